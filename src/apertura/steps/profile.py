"""Rule `profile`: transfer functions of a pair become range profiles, cropped to what the scene needs."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.errors import CampaignError
from apertura.imaging.range_profiles import GUARD_SAMPLES, RangeWindow, range_compress
from apertura.imaging.stages import phase_history_of
from apertura.lineage import result_of
from apertura.load.scene import open_scene
from apertura.scene.clearance import check_antennas
from apertura.settings import CONFIG
from apertura.steps.stamping import stamped
from apertura.store import open_stage, save_stage


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr."""
    lineage = result_of(campaign, "profile", flight, pair).begin(campaign.root, [__name__])
    source, scene = open_stage(campaign.stage("echo", flight, pair), "echo"), open_scene(campaign)
    history, where = phase_history_of(source, campaign.settings.processing.window), f"flight {flight}, pair {pair}"
    check_antennas(scene.grid, scene.terrain, history.aperture, where=where)
    window = RangeWindow.of(history.aperture, scene.grid, scene.terrain, history.frequency_hz)
    _check_prefix(window.farthest_m, source.path_limit.values, where=where)
    _check_unambiguous(window)
    profiles = range_compress(history, scene.grid, scene.terrain, window=window)
    dataset = source[["time", "tx_position", "rx_position"]].assign(
        profile=(("pulse", "range"), profiles.samples), start=("pulse", profiles.start_m)
    )
    dataset.attrs = {name: source.attrs[name] for name in ("frame", "pair", "flags")} | {
        "step_m": profiles.step_m,
        "centre_frequency_hz": profiles.centre_frequency_hz,
        "oversampling": profiles.oversampling,
        "window": campaign.settings.processing.window,
    }
    folder = campaign.stage("profile", flight, pair)
    settings, parents = {**campaign.relevant("profile"), **scene.spec}, [source, *scene.parents]
    how: dict[str, Any] = {"modules": [__name__], "parents": parents, "settings": settings, "inputs": scene.inputs}
    save_stage(stamped(dataset, "profile", **how), folder, lineage=lineage)
    return folder


def _check_prefix(farthest: NDArray[np.float64], limit: NDArray[np.float64], *, where: str) -> None:
    beyond = np.flatnonzero(farthest > limit)
    if beyond.size:
        pulse = int((farthest - limit).argmax())
        raise CampaignError(
            f"at {beyond.size} pulses echoes of the scene arrive after the cyclic prefix, worst at pulse {pulse}: "
            f"total path {farthest[pulse]:.1f} m",
            where=where,
            expected=f"at most {limit[pulse]:.1f} m (c·cyclic_prefix_s less the path offsets)",
            remedy="Make scene.bounds_m smaller, or check path_offset_m and cyclic_prefix_s.",
        )


def _check_unambiguous(window: RangeWindow) -> None:
    if window.samples > window.unambiguous:
        spans_m, most_m = (
            (count - 2 * GUARD_SAMPLES) * window.step_m for count in (window.samples, window.unambiguous)
        )
        raise CampaignError(
            f"the scene spans {spans_m:.1f} m of total path",
            where=f"{CONFIG}: scene.bounds_m",
            expected=f"less than the unambiguous {most_m:.1f} m",
            remedy="Make the scene smaller.",
        )
