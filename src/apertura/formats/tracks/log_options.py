"""Options of a flight log: values that are missing in the log and stated in the config."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

TimeSystem = Literal["utc", "gpst"]
QualityNumbers = Literal["rtklib", "gga"]


@dataclass(frozen=True)
class LogOptions:
    """Configured values for information that a log does not contain; information in the log is never overridden.

    Attributes
    ----------
    format
        A key of `TRACKS`; None: determined from the suffix and the first bytes.
    time_system
        Time system of the log; None: the log must state it.
    start_utc
        Time zero of a log with relative times, or date of a log with times of day only: ISO 8601, UTC; None: the log
        must state it.
    columns
        Standard column name → name in the log, for CSV.
    scales
        Standard column name → factor applied to its numbers, for CSV; default 1.
    quality
        Numbering of solution types in a CSV log: RTKLIB's Q (1 fix, 2 float, 5 single) or NMEA GGA (4 fix, 5 float,
        1 single); None: the log must contain names.
    base
        WGS 84 latitude (deg), longitude (deg) and ellipsoidal height (m) of the base station of logged baselines.
    body
        Rigid body of a motion capture, or device of a log with several devices.
    height_offset_m
        Offset to be added to logged heights to obtain ellipsoidal heights; None: logged heights must be ellipsoidal.
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


DEFAULT_OPTIONS = LogOptions()
"""Default options, for a log that contains all information."""
