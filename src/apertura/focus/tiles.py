"""An image as a dask array whose chunks are the tiles of its grid: computed when asked for, each tile on its own."""

from collections.abc import Collection, Sequence
from functools import partial
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.contracts import Window
from apertura.focus.engines import load_engine
from apertura.focus.engines.engine import Setting
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.focus.presum import Presum, presummed
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import Terrain

if TYPE_CHECKING:
    from dask.array.core import Array


def image_array(
    inputs: PhaseHistory | Profiles,
    setting: Setting,
    grid: SceneGrid,
    terrain: Terrain,
    *,
    side_px: int,
    beams: Beams | None = None,
    presum: tuple[Presum, NDArray[np.float64]] | None = None,
) -> "Array":
    """Return an image, the mean over the pulses, as a dask array whose chunks are square tiles.

    Tables are prepared once per block of pulses and shared by all tiles; with several blocks each one's tables are
    prepared when the tiles of the block before are done, so that one block's tables are held at a time. A tile is the
    same to the bit whichever others are computed, in whatever order, by threads, processes or a cluster.

    Parameters
    ----------
    inputs
        What the setting's engine reads.
    setting
        Engine, options, and into how many blocks pulses are split.
    grid, terrain
        The scene; pixels lie on the terrain.
    side_px
        Of a tile, a multiple of 16 pixels.
    beams
        Weight of each pulse at each pixel by its antennas; none by default.
    presum
        Low-pass sum over pulses and the point (3,) they are aligned to, metres; none by default.

    Returns
    -------
    dask.array.Array
        (row, column) complex64; 1 is the amplitude of an echo seen by every pulse.
    """
    from dask.array.core import Array
    from dask.highlevelgraph import HighLevelGraph

    from apertura.focus.layer import TilesLayer

    name = f"image-{uuid4().hex}"
    graph = partial(_graph, name, inputs, setting, grid, terrain, side_px, beams, presum)
    chunks = tuple(tuple(min(side_px, size - at) for at in range(0, size, side_px)) for size in grid.shape)
    places = product(range(len(chunks[0])), range(len(chunks[1])))
    return Array(HighLevelGraph({name: TilesLayer(name, graph, places)}, {name: set()}), name, chunks, np.complex64)


def _graph(  # noqa: PLR0917
    name: str,
    inputs: PhaseHistory | Profiles,
    setting: Setting,
    grid: SceneGrid,
    terrain: Terrain,
    side_px: int,
    beams: Beams | None,
    presum: tuple[Presum, NDArray[np.float64]] | None,
    places: Collection[tuple[int, int]],
) -> dict[Any, Any]:
    """Return the tasks of the tiles in some rows and columns of tiles, and of what they share."""
    count, pulses = np.float32(len(inputs)), len(inputs) if presum is None else len(presum[0].at)
    ends = [number * pulses // setting.pulse_blocks for number in range(setting.pulse_blocks + 1)]
    graph: dict[Any, Any] = {f"{name}-inputs": inputs}
    before: list[Any] = []  # what must be done before the next block's tables are prepared
    for number, block in enumerate(slice(*pair) for pair in pairwise(ends)):
        tables, last = f"{name}-tables-{number}", block.stop == pulses
        graph[tables] = (partial(_prepare, setting, presum, block), f"{name}-inputs", before)
        before = []
        for place in places:
            rows, columns = (slice(at * side_px, (at + 1) * side_px) for at in place)
            form = partial(_form, setting, grid[rows, columns], terrain, beams and beams[block], count)
            sum_before = (f"{name}-{number - 1}", *place) if number else None
            key = (name if last else f"{name}-{number}", *place)
            graph[key] = (form, tables, sum_before)
            graph[f"{name}-done-{number}", *place] = (_nothing, key)
            before.append((f"{name}-done-{number}", *place))
    return graph


def _prepare(
    setting: Setting,
    presum: tuple[Presum, NDArray[np.float64]] | None,
    block: slice,
    inputs: PhaseHistory | Profiles,
    _before: list[None],
) -> Any:
    """Return what all tiles share of a block of pulses."""
    if presum is not None and isinstance(inputs, Profiles):
        inputs = presummed(inputs, *presum)
    return load_engine(setting.engine).prepare(inputs[block], **setting.options)


def _form(  # noqa: PLR0917
    setting: Setting,
    grid: SceneGrid,
    terrain: Terrain,
    beams: Beams | None,
    count: np.float32,
    tables: Any,
    sum_before: NDArray[np.complex64] | None,
) -> NDArray[np.complex64]:
    """Return one tile of the image of a block of pulses, added to that of the blocks before."""
    image = load_engine(setting.engine).form(tables, terrain.positions(grid), beams=beams, **setting.form_options)
    tile = np.asarray(image / count, np.complex64)
    return tile if sum_before is None else sum_before + tile


def _nothing(_done: Any) -> None:
    """Return None once a tile is done."""


def compute_tiles(
    image: "Array",
    windows: Sequence[Window],
    target: Any,
    *,
    threads: int,
    scheduler: str = "threads",
    seconds_between_reports: float = 0.1,
) -> None:
    """Compute some tiles of an image and write each as soon as it is done.

    Parameters
    ----------
    image
        From `image_array`.
    windows
        Tiles to compute: windows of chunks of the array.
    target
        (y, x) array that takes blocks: numpy or zarr.
    threads
        How many tiles are in work at once; the memory of pixel positions and results is theirs alone.
    scheduler
        'threads', or the address of a `distributed` scheduler whose workers form the tiles: the same bits.
    seconds_between_reports
        How often the progress bar is redrawn.

    Examples
    --------
    >>> import dask.array
    >>> target = np.zeros((4, 6))
    >>> compute_tiles(dask.array.ones((4, 6), chunks=2), [(slice(0, 2), slice(4, 6))], target, threads=1)
    [...
    >>> target.sum()
    np.float64(4.0)
    """
    from dask.diagnostics.progress import ProgressBar
    from dask.threaded import get

    places = [
        {int(end - size): at for at, (end, size) in enumerate(zip(np.cumsum(sizes), sizes, strict=True))}
        for sizes in image.chunks
    ]
    keys = [
        (image.name, *(place[part.start] for place, part in zip(places, window, strict=True))) for window in windows
    ]
    graph = image.dask.cull(set(keys))
    if scheduler != "threads":
        from apertura.focus.cluster import formed_elsewhere

        for number, tile in formed_elsewhere(graph, keys, scheduler):
            target[windows[number]] = tile
        return
    written = {
        ("written", *key): (partial(_write, target, window), key) for key, window in zip(keys, windows, strict=True)
    }
    with ProgressBar(dt=seconds_between_reports):
        get({**graph, **written}, list(written), num_workers=threads)


def _write(target: Any, window: Window, tile: NDArray[np.complex64]) -> None:
    """Write one tile where it belongs."""
    target[window] = tile
