"""The planner: how an image will be formed, why, how exact and how costly, before anything runs."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from apertura.antenna.illumination import decide_antennas
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.errors import CampaignError
from apertura.focus.presum import Presum, design, presum_error_db
from apertura.planning.candidates import Setting, power_sum_db
from apertura.planning.checks import crossed_edges
from apertura.planning.cost import Costs
from apertura.planning.desk import Desk
from apertura.planning.memory import block_decision, bytes_needed, setting_decisions, wall_seconds
from apertura.planning.models import Decision, decide_midpoint, decide_terrain, midpoint_error_db
from apertura.planning.plan import Job, Plan
from apertura.planning.view import phase_rates, vertical
from apertura.scene.terrain import FlatGround

MARGIN_DB = 3.0
"""Predicted errors lie this far below what is asked."""

THINNING_FACTORS = (16, 12, 8, 6, 5, 4, 3, 2)


def make_plan(job: Job, *, accuracy_db: float, costs: Costs, overrides: Mapping[str, Any] | None = None) -> Plan:
    """Choose the cheapest setting and models that meet the accuracy asked.

    Parameters
    ----------
    job
        What is to be imaged.
    accuracy_db
        Numerical error asked.
    costs
        Constants of the machine. The same job and costs give the same plan.
    overrides
        Choice → value that a person asks for: engine, table_degree, table_oversampling, accumulate,
        phase_tolerance_rad, pulse_thinning, pulse_blocks, midpoint, terrain. 'auto' or None leaves the choice to the
        planner.

    Raises
    ------
    CampaignError
        If the job holds no pulse, or what is asked cannot run here.

    Notes
    -----
    Source: docs/theory/planner.md.
    """
    asked = {name: value for name, value in (overrides or {}).items() if value not in (None, "auto")}
    flags = crossed_edges(
        job.tx_position_m,
        job.rx_position_m,
        job.net_m,
        spacing_m=job.spacing_m,
        band_hz=job.band_hz,
        path_limit_m=job.path_limit_m,
    )
    desk = Desk(job, job.view, costs, asked)
    whole = desk.cheapest(len(job.tx_position_m), accuracy_db - MARGIN_DB)
    thinning, presum, chosen = _decide_thinning(desk, whole, accuracy_db)
    midpoint = _decide_midpoint(desk, accuracy_db)
    terrain = _decide_terrain(desk)
    antennas, missed = decide_antennas(job.beams, job.illumination, asked)
    chosen = desk.fitted(chosen, presum)
    models = [decision.error_db for decision in (thinning, midpoint) if decision.error_db is not None]
    expected_db = power_sum_db(chosen.error_db, *models)
    if expected_db > accuracy_db:
        flags["prediction_misses"] = (
            f"predicted {expected_db:.1f} dB, {accuracy_db:.0f} dB asked: tiles that miss it are formed again"
        )
    memory, disk = bytes_needed(job, chosen, presum)
    return Plan(
        setting=chosen,
        better=desk.ladder(chosen.error_db, chosen.engine),
        decisions=(
            *setting_decisions(chosen, asked, accuracy_db),
            thinning,
            block_decision(chosen, job, asked="pulse_blocks" in asked),
            midpoint,
            terrain,
            *antennas,
        ),
        predicted_error_db=expected_db + max(0.0, job.content_db or 0.0),
        predicted_seconds=wall_seconds(chosen, job),
        memory_bytes=memory,
        disk_bytes=disk,
        flags=flags | missed,
        presum=presum,
        midpoint=bool(midpoint.value),
        middle_m=job.place_m[len(job.place_m) // 2],
        terrain=job.ground.called(str(terrain.value)),
        cost_source=costs.source,
        illumination=job.illumination,
    )


def _decide_thinning(desk: Desk, whole: Setting, accuracy_db: float) -> tuple[Decision, Presum | None, Setting]:
    job, asked = desk.job, desk.asked.get("pulse_thinning")
    tx_m, rx_m, pulses = job.tx_position_m, job.rx_position_m, len(job.tx_position_m)
    _, widest = phase_rates(tx_m, rx_m, job.place_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.band_hz[1])
    oversampled = f"the scene's middle and its edges differ by up to {widest:.3f} cycles per pulse"

    def keep(why: str) -> tuple[Decision, None, Setting]:
        return Decision("pulse_thinning", 1, f"{oversampled}; {why}"), None, whole

    if asked == 1:
        return keep("asked for in config/config.yaml")
    if job.beams is not None:
        return keep("the antennas weigh every pulse for itself")
    if whole.engine == "reference":
        return keep("the double sum takes every pulse")
    limit_db = accuracy_db - MARGIN_DB - desk.content_db - 3
    found = _presum(job, (asked,) if asked else THINNING_FACTORS, widest, limit_db)
    if found is None and asked:
        raise CampaignError(
            f"pulse_thinning is {asked}",
            where="config/config.yaml: processing.pulse_thinning",
            expected=f"at most {0.3 / max(widest, 1e-9):.1f} pulses made one: {oversampled}",
            remedy="Use a smaller factor or auto.",
        )
    if found is None:
        return keep(
            f"a low-pass sum of fewer pulses would err by more than {limit_db:.0f} dB, "
            f"which leaves room for tables and for what is weak in the scene"
        )
    presum, error_db = found
    spent = desk.costs.seconds["thin"] * pulses * job.signal.samples
    less = desk.cheapest(len(presum.at), accuracy_db - MARGIN_DB - 1)
    if not asked and spent + less.seconds > 0.9 * whole.seconds:
        return keep(f"a low-pass sum {presum.factor}:1 costs more than it saves")
    line = f"{oversampled}; a low-pass sum makes {len(presum.at)} of {pulses} pulses"
    chosen = replace(less, seconds=less.seconds + spent, table_seconds=less.table_seconds + spent)
    return Decision("pulse_thinning", presum.factor, f"{line} and errs by {error_db:.1f} dB", error_db), presum, chosen


def _presum(job: Job, factors: tuple[int, ...], widest: float, limit_db: float) -> tuple[Presum, float] | None:
    for factor in factors:
        presum = design(len(job.tx_position_m), factor, widest_cycles=widest, error_db=limit_db)
        if presum is None or len(presum.at) > 0.8 * len(job.tx_position_m):
            continue
        error_db = presum_error_db(presum, job.tx_position_m, job.rx_position_m, job.place_m, highest_hz=job.band_hz[1])
        if error_db <= limit_db or len(factors) == 1:
            return presum, error_db
    return None


def _decide_midpoint(desk: Desk, accuracy_db: float) -> Decision:
    job = desk.job
    some = slice(None, None, max(1, len(job.tx_position_m) // 256))
    found = decide_midpoint(
        job.tx_position_m[some],
        job.rx_position_m[some],
        job.place_m,
        wavelength_m=SPEED_OF_LIGHT_M_S / job.centre_hz,
        accuracy_db=accuracy_db,
        bistatic_costs=False,  # every engine here sums both legs, native before the pixel loop
    )
    asked = desk.asked.get("midpoint")
    if asked is None or bool(asked) == found.value or found.reason.startswith("monostatic"):
        return found
    some_tx, some_rx = job.tx_position_m[some], job.rx_position_m[some]
    error_db = midpoint_error_db(some_tx, some_rx, job.place_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.centre_hz)
    return Decision("midpoint", bool(asked), f"asked for in config/config.yaml; {found.reason}", error_db)


def _decide_terrain(desk: Desk) -> Decision:
    job = desk.job
    found = decide_terrain(
        job.ground,
        track_m=(job.tx_position_m + job.rx_position_m) / 2,
        place_m=job.place_m,
        up=vertical(job.net_m),
        wavelength_m=SPEED_OF_LIGHT_M_S / job.centre_hz,
        spacing_m=job.spacing_m,
    )
    asked = desk.asked.get("terrain")
    if asked is None or asked == found.value:
        return found
    if isinstance(job.ground.full, FlatGround):
        raise CampaignError(
            f"terrain is {asked}",
            where="config/config.yaml: processing.terrain",
            expected="plane or auto: the scene has no DEM",
            remedy="Name a DEM in scene.dem, or leave terrain to the planner.",
        )
    return Decision("terrain", asked, f"asked for in config/config.yaml; the rule says {found.value}: {found.reason}")
