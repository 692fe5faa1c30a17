"""An image as a dask array of tiles: computed on request, each tile on its own, here or by workers of a cluster."""

import os
import sys
import threading
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.common.errors import CampaignError
from apertura.common.progress import progress
from apertura.common.provenance import code_sha256
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.presum import Presum, presummed
from apertura.core.backprojection.reach import Reach, pulse_blocks_of
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

if TYPE_CHECKING:
    from dask.array.core import Array


# ---- Tiles formed by workers of a `distributed` scheduler

KEY = "processing.scheduler"
NAMED_BY = "DASK_SCHEDULER_ADDRESS"
"""Environment variable, dask's own: who connects to a scheduler runs what that sends, and a config is untrusted."""

_CONNECT_S = 5.0  # to wait for a scheduler
_WORKERS_S = 10.0  # to wait for its first worker


def cluster_tiles(
    graph: Any, keys: Sequence[tuple[Any, ...]], scheduler: str
) -> Iterator[tuple[int, NDArray[np.complex64]]]:
    """Yield each tile with its number as soon as a worker has formed it.

    Workers need this package and no file of the campaign: what they read is sent to them, and what they formed comes
    back. Tiles of a lost worker are formed again by the others.

    Parameters
    ----------
    graph, keys
        Tasks of an image of `apertura.core.backprojection.tiles.image_array`, and those that are tiles.
    scheduler
        Address of a running scheduler, ``tcp://host:port``.

    Raises
    ------
    CampaignError
        If the environment does not name the same scheduler, it does not answer, or has no workers with this code.
    """
    with _connected(scheduler) as client:
        from distributed import as_completed

        futures = client.get(graph, list(keys), sync=False)
        numbers = {future.key: number for number, future in enumerate(futures)}
        done = as_completed(futures, loop=client.loop, with_results=True)
        del futures  # so that a tile leaves its worker when it has come
        for future, tile in done:
            yield numbers[future.key], tile


def check_named(scheduler: str) -> None:
    """Raise CampaignError unless whoever runs this names the scheduler at an address, too."""
    named = os.environ.get(NAMED_BY)
    if named != scheduler:
        raise CampaignError(
            f"{scheduler}, but {NAMED_BY} is {named or 'not set'}",
            where=KEY,
            expected="the scheduler that whoever runs this names: it may send code",
            remedy=f"If it is yours, run `export {NAMED_BY}={scheduler}`; else set {KEY} to threads.",
        )


def _connected(scheduler: str) -> Any:
    check_named(scheduler)
    try:
        from distributed import Client
    except ImportError as error:
        raise _unusable(scheduler, "package distributed is not installed", "Install apertura[distributed].") from error
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise _unusable(scheduler, "nobody answers there", "Start `dask scheduler`, or correct the address.") from error
    try:
        _check_workers(client, scheduler)
    except BaseException:
        client.close()
        raise
    return client


def _check_workers(client: Any, scheduler: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_WORKERS_S)
    except TimeoutError as error:
        raise _unusable(scheduler, "it has no workers", f"Start some: `dask worker {scheduler}`.") from error
    modules = ("apertura.core.backprojection.tiles", *ENGINES.values())
    own, theirs = code_sha256(*modules), client.run(code_sha256, *modules)
    other = [worker for worker, code in theirs.items() if code != own]
    if other:
        found = f"{len(other)} of {len(theirs)} workers run other code, first {other[0]}"
        raise _unusable(scheduler, found, "Install the same version there.")


def _unusable(scheduler: str, found: str, remedy: str) -> CampaignError:
    return CampaignError(f"{scheduler}: {found}", KEY, "a dask scheduler with workers that have this apertura", remedy)


# ---- An image as a dask array of tiles


def _forget_threads() -> None:
    """Let dask start its threads anew in a forked child, which has none of its parent's and would wait for ever."""
    threaded: Any = sys.modules.get("dask.threaded")
    if threaded is not None:
        threaded.default_pool, threaded.main_thread = None, threading.current_thread()
        threaded.pools_lock = threading.Lock()
        threaded.pools.clear()


os.register_at_fork(after_in_child=_forget_threads)

_NOTHING = np.complex64(complex(np.nan, np.nan))


def image_array(
    inputs: PhaseHistory | Profiles,
    setting: Setting,
    grid: SceneGrid,
    terrain: Terrain,
    *,
    side_px: int,
    weighing: "Weighing | None" = None,
) -> "Array":
    """Return an image, the mean over the pulses, as a dask array whose chunks are square tiles.

    Tables are prepared once per block of pulses and shared by all tiles; with several blocks each one's tables are
    prepared when the tiles of the block before are done, so that one block's inputs and tables are in memory at a time.
    A tile takes of a block the pulses that may add something to it, and of a block without any nothing. It is the
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
    weighing
        What weighs and sums pulses before and beside the engine; by default every pulse counts once.

    Returns
    -------
    dask.array.Array
        (row, column) complex64; 1 is the amplitude of an echo in every pulse counted; 0 where no pulse illuminates the
        pixel.
    """
    from dask.array.core import Array
    from dask.highlevelgraph import HighLevelGraph

    from apertura.core.backprojection.layer import TilesLayer

    name, weighing = f"image-{uuid4().hex}", weighing or Weighing()
    chunks = tuple(tuple(min(side_px, size - at) for at in range(0, size, side_px)) for size in grid.shape)
    places = list(product(range(len(chunks[0])), range(len(chunks[1]))))
    reach = Reach.of(weighing.beams, inputs.aperture, grid, terrain, list(grid.tiles(side_px)))
    forming = _Forming(name, setting, grid, terrain, side_px, weighing, reach)
    layer = TilesLayer(name, partial(_graph, forming, inputs), places)
    return Array(HighLevelGraph({name: layer}, {name: set()}), name, chunks, np.complex64)


