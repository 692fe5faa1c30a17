"""Which capture of the receiver belongs to which pulse of the transmitter, and when that answer is suspect."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.echo.association_edges import association_flags, is_outlier
from apertura.core.echo.frame_counter import pairs_by_frame
from apertura.core.echo.framing import ABSENT
from apertura.core.echo.time_tags import Integers, Pairs, fit_modulo_interval, fit_pairs, nearest_pairs, residual_ns


@dataclass(frozen=True)
class Association:
    """Pulses that two nodes have in common.

    Attributes
    ----------
    tx_index, rx_index
        (pair,) int64, positions in the two recordings, both strictly ascending.
    offset_s
        Receiver's time tag minus transmitter's at the first pair, seconds.
    drift_ppm
        Growth of that offset, parts per million.
    residual_s
        RMS of the tags about that line, seconds.
    method
        What the pairs rest on.
    outlier
        (pair,) bool, whose tags leave that line by more than a tag may err: one of the two is wrong.
    tx_dropped, rx_dropped
        Pulses of each recording without a partner.
    flags
        Edge crossed → what was measured, in one line.
    """

    tx_index: Integers
    rx_index: Integers
    offset_s: float
    drift_ppm: float
    residual_s: float
    method: Literal["frame counter", "time tags"]
    outlier: NDArray[np.bool_]
    tx_dropped: int
    rx_dropped: int
    flags: Mapping[str, str]


def associate(
    tx_time_ns: Integers,
    rx_time_ns: Integers,
    *,
    repetition_interval_s: float,
    tx_frame: Integers | None = None,
    rx_frame: Integers | None = None,
    frame_modulus: int | None = None,
    speed_m_s: float | None = None,
    where: str = "raw",
) -> Association:
    """Pair the pulses of a transmitter with the captures of a receiver.

    Frame numbers decide where both nodes have them. Without, the receiver's tags are taken to run ahead or
    behind by less than half a repetition interval at its first pulse, drifting by up to 100 ppm afterwards.

    Parameters
    ----------
    tx_time_ns, rx_time_ns
        (pulse,) int64, UTC time tags of each node's own clock, nanoseconds, ascending; any common origin.
    repetition_interval_s
        Nominal time between pulses, seconds.
    tx_frame, rx_frame
        (pulse,) int64 frame numbers, -1 where the payload was not read; None without a counter.
    frame_modulus
        Count at which the counter returns to zero. None: the power of two above the largest number seen, if
        a counter ever steps back.
    speed_m_s
        Of the transmitter, to say how far tags that are apart move it, metres per second; None: unknown.
    where
        What to call the recordings in errors.

    Raises
    ------
    CampaignError
        If tags do not ascend, the counters share no frame, or no pair lies within half a repetition interval.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association".

    Examples
    --------
    >>> transmitter = np.arange(5) * 50_000_000
    >>> receiver = np.delete(transmitter, 2) + 2_000_000
    >>> association = associate(transmitter, receiver, repetition_interval_s=0.05)
    >>> association.tx_index, association.rx_index, association.offset_s
    (array([0, 1, 3, 4]), array([0, 1, 2, 3]), 0.002)
    """
    interval_ns = repetition_interval_s * 1e9
    for node, time_ns in (("transmitter", tx_time_ns), ("receiver", rx_time_ns)):
        _require_ascending(time_ns, node, where)
    tags = np.asarray(tx_time_ns, np.int64), np.asarray(rx_time_ns, np.int64)
    frames, conflicts = (tx_frame, rx_frame), 0
    by_frame = pairs_by_frame(tags, frames, interval_ns, frame_modulus)
    if by_frame is None:
        pairs = _pairs_by_tags(tags, interval_ns)
    else:
        pairs, conflicts = _agreed_pairs(tags, by_frame, frames, interval_ns)
    if pairs[0].size == 0:
        raise _nothing_in_common(tags, repetition_interval_s, where)
    line = fit_pairs(tags, pairs, interval_ns)
    residual = residual_ns(tags, pairs, line) * 1e-9
    association = Association(
        *pairs,
        offset_s=line.offset_ns * 1e-9,
        drift_ppm=line.drift * 1e6,
        residual_s=float(np.sqrt(np.mean(residual**2))),
        method="time tags" if by_frame is None else "frame counter",
        outlier=is_outlier(residual),
        tx_dropped=tags[0].size - pairs[0].size,
        rx_dropped=tags[1].size - pairs[0].size,
        flags={},
    )
    flags = association_flags(association, tags, repetition_interval_s, conflicts=conflicts, speed_m_s=speed_m_s)
    return replace(association, flags=flags)


def _require_ascending(tags: Integers, node: str, where: str) -> None:
    back = np.flatnonzero(np.diff(tags) <= 0)
    if back.size or tags.size == 0:
        found = f"time tag of pulse {back[0] + 1} of the {node} steps back" if tags.size else f"no pulses of the {node}"
        raise CampaignError(
            found, where, expected="time tags that ascend", remedy="Check core:datetime of the capture segments."
        )


def _nothing_in_common(tags: Pairs, repetition_interval_s: float, where: str) -> CampaignError:
    gap_s = [(tags[1][0] - tags[0][0]) * 1e-9, (tags[1][-1] - tags[0][-1]) * 1e-9]
    return CampaignError(
        f"no pulse pairs: the receiver begins {gap_s[0]:+.3f} s and ends {gap_s[1]:+.3f} s from the transmitter",
        where=where,
        expected=f"pairs within half a repetition interval ({repetition_interval_s / 2:.4g} s)",
        remedy="Check that both recordings are of the same flight, and their core:datetime.",
    )


def _pairs_by_tags(tags: Pairs, interval_ns: float) -> Pairs:
    pairs = nearest_pairs(tags, fit_modulo_interval(tags, interval_ns), interval_ns)
    return nearest_pairs(tags, fit_pairs(tags, pairs, interval_ns), interval_ns) if pairs[0].size else pairs


def _agreed_pairs(
    tags: Pairs, by_frame: Pairs, frames: tuple[Integers | None, Integers | None], interval_ns: float
) -> tuple[Pairs, int]:
    """Drop frame pairs that the tags contradict, add pulses whose number was not read; count the dropped."""
    if by_frame[0].size == 0:
        return by_frame, 0
    line = fit_pairs(tags, by_frame, interval_ns)
    agreed = np.abs(residual_ns(tags, by_frame, line)) < interval_ns / 2
    tx, rx = by_frame[0][agreed], by_frame[1][agreed]
    near = nearest_pairs(tags, line, interval_ns)
    unread = (np.asarray(frames[0])[near[0]] == ABSENT) | (np.asarray(frames[1])[near[1]] == ABSENT)
    free = unread & ~np.isin(near[0], tx) & ~np.isin(near[1], rx)
    tx, rx = np.concatenate([tx, near[0][free]]), np.concatenate([rx, near[1][free]])
    order = np.argsort(tx)
    tx, rx = tx[order], rx[order]
    ascending = np.concatenate([[True], rx[1:] > np.maximum.accumulate(rx)[:-1]]) if rx.size else np.zeros(0, bool)
    return (tx[ascending], rx[ascending]), int((~agreed).sum())
