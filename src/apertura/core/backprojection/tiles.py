"""Images as dask arrays of tiles; each tile is computed independently on request, by local threads or a cluster."""

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
from apertura.core.antenna.illumination import recorded_mask
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.presum import Presum, presummed
from apertura.core.backprojection.reach import Reach, pulse_blocks_of
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

if TYPE_CHECKING:
    from dask.array.core import Array


# ---- Tiles formed by workers of a `distributed` scheduler

KEY = "processing.scheduler"
NAMED_BY = "DASK_SCHEDULER_ADDRESS"
"""Environment variable of dask with the scheduler address. It must agree with the address in the config, because a
client executes code from the scheduler, and a config is untrusted."""

_CONNECT_S = 5.0  # timeout for the connection to a scheduler
_WORKERS_S = 10.0  # timeout for the first worker of a scheduler


def cluster_tiles(
    graph: Any, keys: Sequence[tuple[Any, ...]], scheduler: str
) -> Iterator[tuple[int, NDArray[np.complex64]]]:
    """Yield each tile with its number as soon as a worker has formed it.

    Workers require this package but no file of the campaign: inputs are sent to the workers, and tiles are returned.
    Tiles of a lost worker are recomputed by other workers.

    Parameters
    ----------
    graph, keys
        Tasks of an image of `apertura.core.backprojection.tiles.image_array`, and keys of its tiles.
    scheduler
        Address of a running scheduler, ``tcp://host:port``.

    Raises
    ------
    CampaignError
        If the environment variable names no scheduler or a different scheduler, if the scheduler is not reachable, or
        if it has no workers with the same code.
    """
    with _connected(scheduler) as client:
        from distributed import as_completed

        futures = client.get(graph, list(keys), sync=False)
        numbers = {future.key: number for number, future in enumerate(futures)}
        done = as_completed(futures, loop=client.loop, with_results=True)
        del futures  # so that workers release a tile after it is received
        for future, tile in done:
            yield numbers[future.key], tile


