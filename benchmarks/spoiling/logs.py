"""Reading, modification and writing of flight logs in their own format."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.leap_seconds import gps_from_utc, utc_from_gps
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from apertura.formats.campaign_files import write_csv_log
from apertura.simulation.targets import Origin


@dataclass(frozen=True)
class Log:
    """Flight log of either format.

    Attributes
    ----------
    time_s
        (epoch,) float64, seconds of UTC after `begun`.
    geodetic
        (epoch, 3) float64: latitude, longitude (deg), metres above the ellipsoid.
    attitude_deg
        (epoch, 3) float64: roll, pitch, yaw; None in RTKLIB solutions.
    header, quality
        Header lines of an RTKLIB solution, and the columns after the position in each line.
    begun
        UTC of the first epoch of the log when it was read.
    """

    time_s: Floats
    geodetic: Floats
    attitude_deg: Floats | None
    header: tuple[str, ...]
    quality: tuple[str, ...]
    begun: np.datetime64

    @property
    def enu_m(self) -> Floats:
        """Positions in east, north and up from the first epoch, (epoch, 3) float64 metres."""
        return self._origin.enu(ecef_from_geodetic(*self.geodetic.T))

    def moved(self, by_m: Floats | tuple[float, float, float]) -> "Log":
        """Return the log displaced by (epoch, 3) or (3,) metres in east, north and up."""
        return replace(self, geodetic=geodetic_from_ecef(self._origin.ecef(self.enu_m + np.asarray(by_m))))

    def picked(self, epochs: NDArray[np.int_] | slice) -> "Log":
        """Return the log with the selected epochs."""
        attitude = None if self.attitude_deg is None else self.attitude_deg[epochs]
        quality = tuple(np.array(self.quality)[epochs]) if self.quality else ()
        return replace(
            self, time_s=self.time_s[epochs], geodetic=self.geodetic[epochs], attitude_deg=attitude, quality=quality
        )

    @property
    def _origin(self) -> Origin:
        return Origin(*map(float, self.geodetic[0]))


def read_log(path: Path) -> Log:
    """Read a log: a .csv with attitude, or an RTKLIB .pos."""
    lines = path.read_text(encoding="utf-8").splitlines()
    if path.suffix == ".csv":
        rows = [line.split(",") for line in lines[1:]]
        time = np.array([row[0].rstrip("Z") for row in rows], "datetime64[ns]")
        numbers = np.array([row[1:7] for row in rows], np.float64)
        return Log(_seconds(time), numbers[:, :3], numbers[:, 3:], (), (), time[0])
    header = tuple(line for line in lines if line.startswith("%"))
    rows = [line.split(maxsplit=5) for line in lines if not line.startswith("%")]
    time = np.array([f"{row[0].replace('/', '-')}T{row[1]}" for row in rows], "datetime64[ns]")
    time = utc_from_gps(time) if _is_gpst(header) else time
    numbers = np.array([row[2:5] for row in rows], np.float64)
    return Log(_seconds(time), numbers, None, header, tuple(row[5] for row in rows), time[0])


def write_log(path: Path, log: Log) -> None:
    """Write a log in its original format."""
    time = log.begun + np.rint(log.time_s * 1e9).astype("timedelta64[ns]")
    if log.attitude_deg is not None:
        write_csv_log(path, time.astype("datetime64[us]"), log.geodetic, np.radians(log.attitude_deg))
        return
    lines = list(log.header)
    for at, (latitude, longitude, height), rest in zip(
        gps_from_utc(time) if _is_gpst(log.header) else time, log.geodetic, log.quality, strict=True
    ):
        text = np.datetime_as_string(at, "ms").replace("-", "/").replace("T", " ")
        lines.append(f"{text}   {latitude:14.11f} {longitude:15.11f} {height:11.5f}   {rest}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _seconds(time: NDArray[np.datetime64]) -> Floats:
    return (time - time[0]).astype(np.float64) / 1e9


def _is_gpst(header: tuple[str, ...]) -> bool:
    """Return True if the times of an RTKLIB solution are GPS time."""
    return header[-1].split()[1] == "GPST"
