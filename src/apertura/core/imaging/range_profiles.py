"""Range profiles of a scene: range window of each pulse, range compression, and conversion of datasets to arrays."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.gate import RangeGate
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import Terrain, ground_of

# ---- Range windows and compression

GUARD_SAMPLES = 32
"""Number of guard samples beyond each edge of the swath, required by the interpolation filters of the engines."""

OVERSAMPLING = 2.0
"""Oversampling factor of the profiles: half of the band remains for the transition of the interpolation filter."""


@dataclass(frozen=True, eq=False)
class RangeWindow:
    """Interval of total path lengths (bistatic ranges) covered by the range profiles.

    Attributes
    ----------
    start_m
        (pulse,) float64, total path of sample 0, metres.
    samples
        Number of samples per pulse.
    step_m
        Total path between samples.
    unambiguous
        Period of a profile, samples.
    farthest_m
        (pulse,) float64, longest total path to a pixel to which the pulse contributes, metres; -inf if there is no such
        pixel.
    wave_speed_m_s
        Wave speed with which delays are converted to paths.
    gate
        Gate of the recorded paths, which profiles contain; None: all echoes are recorded.
    """

    start_m: NDArray[np.float64]
    samples: int
    step_m: float
    unambiguous: int
    farthest_m: NDArray[np.float64]
    wave_speed_m_s: float
    gate: RangeGate | None = None

    @property
    def contributing(self) -> NDArray[np.bool_]:
        """(pulse,) bool, True where a pulse may contribute to a pixel; profiles of other pulses are never read."""
        return np.isfinite(self.farthest_m)

    @classmethod
    def of(
        cls,
        aperture: Aperture,
        grid: SceneGrid,
        terrain: Terrain,
        frequency_hz: NDArray[np.float64],
        *,
        beams: Beams | None = None,
        wave_speed_m_s: float,
        together: int = 1,
    ) -> "RangeWindow":
        """Return the range window of a scene.

        Parameters
        ----------
        aperture
            Phase centres in the frame of the pixels.
        grid, terrain
            The scene.
        frequency_hz
            (subcarrier,) float64, ascending in equal steps.
        beams
            Weights of pulses: the window of a pulse covers the pixels to which the pulse may contribute (default: the
            whole scene).
        wave_speed_m_s
            Speed of the wave along the paths.
        together
            Number of consecutive pulses for which a single window is computed. Larger numbers reduce the computing
            time; the window becomes wider by the motion of the antennas during these pulses.

        Notes
        -----
        Source: docs/theory.md, eq. 4.
        """
        nearest, farthest = swath(grid, terrain, aperture, beams=beams, together=together)
        step, length = range_step(frequency_hz, oversampling=OVERSAMPLING, wave_speed_m_s=wave_speed_m_s)
        spans = farthest - nearest
        samples = int(np.ceil(spans.max(initial=0.0, where=np.isfinite(spans)) / step)) + 2 * GUARD_SAMPLES + 1
        nearest = np.where(np.isfinite(nearest), nearest, 0.0)
        gate = None if beams is None else beams.gate
        return cls(nearest - GUARD_SAMPLES * step, samples, step, length, farthest, wave_speed_m_s, gate)

    def part(self, pulses: slice) -> "RangeWindow":
        """Return the window of a slice of pulses."""
        gate = self.gate and self.gate[pulses]
        return replace(self, start_m=self.start_m[pulses], farthest_m=self.farthest_m[pulses], gate=gate)


def range_compress(
    history: PhaseHistory, grid: SceneGrid, terrain: Terrain | float | None, *, window: RangeWindow | None = None
) -> Profiles:
    """Compress calibrated transfer functions to range profiles, cropped to a scene.

    Parameters
    ----------
    history
        Transfer functions with their window over the subcarriers, or the dataset of a campaign's stage `echo`.
    grid, terrain
        The scene, as for `backproject`.
    window
        Total paths to cover (default: total paths of the scene).

    Returns
    -------
    Profiles
        Oversampled by 2, with 32 guard samples on both sides of the swath; multiplied by the gate of the window.

    Raises
    ------
    CampaignError
        If the scene is deeper than the unambiguous range, or an argument has the wrong type.
    ValueError
        If the window was computed for a different wave speed.

    Notes
    -----
    Source: docs/theory.md, eq. 4 and 4a.

    Examples
    --------
    >>> from apertura.core.scene.terrain import FlatGround
    >>> frequency = 1.2e9 + 1e6 * np.arange(128)
    >>> track = np.stack([np.linspace(-1, 1, 8), np.full(8, -20.0), np.full(8, 10.0)], -1)
    >>> aperture = Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(8), aperture)
    >>> profiles = range_compress(history, SceneGrid("local", -5.0, 5.0, 0.5, (20, 20)), FlatGround(0.0))
    >>> len(profiles), round(float(np.abs(profiles.samples).max()), 1)
    (8, 1.0)
    """
    ground, inputs = ground_of(terrain, grid), history if isinstance(history, PhaseHistory) else inputs_of(history)
    if not isinstance(inputs, PhaseHistory):
        raise CampaignError(
            "range profiles", "history", "a PhaseHistory", "Use the profiles, which are already compressed in range."
        )
    history, frequency, speed = inputs, inputs.frequency_hz, inputs.wave_speed_m_s
    window = window or RangeWindow.of(history.aperture, grid, ground, frequency, wave_speed_m_s=speed)
    if window.wave_speed_m_s != speed:
        raise ValueError(f"{window.wave_speed_m_s=}: must be {speed}, the wave speed of the history")
    if window.samples > window.unambiguous:
        raise CampaignError(
            f"the scene spans {window.samples} range samples",
            where="grid",
            expected=f"at most {window.unambiguous} range samples, the unambiguous range",
            remedy="Reduce the extent of the scene, or sample the band with a smaller frequency step.",
        )
    samples = compress(
        history.transfer,
        frequency,
        weight=history.weight,
        reference_delay_s=history.reference_delay_s,
        start_m=window.start_m,
        count=window.samples,
        oversampling=OVERSAMPLING,
        wave_speed_m_s=speed,
    )
    if window.gate is not None:
        samples *= window.gate.at(window.start_m[:, None] + window.step_m * np.arange(window.samples)).astype(
            np.float32
        )
    return Profiles(
        samples,
        window.start_m,
        window.step_m,
        centre_frequency(frequency),
        window.unambiguous / len(frequency),
        history.aperture,
        speed,
    )


class CompressionError:
    """Error of range profiles relative to the transfer functions, at random samples of random pulses of each block.

    Parameters
    ----------
    generator
        Random generator that draws the pulses and samples.

    Notes
    -----
    Source: docs/theory.md, eq. 4 and 5: the reference is the sum over the subcarriers at the path of a sample, in
    float64.

    Examples
    --------
    >>> frequency = 1.2e9 + 1e6 * np.arange(64)
    >>> track = np.zeros((4, 3))
    >>> history = PhaseHistory(np.ones((4, 64), np.complex64), frequency, np.full(64, 1 / 64), np.zeros(4),
    ...                        Aperture(track, track))
    >>> samples = compress(history.transfer, frequency, weight=history.weight, reference_delay_s=np.zeros(4),
    ...                    start_m=np.full(4, -20.0), count=20, oversampling=2.0)
    >>> error = CompressionError(np.random.default_rng(1))
    >>> error.add(history, Profiles(samples, np.full(4, -20.0), 299792458.0 / 1.28e8, frequency[32], 2.0,
    ...                             history.aperture))
    >>> error.decibels < -110
    True
    """

    _PULSES, _SAMPLES = 2, 16

    def __init__(self, generator: np.random.Generator):
        self._generator, self._error_power, self._power = generator, 0.0, 0.0

    def add(self, history: PhaseHistory, profiles: Profiles, gate: RangeGate | None = None) -> None:
        """Compare random samples of random pulses of profiles with the exact sum over the transfer functions."""
        for pulse in self._generator.integers(len(history), size=self._PULSES):
            sample_indices = self._generator.integers(profiles.samples.shape[1], size=self._SAMPLES)
            path_m = profiles.start_m[pulse] + profiles.step_m * sample_indices
            delay_s = path_m / history.wave_speed_m_s - history.reference_delay_s[pulse]
            cycles = history.frequency_hz[:, None] * delay_s
            exact = (history.weight * history.transfer[pulse]) @ np.exp(2j * np.pi * (cycles % 1.0))
            if gate is not None:
                exact = exact * gate[pulse : pulse + 1].at(path_m[None])[0]
            carrier = np.exp(1j * np.remainder(profiles.wavenumber_rad_m * path_m, 2 * np.pi))
            self._error_power += float((np.abs(profiles.samples[pulse, sample_indices] * carrier - exact) ** 2).sum())
            self._power += float((np.abs(exact) ** 2).sum())

    @property
    def decibels(self) -> float:
        """RMS error relative to the RMS of the samples, dB; -300 if nothing was compared."""
        return decibels(self._error_power / max(self._power, 1e-300))


# ---- Datasets of stages as inputs of engines

_SPARSE_STEP = 64  # step in pulses, above which a slice is read pulse by pulse


class Rows:
    """Samples of the dataset of a stage, read on access for slices of pulses.

    Parameters
    ----------
    array
        (pulse, sample), opened lazily.

    Examples
    --------
    >>> rows = Rows(xr.DataArray(np.arange(12).reshape(4, 3)))
    >>> len(rows), rows[1:4:2].tolist(), np.asarray(rows).sum()
    (4, [[3, 4, 5], [9, 10, 11]], np.int64(66))
    """

    def __init__(self, array: xr.DataArray):
        self._array = array
        self.shape, self.ndim, self.dtype = array.shape, array.ndim, array.dtype

    def __len__(self) -> int:
        """Return the number of pulses."""
        return int(self.shape[0])

    def __getitem__(self, pulses: slice) -> NDArray[Any]:
        """Return the samples of a slice of pulses; for a sparse slice, only the pulses of the slice are decoded."""
        first, last, step = pulses.indices(len(self))
        if step > _SPARSE_STEP:
            return np.stack([self._array[number].values for number in range(first, last, step)])
        return np.asarray(self._array[first:last].values[::step])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the samples of all pulses."""
        return np.asarray(self._array.values, dtype)


