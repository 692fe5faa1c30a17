"""What autopilots log: a receiver's epochs in UTC, and attitude by a clock that counts from the autopilot's start."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.formats.times import utc_times
from apertura.formats.tracks.boot_clock import clock_of
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.own_velocity import contradicted
from apertura.formats.tracks.track import make_track

Floats = NDArray[np.float64]

_WORST_STD_M = 1e4
_UNIT = 1e-2
_HELD_S, _LONGEST_S = 0.5, 1.0
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
        By how much the autopilot hears of an epoch late, s.
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
    stated = np.where((epochs.std_m > 0) & (epochs.std_m < _WORST_STD_M), epochs.std_m, np.nan)
    return make_track(
        epochs.time_utc,
        epochs.geodetic,
        attitude_deg=angles,
        position_std_m=stated if np.isfinite(stated).any() else None,
        fix=epochs.fix,
        dropped=dropped,
        node=node,
        where=where,
    )


def _counted(boot_s: Floats, options: LogOptions, node: str, where: Path) -> NDArray[np.datetime64]:
    """Return UTC of a log in which only the autopilot's clock tells time."""
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
    """Return which epochs are the one before once more."""
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
    held = np.clip(boot_s, time[0], time[-1])
    angles = Slerp(time, turns)(held).as_euler("ZYX", degrees=True)[:, ::-1]
    following = np.clip(np.searchsorted(time, held), 1, time.size - 1)
    unknown = (np.abs(boot_s - held) > _HELD_S) | (time[following] - time[following - 1] > _LONGEST_S)
    return np.where(unknown[:, None], np.nan, angles)
