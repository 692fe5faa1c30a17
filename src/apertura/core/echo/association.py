"""Association of captures with transmitted pulses, checks with time tags and sidelink, and missing pulses."""

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
"""Values for the transmitter and for the receiver: time tags, or indices of paired pulses."""

LARGEST_DRIFT_PPM = 100.0
"""Search limit for the drift between the time tags, ppm; the drift of free-running crystals is smaller."""


# largest number of tags used, spread over the flight; more tags do not improve the offset modulo the interval
_MOST_TAGS = 16_384


class TagLine(NamedTuple):
    """Linear model of the receiver's tags minus the transmitter's: offset_ns + drift·(tag - origin_ns)."""

    offset_ns: float
    drift: float
    origin_ns: int


def fit_modulo_interval(tags: Pairs, interval_ns: float) -> TagLine:
    """Fit the offset line that best aligns the tags of receiver and transmitter, modulo the interval."""
    tx, rx = tags
    rx = rx[:: -(-rx.size // _MOST_TAGS)]
    # all nearby pulses yield the same offset modulo the interval
    nearby = np.minimum(np.searchsorted(tx, rx), tx.size - 1)
    cycles = (rx - tx[nearby]) / interval_ns
    elapsed_ns = (rx - rx[0]).astype(np.float64)
    reach = LARGEST_DRIFT_PPM * 1e-6 * elapsed_ns[-1] / interval_ns
    steps = int(np.ceil(4 * reach)) if reach > 0.25 else 0
    drifts = np.arange(-steps, steps + 1) * (LARGEST_DRIFT_PPM * 1e-6 / max(steps, 1))
    sums = np.array([np.exp(2j * np.pi * (cycles - drift * elapsed_ns / interval_ns)).sum() for drift in drifts])
    best = int(np.argmax(np.abs(sums)))
    return TagLine(float(np.angle(sums[best])) / (2 * np.pi) * interval_ns, float(drifts[best]), int(rx[0]))


def nearest_pairs(tags: Pairs, line: TagLine, interval_ns: float) -> Pairs:
    """Return pairs of mutually nearest pulses within half an interval, after removal of the offset line."""
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
    """Fit a line (Theil-Sen slope, then median) to the offsets of pairs; robust against up to half wrong pairs."""
    tx_tag, rx_tag = tags[0][pairs[0]], tags[1][pairs[1]]
    offset_ns = (rx_tag - tx_tag).astype(np.float64)
    elapsed_ns = (rx_tag - rx_tag[0]).astype(np.float64)
    drift = 0.0
    # in shorter recordings, jitter would be fitted as drift
    if LARGEST_DRIFT_PPM * 1e-6 * elapsed_ns[-1] > interval_ns / 100:
        sample = np.unique(np.linspace(0, rx_tag.size - 1, 300).astype(int))
        drift = _theil_sen_slope(elapsed_ns[sample], offset_ns[sample])
    return TagLine(float(np.median(offset_ns - drift * elapsed_ns)), drift, int(rx_tag[0]))


def _theil_sen_slope(x: Floats, y: Floats) -> float:
    """Return the median slope over all pairs of points with x ascending; importing scipy.stats would take a second."""
    first, second = np.triu_indices(x.size, 1)
    return float(np.median((y[second] - y[first]) / (x[second] - x[first])))


def residual_ns(tags: Pairs, pairs: Pairs, line: TagLine) -> Floats:
    """Return the residuals of the receiver's tags from the line, (pair,) float64, nanoseconds."""
    rx_tag = tags[1][pairs[1]]
    return np.asarray(rx_tag - tags[0][pairs[0]] - _offset_ns(rx_tag, line), np.float64)


def _offset_ns(rx_tag: Integers, line: TagLine) -> Floats:
    return np.asarray(line.offset_ns + line.drift * (rx_tag - line.origin_ns), np.float64)


# ---- Association


@dataclass(frozen=True)
class Association:
    """Pairs of transmitted pulses and their captures by a receiver.

    Attributes
    ----------
    tx_index, rx_index
        (pair,) int64, pulse indices in the two recordings, both strictly ascending.
    offset_s
        Time tag of the receiver minus time tag of the transmitter at the first pair, seconds.
    drift_ppm
        Drift of this offset, parts per million.
    residual_s
        RMS residual of the tags from the offset line, seconds.
    method
        Basis of the association: frame numbers or time tags.
    outlier
        (pair,) bool, True where the tags deviate from the line by more than the accuracy of a tag: one of the two tags
        is wrong.
    tx_dropped, rx_dropped
        Number of unpaired pulses of each recording.
    flags
        Flag → measured values, one line.
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

    If both nodes record frame numbers, pulses are associated by frame number. Otherwise, the tags of the receiver are
    assumed to deviate by less than half a repetition interval at the first pulse, and to drift by at most 100 ppm.

    Parameters
    ----------
    tx_time_ns, rx_time_ns
        (pulse,) int64, UTC time tags from the clock of each node, nanoseconds, ascending, with any common origin.
    repetition_interval_s
        Nominal time between pulses, seconds.
    tx_frame, rx_frame
        (pulse,) int64, frame numbers, -1 where the payload was not decoded; None without a counter.
    frame_modulus
        Count at which the counter returns to zero. None: the next power of two above the largest number if a counter
        steps back; otherwise the counters do not wrap.
    speed_m_s
        Speed of the transmitter, metres per second, with which a tag offset is converted to a displacement; None:
        unknown.
    where
        Name of the recordings in error messages.

    Raises
    ------
    CampaignError
        If tags do not ascend, if the counters have no frame in common, or if no pair lies within half a repetition
        interval.

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
        if pairs[0].size:  # second iteration, with the line fitted to the first pairs
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
    descents = np.flatnonzero(np.diff(tags) <= 0)
    if descents.size or tags.size == 0:
        found = (
            f"the time tag of pulse {descents[0] + 1} of the {node} is not later than the previous time tag"
            if tags.size
            else f"the recording of the {node} contains no pulses"
        )
        raise CampaignError(
            found, where, expected="ascending time tags", remedy="Check core:datetime of the capture segments."
        )


def _no_common_pulse(tags: Pairs, repetition_interval_s: float, where: str) -> CampaignError:
    gap_s = [(tags[1][0] - tags[0][0]) * 1e-9, (tags[1][-1] - tags[0][-1]) * 1e-9]
    return CampaignError(
        f"no pulse pairs: start and end of the receiver's recording differ by {gap_s[0]:+.3f} s and {gap_s[1]:+.3f} s "
        "from start and end of the transmitter's recording",
        where=where,
        expected=f"pairs within half a repetition interval ({repetition_interval_s / 2:.4g} s)",
        remedy="Check that both recordings belong to the same flight, and check core:datetime in both recordings.",
    )


def _agreed_pairs(
    tags: Pairs, by_frame: Pairs, frames: tuple[Integers | None, Integers | None], interval_ns: float
) -> tuple[Pairs, int]:
    """Remove frame pairs that contradict the tags, add pairs without a decoded number, and count the removed pairs."""
    if by_frame[0].size == 0:
        return by_frame, 0
    line = fit_pairs(tags, by_frame, interval_ns)
    agreed = np.abs(residual_ns(tags, by_frame, line)) < interval_ns / 2
    tx, rx = by_frame[0][agreed], by_frame[1][agreed]
    by_tag = nearest_pairs(tags, line, interval_ns)
    unread = (np.asarray(frames[0])[by_tag[0]] == ABSENT) | (np.asarray(frames[1])[by_tag[1]] == ABSENT)
    unpaired = unread & ~np.isin(by_tag[0], tx) & ~np.isin(by_tag[1], rx)
    tx, rx = np.concatenate([tx, by_tag[0][unpaired]]), np.concatenate([rx, by_tag[1][unpaired]])
    order = np.argsort(tx)
    tx, rx = tx[order], rx[order]
    ascending = np.concatenate([[True], rx[1:] > np.maximum.accumulate(rx)[:-1]]) if rx.size else np.zeros(0, bool)
    return (tx[ascending], rx[ascending]), int((~agreed).sum())


# ---- Pairs by frame number


def pairs_by_frame(
    tags: Pairs, frames: tuple[Integers | None, Integers | None], interval_ns: float, modulus: int | None
) -> Pairs | None:
    """Return pairs with equal frame numbers after unwrapping the counters; None if a node has no counter."""
    if frames[0] is None or frames[1] is None:
        return None
    tx, rx = (np.flatnonzero(frame != ABSENT) for frame in (frames[0], frames[1]))
    if tx.size == 0 or rx.size == 0:
        return None
    tx_count, rx_count = frames[0][tx].astype(np.int64), frames[1][rx].astype(np.int64)
    if modulus is None and ((np.diff(tx_count) < 0).any() or (np.diff(rx_count) < 0).any()):
        modulus = 1 << int(max(tx_count.max(), rx_count.max())).bit_length()
    if modulus is not None:
        tx_count = unwrapped(tx_count, tags[0][tx], interval_ns, modulus)
        rx_count = unwrapped(rx_count, tags[1][rx], interval_ns, modulus)
        # the number of counter wraps between the nodes follows from the offset of their tags
        expected_ns = tags[0][tx[0]] + (rx_count - tx_count[0]) * interval_ns
        rx_count += modulus * int(np.rint(np.median(tags[1][rx] - expected_ns) / (modulus * interval_ns)))
    _, at_tx, at_rx = np.intersect1d(tx_count, rx_count, return_indices=True)
    return tx[at_tx], rx[at_rx]


def unwrapped(count: Integers, tags: Integers, interval_ns: float, modulus: int) -> Integers:
    """Unwrap a frame counter by time tags; a misread number does not affect later numbers.

    Examples
    --------
    >>> unwrapped(np.array([6, 7, 1]), np.array([0, 50, 150]), interval_ns=50.0, modulus=8)
    array([6, 7, 9])
    """
    step = np.mod(np.diff(count), modulus)
    step += modulus * np.rint((np.diff(tags) / interval_ns - step) / modulus).astype(np.int64)
    return np.asarray(count[0] + np.concatenate([[0], np.cumsum(step)]), np.int64)


# ---- Flags of an association

LARGEST_JITTER = 1 / 6
"""RMS scatter of the tags, in repetition intervals, at which one tag in 370 (3σ) is closer to an adjacent pulse."""

AMBIGUOUS_SHARE = 0.4
"""Largest offset, in repetition intervals, that is considered unambiguous. Beyond one half, an adjacent pulse is
closer; the difference is a margin."""

LARGEST_OFFSET_S = 20e-3
"""Largest offset between the tags of two nodes, seconds, that is explained by errors of a few milliseconds each."""

OUTLIER_S = 5e-3
"""Largest deviation of a time tag from the fitted line that is attributed to time-tag accuracy, seconds."""

_OUTLIER_SIGMA = 6.0  # standard deviations of all tags: an outlier exceeds both this and `OUTLIER_S`

LARGEST_UNPAIRED = 0.05
"""Fraction of the transmitted pulses before or after the recording of the receiver, above which a flag is raised."""

_FEW = 2  # number of pulses by which a recorder may start late or stop early


def is_outlier(residual_s: Floats) -> NDArray[np.bool_]:
    """Detect tags that deviate from the line by more than `OUTLIER_S` and six standard deviations, (pair,) bool.

    Examples
    --------
    >>> is_outlier(np.array([0.0, 1e-4, -1e-4, 2e-4, 0.03, -1e-4]))
    array([False, False, False, False,  True, False])
    """
    size = np.abs(residual_s)
    return np.asarray(size > max(OUTLIER_S, _OUTLIER_SIGMA * 1.4826 * float(np.median(size))))


def tag_jitter_s(time_ns: Integers) -> float:
    """Return the RMS error of the tags of a node relative to the equal intervals of a radar timer, seconds.

    Parameters
    ----------
    time_ns
        (pulse,) int64, tags of one node, ascending; missing pulses have no effect.

    Notes
    -----
    The result is an upper bound if the trigger intervals are unequal. An error common to all tags is not measured.

    Examples
    --------
    >>> regular = np.arange(100) * 50_000_000
    >>> tag_jitter_s(np.delete(regular, [7, 8])), round(tag_jitter_s(regular + np.arange(100) % 2 * 2_000_000), 5)
    (0.0, 0.001)
    """
    if time_ns.size < 3:
        return 0.0
    steps = np.diff(time_ns)
    # pulse number, counting missing pulses
    number = np.concatenate([[0.0], np.cumsum(np.round(steps / np.median(steps)))])
    elapsed_s = (time_ns - time_ns[0]) * 1e-9
    return round(float(np.std(elapsed_s - np.polyval(np.polyfit(number, elapsed_s, 1), number))), 9)


def association_flags(
    association: "Association", tags: Pairs, interval_s: float, *, conflicts: int, speed_m_s: float | None
) -> dict[str, str]:
    """Return the flags of an association: name of the flag → measured values, one line.

    Parameters
    ----------
    association
        Association of the pulses, without flags.
    tags
        (pulse,) int64 tags of transmitter and receiver, nanoseconds.
    interval_s
        Nominal time between pulses, seconds.
    conflicts
        Number of pairs by frame number that contradict the tags.
    speed_m_s
        Speed of the transmitter; None: unknown.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association".
    """
    flags = {}
    share, by_tags = abs(association.offset_s) / interval_s, association.method == "time tags"
    if by_tags and share > AMBIGUOUS_SHARE:
        flags["association_ambiguous"] = (
            f"time tags differ by {association.offset_s:+.4f} s, which is {share:.2f} repetition intervals: "
            "all pairs may be wrong by one pulse"
        )
    if abs(association.offset_s) > LARGEST_OFFSET_S:
        flags["time_tag_offset"] = _offset_line(association, speed_m_s)
    if conflicts:
        flags["frame_counter_conflict"] = (
            f"{number_of(conflicts, 'pulse')} excluded: frame counter and time tags disagree"
        )
    if by_tags and association.residual_s > interval_s * LARGEST_JITTER:
        flags["time_tag_jitter"] = (
            f"time tags scatter by {association.residual_s:.4f} s rms at a repetition interval of {interval_s:.4g} s: "
            "individual captures may be paired with an adjacent pulse"
        )
    if association.outlier.any():
        flags["time_tag_outlier"] = (
            f"{int(association.outlier.sum())} of {association.outlier.size} pulses excluded: "
            f"their time tags deviate from the line fitted to all tags by more than {OUTLIER_S:g} s"
        )
    pairs = association.tx_index.size
    shorter = pairs + min(association.tx_dropped, association.rx_dropped)
    if pairs < shorter / 2:
        flags["association_sparse"] = f"{pairs} of the {shorter} pulses in the shorter recording are paired"
    unpaired = _unpaired(association, tags, interval_s)
    if unpaired:
        flags["pulses_unpaired"] = unpaired
    return flags


def _offset_line(association: "Association", speed_m_s: float | None) -> str:
    line = f"time tags of the nodes differ by {association.offset_s:+.4f} s (pairs by {association.method})"
    if speed_m_s is None:
        return line
    moved_m = abs(association.offset_s) * speed_m_s
    return f"{line}: the tags of the transmitter are used; in this time, the transmitter moved by {moved_m:.2f} m"


def _unpaired(association: "Association", tags: Pairs, interval_s: float) -> str | None:
    """Report transmitted pulses before the first and after the last pair, if their fraction is too large."""
    tx, rx = tags
    early, late = int(association.tx_index[0]), tx.size - 1 - int(association.tx_index[-1])
    if early + late <= max(LARGEST_UNPAIRED * tx.size, _FEW):
        return None
    line = f"of {tx.size} transmitted pulses, {early} are before and {late} after the recording of the receiver"
    start_s, end_s = (rx[0] - tx[0]) * 1e-9, (rx[-1] - tx[-1]) * 1e-9
    if abs(start_s - end_s) <= 1.5 * interval_s < abs(start_s):
        line += (
            f": the recordings are equally long, and their starts differ by {start_s:+.3f} s, which suggests that the "
            "time tags of one recording are wrong by this offset"
        )
    return line


# ---- Check of the association: comparison of the sidelink delay with the baseline of the tracks

EXPLAINED_M = 0.05
"""Residual of a sidelink path, metres, that may be due to errors of the logged positions alone."""

SIGMAS = 5.0
"""Threshold in standard deviations of the noise of a median. In 1000 windows that contain only noise, the threshold is
exceeded in one of 3000 flights."""

_MEDIAN_PULSES = 15, 61, 241
"""Lengths (odd) of the running medians that separate motion from jitter; longer medians have less noise and less
bandwidth."""

_ENOUGH = 64  # disjoint windows required to estimate the noise of the median


@dataclass(frozen=True)
class BaselineResidual:
    """Difference of the measured delay from the baseline, after removal of a constant and a linear drift.

    Attributes
    ----------
    residual_m, noise_m
        RMS of the running median of the residual, and standard deviation of this median caused by jitter alone, metres.
    jitter_m
        Standard deviation of a single pulse, metres; mostly trigger jitter.
    largest_m, pulse
        Largest magnitude of the running median, metres, and the pulse at which it occurs.
    excess
        `largest_m` relative to the threshold for noise and position errors, maximum over the running medians.
    """

    residual_m: float
    noise_m: float
    jitter_m: float
    largest_m: float
    pulse: int
    excess: float


def baseline_residual(delay_m: Floats, baseline_m: Floats) -> BaselineResidual | None:
    """Return the difference between measured and geometric path of a sidelink; None for fewer than 30 pulses.

    Parameters
    ----------
    delay_m, baseline_m
        (pulse,) float64, metres: measured delay of the sidelink multiplied by c, NaN in pulses without lock; and
        distance between the antennas of the sidelink.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". Only complete windows are evaluated, because a window beyond the
    end would repeat the last pulse.

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
    return max(residuals, key=lambda residual: residual.excess)


def _smoothed(pulse: NDArray[np.intp], residual: Floats, jitter_m: float, width: int) -> BaselineResidual:
    """Return the residual measured by a running median of `width` pulses."""
    from scipy import ndimage

    inside = slice(width // 2, -(width // 2))  # complete windows only
    smooth, middle = ndimage.median_filter(residual, width)[inside], pulse[inside]
    smooth = smooth - np.polyval(np.polyfit(middle, smooth, 1), middle)
    noise_m = 1.2533 * jitter_m / np.sqrt(width)  # standard deviation of a median of `width` Gaussian samples
    steps = np.diff(smooth[::width])
    if steps.size >= _ENOUGH:  # jitter may not be Gaussian: the median of uniform jitter has more noise
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
    """Return the threshold, standard deviations, for the maximum over several windows at a constant false-alarm rate.

    Examples
    --------
    >>> sigmas(500), round(sigmas(300_000), 2)
    (5.0, 6.03)
    """
    return float(np.sqrt(SIGMAS**2 + 2 * np.log(max(1.0, windows / 1000))))


def detect_wrong_association(residual: BaselineResidual | None) -> str | None:
    """Report a deviation of the measured sidelink path from the geometry, in one line; None if there is none.

    A constant and a linear drift are attributed to the clocks. Trigger jitter does not explain a residual that exceeds
    both `EXPLAINED_M` and five standard deviations of the median (six in a long flight): captures are assigned to wrong
    pulses, or positions are wrong.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". A wrong association is detectable only if the baseline changes
    during the flight.

    Examples
    --------
    >>> distance = 5 + np.sin(np.arange(200) / 20)
    >>> detect_wrong_association(baseline_residual(distance + 3.0, distance)) is None
    True
    >>> detect_wrong_association(baseline_residual(np.roll(distance, 9), distance))
    'the measured sidelink path deviates from the geometry by ... m at pulse ... (noise ... m): wrong ...'
    """
    if residual is None or residual.excess <= 1:
        return None
    return (
        f"the measured sidelink path deviates from the geometry by {residual.largest_m:.2f} m at pulse "
        f"{residual.pulse} (noise {residual.noise_m:.3f} m): wrong association or wrong positions"
    )


# ---- Missing pulses

LARGEST_SIDELOBE = 0.1
"""Largest tolerated sidelobe from missing pulses, amplitude relative to the peak: -20 dB, as caused by a gap of a tenth
of the aperture."""


def missing_pulses(time_ns: Integers) -> tuple[int, float]:
    """Return the number of missing pulses between the first and the last pulse, and the highest sidelobe due to gaps.

    Parameters
    ----------
    time_ns
        (pulse,) int64, tags of the recorded pulses, ascending; most are separated by one interval.

    Returns
    -------
    tuple
        Number of missing pulses; amplitude of the sidelobe relative to the peak.

    Notes
    -----
    The response of the aperture is the response of all pulses minus that of the missing pulses. At one resolution cell
    or more from the peak (k ≥ 1), it is |Σ_missing exp(j2πkm/M)|/used. Source: docs/theory/planner.md, "Pulses".

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
    usual = np.partition(steps, middle := (len(steps) - 1) // 2)[middle]  # the lower median is always one of the steps
    single = steps[np.abs(steps / usual - 1) < 0.25].mean()
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / single), 1).astype(np.int64))])
    absent = np.ones(number[-1] + 1)
    absent[number] = 0
    response = np.abs(np.fft.rfft(absent, 4 * absent.size))[4:]
    return int(absent.sum()), float(response.max()) / time_ns.size


def missing_flags(time_ns: Integers) -> dict[str, str]:
    """Return a flag if missing pulses cause sidelobes above `LARGEST_SIDELOBE`; parameters as for `missing_pulses`."""
    flags = {}
    missing, sidelobe = missing_pulses(time_ns)
    if sidelobe > LARGEST_SIDELOBE:
        flags["pulses_missing"] = (
            f"{missing} of {missing + time_ns.size} pulses within the aperture are missing: "
            f"sidelobes of up to {20 * np.log10(sidelobe):.0f} dB along track"
        )
    return flags
