"""config/clocks.tsv: what the clock of a recorder is behind that of its node's log; without the file, nothing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

from apertura.common.errors import CampaignError, quoted
from apertura.pipeline.config.flights import FLIGHTS, Flight
from apertura.pipeline.config.table import table_rows

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CLOCKS = Path("config/clocks.tsv")
CLOCK_COLUMNS = ["flight", "node", "offset_s", "drift_ppm", "std_s"]
_FARTHEST_S, _LARGEST_PPM = Decimal(5_000_000_000), Decimal(1000)
_EXPECTED = "flight, node, seconds to add to the recorder's time, ppm by which it runs slow, standard deviation in s"


@dataclass(frozen=True)
class Clock:
    """The clock of a node's recorder in one flight, against that of the node's log.

    Attributes
    ----------
    offset_ns
        To be added to the recorder's times, at its first pulse.
    drift_ppm
        By which more is to be added for every second since.
    std_s
        Standard deviation of the offset; None: nobody knows.
    """

    flight: str
    node: str
    offset_ns: int = 0
    drift_ppm: float = 0.0
    std_s: float | None = None

    def utc(self, times: "NDArray[np.datetime64]") -> "NDArray[np.datetime64]":
        """Return times of a recorder as the log's clock has them.

        Parameters
        ----------
        times
            (pulse,) datetime64[ns], ascending, the first of the recording first.

        Examples
        --------
        >>> import numpy as np
        >>> times = np.array(["2025-01-01T00:00:00", "2025-01-01T00:01:40"], "datetime64[ns]")
        >>> (Clock("f01", "uav1", offset_ns=10**9, drift_ppm=10.0).utc(times) - times).astype(int).tolist()
        [1000000000, 1001000000]
        """
        if not times.size:
            return times
        elapsed_ns = (times - times[0]).astype("int64")
        further_ns = self.offset_ns + (elapsed_ns * (self.drift_ppm * 1e-6)).round().astype("int64")
        shifted: NDArray[np.datetime64] = times + further_ns.astype("timedelta64[ns]")
        return shifted


def read_clocks(path: Path, *, flights: Sequence[Flight]) -> Iterator[Clock]:
    """Yield the lines of a clocks.tsv; none where there is no such file.

    Parameters
    ----------
    path
        Tab-separated, columns flight, node, offset_s, drift_ppm, std_s, which the last two may leave empty.
    flights
        Those of flights.tsv.

    Raises
    ------
    CampaignError
        Naming file and line.
    """
    if not path.is_file():
        return
    nodes = {flight.name: flight.participants for flight in flights}
    told: set[tuple[str, str]] = set()
    for where, cells in table_rows(path, CLOCK_COLUMNS, remedy="Write one line per flight and node."):
        flight, node = cells["flight"], cells["node"]
        problem = ""
        if flight not in nodes:
            problem = f"flight {quoted(flight)} is not in {FLIGHTS}"
        elif node not in nodes[flight]:
            problem = f"flight {flight} has no node {quoted(node)}"
        elif (flight, node) in told:
            problem = f"flight {flight}, node {node} a second time"
        if problem:
            raise CampaignError(problem, where=where, expected=_EXPECTED, remedy="Correct the line.")
        told.add((flight, node))
        offset = _number(cells, "offset_s", where, most=_FARTHEST_S) or Decimal(0)
        drift = _number(cells, "drift_ppm", where, most=_LARGEST_PPM) or Decimal(0)
        std = _number(cells, "std_s", where, most=_FARTHEST_S)
        offset_ns = int((offset * 1_000_000_000).to_integral_value())
        yield Clock(flight, node, offset_ns, float(drift), None if std is None else float(abs(std)))


def _number(cells: dict[str, str], name: str, where: str, *, most: Decimal) -> Decimal | None:
    """Return a cell as it is written, to all of its digits; None where it is empty."""
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
        expected=f"a number between -{most} and {most}, or nothing",
        remedy="Correct the line; `apertura align` writes it.",
    )
