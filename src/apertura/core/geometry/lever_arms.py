"""Phase centres of antennas at each pulse: logged track, attitude, lever arms, and corrections by autofocus."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.units import seconds_since
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import LOCAL_NED, body_axes, ned_axes

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


# ---- Corrections of tracks and paths


@dataclass(frozen=True, eq=False)
class TrackCorrection:
    """Corrections of the tracks of a flight's nodes; a node that is not named keeps its logged positions.

    Attributes
    ----------
    time_s
        (knot,) float64, seconds of the flight's clock, ascending; between knots corrections are linear, beyond them
        constant.
    moved_m
        Node → (knot, 3) float64, metres to be added to each of its points, in the frame of the phase centres.
    extra_path_m
        Pair → (knot,) float64, metres of total path added to all its echoes, whatever its nodes' positions; none for
        a pair that is not named.

    Examples
    --------
    >>> higher = TrackCorrection(np.array([0.0, 2.0]), {"a": np.array([[0, 0, 0.0], [0, 0, 0.2]])})
    >>> higher.at("a", np.array([1.0])), higher.at("b", np.array([1.0]))
    (array([[0. , 0. , 0.1]]), array([[0., 0., 0.]]))
    """

    time_s: NDArray[np.float64]
    moved_m: Mapping[str, NDArray[np.float64]]
    extra_path_m: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def at(self, node: str, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the correction of a node's positions at some times, (pulse, 3) float64, metres."""
        moved = self.moved_m.get(node)
        if moved is None:
            return np.zeros((len(time_s), 3))
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in moved.T], axis=-1)

    def with_further(self, later: "TrackCorrection") -> "TrackCorrection":
        """Return this and a correction, at the same knots, of tracks that it corrected."""
        moved_m = {node: self.moved_m.get(node, 0.0) + moved for node, moved in later.moved_m.items()}
        return TrackCorrection(self.time_s, {**self.moved_m, **moved_m}, {**self.extra_path_m, **later.extra_path_m})

    def aperture(self, logged: Aperture, pair: str, time_s: NDArray[np.float64]) -> Aperture:
        """Return the phase centres of a pair, transmitter-receiver, as corrected at the times of its pulses."""
        tx, rx = pair.split("-")
        return Aperture(logged.tx_m + self.at(tx, time_s), logged.rx_m + self.at(rx, time_s))

    def longer_m(
        self, pair: str, time_s: NDArray[np.float64], between_m: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the path added to all echoes of a pair: ∆ of the sidelink, and the pair's own correction.

        Parameters
        ----------
        pair
            transmitter-receiver.
        time_s
            (pulse,) float64.
        between_m
            (pulse, 3) float64, metres: from the receiver's sidelink point to the transmitter's, as the logs have it;
            None where no sidelink's length was added to the echoes.

        Returns
        -------
        ndarray
            (pulse,) float64, metres of total path.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 2 and 34.

        Examples
        --------
        >>> apart = np.array([[3.0, 0.0, 0.0]])
        >>> wider = TrackCorrection(np.zeros(1), {"a": np.array([[0.5, 0, 0]])}, {"a-b": np.array([0.1])})
        >>> wider.longer_m("a-b", np.zeros(1), apart), wider.longer_m("a-a", np.zeros(1), None)
        (array([0.6]), array([0.]))
        """
        own = self.extra_path_m.get(pair)
        extra_path_m = np.zeros(len(time_s)) if own is None else np.interp(time_s, self.time_s, own)
        if between_m is None:
            return extra_path_m
        tx, rx = pair.split("-")
        corrected = between_m + self.at(tx, time_s) - self.at(rx, time_s)
        return np.asarray(extra_path_m + np.linalg.norm(corrected, axis=1) - np.linalg.norm(between_m, axis=1))


# ---- Positions and attitude from a logged track

_CUBIC = 3


def phase_centres(
    track_time: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    *,
    at: NDArray[np.datetime64],
    lever_arm_m: tuple[float, float, float],
    attitude_from: Literal["log", "course", "none"],
    where: object,
    frame: str = "ecef",
    smoothing_m: float | None = None,
) -> NDArray[np.float64]:
    """Return the position of an antenna at given times.

    Parameters
    ----------
    track_time
        (epoch,) datetime64[ns], UTC.
    position
        (epoch, 3) float64, logged point in `frame`, metres.
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
    frame
        'ecef', or 'local': axes to east, north and up.
    smoothing_m
        Noise of the logged positions that a smoothing spline removes; None: the spline goes through all epochs.

    Returns
    -------
    ndarray
        (pulse, 3) float64, metres in `frame`.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or the lever arm needs an attitude that is not in the log.

    Notes
    -----
    Position is a cubic spline through the epochs; R = Rz(yaw)·Ry(pitch)·Rx(roll) turns body axes to NED
    (docs/theory.md, "Geometry").
    """
    _check_covered(track_time, at, where)
    spline = position_spline(seconds_since(track_time, track_time[0]), position, smoothing_m=smoothing_m)
    centres = spline(seconds_since(at, track_time[0]))
    if not any(lever_arm_m):
        return np.asarray(centres)
    why = f"a lever arm of {list(lever_arm_m)} m"
    turn = _turn(track_time, attitude, spline, at=at, attitude_from=attitude_from, frame=frame, why=why, where=where)
    return np.asarray(centres + np.einsum("pij,pjk,k->pi", *turn, np.array(lever_arm_m)))


def attitude_axes(
    track_time: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    *,
    at: NDArray[np.datetime64],
    attitude_from: Literal["log", "course", "none"],
    where: object,
    frame: str = "ecef",
    smoothing_m: float | None = None,
) -> NDArray[np.float64]:
    """Return the attitude of the body at given times; parameters as `phase_centres`.

    Returns
    -------
    ndarray
        (pulse, 3, 3) float64; columns are the body's forward, right and down unit vectors in `frame`.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or there is no attitude in the log.
    """
    _check_covered(track_time, at, where)
    spline = position_spline(seconds_since(track_time, track_time[0]), position, smoothing_m=smoothing_m)
    why = "an antenna's beam"
    ned, body = _turn(
        track_time, attitude, spline, at=at, attitude_from=attitude_from, frame=frame, why=why, where=where
    )
    return ned @ body


def position_spline(
    time_s: NDArray[np.float64], position: NDArray[np.float64], *, smoothing_m: float | None = None
) -> "BSpline":
    """Return the cubic spline through the epochs of a log, or near them: the positions between epochs.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position
        (epoch, 3) float64, metres.
    smoothing_m
        Noise of the epochs in each axis: the spline with the fewest knots that stays as near to them, rms; None: the
        one through all of them.

    Notes
    -----
    Source: P. Dierckx, "Curve and Surface Fitting with Splines", Oxford 1993: the sum of squares of the residuals is
    3·n·smoothing_m².

    Examples
    --------
    >>> position_spline(np.arange(5.0), np.arange(15.0).reshape(5, 3))(2.5).round(9)
    array([7.5, 8.5, 9.5])
    """
    from scipy.interpolate import BSpline, make_interp_spline, splprep  # slow to import, and few steps need them

    if smoothing_m is not None and len(time_s) > _CUBIC:
        middle = position.mean(axis=0)  # of ECEF: the fit is of the differences
        knots, coefficients, degree = splprep((position - middle).T, u=time_s, s=position.size * smoothing_m**2)[0]
        return BSpline(knots, np.stack(coefficients, axis=-1) + middle, degree)
    return make_interp_spline(time_s, position, k=min(_CUBIC, len(time_s) - 1))


def _turn(
    track_time: NDArray[np.datetime64],
    attitude: NDArray[np.float64],
    spline: "BSpline",
    *,
    at: NDArray[np.datetime64],
    attitude_from: Literal["log", "course", "none"],
    frame: str,
    why: str,
    where: object,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return NED → `frame` and body → NED at given times; `why` they are needed."""
    pulses = seconds_since(at, track_time[0])
    ned = ned_axes(spline(pulses)) if frame == "ecef" else np.broadcast_to(LOCAL_NED, (len(pulses), 3, 3))
    angles = (
        _course(spline.derivative()(pulses), ned)
        if attitude_from == "course"
        else _logged(seconds_since(track_time, track_time[0]), attitude, pulses)
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
    early = -float(seconds_since(at.min(), track_time[0]))
    late = float(seconds_since(at.max(), track_time[-1]))
    if max(early, late) > 0:
        ends = [f"begins {early:.3f} s after the first pulse"] if early > 0 else []
        ends += [f"ends {late:.3f} s before the last"] if late > 0 else []
        raise CampaignError(
            f"the track ({track_time[0]} to {track_time[-1]}) {' and '.join(ends)}",
            where=where,
            expected=f"a track that covers the pulses, {at.min()} to {at.max()}",
            remedy="Check the log's time system (GPST is 18 s ahead of UTC) and the transmitter's time tags, at which "
            "both nodes are placed, or give the whole log; a recorder with a clock of its own: `apertura align`.",
        )


def _course(velocity: NDArray[np.float64], ned: NDArray[np.float64]) -> NDArray[np.float64]:
    north, east, _ = np.moveaxis(np.einsum("pij,pi->pj", ned, velocity), -1, 0)
    return np.stack([np.zeros_like(north), np.zeros_like(north), np.arctan2(east, north)], -1)


def _logged(
    epochs: NDArray[np.float64], attitude: NDArray[np.float64], pulses: NDArray[np.float64]
) -> NDArray[np.float64]:
    smooth = np.unwrap(attitude, axis=0)
    return np.stack([np.interp(pulses, epochs, angle) for angle in smooth.T], -1)
