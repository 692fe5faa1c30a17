"""The planner's desk: what lies before every decision, and the setting that is cheapest there."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from apertura.errors import CampaignError
from apertura.focus.presum import Presum
from apertura.planning.candidates import Setting, candidates
from apertura.planning.cost import Costs, tile_seconds
from apertura.planning.memory import blocked
from apertura.planning.plan import Job
from apertura.planning.view import View

UNSEEN_DB = 3.0
"""And this much further before the echo is there: at random pixels of a sparse scene errors weigh more."""

NEAR = 1.3
"""A setting that costs no more than this times the cheapest is near it."""

ALIKE = 1.05
"""And one that costs no more than this times the chosen is as cheap: the most exact of them is taken."""


@dataclass(frozen=True)
class Desk:
    """What every decision looks at.

    Attributes
    ----------
    job, view, costs
        What is to be imaged, how the scene is seen, what work costs.
    asked
        Choice → value that a person asks for.
    """

    job: Job
    view: View
    costs: Costs
    asked: Mapping[str, Any]

    @property
    def content_db(self) -> float:
        """How much more errors may weigh at the scene's pixels than at those of a flat, incoherent one."""
        return UNSEEN_DB if self.job.content_db is None else max(0.0, self.job.content_db)

    def cheapest(self, pulses: int, target_db: float) -> Setting:
        """Return the cheapest setting that meets the target, or the best there is.

        What the content may cost is paid for as long as it is cheap: beyond that the certificate decides, and tiles
        that need it are redone.
        """
        load = replace(self.job.load, pulses=pulses)
        options = candidates(self.view, self.job.signal, load, self.costs, asked=self.asked)
        if not options:
            raise CampaignError(
                f"engine {self.asked.get('engine')} was not built when apertura was installed",
                where="config/config.yaml: processing.engine",
                expected="an engine that can run here",
                remedy="Install with a C++ compiler, or choose another engine.",
            )
        exact = [setting for setting in options if setting.error_db <= target_db]
        if not exact:
            return min(options, key=lambda setting: setting.error_db)
        near = [setting for setting in exact if setting.seconds <= NEAR * exact[0].seconds]
        sure = (setting for setting in near if setting.error_db <= target_db - self.content_db)
        chosen = next(sure, min(near, key=lambda setting: setting.error_db))
        alike = (setting for setting in exact if setting.seconds <= ALIKE * chosen.seconds)
        return min(alike, key=lambda setting: setting.error_db)

    def ladder(self, error_db: float, engine: str) -> tuple[Setting, ...]:
        """Return per 6 dB gained the cheapest setting, ending with the reference."""
        options = candidates(self.view, self.job.signal, self.job.load, self.costs)
        rungs: list[Setting] = []
        while error_db > -130:
            better = [s for s in options if s.error_db <= error_db - 6 and s.engine != "reference"]
            if not better or engine == "reference":
                break
            rungs.append(better[0])
            error_db = better[0].error_db
        last = [setting for setting in options if setting.engine == "reference" and engine != "reference"]
        return (*(self.fitted(rung, None) for rung in rungs), *last)

    def fitted(self, setting: Setting, presum: Presum | None) -> Setting:
        """Return the setting in as many pulse blocks as fit into memory; each one places the tiles anew."""
        found = blocked(setting, self.job, presum, asked=self.asked.get("pulse_blocks"))
        return replace(
            found, seconds=found.seconds + (found.pulse_blocks - 1) * tile_seconds(self.costs, self.job.load)
        )
