"""What goes wrong, each on its own switch and off by default, and what was drawn of it.

Every random impairment has its own stream of random numbers, so that switching one on leaves the others as
they were.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
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


@dataclass(frozen=True)
class Hidden:
    """What was drawn for one node and flight, pulse by pulse.

    Attributes
    ----------
    kept
        (pulse,) bool, the recorder fired.
    phase_rad, start_s, tag_error_s
        (pulse,) float64: carrier phase, start of capture less start of pulse, time tag less truth.
    blocked
        (pulse,) bool, sidelink shadowed.
    position_error_m
        (pulse, 3) float64, logged less true position, ECEF.
    """

    kept: NDArray[np.bool_]
    phase_rad: Floats
    start_s: Floats
    tag_error_s: Floats
    blocked: NDArray[np.bool_]
    position_error_m: Floats


def draw(impairments: Impairments, time_s: Floats, sample_rate_hz: float, generator: Generator) -> Hidden:
    """Draw what is random about a node in one flight.

    Parameters
    ----------
    impairments
        The switches.
    time_s
        (pulse,) float64, times of the pulses.
    sample_rate_hz
        For trigger jitter.
    generator
        Advanced by the same amount whatever is switched on.

    Examples
    --------
    >>> drawn = draw(Impairments(carrier_phase=UniformPhase()), np.arange(5.0), 1e9, np.random.default_rng(1))
    >>> drawn.phase_rad.round(2), drawn.start_s
    (array([...]), array([0., 0., 0., 0., 0.]))
    """
    streams = independent_streams(generator, 6)
    pulses = time_s.size
    return Hidden(
        kept=streams[0].random(pulses) >= impairments.missed_fraction,
        phase_rad=_phases(impairments, time_s, streams[1]),
        start_s=_starts(impairments.timing, pulses, sample_rate_hz, streams[2]),
        tag_error_s=impairments.time_tag.offset_s
        + impairments.time_tag.drift_ppm * 1e-6 * time_s
        + impairments.time_tag.jitter_s * streams[3].standard_normal(pulses),
        blocked=_bursts(impairments.sidelink_blockage, pulses, streams[4]),
        position_error_m=_position_error(impairments.localization, time_s, streams[5]),
    )


def independent_streams(generator: Generator, count: int) -> list[Generator]:
    """Return `count` generators that depend on nothing but the state of `generator`, which moves on."""
    root = SeedSequence([int(word) for word in generator.integers(0, 2**32, 4)])
    return [default_rng(seed) for seed in root.spawn(count)]


def _phases(impairments: Impairments, time_s: Floats, generator: Generator) -> Floats:
    phase = np.zeros(time_s.size)
    match impairments.carrier_phase:
        case UniformPhase(half_width_rad=width):
            phase = generator.uniform(-width, width, time_s.size)
        case PhaseWalk(rad_per_root_s=rate):
            steps = np.sqrt(np.diff(time_s, prepend=time_s[:1]))
            phase = np.cumsum(rate * steps * generator.standard_normal(time_s.size))
    if impairments.clock.continuous_phase:
        phase = phase - 2 * np.pi * impairments.clock.cfo_hz * time_s
    return np.asarray(phase)


def _starts(timing: Timing, pulses: int, sample_rate_hz: float, generator: Generator) -> Floats:
    uniform = generator.uniform(-1.0, 1.0, pulses) * timing.half_width_s
    late = np.rint(generator.standard_normal(pulses) * timing.jitter_samples) / sample_rate_hz
    return np.asarray(timing.offset_s + uniform + late)


def _bursts(blockage: Blockage | None, pulses: int, generator: Generator) -> NDArray[np.bool_]:
    blocked = np.zeros(pulses, np.bool_)
    if blockage is None:
        return blocked
    leave = 1 / blockage.mean_pulses
    enter = leave * blockage.fraction / (1 - blockage.fraction)
    state = False
    for pulse, chance in enumerate(generator.random(pulses)):
        limit = blockage.fraction if pulse == 0 else (1 - leave if state else enter)
        state = bool(chance < limit)
        blocked[pulse] = state
    return blocked


def _position_error(localization: Localization | None, time_s: Floats, generator: Generator) -> Floats:
    if localization is None:
        return np.zeros((time_s.size, 3))
    step_s = np.median(np.diff(time_s)) if time_s.size > 1 else localization.window_s
    length = max(1, round(localization.window_s / float(step_s)))
    white = generator.standard_normal((time_s.size + length - 1, 3)) * localization.sigma_m * np.sqrt(length)
    kernel = np.full(length, 1 / length)
    return np.column_stack([np.convolve(axis, kernel, "valid") for axis in white.T])
