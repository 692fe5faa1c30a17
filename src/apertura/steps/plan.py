"""`apertura plan`: how each pair will be imaged, why, how exactly and at what cost, before anything runs."""

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.echo.compression import centre_frequency, range_step
from apertura.errors import CampaignError
from apertura.focus.engines import reference
from apertura.focus.inputs import Spectra
from apertura.load.antennas import lit
from apertura.load.ground import Ground
from apertura.load.pair import Outlook, campaign_grid, outlook_of
from apertura.planning.candidates import Signal
from apertura.planning.memory import memory_limit, size_text
from apertura.planning.plan import Job, Plan
from apertura.planning.planner import make_plan
from apertura.quality.measures import content_loss_db
from apertura.scene.auto_grid import swath
from apertura.scene.grid import LOCAL, SceneGrid
from apertura.steps.costs import campaign_costs
from apertura.steps.profile import GUARD_SAMPLES, OVERSAMPLING, check_clearance
from apertura.steps.terrain import Heights, expected_heights
from apertura.store import manifest_of

if TYPE_CHECKING:
    from rich.table import Table

OVERRIDES = (
    "engine",
    "table_degree",
    "table_oversampling",
    "phase_tolerance_rad",
    "accumulate",
    "pulse_thinning",
    "pulse_blocks",
    "midpoint",
    "terrain",
)
_NET = 9
_BLOCKS = 33
_CONTENT_PIXELS = 128


def plan_pair(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Plan:
    """Return how a pair will be imaged: from its echo, or from the flight logs before anything ran.

    Parameters and errors as `plan_known`.
    """
    outlook = outlook_of(campaign, flight, pair)
    grid = campaign_grid(campaign, outlook)
    return plan_known(campaign, flight, pair, outlook, grid, expected_heights(campaign, grid), threads=threads)


def plan_known(
    campaign: Campaign,
    flight: str,
    pair: str,
    outlook: Outlook,
    grid: SceneGrid,
    heights: Heights,
    *,
    threads: int = 1,
) -> Plan:
    """Return how a pair will be imaged of which all that is known is open.

    Parameters
    ----------
    campaign, flight, pair
        Which.
    outlook, grid, heights
        Its echo or what the logs promise, the campaign's grid and the ground.
    threads
        Tiles formed at once: for seconds and bytes; nothing is chosen by it.

    Raises
    ------
    CampaignError
        If the job cannot fit in memory or on the disk, or its geometry is impossible.
    """
    check_clearance(grid, outlook.tx, outlook.rx, heights=heights, where=f"flight {flight}, pair {pair}")
    plan = plan_job(campaign, campaign_job(campaign, pair, outlook, grid, heights, threads=threads))
    written = manifest_of(campaign.stage("image", flight, pair)).is_file()
    check_fits(plan, free_disk=None if written else shutil.disk_usage(campaign.root).free, where=f"{flight}/{pair}")
    return plan


def plan_job(campaign: Campaign, job: Job) -> Plan:
    """Return how a job will be done at the accuracy, with the overrides and the costs of a campaign."""
    processing = campaign.settings.processing
    overrides = {name: getattr(processing, name) for name in OVERRIDES}
    return make_plan(job, accuracy_db=processing.accuracy_db, costs=campaign_costs(campaign), overrides=overrides)


def campaign_job(
    campaign: Campaign, pair: str, outlook: Outlook, grid: SceneGrid, heights: Heights, *, threads: int = 1
) -> Job:
    """Return the planner's job of a pair, or of a part of its pulses, with the campaign's DEM, antennas and memory."""
    return replace(
        job_of(outlook, grid, heights, tile_px=campaign.settings.processing.tile_px, threads=threads),
        memory_bytes=memory_limit(),
        **_relief(campaign, grid),
        **lit(campaign, pair, outlook.beams, grid, (outlook.tx, outlook.rx)),
    )


def job_of(outlook: Outlook, grid: SceneGrid, heights: Heights, *, tile_px: int, threads: int) -> Job:
    """Return the planner's job of what is known of a pair, on a grid and its ground."""
    rows, columns = (np.linspace(0, size - 1, min(size, _NET)) for size in grid.shape)
    frequency = outlook.frequency_hz
    step, length = range_step(frequency, oversampling=OVERSAMPLING)
    nearest, farthest = swath(grid, outlook.tx, outlook.rx, heights=heights.of)
    centre, count = centre_frequency(frequency), len(frequency)
    samples = int(np.ceil((farthest - nearest).max() / step)) + 2 * GUARD_SAMPLES + 1
    return Job(
        tx_position_m=outlook.tx,
        rx_position_m=outlook.rx,
        net_m=grid.positions_at(*np.meshgrid(rows, columns, indexing="ij")),
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre,
        bandwidth_hz=float(frequency[-1] - frequency[0]) * count / (count - 1),
        subcarriers=count,
        signal=Signal(centre, length / count, step, samples, outlook.weight),
        frame="local" if grid.crs == LOCAL else "ecef",
        tile_px=tile_px,
        threads=threads,
        path_limit_m=outlook.path_limit_m,
        content_db=None if outlook.spectra is None else _content_db(outlook, outlook.spectra, grid, heights),
    )


def _content_db(outlook: Outlook, spectra: Spectra, grid: SceneGrid, heights: Heights) -> float:
    """Return how much errors weigh at some random pixels of the scene."""
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (_CONTENT_PIXELS, 2)).T
    places = grid.positions_at(rows, columns, heights.at(rows, columns))
    parts = [slice(first, first + 64) for first in range(0, len(spectra.transfer), 64)]
    return content_loss_db(
        np.concatenate([reference.terms(spectra, places, outlook.beams, pulses=part) for part in parts])
    )


