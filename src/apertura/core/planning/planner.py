"""Planner: search for the cheapest setting of all engines that meets the requested accuracy."""

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
"""Cost relative to the cheapest setting, up to which settings are considered equally cheap. The most exact of these
settings is chosen."""

_PLACE_S = {"ecef": 2.0e-8, "local": 2.7e-9}  # seconds per pixel position
_TILE_S = 4.0e-3  # seconds per tile, for its task and for writing


@dataclass(frozen=True, eq=False)
class SettingSearch:
    """Search for settings of a job.

    Attributes
    ----------
    job
        Imaging job.
    engine
        Requested engine; None: any.
    options
        Engine → option → requested value.
    pulse_blocks
        Requested number of pulse blocks; None: the smallest number with which a block fits into memory.
    where
        Section of the configuration with the request, for messages.
    """

    job: Job
    engine: str | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pulse_blocks: int | None = None
    where: str = "processing"

    @cached_property
    def _predicted(self) -> dict[int, list[Setting]]:
        """Number of pulses → settings."""
        return {}

    @property
    def tile_seconds(self) -> float:
        """Seconds for computing the pixel positions and writing all tiles, without the sums over pulses."""
        return self.job.pixels * _PLACE_S[self.job.frame] + self.job.tiles * _TILE_S

    def cheapest(self, pulses: int, target_db: float) -> Setting:
        """Return the cheapest setting that meets the target, or the most exact one if none does.

        Of settings within `EQUAL_COST` of the cheapest, the most exact one is returned.

        Raises
        ------
        CampaignError
            If the requested engine is not available on this machine or for this job.
        """
        options = self.settings(pulses)
        exact = [setting for setting in options if setting.error_db <= target_db]
        if not exact:
            return min(options, key=lambda setting: setting.error_db)
        equal = (setting for setting in exact if setting.seconds <= EQUAL_COST * exact[0].seconds)
        return min(equal, key=lambda setting: setting.error_db)

    def settings(self, pulses: int) -> list[Setting]:
        """Return all available settings that match the request, sorted by cost; at equal cost, most exact first.

        `form_seconds` includes the computation of pixel positions and the writing of tiles.

        Raises
        ------
        CampaignError
            If the requested engine is not available on this machine or for this job.
        """
        if pulses not in self._predicted:
            options = [
                replace(setting, form_seconds=setting.form_seconds + self.tile_seconds)
                for name in self._engines()
                for setting in load_engine(name).candidates(self.job, pulses=pulses, requested=self._requested(name))
            ]
            self._predicted[pulses] = sorted(options, key=lambda setting: (setting.seconds, setting.error_db))
        return self._predicted[pulses]

    def _requested(self, engine: str) -> dict[str, Any]:
        return {option: value for option, value in self.options.get(engine, {}).items() if value is not None}

    def fallbacks(self, chosen: Setting) -> tuple[Setting, ...]:
        """Return settings that are successively more exact by at least 6 dB, ending with the exact sum.

        Each setting is the cheapest one with its accuracy, regardless of the requested engine and options.
        """
        if chosen.engine == "reference":
            return ()
        is_restricted = self.engine is not None or any(self._requested(engine) for engine in self.options)
        free = replace(self, engine=None, options={}) if is_restricted else self
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
        """Return the setting with pulse blocks that fit into memory; each block recomputes the pixel positions."""
        blocks = pulse_blocks(setting, self.job, presum, requested=self.pulse_blocks)
        extra_seconds = (blocks - 1) * self.tile_seconds
        return replace(setting, pulse_blocks=blocks, form_seconds=setting.form_seconds + extra_seconds)

    def decisions(self, chosen: Setting, expected_db: float, accuracy_db: float) -> Iterator[Decision]:
        """Yield the decisions of a setting with their reasons; the first reason compares error and accuracy."""
        requested = self._requested(chosen.engine)
        candidates = "all engines and settings" if self.engine is None and not requested else "the requested settings"
        reason = f"cheapest of {candidates} (within 5 %) that meets {accuracy_db:.0f} dB"
        if expected_db > accuracy_db:
            reason = f"most exact of {candidates}: predicted error {expected_db:.1f} dB, requested {accuracy_db:.0f} "
            reason += "dB; tiles that do not meet the requested accuracy are recomputed"
        yield Decision("engine", chosen.engine, reason, chosen.error_db)
        for name, reason in chosen.reasons.items():
            prefix = "requested; " if name in requested else ""
            yield Decision(name, chosen.all_options[name], prefix + reason)

    def _engines(self) -> list[str]:
        """Return the available engines that match the request.

        A substitute engine needs ten seconds for compilation at run time and is therefore excluded if the engine that
        it replaces was built.
        """
        reads = {"profiles", "phase_history"} if self.job.recorded else {"profiles"}
        runnable = [name for name in ENGINES if load_engine(name).available() and load_engine(name).READS in reads]
        if self.engine is not None and self.engine not in runnable:
            engine = load_engine(self.engine)
            problem = (
                "is not available on this machine"
                if engine.READS in reads
                else f"requires a {engine.READS.replace('_', ' ')}, which is not available for this job"
            )
            needs = getattr(engine, "NEEDS", None)
            remedy = f"Engine {self.engine} needs {needs}. " if needs and engine.READS in reads else ""
            raise CampaignError(
                f"engine {self.engine} {problem}",
                where=f"{self.where}.engine",
                expected=f"an available engine: {', '.join(runnable)}",
                remedy=f"{remedy}Choose an available engine, or auto.",
            )
        if self.engine is not None:
            return [self.engine]
        with_options = [name for name in runnable if self._requested(name)]
        if with_options:
            return with_options
        return [name for name in runnable if getattr(load_engine(name), "STANDS_IN_FOR", None) not in runnable]


