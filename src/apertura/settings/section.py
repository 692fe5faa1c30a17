"""What every section of the config is."""

from pydantic import BaseModel, ConfigDict

Metres3 = tuple[float, float, float]


class Section(BaseModel):
    """A part of the config; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
