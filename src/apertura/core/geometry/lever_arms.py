"""Phase centres of antennas at each pulse, from logged track, attitude, lever arms, and corrections by autofocus."""

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
    """Corrections of the tracks of the nodes of a flight; positions of nodes that are not listed are unchanged.

    Attributes
    ----------
    time_s
        (knot,) float64, seconds of the flight's clock, ascending. Corrections are linear between knots and constant
        before the first and after the last knot.
    moved_m
        Node → (knot, 3) float64, displacement of all antennas of the node, metres, in the frame of the phase centres.
    extra_path_m
        Pair → (knot,) float64, total path added to all echoes of the pair, metres, in addition to the effect of
        displaced nodes; 0 for a pair that is not listed.

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
        """Return the correction of the positions of a node at given times, (pulse, 3) float64, metres."""
        displacement = self.moved_m.get(node)
        if displacement is None:
            return np.zeros((len(time_s), 3))
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in displacement.T], axis=-1)

    def with_further(self, later: "TrackCorrection") -> "TrackCorrection":
        """Return the sum of this correction and a later correction of the corrected tracks, at the same knots."""
        moved_m = {node: self.moved_m.get(node, 0.0) + added for node, added in later.moved_m.items()}
        return TrackCorrection(self.time_s, {**self.moved_m, **moved_m}, {**self.extra_path_m, **later.extra_path_m})

    def aperture(self, logged: Aperture, pair: str, time_s: NDArray[np.float64]) -> Aperture:
        """Return the corrected phase centres of a pair, named transmitter-receiver, at the times of its pulses."""
        tx, rx = pair.split("-")
        return Aperture(logged.tx_m + self.at(tx, time_s), logged.rx_m + self.at(rx, time_s))

    def longer_m(
        self, pair: str, time_s: NDArray[np.float64], between_m: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the path added to all echoes of a pair: ∆ of the sidelink plus the path correction of the pair.

        Parameters
        ----------
        pair
            Name of the pair, transmitter-receiver.
        time_s
            (pulse,) float64, seconds of the flight's clock.
        between_m
            (pulse, 3) float64, logged vector from the receiver's sidelink antenna to the transmitter's antenna, metres;
            None if no sidelink path was added to the echoes.

        Returns
        -------
        ndarray
            (pulse,) float64, total path, metres.

        Notes
        -----
        Source: docs/theory/autofocus.md, eqs. 2 and 34.

        Examples
        --------
        >>> between = np.array([[3.0, 0.0, 0.0]])
        >>> wider = TrackCorrection(np.zeros(1), {"a": np.array([[0.5, 0, 0]])}, {"a-b": np.array([0.1])})
        >>> wider.longer_m("a-b", np.zeros(1), between), wider.longer_m("a-a", np.zeros(1), None)
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
        (epoch, 3) float64, position of the logged point in `frame`, metres.
    attitude
        (epoch, 3) float64, roll, pitch and yaw in radians; NaN where not logged.
    at
        (pulse,) datetime64[ns], UTC.
    lever_arm_m
        Vector from the logged point to the antenna in body axes (forward, right, down), metres.
    attitude_from
        Source of the body axes: 'log', 'course' (course over ground with level flight assumed), or 'none'.
    where
        Name of the log in error messages.
    frame
        'ecef', or 'local' with axes east, north and up.
    smoothing_m
        Noise of the logged positions, removed by a smoothing spline, metres; None: the spline interpolates all epochs.

    Returns
    -------
    ndarray
        (pulse, 3) float64, metres in `frame`.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or if the lever arm requires an attitude that is not logged.

    Notes
    -----
    The position is a cubic spline through the epochs; R = Rz(yaw)·Ry(pitch)·Rx(roll) rotates body axes to NED
    (docs/theory.md, "Geometry").
    """
    _check_covered(track_time, at, where)
    spline = position_spline(seconds_since(track_time, track_time[0]), position, smoothing_m=smoothing_m)
    centres = spline(seconds_since(at, track_time[0]))
    if not any(lever_arm_m):
        return np.asarray(centres)
    purpose = f"a lever arm of {list(lever_arm_m)} m"
    rotations = _rotations(
        track_time, attitude, spline, at=at, attitude_from=attitude_from, frame=frame, purpose=purpose, where=where
    )
    return np.asarray(centres + np.einsum("pij,pjk,k->pi", *rotations, np.array(lever_arm_m)))


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
    """Return the attitude of the body at given times; parameters as for `phase_centres`.

    Returns
    -------
    ndarray
        (pulse, 3, 3) float64; columns are the forward, right and down unit vectors of the body in `frame`.

    Raises
    ------
    CampaignError
        If the track does not cover `at`, or if the log contains no attitude.
    """
    _check_covered(track_time, at, where)
    spline = position_spline(seconds_since(track_time, track_time[0]), position, smoothing_m=smoothing_m)
    purpose = "an antenna beam"
    ned, body = _rotations(
        track_time, attitude, spline, at=at, attitude_from=attitude_from, frame=frame, purpose=purpose, where=where
    )
    return ned @ body


