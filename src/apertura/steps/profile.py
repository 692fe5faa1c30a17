"""Rule `profile`: transfer functions of a pair become range profiles, cropped to what the scene needs."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.errors import CampaignError
from apertura.load.scene import open_scene
from apertura.scene.clearance import check_antennas
from apertura.scene.swath import swath
from apertura.steps.stamping import stamped
from apertura.store import open_stage, save_stage

GUARD_SAMPLES = 32
"""Samples beyond the swath on both sides, for the filters of the engines."""

OVERSAMPLING = 2.0


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr."""
    source, scene = open_stage(campaign.stage("echo", flight, pair), "echo"), open_scene(campaign)
    window, frequency = campaign.settings.processing.window, source.frequency.values
    antennas, where = (source.tx_position.values, source.rx_position.values), f"flight {flight}, pair {pair}"
    check_antennas(scene.grid, scene.terrain, *antennas, where=where)
    nearest, farthest = swath(scene.grid, scene.terrain, *antennas)
    _check_prefix(farthest, source.path_limit.values, where=where)
    step, length = range_step(frequency, oversampling=OVERSAMPLING)
    start = nearest - GUARD_SAMPLES * step
    count = int(np.ceil((farthest - nearest).max() / step)) + 2 * GUARD_SAMPLES + 1
    _check_unambiguous(count, length, step)
    samples = compress(
        source.transfer.values,
        frequency,
        weight=window_weights(window, len(frequency)),
        reference_delay_s=source.reference_delay.values,
        start_m=start,
        count=count,
        oversampling=OVERSAMPLING,
    )
    dataset = source[["time", "tx_position", "rx_position"]].assign(
        profile=(("pulse", "range"), samples), start=("pulse", start)
    )
    dataset.attrs = {name: source.attrs[name] for name in ("frame", "pair", "flags")} | {
        "step_m": step,
        "centre_frequency_hz": centre_frequency(frequency),
        "oversampling": length / len(frequency),
        "window": window,
    }
    folder = campaign.stage("profile", flight, pair)
    settings, parents = {**campaign.relevant("profile"), **scene.spec}, [source, *scene.parents]
    how: dict[str, Any] = {"module": __name__, "parents": parents, "settings": settings, "inputs": scene.inputs}
    save_stage(stamped(dataset, "profile", **how), folder)
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


def _check_unambiguous(count: int, length: int, step: float) -> None:
    if count > length:
        raise CampaignError(
            f"the scene spans {(count - 2 * GUARD_SAMPLES) * step:.1f} m of total path",
            where="config/config.yaml: scene.bounds_m",
            expected=f"less than the unambiguous {(length - 2 * GUARD_SAMPLES) * step:.1f} m",
            remedy="Make the scene smaller.",
        )