def _relief(campaign: Campaign, grid: SceneGrid) -> dict[str, Any]:
    """Return the DEM as the planner's job takes it: above the flat model, in the middle of blocks of pixels."""
    if campaign.settings.scene.dem is None:
        return {}
    terrain = Ground.of(campaign.settings.scene, campaign.root, crs=grid.crs).terrain
    if terrain is None:
        return {}
    side = max(1, max(grid.shape) // _BLOCKS)
    rows, columns = (max(1, size // side) for size in grid.shape)
    found = terrain.heights(replace(grid, spacing_m=grid.spacing_m * side, shape=(rows, columns))) - grid.height_m
    # Voids at pixels are refused by now; one between them is not imaged.
    return {"heights_m": np.where(np.isfinite(found), found, 0.0), "heights_step_px": side}


def planned_heights(plan: Plan, heights: Heights, grid: SceneGrid) -> Heights:
    """Return the ground as the plan models it: the DEM itself, a plane through it, or flat.

    Parameters
    ----------
    plan
        Of the pair.
    heights
        From `apertura.steps.terrain.open_heights`.
    grid
        The campaign's.
    """
    if heights.of is None or plan.choices["terrain"] == "dem":
        return heights
    if plan.tilt_m is None:
        return replace(heights, of=None)
    first, down, right = plan.tilt_m

    def plane(window: Window) -> NDArray[np.float64]:
        row, column = (np.arange(*part.indices(size)) for part, size in zip(window, grid.shape, strict=True))
        return np.asarray(grid.height_m + first + down * row[:, None] + right * column)

    return replace(heights, of=plane)


def check_fits(plan: Plan, *, free_disk: int | None, where: str, memory: int | None = None) -> None:
    """Raise CampaignError, with the numbers, unless the plan fits this machine.

    Parameters
    ----------
    plan
        Of one pair.
    free_disk
        Bytes; None: do not ask.
    where
        Flight and pair.
    memory
        Bytes, by default those of this machine or of the control group that the process runs in.
    """
    memory = memory or memory_limit()
    if plan.memory_bytes > memory:
        raise CampaignError(
            f"imaging needs {size_text(plan.memory_bytes)} of memory",
            where=where,
            expected=f"at most the {size_text(memory)} that this machine, or the job's share of it, has",
            remedy="Make scene.bounds_m smaller, use fewer threads, or ask for more memory.",
        )
    if free_disk is not None and plan.disk_bytes > free_disk:
        raise CampaignError(
            f"the results need {size_text(plan.disk_bytes)} on disk",
            where=where,
            expected=f"at most the {size_text(free_disk)} that are free",
            remedy="Free some space, make scene.bounds_m smaller or scene.spacing_m larger.",
        )


def print_plan(campaign: Campaign, *, threads: int = 1) -> None:
    """Print every pair's decisions, reasons, predicted error, seconds and bytes; nothing is run or written."""
    from rich.console import Console

    console = Console(width=max(140, Console().width))
    seconds, disk = 0.0, 0
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            plan = plan_pair(campaign, flight.name, pair, threads=threads)
            console.print(_table(plan, f"{flight.name}/{pair}", campaign.settings.processing.accuracy_db))
            for name, line in plan.flags.items():
                console.print(f"[yellow]{name}[/yellow]: {line}")
            seconds, disk = seconds + plan.predicted_seconds, disk + plan.disk_bytes
    console.print(
        f"in all {seconds:.3g} s of imaging on {threads} threads, {size_text(disk)} on disk before compression"
    )
    free = shutil.disk_usage(campaign.root).free
    if disk > free and not campaign.results.is_dir():
        raise CampaignError(
            f"the results of all pairs need {size_text(disk)} on disk",
            where=campaign.root,
            expected=f"at most the {size_text(free)} that are free",
            remedy="Free some space, or make the scene smaller.",
        )


def _table(plan: Plan, title: str, accuracy_db: float) -> "Table":
    from rich.table import Table

    table = Table(title=f"{title}: {plan.setting.line}", title_justify="left")
    for heading in ("choice", "value", "reason", "error"):
        table.add_column(heading, overflow="fold")
    for decision in plan.decisions:
        error = "" if decision.error_db is None else f"{decision.error_db:.1f} dB"
        table.add_row(decision.name, str(decision.value), decision.reason, error)
    table.add_section()
    memory, disk = size_text(plan.memory_bytes), size_text(plan.disk_bytes)
    line = f"{plan.predicted_seconds:.3g} s, {memory} of memory, {disk} on disk; costs {plan.cost_source}"
    table.add_row("predicted", f"{accuracy_db:.0f} dB asked", line, f"{plan.predicted_error_db:.1f} dB")
    return table
