"""Logs of autopilots: a receiver's epochs in UTC, attitude by a clock from start, Doppler velocities."""

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

# ---- Autopilot's clock against UTC: a line through its receiver's times ---------------------------------------------


_AGREES_S = 0.25  # receivers' messages are late by about 0.1 s, and now and then by some tens of milliseconds more
_FASTEST = 1e-4  # the worst of quartz clocks
_MOST_AGREE = 0.9


@dataclass(frozen=True)
class BootClock:
    """The autopilot's clock against UTC: UTC = origin + offset_s + rate·boot_s, when it heard of epochs.

    Attributes
    ----------
    origin
        Some UTC near the log.
    offset_s, rate
        Of the line.
    delay_s
        By how much later than they were true epochs are heard of.
    """

    origin: np.datetime64
    offset_s: float
    rate: float
    delay_s: float

    def utc(self, boot_s: Floats) -> NDArray[np.datetime64]:
        """Return UTC of the autopilot's clock.

        Examples
        --------
        >>> clock = BootClock(np.datetime64("2025-05-14T09:30:00", "ns"), 0.0, 1.0, 0.1)
        >>> str(clock.utc(np.array([1.1]))[0])
        '2025-05-14T09:30:01.200000000'
        """
        since = self.offset_s + self.rate * (boot_s + self.delay_s)
        return np.asarray(self.origin + np.rint(since * 1e9).astype("timedelta64[ns]"))

    def boot_s(self, utc: NDArray[np.datetime64]) -> Floats:
        """Return the autopilot's clock at UTC."""
        return (seconds_since(utc, self.origin) - self.offset_s) / self.rate - self.delay_s


def clock_of(
    boot_s: Floats, time_utc: NDArray[np.datetime64], *, delay_s: float, where: Path
) -> tuple[BootClock, NDArray[np.bool_]]:
    """Return the autopilot's clock against UTC as a robust line, and which epochs agree with it.

    Parameters
    ----------
    boot_s, time_utc
        (epoch,): the autopilot's clock when it heard of epochs, and their times.
    delay_s
        Latency of the receiver's messages, s.
    where
        The log, for messages.

    Raises
    ------
    CampaignError
        If more than a tenth of the epochs is 0.25 s off, as where the receiver learns of a leap second late.

    Examples
    --------
    >>> times = np.datetime64("2025-05-14T09:30:00", "ns") + np.array([0, 1, 2]) * np.timedelta64(1, "s")
    >>> clock, agree = clock_of(np.array([5.0, 6.0, 7.1]), times, delay_s=0.0, where=Path("x.ulg"))
    >>> str(clock.utc(np.array([6.0]))[0]), bool(agree.all())
    ('2025-05-14T09:30:01.000000000', True)
    """
    origin, zero = time_utc[0], float(np.median(boot_s))
    since = seconds_since(time_utc, origin)
    ahead, beside = since - boot_s, boot_s - zero
    line = np.array([0.0, float(np.median(ahead))])
    reach = _AGREES_S + _FASTEST * float(np.ptp(boot_s)) / 2
    for _ in range(2):  # outliers of seconds are removed before the rest is fitted
        near = np.abs(ahead - np.polyval(line, beside)) <= reach
        if near.sum() >= 8 and np.ptp(beside[near]) * _FASTEST > 0.01:
            line = np.polyfit(beside[near], ahead[near], 1)
        elif near.any():
            line = np.array([0.0, float(np.median(ahead[near]))])
        reach = _AGREES_S
    off = np.abs(ahead - np.polyval(line, beside))
    agree = off <= _AGREES_S
    if agree.mean() < _MOST_AGREE:
        first = int(np.flatnonzero(~agree)[0])
        raise CampaignError(
            f"{int((~agree).sum())} of {agree.size} times of the receiver do not fit the autopilot's clock; epoch "
            f"{first} at {time_utc[first]} is {off[first]:.2f} s off",
            where,
            f"one line within {_AGREES_S} s",
            "Cut the log where the receiver corrects its time, or take another source (nodes.<node>.log.body).",
        )
    slope, middle = (float(one) for one in line)
    return BootClock(origin, middle - slope * zero, 1 + slope, delay_s), agree


