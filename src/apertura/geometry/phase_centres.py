"""Where each antenna was at each pulse and how the body was turned, from a logged track, attitude and lever arms."""

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.errors import CampaignError
from apertura.geometry.geodesy import body_axes, ned_axes

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


def phase_centres(
    track_time: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    *,
    at: NDArray[np.datetime64],
    lever_arm_m: tuple[float, float, float],
    attitude_from: Literal["log", "course", "none"],
    where: object,
) -> NDArray[np.float64]:
    """Return the ECEF position of an antenna at given times.

    Parameters
    ----------
    track_time
        (epoch,) datetime64[ns], UTC.
    position
        (epoch, 3) float64, logged point, ECEF metres.
    attitude
        (epoch, 3) float64, roll, pitch, yaw in radians; NaN where not logged.
    at
        (pulse,) datetime64[ns], UTC.
    lever_arm_m
        From the logged point to the antenna, body axes forward-right-down, metres.
    attitude_from
        Whether body axes come from the log, from the course over ground (level flight), or are not known.
    where
        The log, for messages.

    Returns
    -------
    ndarray
        (pulse, 3) float64, ECEF metres.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or the lever arm needs an attitude that the log does not hold.

    Notes
    -----
    Position is a cubic spline through the epochs; R = Rz(yaw)·Ry(pitch)·Rx(roll) turns body axes to NED
    (docs/theory.md, "Geometry").
    """
    _check_covered(track_time, at, where)
    centres = position_spline(_seconds(track_time - track_time[0]), position)(_seconds(at - track_time[0]))
    if not any(lever_arm_m):
        return np.asarray(centres)
    why = f"a lever arm of {list(lever_arm_m)} m"
    turn = _turn(track_time, position, attitude, at=at, attitude_from=attitude_from, why=why, where=where)
    return np.asarray(centres + np.einsum("pij,pjk,k->pi", *turn, np.array(lever_arm_m)))


def attitude_axes(
    track_time: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    *,
    at: NDArray[np.datetime64],
    attitude_from: Literal["log", "course", "none"],
    where: object,
) -> NDArray[np.float64]:
    """Return how the body is turned at given times; parameters as `phase_centres`.

    Returns
    -------
    ndarray
        (pulse, 3, 3) float64; columns are the body's forward, right and down unit vectors in ECEF.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or the log does not hold an attitude.
    """
    _check_covered(track_time, at, where)
    ned, body = _turn(
        track_time, position, attitude, at=at, attitude_from=attitude_from, why="an antenna's beam", where=where
    )
    return ned @ body


def position_spline(time_s: NDArray[np.float64], position: NDArray[np.float64]) -> "BSpline":
    """Return the cubic spline through the epochs of a log: what is said of positions between them.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position
        (epoch, 3) float64, metres.

    Examples
    --------
    >>> position_spline(np.arange(5.0), np.arange(15.0).reshape(5, 3))(2.5).round(9)
    array([7.5, 8.5, 9.5])
    """
    from scipy.interpolate import make_interp_spline  # slow to import, and most steps only read finished positions

    return make_interp_spline(time_s, position, k=min(3, len(time_s) - 1))


def _turn(
    track_time: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    *,
    at: NDArray[np.datetime64],
    attitude_from: Literal["log", "course", "none"],
    why: str,
    where: object,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return NED → ECEF and body → NED at given times; `why` they are needed."""
    pulses = _seconds(at - track_time[0])
    spline = position_spline(_seconds(track_time - track_time[0]), position)
    ned = ned_axes(spline(pulses))
    angles = (
        _course(spline.derivative()(pulses), ned)
        if attitude_from == "course"
        else _logged(_seconds(track_time - track_time[0]), attitude, pulses)
    )
    if not np.isfinite(angles).all():
        raise CampaignError(
            f"{why} but no attitude (attitude: {attitude_from})",
            where=where,
            expected="roll, pitch and yaw at every epoch of the log",
            remedy="Log attitude, set the node's attitude to course, or its lever arms to zero and antennas to null.",
        )
    return ned, body_axes(angles)


def _check_covered(track_time: NDArray[np.datetime64], at: NDArray[np.datetime64], where: object) -> None:
    early = float(_seconds(track_time[0] - at.min()))
    late = float(_seconds(at.max() - track_time[-1]))
    if max(early, late) > 0:
        raise CampaignError(
            f"the track ({track_time[0]} to {track_time[-1]}) begins {max(early, 0):.3f} s after the first pulse "
            f"and ends {max(late, 0):.3f} s before the last",
            where=where,
            expected=f"a track that covers the pulses, {at.min()} to {at.max()}",
            remedy="Check the log's time system (GPST is 18 s ahead of UTC) and the transmitter's time tags, at which "
            "both nodes are placed, or give the whole log.",
        )


def _course(velocity: NDArray[np.float64], ned: NDArray[np.float64]) -> NDArray[np.float64]:
    north, east, _ = np.moveaxis(np.einsum("pij,pi->pj", ned, velocity), -1, 0)
    return np.stack([np.zeros_like(north), np.zeros_like(north), np.arctan2(east, north)], -1)


def _logged(
    epochs: NDArray[np.float64], attitude: NDArray[np.float64], pulses: NDArray[np.float64]
) -> NDArray[np.float64]:
    smooth = np.unwrap(attitude, axis=0)
    return np.stack([np.interp(pulses, epochs, angle) for angle in smooth.T], -1)


def _seconds(span: NDArray[np.timedelta64]) -> NDArray[np.float64]:
    return np.asarray(span / np.timedelta64(1, "s"))
