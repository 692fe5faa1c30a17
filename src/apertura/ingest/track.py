"""What every flight log becomes: times in UTC, positions in ECEF, attitude in radians."""

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.errors import CampaignError
from apertura.geometry.geodesy import ecef_from_geodetic

FIXES = {"fix": 1, "float": 2, "sbas": 3, "dgps": 4, "single": 5, "ppp": 6}
"""Kinds of solution by RTKLIB's numbers, Q."""


def make_track(
    time_utc: NDArray[np.datetime64],
    geodetic: NDArray[np.float64],
    *,
    attitude_deg: NDArray[np.float64] | None = None,
    position_std_m: NDArray[np.float64] | None = None,
    fix: NDArray[np.int8] | None = None,
    node: str,
    where: Path,
) -> xr.Dataset:
    """Return the `track` stage of epochs that `node` logged in the file `where`.

    Parameters
    ----------
    time_utc
        (epoch,) datetime64[ns], UTC, strictly increasing.
    geodetic
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m).
    attitude_deg
        (epoch, 3) float64: roll, pitch, yaw in degrees, yaw clockwise from north; None where not logged.

    position_std_m
        (epoch, 3) float64: standard deviations to north, east and up, metres, NaN where not logged; None: nowhere.
    fix
        (epoch,) int8: kind of solution, a value of `FIXES`, 0 where not logged; None: nowhere.

    Raises
    ------
    CampaignError
        If times do not increase, a value is not finite, or a latitude is out of range.

    Examples
    --------
    >>> times = np.array(["2025-05-14T09:30", "2025-05-14T09:31"], "datetime64[ns]")
    >>> track = make_track(times, np.array([[0, 0, 0], [0, 0, 1.0]]), node="uav1", where=Path("x.csv"))
    >>> track.position.values[1]
    array([6378138.,       0.,       0.])
    """
    if len(time_utc) < 2:
        raise CampaignError(f"{len(time_utc)} epochs", where, "at least two", "Export the whole log.")
    _check_times(time_utc, where)
    bad = ~np.isfinite(geodetic).all(axis=1) | (np.abs(geodetic[:, 0]) > 90)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise CampaignError(
            f"{int(bad.sum())} epochs without a position, first epoch {first}: {geodetic[first].tolist()}",
            where,
            "finite latitude, longitude and ellipsoidal height",
            "Drop those lines or export again.",
        )
    attitude = np.full_like(geodetic, np.nan) if attitude_deg is None else np.radians(attitude_deg)
    quality = {
        name: (dims, values)
        for name, dims, values in (("position_std", ("epoch", "axis"), position_std_m), ("fix", ("epoch",), fix))
        if values is not None
    }
    return xr.Dataset(
        {
            **quality,
            "time": ("epoch", time_utc.astype("datetime64[ns]")),
            "position": (("epoch", "axis"), ecef_from_geodetic(*geodetic.T)),
            "attitude": (("epoch", "axis"), attitude),
        },
        attrs={"node": node},
    )


def _check_times(time_utc: NDArray[np.datetime64], where: Path) -> None:
    steps = np.diff(time_utc)
    wrong = np.flatnonzero(steps <= np.timedelta64(0, "ns"))
    if wrong.size:
        epoch = int(wrong[0]) + 1
        kind = "the same time as the epoch before" if steps[wrong[0]] == np.timedelta64(0, "ns") else "an earlier time"
        raise CampaignError(
            f"epoch {epoch} ({time_utc[epoch]}) has {kind} ({time_utc[epoch - 1]})",
            where,
            "strictly increasing times",
            "Remove doubled or unsorted lines from the log.",
        )
