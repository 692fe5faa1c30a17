"""Logs of autopilots: GNSS epochs in UTC, attitude with times of the autopilot's clock, Doppler velocities."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.formats.times import utc_times
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.track import make_track

# ---- Autopilot's clock relative to UTC: line fitted to the times of the receiver ------------------------------------


_AGREES_S = 0.25  # latency of receiver messages: about 0.1 s, occasionally some tens of milliseconds more
_FASTEST = 1e-4  # largest rate error of a quartz clock
_MOST_AGREE = 0.9


@dataclass(frozen=True)
class BootClock:
    """Autopilot's clock relative to UTC: UTC = origin + offset_s + rate·boot_s at the reception of epochs.

    Attributes
    ----------
    origin
        Reference UTC near the log.
    offset_s, rate
        Offset and slope of the line.
    delay_s
        Latency between an epoch and its reception by the autopilot, s.
    """

    origin: np.datetime64
    offset_s: float
    rate: float
    delay_s: float

    def utc(self, boot_s: Floats) -> NDArray[np.datetime64]:
        """Convert times of the autopilot's clock to UTC.

        Examples
        --------
        >>> clock = BootClock(np.datetime64("2025-05-14T09:30:00", "ns"), 0.0, 1.0, 0.1)
        >>> str(clock.utc(np.array([1.1]))[0])
        '2025-05-14T09:30:01.200000000'
        """
        since = self.offset_s + self.rate * (boot_s + self.delay_s)
        return np.asarray(self.origin + np.rint(since * 1e9).astype("timedelta64[ns]"))

    def boot_s(self, utc: NDArray[np.datetime64]) -> Floats:
        """Convert UTC to times of the autopilot's clock."""
        return (seconds_since(utc, self.origin) - self.offset_s) / self.rate - self.delay_s


def clock_of(
    boot_s: Floats, time_utc: NDArray[np.datetime64], *, delay_s: float, where: Path
) -> tuple[BootClock, NDArray[np.bool_]]:
    """Fit the autopilot's clock relative to UTC by a robust line; also return a mask of the epochs that agree with it.

    Parameters
    ----------
    boot_s, time_utc
        (epoch,): times of the autopilot's clock at the reception of epochs, and UTC of the epochs.
    delay_s
        Latency of the receiver's messages, s.
    where
        The log, for messages.

    Raises
    ------
    CampaignError
        If more than a tenth of the epochs deviates by more than 0.25 s, for example because the receiver applies a leap
        second late.

    Examples
    --------
    >>> times = np.datetime64("2025-05-14T09:30:00", "ns") + np.array([0, 1, 2]) * np.timedelta64(1, "s")
    >>> clock, agree = clock_of(np.array([5.0, 6.0, 7.1]), times, delay_s=0.0, where=Path("x.ulg"))
    >>> str(clock.utc(np.array([6.0]))[0]), bool(agree.all())
    ('2025-05-14T09:30:01.000000000', True)
    """
    origin, zero = time_utc[0], float(np.median(boot_s))
    since = seconds_since(time_utc, origin)
    ahead, centred_s = since - boot_s, boot_s - zero
    line = np.array([0.0, float(np.median(ahead))])
    tolerance_s = _AGREES_S + _FASTEST * float(np.ptp(boot_s)) / 2
    for _ in range(2):  # the first pass removes outliers of several seconds
        near = np.abs(ahead - np.polyval(line, centred_s)) <= tolerance_s
        if near.sum() >= 8 and np.ptp(centred_s[near]) * _FASTEST > 0.01:
            line = np.polyfit(centred_s[near], ahead[near], 1)
        elif near.any():
            line = np.array([0.0, float(np.median(ahead[near]))])
        tolerance_s = _AGREES_S
    residual_s = np.abs(ahead - np.polyval(line, centred_s))
    agree = residual_s <= _AGREES_S
    if agree.mean() < _MOST_AGREE:
        first = int(np.flatnonzero(~agree)[0])
        raise CampaignError(
            f"{int((~agree).sum())} of {agree.size} times of the receiver disagree with the autopilot's clock; epoch "
            f"{first} at {time_utc[first]} differs by {residual_s[first]:.2f} s",
            where,
            f"agreement within {_AGREES_S} s",
            "Cut the log where the receiver corrects its time, or select another source (nodes.<node>.log.body).",
        )
    slope, middle = (float(coefficient) for coefficient in line)
    return BootClock(origin, middle - slope * zero, 1 + slope, delay_s), agree


# ---- Consistency of a receiver's positions and Doppler velocities ---------------------------------------------------

_NEAR_M, _CURVED_M_S2 = 0.5, 2.5  # noise of position and velocity; 1/8 of the largest acceleration, 20 m/s²
_MOST, _FEW = 0.5, 10


