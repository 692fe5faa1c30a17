"""`apertura plan`: processing decisions of each pair with reasons, predicted error and cost, before any processing."""

from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError, number_of
from apertura.core.backprojection.engines import missing_kernel
from apertura.core.planning.plan import Plan
from apertura.core.quality.budget import BudgetLine, expected
from apertura.core.quality.path_errors import Effect
from apertura.stages.pair import open_pair
from apertura.stages.planning import budget_of, gated, plan_pair
from apertura.stages.refine import expected_track
from apertura.stages.scene import Flown, expected_scene
from apertura.workflow.stale import outdated_lines, without_outdated

if TYPE_CHECKING:
    from rich.table import Table


def first_flight(campaign: Campaign) -> Flown:
    """Return the geometry of all pairs of the first image flight, which determines the common grid of all images."""
    flight = campaign.image_flights[0]
    return Flown.together([open_pair(campaign, flight.name, pair).flown for pair in flight.pairs])


def print_plan(campaign: Campaign, *, threads: int = 1) -> None:
    """Print the decisions of each pair with reasons, predicted error, run time and memory; nothing is written."""
    campaign.check_images()
    from rich.console import Console
    from rich.filesize import decimal

    console = Console(width=max(140, Console().width))
    campaign = without_outdated(campaign)
    for line in outdated_lines(campaign):
        console.print(line, highlight=False)
    seconds, disk = 0.0, 0
    scene = expected_scene(campaign, lambda: first_flight(campaign))
    rows, columns = scene.grid.shape
    console.print(f"scene: {columns} × {rows} pixels of {scene.grid.spacing_m:g} m, {scene.grid.crs}", highlight=False)
    for key, reason in scene.chosen.items():
        console.print(f"  scene.{key}: {reason}", highlight=False)
    for flight in campaign.image_flights:
        logged = [gated(campaign, open_pair(campaign, flight.name, pair), scene) for pair in flight.pairs]
        pairs, autofocus = expected_track(campaign, logged, scene)
        for opened in pairs:
            plan = plan_pair(campaign, opened, scene, threads=threads)
            plan = replace(plan, decisions=(*plan.decisions, *autofocus))
            budget = _budget_table(budget_of(campaign, opened, scene))
            console.print(_table(plan, f"{flight.name}/{opened.name}"), budget)
            if opened.history is None:
                console.print(
                    "This plan is based on the flight logs alone, because step echo has not run. The recorded samples "
                    "and the number of usable pulses may change models, errors and engine. Repeat `apertura plan` "
                    "after step echo."
                )
            for name, line in plan.flags.items():
                console.print(f"[yellow]{name}[/yellow]: {line}")
            seconds, disk = seconds + plan.predicted_seconds, disk + plan.disk_bytes
    console.print(
        f"total: about {seconds:.2g} s of image formation on {number_of(threads, 'thread')}, {decimal(disk)} on disk "
        "before compression"
    )
    if slow := missing_kernel():
        console.print(slow, highlight=False, soft_wrap=True)
    free = campaign.root.free_bytes()
    if disk > free and not campaign.results.is_dir():
        raise CampaignError(
            f"the results of all pairs need {decimal(disk)} on disk",
            where=campaign.root,
            expected=f"at most {decimal(free)}, the free disk space",
            remedy="Free disk space, or make the scene smaller.",
        )


def _table(plan: Plan, title: str) -> "Table":
    from rich.filesize import decimal
    from rich.table import Table

    table = Table(title=f"{title}: {plan.setting.line}", title_justify="left")
    for heading in ("decision", "value", "reason", "error"):
        table.add_column(heading, overflow="fold")
    for decision in plan.decisions:
        error = "" if decision.error_db is None else f"{decision.error_db:.1f} dB"
        table.add_row(decision.name, str(decision.value), decision.reason, error)
    table.add_section()
    memory, disk = decimal(plan.memory_bytes), decimal(plan.disk_bytes)
    line = f"about {plan.predicted_seconds:.2g} s, {memory} of memory, {disk} on disk"
    table.add_row("predicted", f"{plan.accuracy_db:.0f} dB requested", line, f"{plan.predicted_error_db:.1f} dB")
    return table


def _budget_table(lines: list[BudgetLine]) -> "Table":
    from rich.table import Table

    table = Table(title="error budget", title_justify="left")
    for heading in ("cause", "size", "peak loss", "displacement", "phase"):
        table.add_column(heading, overflow="fold")
    for line in lines:
        report = line.report
        stated = "; ".join(dict.fromkeys(report["stated"].split("; ")))  # text that is identical for several nodes
        table.add_row(report["cause"], stated, *_effect(line.effect))
    table.add_section()
    table.add_row("sum of expected effects", "", *_effect(expected(lines)))
    return table


def _effect(effect: Effect) -> tuple[str, str, str]:
    phase = f"{effect.phase_rad:.2g} rad" if isfinite(effect.phase_rad) else "not predicted"
    return f"{abs(effect.loss_db):.2f} dB", _length(effect.shift_m), phase


def _length(metres: float) -> str:
    """Format a length in centimetres, or in metres for lengths of at least 1 m.

    Examples
    --------
    >>> _length(0.0132), _length(2.13)
    ('1.3 cm', '2.1 m')
    """
    return f"{metres:.2g} m" if metres >= 1 else f"{100 * metres:.2g} cm"
