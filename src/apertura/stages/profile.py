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
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.core.echo.background import GroupMeans, background_excess_db
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.interference import Interference
from apertura.core.imaging.background import BackgroundScene, Removal, decide_removal
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
    method, requested = campaign.settings.processing.background_method, campaign.settings.processing.window
    interference = _interference(echo, requested=campaign.settings.processing.interference, window=requested)
    if interference and interference.is_removed:
        echo = replace(echo, gain=interference.gain)
    removal = _removal(echo, scene, method=method, window=requested)
    echo = replace(echo, removed=removal.background) if removal else echo
    source = echo.stage
    window = ranges_of(campaign, open_pair(campaign, flight, pair, echo=source), scene)
    frequency = source.frequency.values
    zeros = np.broadcast_to(np.complex64(0), (source.sizes["pulse"], window.samples))
    dataset = source[["time", "tx_position", "rx_position"]].assign(
        profile=(("pulse", "range"), zeros), start=("pulse", window.start_m)
    )
    if echo.gain is not None:
        dataset["subcarrier_gain"] = ("subcarrier", echo.gain)
    if echo.removed:
        dataset["background"] = (("background_knot", "subcarrier"), echo.removed.values)
        dataset["background_time"] = ("background_knot", echo.removed.time_s)
    dataset.attrs = {name: source.attrs[name] for name in ("frame", "pair", "flags")} | {
        "background": {"requested": method} | (removal.report if removal else {}),
        "interference": interference.report if interference else {},
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
        flags = Flags.merged(echo.flags, *(one.flags for one in (interference, removal) if one))
        finish(wip, folder, lineage=lineage, flags=flags, compression_error_db=round(error.decibels, 2))
    return folder


def _interference(echo: PairEcho, *, requested: str, window: str) -> Interference | None:
    """Measure the interference of a pair; None if exclusion of interference is off."""
    if requested == "none":
        return None
    pulses, subcarriers = echo.shape
    frequency = echo.dataset.frequency.values
    return Interference.measured(echo.read, pulses, frequency, window_weights(window, subcarriers))


def _removal(echo: PairEcho, scene: OpenScene, *, method: str | float, window: str) -> Removal | None:
    """Decide on the removal of the background; None if removal is off, or the recording has no background."""
    pulses, subcarriers = echo.shape
    if method == "none" or (method == "auto" and background_excess_db(echo.recorded_at, pulses, subcarriers) < 0):
        return None
    history = phase_history_of(echo.stage, window, lazy=True)
    recorded = BackgroundScene(history, echo.delay_s, echo.extra_s, echo.time_s, scene.grid, scene.level)
    means = GroupMeans.of(echo.recorded_at, echo.time_s)
    return decide_removal(means, recorded, method=method, generator=np.random.default_rng(0))


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
