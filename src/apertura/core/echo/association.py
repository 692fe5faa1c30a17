"""Association of captures with the transmitter's pulses, its checks by tags and by the sidelink, and missing pulses."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError, number_of
from apertura.core.echo.trigger import ABSENT

# ---- Offset and drift between the time tags of two nodes

Integers = NDArray[np.int64]
Pairs = tuple[Integers, Integers]
"""Of the transmitter and of the receiver: tags, or indices of paired pulses."""

LARGEST_DRIFT_PPM = 100.0
"""ppm, largest drift of the tags that is searched: free-running crystals stay inside."""


_MOST_TAGS = 16_384  # spread over the flight, of which an offset modulo the interval is told as well as of all


class TagLine(NamedTuple):
    """Offset of the receiver's tags: offset_ns + drift·(tag - origin_ns)."""

    offset_ns: float
    drift: float
    origin_ns: int


def fit_modulo_interval(tags: Pairs, interval_ns: float) -> TagLine:
    """Return the offset line under which the receiver's tags best fall on the transmitter's, modulo the interval."""
    tx, rx = tags
    rx = rx[:: -(-rx.size // _MOST_TAGS)]
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
    if LARGEST_DRIFT_PPM * 1e-6 * elapsed_ns[-1] > interval_ns / 100:  # else jitter would be fitted as drift
        some = np.unique(np.linspace(0, rx_tag.size - 1, 300).astype(int))
        drift = _theil_sen_slope(elapsed_ns[some], offset_ns[some])
    return TagLine(float(np.median(offset_ns - drift * elapsed_ns)), drift, int(rx_tag[0]))


def _theil_sen_slope(x: Floats, y: Floats) -> float:
    """Return the median of the slopes between all pairs of points, x ascending; scipy.stats imports for a second."""
    first, second = np.triu_indices(x.size, 1)
    return float(np.median((y[second] - y[first]) / (x[second] - x[first])))


def residual_ns(tags: Pairs, pairs: Pairs, line: TagLine) -> Floats:
    """Return (pair,) float64: residual of the receiver's tag from the line, nanoseconds."""
    rx_tag = tags[1][pairs[1]]
    return np.asarray(rx_tag - tags[0][pairs[0]] - _offset_ns(rx_tag, line), np.float64)


def _offset_ns(rx_tag: Integers, line: TagLine) -> Floats:
    return np.asarray(line.offset_ns + line.drift * (rx_tag - line.origin_ns), np.float64)


# ---- Association


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
        Basis of the pairs: frame numbers or tags.
    outlier
        (pair,) bool, whose tags deviate from that line by more than the error of a tag: one of the two is wrong.
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
        Count at which the counter returns to zero. None: the power of two above the largest number, if
        a counter ever steps back.
    speed_m_s
        Of the transmitter, to state the displacement by an offset of tags, metres per second; None: unknown.
    where
        Name of the recordings in errors.

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
        pairs = nearest_pairs(tags, fit_modulo_interval(tags, interval_ns), interval_ns)
        if pairs[0].size:  # again by the line through them
            pairs = nearest_pairs(tags, fit_pairs(tags, pairs, interval_ns), interval_ns)
    else:
        pairs, conflicts = _agreed_pairs(tags, by_frame, frames, interval_ns)
    if pairs[0].size == 0:
        raise _no_common_pulse(tags, repetition_interval_s, where)
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


def _no_common_pulse(tags: Pairs, repetition_interval_s: float, where: str) -> CampaignError:
    gap_s = [(tags[1][0] - tags[0][0]) * 1e-9, (tags[1][-1] - tags[0][-1]) * 1e-9]
    return CampaignError(
        f"no pulse pairs: the receiver begins {gap_s[0]:+.3f} s and ends {gap_s[1]:+.3f} s from the transmitter",
        where=where,
        expected=f"pairs within half a repetition interval ({repetition_interval_s / 2:.4g} s)",
        remedy="Check that both recordings are of the same flight, and their core:datetime.",
    )


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


# ---- Pairs by frame number


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
        # number of wraps of the counter between the nodes: the one that brings their tags closest
        expected_ns = tags[0][tx[0]] + (rx_count - tx_count[0]) * interval_ns
        rx_count += modulus * int(np.rint(np.median(tags[1][rx] - expected_ns) / (modulus * interval_ns)))
    _, at_tx, at_rx = np.intersect1d(tx_count, rx_count, return_indices=True)
    return tx[at_tx], rx[at_rx]


def _unwrapped(count: Integers, tags: Integers, interval_ns: float, modulus: int) -> Integers:
    """Return the count without wraps; a misread number does not change those after it."""
    step = np.mod(np.diff(count), modulus)
    step += modulus * np.rint((np.diff(tags) / interval_ns - step) / modulus).astype(np.int64)
    return np.asarray(count[0] + np.concatenate([[0], np.cumsum(step)]), np.int64)


# ---- Flags of an association

LARGEST_JITTER = 1 / 6
"""RMS scatter of the tags, in repetition intervals, at which one pulse in 370 (3σ) reaches its neighbour."""

AMBIGUOUS_SHARE = 0.4
"""Share of a repetition interval: offsets beyond it may belong to the neighbouring pulse, which begins at one half."""

LARGEST_OFFSET_S = 20e-3
"""Seconds, largest offset between two nodes' tags that errors of a few milliseconds each explain."""

OUTLIER_S = 5e-3
"""Seconds: a single tag within this of the line is as accurate as tags are."""

_OUTLIER_SIGMA = 6.0  # scatters of all tags: an outlier deviates by more than this and `OUTLIER_S`

LARGEST_UNPAIRED = 0.05
"""Share of the transmitter's pulses before or after the other recording above which a flag is raised."""

_FEW = 2  # pulses by which a recorder may begin late or end early


def is_outlier(residual_s: Floats) -> NDArray[np.bool_]:
    """Return (pair,) bool: which tags deviate from the line by more than `OUTLIER_S` and six times the scatter of all.

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
    Where triggers do not come in equal steps this is an upper bound. An error common to all tags is not measured.

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
    association
        Of the pulses.
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
    if by_tags and share > AMBIGUOUS_SHARE:
        flags["association_ambiguous"] = (
            f"tags are {association.offset_s:+.4f} s apart, {share:.2f} of a repetition interval: "
            "every pair may be off by one pulse"
        )
    if abs(association.offset_s) > LARGEST_OFFSET_S:
        flags["time_tag_offset"] = _offset_line(association, speed_m_s)
    if conflicts:
        flags["frame_counter_conflict"] = (
            f"{number_of(conflicts, 'pulse')} dropped: frame counter and time tags disagree"
        )
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


def _offset_line(association: "Association", speed_m_s: float | None) -> str:
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


# ---- Sidelink delay against the baseline of the tracks: a check of the association

EXPLAINED_M = 0.05
"""Metres of movement of a sidelink that errors of the logged positions alone may explain."""

SIGMAS = 5.0
"""Standard deviations of a median's noise that one of a thousand windows reaches by chance once in 3000 flights."""

_MEDIAN_PULSES = 15, 61, 241
"""Lengths of the running medians that separate movement from jitter, odd: the longer, the less noise and the slower."""

_ENOUGH = 64  # disjoint windows from which their noise is estimated


@dataclass(frozen=True)
class BaselineResidual:
    """Residual of the measured delay against the baseline, without a constant and a linear drift.

    Attributes
    ----------
    residual_m, noise_m
        RMS of the residual's running median, metres, and the standard deviation of that median by jitter alone.
    jitter_m
        Standard deviation of a single pulse, metres: of the trigger, mostly.
    largest_m, pulse
        Largest running median, metres, and its pulse.
    excess
        `largest_m` relative to what noise and position errors explain, over running medians of several lengths.
    """

    residual_m: float
    noise_m: float
    jitter_m: float
    largest_m: float
    pulse: int
    excess: float


def baseline_residual(delay_m: Floats, baseline_m: Floats) -> BaselineResidual | None:
    """Return the residual of a sidelink's measured path from its geometry; None of less than 30 pulses.

    Parameters
    ----------
    delay_m, baseline_m
        (pulse,) float64, metres: measured delay of the sidelink times c, NaN where it did not lock, and distance
        between its antennas.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". Of each length only full windows count: a window that runs over
    the end would repeat its last pulse.

    Examples
    --------
    >>> distance = 5 + np.sin(np.arange(200) / 20)
    >>> [baseline_residual(moved, distance).residual_m.__round__(1) for moved in (distance, np.roll(distance, 9))]
    [0.0, 0.3]
    """
    pulse = np.flatnonzero(np.isfinite(delay_m) & np.isfinite(baseline_m))
    if pulse.size < 2 * _MEDIAN_PULSES[0]:
        return None
    residual = delay_m[pulse] - baseline_m[pulse]
    jitter = 1.4826 * float(np.median(np.abs(np.diff(residual)))) / 2**0.5
    residuals = [_smoothed(pulse, residual, jitter, width) for width in _MEDIAN_PULSES if 2 * width <= pulse.size]
    return max(residuals, key=lambda one: one.excess)


def _smoothed(pulse: NDArray[np.intp], residual: Floats, jitter_m: float, width: int) -> BaselineResidual:
    from scipy import ndimage

    inside = slice(width // 2, -(width // 2))  # full windows
    smooth, middle = ndimage.median_filter(residual, width)[inside], pulse[inside]
    smooth = smooth - np.polyval(np.polyfit(middle, smooth, 1), middle)
    noise_m = 1.2533 * jitter_m / np.sqrt(width)  # standard deviation of a median of so many Gaussian samples
    steps = np.diff(smooth[::width])
    if steps.size >= _ENOUGH:  # jitter need not be normal: the median of a uniform one is noisier
        noise_m = max(noise_m, 1.4826 * float(np.median(np.abs(steps))) / 2**0.5)
    worst = int(np.argmax(np.abs(smooth)))
    largest_m = float(abs(smooth[worst]))
    return BaselineResidual(
        float(np.sqrt(np.mean(smooth**2))),
        float(noise_m),
        jitter_m,
        largest_m,
        int(middle[worst]),
        largest_m / max(EXPLAINED_M, sigmas(smooth.size) * float(noise_m)),
    )


def sigmas(windows: int) -> float:
    """Return the threshold in standard deviations for the highest of so many windows, of equal false alarm per flight.

    Examples
    --------
    >>> sigmas(500), round(sigmas(300_000), 2)
    (5.0, 6.03)
    """
    return float(np.sqrt(SIGMAS**2 + 2 * np.log(max(1.0, windows / 1000))))


def detect_wrong_association(residual: BaselineResidual | None) -> str | None:
    """Return one line on where the measured sidelink deviates from the geometry of its pulses, or None.

    A constant and a linear drift are of the clocks. A residual that moves by more than `EXPLAINED_M` and by more than
    five times its own noise, six of a long flight, cannot come from trigger jitter: pulses have positions of other
    pulses, or wrong ones.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". Two nodes that keep their distance give no evidence either way:
    the baseline must change for a wrong pair to be detected.

    Examples
    --------
    >>> distance = 5 + np.sin(np.arange(200) / 20)
    >>> detect_wrong_association(baseline_residual(distance + 3.0, distance)) is None
    True
    >>> detect_wrong_association(baseline_residual(np.roll(distance, 9), distance))
    'sidelink leaves its geometry by ... m at pulse ... (noise ... m): pulses or positions are wrongly associated'
    """
    if residual is None or residual.excess <= 1:
        return None
    return (
        f"sidelink leaves its geometry by {residual.largest_m:.2f} m at pulse {residual.pulse} "
        f"(noise {residual.noise_m:.3f} m): pulses or positions are wrongly associated"
    )


# ---- Missing pulses

LARGEST_SIDELOBE = 0.1
"""Amplitude over the peak, largest sidelobe by missing pulses: -20 dB, of a tenth of the aperture in a row."""


def missing_pulses(time_ns: Integers) -> tuple[int, float]:
    """Return the number of pulses missing between the first and the last, and the highest sidelobe they cause.

    Parameters
    ----------
    time_ns
        (pulse,) int64, ascending tags of the recorded pulses; most are one interval apart.

    Returns
    -------
    tuple
        Number of missing pulses; amplitude of the sidelobe relative to the peak.

    Notes
    -----
    The response of the aperture is that of all pulses less that of the missing ones:
    |Σ_missing exp(j2πkm/M)|/used at a cell or more from the peak, k ≥ 1. Source: docs/theory/planner.md, "Pulses".

    Examples
    --------
    >>> sent = np.arange(1000) * 50_000_000
    >>> missing_pulses(sent), missing_pulses(np.delete(sent, np.arange(400, 500)))
    ((0, 0.0), (100, 0.109...))
    >>> missing_pulses(np.array([0, 2, 8]) * 1_000_000)[0]
    2
    """
    if time_ns.size < 3:
        return 0, 0.0
    steps = np.diff(time_ns)
    usual = np.partition(steps, middle := (len(steps) - 1) // 2)[middle]  # one of the steps, however few there are
    single = steps[np.abs(steps / usual - 1) < 0.25].mean()
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / single), 1).astype(np.int64))])
    absent = np.ones(number[-1] + 1)
    absent[number] = 0
    response = np.abs(np.fft.rfft(absent, 4 * absent.size))[4:]
    return int(absent.sum()), float(response.max()) / time_ns.size


def missing_flags(time_ns: Integers) -> dict[str, str]:
    """Return a flag where missing pulses add sidelobes above `LARGEST_SIDELOBE`; parameters as `missing_pulses`."""
    flags = {}
    missing, sidelobe = missing_pulses(time_ns)
    if sidelobe > LARGEST_SIDELOBE:
        flags["pulses_missing"] = (
            f"{missing} of {missing + time_ns.size} pulses inside the aperture are missing: "
            f"sidelobes of up to {20 * np.log10(sidelobe):.0f} dB along the track"
        )
    return flags
