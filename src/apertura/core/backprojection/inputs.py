"""Inputs of engines: phase history and range profiles as arrays, independent of settings and files."""

from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, quoted
from apertura.core.geometry.aperture import Aperture, as_array


def _as_arrays(inputs: Any, kinds: dict[str, type]) -> None:
    """Convert lists of an input to arrays; arrays, including lazily read arrays, are unchanged.

    Raises
    ------
    CampaignError
        If a value is not an array of numbers, if `aperture` is not an `Aperture`, or if the wave speed is not plausible
        for a radio wave.
    """
    where = type(inputs).__name__
    for name, kind in kinds.items():
        object.__setattr__(inputs, name, as_array(getattr(inputs, name), kind, f"{where}: {name}"))
    slowest, speed = SPEED_OF_LIGHT_M_S / 1.1, inputs.wave_speed_m_s
    if not (isinstance(speed, Real) and slowest < float(speed) <= SPEED_OF_LIGHT_M_S):
        raise CampaignError(
            quoted(speed),
            where=f"{where}: wave_speed_m_s",
            expected=f"a wave speed from {slowest:.0f} m/s to {SPEED_OF_LIGHT_M_S} m/s, the speed of light in vacuum",
            remedy="Use apertura.wave_speed(N units).",
        )
    if not isinstance(inputs.aperture, Aperture):
        raise CampaignError(
            f"an object of type {type(inputs.aperture).__name__}",
            where=f"{where}: aperture",
            expected="an Aperture: phase centres of transmitter and receiver, (pulse, 3) each",
            remedy="Create an aperture with Aperture(tx_m, rx_m).",
        )


def _check_shapes(inputs: Any, expected: dict[str, tuple[int, ...]], description: str) -> None:
    """Raise CampaignError if the shapes of the arrays are inconsistent."""
    found = {name: tuple(getattr(inputs, name).shape) for name in expected}
    pulses = {"aperture": len(inputs.aperture)} | {name: shape[0] if shape else 0 for name, shape in found.items()}
    if found != expected or pulses["aperture"] != next(iter(expected.values()))[0]:
        shapes = ", ".join(f"{name} {shape}" for name, shape in found.items())
        raise CampaignError(
            f"{shapes}, aperture of {pulses['aperture']} pulses",
            where=f"{type(inputs).__name__}",
            expected=description,
            remedy="Transpose arrays with interchanged axes; the rows of each array correspond to the pulses.",
        )


