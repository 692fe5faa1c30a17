"""Options of image formation, from Python or in section `processing` of a campaign's configuration."""

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from apertura.core.backprojection.engines import ENGINES, PATCH_PX, load_engine


class IntegrationAngle(BaseModel):
    """Integration angle of a straight pass."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    degrees: float = Field(gt=0, le=180, description="integration angle of a straight pass, degrees")


class IntegrationResolution(BaseModel):
    """Integration given by the resolution along the flight."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    resolution_m: float = Field(gt=0, description="required resolution along the flight, m")


PLANNED = ("engine", "engine_options", "presum", "pulse_blocks", "terrain")
"""Options for which 'auto' leaves the decision to the planner."""


def _options_of_each_engine(schema: dict[str, Any]) -> None:
    engines = {name: load_engine(name).Options.model_json_schema() for name in ENGINES}
    schema.update(additionalProperties=False, properties=engines)


class ImagingChoices(BaseModel):
    """Options of image formation; each has a default.

    Examples
    --------
    >>> ImagingChoices(accuracy_db=-40).planned["presum"]
    'auto'
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    window: Literal["hann", "none"] = Field("hann", description="weighting over the subcarriers")
    accuracy_db: Annotated[float, Field(le=-10, ge=-120)] | Literal["auto"] = Field(
        "auto",
        description="requested numerical error of the image, dB; auto: 10 dB below the largest other error, limited to "
        "-60 … -40 dB",
    )
    engine: str = Field(
        "auto",
        description=f"backprojection engine: auto, {', '.join(ENGINES)}",
        json_schema_extra={"enum": ["auto", *ENGINES]},
    )
    engine_options: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="engine options that override the planner: engine → option → value",
        examples=[{}],
        json_schema_extra=_options_of_each_engine,
    )
    tile_px: int = Field(256, ge=PATCH_PX, multiple_of=PATCH_PX, description="side of a tile, pixels")
    presum: Annotated[int, Field(ge=1, le=64)] | Literal["auto"] = Field(
        "auto", description="presumming factor, for oversampled apertures; 1: no presumming"
    )
    pulse_blocks: Annotated[int, Field(ge=1, le=1024)] | Literal["auto"] = Field(
        "auto",
        description="number of pulse blocks that are processed one after the other to limit memory use; 1: all pulses "
        "at once",
    )
    integration: Literal["auto", "all"] | IntegrationAngle | IntegrationResolution = Field(
        "auto",
        description="integration angle of a pixel: auto (the finest resolution that the pixel spacing can represent), "
        "all (all pulses), {degrees: x} of a straight pass, or {resolution_m: x} along the track",
    )
    terrain: Literal["auto", "plane", "tilted_plane", "dem"] = Field(
        "auto", description="terrain model; auto: the simplest model that preserves focus and position"
    )

    @property
    def planned(self) -> dict[str, Any]:
        """Overrides of the planner: option → value."""
        return {name: getattr(self, name) for name in PLANNED}

    @property
    def integrated(self) -> Any:
        """Requested integration: 'auto', 'all', or a mapping."""
        return self.integration if isinstance(self.integration, str) else self.integration.model_dump()

    @field_validator("engine")
    @classmethod
    def _engine_is_known(cls, name: str) -> str:
        if name not in {"auto", *ENGINES}:
            raise ValueError(f"unknown engine; choose auto, {', '.join(ENGINES)}")
        return name

    @model_validator(mode="after")
    def _options_are_those_of_engines(self) -> Self:
        for name, options in self.engine_options.items():
            if name not in ENGINES:
                raise ValueError(f"engine_options.{name}: unknown engine; choose {', '.join(ENGINES)}")
            try:
                load_engine(name).Options.model_validate(options)
            except ValidationError as error:
                first = error.errors()[0]
                known = ", ".join(load_engine(name).Options.model_fields) or "none"
                option = ".".join(map(str, first["loc"]))
                line = f"engine_options.{name}.{option}: {first['msg']} (options of {name}: {known})"
                raise ValueError(line) from error
        return self