def phase_history_of(echo: xr.Dataset, window: str, *, lazy: bool = False) -> PhaseHistory:
    """Return the dataset of stage `echo` as arrays with a subcarrier window; `lazy`: samples are read on access."""
    return PhaseHistory(
        cast("NDArray[np.complex64]", Rows(echo.transfer)) if lazy else echo.transfer.values,
        echo.frequency.values,
        window_weights(window, len(echo.subcarrier)),
        echo.reference_delay.values,
        aperture_of(echo),
        wave_speed_of(echo),
    )


def profiles_of(profile: xr.Dataset, *, lazy: bool = False) -> Profiles:
    """Return the dataset of stage `profile` as arrays; `lazy` as for `phase_history_of`."""
    return Profiles(
        cast("NDArray[np.complex64]", Rows(profile.profile)) if lazy else profile.profile.values,
        profile.start.values,
        profile.attrs["step_m"],
        profile.attrs["centre_frequency_hz"],
        profile.attrs["oversampling"],
        aperture_of(profile),
        wave_speed_of(profile),
    )


def wave_speed_of(stage: xr.Dataset) -> float:
    """Return the wave speed (m/s) recorded in the dataset of stage `echo` or `profile`."""
    return float(stage.attrs["wave_speed_m_s"])


def aperture_of(stage: xr.Dataset) -> Aperture:
    """Return the phase centres in the dataset of stage `echo` or `profile`."""
    return Aperture(stage.tx_position.values, stage.rx_position.values)


def inputs_of(given: PhaseHistory | Profiles | xr.Dataset, window: str = "hann") -> PhaseHistory | Profiles:
    """Return the inputs of an engine: the given arrays, or the arrays in the dataset of stage `echo` or `profile`.

    Raises
    ------
    CampaignError
        If the argument is neither such an array object nor such a dataset.
    """
    if isinstance(given, PhaseHistory | Profiles):
        return given
    if not hasattr(given, "data_vars"):
        raise CampaignError(
            f"an object of type {type(given).__name__}",
            where="profiles",
            expected="PhaseHistory, Profiles, or an xarray.Dataset of stage echo or profile",
            remedy="Construct a PhaseHistory or Profiles from its arrays.",
        )
    if "transfer" in given:
        return phase_history_of(given, window)
    if "profile" in given:
        return profiles_of(given)
    raise CampaignError(
        f"a dataset with variables {', '.join(sorted(map(str, given.variables)))}",
        where="profiles",
        expected="a dataset of stage echo (variable transfer) or of stage profile (variable profile)",
        remedy="Open the dataset of one of these stages.",
    )
