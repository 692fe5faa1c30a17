"""A recorder that never stops: preamble, payload and symbol of every pulse in one stream, noise between them."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.errors import CampaignError
from apertura.simulation.frame import Framing
from apertura.simulation.hidden import independent_streams
from apertura.simulation.impairments import Adc
from apertura.simulation.radar import Floats
from apertura.simulation.recording import digitize, full_scale
from apertura.simulation.synthesis import Channel, Complex, noise, samples, sampling_rate

_SAMPLES_AT_ONCE = 2**18


def recording_start_s(channel: Channel) -> float:
    """Return when the recorder is switched on: half a repetition interval before the first pulse, whole samples.

    The node's timing error at its first pulse shifts the whole recording.
    """
    rate = channel.waveform.sample_rate_hz
    return -round(0.5 * rate / channel.waveform.prf_hz) / rate + float(channel.start_s[0])


def pulse_samples(channel: Channel, time_s: Floats) -> Floats:
    """Return (pulse,) float64, where in the recording each pulse starts, in samples of the node's own clock."""
    return np.asarray((time_s - recording_start_s(channel)) * sampling_rate(channel))


def continuous_blocks(
    channels: Mapping[str, Channel],
    time_s: Floats,
    adc: Adc,
    generator: Generator,
    *,
    framing: Framing | None = None,
    first_frame: int = 0,
) -> Iterator[NDArray[np.int16]]:
    """Yield (sample, channel, 2) int16 counts of a whole flight, a bounded number of samples at a time.

    Parameters
    ----------
    channels
        Of one node; their `start_s` matters at the first pulse only.
    time_s
        (pulse,) float64, times of the pulses.
    adc
        Converter; its full scale is set as for captures.
    generator
        Draws the noise.
    framing
        What goes before each symbol; None: nothing.
    first_frame
        Number of the first pulse.

    Raises
    ------
    CampaignError
        If frames overlap.

    Notes
    -----
    Source: docs/theory/simulate.md, eq. 6. The local oscillator runs through: no phase begins anew at a pulse.
    """
    some = next(iter(channels.values()))
    regions = _regions(channels, time_s, framing)
    total = int(np.ceil(pulse_samples(some, time_s[-1:])[0] + 0.5 * sampling_rate(some) / some.waveform.prf_hz))
    scales = {name: full_scale(channel, adc) for name, channel in channels.items()}
    streams = dict(zip(channels, independent_streams(generator, len(channels)), strict=True))
    done = 0
    for pulse, (start, stop) in enumerate([*regions, (total, total)]):
        pieces = [(begin, min(begin + _SAMPLES_AT_ONCE, start)) for begin in range(done, start, _SAMPLES_AT_ONCE)]
        for begin, end in [*pieces, (start, stop)]:
            counts = []
            for name, channel in channels.items():
                block = noise(streams[name], (end - begin,), channel.noise_variance)
                if pulse < len(regions) and begin == start:
                    block += _frame(channel, pulse, (start, stop), float(time_s[pulse]), framing, first_frame)
                counts.append(digitize(block, adc, scales[name]))
            yield np.stack(counts, axis=1)
        done = stop


def _regions(channels: Mapping[str, Channel], time_s: Floats, framing: Framing | None) -> list[tuple[int, int]]:
    """Return the samples from the start of each preamble to the end of its last echo."""
    some = next(iter(channels.values()))
    rate = sampling_rate(some)
    place = pulse_samples(some, time_s)
    lead = (framing.lead_samples if framing else 0) / some.waveform.sample_rate_hz
    longest = max(float(channel.paths.delay_s.max(initial=0.0)) for channel in channels.values())
    starts = np.floor(place - lead * rate).astype(int)
    stops = np.ceil(place + (some.waveform.duration_s + longest) * rate).astype(int) + 1
    if starts[0] < 0 or (starts[1:] < stops[:-1]).any():
        raise CampaignError(
            f"a frame of {stops[0] - starts[0]} samples at {some.waveform.prf_hz} Hz",
            where="simulate",
            expected="frames shorter than half a repetition interval",
            remedy="Lower prf_hz or shorten preamble, payload or symbol.",
        )
    return [(int(start), int(stop)) for start, stop in zip(starts, stops, strict=True)]


def _frame(
    channel: Channel, pulse: int, region: tuple[int, int], time_s: float, framing: Framing | None, first_frame: int
) -> Complex:
    """One frame without noise, on the recording's own samples."""
    start, stop = region
    rate, waveform = sampling_rate(channel), channel.waveform
    start_s = start / rate + recording_start_s(channel) - time_s
    # `samples` lets the oscillator begin at each capture; here it began with the recording
    turn = -2 * np.pi * (waveform.carrier_hz * start_s + channel.cfo_hz * start / rate)
    starts, phases = np.full_like(channel.start_s, start_s), channel.phase_rad + turn
    one = replace(channel, start_s=starts, phase_rad=phases, noise_variance=0.0)
    frame = samples(one, None, slice(pulse, pulse + 1), count=stop - start)[0]
    if framing:
        index = np.arange(stop - start)
        arrived = index / rate + start_s - channel.paths.delay_s[pulse][:, None]
        sent = framing.signal(waveform, first_frame + pulse, arrived)
        carried = channel.paths.amplitude[pulse] * np.exp(
            -2j * np.pi * waveform.carrier_hz * channel.paths.delay_s[pulse]
        )
        spin = channel.phase_rad[pulse] - 2 * np.pi * channel.cfo_hz * (start + index) / rate
        frame += (carried @ sent) * np.exp(1j * spin)
    return np.asarray(frame)
