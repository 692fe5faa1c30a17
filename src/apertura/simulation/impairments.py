"""Impairments of a node, and their random draws in a flight.

Each random impairment has its own stream of random numbers, so that enabling one does not change the others.
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
"""Pydantic configuration of all parts of a specification: unknown keys are errors."""
RadarPoint = Literal["radar_tx", "radar_rx"]
AntennaPoint = Literal["radar_tx", "radar_rx", "sidelink"]
ChannelName = Literal["radar", "sidelink"]


@dataclass(frozen=True, config=STRICT_KEYS)
class Clock:
    """Clock offset of the receiver from the transmitter; docs/theory/simulate.md, eq. 3.

    The received signal is shifted by −cfo_hz at baseband, and the sampling rate is too high by sfo_hz.
    """

    cfo_hz: float = Field(default=0.0, description="local oscillator minus its nominal frequency, Hz")
    sfo_hz: float = Field(default=0.0, description="sampling rate minus its nominal value, Hz")
    continuous_phase: bool = Field(
        default=False,
        description="the oscillator runs continuously (-2π·cfo·t) instead of restarting at each trigger",
    )

    @classmethod
    def of_ppm(cls, ppm: float, *, carrier_hz: float, sample_rate_hz: float) -> "Clock":
        """Return the offset of a clock that drives both oscillator and converter and is fast by `ppm`.

        Examples
        --------
        >>> Clock.of_ppm(8, carrier_hz=1.25e9, sample_rate_hz=1e9)
        Clock(cfo_hz=10000.0, sfo_hz=8000.0, continuous_phase=False)
        """
        return cls(ppm * carrier_hz / 1e6, ppm * sample_rate_hz / 1e6)


@dataclass(frozen=True, config=STRICT_KEYS)
class UniformPhase:
    """Uniformly distributed carrier phase per pulse."""

    half_width_rad: float = Field(default=np.pi, ge=0, description="half width, rad; π: completely random")
    kind: Literal["uniform"] = Field(default="uniform", kw_only=True, repr=False)


@dataclass(frozen=True, config=STRICT_KEYS)
class PhaseWalk:
    """Random walk of the carrier phase, as of free-running oscillators."""

    rad_per_root_s: float = Field(ge=0, description="square root of the variance growth in rad²/s")
    kind: Literal["walk"] = Field(default="walk", kw_only=True, repr=False)


@dataclass(frozen=True, config=STRICT_KEYS)
class Timing:
    """Timing error: start of the capture minus start of the pulse."""

    offset_s: float = Field(default=0.0, description="constant part, s")
    half_width_s: float = Field(default=0.0, ge=0, description="half width of a uniform part per pulse, s")
    jitter_samples: float = Field(
        default=0.0, ge=0, description="standard deviation of the trigger delay, rounded to whole samples"
    )


@dataclass(frozen=True, config=STRICT_KEYS)
class TimeTag:
    """Error of the node's UTC tags."""

    offset_s: float = Field(default=0.0, description="constant part, s")
    drift_ppm: float = Field(default=0.0, description="drift, microseconds per second")
    jitter_s: float = Field(default=0.0, ge=0, description="standard deviation per pulse, s")


@dataclass(frozen=True, config=STRICT_KEYS)
class Reflection:
    """Reflection in the sidelink."""

    excess_m: float = Field(description="path length in excess of the direct path, m")
    amplitude: complex = Field(description="relative to the direct path")


@dataclass(frozen=True, config=STRICT_KEYS)
class Blockage:
    """Shadowing of the sidelink in bursts.

    Notes
    -----
    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39 (1960): two-state Markov chain.
    """

    fraction: float = Field(ge=0, lt=1, description="fraction of shadowed pulses")
    mean_pulses: float = Field(default=10.0, ge=1, description="mean length of a burst, pulses")
    attenuation_db: float = Field(default=60.0, ge=0, description="loss while shadowed, dB")


