"""The planner: the cheapest setting of all engines that is exact enough, why, and at what cost."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.core.antenna.illumination import decide_antennas
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.engines.engine import Setting, power_sum_db
from apertura.core.backprojection.job import Integration, Job
from apertura.core.backprojection.presum import PRESUM_S, Presum, design, presum_error_db
from apertura.core.planning.decisions import decide_terrain
from apertura.core.planning.plan import Decision, Plan, block_decision, bytes_needed, check_geometry, pulse_blocks

# ---- Search among the settings of all engines

EQUAL_COST = 1.05
"""Cost relative to the cheapest setting that counts as equal; the most exact of equals is taken."""

_PLACE_S = {"ecef": 2.0e-8, "local": 2.7e-9}  # per pixel position
_TILE_S = 4.0e-3  # per tile: task and write


@dataclass(frozen=True, eq=False)
class SettingSearch:
    """Search for settings of a job.

    Attributes
    ----------
    job
        What is to be imaged.
    engine
        Requested engine; None: any.
    options
        Engine → option → requested value.
    pulse_blocks
        Requested number; None: as few as fit.
    where
        Section of the config with the request, for messages.
    """

    job: Job
    engine: str | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pulse_blocks: int | None = None
    where: str = "processing"

    @cached_property
    def _predicted(self) -> dict[int, list[Setting]]:
        """Pulses → settings."""
        return {}

    @property
    def tile_seconds(self) -> float:
        """Seconds of tiles apart from their sums: placing pixels, and writing."""
        return self.job.pixels * _PLACE_S[self.job.frame] + self.job.tiles * _TILE_S

    def cheapest(self, pulses: int, target_db: float) -> Setting:
        """Return the most exact of the settings about as cheap as the cheapest that meets the target; else the best.

        Raises
        ------
        CampaignError
            If the requested engine cannot run here.
        """
        options = self.settings(pulses)
        exact = [setting for setting in options if setting.error_db <= target_db]
        if not exact:
            return min(options, key=lambda setting: setting.error_db)
        equal = (setting for setting in exact if setting.seconds <= EQUAL_COST * exact[0].seconds)
        return min(equal, key=lambda setting: setting.error_db)

    def settings(self, pulses: int) -> list[Setting]:
        """Return every setting that can run here and fits the request, cheapest first.

        Of equal costs the most exact comes first. Placing pixels and writing tiles is in `form_seconds`.

        Raises
        ------
        CampaignError
            If the requested engine cannot run here.
        """
        if pulses not in self._predicted:
            options = [
                replace(setting, form_seconds=setting.form_seconds + self.tile_seconds)
                for name in self._engines()
                for setting in load_engine(name).candidates(self.job, pulses=pulses, requested=self._asked(name))
            ]
            self._predicted[pulses] = sorted(options, key=lambda setting: (setting.seconds, setting.error_db))
        return self._predicted[pulses]

    def _asked(self, engine: str) -> dict[str, Any]:
        return {option: value for option, value in self.options.get(engine, {}).items() if value is not None}

    def fallbacks(self, chosen: Setting) -> tuple[Setting, ...]:
        """Return the cheapest setting per 6 dB gained, whatever was requested, ending with the double sum."""
        if chosen.engine == "reference":
            return ()
        asked = self.engine is not None or any(self._asked(engine) for engine in self.options)
        free = replace(self, engine=None, options={}) if asked else self
        options = free.settings(len(self.job.aperture))
        last = [setting for setting in options if setting.engine == "reference"]
        options = [setting for setting in options if not last or setting.seconds < last[0].seconds]
        better: list[Setting] = []
        error_db = chosen.error_db
        while error_db > -130:
            finer = [s for s in options if s.error_db <= error_db - 6 and s.engine != "reference"]
            if not finer:
                break
            better.append(finer[0])
            error_db = finer[0].error_db
        return (*(self.fitted(setting, None) for setting in better), *last)

    def fitted(self, setting: Setting, presum: Presum | None) -> Setting:
        """Return the setting in as many pulse blocks as fit into memory; each one places the tiles once more."""
        blocks = pulse_blocks(setting, self.job, presum, requested=self.pulse_blocks)
        more = (blocks - 1) * self.tile_seconds
        return replace(setting, pulse_blocks=blocks, form_seconds=setting.form_seconds + more)

    def decisions(self, chosen: Setting, expected_db: float, accuracy_db: float) -> Iterator[Decision]:
        """Yield the choices that make up a setting, with their reasons, and whether it is exact enough."""
        requested = self._asked(chosen.engine)
        every = "engine and setting" if self.engine is None and not requested else "setting that was asked for"
        why = f"cheapest of every {every}, to 5 %, meets {accuracy_db:.0f} dB"
        if expected_db > accuracy_db:
            why = f"most exact of every {every}, predicted {expected_db:.1f} dB, {accuracy_db:.0f} dB asked: "
            why += "tiles that miss it are formed again"
        yield Decision("engine", chosen.engine, why, chosen.error_db)
        for name, reason in chosen.reasons.items():
            why = "asked for; " if name in requested else ""
            yield Decision(name, chosen.all_options[name], why + reason)

    def _engines(self) -> list[str]:
        """Return the engines that can run here and fit the request; untimed ones only where they are named.

        Seconds that were not measured are no reason to prefer an engine; nor are those of one that compiles itself
        for ten seconds first, where the engine that it stands in for was built.
        """
        reads = {"profiles", "phase_history"} if self.job.recorded else {"profiles"}
        runnable = [name for name in ENGINES if load_engine(name).available() and load_engine(name).READS in reads]
        if self.engine is not None and self.engine not in runnable:
            engine = load_engine(self.engine)
            what = (
                "cannot run here" if engine.READS in reads else f"reads the {engine.READS.replace('_', ' ')}: none here"
            )
            needs = getattr(engine, "NEEDS", None)
            remedy = f"It needs {needs}. " if needs and engine.READS in reads else ""
            raise CampaignError(
                f"engine {self.engine} {what}",
                where=f"{self.where}.engine",
                expected=f"an engine that can: {', '.join(runnable)}",
                remedy=f"{remedy}Choose one of these, or auto.",
            )
        if self.engine is not None:
            return [self.engine]
        stated = [name for name in runnable if self._asked(name)]
        if stated:
            return stated
        timed = [name for name in runnable if getattr(load_engine(name), "TIMED", True)]
        return [name for name in timed if getattr(load_engine(name), "STANDS_IN_FOR", None) not in timed]


# ---- The planner

MARGIN_DB = 3.0
"""dB of predicted errors below the requested accuracy: what predictions may be too low by (benchmarks/planner.py)."""

_PRESUM_DB = 6.0
"""dB of a low-pass sum's error below that of all: a quarter, so that tables may err by the rest."""

