"""`apertura plan`: how each pair will be imaged, why, how exactly and at what cost, before anything runs."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.compression import centre_frequency, range_step, window_weights
from apertura.echo.demodulate import subcarrier_numbers
from apertura.echo.geometry import phase_centres
from apertura.errors import CampaignError
from apertura.image.candidates import Signal
from apertura.image.cost import read_costs
from apertura.image.engines import reference
from apertura.image.extent import swath
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.history import Spectra
from apertura.image.models import content_loss_db
from apertura.image.plan import Job, Plan
from apertura.image.planner import make_plan
from apertura.ingest import PHASE_HISTORIES, TRACKS
from apertura.settings import OfdmWaveform, PhaseHistoryWaveform
from apertura.steps.profile import GUARD_SAMPLES, OVERSAMPLING
from apertura.steps.scene import PATH, scene_grid, settle
from apertura.store import manifest_of, open_stage

OVERRIDES = (
    "engine",
    "table_degree",
    "table_oversampling",
    "phase_tolerance_rad",
    "accumulate",
    "pulse_thinning",
    "midpoint",
    "terrain",
)
_NET = 9


_CONTENT_PIXELS = 128


@dataclass(frozen=True)
class Outlook:
    """What is known of a pair's echo before it is formed, or after: phase centres (pulse, 3), band, prefix, spectra."""

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    path_limit_m: float
    spectra: Spectra | None = None


def plan_pair(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Plan:
    """Return how a pair will be imaged: from its echo, or from the flight logs before anything ran.

    Parameters
    ----------
    campaign, flight, pair
        Which.
    threads
        Tiles formed at once: for seconds and bytes; nothing is chosen by it.

    Raises
    ------
    CampaignError
        If the job cannot fit in memory or on the disk, or its geometry is impossible.
    """
    outlook = outlook_of(campaign, flight, pair)
    grid = campaign_grid(campaign, outlook)
    processing = campaign.settings.processing
    plan = make_plan(
        job_of(outlook, grid, tile_px=processing.tile_px, threads=threads),
        accuracy_db=processing.accuracy_db,
        costs=read_costs(),
        overrides={name: getattr(processing, name) for name in OVERRIDES},
    )
    written = manifest_of(campaign.stage("image", flight, pair)).is_file()
    check_fits(plan, free_disk=None if written else shutil.disk_usage(campaign.root).free, where=f"{flight}/{pair}")
    return plan


def job_of(outlook: Outlook, grid: SceneGrid, *, tile_px: int, threads: int) -> Job:
    """Return the planner's job of a pair on a grid."""
    rows, columns = (np.linspace(0, size - 1, min(size, _NET)) for size in grid.shape)
    frequency = outlook.frequency_hz
    step, length = range_step(frequency, oversampling=OVERSAMPLING)
    nearest, farthest = swath(grid, outlook.tx, outlook.rx)
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
        signal=Signal(centre, length / count, step, samples),
        frame="local" if grid.crs == LOCAL else "ecef",
        tile_px=tile_px,
        threads=threads,
        path_limit_m=outlook.path_limit_m,
        content_db=None if outlook.spectra is None else _content_db(outlook.spectra, grid),
    )


def _content_db(spectra: Spectra, grid: SceneGrid) -> float:
    """Return how much errors weigh at some random pixels of the scene."""
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (_CONTENT_PIXELS, 2)).T
    places = grid.positions_at(rows, columns)
    parts = [slice(first, first + 64) for first in range(0, len(spectra.transfer), 64)]
    return content_loss_db(np.concatenate([reference.terms(spectra, places, pulses=part) for part in parts]))


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
        Bytes of this machine, by default what the operating system says.
    """
    memory = memory or os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if plan.memory_bytes > memory:
        raise CampaignError(
            f"imaging needs {_size(plan.memory_bytes)} of memory",
            where=where,
            expected=f"at most the {_size(memory)} of this machine",
            remedy="Make scene.bounds_m smaller, use fewer threads, or a larger machine.",
        )
    if free_disk is not None and plan.disk_bytes > free_disk:
        raise CampaignError(
            f"the results need {_size(plan.disk_bytes)} on disk",
            where=where,
            expected=f"at most the {_size(free_disk)} that are free",
            remedy="Free some space, make scene.bounds_m smaller or scene.spacing_m larger.",
        )


def print_plan(campaign: Campaign, *, threads: int = 1) -> None:
    """Print every pair's decisions, reasons, predicted error, seconds and bytes; nothing is run or written."""
    console = Console(width=max(140, Console().width))
    seconds, disk = 0.0, 0
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            plan = plan_pair(campaign, flight.name, pair, threads=threads)
            console.print(_table(plan, f"{flight.name}/{pair}", campaign.settings.processing.accuracy_db))
            for name, line in plan.flags.items():
                console.print(f"[yellow]{name}[/yellow]: {line}")
            seconds, disk = seconds + plan.predicted_seconds, disk + plan.disk_bytes
    console.print(f"in all {seconds:.3g} s of imaging on {threads} threads, {_size(disk)} on disk before compression")
    free = shutil.disk_usage(campaign.root).free
    if disk > free and not campaign.results.is_dir():
        raise CampaignError(
            f"the results of all pairs need {_size(disk)} on disk",
            where=campaign.root,
            expected=f"at most the {_size(free)} that are free",
            remedy="Free some space, or make the scene smaller.",
        )


