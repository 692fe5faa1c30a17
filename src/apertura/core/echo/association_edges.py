"""When a pairing of two nodes' pulses is suspect, and which tags are wrong by themselves."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.time_tags import Floats, Integers, Pairs

if TYPE_CHECKING:
    from apertura.core.echo.association import Association

LARGEST_JITTER = 1 / 6
"""RMS scatter of the tags, in repetition intervals, at which one pulse in 370 (3σ) reaches its neighbour."""

NEAR_HALF = 0.4
"""Offsets beyond this share of a repetition interval could as well belong to the neighbouring pulse."""

APART_S = 20e-3
"""Offset between two nodes' tags, good to a few milliseconds each, that is no longer the error of good tags."""

OUTLIER_S = 5e-3
"""A single tag that leaves the line by no more than this is as good as tags are."""

_OUTLIER_SIGMA = 6.0

LARGEST_UNPAIRED = 0.05
"""Share of the transmitter's pulses before or after the other recording that is worth a remark."""

_FEW = 2  # pulses that a recorder may begin late or end early by


def is_outlier(residual_s: Floats) -> NDArray[np.bool_]:
    """Return (pair,) bool: which tags leave the line by more than `OUTLIER_S` and six times the scatter of all.

    Examples
    --------
    >>> is_outlier(np.array([0.0, 1e-4, -1e-4, 2e-4, 0.03, -1e-4]))
    array([False, False, False, False,  True, False])
    """
    size = np.abs(residual_s)
    return np.asarray(size > max(OUTLIER_S, _OUTLIER_SIGMA * 1.4826 * float(np.median(size))))


def tag_jitter_s(time_ns: Integers) -> float:
    """Return the RMS error of a node's own tags about equal steps, as a radar's timer makes them, seconds.

    Parameters
    ----------
    time_ns
        (pulse,) int64, tags of one node, ascending; missed pulses are bridged.

    Notes
    -----
    Where triggers do not come in equal steps this is an upper bound. An error that all tags share cannot be seen.

    Examples
    --------
    >>> regular = np.arange(100) * 50_000_000
    >>> tag_jitter_s(np.delete(regular, [7, 8])), round(tag_jitter_s(regular + np.arange(100) % 2 * 2_000_000), 5)
    (0.0, 0.001)
    """
    if time_ns.size < 3:
        return 0.0
    steps = np.diff(time_ns)
    number = np.concatenate([[0.0], np.cumsum(np.round(steps / np.median(steps)))])
    elapsed_s = (time_ns - time_ns[0]) * 1e-9
    return round(float(np.std(elapsed_s - np.polyval(np.polyfit(number, elapsed_s, 1), number))), 9)


def association_flags(
    association: "Association", tags: Pairs, interval_s: float, *, conflicts: int, speed_m_s: float | None
) -> dict[str, str]:
    """Return flags: edge that an association crosses → what was measured, in one line.

    Parameters
    ----------
    tags
        (pulse,) int64 tags of transmitter and receiver, nanoseconds.
    interval_s
        Nominal time between pulses, seconds.
    conflicts
        Pairs that the frame counter makes and the tags contradict.
    speed_m_s
        Of the transmitter; None: unknown.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association".
    """
    flags = {}
    share, by_tags = abs(association.offset_s) / interval_s, association.method == "time tags"
    if by_tags and share > NEAR_HALF:
        flags["association_ambiguous"] = (
            f"tags are {association.offset_s:+.4f} s apart, {share:.2f} of a repetition interval: "
            "every pair may be off by one pulse"
        )
    if abs(association.offset_s) > APART_S:
        flags["time_tags_apart"] = _apart(association, speed_m_s)
    if conflicts:
        flags["frame_counter_conflict"] = f"{conflicts} pulses dropped: frame counter and time tags disagree"
    if by_tags and association.residual_s > interval_s * LARGEST_JITTER:
        flags["time_tag_jitter"] = (
            f"time tags scatter by {association.residual_s:.4f} s rms at a repetition interval of {interval_s:.4g} s: "
            "single pulses may be paired with a neighbour"
        )
    if association.outlier.any():
        flags["time_tag_outlier"] = (
            f"{int(association.outlier.sum())} of {association.outlier.size} pulses left out: "
            f"their tags leave the line through all by more than {OUTLIER_S:g} s"
        )
    pairs = association.tx_index.size
    shorter = pairs + min(association.tx_dropped, association.rx_dropped)
    if pairs < shorter / 2:
        flags["association_sparse"] = f"{pairs} pulses paired of {shorter} in the shorter recording"
    unpaired = _unpaired(association, tags, interval_s)
    if unpaired:
        flags["pulses_unpaired"] = unpaired
    return flags


def _apart(association: "Association", speed_m_s: float | None) -> str:
    line = f"time tags of the nodes are {association.offset_s:+.4f} s apart (pairs by {association.method})"
    if speed_m_s is None:
        return line
    return f"{line}: the transmitter's decide, and moved {abs(association.offset_s) * speed_m_s:.2f} m meanwhile"


def _unpaired(association: "Association", tags: Pairs, interval_s: float) -> str | None:
    """Return one line on the transmitter's pulses before the first and after the last pair, if they are many."""
    tx, rx = tags
    early, late = int(association.tx_index[0]), tx.size - 1 - int(association.tx_index[-1])
    if early + late <= max(LARGEST_UNPAIRED * tx.size, _FEW):
        return None
    line = f"{early} pulses before and {late} after the other recording, of {tx.size}"
    begin_s, end_s = (rx[0] - tx[0]) * 1e-9, (rx[-1] - tx[-1]) * 1e-9
    if abs(begin_s - end_s) <= 1.5 * interval_s < abs(begin_s):
        line += f": both recordings are equally long and {begin_s:+.3f} s apart, as if the tags of one were off by that"
    return line
