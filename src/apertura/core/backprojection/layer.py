"""dask graph of the requested tiles, in a separate module so that importing `tiles` does not load dask."""

from collections.abc import Callable, Collection, Iterable
from typing import Any

from dask.highlevelgraph import MaterializedLayer

Place = tuple[int, int]


class TilesLayer(MaterializedLayer):
    """Tasks of the requested tiles of an image.

    Pulse blocks are processed in sequence: the tables of a block are prepared after the previous block has been added
    to every tile. With these dependencies, dask would compute all tiles to obtain a single tile. This graph therefore
    contains only the requested tiles.

    Parameters
    ----------
    name
        Name of the array.
    graph
        Function of the rows and columns of tiles that returns key → task.
    places
        Row and column of every tile.

    Attributes
    ----------
    origin
        Inputs of the image, for its quality assessment; None in the graph sent to a scheduler.
    """

    def __init__(self, name: str, graph: Callable[[Collection[Place]], dict[Any, Any]], places: Iterable[Place]):
        self.name, self.graph, self.places = name, graph, list(places)
        self.origin: Any = None
        super().__init__(graph(self.places))

    def cull(self, keys: set[Any], all_hlg_keys: Collection[Any]) -> tuple[MaterializedLayer, dict[Any, set[Any]]]:
        """Return the layer of those tiles that are among the keys, and the dependencies of the tasks of this layer."""
        places = [place for place in self.places if (self.name, *place) in keys]
        requested = TilesLayer(self.name, self.graph, places)
        return requested, {key: requested.get_dependencies(key, all_hlg_keys) for key in requested}
