"""A campaign's config files, each read whatever is wrong with the others."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import (
    CLOCKS,
    CONFIG,
    FLIGHTS,
    SEGMENTS,
    Flight,
    read_clocks,
    read_flights,
    read_segments,
    read_settings,
)
from apertura.pipeline.config.section import table_rows

T = TypeVar("T")


class _AnyNode(frozenset[str]):
    """Stands for the nodes of a config that cannot be read: a flight may name any."""

    def __contains__(self, _: object) -> bool:
        return True


def load(root: Path) -> tuple[Campaign | None, list[CampaignError]]:
    """Return a campaign, or None and what is wrong with config.yaml and its tables, each by itself.

    Examples
    --------
    >>> load(Path("nowhere"))[0] is None
    True
    """
    if not root.is_dir():
        remedy = "`apertura init` makes one."
        return None, [CampaignError("no such folder", where=root, expected="a campaign folder", remedy=remedy)]
    found: list[CampaignError] = []
    settings = _tried(lambda: read_settings(_inside(root, CONFIG)), found)
    nodes = settings.nodes if settings else _AnyNode()
    flights = _tried(lambda: tuple(read_flights(_inside(root, FLIGHTS), nodes=nodes)), found)
    named = _named_flights(root / FLIGHTS) if flights is None else flights
    segments = _tried(lambda: tuple(read_segments(_inside(root, SEGMENTS), flights=named)), found) if named else ()
    clocks = _tried(lambda: tuple(read_clocks(_inside(root, CLOCKS), flights=named)), found) if named else ()
    if settings is None or flights is None or segments is None or clocks is None:
        return None, found
    return Campaign(root, settings, flights, segments, clocks), found


def _inside(root: Path, path: Path) -> Path:
    return inside(root, path.as_posix(), where=root)


def _tried(read: Callable[[], T], found: list[CampaignError]) -> T | None:
    try:
        return read()
    except CampaignError as problem:
        found.append(problem)
        return None


def _named_flights(path: Path) -> tuple[Flight, ...]:
    """Return the flights of a table with a line that is wrong, as it names them, so that segments are compared."""
    rows = _tried(
        lambda: [cells for _, cells in table_rows(path, ["flight", "kind", "transmitter", "nodes"], remedy="")], []
    )
    return tuple(
        Flight(row["flight"], row["kind"], row["transmitter"], tuple(map(str.strip, row["nodes"].split(","))))
        for row in rows or ()
    )