# ---- The planner

MARGIN_DB = 3.0
"""Margin of predicted errors below the requested accuracy, dB: the uncertainty of the predictions
(benchmarks/planner.py)."""

_PRESUM_DB = 6.0
"""Margin of the presumming error below the total error, dB: a quarter of the error power is assigned to presumming, and
the rest to the tables of the engine."""

PRESUM_FACTORS = (16, 12, 8, 6, 5, 4, 3, 2)
"""Candidate numbers of pulses per virtual (presummed) pulse, in descending order."""


def make_plan(
    job: Job, *, accuracy_db: float, overrides: Mapping[str, Any] | None = None, where: str = "processing"
) -> Plan:
    """Choose deterministically the cheapest setting and models that meet the requested accuracy.

    Parameters
    ----------
    job
        Imaging job.
    accuracy_db
        Requested numerical error, dB.
    overrides
        Option → requested value: engine, engine_options (engine → option → value), presum, pulse_blocks, terrain. The
        planner decides the options that are 'auto', None or missing.
    where
        Section of the configuration with the request, for messages.

    Raises
    ------
    CampaignError
        If the job has no pulse, or the request cannot be met on this machine.

    Notes
    -----
    Source: docs/theory/planner.md.
    """
    requested = {name: value for name, value in (overrides or {}).items() if value not in (None, "auto")}
    # Terrain model first: the errors of engines are predicted at its pixels.
    flags = check_geometry(job)
    terrain = decide_terrain(job, requested=requested.get("terrain"), where=where)
    if job.patches_on is not None:
        job = replace(job, patches_m=job.patches_on(job.terrain.model(str(terrain.value))))
    search = SettingSearch(
        job, requested.get("engine"), requested.get("engine_options", {}), requested.get("pulse_blocks"), where
    )
    # Cheapest setting for all pulses, and for virtual pulses if presumming saves time; pulse blocks by memory.
    every_pulse = search.cheapest(len(job.aperture), accuracy_db - MARGIN_DB)
    presumming, presum, chosen = _decide_presum(search, every_pulse, accuracy_db, requested.get("presum"))
    antennas, missed = decide_antennas(job.beams, job.illumination)
    chosen = search.fitted(chosen, presum)
    expected_db = power_sum_db(chosen.error_db, *([] if presumming.error_db is None else [presumming.error_db]))
    integrated = job.integration or Integration(None, len(job.aperture), "all", "all pulses contribute to every pixel")
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
    """Decide on presumming: return the decision, the low-pass sum over pulses or None, and the setting."""
    job, pulses = search.job, len(search.job.aperture)
    _, widest = job.aperture.phase_rates(job.points_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.band_hz[1])
    oversampled = f"phase rates differ from that of the scene centre by up to {widest:.3f} cycles per pulse"

    def keep(reason: str) -> tuple[Decision, None, Setting]:
        return Decision("presum", 1, f"{oversampled}; {reason}"), None, every_pulse

    if requested == 1:
        return keep("requested")
    if job.beams is not None:
        if requested is not None:
            raise _no_presum(requested, search.where)
        weights = "antennas" if job.antennas else "sector" if job.sector else "recorded paths"
        return keep(f"the weights of the {weights} differ from pulse to pulse")
    if every_pulse.engine == "reference":
        return keep("the exact sum is computed over all pulses")
    limit_db = accuracy_db - MARGIN_DB - _PRESUM_DB
    best = _best_presum(job, (requested,) if requested else PRESUM_FACTORS, widest, limit_db)
    if best is None and requested:
        most = int(0.3 / max(widest, 1e-9))
        raise CampaignError(
            f"presum factor {requested}",
            where=f"{search.where}.presum",
            expected=f"{f'a factor of at most {most}' if most > 1 else '1 or auto'}: {oversampled}",
            remedy="Use a smaller factor or auto.",
        )
    if best is None:
        return keep(
            f"the error of every presumming factor exceeds {limit_db:.0f} dB, the limit for the requested accuracy"
        )
    presum, error_db = best
    presum_seconds = PRESUM_S * pulses * job.signal.samples
    presummed = search.cheapest(len(presum.at), accuracy_db - MARGIN_DB - 1)
    if not requested and presum_seconds + presummed.seconds > 0.9 * every_pulse.seconds:
        return keep(f"presumming {presum.factor}:1 takes more time than it saves")
    line = f"{oversampled}; {pulses} pulses are presummed to {len(presum.at)} with an error of {error_db:.1f} dB"
    chosen = replace(presummed, table_seconds=presummed.table_seconds + presum_seconds)
    return Decision("presum", presum.factor, line, error_db), presum, chosen


def _no_presum(requested: int, where: str) -> CampaignError:
    return CampaignError(
        f"presum factor {requested} with antenna beams, a limited integration angle or a partly recorded scene",
        where=f"{where}.presum",
        expected="1 or auto, because the weights of antennas, sector and recorded paths differ from pulse to pulse",
        remedy="Set presum to auto, or set the nodes' antennas to null and processing.integration to all, and make the "
        "scene smaller.",
    )


def _best_presum(job: Job, factors: tuple[int, ...], widest: float, limit_db: float) -> tuple[Presum, float] | None:
    """Return the low-pass sum with the largest factor that meets the error limit, and its error."""
    pulses = len(job.aperture)
    for factor in factors:
        presum = design(pulses, factor, widest_cycles=widest, error_db=limit_db)
        if presum is None or len(presum.at) > 0.8 * pulses:
            continue
        error_db = presum_error_db(presum, job.aperture, job.points_m, highest_hz=job.band_hz[1])
        if error_db <= limit_db or len(factors) == 1:
            return presum, error_db
    return None