@dataclass(frozen=True, config=STRICT_KEYS)
class Spikes:
    """Disturbance of the sidelink in single pulses, as of a blade or the airframe in the line of sight."""

    fraction: float = Field(ge=0, lt=1, description="share of disturbed pulses")
    phase_rad: float = Field(default=0.0, description="phase of the direct path in these pulses, either sign, rad")
    level_db: float | None = Field(
        default=None, description="reflection of random phase in these pulses, dB to the direct path; null: none"
    )
    excess_m: float = Field(default=0.1, description="path of the reflection in excess of the direct path, m")


@dataclass(frozen=True, config=STRICT_KEYS)
class Rotor:
    """Reflection of the sidelink from moving blades, with a constant Doppler frequency."""

    frequency_hz: float = Field(description="Doppler frequency of the reflection, Hz; may exceed the pulse rate")
    level_db: float = Field(description="level relative to the direct path, dB")
    excess_m: float = Field(default=0.1, description="path length in excess of the direct path, m")


@dataclass(frozen=True, config=STRICT_KEYS)
class Leakage:
    """Direct coupling between the radar antennas."""

    level_db: float = Field(description="level relative to the RMS echo spectrum, dB")
    path_m: float = Field(default=0.0, description="electrical path in excess of the antennas' distance, m")


@dataclass(frozen=True, config=STRICT_KEYS)
class Interferer:
    """Signal of another transmitter in a receiving channel; docs/theory/simulate.md, "Interference"."""

    frequency_hz: float = Field(gt=0, description="RF centre frequency, Hz")
    level_db: float = Field(description="power during transmission relative to the mean power of the echoes, dB")
    bandwidth_hz: float = Field(default=0.0, ge=0, description="bandwidth of Gaussian noise, Hz; 0: a sine")
    duration_s: float | None = Field(default=None, gt=0, description="duration of a pulse, s; null: continuous")
    rate_hz: float = Field(default=0.0, ge=0, description="mean number of pulses per second, at random times")
    envelope: Literal["rectangular", "hann"] = Field(default="rectangular", description="envelope of a pulse")
    sweep_hz_per_s: float = Field(default=0.0, description="frequency rate during a pulse, Hz/s")
    channel: ChannelName = Field(default="radar", description="channel that receives it")


@dataclass(frozen=True, config=STRICT_KEYS)
class Ripple:
    """Ripple due to an internal reflection: response 1 + ρ·exp(-j2πf·delay).

    Examples
    --------
    >>> response = Ripple(1.0, 50e-9).response(1e9 + 1e5 * np.arange(4000))
    >>> level_db = 20 * np.log10(abs(response))
    >>> float((level_db.max() - level_db.min()).round(3))
    1.0
    """

    peak_to_peak_db: float = Field(description="peak-to-peak ripple across the band, dB")
    delay_s: float = Field(description="delay of the reflection, s")

    def response(self, frequency_hz: Floats) -> NDArray[np.complex128]:
        """Return the frequency response at RF frequencies, (subcarrier,) complex128."""
        ratio = 10 ** (self.peak_to_peak_db / 20)
        reflected = (ratio - 1) / (ratio + 1)
        return np.asarray(1 + reflected * np.exp(-2j * np.pi * frequency_hz * self.delay_s))


@dataclass(frozen=True, config=STRICT_KEYS)
class Adc:
    """Analogue-to-digital converter."""

    bits: int = Field(default=14, ge=1, le=16, description="bits of I and of Q")
    backoff_db: float = Field(default=14.0, description="full scale relative to the RMS of I and of Q, dB")


@dataclass(frozen=True, config=STRICT_KEYS)
class Radio:
    """Power, gains and receiver of a node in physical units; docs/theory/simulate.md, "Radio"."""

    transmit_power_dbm: float = Field(description="mean power during transmission at the antenna port, dBm")
    transmit_gain_dbi: float = Field(description="boresight gain of the transmitting radar antenna, dBi")
    receive_gain_dbi: float = Field(description="boresight gain of the receiving radar antenna, dBi")
    full_scale_dbm: float = Field(description="power at the converter of a complex sine at full scale, dBm")
    gain_db: float = Field(description="gain from the port of the receiving antenna to the converter, dB")
    noise_figure_db: float | None = Field(
        default=None, ge=0, description="noise figure of the receiver, dB; null: no noise"
    )
    amplitude_std_db: float | None = Field(
        default=None, ge=0, description="configured standard deviation of all these values, dB; null: not configured"
    )


