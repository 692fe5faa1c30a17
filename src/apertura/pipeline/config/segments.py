"""config/segments.tsv: which part of the track images a pair; without the file, all of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from apertura.common.errors import CampaignError, quoted
from apertura.pipeline.config.flights import FLIGHTS, Flight
from apertura.pipeline.config.table import table_rows

SEGMENTS = Path("config/segments.tsv")
_FIRST_YEAR, _LAST_YEAR = 1980, 2199
_COLUMNS = ["flight", "pair", "start", "end"]


@dataclass(frozen=True)
class Segment:
    """One line of segments.tsv: pulses from start to end, both included, image the pair.

    Attributes
    ----------
    start, end
        UTC, ISO 8601 without time zone, on the transmitter's time tags.
    """

    flight: str
    pair: str
    start: str
    end: str


def read_segments(path: Path, *, flights: Sequence[Flight]) -> Iterator[Segment]:
    """Yield the lines of a segments.tsv; none where there is no such file.

    Parameters
    ----------
    path
        Tab-separated, columns flight, pair, start, end; several lines of a pair are all used.
    flights
        Those of flights.tsv.

    Raises
    ------
    CampaignError
        Naming file and line.
    """
    if not path.is_file():
        return
    pairs = {flight.name: flight.pairs for flight in flights}
    for where, cells in table_rows(path, _COLUMNS, remedy="Write one line per segment."):
        problem, expected = None, "flight, pair, start and end in UTC such as 2025-05-14T09:30:00.5"
        if cells["flight"] not in pairs:
            problem, expected = f"flight {quoted(cells['flight'])} is not in {FLIGHTS}", f"one of {', '.join(pairs)}"
        elif cells["pair"] not in pairs[cells["flight"]]:
            problem = f"flight {cells['flight']} has no pair {quoted(cells['pair'])}"
            expected = f"one of {', '.join(pairs[cells['flight']])}"
        start, end = (_utc(cells[name]) for name in ("start", "end"))
        for name, time in (("start", start), ("end", end)):
            if not problem and time is None:
                problem = f"{name} {quoted(cells[name])} is no time"
        if not problem and start is not None and end is not None and start >= end:
            problem, expected = f"start {cells['start']} is not before end {cells['end']}", "a start before its end"
        if problem or start is None or end is None:
            raise CampaignError(str(problem), where=where, expected=expected, remedy="Correct the line.")
        yield Segment(cells["flight"], cells["pair"], start.isoformat(), end.isoformat())


def _utc(text: str) -> datetime | None:
    """Return a time in UTC; one without time zone is UTC already. None if the text is no time."""
    try:
        time = datetime.fromisoformat(text)
        time = time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
    except (ValueError, OverflowError):
        return None
    return time if _FIRST_YEAR <= time.year <= _LAST_YEAR else None
