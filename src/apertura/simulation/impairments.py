"""What goes wrong, each on its own switch and off by default."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Clock:
    """The receiver's clock against the transmitter's.

    Attributes
    ----------
    cfo_hz, sfo_hz
        Its local oscillator and sampling rate less their nominal frequencies, Hz: the received signal turns by
        −cfo_hz at baseband and is sampled sfo_hz too often.
    continuous_phase
        The oscillator runs on between pulses (phase −2π·cfo·t from pulse to pulse) instead of beginning anew
        at each trigger.
    """

    cfo_hz: float = 0.0
    sfo_hz: float = 0.0
    continuous_phase: bool = False

    @classmethod
    def of_ppm(cls, ppm: float, *, carrier_hz: float, sample_rate_hz: float, continuous_phase: bool = False) -> "Clock":
        """Return one clock that feeds both, fast by `ppm`.

        Examples
        --------
        >>> Clock.of_ppm(8, carrier_hz=1.25e9, sample_rate_hz=1e9)
        Clock(cfo_hz=10000.0, sfo_hz=8000.0, continuous_phase=False)
        """
        return cls(ppm * carrier_hz / 1e6, ppm * sample_rate_hz / 1e6, continuous_phase)


@dataclass(frozen=True)
class UniformPhase:
    """Carrier phase per pulse, uniform in ±half_width_rad (π: unknown altogether)."""

    half_width_rad: float = np.pi


@dataclass(frozen=True)
class PhaseWalk:
    """Carrier phase as a random walk: free-running oscillators, variance growing by rad²/s."""

    rad_per_root_s: float


@dataclass(frozen=True)
class Timing:
    """Start of the capture less start of the pulse.

    Attributes
    ----------
    offset_s
        Constant.
    half_width_s
        Uniform in ± this per pulse.
    jitter_samples
        Standard deviation of whole samples by which the trigger fires late.
    """

    offset_s: float = 0.0
    half_width_s: float = 0.0
    jitter_samples: float = 0.0


@dataclass(frozen=True)
class TimeTag:
    """Error of the node's UTC tags: constant, growing, and scattering (standard deviation)."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    jitter_s: float = 0.0


@dataclass(frozen=True)
class Reflection:
    """An extra sidelink path: metres longer than the direct one, amplitude relative to it."""

    excess_m: float
    amplitude: complex


@dataclass(frozen=True)
class Blockage:
    """Sidelink shadowed in bursts: share of pulses, mean length of a burst in pulses, attenuation.

    Notes
    -----
    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39 (1960): two-state chain.
    """

    fraction: float
    mean_pulses: float = 10.0
    attenuation_db: float = 60.0


@dataclass(frozen=True)
class Leakage:
    """Direct coupling of the radar antennas, dB against the RMS echo spectrum; `path_m` beyond their distance."""

    level_db: float
    path_m: float = 0.0


@dataclass(frozen=True)
class Ripple:
    """An internal reflection: response 1 + ρ·exp(-j2πf·delay), `peak_to_peak_db` across the band.

    Examples
    --------
    >>> response = Ripple(1.0, 50e-9).response(1e9 + 1e5 * np.arange(4000))
    >>> level_db = 20 * np.log10(abs(response))
    >>> float((level_db.max() - level_db.min()).round(3))
    1.0
    """

    peak_to_peak_db: float
    delay_s: float

    def response(self, frequency_hz: Floats) -> NDArray[np.complex128]:
        """Return (subcarrier,) complex128."""
        ratio = 10 ** (self.peak_to_peak_db / 20)
        reflected = (ratio - 1) / (ratio + 1)
        return np.asarray(1 + reflected * np.exp(-2j * np.pi * frequency_hz * self.delay_s))


@dataclass(frozen=True)
class Adc:
    """Bits of the converter, and how far under its full scale the RMS of I and of Q lies."""

    bits: int = 14
    backoff_db: float = 14.0


@dataclass(frozen=True)
class Localization:
    """Logged position less true position.

    Attributes
    ----------
    sigma_m
        Standard deviation per axis after the moving average.
    window_s
        Length of the moving average over white noise.
    points
        Antennas that are elsewhere than the log says: `radar_tx`, `radar_rx`, `sidelink`.
    """

    sigma_m: float
    window_s: float = 1.0
    points: tuple[str, ...] = ("radar_tx", "radar_rx", "sidelink")


@dataclass(frozen=True)
class Impairments:
    """Everything that is wrong with one node; the default is a perfect one with a 14-bit converter.

    SNR is per subcarrier: mean power of the unimpaired echoes (or of the direct path at gain 1) over pulses
    and subcarriers, against the noise of one DFT bin. What else reaches the channel does not change the noise.
    """

    clock: Clock = Clock()
    carrier_phase: UniformPhase | PhaseWalk | None = None
    timing: Timing = Timing()
    missed_fraction: float = 0.0
    time_tag: TimeTag = TimeTag()
    radar_snr_db: float | None = None
    sidelink_snr_db: float | None = None
    sidelink_gain_db: float = 0.0
    sidelink_multipath: tuple[Reflection, ...] = ()
    sidelink_blockage: Blockage | None = None
    leakage: Leakage | None = None
    transmit_ripple: Ripple | None = None
    radar_ripple: Ripple | None = None
    sidelink_ripple: Ripple | None = None
    adc: Adc = Adc()
    localization: Localization | None = None
    doppler: bool = False
