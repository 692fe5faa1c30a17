"""Continuous recordings: frames of preamble, payload and symbol in one stream, with noise between them.

Frame: preamble chips | counter bits | inverted counter bits | guard | cyclic prefix, symbol
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError
from apertura.simulation.impairments import STRICT_KEYS, Adc, independent_streams
from apertura.simulation.synthesis import Channel, Complex, digitize, full_scale, noise, samples, sampling_rate
from apertura.simulation.waveform import TransmitWaveform

Chips = NDArray[np.int8]


@dataclass(frozen=True, config=STRICT_KEYS)
class Framing:
    """Framing in front of the symbol, on the centre subcarrier: a PN preamble and a payload with the frame number.

    Examples
    --------
    >>> framing = Framing(register_bits=3, chip_samples=2, counter_bits=2, bit_chips=3)
    >>> framing.preamble()
    array([ 1,  1,  1, -1,  1, -1, -1], dtype=int8)
    >>> framing.payload(6)  # counter 2: bits 1 0, inverted 0 1
    array([ 1,  1,  1, -1, -1, -1, -1, -1, -1,  1,  1,  1], dtype=int8)
    """

    register_bits: int = Field(
        default=10, ge=2, le=20, description="length k of the shift register: 2^k - 1 chips of preamble"
    )
    chip_samples: int = Field(default=4, ge=1, description="samples per chip; the chip rate must fit the band")
    counter_bits: int = Field(default=16, ge=1, description="width of the frame counter; it wraps at 2^counter_bits")
    bit_chips: int = Field(default=15, ge=1, description="chips per payload bit, all of one sign: +1 for a one")
    guard_samples: int = Field(default=256, ge=0, description="pause before the prefix, longer than the longest echo")
    level_db: float = Field(default=0.0, description="power relative to the mean power of the symbol, dB")

    def preamble(self) -> Chips:
        """Return the preamble, a maximum-length sequence, (chip,) int8 of ±1."""
        from scipy.signal import max_len_seq  # slow to import, and rarely needed

        return np.asarray(2 * max_len_seq(self.register_bits)[0].astype(np.int8) - 1)

    def counted(self, frame: int) -> int:
        """Return the counter value of frame `frame`."""
        return int(frame % 2**self.counter_bits)

    def payload(self, frame: int) -> Chips:
        """Return the payload, (chip,) int8 of ±1: the counter, most significant bit first, then its complement."""
        number = self.counted(frame)
        bits = np.array([(number >> bit) & 1 for bit in reversed(range(self.counter_bits))], np.int8)
        return np.repeat(2 * np.concatenate([bits, 1 - bits]) - 1, self.bit_chips)

    @property
    def lead_samples(self) -> int:
        """Number of samples from the start of the preamble to the start of the cyclic prefix."""
        chips = 2**self.register_bits - 1 + 2 * self.counter_bits * self.bit_chips
        return int(chips * self.chip_samples + self.guard_samples)

    def centre_hz(self, waveform: TransmitWaveform) -> float:
        """Return the baseband frequency of the carrier of the chips, the centre subcarrier."""
        return float(waveform.baseband_hz[waveform.subcarriers // 2])

    def signal(self, waveform: TransmitWaveform, frame: int, time_s: Floats) -> NDArray[np.complex128]:
        """Return preamble and payload of a frame at baseband, at (...,) seconds from the start of the prefix."""
        chips = np.concatenate([self.preamble(), self.payload(frame)])
        rate = waveform.sample_rate_hz
        # 1e-6 samples: tolerance for rounding at the edge of a chip
        index = np.floor((time_s * rate + self.lead_samples + 1e-6) / self.chip_samples).astype(int)
        inside = (index >= 0) & (index < len(chips))
        level = np.sqrt((np.abs(waveform.codes_at(0)) ** 2).sum()) * 10 ** (self.level_db / 20)
        modulation = np.where(inside, chips[np.clip(index, 0, len(chips) - 1)], 0)
        return np.asarray(level * modulation * np.exp(2j * np.pi * self.centre_hz(waveform) * time_s))


def recording_start_s(channel: Channel) -> float:
    """Return the start of the recording: half a repetition interval before the first pulse, in whole samples, seconds.

    The node's timing error at its first pulse applies to the whole recording.
    """
    rate = channel.waveform.sample_rate_hz
    return -round(0.5 * rate / channel.waveform.prf_hz) / rate + float(channel.start_s[0])


def pulse_samples(channel: Channel, time_s: Floats) -> Floats:
    """Return the start of each pulse in the recording, (pulse,) float64, in samples of the node's own clock."""
    return np.asarray((time_s - recording_start_s(channel)) * sampling_rate(channel))


