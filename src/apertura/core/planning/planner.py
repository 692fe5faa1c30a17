"""The planner: how an image will be formed, why, how exact and how costly, before anything runs."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags.raised import Flags
from apertura.core.antenna.illumination import decide_antennas
from apertura.core.focus.engines.engine import Setting, power_sum_db
from apertura.core.focus.job import Integration, Job
from apertura.core.focus.presum import PRESUM_S, Presum, design, presum_error_db
from apertura.core.planning.checks import check_geometry
from apertura.core.planning.memory import block_decision, bytes_needed
from apertura.core.planning.plan import Decision, Plan
from apertura.core.planning.search import Search
from apertura.core.planning.terrain_model import decide_terrain

MARGIN_DB = 3.0
"""Predicted errors lie this far below what is asked."""

PRESUM_FACTORS = (16, 12, 8, 6, 5, 4, 3, 2)


def make_plan(
    job: Job, *, accuracy_db: float, overrides: Mapping[str, Any] | None = None, where: str = "processing"
) -> Plan:
    """Choose the cheapest setting and models that meet the accuracy asked. The same job gives the same plan.

    Parameters
    ----------
    job
        What is to be imaged.
    accuracy_db
        Numerical error asked.
    overrides
        Choice → value that a person asks for: engine, engine_options (engine → option → value), presum, pulse_blocks,
        terrain. 'auto' or None leaves the choice to the planner.
    where
        Section of the config that asks, for messages.

    Raises
    ------
    CampaignError
        If the job holds no pulse, or what is asked cannot run here.

    Notes
    -----
    Source: docs/theory/planner.md.
    """
    asked = {name: value for name, value in (overrides or {}).items() if value not in (None, "auto")}
    flags = check_geometry(job)
    terrain = decide_terrain(job, asked=asked.get("terrain"), where=where)
    if job.patches_on is not None:
        job = replace(job, patches_m=job.patches_on(job.terrain.called(str(terrain.value))))
    search = Search(job, asked.get("engine"), asked.get("engine_options", {}), asked.get("pulse_blocks"), where)
    every_pulse = search.cheapest(len(job.aperture), accuracy_db - MARGIN_DB)
    presumming, presum, chosen = _decide_presum(search, every_pulse, accuracy_db, asked.get("presum"))
    antennas, missed = decide_antennas(job.beams, job.illumination)
    chosen = search.fitted(chosen, presum)
    expected_db = power_sum_db(chosen.error_db, *([] if presumming.error_db is None else [presumming.error_db]))
    if expected_db > accuracy_db:
        flags["prediction_misses"] = (
            f"predicted {expected_db:.1f} dB, {accuracy_db:.0f} dB asked: tiles that miss it are formed again"
        )
    integrated = job.integration or Integration(None, len(job.aperture), "all", "every pulse counts for every pixel")
    memory, disk = bytes_needed(job, chosen, presum)
    blocks = block_decision(chosen, job, presum, asked="pulse_blocks" in asked)
    return Plan(
        setting=chosen,
        fallbacks=search.fallbacks(chosen),
        decisions=(
            *search.decisions(chosen, accuracy_db),
            Decision("integration", integrated.value, integrated.reason),
            presumming,
            blocks,
            terrain,
            *(Decision("antenna", value, reason) for value, reason in antennas),
        ),
        accuracy_db=accuracy_db,
        predicted_error_db=expected_db + max(0.0, job.content_db or 0.0),
        predicted_seconds=chosen.table_seconds + chosen.form_seconds / min(job.threads, job.tiles),
        memory_bytes=memory,
        disk_bytes=disk,
        flags=Flags.merged(flags, missed, integrated.flags),
        terrain=job.terrain.called(str(terrain.value)),
        presum=presum,
        middle_m=job.points_m[len(job.points_m) // 2],
        beams=job.beams,
        integration=integrated,
        illumination=job.illumination,
    )


def _decide_presum(
    search: Search, every_pulse: Setting, accuracy_db: float, asked: int | None
) -> tuple[Decision, Presum | None, Setting]:
    """Return the decision, the low-pass sum over pulses, and the setting with it."""
    job, pulses = search.job, len(search.job.aperture)
    _, widest = job.aperture.phase_rates(job.points_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.band_hz[1])
    oversampled = f"the scene's middle and its edges differ by up to {widest:.3f} cycles per pulse"

    def keep(why: str) -> tuple[Decision, None, Setting]:
        return Decision("presum", 1, f"{oversampled}; {why}"), None, every_pulse

    if asked == 1:
        return keep("asked for")
    if job.beams is not None:
        if asked is not None:
            raise _no_presum(asked, search.where)
        return keep(f"{'the antennas weigh' if job.antennas else 'the sector weighs'} every pulse for itself")
    if every_pulse.engine == "reference":
        return keep("the double sum takes every pulse")
    limit_db = accuracy_db - MARGIN_DB - search.content_db - 3
    best = _best_presum(job, (asked,) if asked else PRESUM_FACTORS, widest, limit_db)
    if best is None and asked:
        raise CampaignError(
            f"presum is {asked}",
            where=f"{search.where}.presum",
            expected=f"at most {0.3 / max(widest, 1e-9):.1f} pulses made one: {oversampled}",
            remedy="Use a smaller factor or auto.",
        )
    if best is None:
        return keep(
            f"a low-pass sum of fewer pulses would err by more than {limit_db:.0f} dB, "
            f"which leaves room for tables and for what is weak in the scene"
        )
    presum, error_db = best
    spent = PRESUM_S * pulses * job.signal.samples
    less = search.cheapest(len(presum.at), accuracy_db - MARGIN_DB - 1)
    if not asked and spent + less.seconds > 0.9 * every_pulse.seconds:
        return keep(f"a low-pass sum {presum.factor}:1 costs more than it saves")
    line = f"{oversampled}; a low-pass sum makes {len(presum.at)} of {pulses} pulses"
    chosen = replace(less, table_seconds=less.table_seconds + spent)
    return Decision("presum", presum.factor, f"{line} and errs by {error_db:.1f} dB", error_db), presum, chosen


def _no_presum(asked: int, where: str) -> CampaignError:
    return CampaignError(
        f"presum is {asked}, and the antennas have beams or only a part of the flight is integrated",
        where=f"{where}.presum",
        expected="1 or auto: every pulse is weighed for itself, by the antennas and by its place in the sector",
        remedy="Leave presum to the planner, or set the nodes' antennas to null and processing.integration to all.",
    )


def _best_presum(job: Job, factors: tuple[int, ...], widest: float, limit_db: float) -> tuple[Presum, float] | None:
    """Return the low-pass sum of the largest factor that errs less than the limit, and its error."""
    pulses = len(job.aperture)
    for factor in factors:
        presum = design(pulses, factor, widest_cycles=widest, error_db=limit_db)
        if presum is None or len(presum.at) > 0.8 * pulses:
            continue
        error_db = presum_error_db(presum, job.aperture, job.points_m, highest_hz=job.band_hz[1])
        if error_db <= limit_db or len(factors) == 1:
            return presum, error_db
    return None
