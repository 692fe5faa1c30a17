"""Part of rule `raw`: captures of a recording that never stopped, found by the preamble before each symbol."""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.echo.framing import Framing
from apertura.echo.trigger import find_preambles, triggered_rate
from apertura.errors import CampaignError
from apertura.ingest import cut
from apertura.ingest.sigmf import Recording
from apertura.settings import OfdmWaveform

_BLOCK = 1 << 18
_BITS = 16


def triggered(recording: Recording, campaign: Campaign, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of a continuous recording, as a triggered recorder would have written it.

    Raises
    ------
    CampaignError
        If the preamble file is missing, or no preamble rises above the threshold.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, OfdmWaveform):
        raise TypeError("a recording of samples needs an OFDM waveform")
    framing = _framing(recording, campaign)
    channel = recording.channels.index("sidelink" if "sidelink" in recording.channels else "radar")
    length = round((waveform.cyclic_prefix_s + waveform.symbol_s) * recording.sample_rate_hz)
    rate = campaign.settings.processing.false_alarms_per_s
    samples = recording.samples
    found = [
        detection
        for detection in find_preambles(
            _blocks(samples, channel), framing, symbol_samples=length, false_alarms_per_s=rate
        )
        if detection.sample + framing.lead_samples + length <= len(samples)
    ]
    if not found:
        raise CampaignError(
            f"no preamble in {len(samples)} samples at a threshold for {rate} false alarms per second",
            where=recording.data_path,
            expected=f"preambles of {recording.framing and recording.framing['preamble']} in channel "
            f"{recording.channels[channel]}",
            remedy="Check the preamble file and apertura:framing, or record with more signal.",
        )
    places = np.array([detection.sample for detection in found])
    numbers = [framing.read_counter(samples[place : place + framing.lead_samples, channel]) for place in places]
    dataset = cut(
        recording,
        recording.captures_at(places + framing.lead_samples, length, np.array(numbers, np.int64)),
        node=node,
    )
    kept = triggered_rate(
        len(found),
        length,
        recorded_samples=len(samples),
        sample_rate_hz=recording.sample_rate_hz,
        bits=_BITS,
    )
    snr_db = float(np.median([detection.snr_db for detection in found]))
    dataset.attrs["trigger"] = {
        "captures": len(found),
        "false_alarms_per_s": rate,
        "snr_db": round(snr_db, 2),
        "duty_cycle": kept.duty_cycle,
        "mean_rate_bit_s": kept.mean_rate_bit_s,
    }
    return dataset


def _blocks(samples: NDArray[np.int16], channel: int) -> Iterator[NDArray[np.int16]]:
    for start in range(0, len(samples), _BLOCK):
        yield samples[start : start + _BLOCK, channel]


def _framing(recording: Recording, campaign: Campaign) -> Framing:
    described = recording.framing or {}
    path = campaign.root / described["preamble"]
    if not path.is_file():
        raise CampaignError(
            "no such file",
            where=path,
            expected=f"the preamble that {recording.meta_path.name}: apertura:framing names",
            remedy="Copy it there.",
        )
    return Framing(
        np.load(path, allow_pickle=False).astype(np.int64),
        chip_samples=described["chip_samples"],
        centre_hz=described["centre_hz"],
        sample_rate_hz=recording.sample_rate_hz,
        counter_bits=described["counter_bits"],
        bit_chips=described["bit_chips"],
        guard_samples=described["guard_samples"],
    )