def _table(plan: Plan, title: str, accuracy_db: float) -> Table:
    table = Table(title=f"{title}: {plan.setting.line}", title_justify="left")
    for heading in ("choice", "value", "reason", "error"):
        table.add_column(heading, overflow="fold")
    for decision in plan.decisions:
        error = "" if decision.error_db is None else f"{decision.error_db:.1f} dB"
        table.add_row(decision.name, str(decision.value), decision.reason, error)
    table.add_section()
    line = f"{plan.predicted_seconds:.3g} s, {_size(plan.memory_bytes)} of memory, {_size(plan.disk_bytes)} on disk"
    table.add_row("predicted", f"{accuracy_db:.0f} dB asked", line, f"{plan.predicted_error_db:.1f} dB")
    return table


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000 or unit == "TB":
            break
        count /= 1000
    return f"{count:.3g} {unit}"


def campaign_grid(campaign: Campaign, outlook: Outlook) -> SceneGrid:
    """Return the campaign's grid, settled or as it will be."""
    asked = campaign.settings.scene
    if "auto" in {asked.crs, asked.bounds_m, asked.spacing_m} and (campaign.root / PATH).is_file():
        return scene_grid(campaign)
    return settle(asked, outlook.tx, outlook.rx, outlook.frequency_hz, outlook.path_limit_m, root=campaign.root)[0]


def outlook_of(campaign: Campaign, flight: str, pair: str) -> Outlook:
    """Return what is known of a pair: its echo where it is formed, else what the logs promise."""
    folder = campaign.stage("echo", flight, pair)
    waveform = campaign.settings.waveform
    if manifest_of(folder).is_file():
        echo = open_stage(folder, "echo")
    elif isinstance(waveform, PhaseHistoryWaveform):
        files = list(campaign.raw_files(flight, pair.split("-")[1]).values())
        echo = PHASE_HISTORIES[waveform.format](files, pair=pair)
    else:
        return _expected(campaign, flight, pair, waveform)
    tx, rx, frequency = echo.tx_position.values, echo.rx_position.values, echo.frequency.values
    weight = window_weights(campaign.settings.processing.window, len(frequency))
    spectra = Spectra(echo.transfer.values, frequency, weight, echo.reference_delay.values, tx, rx)
    return Outlook(tx, rx, frequency, float(echo.path_limit.values.min()), spectra)


def _expected(campaign: Campaign, flight: str, pair: str, waveform: OfdmWaveform) -> Outlook:
    """Return what the logs promise: the transmitter's pulses, as far as every log reaches."""
    tx, rx = pair.split("-")
    logs = {node: campaign.track_file(flight, node) for node in (tx, rx)}
    tracks = {node: TRACKS[log.suffix](log, node=node) for node, log in logs.items()}
    first = max(track.time.values[0] for track in tracks.values())
    last = min(track.time.values[-1] for track in tracks.values())
    times = _pulse_times(campaign.raw_file(flight, tx, ".sigmf-meta"), first, last, waveform.prf_hz)
    places = []
    for node, antenna in ((tx, "radar_tx"), (rx, "radar_rx")):
        track, settings = tracks[node], campaign.settings.nodes[node]
        places.append(
            phase_centres(
                track.time.values,
                track.position.values,
                track.attitude.values,
                at=times,
                lever_arm_m=getattr(settings.lever_arms_m, antenna),
                attitude_from=settings.attitude,
                where=logs[node],
            )
        )
    numbers = subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is)
    frequency = np.asarray(waveform.carrier_hz + numbers * waveform.subcarrier_spacing_hz, np.float64)
    return Outlook(places[0], places[1], frequency, SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s)


def _pulse_times(meta: Path, first: np.datetime64, last: np.datetime64, prf_hz: float) -> NDArray[np.datetime64]:
    """Return the capture times of a recording inside the logs, or a regular series where it has none."""
    captures: list[Mapping[str, str]] = json.loads(meta.read_text(encoding="utf-8")).get("captures", [])
    stated = [capture["core:datetime"].removesuffix("Z") for capture in captures if "core:datetime" in capture]
    times = np.array(stated, "datetime64[ns]")
    if len(times) < 2:
        count = int((last - first) / np.timedelta64(1, "s") * prf_hz) + 1
        times = first + (1e9 / prf_hz * np.arange(count)).astype("timedelta64[ns]")
    return times[(times >= first) & (times <= last)]