# ---- A receiver's positions against its own Doppler velocities ------------------------------------------------------

_NEAR_M, _CURVED_M_S2 = 0.5, 2.5  # noise of both; an eighth of the 20 m/s² by which velocity may bend between epochs
_MOST, _FEW = 0.5, 10


def contradicted(time_utc: NDArray[np.datetime64], geodetic: Floats, velocity: Floats) -> NDArray[np.bool_]:
    """Return a mask of the epochs that are not where their neighbours and the velocities lead.

    A step that starts or ends at an epoch misses by |p_{i+1} − p_i − (v_i + v_{i+1})·Δt/2|; an epoch whose steps all
    miss is contradicted. Where more than half of ten or more steps miss, it is the velocities that are wrong: no epoch
    is.

    Parameters
    ----------
    time_utc
        (epoch,) datetime64[ns].
    geodetic
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m).
    velocity
        (epoch, 3) float64 to north, east and down, m/s; NaN where not known.

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
    >>> place = np.tile([0.0, 9.0, 600.0], (30, 1))
    >>> place[7, 2] += 1
    >>> np.flatnonzero(contradicted(times, place, np.zeros((30, 3)))).tolist()
    [7]
    """
    wrong = np.zeros(len(time_utc), bool)
    if len(wrong) < 3:
        return wrong
    ends = velocity[:-1], velocity[1:]  # of each step; one stands in for the other where that is not known
    with np.errstate(invalid="ignore"):  # of what is no place on Earth, which is refused later
        position = ecef_from_geodetic(*geodetic.T)
        steps = np.einsum("eij,ei->ej", ned_axes(position)[:-1], np.diff(position, axis=0))
        lasting = (np.diff(time_utc) / np.timedelta64(1, "s"))[:, None]
        before, after = (np.where(np.isnan(v), w, v) for v, w in (ends, ends[::-1]))
        missed = steps - (before + after) / 2 * lasting
        far = (np.abs(missed) > _NEAR_M + _CURVED_M_S2 * lasting**2).any(axis=1)  # NaN is not
    if far.size >= _FEW and far.mean() > _MOST:
        return wrong
    return np.asarray(np.concatenate([[True], far]) & np.concatenate([far, [True]]))


