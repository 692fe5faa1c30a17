"""config/flights.tsv: one line per flight."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from apertura.common.errors import CampaignError, quoted
from apertura.pipeline.config.config import CONFIG
from apertura.pipeline.config.section import Name
from apertura.pipeline.config.table import table_rows

FLIGHTS = Path("config/flights.tsv")
_COLUMNS = ["flight", "kind", "transmitter", "nodes"]
_NAME: TypeAdapter[str] = TypeAdapter(Name)


@dataclass(frozen=True)
class Flight:
    """One line of flights.tsv."""

    name: str
    kind: str
    transmitter: str
    nodes: tuple[str, ...]

    @property
    def participants(self) -> tuple[str, ...]:
        """The transmitter and then the receivers, each once.

        Examples
        --------
        >>> Flight("f01", "image", "a", ("b", "a")).participants
        ('a', 'b')
        """
        return tuple(dict.fromkeys((self.transmitter, *self.nodes)))

    @property
    def pairs(self) -> tuple[str, ...]:
        """Transmitter-receiver names, as folders are named."""
        return tuple(f"{self.transmitter}-{node}" for node in self.nodes)


def read_flights(path: Path, *, nodes: Collection[str]) -> Iterator[Flight]:
    """Yield the flights of a flights.tsv.

    Parameters
    ----------
    path
        Tab-separated, columns flight, kind, transmitter, nodes.
    nodes
        Names that the config knows.

    Raises
    ------
    CampaignError
        Naming file and line.
    """
    seen: set[str] = set()
    for where, cells in table_rows(path, _COLUMNS, remedy="Write one line per flight."):
        flight = _flight(cells, nodes, where=where)
        if flight.name in seen:
            raise CampaignError(
                f"flight {flight.name} a second time",
                where=where,
                expected="each flight once",
                remedy="Join the lines or rename one flight.",
            )
        seen.add(flight.name)
        yield flight
    if not seen:
        raise CampaignError("no flights", where=path, expected="at least one line", remedy="Add a flight.")


def _flight(cells: dict[str, str], known: Collection[str], *, where: str) -> Flight:
    nodes = tuple(name.strip() for name in cells["nodes"].split(",") if name.strip())
    problem = None
    try:
        _NAME.validate_python(cells["flight"])
    except ValidationError as error:
        problem = error.errors()[0]["msg"].removeprefix("Value error, ")
    if cells["kind"] not in {"image", "calibration"}:
        problem = f"kind {quoted(cells['kind'])} is neither image nor calibration"
    unknown = [name for name in (cells["transmitter"], *nodes) if name not in known]
    if unknown:
        problem = f"node {quoted(unknown[0])} is not in {CONFIG}: nodes"
    if not nodes or len(set(nodes)) != len(nodes):
        problem = f"nodes {quoted(cells['nodes'])} are none or doubled"
    if problem:
        raise CampaignError(
            problem,
            where=where,
            expected=f"flight, image|calibration, a transmitter and nodes among {sorted(known)}",
            remedy="Correct the line.",
        )
    return Flight(cells["flight"], cells["kind"], cells["transmitter"], nodes)