PRESUM_FACTORS = (16, 12, 8, 6, 5, 4, 3, 2)
"""Pulses per virtual pulse that are tried, the largest first."""


def make_plan(
    job: Job, *, accuracy_db: float, overrides: Mapping[str, Any] | None = None, where: str = "processing"
) -> Plan:
    """Choose the cheapest setting and models that meet the requested accuracy. The same job gives the same plan.

    Parameters
    ----------
    job
        What is to be imaged.
    accuracy_db
        Requested numerical error.
    overrides
        Choice → requested value: engine, engine_options (engine → option → value), presum, pulse_blocks,
        terrain. 'auto' or None leaves the choice to the planner.
    where
        Section of the config with the request, for messages.

    Raises
    ------
    CampaignError
        If the job has no pulse, or the request cannot run here.

    Notes
    -----
    Source: docs/theory/planner.md.
    """
    requested = {name: value for name, value in (overrides or {}).items() if value not in (None, "auto")}
    # Model of the ground first: engines are predicted on its pixels.
    flags = check_geometry(job)
    terrain = decide_terrain(job, requested=requested.get("terrain"), where=where)
    if job.patches_on is not None:
        job = replace(job, patches_m=job.patches_on(job.terrain.model(str(terrain.value))))
    search = SettingSearch(
        job, requested.get("engine"), requested.get("engine_options", {}), requested.get("pulse_blocks"), where
    )
    # The cheapest setting for every pulse, and for fewer where a low-pass sum pays; blocks that fit into memory.
    every_pulse = search.cheapest(len(job.aperture), accuracy_db - MARGIN_DB)
    presumming, presum, chosen = _decide_presum(search, every_pulse, accuracy_db, requested.get("presum"))
    antennas, missed = decide_antennas(job.beams, job.illumination)
    chosen = search.fitted(chosen, presum)
    expected_db = power_sum_db(chosen.error_db, *([] if presumming.error_db is None else [presumming.error_db]))
    integrated = job.integration or Integration(None, len(job.aperture), "all", "every pulse counts for every pixel")
    memory, disk = bytes_needed(job, chosen, presum)
    blocks = block_decision(chosen, job, presum, requested="pulse_blocks" in requested)
    return Plan(
        setting=chosen,
        fallbacks=search.fallbacks(chosen),
        decisions=(
            *search.decisions(chosen, expected_db, accuracy_db),
            Decision("integration", integrated.value, integrated.reason),
            presumming,
            blocks,
            terrain,
            *(Decision("antenna", value, reason) for value, reason in antennas),
        ),
        accuracy_db=accuracy_db,
        predicted_error_db=expected_db,
        predicted_seconds=chosen.table_seconds + chosen.form_seconds / min(job.threads, job.tiles),
        memory_bytes=memory,
        disk_bytes=disk,
        flags=Flags.merged(flags, missed, integrated.flags),
        terrain=job.terrain.model(str(terrain.value)),
        presum=presum,
        middle_m=job.points_m[len(job.points_m) // 2],
        beams=job.beams,
        integration=integrated,
        illumination=job.illumination,
        fixed_engine="engine" in requested,
    )


def _decide_presum(
    search: SettingSearch, every_pulse: Setting, accuracy_db: float, requested: int | None
) -> tuple[Decision, Presum | None, Setting]:
    """Return the decision, the low-pass sum over pulses, and the setting with it."""
    job, pulses = search.job, len(search.job.aperture)
    _, widest = job.aperture.phase_rates(job.points_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.band_hz[1])
    oversampled = f"the scene's middle and its edges differ by up to {widest:.3f} cycles per pulse"

    def keep(why: str) -> tuple[Decision, None, Setting]:
        return Decision("presum", 1, f"{oversampled}; {why}"), None, every_pulse

    if requested == 1:
        return keep("asked for")
    if job.beams is not None:
        if requested is not None:
            raise _no_presum(requested, search.where)
        return keep(f"{'the antennas weigh' if job.antennas else 'the sector weighs'} every pulse for itself")
    if every_pulse.engine == "reference":
        return keep("the double sum takes every pulse")
    limit_db = accuracy_db - MARGIN_DB - _PRESUM_DB
    best = _best_presum(job, (requested,) if requested else PRESUM_FACTORS, widest, limit_db)
    if best is None and requested:
        most = int(0.3 / max(widest, 1e-9))
        raise CampaignError(
            f"presum is {requested}",
            where=f"{search.where}.presum",
            expected=f"{f'at most {most} pulses made one' if most > 1 else '1 or auto'}: {oversampled}",
            remedy="Use a smaller factor or auto.",
        )
    if best is None:
        return keep(
            f"a low-pass sum of fewer pulses would err by more than {limit_db:.0f} dB, which leaves room for tables"
        )
    presum, error_db = best
    spent = PRESUM_S * pulses * job.signal.samples
    less = search.cheapest(len(presum.at), accuracy_db - MARGIN_DB - 1)
    if not requested and spent + less.seconds > 0.9 * every_pulse.seconds:
        return keep(f"a low-pass sum {presum.factor}:1 costs more than it saves")
    line = f"{oversampled}; a low-pass sum makes {len(presum.at)} of {pulses} pulses"
    chosen = replace(less, table_seconds=less.table_seconds + spent)
    return Decision("presum", presum.factor, f"{line} and errs by {error_db:.1f} dB", error_db), presum, chosen


def _no_presum(requested: int, where: str) -> CampaignError:
    return CampaignError(
        f"presum is {requested}, and the antennas have beams or only a part of the flight is integrated",
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
