"""Pulses that carry the same frame number, however often the counter wrapped between them."""

import numpy as np

from apertura.core.echo.framing import ABSENT
from apertura.core.echo.time_tags import Integers, Pairs


def pairs_by_frame(
    tags: Pairs, frames: tuple[Integers | None, Integers | None], interval_ns: float, modulus: int | None
) -> Pairs | None:
    """Return pairs of equal frame number, wraps undone; None where a node has no counter."""
    if frames[0] is None or frames[1] is None:
        return None
    tx, rx = (np.flatnonzero(frame != ABSENT) for frame in (frames[0], frames[1]))
    if tx.size == 0 or rx.size == 0:
        return None
    tx_count, rx_count = frames[0][tx].astype(np.int64), frames[1][rx].astype(np.int64)
    if modulus is None and ((np.diff(tx_count) < 0).any() or (np.diff(rx_count) < 0).any()):
        modulus = 1 << int(max(tx_count.max(), rx_count.max())).bit_length()
    if modulus is not None:
        tx_count = _unwrapped(tx_count, tags[0][tx], interval_ns, modulus)
        rx_count = _unwrapped(rx_count, tags[1][rx], interval_ns, modulus)
        # whole turns of the counter between the nodes: those that bring their tags closest
        expected_ns = tags[0][tx[0]] + (rx_count - tx_count[0]) * interval_ns
        rx_count += modulus * int(np.rint(np.median(tags[1][rx] - expected_ns) / (modulus * interval_ns)))
    _, at_tx, at_rx = np.intersect1d(tx_count, rx_count, return_indices=True)
    return tx[at_tx], rx[at_rx]


def _unwrapped(count: Integers, tags: Integers, interval_ns: float, modulus: int) -> Integers:
    """Return the count that never wraps; a misread number costs itself, not those after it."""
    step = np.mod(np.diff(count), modulus)
    step += modulus * np.rint((np.diff(tags) / interval_ns - step) / modulus).astype(np.int64)
    return np.asarray(count[0] + np.concatenate([[0], np.cumsum(step)]), np.int64)
