"""A receiver's positions against its own velocities, which come of Doppler shifts: two words on the same motion."""

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes

Floats = NDArray[np.float64]

_NEAR_M, _CURVED_M_S2 = 0.5, 2.5  # noise of both; an eighth of the 20 m/s² by which velocity may bend between epochs
_MOST, _FEW = 0.5, 10


def contradicted(time_utc: NDArray[np.datetime64], geodetic: Floats, velocity: Floats) -> NDArray[np.bool_]:
    """Return which epochs are not where their neighbours and the velocities lead.

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