@dataclass(frozen=True, eq=False)
class Weighing:
    """How pulses are weighted and summed.

    Attributes
    ----------
    beams
        Weight of each pulse at each pixel by its antennas and the sector integrated; none by default.
    presum
        Low-pass sum over pulses and the point (3,) they are aligned to, metres; none by default.
    count
        Pulses that the sum is divided by; all of them by default.
    variant_counts
        Variant of the engine's sum → pixels × pulses that took it in this process.
    """

    beams: Beams | None = None
    presum: tuple[Presum, NDArray[np.float64]] | None = None
    count: int | None = None
    variant_counts: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, eq=False)
class _Forming:
    """What the tasks of all tiles share."""

    name: str
    setting: Setting
    grid: SceneGrid
    terrain: Terrain
    side_px: int
    weighing: Weighing
    reach: Reach

    def window(self, place: tuple[int, int]) -> tuple[slice, slice]:
        rows, columns = (slice(at * self.side_px, (at + 1) * self.side_px) for at in place)
        return rows, columns

    def index(self, place: tuple[int, int]) -> int:
        return place[0] * -(-self.grid.shape[1] // self.side_px) + place[1]


def _graph(forming: _Forming, inputs: PhaseHistory | Profiles, places: Collection[tuple[int, int]]) -> dict[Any, Any]:
    """Return the tasks of the tiles in some rows and columns of tiles, and of what they share."""
    name, presum, beams = forming.name, forming.weighing.presum, forming.weighing.beams
    count = np.float32(forming.weighing.count or len(inputs))
    pulses = len(inputs) if presum is None else len(presum[0].at)
    graph: dict[Any, Any] = {f"{name}-inputs": inputs, f"{name}-beams": beams}
    sums: dict[tuple[int, int], Any] = {}  # place → key of what the blocks so far add up to
    before: list[Any] = []  # what must be done before the next block's tables are prepared
    for number, some in enumerate(pulse_blocks_of(pulses, forming.setting.pulse_blocks, any_start=beams is None)):
        parts = {place: forming.reach.within(forming.index(place), some) for place in places}
        covering = {place: part for place, part in parts.items() if part is not None}
        if not covering:
            continue
        first, last = min(part.start for part in covering.values()), max(part.stop for part in covering.values())
        block = slice(some.start + first, some.start + last)  # what no tile takes is not even read
        tables = f"{name}-tables-{number}"
        graph[tables] = (partial(_prepare, forming.setting, presum, block), f"{name}-inputs", before)
        before = []
        for place, covered in covering.items():
            part = slice(covered.start - first, covered.stop - first)
            form, key = partial(_form, forming, place, block, part, count), (f"{name}-{number}", *place)
            graph[key] = (form, tables, f"{name}-beams", sums.get(place))
            graph[f"{name}-done-{number}", *place] = (_nothing, key)
            before.append((f"{name}-done-{number}", *place))
            sums[place] = key
    for place in places:
        graph[name, *place] = (
            sums[place]
            if place in sums
            else (partial(np.zeros, forming.grid[forming.window(place)].shape, np.complex64),)
        )
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
        some, pulses = presum[0].part(block)
        return load_engine(setting.engine).prepare(presummed(inputs[pulses], some, presum[1]), **setting.options)
    return load_engine(setting.engine).prepare(inputs[block], **setting.options)


def _form(  # noqa: PLR0917
    forming: _Forming,
    place: tuple[int, int],
    block: slice,
    part: slice,
    count: np.float32,
    tables: Any,
    beams: Beams | None,
    sum_before: NDArray[np.complex64] | None,
) -> NDArray[np.complex64]:
    """Return one tile of the image of a block of pulses, added to the sum of the blocks before."""
    setting, grid = forming.setting, forming.grid[forming.window(place)]
    if part != slice(0, block.stop - block.start):
        tables = tables[part]
    some = beams and beams[block.start + part.start : block.start + part.stop]
    engine, pixels = load_engine(setting.engine), forming.terrain.positions(grid)
    variants: tuple[str, ...] = getattr(engine, "VARIANTS", ())
    counted = {"counts": np.zeros(len(variants), np.int64)} if variants else {}
    image = engine.form(tables, pixels, beams=some, **setting.form_options, **counted)
    forming.weighing.variant_counts.update({name: int(counted["counts"][n]) for n, name in enumerate(variants)})
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
) -> None:
    """Compute some tiles of an image and write each as soon as it is done.

    A pixel to which no pulse adds anything is written as NaN: nothing was measured there, and 0 would be a measure.

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

    Examples
    --------
    >>> import dask.array
    >>> target = np.zeros((4, 6), np.complex64)
    >>> compute_tiles(dask.array.ones((4, 6), chunks=2), [(slice(0, 2), slice(4, 6))], target, threads=1)
    >>> target.sum().item()
    (4+0j)
    """
    from dask.callbacks import Callback
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
        with progress("tiles", len(keys)) as done:
            for number, tile in cluster_tiles(graph, keys, scheduler):
                _write(target, windows[number], tile)
                done(1)
        return
    written = {
        ("written", *key): (partial(_write, target, window), key) for key, window in zip(keys, windows, strict=True)
    }
    tasks = {**graph, **written}
    with progress("parts of tiles", len(tasks)) as done, Callback(posttask=lambda *_: done(1)):
        get(tasks, list(written), num_workers=threads)


def _write(target: Any, window: Window, tile: NDArray[np.complex64]) -> None:
    """Write one tile where it belongs."""
    target[window] = np.where(tile == 0, _NOTHING, tile)
