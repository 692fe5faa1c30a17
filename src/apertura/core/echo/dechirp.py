"""Beat signals of a radar that mixes echoes with its own sweep: transfer functions, without residual video phase.

Equations are those of docs/theory/fmcw.md.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S

Mixing = Literal["real", "complex", "conjugate"]

_SWEEPS_AT_ONCE = 256
_BEFORE_ZERO = 1 / 16
"""Share of the sample rate of a complex beat that is of paths before zero, which leakage of the direct path reaches."""

_MOTION_WAVES = 1 / 8
"""Wavelengths of path within a sweep that are tolerated: λ/16 flown by one antenna that sends and receives."""

_FASTEST = 95.0
"""Percentile of speeds between pulses that counts as motion: single errors of a log do not."""


@dataclass(frozen=True)
class FrequencySweep:
    """A linear frequency sweep, and the mixing and sampling of its echoes.

    Attributes
    ----------
    start_hz
        RF frequency at the first sample, or at the trigger, Hz.
    bandwidth_hz
        Rise of the frequency in `sweep_s`, Hz; negative where it falls.
    sweep_s
        Length of the linear part, seconds.
    sample_rate_hz
        Of the beat signal.
    iq
        real: one mixer; complex: echo times conjugate of the sweep; conjugate: the reverse.
    settle_s
        Time left out at the beginning, seconds.
    reference_path_m
        Path of the sweep to the mixer, metres.

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
        """γ, Hz/s, negative where frequency falls."""
        return self.bandwidth_hz / self.sweep_s

    @property
    def sweep_samples(self) -> int:
        """Samples of a sweep from its beginning."""
        return int(self.sweep_s * self.sample_rate_hz + 1e-6)

    @property
    def first(self) -> int:
        """The first sample used."""
        return int(np.ceil(self.settle_s * self.sample_rate_hz - 1e-6))

    @property
    def samples(self) -> int:
        """Samples used."""
        return self.sweep_samples - self.first

    @property
    def middle_s(self) -> float:
        """The middle of the samples used, seconds after the sweep began: where phase centres belong (eq. 6)."""
        return (self.first + (self.samples - 1) / 2) / self.sample_rate_hz

    @property
    def reference_delay_s(self) -> float:
        """τ_r, seconds."""
        return self.reference_path_m / SPEED_OF_LIGHT_M_S

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """RF frequencies that the samples are those of, ascending, (subcarrier,) Hz (eq. 2)."""
        time_s = np.arange(self.first, self.sweep_samples) / self.sample_rate_hz - self.reference_delay_s
        rising = self.start_hz + self.slope_hz_s * time_s
        return rising if self.bandwidth_hz > 0 else rising[::-1]

    @property
    def beats_hz(self) -> tuple[float, float]:
        """Lowest and highest unambiguous γΔ, Hz: of positive Δ, or of one sample rate (eq. 4)."""
        rate = self.sample_rate_hz
        if self.iq == "real":
            return 0.0, rate / 2
        lowest = max(-_BEFORE_ZERO * rate - abs(self.slope_hz_s) * self.reference_delay_s, -rate / 2)
        return lowest, lowest + rate

    @property
    def path_limit_m(self) -> float:
        """Total path beyond which a beat is ambiguous, or lacks half of its band, metres (eq. 4)."""
        beyond_s = min(self.beats_hz[1] / abs(self.slope_hz_s), self.samples / self.sample_rate_hz / 2)
        return SPEED_OF_LIGHT_M_S * (self.reference_delay_s + beyond_s)


def transfer_of(
    beat: NDArray[np.number], sweep: FrequencySweep, *, late_s: NDArray[np.float64] | None = None, deskewed: bool = True
) -> NDArray[np.complex64]:
    """Return transfer functions from beat signals, without residual video phase.

    Parameters
    ----------
    beat
        (pulse, sample) real or complex, `sweep.sweep_samples` samples from the beginning of each sweep, or more.
    sweep
        The sweep.
    late_s
        (pulse,) float64, seconds by which the first sample of each sweep was taken after its beginning; None: 0.
    deskewed
        False leaves the residual video phase, for comparison.

    Returns
    -------
    ndarray
        (pulse, subcarrier) complex64 at `sweep.frequency_hz`: Σ a·exp(-j2πf(τ-τ_r)).

    Notes
    -----
    Source: docs/theory/fmcw.md, eqs. 2 to 5; W. G. Carrara, R. S. Goodman, R. M. Majewski, Spotlight Synthetic Aperture
    Radar, Artech House 1995, on deskewing.

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
    length = scipy.fft.next_fast_len(kept + farthest)  # room for shifts, so that none wraps around
    bins = -np.sign(slope) * scipy.fft.fftfreq(length, 1 / sweep.sample_rate_hz)
    shift = (bins - low) % sweep.sample_rate_hz + low  # γΔ of each bin; f_b = -γΔ, eq. 1
    turn = np.exp(-1j * np.pi * shift**2 / slope) if deskewed else np.ones(length, np.complex128)
    if sweep.iq == "real":
        turn = turn * np.where(shift > high, 0.0, np.where((shift == 0) | (shift == high), 1.0, 2.0))
    beat_hz = -np.sign(slope) * shift
    transfer = np.empty((len(beat), kept), np.complex64)
    for begin in range(0, len(beat), _SWEEPS_AT_ONCE):
        part = slice(begin, begin + _SWEEPS_AT_ONCE)
        some = np.asarray(beat[part, sweep.first : sweep.sweep_samples])
        spectrum = scipy.fft.fft(some.conj() if sweep.iq == "conjugate" else some, length, axis=1) * turn
        if late_s is not None:
            spectrum = spectrum * np.exp(-2j * np.pi * late_s[part, None] * beat_hz)
        transfer[part] = scipy.fft.ifft(spectrum, axis=1)[:, :kept]
    return transfer if slope > 0 else np.ascontiguousarray(transfer[:, ::-1])


def sweep_motion_flags(
    time: NDArray[np.datetime64],
    antennas: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    lasting_s: float,
    frequency_hz: NDArray[np.float64],
) -> dict[str, str]:
    """Return a flag where the antennas move so far during a sweep that envelopes and phases disagree.

    Parameters
    ----------
    time
        (pulse,) datetime64[ns], the middles of the sweeps.
    antennas
        Of transmitter and receiver, (pulse, 3) float64 metres each, one Cartesian frame.
    lasting_s
        Length of the part of a sweep that is used, seconds; 0: no sweep.
    frequency_hz
        (subcarrier,) float64, ascending.

    Notes
    -----
    Source: docs/theory/fmcw.md, eq. 7. The path of an echo changes by no more than both antennas move.
    """
    if not lasting_s or len(time) < 2:
        return {}
    step_s = np.diff(time) / np.timedelta64(1, "s")
    speed_m_s = sum(np.linalg.norm(np.diff(one, axis=0), axis=1) for one in antennas) / step_s
    moved_m = float(np.percentile(speed_m_s, _FASTEST)) * lasting_s
    middle_hz = float(frequency_hz[[0, -1]].mean())
    if moved_m <= _MOTION_WAVES * SPEED_OF_LIGHT_M_S / middle_hz:
        return {}
    smeared_m = moved_m * middle_hz / float(frequency_hz[-1] - frequency_hz[0])
    return {
        "sweep_motion": f"antennas move {moved_m * middle_hz / SPEED_OF_LIGHT_M_S:.2f} wavelengths of path within a "
        f"sweep: echoes are up to {smeared_m:.2g} m of path off, one way ahead and the other astern"
    }