# ---- Logs of autopilots: receiver's epochs in UTC, attitude by its clock --------------------------------------------

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
        (sample,) float64: the autopilot's clock.
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
        (epoch,) float64: the autopilot's clock when it heard of the epoch.
    time_utc
        (epoch,) datetime64[ns], NaT where the log knows none.
    geodetic
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m), NaN where there is none.
    fixed
        (epoch,) bool: positions in three dimensions.
    fix
        (epoch,) int8: a value of `FIXES`; None: not logged.
    std_m
        (epoch, 3) float64: to north, east and up; values that no receiver states become NaN.
    velocity
        (epoch, 3) float64 to north, east and down, m/s, NaN where not logged.
    """

    boot_s: Floats
    time_utc: NDArray[np.datetime64]
    geodetic: Floats
    fixed: NDArray[np.bool_]
    fix: NDArray[np.int8] | None
    std_m: Floats
    velocity: Floats

    def only(self, kept: NDArray[np.bool_]) -> "Epochs":
        """Return the epochs that are kept."""
        fix = None if self.fix is None else self.fix[kept]
        placed = self.boot_s[kept], self.time_utc[kept], self.geodetic[kept]
        return Epochs(*placed, self.fixed[kept], fix, self.std_m[kept], self.velocity[kept])


def autopilot_track(
    epochs: Epochs, attitude: Attitude | None, *, delay_s: float, options: LogOptions, node: str, where: Path
) -> xr.Dataset:
    """Return the `track` stage of an autopilot's log.

    Epochs without a fix, height or time of their own, those that the log holds twice, whose time is not that of the
    autopilot's clock or whose place is not where the receiver's velocity leads are left out and counted. Attitude is
    taken where the autopilot was when an epoch was true.

    Parameters
    ----------
    epochs
        As logged.
    attitude
        None: not logged.
    delay_s
        Latency of an epoch in the autopilot, s.
    options
        start_utc: time zero of the autopilot's clock, where no epoch has a time.
    node, where
        As `make_track`.

    Raises
    ------
    CampaignError
        If no epoch has a time and the config names none, or as `clock_of` and `make_track`.
    """
    dropped: dict[str, int] = {}

    def without(wrong: NDArray[np.bool_], why: str) -> Epochs:
        if wrong.any():
            dropped[why] = int(wrong.sum())
        return epochs.only(~wrong)

    epochs = without(~epochs.fixed, "no fix")
    epochs = without(~np.isfinite(epochs.geodetic.sum(axis=1)), "no ellipsoidal height")
    if epochs.time_utc.size and np.isnat(epochs.time_utc).all():
        epochs = replace(epochs, time_utc=_counted(epochs.boot_s, options, node, where))
    epochs = without(np.asarray(np.isnat(epochs.time_utc)), "no time of the receiver")
    epochs = without(_repeated(epochs), "held twice")
    angles = None
    if epochs.boot_s.size:
        clock, agree = clock_of(epochs.boot_s, epochs.time_utc, delay_s=delay_s, where=where)
        epochs = without(~agree, "a time that is not the autopilot's")
        moved = contradicted(epochs.time_utc, epochs.geodetic, epochs.velocity)
        epochs = without(moved, "not where the receiver's velocity leads")
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
    """Return UTC of a log that has no clock but the autopilot's."""
    key = f"nodes.{node}.log.start_utc"
    try:
        start = utc_times([options.start_utc or ""])[0]
    except ValueError as error:
        raise CampaignError(
            "no epoch has a time in UTC" if options.start_utc is None else f"{key}: {error}",
            where,
            f"a receiver that tells UTC, or {key}: UTC at the autopilot's start, 2025-05-14T09:30:00.5",
            f"Set {key}.",
        ) from error
    return np.asarray(start + np.rint(boot_s * 1e9).astype("timedelta64[ns]"))


def _repeated(epochs: Epochs) -> NDArray[np.bool_]:
    """Return a mask of the epochs that repeat the one before."""
    same = np.zeros(epochs.boot_s.size, bool)
    same[1:] = (np.diff(epochs.geodetic, axis=0) == 0).all(axis=1) & (epochs.time_utc[1:] == epochs.time_utc[:-1])
    return same


def _angles_deg(attitude: Attitude, boot_s: Floats) -> Floats | None:
    """Return (epoch, 3) roll, pitch, yaw in degrees at the autopilot's clock; NaN where none was logged around it."""
    from scipy.spatial.transform import Rotation, Slerp

    norm = np.linalg.norm(attitude.quaternion, axis=1)
    good = np.isfinite(attitude.boot_s) & (np.abs(norm - 1) < _UNIT)
    time, order = np.unique(attitude.boot_s[good], return_index=True)
    if time.size < 2:
        return None
    turns = Rotation.from_quat(attitude.quaternion[good][order])
    # one that its neighbours, who agree, both contradict is none that was flown
    before, after, across = ((turns[:-n].inv() * turns[n:]).magnitude() for n in (1, 1, 2))
    alone = np.zeros(time.size, bool)
    alone[1:-1] = np.minimum(before[:-1], after[1:]) > across + _TURN_RAD
    time, turns = time[~alone], turns[~alone]
    within_s = np.clip(boot_s, time[0], time[-1])
    angles = Slerp(time, turns)(within_s).as_euler("ZYX", degrees=True)[:, ::-1]
    following = np.clip(np.searchsorted(time, within_s), 1, time.size - 1)
    unknown = (np.abs(boot_s - within_s) > _EXTRAPOLATED_S) | (time[following] - time[following - 1] > _LONGEST_S)
    return np.where(unknown[:, None], np.nan, angles)
