"""Tiles formed by the workers of a `distributed` scheduler, over TCP; they come back to whoever asked."""

import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.provenance import code_sha256
from apertura.core.focus.engines import ENGINES

KEY = "processing.scheduler"
NAMED_BY = "DASK_SCHEDULER_ADDRESS"
"""Environment variable, dask's own: who connects to a scheduler runs what that sends, and a config is a stranger's."""

_CONNECT_S = 5.0
_WORKERS_S = 10.0


def formed_elsewhere(
    graph: Any, keys: Sequence[tuple[Any, ...]], scheduler: str
) -> Iterator[tuple[int, NDArray[np.complex64]]]:
    """Yield each tile with its number as soon as a worker has formed it.

    Workers need this package and no file of the campaign: what they read is sent to them, and what they formed comes
    back. A worker that dies is made up for by the others.

    Parameters
    ----------
    graph, keys
        Tasks of an image of `apertura.core.focus.tiles.image_array`, and those that are tiles.
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


def _connected(scheduler: str) -> Any:
    named = os.environ.get(NAMED_BY)
    if named != scheduler:
        raise CampaignError(
            f"{scheduler}, but {NAMED_BY} is {named or 'not set'}",
            where=KEY,
            expected="the scheduler that whoever runs this names: it may send code",
            remedy=f"If it is yours, run `export {NAMED_BY}={scheduler}`; else set {KEY} to threads.",
        )
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
    modules = ("apertura.core.focus.tiles", *ENGINES.values())
    own, theirs = code_sha256(*modules), client.run(code_sha256, *modules)
    other = [worker for worker, code in theirs.items() if code != own]
    if other:
        found = f"{len(other)} of {len(theirs)} workers run other code, first {other[0]}"
        raise _unusable(scheduler, found, "Install the same version there.")


def _unusable(scheduler: str, found: str, remedy: str) -> CampaignError:
    return CampaignError(f"{scheduler}: {found}", KEY, "a dask scheduler with workers that have this apertura", remedy)