def check_named(scheduler: str) -> None:
    """Raise CampaignError if the environment variable `NAMED_BY` does not confirm the address of the scheduler."""
    named = os.environ.get(NAMED_BY)
    if named != scheduler:
        raise CampaignError(
            f"{scheduler}, but {NAMED_BY} is {named or 'not set'}",
            where=KEY,
            expected=f"the scheduler named by {NAMED_BY}, because a scheduler may send code",
            remedy=f"If you trust the scheduler, run `export {NAMED_BY}={scheduler}`; otherwise set {KEY} to threads.",
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
        remedy = "Start `dask scheduler`, or correct the address."
        raise _unusable(scheduler, "no scheduler is reachable at this address", remedy) from error
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
        remedy = f"Start workers with `dask worker {scheduler}`."
        raise _unusable(scheduler, "the scheduler has no workers", remedy) from error
    modules = ("apertura.core.backprojection.tiles", *ENGINES.values())
    own, theirs = code_sha256(*modules), client.run(code_sha256, *modules)
    differing = [worker for worker, code in theirs.items() if code != own]
    if differing:
        found = f"{len(differing)} of {len(theirs)} workers have a different version of the code, e.g. {differing[0]}"
        raise _unusable(scheduler, found, "Install the same version of apertura on the workers.")


def _unusable(scheduler: str, found: str, remedy: str) -> CampaignError:
    expected = "a dask scheduler with workers of the same version of apertura"
    return CampaignError(f"{scheduler}: {found}", KEY, expected, remedy)


# ---- An image as a dask array of tiles


def _forget_threads() -> None:
    """Reset the thread pools of dask in a forked child, which inherits no threads and would wait indefinitely."""
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
    """Return an image, the mean over the pulses, as a dask array with square tiles as chunks.

    Tables are prepared once per pulse block and shared by all tiles. With several blocks, the tables of a block are
    prepared when the tiles of the previous block are complete, so that inputs and tables of only one block are in
    memory. For each tile, only the pulses that may contribute to it are summed. The bits of a tile do not depend on
    which other tiles are computed, on the order of tiles, or on the use of threads, processes or a cluster.

    Parameters
    ----------
    inputs
        Input required by the engine of the setting.
    setting
        Engine, options of the engine, and number of pulse blocks.
    grid, terrain
        The scene; pixels lie on the terrain.
    side_px
        Side of a tile, a multiple of 16 pixels.
    weighing
        Weights and presumming of pulses (default: all pulses have the weight 1).

    Returns
    -------
    dask.array.Array
        (row, column) complex64, in units of the amplitude of an echo present in `Weighing.count` pulses; 0 where no
        pulse illuminates the pixel.
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
    """Weights and presumming of pulses.

    Attributes
    ----------
    beams
        Weight of each pulse at each pixel due to antennas and integrated sector (default: 1).
    presum
        Presumming filter, and point (3,) to which pulses are aligned, metres (default: no presumming).
    count
        Divisor of the sum (default: number of all pulses).
    variant_counts
        Variant of the engine's sum → number of pixel-pulse contributions summed by this variant in this process.
    """

    beams: Beams | None = None
    presum: tuple[Presum, NDArray[np.float64]] | None = None
    count: int | None = None
    variant_counts: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, eq=False)
class _Forming:
    """Common inputs of the tasks of all tiles."""

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
    """Return the tasks for the given tiles (row and column of tiles) and for their common tables."""
    name, presum, beams = forming.name, forming.weighing.presum, forming.weighing.beams
    count = np.float32(forming.weighing.count or len(inputs))
    pulses = len(inputs) if presum is None else len(presum[0].at)
    common = {"inputs": inputs, "beams": beams, "aperture": inputs.aperture if beams and beams.gate else None}
    graph: dict[Any, Any] = {f"{name}-{key}": value for key, value in common.items()}
    sums: dict[tuple[int, int], Any] = {}  # tile → key of its sum over the blocks so far
    before: list[Any] = []  # tasks to finish before the tables of the next block are prepared
    for number, pulse_block in enumerate(
        pulse_blocks_of(pulses, forming.setting.pulse_blocks, any_start=beams is None)
    ):
        parts = {place: forming.reach.within(forming.index(place), pulse_block) for place in places}
        covering = {place: part for place, part in parts.items() if part is not None}
        if not covering:
            continue
        first, last = min(part.start for part in covering.values()), max(part.stop for part in covering.values())
        # pulses that contribute to no tile are not read
        block = slice(pulse_block.start + first, pulse_block.start + last)
        tables = f"{name}-tables-{number}"
        graph[tables] = (partial(_prepare, forming.setting, presum, block), f"{name}-inputs", before)
        before = []
        for place, covered in covering.items():
            part = slice(covered.start - first, covered.stop - first)
            form, key = partial(_form, forming, place, block, part, count), (f"{name}-{number}", *place)
            graph[key] = (form, tables, f"{name}-beams", f"{name}-aperture", sums.get(place))
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
    """Return the tables of the engine for a pulse block, which are common to all tiles."""
    if presum is not None and isinstance(inputs, Profiles):
        block_filter, pulses = presum[0].part(block)
        return load_engine(setting.engine).prepare(
            presummed(inputs[pulses], block_filter, presum[1]), **setting.options
        )
    return load_engine(setting.engine).prepare(inputs[block], **setting.options)


def _form(  # noqa: PLR0917
    forming: _Forming,
    place: tuple[int, int],
    block: slice,
    part: slice,
    count: np.float32,
    tables: Any,
    beams: Beams | None,
    aperture: Aperture | None,
    sum_before: NDArray[np.complex64] | None,
) -> NDArray[np.complex64]:
    """Return a tile of the image of a pulse block, added to the sum over the previous blocks."""
    setting, grid = forming.setting, forming.grid[forming.window(place)]
    if part != slice(0, block.stop - block.start):
        tables = tables[part]
    pulses = slice(block.start + part.start, block.start + part.stop)
    part_beams = beams and beams[pulses]
    engine, pixels = load_engine(setting.engine), forming.terrain.positions(grid)
    variants: tuple[str, ...] = getattr(engine, "VARIANTS", ())
    counts = {"counts": np.zeros(len(variants), np.int64)} if variants else {}
    image = engine.form(tables, pixels, beams=part_beams, **setting.form_options, **counts)
    forming.weighing.variant_counts.update({name: int(counts["counts"][n]) for n, name in enumerate(variants)})
    tile = np.asarray(image / count, np.complex64)
    if part_beams and aperture and (recorded := recorded_mask(part_beams, aperture[pulses], pixels)) is not None:
        tile[~recorded] = 0
    return tile if sum_before is None else sum_before + tile


def _nothing(_done: Any) -> None:
    """Return None, to signal without data that a tile is complete."""


def compute_tiles(
    image: "Array",
    windows: Sequence[Window],
    target: Any,
    *,
    threads: int,
    scheduler: str = "threads",
) -> None:
    """Compute tiles of an image and write each tile as soon as it is complete.

    Pixels without contributing pulses are written as NaN, to distinguish them from measured values.

    Parameters
    ----------
    image
        Image from `image_array`.
    windows
        Tiles to compute: windows of chunks of the array.
    target
        (y, x) array to write to: numpy or zarr.
    threads
        Number of tiles computed concurrently, which determines the memory for pixel positions and results.
    scheduler
        'threads', or the address of a `distributed` scheduler, the workers of which form bit-identical tiles.

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

    tile_numbers = [
        {int(end - size): at for at, (end, size) in enumerate(zip(np.cumsum(sizes), sizes, strict=True))}
        for sizes in image.chunks
    ]
    keys = [
        (image.name, *(numbers_of[part.start] for numbers_of, part in zip(tile_numbers, window, strict=True)))
        for window in windows
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
    """Write a tile to its window, with 0 replaced by NaN."""
    target[window] = np.where(tile == 0, _NOTHING, tile)