def position_spline(
    time_s: NDArray[np.float64], position: NDArray[np.float64], *, smoothing_m: float | None = None
) -> "BSpline":
    """Fit an interpolating or smoothing cubic spline to the epochs of a log.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position
        (epoch, 3) float64, metres.
    smoothing_m
        Standard deviation of the noise in each axis, metres: the spline has the smallest number of knots that yields
        this RMS residual; None: the spline interpolates all epochs.

    Notes
    -----
    Source: P. Dierckx, "Curve and Surface Fitting with Splines", Oxford 1993: the sum of squares of the residuals is
    3·n·smoothing_m².

    Examples
    --------
    >>> position_spline(np.arange(5.0), np.arange(15.0).reshape(5, 3))(2.5).round(9)
    array([7.5, 8.5, 9.5])
    """
    from scipy.interpolate import BSpline, make_interp_spline, splprep  # slow to import, and rarely needed

    if smoothing_m is not None and len(time_s) > _CUBIC:
        middle = position.mean(axis=0)  # subtracted for precision: ECEF coordinates are large
        knots, coefficients, degree = splprep((position - middle).T, u=time_s, s=position.size * smoothing_m**2)[0]
        return BSpline(knots, np.stack(coefficients, axis=-1) + middle, degree)
    return make_interp_spline(time_s, position, k=min(_CUBIC, len(time_s) - 1))


def _rotations(
    track_time: NDArray[np.datetime64],
    attitude: NDArray[np.float64],
    spline: "BSpline",
    *,
    at: NDArray[np.datetime64],
    attitude_from: Literal["log", "course", "none"],
    frame: str,
    purpose: str,
    where: object,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotations NED → `frame` and body → NED at given times; error messages contain the `purpose`."""
    pulses = seconds_since(at, track_time[0])
    ned = ned_axes(spline(pulses)) if frame == "ecef" else np.broadcast_to(LOCAL_NED, (len(pulses), 3, 3))
    angles = (
        _course(spline.derivative()(pulses), ned)
        if attitude_from == "course"
        else _logged(seconds_since(track_time, track_time[0]), attitude, pulses)
    )
    if not np.isfinite(angles).all():
        raise CampaignError(
            f"{purpose} is configured, but the attitude is unknown (attitude: {attitude_from})",
            where=where,
            expected="roll, pitch and yaw at every epoch of the log",
            remedy="Log the attitude; or set the attitude of the node to course; or set the lever arms of the node to "
            "zero and its antennas to null.",
        )
    return ned, body_axes(angles)


def _check_covered(track_time: NDArray[np.datetime64], at: NDArray[np.datetime64], where: object) -> None:
    early = -float(seconds_since(at.min(), track_time[0]))
    late = float(seconds_since(at.max(), track_time[-1]))
    if max(early, late) > 0:
        ends = [f"starts {early:.3f} s after the first pulse"] if early > 0 else []
        ends += [f"ends {late:.3f} s before the last pulse"] if late > 0 else []
        raise CampaignError(
            f"the track ({track_time[0]} to {track_time[-1]}) {' and '.join(ends)}",
            where=where,
            expected=f"a track that covers the pulses, {at.min()} to {at.max()}",
            remedy="Check the time system of the log (GPST is 18 s ahead of UTC) and the time tags of the transmitter, "
            "at which the positions of both nodes are evaluated; or provide the complete log. If the recorder has a "
            "separate clock, use `apertura align`.",
        )


def _course(velocity: NDArray[np.float64], ned: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return level attitude with the yaw equal to the course over ground, (pulse, 3) rad."""
    north, east, _ = np.moveaxis(np.einsum("pij,pi->pj", ned, velocity), -1, 0)
    return np.stack([np.zeros_like(north), np.zeros_like(north), np.arctan2(east, north)], -1)


def _logged(
    epochs: NDArray[np.float64], attitude: NDArray[np.float64], pulses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the logged attitude, interpolated linearly at the pulses, (pulse, 3) rad."""
    unwrapped = np.unwrap(attitude, axis=0)
    return np.stack([np.interp(pulses, epochs, angle) for angle in unwrapped.T], -1)
