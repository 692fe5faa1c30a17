"""What the planner answers: how an image will be formed, with a reason for each choice."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import Illumination
from apertura.core.focus.engines.engine import Setting
from apertura.core.focus.inputs import Profiles
from apertura.core.focus.job import Integration
from apertura.core.focus.presum import Presum, presummed
from apertura.core.scene.terrain import Terrain


@dataclass(frozen=True)
class Decision:
    """One choice.

    Attributes
    ----------
    name, value
        What was chosen: a key of the config's `processing`, or an option of the engine, where it can be overridden.
    reason
        One line with the numbers.
    error_db
        Error that this choice adds, relative to the full model; None where it adds none.
    """

    name: str
    value: str | int | float | bool
    reason: str
    error_db: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """How an image will be formed.

    Attributes
    ----------
    setting
        Engine and options.
    fallbacks
        Next better settings, for tiles whose certified error is worse than asked; the last one is `reference`.
    decisions
        Every choice with its reason.
    accuracy_db
        The numerical error asked.
    predicted_error_db
        RMS on random pixels: of the setting and of the models.
    predicted_seconds
        Tables and tiles, roughly.
    memory_bytes, disk_bytes
        Peak of the imaging step; what it leaves in the results folder.
    flags
        Limits that the job exceeds: name → what was found, in one line.
    presum, middle_m
        The low-pass sum over pulses, and the point they are aligned to; settings of `fallbacks` go without.
    terrain
        The ground that is imaged on: as it is, a plane through it, or level.
    beams, integration, illumination
        Of the job.
    """

    setting: Setting
    fallbacks: tuple[Setting, ...]
    decisions: tuple[Decision, ...]
    accuracy_db: float
    predicted_error_db: float
    predicted_seconds: float
    memory_bytes: int
    disk_bytes: int
    flags: Mapping[str, str]
    terrain: Terrain
    presum: Presum | None = field(default=None, repr=False)
    middle_m: NDArray[np.float64] | None = field(default=None, repr=False)
    beams: Beams | None = field(default=None, repr=False)
    integration: Integration | None = field(default=None, repr=False)
    illumination: Illumination | None = field(default=None, repr=False)

    @property
    def engine(self) -> str:
        """A key of `ENGINES`."""
        return self.setting.engine

    @property
    def reasons(self) -> dict[str, str]:
        """Choice → value and reason, in one line."""
        return {decision.name: f"{decision.value}: {decision.reason}" for decision in self.decisions}

    @property
    def choices(self) -> dict[str, Any]:
        """Choice → value: all that the image's pixels depend on, and no prediction."""
        return {decision.name: decision.value for decision in self.decisions} | {"ground": self.terrain.spec}

    @property
    def count(self) -> int | None:
        """Pulses that 1 stands for; None: all of them."""
        return None if self.integration is None or self.integration.sector is None else self.integration.count

    @property
    def presumming(self) -> tuple[Presum, NDArray[np.float64]] | None:
        """The low-pass sum over pulses and the point they are aligned to; None: every pulse as it is."""
        return None if self.presum is None or self.middle_m is None else (self.presum, self.middle_m)

    def fallen_back(self, setting: Setting) -> "Plan":
        """Return the plan with one of its fallbacks, which takes every pulse as it is."""
        reason = f"{self.setting.line} missed the accuracy asked on the pixels compared"
        replaced = {"engine", "presum", "pulse_blocks", *self.setting.reasons}
        decisions = (
            Decision("engine", setting.engine, reason, setting.error_db),
            *(Decision(name, setting.all_options[name], why) for name, why in setting.reasons.items()),
            Decision("presum", 1, "a fallback takes every pulse"),
            Decision("pulse_blocks", setting.pulse_blocks, "those of the fallback"),
            *(decision for decision in self.decisions if decision.name not in replaced),
        )
        return replace(
            self,
            setting=setting,
            decisions=decisions,
            predicted_error_db=setting.error_db,
            presum=None,
            middle_m=None,
        )

    def inputs(self, profiles: Profiles) -> Profiles:
        """Return the profiles that the plan's setting is given: the image's sum over pulses stays the same."""
        return profiles if self.presumming is None else presummed(profiles, *self.presumming)
