"""Impairments of a node, and their draws in one flight.

Every random impairment has its own stream of random numbers, so that switching one on leaves the others as
they were.
"""

from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from apertura.common.arrays import Floats

STRICT_KEYS = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Of everything that a specification may hold: unknown keys are errors."""
RadarPoint = Literal["radar_tx", "radar_rx"]
AntennaPoint = Literal["radar_tx", "radar_rx", "sidelink"]
ChannelName = Literal["radar", "sidelink"]


@dataclass(frozen=True, config=STRICT_KEYS)
class Clock:
    """The receiver's clock against the transmitter's; docs/theory/simulate.md, eq. 3.

    The received signal turns by −cfo_hz at baseband and is sampled sfo_hz too often.
    """

    cfo_hz: float = Field(default=0.0, description="local oscillator less its nominal frequency, Hz")
    sfo_hz: float = Field(default=0.0, description="sampling rate less its nominal value, Hz")
    continuous_phase: bool = Field(
        default=False,
        description="the oscillator runs on from pulse to pulse (-2π·cfo·t) instead of restarting at each trigger",
    )

    @classmethod
    def of_ppm(cls, ppm: float, *, carrier_hz: float, sample_rate_hz: float) -> "Clock":
        """Return one clock that feeds both, fast by `ppm`.

        Examples
        --------
        >>> Clock.of_ppm(8, carrier_hz=1.25e9, sample_rate_hz=1e9)
        Clock(cfo_hz=10000.0, sfo_hz=8000.0, continuous_phase=False)
        """
        return cls(ppm * carrier_hz / 1e6, ppm * sample_rate_hz / 1e6)


@dataclass(frozen=True, config=STRICT_KEYS)
class UniformPhase:
    """Carrier phase per pulse, uniform in ± a width."""

    half_width_rad: float = Field(default=np.pi, ge=0, description="half width, rad; π: unknown altogether")
    kind: Literal["uniform"] = Field(default="uniform", kw_only=True, repr=False)


@dataclass(frozen=True, config=STRICT_KEYS)
class PhaseWalk:
    """Carrier phase as a random walk: free-running oscillators."""

    rad_per_root_s: float = Field(ge=0, description="root of the variance's growth in rad²/s")
    kind: Literal["walk"] = Field(default="walk", kw_only=True, repr=False)


@dataclass(frozen=True, config=STRICT_KEYS)
class Timing:
    """Start of the capture less start of the pulse."""

    offset_s: float = Field(default=0.0, description="constant, s")
    half_width_s: float = Field(default=0.0, ge=0, description="uniform in ± this per pulse, s")
    jitter_samples: float = Field(default=0.0, ge=0, description="standard deviation of whole samples of trigger delay")


@dataclass(frozen=True, config=STRICT_KEYS)
class TimeTag:
    """Error of the node's UTC tags."""

    offset_s: float = Field(default=0.0, description="constant, s")
    drift_ppm: float = Field(default=0.0, description="growing, microseconds per second")
    jitter_s: float = Field(default=0.0, ge=0, description="standard deviation per pulse, s")


@dataclass(frozen=True, config=STRICT_KEYS)
class Reflection:
    """An extra sidelink path."""

    excess_m: float = Field(description="length beyond the direct path, m")
    amplitude: complex = Field(description="relative to the direct path")


@dataclass(frozen=True, config=STRICT_KEYS)
class Blockage:
    """Sidelink shadowed in bursts.

    Notes
    -----
    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39 (1960): two-state chain.
    """

    fraction: float = Field(ge=0, lt=1, description="share of the pulses")
    mean_pulses: float = Field(default=10.0, ge=1, description="mean length of a burst, pulses")
    attenuation_db: float = Field(default=60.0, ge=0, description="loss while shadowed, dB")


@dataclass(frozen=True, config=STRICT_KEYS)
class Leakage:
    """Direct coupling of the radar antennas."""

    level_db: float = Field(description="against the RMS echo spectrum, dB")
    path_m: float = Field(default=0.0, description="electrical path beyond the antennas' distance, m")


@dataclass(frozen=True, config=STRICT_KEYS)
class Ripple:
    """An internal reflection: response 1 + ρ·exp(-j2πf·delay).

    Examples
    --------
    >>> response = Ripple(1.0, 50e-9).response(1e9 + 1e5 * np.arange(4000))
    >>> level_db = 20 * np.log10(abs(response))
    >>> float((level_db.max() - level_db.min()).round(3))
    1.0
    """

    peak_to_peak_db: float = Field(description="across the band, dB")
    delay_s: float = Field(description="of the reflection, s")

    def response(self, frequency_hz: Floats) -> NDArray[np.complex128]:
        """Return (subcarrier,) complex128 at RF frequencies (subcarrier,) float64."""
        ratio = 10 ** (self.peak_to_peak_db / 20)
        reflected = (ratio - 1) / (ratio + 1)
        return np.asarray(1 + reflected * np.exp(-2j * np.pi * frequency_hz * self.delay_s))