def continuous_blocks(
    channels: Mapping[str, Channel],
    time_s: Floats,
    adc: Adc,
    generator: Generator,
    *,
    framing: Framing | None = None,
    first_frame: int = 0,
    block_samples: int = 2**18,
) -> Iterator[NDArray[np.int16]]:
    """Yield the counts of a whole flight, (sample, channel, 2) int16, in blocks of bounded size.

    Parameters
    ----------
    channels
        Channels of one node; only the first value of their `start_s` is used.
    time_s
        (pulse,) float64, times of the pulses.
    framing, first_frame
        Framing in front of each symbol, and the first frame number; None: no framing.
    block_samples
        Block size of the noise between frames, samples.

    Raises
    ------
    CampaignError
        If frames overlap, or a channel has interference.

    Notes
    -----
    Source: docs/theory/simulate.md, eq. 6. The local oscillator runs continuously, without a new phase at each pulse.
    """
    first = next(iter(channels.values()))
    if any(channel.interference for channel in channels.values()):
        raise CampaignError(
            "interference in a continuous recording",
            where="simulate: impairments.interference",
            expected="interference only in recordings of single captures",
            remedy="Remove it, or simulate captures.",
        )
    regions = _regions(channels, time_s, framing)
    total = int(np.ceil(pulse_samples(first, time_s[-1:])[0] + 0.5 * sampling_rate(first) / first.waveform.prf_hz))
    scales = {name: full_scale(channel, adc) for name, channel in channels.items()}
    streams = dict(zip(channels, independent_streams(generator, len(channels)), strict=True))
    written = 0
    for pulse, (start, stop) in enumerate([*regions, (total, total)]):
        gaps = [(low, min(low + block_samples, start)) for low in range(written, start, block_samples)]
        for low, high in [*gaps, (start, stop)]:
            counts = []
            for name, channel in channels.items():
                block = noise(streams[name], (high - low,), channel.noise_variance)
                if pulse < len(regions) and low == start:
                    block += _frame(channel, pulse, (start, stop), float(time_s[pulse]), framing, first_frame)
                counts.append(digitize(block, adc, scales[name]))
            yield np.stack(counts, axis=1)
        written = stop


def _regions(channels: Mapping[str, Channel], time_s: Floats, framing: Framing | None) -> list[tuple[int, int]]:
    """Return the first and last sample of each frame, from the start of its preamble to the end of its last echo."""
    first = next(iter(channels.values()))
    rate = sampling_rate(first)
    pulse_start = pulse_samples(first, time_s)
    lead = (framing.lead_samples if framing else 0) / first.waveform.sample_rate_hz
    longest = max(float(channel.paths.delay_s.max(initial=0.0)) for channel in channels.values())
    starts = np.floor(pulse_start - lead * rate).astype(int)
    stops = np.ceil(pulse_start + (first.waveform.duration_s + longest) * rate).astype(int) + 1
    if starts[0] < 0 or (starts[1:] < stops[:-1]).any():
        raise CampaignError(
            f"a frame of {stops[0] - starts[0]} samples at a pulse repetition frequency of {first.waveform.prf_hz} Hz",
            where="simulate",
            expected="frames shorter than half a repetition interval",
            remedy="Reduce prf_hz, or shorten preamble, payload or symbol.",
        )
    return [(int(start), int(stop)) for start, stop in zip(starts, stops, strict=True)]


def _frame(
    channel: Channel, pulse: int, region: tuple[int, int], time_s: float, framing: Framing | None, first_frame: int
) -> Complex:
    """Return a frame without noise, at the sampling instants of the recording."""
    start, stop = region
    rate, waveform = sampling_rate(channel), channel.waveform
    start_s = start / rate + recording_start_s(channel) - time_s
    # `samples` restarts the oscillator at each capture; here, the oscillator started with the recording
    offset_rad = -2 * np.pi * (waveform.carrier_hz * start_s + channel.cfo_hz * start / rate)
    starts, phases = np.full_like(channel.start_s, start_s), channel.phase_rad + offset_rad
    noiseless = replace(channel, start_s=starts, phase_rad=phases, noise_variance=0.0)
    frame = samples(noiseless, None, slice(pulse, pulse + 1), count=stop - start)[0]
    if framing:
        index = np.arange(stop - start)
        emission_s = index / rate + start_s - channel.paths.delay_s[pulse][:, None]
        sent = framing.signal(waveform, first_frame + pulse, emission_s)
        weights = channel.paths.amplitude[pulse] * np.exp(
            -2j * np.pi * waveform.carrier_hz * channel.paths.delay_s[pulse]
        )
        phase_rad = channel.phase_rad[pulse] - 2 * np.pi * channel.cfo_hz * (start + index) / rate
        frame += (weights @ sent) * np.exp(1j * phase_rad)
    return np.asarray(frame)
