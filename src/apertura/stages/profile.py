"""Rule `profile`: range profiles of a pair from its transfer functions, cropped to the ranges of the scene."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import blocks_of_rows, finish, write_blocks, writing
from apertura.common.provenance import merged
from apertura.core.echo.compression import centre_frequency
from apertura.core.imaging.range_profiles import CompressionError, RangeWindow, phase_history_of, range_compress
from apertura.stages.pair import open_pair, pattern_digests
from apertura.stages.planning import ranges_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import stamped
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr, block by block."""
    lineage = result_of(campaign, "profile", flight, pair).begin(campaign.root)
    echo, scene = PairEcho.opened(campaign, flight, pair), open_scene(campaign)
    source = echo.stage
    window = ranges_of(campaign, open_pair(campaign, flight, pair, echo=source), scene)
    frequency, requested = source.frequency.values, campaign.settings.processing.window
    zeros = np.broadcast_to(np.complex64(0), (source.sizes["pulse"], window.samples))
    dataset = source[["time", "tx_position", "rx_position"]].assign(
        profile=(("pulse", "range"), zeros), start=("pulse", window.start_m)
    )
    dataset.attrs = {name: source.attrs[name] for name in ("frame", "pair", "flags")} | {
        "step_m": window.step_m,
        "centre_frequency_hz": centre_frequency(frequency),
        "oversampling": window.unambiguous / len(frequency),
        "window": requested,
        "wave_speed_m_s": window.wave_speed_m_s,
        "compression_error_db": 0.0,  # set after the last pulse
    }
    settings, parents = {**lineage.result.settings, **scene.spec}, [source, *scene.parents]
    inputs = merged(scene.inputs, pattern_digests(campaign, pair))
    origin: dict[str, Any] = {"modules": lineage.modules, "parents": parents, "settings": settings, "inputs": inputs}
    stage, folder = stamped(dataset, "profile", **origin), campaign.stage("profile", flight, pair)
    error = CompressionError(np.random.default_rng(0))
    with writing(folder) as wip:
        write_blocks(wip, stage, "profile", _compressed(source, requested, window, scene, error))
        finish(wip, folder, lineage=lineage, flags=echo.flags, compression_error_db=round(error.decibels, 2))
    return folder


def _compressed(
    source: xr.Dataset, requested: str, window: RangeWindow, scene: OpenScene, error: CompressionError
) -> Iterator[NDArray[np.complex64]]:
    """Yield the profiles of one chunk of the echo at a time; zeros if none of its pulses contributes to the scene."""
    for part in blocks_of_rows(source, "transfer"):
        if not window.contributing[part].any():
            yield np.zeros((part.stop - part.start, window.samples), np.complex64)
            continue
        history = phase_history_of(source.isel(pulse=part), requested)
        chunk = replace(window, start_m=window.start_m[part], farthest_m=window.farthest_m[part])
        profiles = range_compress(history, scene.grid, scene.terrain, window=chunk)
        error.add(history, profiles)
        yield profiles.samples
