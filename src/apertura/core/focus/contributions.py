"""What blocks of pulses add at single places: the columns of an image of few pixels, which corrected tracks turn."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.core.focus.echoes import Echoes, job_of, pulses_at_once, tiles
from apertura.core.focus.engines.native_binding import available, call
from apertura.core.focus.inputs import Profiles

Piece = tuple[int, slice]
"""A block and some of its pulses."""


def block_contributions(
    profiles: Profiles,
    places_m: NDArray[np.float64],
    *,
    edges: NDArray[np.int64],
    weights: NDArray[np.float64] | None = None,
) -> NDArray[np.complex64]:
    """Return Σ w·s(R)·exp(+j2πf_mid·R/c) over the pulses of each block at each place, R the total path.

    Parameters
    ----------
    profiles
        At least twice oversampled; samples beyond theirs count as zero. They may be read as they are asked for.
    places_m
        (place, 3) float64, metres, in the frame of the phase centres.
    edges
        (block + 1,) int64, ascending: block b holds pulses edges[b] to edges[b + 1].
    weights
        (pulse,) float64, of each pulse; 1 by default. Blocks without weight are not read.

    Returns
    -------
    ndarray
        (place, block) complex64, not divided by anything; NaN where a place is not finite.

    Raises
    ------
    ValueError
        If shapes differ, or edges do not ascend within the pulses.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 4 and 5: errs by less than -65 dB in the whole band of twice oversampled
    profiles. Paths and the carrier's whole turns are float64. Without the compiled library numpy does the same.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> track = np.array([[0.0, 0.0, 5.0]] * 4)
    >>> echo = np.exp(-((np.arange(32) - 16.0) ** 2) / 8).astype(np.complex64)
    >>> profiles = Profiles(np.tile(echo, (4, 1)), np.full(4, 2.0), 0.5, 299792458.0, 2.0, Aperture(track, track))
    >>> abs(block_contributions(profiles, np.zeros((1, 3)), edges=np.array([0, 1, 4]))).round(2)
    array([[1., 3.]], dtype=float32)
    """
    weights = np.ones(len(profiles)) if weights is None else weights
    edges = np.asarray(edges, np.int64)
    if places_m.ndim != 2 or places_m.shape[1] != 3 or weights.shape != (len(profiles),):
        raise ValueError(f"{places_m.shape=}, {weights.shape=}: must be (place, 3) and ({len(profiles)},)")
    if edges.size < 2 or (np.diff(edges) < 0).any() or edges[0] < 0 or edges[-1] > len(profiles):
        raise ValueError(f"{edges=}: must ascend within {len(profiles)} pulses")
    places_m = np.ascontiguousarray(places_m, np.float64)
    sums = np.zeros((len(places_m), edges.size - 1), np.complex64)
    add = _add_compiled if available() else _add
    for pieces in _chunks(edges, weights, pulses_at_once(profiles)):
        parts = [part for _block, part in pieces]
        add(Echoes.read(profiles, parts), places_m, pieces, np.concatenate([weights[part] for part in parts]), sums)
    return sums


def _chunks(edges: NDArray[np.int64], weights: NDArray[np.float64], most: int) -> Iterator[list[Piece]]:
    """Yield the blocks that weigh something, cut where one chunk has `most` pulses."""
    chunk: list[Piece] = []
    room = most
    for block, (first, end) in enumerate(pairwise(edges.tolist())):
        begin = first
        while begin < end and weights[begin:end].any():
            taken = min(room, end - begin)
            chunk.append((block, slice(begin, begin + taken)))
            begin += taken
            room -= taken
            if not room:
                yield chunk
                chunk, room = [], most
    if chunk:
        yield chunk


def _borders(pieces: list[Piece]) -> NDArray[np.int64]:
    """Return where pieces begin and end once they stand one after the other."""
    return np.cumsum([0, *(part.stop - part.start for _block, part in pieces)])


def _add_compiled(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    pieces: list[Piece],
    weights: NDArray[np.float64],
    sums: NDArray[np.complex64],
) -> None:
    columns = np.array([block for block, _part in pieces], np.int64)
    weight, borders = weights.astype(np.float32)[None], _borders(pieces)
    job = job_of(echoes, places_m, weight)
    job.edges, job.columns, job.sums = borders.ctypes.data, columns.ctypes.data, sums.ctypes.data
    job.blocks, job.width = columns.size, sums.shape[1]
    call("apertura_contribute", job)


def _add(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    pieces: list[Piece],
    weights: NDArray[np.float64],
    sums: NDArray[np.complex64],
) -> None:
    borders = _borders(pieces)
    for tile in tiles(len(places_m), len(echoes)):
        values = echoes.at(places_m[tile])[0] * weights[:, None]
        for (block, _part), (begin, end) in zip(pieces, pairwise(borders), strict=True):
            sums[tile, block] += values[begin:end].sum(axis=0)
