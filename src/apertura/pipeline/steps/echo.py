"""Rule `echo`: what is measured of a pair's recordings and tracks: pulses, phase centres, clock and sidelink.

The calibrated transfer functions follow from it and the recordings. They are in it of a recorder that stores transfer
functions itself; else rule `transfer` keeps them where `processing.keep` says so.
"""

from pathlib import Path
from typing import Any

import xarray as xr

from apertura.common.provenance import merged
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.digests import Lineage
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.acquisition import open_acquisition
from apertura.pipeline.opening.air import scene_air
from apertura.pipeline.opening.echo import PairEcho, pair_echo
from apertura.pipeline.opening.pair import recorded_echo
from apertura.pipeline.opening.transmitted import transmitted
from apertura.pipeline.steps.calibration import calibrated, calibration_spec
from apertura.pipeline.steps.stamping import stamped
from apertura.pipeline.store import finish, save_stage, write_blocks, writing


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    lineage = result_of(campaign, "echo", flight, pair).begin(campaign.root)
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    calibration = calibrated(campaign, flight, pair)
    if not isinstance(waveform, SampledWaveform):
        files = [campaign.root / name for name in lineage.result.sources]
        formed = PairEcho.recorded(recorded_echo(campaign, flight, pair))
    else:
        files = [campaign.sent_file]
        sent = transmitted(campaign, waveform)
        tx, rx = pair.split("-")
        nodes = {node: open_acquisition(campaign, flight, node, sent) for node in dict.fromkeys((tx, rx))}
        parents = [stage for node in nodes.values() for stage in (node.raw, node.track)]
        air = scene_air(campaign, nodes[tx].track.position.values)
        hovers = bool(campaign.segments_of(flight, pair))
        formed = pair_echo(nodes[tx], nodes[rx], sent, campaign.settings.processing, calibration, air, hovers=hovers)
    formed = formed.within(campaign, flight, pair)
    inputs = {name: lineage.sources.digests[name] for name in map(campaign.relative, files)}
    if calibration:
        inputs = merged(inputs, calibration["inputs"])
    relevant = {**lineage.result.settings, "calibration": calibration_spec(calibration)}
    folder = campaign.stage("echo", flight, pair)
    how: dict[str, Any] = {"modules": lineage.modules, "parents": parents, "settings": relevant, "inputs": inputs}
    if isinstance(waveform, SampledWaveform):
        save_stage(stamped(formed.dataset, "echo", **how), folder, lineage=lineage)
    else:
        _write(formed, stamped(formed.hollow, "echo", **how), folder, lineage)
    return folder


def transfer(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/transfer.zarr, pulse by pulse those of echo.zarr."""
    lineage = result_of(campaign, "transfer", flight, pair).begin(campaign.root)
    formed, folder = PairEcho.opened(campaign, flight, pair), campaign.stage("transfer", flight, pair)
    kept = formed.hollow[["time", "frequency", "transfer"]]
    _write(formed, stamped(kept, "transfer", modules=lineage.modules, parents=[formed.dataset]), folder, lineage)
    return folder


def _write(formed: PairEcho, stage: xr.Dataset, folder: Path, lineage: Lineage) -> None:
    with writing(folder) as wip:
        write_blocks(wip, stage, "transfer", formed.blocks())
        finish(wip, folder, lineage=lineage, flags=formed.flags)
