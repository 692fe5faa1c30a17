"""What a flight log cannot say of itself, and the config says for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

TimeSystem = Literal["utc", "gpst"]


@dataclass(frozen=True)
class LogOptions:
    """How a log is to be read where it leaves that open; what it says itself is never overruled.

    Attributes
    ----------
    format
        A key of `TRACKS`; None: by suffix and heading.
    time_system
        Of its times; None: the log says, or is refused.
    start_utc
        Time zero of a log that counts from its own beginning, or the day of one that writes times of day only:
        ISO 8601, UTC; None: the log says, or is refused.
    columns
        Name of a column of ours → name in the log, for CSV.
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
    base: tuple[float, float, float] | None = None
    body: str | None = None
    height_offset_m: float | None = None


AS_IT_SAYS = LogOptions()
"""Of a log that says everything itself."""
