"""Whether the headers of recordings fit the waveform and the pairs."""

from collections.abc import Iterator

import numpy as np

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.formats.recordings.recording import Recording
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import CONFIG, OfdmWaveform, SampledWaveform
from apertura.pipeline.opening.transmitted import check_mixing

_SAME = 1e-9
"""Carriers and rates that differ by less, relative to what the config states, are the same."""


def check_recordings(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield recordings that do not open, or were recorded at another carrier or sample rate than the waveform's."""
    yield from inspected.unopened
    waveform = inspected.waveform
    if waveform is None:
        return
    sent = inspected.sent
    for recording in inspected.recordings.values():
        keys = (("sample_rate_hz", "core:sample_rate"), ("carrier_hz", "core:frequency"))
        recorded = recording.sample_rate_hz, recording.frequency_hz
        for (key, name), value in zip(keys, recorded, strict=True):
            asked = float(getattr(waveform, key))
            if not abs(value - asked) <= _SAME * asked:
                yield CampaignError(
                    f"{name} {value:.6f}",
                    where=recording.files[0],
                    expected=f"{asked:.6f}, as {CONFIG}: waveform.{key}",
                    remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
                )
        try:
            if sent is not None:
                check_mixing(recording.samples, sent.numerology, where=recording.files[0])
        except CampaignError as problem:
            yield problem
        preamble = recording.framing["preamble"] if recording.framing else None
        if not preamble:
            continue
        path = inside(inspected.campaign.root, preamble, where=f"{recording.files[0]}: apertura:framing.preamble")
        if not path.is_file():
            yield CampaignError(
                "no such file",
                where=path,
                expected=f"the preamble that {recording.files[0].name}: apertura:framing names",
                remedy="Copy it there.",
            )


def check_channels(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield receivers without the channels they need, or with captures shorter than prefix and DFT window."""
    waveform = inspected.waveform
    if waveform is None:
        return
    for flight in inspected.campaign.flights:
        for node in flight.nodes:
            recording = inspected.recordings.get((flight.name, node))
            if recording:
                yield from _named(recording, node, secondary=node != flight.transmitter)
                yield from _long_enough(recording, waveform)


def _named(recording: Recording, node: str, *, secondary: bool) -> Iterator[CampaignError]:
    names = recording.channels
    if secondary and "sidelink" not in names:
        yield CampaignError(
            f"apertura:channels {names}",
            where=recording.files[0],
            expected=f"a channel named 'sidelink': {node} receives what another node sends",
            remedy="Name the channel, or take the node out of the flight.",
        )
    if len(set(names)) < len(names):
        yield CampaignError(
            f"apertura:channels {names}, a name twice",
            where=recording.files[0],
            expected="another name for each channel",
            remedy="Correct the metadata.",
        )


def _long_enough(recording: Recording, waveform: SampledWaveform) -> Iterator[CampaignError]:
    if recording.framing is not None:
        return
    length = int(np.min(recording.captures.length))
    if isinstance(waveform, OfdmWaveform):
        parts = (
            f"cyclic prefix ({waveform.prefix_samples}) and one period of "
            f"1/subcarrier_spacing_hz ({waveform.dft_samples})"
        )
    else:
        parts = "lead_s, pulse_s and listen_s of the waveform"
    if length < waveform.needed_samples:
        yield CampaignError(
            f"captures of {length} samples",
            where=recording.files[0],
            expected=f"at least {waveform.needed_samples}: {parts}",
            remedy=f"Correct the waveform in {CONFIG}, or record longer captures.",
        )