def contradicted(time_utc: NDArray[np.datetime64], geodetic: Floats, velocity: Floats) -> NDArray[np.bool_]:
    """Return a mask of the epochs whose positions contradict their neighbours and the velocities.

    The residual of the step from an epoch to the next is |p_{i+1} − p_i − (v_i + v_{i+1})·Δt/2|; the position of an
    epoch is rejected if the residuals of all its steps are too large. If more than half of ten or more steps have too
    large a residual, the velocities are assumed to be wrong, and no position is rejected.

    Parameters
    ----------
    time_utc
        (epoch,) datetime64[ns].
    geodetic
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m).
    velocity
        (epoch, 3) float64: velocity to north, east and down, m/s; NaN where unknown.

    Returns
    -------
    ndarray
        (epoch,) bool.

    Notes
    -----
    Source: docs/theory/autopilots.md, eq. 2.

    Examples
    --------
    >>> times = np.datetime64("2025-05-14T09:30", "ns") + np.arange(30) * np.timedelta64(100, "ms")
    >>> geodetic = np.tile([0.0, 9.0, 600.0], (30, 1))
    >>> geodetic[7, 2] += 1
    >>> np.flatnonzero(contradicted(times, geodetic, np.zeros((30, 3)))).tolist()
    [7]
    """
    wrong = np.zeros(len(time_utc), bool)
    if len(wrong) < 3:
        return wrong
    ends = velocity[:-1], velocity[1:]  # at both ends of each step; an unknown one is replaced by that of the other end
    with np.errstate(invalid="ignore"):  # invalid coordinates are rejected later
        position = ecef_from_geodetic(*geodetic.T)
        steps = np.einsum("eij,ei->ej", ned_axes(position)[:-1], np.diff(position, axis=0))
        duration_s = (np.diff(time_utc) / np.timedelta64(1, "s"))[:, None]
        before, after = (np.where(np.isnan(v), w, v) for v, w in (ends, ends[::-1]))
        residual = steps - (before + after) / 2 * duration_s
        too_large = (np.abs(residual) > _NEAR_M + _CURVED_M_S2 * duration_s**2).any(axis=1)  # False for NaN
    if too_large.size >= _FEW and too_large.mean() > _MOST:
        return wrong
    return np.asarray(np.concatenate([[True], too_large]) & np.concatenate([too_large, [True]]))


# ---- Track of an autopilot's log: epochs of the receiver in UTC, interpolated attitude ------------------------------

_WORST_STD_M = 1e4
_UNIT = 1e-2
_EXTRAPOLATED_S, _LONGEST_S = 0.5, 1.0
_TURN_RAD = np.radians(10)


@dataclass(frozen=True, eq=False)
class Attitude:
    """Orientation of the forward-right-down body axes in north-east-down.

    Attributes
    ----------
    boot_s
        (sample,) float64: time of the autopilot's clock.
    quaternion
        (sample, 4) float64: x, y, z, w.
    """

    boot_s: Floats
    quaternion: Floats


@dataclass(frozen=True, eq=False)
class Epochs:
    """Epochs of a track, in the order of the log.

    Attributes
    ----------
    boot_s
        (epoch,) float64: time of the autopilot's clock at the reception of the epoch.
    time_utc
        (epoch,) datetime64[ns], NaT where not logged.
    geodetic
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m), NaN where not logged.
    fixed
        (epoch,) bool: True for a 3D fix.
    fix
        (epoch,) int8: solution type, a value of `FIXES`; None: not logged.
    std_m
        (epoch, 3) float64: standard deviations to north, east and up, m; implausible values become NaN.
    velocity
        (epoch, 3) float64: velocity to north, east and down, m/s, NaN where not logged.
    """

    boot_s: Floats
    time_utc: NDArray[np.datetime64]
    geodetic: Floats
    fixed: NDArray[np.bool_]
    fix: NDArray[np.int8] | None
    std_m: Floats
    velocity: Floats

    def only(self, kept: NDArray[np.bool_]) -> "Epochs":
        """Select the epochs of a mask."""
        fix = None if self.fix is None else self.fix[kept]
        times_and_positions = self.boot_s[kept], self.time_utc[kept], self.geodetic[kept]
        return Epochs(*times_and_positions, self.fixed[kept], fix, self.std_m[kept], self.velocity[kept])


