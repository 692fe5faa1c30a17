"""The search among the settings of all engines for the cheapest that is exact enough."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from apertura.common.errors import CampaignError
from apertura.core.focus.engines import ENGINES, load_engine
from apertura.core.focus.engines.engine import Setting
from apertura.core.focus.job import Job
from apertura.core.focus.presum import Presum
from apertura.core.planning.memory import pulse_blocks
from apertura.core.planning.plan import Decision

UNSEEN_DB = 3.0
"""Set aside before the echo is there: at random pixels of a sparse scene errors weigh more."""

NEAR = 1.3
"""A setting that costs no more than this times the cheapest may be taken for what the scene's content may cost."""

EQUAL = 1.05
"""Settings that cost no more than this times the chosen one are as cheap: the most exact of them is taken."""

_PLACE_S = {"ecef": 2.0e-8, "local": 2.7e-9}  # per pixel position
_TILE_S = 4.0e-3


@dataclass(frozen=True, eq=False)
class Search:
    """What every choice of a setting looks at.

    Attributes
    ----------
    job
        What is to be imaged.
    engine
        The one that a person asks for; None: any.
    options
        Engine → option → value that a person asks for.
    pulse_blocks
        Asked for; None: as few as fit.
    where
        Section of the config that asks, for messages.
    """

    job: Job
    engine: str | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pulse_blocks: int | None = None
    where: str = "processing"

    @property
    def content_db(self) -> float:
        """How much more errors may weigh at the scene's pixels than at those of a flat, incoherent one."""
        return UNSEEN_DB if self.job.content_db is None else max(0.0, self.job.content_db)

    @property
    def tile_seconds(self) -> float:
        """What tiles cost apart from their sums: placing pixels, and writing."""
        return self.job.pixels * _PLACE_S[self.job.frame] + self.job.tiles * _TILE_S

    def cheapest(self, pulses: int, target_db: float) -> Setting:
        """Return the cheapest setting that meets the target, or the best there is.

        What the content may cost is paid for as long as it is cheap: beyond that the certificate decides, and tiles
        that need it are formed again.

        Raises
        ------
        CampaignError
            If the engine asked for cannot run here.
        """
        options = self.settings(pulses)
        exact = [setting for setting in options if setting.error_db <= target_db]
        if not exact:
            return min(options, key=lambda setting: setting.error_db)
        near = [setting for setting in exact if setting.seconds <= NEAR * exact[0].seconds]
        sure = (setting for setting in near if setting.error_db <= target_db - self.content_db)
        chosen = next(sure, min(near, key=lambda setting: setting.error_db))
        equal = (setting for setting in exact if setting.seconds <= EQUAL * chosen.seconds)
        return min(equal, key=lambda setting: setting.error_db)

    def settings(self, pulses: int) -> list[Setting]:
        """Return every setting that can run here and that what is asked for leaves, cheapest first.

        Of equal costs the most exact comes first. Placing pixels and writing tiles is in `form_seconds`.

        Raises
        ------
        CampaignError
            If the engine asked for cannot run here, or cannot form this image.
        """
        options = [
            replace(setting, form_seconds=setting.form_seconds + self.tile_seconds)
            for name in self._engines()
            for setting in load_engine(name).candidates(self.job, pulses=pulses, asked=self.options.get(name, {}))
        ]
        if not options:
            able = sorted({setting.engine for setting in replace(self, engine=None, options={}).settings(pulses)})
            weighed = ", whose pulses are weighed by antennas or a sector of the flight" if self.job.weights else ""
            raise self._unfit(f"cannot form this image{weighed}", able)
        return sorted(options, key=lambda setting: (setting.seconds, setting.error_db))

    def fallbacks(self, chosen: Setting) -> tuple[Setting, ...]:
        """Return the cheapest setting per 6 dB gained, whatever was asked for, ending with the double sum."""
        if chosen.engine == "reference":
            return ()
        options = replace(self, engine=None, options={}).settings(len(self.job.aperture))
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
        blocks = pulse_blocks(setting, self.job, presum, asked=self.pulse_blocks)
        more = (blocks - 1) * self.tile_seconds
        return replace(setting, pulse_blocks=blocks, form_seconds=setting.form_seconds + more)

    def decisions(self, chosen: Setting, accuracy_db: float) -> Iterator[Decision]:
        """Yield the choices that make up a setting, with their reasons."""
        asked = {name for name, value in self.options.get(chosen.engine, {}).items() if value is not None}
        met = "meets" if chosen.error_db <= accuracy_db else "does not meet"
        rank = "what was asked for" if asked or self.engine else "cheapest of every engine and setting, to 5 %"
        why = "asked for; " if self.engine else ""
        yield Decision("engine", chosen.engine, f"{why}{rank}, {met} {accuracy_db:.0f} dB", chosen.error_db)
        for name, reason in chosen.reasons.items():
            why = "asked for; " if name in asked else ""
            yield Decision(name, chosen.all_options[name], why + reason)

    def _engines(self) -> list[str]:
        """Return the engines that can run here and that what is asked for leaves; untimed ones where they are named.

        Seconds that nobody has measured are no reason to prefer an engine.
        """
        reads = {"profiles", "phase_history"} if self.job.recorded else {"profiles"}
        runnable = [name for name in ENGINES if load_engine(name).available() and load_engine(name).READS in reads]
        if self.engine is not None and self.engine not in runnable:
            engine = load_engine(self.engine)
            what = (
                "cannot run here" if engine.READS in reads else f"reads the {engine.READS.replace('_', ' ')}: none here"
            )
            needs = getattr(engine, "NEEDS", None)
            raise self._unfit(what, runnable, f"It needs {needs}. " if needs and engine.READS in reads else "")
        if self.engine is not None:
            return [self.engine]
        stated = [name for name in runnable if any(v is not None for v in self.options.get(name, {}).values())]
        return stated or [name for name in runnable if getattr(load_engine(name), "TIMED", True)]

    def _unfit(self, what: str, others: list[str], remedy: str = "") -> CampaignError:
        return CampaignError(
            f"engine {self.engine or ', '.join(self._engines())} {what}",
            where=f"{self.where}.engine",
            expected=f"an engine that can: {', '.join(others)}",
            remedy=f"{remedy}Choose one of these, or auto.",
        )