class PhaseRotated:
    """Samples of pulses that are multiplied by a factor for each pulse on access.

    Examples
    --------
    >>> np.asarray(PhaseRotated(np.ones((3, 2), np.complex64), np.array([1, 1j, -1]))[1:])
    array([[ 0.+1.j,  0.+1.j],
           [-1.+0.j, -1.+0.j]], dtype=complex64)
    """

    def __init__(self, samples: Any, factor: NDArray[np.complex128]):
        self._samples, self._factor = samples, factor.astype(np.complex64)
        self.shape, self.ndim, self.dtype = samples.shape, samples.ndim, samples.dtype

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self._samples)

    def __getitem__(self, pulses: slice) -> NDArray[np.complex64]:
        """Return the samples of a slice of pulses."""
        return np.asarray(self._samples[pulses]) * self._factor[pulses, None]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the samples of all pulses."""
        return np.asarray(self[:], dtype)


@dataclass(frozen=True)
class PhaseHistory:
    """Calibrated transfer functions, the input of engine `reference`.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ - reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, RF frequency.
    weight
        (subcarrier,) float64, window over the subcarriers.
    reference_delay_s
        (pulse,) float64, delay that is already removed from `transfer`, seconds.
    aperture
        Phase centres in the frame of the pixels.
    wave_speed_m_s
        Speed of the wave along the paths, m/s: path = speed · delay (docs/theory/atmosphere.md, eq. 4).

    Raises
    ------
    CampaignError
        If a value is not an array of numbers, if shapes are inconsistent, or if the wave is faster than light.
    """

    transfer: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]
    weight: NDArray[np.float64]
    reference_delay_s: NDArray[np.float64]
    aperture: Aperture
    wave_speed_m_s: float = SPEED_OF_LIGHT_M_S

    def __post_init__(self) -> None:
        real = dict.fromkeys(("frequency_hz", "weight", "reference_delay_s"), np.float64)
        _as_arrays(self, {"transfer": np.complex64, **real})
        pulses, subcarriers = self.transfer.shape if self.transfer.ndim == 2 else (-1, -1)
        vectors = {"reference_delay_s": (pulses,), "frequency_hz": (subcarriers,), "weight": (subcarriers,)}
        shapes = "transfer (pulse, subcarrier), reference_delay_s (pulse,), frequency_hz and weight (subcarrier,)"
        description = f"{shapes}, and an aperture with the same number of pulses"
        _check_shapes(self, {"transfer": (pulses, subcarriers), **vectors}, description)
        if subcarriers == 0:
            expected = "two or more subcarriers over a band that provides range resolution"
            remedy = "Provide the transfer function over a band."
            raise CampaignError("no subcarriers", "PhaseHistory: transfer", expected, remedy)

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.transfer)

    def __getitem__(self, pulses: slice) -> "PhaseHistory":
        """Return the phase history of a slice of pulses; the arrays are views."""
        return replace(
            self,
            transfer=self.transfer[pulses],
            reference_delay_s=self.reference_delay_s[pulses],
            aperture=self.aperture[pulses],
        )

    def moved(self, aperture: Aperture, extra_path_m: NDArray[np.float64]) -> "PhaseHistory":
        """Return the same echoes with new phase centres and with paths increased by `extra_path_m`.

        See `Profiles.moved`.
        """
        delay_s = self.reference_delay_s + extra_path_m / self.wave_speed_m_s
        return replace(self, reference_delay_s=delay_s, aperture=aperture)

    def at_speed(self, wave_speed_m_s: float) -> "PhaseHistory":
        """Return the phase history with unchanged delays for a different wave speed, m/s."""
        return replace(self, wave_speed_m_s=wave_speed_m_s)


@dataclass(frozen=True)
class Profiles:
    """Range profiles of a band-limited signal, cropped to the scene.

    Sample i of pulse p at the total path ``start_m[p] + i·step_m`` has the value
    Σ_n w_n H_n exp(+j2π(f_n - f_mid)·path/v), where H_n refers to absolute delay and v is the wave speed. At a target,
    the products profile·exp(+j2π f_mid·path/v) of all pulses are therefore in phase.

    Attributes
    ----------
    samples
        (pulse, range) complex64, oversampled by `oversampling` ≥ 2 relative to the cell v/B of the total path.
    start_m
        (pulse,) float64, total path tx → pixel → rx of sample 0, metres.
    step_m
        Total path between samples, metres.
    centre_frequency_hz
        Centre frequency f_mid, Hz.
    oversampling
        Samples per Nyquist cell, (v/B)/step_m.
    aperture
        Phase centres in the frame of the pixels.
    wave_speed_m_s
        Wave speed v, as in `PhaseHistory`.

    Raises
    ------
    CampaignError
        If a value is not an array of numbers, if shapes are inconsistent, if the step is not positive, if the
        oversampling is 1 or less, or if the wave is faster than light.
    """

    samples: NDArray[np.complex64]
    start_m: NDArray[np.float64]
    step_m: float
    centre_frequency_hz: float
    oversampling: float
    aperture: Aperture
    wave_speed_m_s: float = SPEED_OF_LIGHT_M_S

    def __post_init__(self) -> None:
        _as_arrays(self, {"samples": np.complex64, "start_m": np.float64})
        pulses, length = self.samples.shape if self.samples.ndim == 2 else (-1, -1)
        description = "samples (pulse, range), start_m (pulse,), and an aperture with the same number of pulses"
        _check_shapes(self, {"samples": (pulses, length), "start_m": (pulses,)}, description)
        for name, least in (("step_m", 0.0), ("oversampling", 1.0), ("centre_frequency_hz", -np.inf)):
            value = getattr(self, name)
            if not (isinstance(value, Real) and least < float(value) < np.inf):
                expected = f"a number above {least:g}" if np.isfinite(least) else "a number"
                remedy = "Use the value that range compression returned."
                raise CampaignError(quoted(value), f"Profiles: {name}", expected, remedy)

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/v."""
        return 2 * np.pi * self.centre_frequency_hz / self.wave_speed_m_s

    @property
    def wavelength_m(self) -> float:
        """v/f_mid."""
        return self.wave_speed_m_s / self.centre_frequency_hz

    @property
    def bandwidth_hz(self) -> float:
        """Bandwidth B of the resolution cell v/B."""
        return self.wave_speed_m_s / (self.step_m * self.oversampling)

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.samples)

    def __getitem__(self, pulses: slice) -> "Profiles":
        """Return the profiles of a slice of pulses as views; the images of pulse blocks add up to the whole image."""
        return replace(
            self,
            samples=self.samples[pulses],
            start_m=self.start_m[pulses],
            aperture=self.aperture[pulses],
        )

    def for_tables(self) -> tuple[NDArray[np.complex64], NDArray[np.float64], list[NDArray[np.float64]]]:
        """Return samples, starts and phase centres of both antennas as arrays, validated for polynomial tables.

        Raises
        ------
        ValueError
            If the oversampling is below 1.5, if there is no pulse, or if a position or start is not finite.
        """
        if not self.oversampling >= 1.5:
            raise ValueError(f"{self.oversampling=}: must be at least 1.5")
        if not len(self):
            raise ValueError(f"{self.samples.shape=}: must contain at least one pulse")
        start_m = np.ascontiguousarray(self.start_m, np.float64)
        phase_centres = [np.asarray(leg, np.float64) for leg in self.aperture.legs]
        if not all(np.isfinite(values).all() for values in (start_m, *phase_centres)):
            raise ValueError("phase centres and starts of the profiles must be finite")
        return np.ascontiguousarray(self.samples, np.complex64), start_m, phase_centres

    def moved(self, aperture: Aperture, extra_path_m: NDArray[np.float64]) -> "Profiles":
        """Return the same echoes with new phase centres and with paths increased by `extra_path_m`.

        Parameters
        ----------
        aperture
            Phase centres of the same number of pulses.
        extra_path_m
            (pulse,) float64, increase of the measured path of all echoes of a pulse, metres.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 3: an echo at path R is shifted to R + ∆ and has the phase of R + ∆.
        """
        rotated = (
            PhaseRotated(self.samples, np.exp(-1j * self.wavenumber_rad_m * extra_path_m))
            if np.any(extra_path_m)
            else self.samples
        )
        samples = cast("NDArray[np.complex64]", rotated)
        return replace(self, samples=samples, start_m=self.start_m + extra_path_m, aperture=aperture)

    def at_speed(self, wave_speed_m_s: float) -> "Profiles":
        """Return the profiles with unchanged delays for a different wave speed, m/s."""
        scale = wave_speed_m_s / self.wave_speed_m_s
        return replace(self, start_m=scale * self.start_m, step_m=scale * self.step_m, wave_speed_m_s=wave_speed_m_s)
