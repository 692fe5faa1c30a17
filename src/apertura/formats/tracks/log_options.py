"""Options of a flight log: values that the log lacks and the config states."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

TimeSystem = Literal["utc", "gpst"]
QualityNumbers = Literal["rtklib", "gga"]


@dataclass(frozen=True)
class LogOptions:
    """Values for what a log leaves open; those that it states are never overruled.

    Attributes
    ----------
    format
        A key of `TRACKS`; None: by suffix and heading.
    time_system
        Of its times; None: stated by the log, else the log is rejected.
    start_utc
        Time zero of a log that counts from its own beginning, or the day of one that writes times of day only:
        ISO 8601, UTC; None: stated by the log, else the log is rejected.
    columns
        Name of a column of ours → name in the log, for CSV.
    scales
        Name of a column of ours → factor that its numbers are multiplied by, for CSV; missing ones are 1.
    quality
        How kinds of solution are numbered in a CSV log: as RTKLIB's Q (1 fix, 2 float, 5 single) or as in GGA of NMEA
        (4 fix, 5 float, 1 single); None: they are names, or the log is rejected.
    base
        WGS 84 latitude (deg), longitude (deg) and ellipsoidal height (m) of the point that baselines begin at.
    body
        Which rigid body of a motion capture, or which device of a log that holds several.
    height_offset_m
        What is to be added to logged heights to give ellipsoidal ones; None: they are ellipsoidal, or the log is
        refused.
    """

    format: str | None = None
    time_system: TimeSystem | None = None
    start_utc: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, float] = field(default_factory=dict)
    quality: QualityNumbers | None = None
    base: tuple[float, float, float] | None = None
    body: str | None = None
    height_offset_m: float | None = None


AS_IT_SAYS = LogOptions()
"""Of a log that states everything itself."""
