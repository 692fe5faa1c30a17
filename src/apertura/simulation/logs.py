"""Flight logs as flight controllers and RTKLIB write them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.constants import GPS_UTC_LEAP_S
from apertura.simulation.radar import Floats

_POS_HEADER = """\
% program   : RTKPOST ver.2.4.3
% pos mode  : Kinematic
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  {system:<22}latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) \
age(s)  ratio
"""
_POS_QUALITY = "   1  18   0.0050   0.0050   0.0100   0.0000   0.0000   0.0000   0.00  100.0"


def write_csv_log(path: Path, time_utc: NDArray[np.datetime64], geodetic: Floats, attitude_rad: Floats) -> None:
    """Write a flight controller's log: UTC, latitude, longitude, ellipsoidal height, roll, pitch, yaw.

    Parameters
    ----------
    path
        The .csv to write.
    time_utc
        (epoch,) datetime64[ns], UTC.
    geodetic
        (epoch, 3) float64: degrees, degrees, metres above the ellipsoid.
    attitude_rad
        (epoch, 3) float64: roll, pitch, yaw (clockwise from north).
    """
    lines = ["time_utc,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,yaw_deg"]
    turned = np.degrees(attitude_rad)
    turned[:, 2] %= 360
    for time, (latitude, longitude, height), (roll, pitch, yaw) in zip(time_utc, geodetic, turned, strict=True):
        place = f"{latitude:.11f},{longitude:.11f},{height:.5f}"
        lines.append(f"{np.datetime_as_string(time, 'us')}Z,{place},{roll:.4f},{pitch:.4f},{yaw:.4f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_pos_log(path: Path, time_utc: NDArray[np.datetime64], geodetic: Floats, *, system: str = "GPST") -> None:
    """Write an RTKLIB solution in `system` GPST (18 s ahead of UTC since 2017) or UTC.

    Parameters
    ----------
    path
        The .pos to write.
    time_utc
        (epoch,) datetime64[ns], UTC.
    geodetic
        (epoch, 3) float64: degrees, degrees, metres above the ellipsoid.
    system
        Time system of the columns, named in the header.

    Notes
    -----
    Source: RTKLIB manual 2.4.2, appendix B.1 "Positioning solution file".
    """
    ahead = np.timedelta64(GPS_UTC_LEAP_S if system == "GPST" else 0, "s")
    lines = []
    for time, (latitude, longitude, height) in zip(time_utc + ahead, geodetic, strict=True):
        text = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
        lines.append(f"{text}   {latitude:14.11f} {longitude:15.11f} {height:11.5f}{_POS_QUALITY}")
    path.write_text(_POS_HEADER.format(system=system) + "\n".join(lines) + "\n", encoding="utf-8")