def autopilot_track(
    epochs: Epochs, attitude: Attitude | None, *, delay_s: float, options: LogOptions, node: str, where: Path
) -> xr.Dataset:
    """Build the `track` stage of an autopilot's log.

    Epochs without a fix, height or UTC, repeated epochs, and epochs whose time contradicts the autopilot's clock or
    whose position contradicts the receiver's velocity are excluded and counted. Attitude is interpolated to the times
    of the epochs, corrected for their latency.

    Parameters
    ----------
    epochs
        Epochs as logged.
    attitude
        Attitude; None: not logged.
    delay_s
        Latency of an epoch in the autopilot, s.
    options
        start_utc: time zero of the autopilot's clock, if no epoch has UTC.
    node, where
        See `make_track`.

    Raises
    ------
    CampaignError
        If no epoch has UTC and start_utc is not configured; see also `clock_of` and `make_track`.
    """
    dropped: dict[str, int] = {}

    def without(wrong: NDArray[np.bool_], reason: str) -> Epochs:
        if wrong.any():
            dropped[reason] = int(wrong.sum())
        return epochs.only(~wrong)

    epochs = without(~epochs.fixed, "no fix")
    epochs = without(~np.isfinite(epochs.geodetic.sum(axis=1)), "no ellipsoidal height")
    if epochs.time_utc.size and np.isnat(epochs.time_utc).all():
        epochs = replace(epochs, time_utc=_counted(epochs.boot_s, options, node, where))
    epochs = without(np.asarray(np.isnat(epochs.time_utc)), "no UTC from the receiver")
    epochs = without(_repeated(epochs), "duplicate")
    angles = None
    if epochs.boot_s.size:
        clock, agree = clock_of(epochs.boot_s, epochs.time_utc, delay_s=delay_s, where=where)
        epochs = without(~agree, "time contradicts the autopilot's clock")
        is_contradicted = contradicted(epochs.time_utc, epochs.geodetic, epochs.velocity)
        epochs = without(is_contradicted, "position contradicts the receiver's velocity")
        angles = None if attitude is None else _angles_deg(attitude, clock.boot_s(epochs.time_utc))
    std_m = np.where((epochs.std_m > 0) & (epochs.std_m < _WORST_STD_M), epochs.std_m, np.nan)
    return make_track(
        epochs.time_utc,
        epochs.geodetic,
        attitude_deg=angles,
        position_std_m=std_m if np.isfinite(std_m).any() else None,
        fix=epochs.fix,
        dropped=dropped,
        node=node,
        where=where,
    )


def _counted(boot_s: Floats, options: LogOptions, node: str, where: Path) -> NDArray[np.datetime64]:
    """Convert times of the autopilot's clock to UTC with the configured time zero."""
    key = f"nodes.{node}.log.start_utc"
    try:
        start = utc_times([options.start_utc or ""])[0]
    except ValueError as error:
        raise CampaignError(
            "no epoch has a time in UTC" if options.start_utc is None else f"{key}: {error}",
            where,
            f"UTC of the receiver, or {key}: UTC at the start of the autopilot, such as 2025-05-14T09:30:00.5",
            f"Set {key}.",
        ) from error
    return np.asarray(start + np.rint(boot_s * 1e9).astype("timedelta64[ns]"))


def _repeated(epochs: Epochs) -> NDArray[np.bool_]:
    """Return a mask of the epochs that repeat the previous epoch."""
    same = np.zeros(epochs.boot_s.size, bool)
    same[1:] = (np.diff(epochs.geodetic, axis=0) == 0).all(axis=1) & (epochs.time_utc[1:] == epochs.time_utc[:-1])
    return same


def _angles_deg(attitude: Attitude, boot_s: Floats) -> Floats | None:
    """Interpolate roll, pitch and yaw, (epoch, 3) degrees, to times of the autopilot's clock; NaN in gaps of a log."""
    from scipy.spatial.transform import Rotation, Slerp

    norm = np.linalg.norm(attitude.quaternion, axis=1)
    good = np.isfinite(attitude.boot_s) & (np.abs(norm - 1) < _UNIT)
    time, order = np.unique(attitude.boot_s[good], return_index=True)
    if time.size < 2:
        return None
    rotations = Rotation.from_quat(attitude.quaternion[good][order])
    # outlier: differs from both neighbours by more than the neighbours differ from each other
    before, after, across = ((rotations[:-n].inv() * rotations[n:]).magnitude() for n in (1, 1, 2))
    is_outlier = np.zeros(time.size, bool)
    is_outlier[1:-1] = np.minimum(before[:-1], after[1:]) > across + _TURN_RAD
    time, rotations = time[~is_outlier], rotations[~is_outlier]
    within_s = np.clip(boot_s, time[0], time[-1])
    angles = Slerp(time, rotations)(within_s).as_euler("ZYX", degrees=True)[:, ::-1]
    following = np.clip(np.searchsorted(time, within_s), 1, time.size - 1)
    unknown = (np.abs(boot_s - within_s) > _EXTRAPOLATED_S) | (time[following] - time[following - 1] > _LONGEST_S)
    return np.where(unknown[:, None], np.nan, angles)
