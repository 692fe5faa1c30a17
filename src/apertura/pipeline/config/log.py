"""Section `nodes.<n>.log`: what a flight log cannot say of itself."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from apertura.formats.names import TRACKS
from apertura.formats.tracks.log_options import LogOptions
from apertura.pipeline.config.section import Section

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=360)]
Cell = Annotated[str, Field(min_length=1, max_length=200)]


class Log(Section):
    """How a flight log is to be read where it leaves that open."""

    format: str | None = Field(None, description=f"one of {', '.join(TRACKS)}; null: by the file's suffix and heading")
    time_system: Literal["utc", "gpst"] | None = Field(
        None, description="of times whose log does not say whether they are utc or gpst, which is ahead by leap seconds"
    )
    start_utc: str | None = Field(
        None,
        description="time zero of a log that counts from its beginning, or the day of one that writes times of day "
        "only, ISO 8601 in UTC",
    )
    columns: dict[Cell, Cell] = Field(
        default_factory=dict, description="column that apertura reads → its name in a CSV log"
    )
    base: tuple[Latitude, Longitude, float] | None = Field(
        None, description="where baselines begin: latitude, longitude (deg), ellipsoidal height (m), WGS 84"
    )
    body: str | None = Field(None, description="which rigid body or device, where the log holds several")
    height_offset_m: float | None = Field(
        None, description="to be added to logged heights to give ellipsoidal ones, where the log has others, m"
    )
    longest_gap_s: float | None = Field(
        None, gt=0, description="pulses in longer gaps between epochs are left out, s; null: where a spline may err"
    )
    smoothing_m: float | None = Field(
        None, gt=0, description="noise of logged positions that a smoothing spline takes off, m; null: none is"
    )

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str | None) -> str | None:
        if name is not None and name not in TRACKS:
            raise ValueError(f"no such format; choose {', '.join(TRACKS)}")
        return name

    @property
    def options(self) -> LogOptions:
        """As readers take them."""
        read = self.model_dump(exclude={"longest_gap_s", "smoothing_m"})
        return LogOptions(**read)
