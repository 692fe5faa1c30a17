"""How the time tags of two nodes lie to each other: an offset, a drift, and the pairs that follow from them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]
Pairs = tuple[Integers, Integers]
"""Something of the transmitter and the same of the receiver: tags, or indices of paired pulses."""

LARGEST_DRIFT_PPM = 100.0
"""Free-running crystals stay inside this; a faster drift of the tags is not searched for."""


class TagLine(NamedTuple):
    """Offset of the receiver's tags: offset_ns + drift·(tag - origin_ns)."""

    offset_ns: float
    drift: float
    origin_ns: int


def fit_modulo_interval(tags: Pairs, interval_ns: float) -> TagLine:
    """Return the offset line under which the receiver's tags best fall on the transmitter's, modulo the interval."""
    tx, rx = tags
    some = np.minimum(np.searchsorted(tx, rx), tx.size - 1)  # any nearby pulse: modulo the interval all give the same
    cycles = (rx - tx[some]) / interval_ns
    elapsed_ns = (rx - rx[0]).astype(np.float64)
    reach = LARGEST_DRIFT_PPM * 1e-6 * elapsed_ns[-1] / interval_ns
    steps = int(np.ceil(4 * reach)) if reach > 0.25 else 0
    drifts = np.arange(-steps, steps + 1) * (LARGEST_DRIFT_PPM * 1e-6 / max(steps, 1))
    sums = np.array([np.exp(2j * np.pi * (cycles - drift * elapsed_ns / interval_ns)).sum() for drift in drifts])
    best = int(np.argmax(np.abs(sums)))
    return TagLine(float(np.angle(sums[best])) / (2 * np.pi) * interval_ns, float(drifts[best]), int(rx[0]))


def nearest_pairs(tags: Pairs, line: TagLine, interval_ns: float) -> Pairs:
    """Return pairs that are each other's nearest, within half an interval, once the offset is taken out."""
    tx, rx = tags
    corrected = (rx - rx[0]) - _offset_ns(rx, line)
    tx_ns = (tx - rx[0]).astype(np.float64)
    middles = (tx_ns[1:] + tx_ns[:-1]) / 2
    nearest_tx = np.searchsorted(middles, corrected)
    distance = np.abs(corrected - tx_ns[nearest_tx])
    order = np.lexsort((distance, nearest_tx))
    _, first = np.unique(nearest_tx[order], return_index=True)
    kept = np.sort(order[first])
    kept = kept[distance[kept] < interval_ns / 2]
    return nearest_tx[kept], kept


def fit_pairs(tags: Pairs, pairs: Pairs, interval_ns: float) -> TagLine:
    """Return the line (Theil-Sen, then median) through the offsets of pairs; less than half of them may be wrong."""
    tx_tag, rx_tag = tags[0][pairs[0]], tags[1][pairs[1]]
    offset_ns = (rx_tag - tx_tag).astype(np.float64)
    elapsed_ns = (rx_tag - rx_tag[0]).astype(np.float64)
    drift = 0.0
    if LARGEST_DRIFT_PPM * 1e-6 * elapsed_ns[-1] > interval_ns / 100:  # else jitter would pose as drift
        some = np.unique(np.linspace(0, rx_tag.size - 1, 300).astype(int))
        drift = _theil_sen_slope(elapsed_ns[some], offset_ns[some])
    return TagLine(float(np.median(offset_ns - drift * elapsed_ns)), drift, int(rx_tag[0]))


def _theil_sen_slope(x: Floats, y: Floats) -> float:
    """Return the median of the slopes between all pairs of points, x ascending; scipy.stats imports for a second."""
    first, second = np.triu_indices(x.size, 1)
    return float(np.median((y[second] - y[first]) / (x[second] - x[first])))


def residual_ns(tags: Pairs, pairs: Pairs, line: TagLine) -> Floats:
    """Return (pair,) float64: how far the receiver's tag lies from where the line puts it, nanoseconds."""
    rx_tag = tags[1][pairs[1]]
    return np.asarray(rx_tag - tags[0][pairs[0]] - _offset_ns(rx_tag, line), np.float64)


def _offset_ns(rx_tag: Integers, line: TagLine) -> Floats:
    return np.asarray(line.offset_ns + line.drift * (rx_tag - line.origin_ns), np.float64)
