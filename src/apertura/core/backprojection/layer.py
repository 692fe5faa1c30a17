"""The graph of requested tiles; apart from `tiles`, whose import does not load dask."""

from collections.abc import Callable, Collection, Iterable
from typing import Any

from dask.highlevelgraph import MaterializedLayer

Place = tuple[int, int]


class TilesLayer(MaterializedLayer):
    """The tasks of some tiles of an image.

    Blocks of pulses follow one another: the next one's tables are prepared when every tile has its part of the last.
    dask would therefore compute all tiles for the sake of one; here the graph has the requested tiles only.

    Parameters
    ----------
    name
        Of the array.
    graph
        Rows and columns of tiles → key → task.
    places
        Row and column of every tile.

    Attributes
    ----------
    origin
        What the image is formed of, for whoever judges it; None in what a scheduler gets.
    """

    def __init__(self, name: str, graph: Callable[[Collection[Place]], dict[Any, Any]], places: Iterable[Place]):
        self.name, self.graph, self.places = name, graph, list(places)
        self.origin: Any = None
        super().__init__(graph(self.places))

    def cull(self, keys: set[Any], all_hlg_keys: Collection[Any]) -> tuple[MaterializedLayer, dict[Any, set[Any]]]:
        """Return the layer of the tiles among the keys, and the dependencies of its tasks."""
        places = [place for place in self.places if (self.name, *place) in keys]
        requested = TilesLayer(self.name, self.graph, places)
        return requested, {key: requested.get_dependencies(key, all_hlg_keys) for key in requested}
