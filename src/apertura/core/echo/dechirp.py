"""Dechirped FMCW signals: transfer functions from beat signals, with the residual video phase removed.

Equation numbers refer to docs/theory/fmcw.md.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import decibels

Mixing = Literal["real", "complex", "conjugate"]

_SWEEPS_AT_ONCE = 256
_BEFORE_ZERO = 1 / 16
"""Fraction of the sample rate of a complex beat signal that is reserved for negative paths, into which the direct path
leaks."""

_MOTION_WAVES = 1 / 8
"""Tolerated change of the total path within a sweep, wavelengths: motion of a monostatic antenna by λ/16."""

_FASTEST = 95.0
"""Percentile of the speeds between pulses that is evaluated, so that single errors of a log have no effect."""


@dataclass(frozen=True)
class FrequencySweep:
    """Linear frequency sweep, and the mixing and sampling of its echoes.

    Attributes
    ----------
    start_hz
        RF frequency at the first sample, or at the trigger, Hz.
    bandwidth_hz
        Change of the frequency in `sweep_s`, Hz; negative for a falling sweep.
    sweep_s
        Length of the linear part, seconds.
    sample_rate_hz
        Sample rate of the beat signal.
    iq
        Mixing of the echo with the sweep. real: one mixer; complex: echo multiplied by the conjugate of the sweep;
        conjugate: sweep multiplied by the conjugate of the echo.
    settle_s
        Time excluded at the start of the sweep, seconds.
    reference_path_m
        Length of the path of the sweep to the mixer inside the radar, metres.

    Examples
    --------
    >>> sweep = FrequencySweep(2.2e9, 400e6, 20e-6, 25e6)
    >>> sweep.samples, round(sweep.path_limit_m, 1)
    (500, 187.4)
    """

    start_hz: float
    bandwidth_hz: float
    sweep_s: float
    sample_rate_hz: float
    iq: Mixing = "real"
    settle_s: float = 0.0
    reference_path_m: float = 0.0

    @property
    def slope_hz_s(self) -> float:
        """Sweep rate γ, Hz/s; negative for a falling sweep."""
        return self.bandwidth_hz / self.sweep_s

    @property
    def sweep_samples(self) -> int:
        """Number of samples of a sweep, counted from the start of the sweep."""
        return int(self.sweep_s * self.sample_rate_hz + 1e-6)

    @property
    def first(self) -> int:
        """Index of the first sample used."""
        return int(np.ceil(self.settle_s * self.sample_rate_hz - 1e-6))

    @property
    def samples(self) -> int:
        """Number of samples used."""
        return self.sweep_samples - self.first

    @property
    def middle_s(self) -> float:
        """Time of the central used sample after the start of the sweep, seconds: epoch of the phase centres (eq. 6)."""
        return (self.first + (self.samples - 1) / 2) / self.sample_rate_hz

    @property
    def reference_delay_s(self) -> float:
        """Delay τ_r of the reference path, seconds."""
        return self.reference_path_m / SPEED_OF_LIGHT_M_S

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """RF frequencies that correspond to the samples, ascending, (subcarrier,) Hz (eq. 2)."""
        time_s = np.arange(self.first, self.sweep_samples) / self.sample_rate_hz - self.reference_delay_s
        rising = self.start_hz + self.slope_hz_s * time_s
        return rising if self.bandwidth_hz > 0 else rising[::-1]

    @property
    def beats_hz(self) -> tuple[float, float]:
        """Lowest and highest unambiguous γΔ, Hz: Δ ≥ 0 for real samples, otherwise one sample rate (eq. 4)."""
        rate = self.sample_rate_hz
        if self.iq == "real":
            return 0.0, rate / 2
        lowest = max(-_BEFORE_ZERO * rate - abs(self.slope_hz_s) * self.reference_delay_s, -rate / 2)
        return lowest, lowest + rate

    @property
    def path_limit_m(self) -> float:
        """Total path, metres, beyond which a beat frequency is ambiguous or an echo lacks half of its band (eq. 4)."""
        longest_s = min(self.beats_hz[1] / abs(self.slope_hz_s), self.samples / self.sample_rate_hz / 2)
        return SPEED_OF_LIGHT_M_S * (self.reference_delay_s + longest_s)


def transfer_of(
    beat: NDArray[np.number], sweep: FrequencySweep, *, late_s: NDArray[np.float64] | None = None, deskewed: bool = True
) -> NDArray[np.complex64]:
    """Compute transfer functions from beat signals, with the residual video phase removed.

    Parameters
    ----------
    beat
        (pulse, sample) real or complex, at least `sweep.sweep_samples` samples from the start of each sweep.
    sweep
        Parameters of the sweep.
    late_s
        (pulse,) float64, delay of the first sample of each sweep after its start, seconds; None: 0.
    deskewed
        False to retain the residual video phase for comparison.

    Returns
    -------
    ndarray
        (pulse, subcarrier) complex64 at `sweep.frequency_hz`: Σ a·exp(-j2πf(τ-τ_r)).

    Notes
    -----
    Source: docs/theory/fmcw.md, eqs. 2 to 5; for deskewing, W. G. Carrara, R. S. Goodman, R. M. Majewski, Spotlight
    Synthetic Aperture Radar, Artech House 1995.

    Examples
    --------
    >>> import numpy as np
    >>> sweep = FrequencySweep(1e9, 200e6, 1e-3, 2e6, iq="complex")
    >>> t, tau = np.arange(2000) / 2e6, 2e-7
    >>> beat = np.exp(-2j * np.pi * (1e9 + 2e11 * t) * tau + 1j * np.pi * 2e11 * tau**2)
    >>> ratio = transfer_of(beat[None], sweep)[0] * np.exp(2j * np.pi * sweep.frequency_hz * tau)
    >>> bool(abs(np.average(ratio, weights=np.hanning(2000)) - 1) < 1e-6)
    True
    """
    kept, slope = sweep.samples, sweep.slope_hz_s
    low, high = sweep.beats_hz
    farthest = min(round((high - min(low, 0.0)) / abs(slope) * sweep.sample_rate_hz) + 1, kept)
    length = scipy.fft.next_fast_len(kept + farthest)  # zero padding prevents circular wrap-around of delays
    bins = -np.sign(slope) * scipy.fft.fftfreq(length, 1 / sweep.sample_rate_hz)
    shift = (bins - low) % sweep.sample_rate_hz + low  # γΔ of each bin; f_b = -γΔ, eq. 1
    response = np.exp(-1j * np.pi * shift**2 / slope) if deskewed else np.ones(length, np.complex128)
    if sweep.iq == "real":  # analytic signal with a one-sided spectrum
        response = response * np.where(shift > high, 0.0, np.where((shift == 0) | (shift == high), 1.0, 2.0))
    beat_hz = -np.sign(slope) * shift
    transfer = np.empty((len(beat), kept), np.complex64)
    for start in range(0, len(beat), _SWEEPS_AT_ONCE):
        sweeps = slice(start, start + _SWEEPS_AT_ONCE)
        samples = np.asarray(beat[sweeps, sweep.first : sweep.sweep_samples])
        spectrum = scipy.fft.fft(samples.conj() if sweep.iq == "conjugate" else samples, length, axis=1) * response
        if late_s is not None:
            spectrum = spectrum * np.exp(-2j * np.pi * late_s[sweeps, None] * beat_hz)
        transfer[sweeps] = scipy.fft.ifft(spectrum, axis=1)[:, :kept]
    return transfer if slope > 0 else np.ascontiguousarray(transfer[:, ::-1])


_IDLE_PARTS = 64
"""Parts of a sweep whose powers are compared."""

_IDLE_BODY = 16
"""First part that is compared: before it, echoes from far away are still missing."""

_IDLE_LEAST = 2
"""Smallest number of parts without echoes that are detected, in addition to a part with the end of the sweep."""

_IDLE_SHARPNESS = 0.5
"""Least difference between the lowest part of the sweep and the highest idle part, relative to that of the medians."""

_IDLE_DROP = 0.1
"""Least decrease of the power, relative to that of echoes and noise together."""


class SweepPower:
    """Power of the fluctuating part of beat signals along the sweep, block by block.

    The mean over all sweeps is subtracted, i.e. echoes at constant range such as the direct path.
    """

    def __init__(self, sweep: FrequencySweep) -> None:
        self._sweep, self._count = sweep, 0
        self._sum, self._squares = np.zeros(sweep.samples, np.complex128), np.zeros(sweep.samples)

    def count(self, beat: NDArray[np.number]) -> None:
        """Add the used samples of sweeps, (sweep, sample)."""
        self._count += len(beat)
        self._sum += beat.sum(axis=0, dtype=np.complex128)
        self._squares += (np.abs(beat).astype(np.float64) ** 2).sum(axis=0)

    @property
    def flags(self) -> dict[str, str]:
        """Flag of sweeps that end before `sweep_s`, after which the rows contain noise only.

        Notes
        -----
        Source: docs/theory/fmcw.md, "Idle time". A window that the recorder applied decreases towards both ends.
        """
        if self._sweep.samples < _IDLE_PARTS or not self._count:
            return {}
        power = (self._squares - np.abs(self._sum) ** 2 / self._count) / self._count
        edges = np.linspace(0, len(power), _IDLE_PARTS + 1).astype(np.int64)
        parts = np.add.reduceat(power, edges[:-1]) / np.diff(edges)
        for end in range(_IDLE_PARTS // 2, _IDLE_PARTS - _IDLE_LEAST):
            body, idle = parts[_IDLE_BODY:end], parts[end + 1 :]  # part `end` contains the end of the sweep
            level, rest = float(np.median(body)), float(np.median(idle))
            is_sharp = body.min() - idle.max() > _IDLE_SHARPNESS * (level - rest)
            is_window = (parts[: len(idle)] < (level + rest) / 2).all()
            if is_sharp and not is_window and level - rest > _IDLE_DROP * level:
                last_s = (self._sweep.first + edges[end : end + 2].mean()) / self._sweep.sample_rate_hz
                drop_db = decibels(level / max(rest, 1e-9 * level))
                line = (
                    f"the power of the samples decreases by {drop_db:.1f} dB after {last_s:.3g} s; waveform.sweep_s is "
                    f"{self._sweep.sweep_s:.3g} s"
                )
                return {"sweep_idle": line}
        return {}


def sweep_motion_flags(
    time: NDArray[np.datetime64],
    antennas: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    lasting_s: float,
    frequency_hz: NDArray[np.float64],
) -> dict[str, str]:
    """Return a flag if the motion of the antennas during a sweep displaces the envelope of an echo from its phase.

    Parameters
    ----------
    time
        (pulse,) datetime64[ns], centre times of the sweeps.
    antennas
        Positions of the transmitting and the receiving antenna, (pulse, 3) float64 each, metres, in the same Cartesian
        frame.
    lasting_s
        Duration of the used part of a sweep, seconds; 0: no sweep.
    frequency_hz
        (subcarrier,) float64, ascending.

    Notes
    -----
    Source: docs/theory/fmcw.md, eq. 7. The path of an echo changes by at most the sum of the motions of both antennas.
    """
    if not lasting_s or len(time) < 2:
        return {}
    step_s = np.diff(time) / np.timedelta64(1, "s")
    speed_m_s = sum(np.linalg.norm(np.diff(position_m, axis=0), axis=1) for position_m in antennas) / step_s
    moved_m = float(np.percentile(speed_m_s, _FASTEST)) * lasting_s
    middle_hz = float(frequency_hz[[0, -1]].mean())
    if moved_m <= _MOTION_WAVES * SPEED_OF_LIGHT_M_S / middle_hz:
        return {}
    displaced_m = moved_m * middle_hz / float(frequency_hz[-1] - frequency_hz[0])
    return {
        "sweep_motion": "antenna motion changes the total path by up to "
        f"{moved_m * middle_hz / SPEED_OF_LIGHT_M_S:.2f} wavelengths within a sweep: echoes are displaced by up to "
        f"{displaced_m:.2g} m of total path, with opposite signs ahead and astern"
    }
