"""Rule `profile`: transfer functions of a pair become range profiles, cropped to what the scene needs."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.errors import CampaignError
from apertura.scene.auto_grid import clearance, swath
from apertura.scene.grid import SceneGrid
from apertura.steps.scene import grid_spec, scene_grid, scene_inputs
from apertura.steps.stamping import stamped
from apertura.steps.terrain import Heights, open_heights
from apertura.store import open_stage, save_stage

GUARD_SAMPLES = 32
"""Samples beyond the swath on both sides, for the filters of the engines."""

OVERSAMPLING = 2.0


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr."""
    source, grid = open_stage(campaign.stage("echo", flight, pair), "echo"), scene_grid(campaign)
    window, frequency = campaign.settings.processing.window, source.frequency.values
    ground, places = open_heights(campaign), (source.tx_position.values, source.rx_position.values)
    check_clearance(grid, *places, heights=ground, where=f"flight {flight}, pair {pair}")
    nearest, farthest = swath(grid, *places, heights=ground.of)
    _check_prefix(farthest, source.path_limit.values, where=f"flight {flight}, pair {pair}")
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
    settings = {**campaign.relevant("profile"), "grid": grid_spec(grid)}
    parents, inputs = [source, *ground.parents], scene_inputs(campaign)
    save_stage(stamped(dataset, "profile", module=__name__, parents=parents, settings=settings, inputs=inputs), folder)
    return folder


def check_clearance(
    grid: SceneGrid, tx: NDArray[np.float64], rx: NDArray[np.float64], *, heights: Heights, where: str
) -> None:
    """Raise CampaignError where an antenna is not above the ground; it names what said how high the ground is.

    Parameters
    ----------
    grid, heights
        The scene and its ground.
    tx, rx
        (pulse, 3) float64 phase centres, metres, in the grid's processing frame.
    where
        Flight and pair.
    """
    source, keys = ("the ground", "scene.height_m and scene.height_datum")
    if heights.of is not None:
        source, keys = ("the DEM", "scene.dem (metres, not feet) and scene.dem_datum")
    for antenna, which in ((tx, "transmitter"), (rx, "receiver")):
        above, ground = clearance(grid, antenna, heights=heights.of)
        low = above <= 0
        if low.any():
            pulse = int(np.nanargmin(above))
            raise CampaignError(
                f"{where}: at {int(low.sum())} pulses the {which} is in or below the ground of the scene, worst at "
                f"pulse {pulse}: {above[pulse]:.2f} m above it, its height {above[pulse] + ground[pulse]:.2f} m where "
                f"{source} has {ground[pulse]:.2f} m",
                where=f"config/config.yaml: scene.{'height_m' if heights.of is None else 'dem'}",
                expected="an antenna above the ground",
                remedy=f"Check {keys}, and the heights in the flight log (logs may count from the geoid).",
            )


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