@dataclass(frozen=True, config=STRICT_KEYS)
class Adc:
    """The converter."""

    bits: int = Field(default=14, ge=1, le=16, description="bits of I and of Q")
    backoff_db: float = Field(default=14.0, description="how far under full scale the RMS of I and of Q lies, dB")


@dataclass(frozen=True, config=STRICT_KEYS)
class Radio:
    """Power, gains and receiver of a node in physical units; docs/theory/simulate.md, "Radio"."""

    transmit_power_dbm: float = Field(description="mean power while it sends, at the antenna's port, dBm")
    transmit_gain_dbi: float = Field(description="of its transmitting radar antenna on boresight, dBi")
    receive_gain_dbi: float = Field(description="of its receiving radar antenna on boresight, dBi")
    full_scale_dbm: float = Field(description="power at the converter of a complex sine at full scale, dBm")
    gain_db: float = Field(description="from the receiving antenna's port to the converter, dB")
    noise_figure_db: float | None = Field(default=None, ge=0, description="of the receiver, dB; null: no noise")
    amplitude_std_db: float | None = Field(
        default=None, ge=0, description="what the config says of the error of all of these, dB; null: nothing"
    )


@dataclass(frozen=True, config=STRICT_KEYS)
class Localization:
    """Logged position less true position: white noise after a moving average."""

    sigma_m: float = Field(ge=0, description="standard deviation per axis after the moving average, m")
    window_s: float = Field(default=1.0, gt=0, description="length of the moving average, s")
    points: tuple[AntennaPoint, ...] = Field(
        default=("radar_tx", "radar_rx", "sidelink"), description="antennas that are elsewhere than the log says"
    )


@dataclass(frozen=True, config=STRICT_KEYS)
class Impairments:
    """Everything that is wrong with one node; the default is a perfect one with a 14-bit converter.

    SNR is per subcarrier: mean power of the unimpaired echoes (or of the direct path at gain 1) over pulses
    and subcarriers, against the noise of one DFT bin. What else reaches the channel does not change the noise.
    """

    clock: Clock = Field(default=Clock(), description="clock offset")
    carrier_phase: Annotated[UniformPhase | PhaseWalk, Field(discriminator="kind")] | None = Field(
        default=None, description="carrier phase per pulse: uniform or walk; null: coherent"
    )
    timing: Timing = Field(default=Timing(), description="start of each capture")
    missed_fraction: float = Field(default=0.0, ge=0, lt=1, description="share of the pulses without trigger")
    time_tag: TimeTag = Field(default=TimeTag(), description="error of the UTC tags")
    radar_snr_db: float | None = Field(default=None, description="SNR of the radar channel, dB; null: no noise")
    sidelink_snr_db: float | None = Field(default=None, description="SNR of the sidelink, dB; null: no noise")
    sidelink_gain_db: float = Field(default=0.0, description="gain of the direct path, dB")
    sidelink_multipath: tuple[Reflection, ...] = Field(default=(), description="reflections of the sidelink")
    sidelink_blockage: Blockage | None = Field(default=None, description="shadowing of the sidelink")
    leakage: Leakage | None = Field(default=None, description="direct coupling into the radar channel")
    transmit_ripple: Ripple | None = Field(default=None, description="of the transmitter")
    radar_ripple: Ripple | None = Field(default=None, description="of the radar receiver")
    sidelink_ripple: Ripple | None = Field(default=None, description="of the sidelink receiver")
    adc: Adc = Field(default=Adc(), description="converter")
    localization: Localization | None = Field(default=None, description="error of the logged positions")
    doppler: bool = Field(default=False, description="motion within the pulse; off: stop and go")


@plain_dataclass(frozen=True)
class ImpairmentDraw:
    """Impairments drawn for one node and flight, pulse by pulse.

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


def draw_impairments(
    impairments: Impairments, time_s: Floats, sample_rate_hz: float, generator: Generator
) -> ImpairmentDraw:
    """Draw what is random about a node at (pulse,) times; the generator advances by as much whatever is on.

    Examples
    --------
    >>> wrong = Impairments(carrier_phase=UniformPhase())
    >>> drawn = draw_impairments(wrong, np.arange(5.0), 1e9, np.random.default_rng(1))
    >>> drawn.phase_rad.round(2), drawn.start_s
    (array([...]), array([0., 0., 0., 0., 0.]))
    """
    streams = independent_streams(generator, 6)
    pulses = time_s.size
    return ImpairmentDraw(
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