@dataclass(frozen=True, config=STRICT_KEYS)
class Localization:
    """Localization error, logged minus true position: white noise after a moving average."""

    sigma_m: float = Field(ge=0, description="standard deviation per axis after the moving average, m")
    window_s: float = Field(default=1.0, gt=0, description="length of the moving average, s")
    points: tuple[AntennaPoint, ...] = Field(
        default=("radar_tx", "radar_rx", "sidelink"), description="antennas whose positions have this error"
    )


@dataclass(frozen=True, config=STRICT_KEYS)
class Impairments:
    """Impairments of a node; by default none, with a 14-bit converter.

    SNR is per subcarrier: mean power of the unimpaired echoes (or of the direct path at gain 1) over pulses and
    subcarriers, relative to the noise of one DFT bin. Other signals in the channel do not change the noise.
    """

    clock: Clock = Field(default=Clock(), description="clock offset")
    carrier_phase: Annotated[UniformPhase | PhaseWalk, Field(discriminator="kind")] | None = Field(
        default=None, description="carrier phase per pulse: uniform or walk; null: coherent"
    )
    timing: Timing = Field(default=Timing(), description="error of the start of each capture")
    missed_fraction: float = Field(default=0.0, ge=0, lt=1, description="fraction of the pulses without a capture")
    time_tag: TimeTag = Field(default=TimeTag(), description="error of the UTC tags")
    radar_snr_db: float | None = Field(default=None, description="SNR of the radar channel, dB; null: no noise")
    sidelink_snr_db: float | None = Field(default=None, description="SNR of the sidelink, dB; null: no noise")
    sidelink_gain_db: float = Field(default=0.0, description="gain of the direct path, dB")
    sidelink_multipath: tuple[Reflection, ...] = Field(default=(), description="reflections of the sidelink")
    sidelink_blockage: Blockage | None = Field(default=None, description="shadowing of the sidelink")
    sidelink_spikes: Spikes | None = Field(default=None, description="disturbance of the sidelink in single pulses")
    sidelink_rotor: Rotor | None = Field(default=None, description="reflection of the sidelink from moving blades")
    leakage: Leakage | None = Field(default=None, description="direct coupling into the radar channel")
    interference: tuple[Interferer, ...] = Field(default=(), description="signals of other transmitters")
    transmit_ripple: Ripple | None = Field(default=None, description="ripple of the transmitter")
    radar_ripple: Ripple | None = Field(default=None, description="ripple of the radar receiver")
    sidelink_ripple: Ripple | None = Field(default=None, description="ripple of the sidelink receiver")
    adc: Adc = Field(default=Adc(), description="converter")
    localization: Localization | None = Field(default=None, description="error of the logged positions")
    doppler: bool = Field(default=False, description="motion within the pulse; off: stop and go")


@plain_dataclass(frozen=True)
class ImpairmentDraw:
    """Impairments drawn for one node and flight, pulse by pulse.

    Attributes
    ----------
    kept
        (pulse,) bool, True if the recorder was triggered.
    phase_rad, start_s, tag_error_s
        (pulse,) float64: carrier phase, start of capture minus start of pulse, time tag minus true time.
    blocked
        (pulse,) bool, True if the sidelink is shadowed.
    position_error_m
        (pulse, 3) float64, logged minus true position, ECEF.
    direct, spike_echo, rotor_echo
        (pulse,) complex128, direct path of the sidelink and its additional reflections at mid-band, relative to the
        undisturbed direct path.
    """

    kept: NDArray[np.bool_]
    phase_rad: Floats
    start_s: Floats
    tag_error_s: Floats
    blocked: NDArray[np.bool_]
    position_error_m: Floats
    direct: NDArray[np.complex128]
    spike_echo: NDArray[np.complex128]
    rotor_echo: NDArray[np.complex128]

    @property
    def sidelink_error_rad(self) -> Floats:
        """(pulse,) float64, phase error of the sidelink at mid-band that echoes do not have, unresolved in delay."""
        return np.asarray(np.angle(self.direct + self.spike_echo + self.rotor_echo))


