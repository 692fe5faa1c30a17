"""Tables of the config: flights.tsv, segments.tsv and clocks.tsv."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from apertura.campaign.config.config import CONFIG
from apertura.campaign.config.section import Name, table_rows
from apertura.common.errors import CampaignError, quoted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


# ---- config/flights.tsv: one line per flight -----------------------------------------------------------------------

FLIGHTS = Path("config/flights.tsv")
_COLUMNS = ["flight", "kind", "transmitter", "nodes"]
KINDS = ("bench", "calibration", "image")
"""Kinds of flights: recording of a stationary radar; calibration flight past a reflector; imaging flight."""
_NAME: TypeAdapter[str] = TypeAdapter(Name)

FUSED = "fused"
"""Name of the sums of the pairs of a flight, used as image name and as folder name."""


@dataclass(frozen=True)
class Flight:
    """Line of flights.tsv."""

    name: str
    kind: str
    transmitter: str
    nodes: tuple[str, ...]

    @property
    def participants(self) -> tuple[str, ...]:
        """Transmitter and receivers, without repetition.

        Examples
        --------
        >>> Flight("f01", "image", "a", ("b", "a")).participants
        ('a', 'b')
        """
        return tuple(dict.fromkeys((self.transmitter, *self.nodes)))

    @property
    def recorded(self) -> tuple[str, ...]:
        """Nodes with a recording: all participants, or the receivers of a bench measurement.

        Examples
        --------
        >>> Flight("f01", "image", "a", ("b",)).recorded, Flight("b01", "bench", "a", ("b",)).recorded
        (('a', 'b'), ('b',))
        """
        return self.nodes if self.kind == "bench" else self.participants

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of the pairs, transmitter-receiver, which are also folder names."""
        return tuple(f"{self.transmitter}-{node}" for node in self.nodes)

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images of the flight: the pairs, and 'fused' if there are several pairs.

        Examples
        --------
        >>> Flight("f01", "image", "a", ("a", "b")).images, Flight("f02", "image", "a", ("b",)).images
        (('a-a', 'a-b', 'fused'), ('a-b',))
        """
        return (*self.pairs, FUSED) if len(self.pairs) > 1 else self.pairs


def is_monostatic(pair: str) -> bool:
    """Return True if one node of a pair transmits and receives."""
    transmitter, receiver = pair.split("-")
    return transmitter == receiver


def read_flights(path: Path, *, nodes: Collection[str]) -> Iterator[Flight]:
    """Yield the flights of flights.tsv.

    Parameters
    ----------
    path
        Tab-separated table with columns flight, kind, transmitter, nodes.
    nodes
        Names of the configured nodes.

    Raises
    ------
    CampaignError
        If a line is invalid; the message contains file and line.
    """
    names: set[str] = set()
    for where, cells in table_rows(path, _COLUMNS, remedy="Write one line per flight."):
        flight = _flight(cells, nodes, where=where)
        if flight.name in names:
            raise CampaignError(
                f"a second line for flight {flight.name}",
                where=where,
                expected="one line per flight",
                remedy="Join the lines, or rename one of the flights.",
            )
        names.add(flight.name)
        yield flight
    if not names:
        raise CampaignError("no flights", where=path, expected="at least one line", remedy="Add a flight.")


def _flight(cells: dict[str, str], known: Collection[str], *, where: str) -> Flight:
    nodes = tuple(name.strip() for name in cells["nodes"].split(",") if name.strip())
    problem = None
    try:
        _NAME.validate_python(cells["flight"])
    except ValidationError as error:
        problem = error.errors()[0]["msg"].removeprefix("Value error, ")
    if cells["kind"] not in KINDS:
        problem = f"unknown kind {quoted(cells['kind'])}, not one of {', '.join(KINDS)}"
    unknown = [name for name in (cells["transmitter"], *nodes) if name not in known]
    if unknown:
        problem = f"node {quoted(unknown[0])} is not in {CONFIG}: nodes"
    if not nodes or len(set(nodes)) != len(nodes):
        problem = f"the list of nodes {quoted(cells['nodes'])} is empty or contains duplicates"
    if problem:
        raise CampaignError(
            problem,
            where=where,
            expected=f"flight, {'|'.join(KINDS)}, and a transmitter and nodes from {sorted(known)}",
            remedy="Correct the line.",
        )
    return Flight(cells["flight"], cells["kind"], cells["transmitter"], nodes)


# ---- config/segments.tsv: track segments that image a pair -----------------------------------------------------------

SEGMENTS = Path("config/segments.tsv")
_FIRST_YEAR, _LAST_YEAR = 1980, 2199
_SEGMENT_COLUMNS = ["flight", "pair", "start", "end"]


@dataclass(frozen=True)
class Segment:
    """Line of segments.tsv: the image of the pair is formed from the pulses from start to end, inclusive.

    Attributes
    ----------
    start, end
        UTC, ISO 8601 without time zone; compared with the transmitter's time tags.
    """

    flight: str
    pair: str
    start: str
    end: str


def read_segments(path: Path, *, flights: Sequence[Flight]) -> Iterator[Segment]:
    """Yield the lines of segments.tsv; yield nothing if the file is missing.

    Parameters
    ----------
    path
        Tab-separated table with columns flight, pair, start, end; a pair may have several lines.
    flights
        Flights of flights.tsv.

    Raises
    ------
    CampaignError
        If a line is invalid; the message contains file and line.
    """
    if not path.is_file():
        return
    pairs = {flight.name: flight.pairs for flight in flights}
    for where, cells in table_rows(path, _SEGMENT_COLUMNS, remedy="Write one line per segment."):
        problem, expected = None, "flight, pair, start and end in UTC such as 2025-05-14T09:30:00.5"
        if cells["flight"] not in pairs:
            problem, expected = f"flight {quoted(cells['flight'])} is not in {FLIGHTS}", f"one of {', '.join(pairs)}"
        elif cells["pair"] not in pairs[cells["flight"]]:
            problem = f"flight {cells['flight']} has no pair {quoted(cells['pair'])}"
            expected = f"one of {', '.join(pairs[cells['flight']])}"
        start, end = (_utc(cells[name]) for name in ("start", "end"))
        for name, time in (("start", start), ("end", end)):
            if not problem and time is None:
                problem = f"{name} {quoted(cells[name])} is not a valid time"
        if not problem and start is not None and end is not None and start >= end:
            problem, expected = f"start {cells['start']} is not before end {cells['end']}", "a start before the end"
        if problem or start is None or end is None:
            raise CampaignError(str(problem), where=where, expected=expected, remedy="Correct the line.")
        yield Segment(cells["flight"], cells["pair"], start.isoformat(), end.isoformat())


def _utc(text: str) -> datetime | None:
    """Parse a time; a time without time zone is interpreted as UTC; return None if the time is not valid."""
    try:
        time = datetime.fromisoformat(text)
        time = time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
    except (ValueError, OverflowError):
        return None
    return time if _FIRST_YEAR <= time.year <= _LAST_YEAR else None


# ---- config/clocks.tsv: offset and drift of recorders relative to logs -----------------------------------------------

CLOCKS = Path("config/clocks.tsv")
CLOCK_COLUMNS = ["flight", "node", "offset_s", "drift_ppm", "std_s"]
_FARTHEST_S, _LARGEST_PPM = Decimal(5_000_000_000), Decimal(1000)
_EXPECTED = "flight, node, offset to add to the recorder's time in s, drift in ppm, standard deviation in s"


@dataclass(frozen=True)
class ClockRow:
    """Clock of a node's recorder in one flight, relative to the node's log.

    Attributes
    ----------
    offset_ns
        Offset at the first pulse, to be added to the recorder's times.
    drift_ppm
        Rate of change of the offset after the first pulse.
    std_s
        Standard deviation of the offset; None: unknown.
    """

    flight: str
    node: str
    offset_ns: int = 0
    drift_ppm: float = 0.0
    std_s: float | None = None

    def utc(self, times: "NDArray[np.datetime64]") -> "NDArray[np.datetime64]":
        """Convert times of a recorder to the clock of the log.

        Parameters
        ----------
        times
            (pulse,) datetime64[ns], ascending, beginning with the first pulse of the recording.

        Examples
        --------
        >>> import numpy as np
        >>> times = np.array(["2025-01-01T00:00:00", "2025-01-01T00:01:40"], "datetime64[ns]")
        >>> (ClockRow("f01", "uav1", offset_ns=10**9, drift_ppm=10.0).utc(times) - times).astype(int).tolist()
        [1000000000, 1001000000]
        """
        if not times.size:
            return times
        elapsed_ns = (times - times[0]).astype("int64")
        correction_ns = self.offset_ns + (elapsed_ns * (self.drift_ppm * 1e-6)).round().astype("int64")
        shifted: NDArray[np.datetime64] = times + correction_ns.astype("timedelta64[ns]")
        return shifted


def read_clocks(path: Path, *, flights: Sequence[Flight]) -> Iterator[ClockRow]:
    """Yield the lines of clocks.tsv; yield nothing if the file is missing.

    Parameters
    ----------
    path
        Tab-separated table with columns flight, node, offset_s, drift_ppm, std_s; cells of the last two may be empty.
    flights
        Flights of flights.tsv.

    Raises
    ------
    CampaignError
        If a line is invalid; the message contains file and line.
    """
    if not path.is_file():
        return
    nodes = {flight.name: flight.participants for flight in flights}
    stated: set[tuple[str, str]] = set()
    for where, cells in table_rows(path, CLOCK_COLUMNS, remedy="Write one line per flight and node."):
        flight, node = cells["flight"], cells["node"]
        problem = ""
        if flight not in nodes:
            problem = f"flight {quoted(flight)} is not in {FLIGHTS}"
        elif node not in nodes[flight]:
            problem = f"flight {flight} has no node {quoted(node)}"
        elif (flight, node) in stated:
            problem = f"a second line for flight {flight}, node {node}"
        if problem:
            raise CampaignError(problem, where=where, expected=_EXPECTED, remedy="Correct the line.")
        stated.add((flight, node))
        offset = _number(cells, "offset_s", where, most=_FARTHEST_S) or Decimal(0)
        drift = _number(cells, "drift_ppm", where, most=_LARGEST_PPM) or Decimal(0)
        std = _number(cells, "std_s", where, most=_FARTHEST_S)
        offset_ns = int((offset * 1_000_000_000).to_integral_value())
        yield ClockRow(flight, node, offset_ns, float(drift), None if std is None else float(abs(std)))


def _number(cells: dict[str, str], name: str, where: str, *, most: Decimal) -> Decimal | None:
    """Return the exact decimal number in a cell; None if the cell is empty."""
    if not cells[name]:
        return None
    try:
        value = Decimal(cells[name])
    except InvalidOperation:
        value = Decimal("nan")
    if value.is_finite() and -most <= value <= most:
        return value
    raise CampaignError(
        f"{name} {quoted(cells[name])}",
        where=where,
        expected=f"a number between -{most} and {most}, or an empty cell",
        remedy="Correct the line, or let `apertura align` write it.",
    )
