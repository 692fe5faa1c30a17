"""Rule `profile`: range profiles of a pair from its transfer functions, cropped to the ranges of the scene."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Processing
from apertura.campaign.folder import Campaign
from apertura.campaign.store import blocks_of_rows, finish, write_blocks, writing
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.core.echo.background import GroupMeans, background_excess_db
from apertura.core.echo.captures import sampled_pulses
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.interference import Interference
from apertura.core.imaging.background import BackgroundScene, Removal, decide_removal
from apertura.core.imaging.range_profiles import CompressionError, RangeWindow, phase_history_of, range_compress
from apertura.stages.pair import open_pair, pattern_digests
from apertura.stages.planning import gated, ranges_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import stamped
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr, block by block."""
    lineage = result_of(campaign, "profile", flight, pair).begin(campaign.root)
    echo, scene = PairEcho.opened(campaign, flight, pair), open_scene(campaign)
    processing = campaign.settings.processing
    method, requested = processing.background_method, processing.window
    # Opened for itself: samples read for the decisions do not count twice among those checked for saturation.
    interference, removal = _decisions(PairEcho.opened(campaign, flight, pair), scene, processing)
    if interference and interference.is_removed:
        echo = replace(echo, gain=interference.gain)
    echo = replace(echo, removed=removal.background) if removal else echo
    source = echo.stage
    window = ranges_of(campaign, gated(campaign, open_pair(campaign, flight, pair, echo=source), scene), scene)
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


def _decisions(echo: PairEcho, scene: OpenScene, processing: Processing) -> tuple[Interference | None, Removal | None]:
    """Decide on interference and background of a pair; None if a removal is off, or nothing is there to remove."""
    method, frequency = processing.background_method, echo.dataset.frequency.values
    pulses = sampled_pulses(echo.shape[0])
    sampled = [echo.read(group) for group in pulses] if (processing.interference, method) != ("none", "none") else []
    interference = None
    if processing.interference != "none":
        interference = Interference.measured(sampled, frequency, window_weights(processing.window, echo.shape[1]))
        if interference.is_removed:
            echo = replace(echo, gain=interference.gain)
            sampled = [group * interference.gain for group in sampled]
    if method == "none":
        return interference, None
    if method == "auto":
        parts = zip(sampled, pulses, strict=True)
        if background_excess_db([remove_path(part, frequency, delay_s=-echo.delay_s[at]) for part, at in parts]) < 0:
            return interference, None
    history = phase_history_of(echo.stage, processing.window, lazy=True)
    over_scene = BackgroundScene(history, echo.delay_s, echo.extra_s, echo.time_s, scene.grid, scene.level)
    means = GroupMeans.of(echo.recorded_at, echo.time_s)
    return interference, decide_removal(means, over_scene, method=method, generator=np.random.default_rng(0))


def _compressed(
    source: xr.Dataset, requested: str, window: RangeWindow, scene: OpenScene, error: CompressionError
) -> Iterator[NDArray[np.complex64]]:
    """Yield the profiles of one chunk of the echo at a time; zeros if none of its pulses contributes to the scene."""
    for part in blocks_of_rows(source, "transfer"):
        if not window.contributing[part].any():
            yield np.zeros((part.stop - part.start, window.samples), np.complex64)
            continue
        history = phase_history_of(source.isel(pulse=part), requested)
        chunk = window.part(part)
        profiles = range_compress(history, scene.grid, scene.terrain, window=chunk)
        error.add(history, profiles, chunk.gate)
        yield profiles.samples