def draw_impairments(
    impairments: Impairments, time_s: Floats, sample_rate_hz: float, generator: Generator
) -> ImpairmentDraw:
    """Draw the random impairments of a node at (pulse,) times; the generator advances equally for any impairments.

    Examples
    --------
    >>> impairments = Impairments(carrier_phase=UniformPhase())
    >>> drawn = draw_impairments(impairments, np.arange(5.0), 1e9, np.random.default_rng(1))
    >>> drawn.phase_rad.round(2), drawn.start_s
    (array([...]), array([0., 0., 0., 0., 0.]))
    """
    streams = independent_streams(generator, 8)
    pulses = time_s.size
    direct, spike_echo = _spikes(impairments.sidelink_spikes, pulses, streams[6])
    return ImpairmentDraw(
        kept=streams[0].random(pulses) >= impairments.missed_fraction,
        phase_rad=_phases(impairments, time_s, streams[1]),
        start_s=_starts(impairments.timing, pulses, sample_rate_hz, streams[2]),
        tag_error_s=impairments.time_tag.offset_s
        + impairments.time_tag.drift_ppm * 1e-6 * time_s
        + impairments.time_tag.jitter_s * streams[3].standard_normal(pulses),
        blocked=_bursts(impairments.sidelink_blockage, pulses, streams[4]),
        position_error_m=_position_error(impairments.localization, time_s, streams[5]),
        direct=direct,
        spike_echo=spike_echo,
        rotor_echo=_rotor_echo(impairments.sidelink_rotor, time_s, streams[7]),
    )


def independent_streams(generator: Generator, count: int) -> list[Generator]:
    """Return `count` generators that depend only on the state of `generator`, which is advanced."""
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
    jitter = np.rint(generator.standard_normal(pulses) * timing.jitter_samples) / sample_rate_hz
    return np.asarray(timing.offset_s + uniform + jitter)


def _bursts(blockage: Blockage | None, pulses: int, generator: Generator) -> NDArray[np.bool_]:
    blocked = np.zeros(pulses, np.bool_)
    if blockage is None:
        return blocked
    leave = 1 / blockage.mean_pulses
    enter = leave * blockage.fraction / (1 - blockage.fraction)
    state = False
    for pulse, draw in enumerate(generator.random(pulses)):
        probability = blockage.fraction if pulse == 0 else (1 - leave if state else enter)
        state = bool(draw < probability)
        blocked[pulse] = state
    return blocked


def _spikes(
    spikes: Spikes | None, pulses: int, generator: Generator
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return direct path and reflection of each pulse, relative to the undisturbed direct path."""
    direct, echo = np.ones(pulses, np.complex128), np.zeros(pulses, np.complex128)
    if spikes is not None:
        hit = generator.random(pulses) < spikes.fraction
        sign, phase = generator.choice([-1.0, 1.0], pulses), generator.uniform(-np.pi, np.pi, pulses)
        direct[hit] = np.exp(1j * spikes.phase_rad * sign[hit])
        if spikes.level_db is not None:
            echo[hit] = 10 ** (spikes.level_db / 20) * np.exp(1j * phase[hit])
    return direct, echo


def _rotor_echo(rotor: Rotor | None, time_s: Floats, generator: Generator) -> NDArray[np.complex128]:
    if rotor is None:
        return np.zeros(time_s.size, np.complex128)
    phase = 2 * np.pi * rotor.frequency_hz * time_s + generator.uniform(-np.pi, np.pi)
    return np.asarray(10 ** (rotor.level_db / 20) * np.exp(1j * phase))


def _position_error(localization: Localization | None, time_s: Floats, generator: Generator) -> Floats:
    if localization is None:
        return np.zeros((time_s.size, 3))
    step_s = np.median(np.diff(time_s)) if time_s.size > 1 else localization.window_s
    length = max(1, round(localization.window_s / float(step_s)))
    white = generator.standard_normal((time_s.size + length - 1, 3)) * localization.sigma_m * np.sqrt(length)
    kernel = np.full(length, 1 / length)
    return np.column_stack([np.convolve(axis, kernel, "valid") for axis in white.T])
