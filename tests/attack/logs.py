"""Flight logs in formats of several vendors, written from one list of epochs, as seeds and for tests of readers."""

import functools
import itertools
import operator
from collections.abc import Sequence

import numpy as np

START = np.datetime64("2025-05-14T23:59:57", "ns")


def circle(count: int = 40, rate_hz: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Return times across midnight, and latitude, longitude (deg) and height (m) of a node on a circle."""
    along = np.arange(count) / rate_hz
    turn = 0.3 * along
    geodetic = np.stack([48.4 + 1e-4 * np.sin(turn), 9.95 + 1.5e-4 * np.cos(turn), 600 + along], -1)
    return START + np.round(along * 1e9).astype("timedelta64[ns]"), geodetic.round(9)


def sealed(body: str) -> str:
    """Return an NMEA sentence with its checksum, the exclusive OR of its bytes."""
    return f"${body}*{functools.reduce(operator.xor, body.encode('latin-1'), 0):02X}"


def degrees_minutes(angle: float, width: int, signs: str) -> str:
    """Return an angle in the format of NMEA: ddmm.mmmmmmmm,N."""
    degrees, minutes = divmod(round(abs(angle) * 60e8), 60 * 10**8)
    return f"{degrees:0{width}d}{minutes // 10**8:02d}.{minutes % 10**8:08d},{signs[int(angle < 0)]}"


def of_day(time: np.datetime64, digits: int = 2) -> str:
    """Return the time of day as hhmmss.ss."""
    text = np.datetime_as_string(time, "ns").partition("T")[2].replace(":", "")
    return text[: 7 + digits] if digits else text[:6]


def gga(
    time: np.datetime64, geodetic: Sequence[float], *, talker="GN", quality=4, separation="48.000", digits=2
) -> str:
    """Return a GGA sentence of an ellipsoidal height with a geoid separation."""
    latitude, longitude, height = geodetic
    place = f"{degrees_minutes(latitude, 2, 'NS')},{degrees_minutes(longitude, 3, 'EW')}"
    heights = f"{height - float(separation or 0):.6f},M,{separation},{'M' if separation else ''}"
    return sealed(f"{talker}GGA,{of_day(time, digits)},{place},{quality},12,0.8,{heights},,")


def rmc(time: np.datetime64, *, status: str = "A") -> str:
    """Return an RMC sentence with status, time and date."""
    year, month, day = str(time)[2:10].split("-")
    return sealed(f"GNRMC,{of_day(time)},{status},,,,,,,{day}{month}{year},,,A")


def zda(time: np.datetime64) -> str:
    """Return a ZDA sentence."""
    year, month, day = str(time)[:10].split("-")
    return sealed(f"GPZDA,{of_day(time)},{day},{month},{year},00,00")


def gst(time: np.datetime64, north: float, east: float, up: float) -> str:
    """Return a GST sentence."""
    return sealed(f"GPGST,{of_day(time)},1.0,,,,{north},{east},{up}")


def nmea(times: np.ndarray, geodetic: np.ndarray, *, every: int = 5, prefix: str = "", **written) -> str:
    """Return a log with RMC before every `every`-th GGA and GST after each GGA."""
    lines = []
    for number, (time, place) in enumerate(zip(times, geodetic, strict=True)):
        lines += [rmc(time)] * (every > 0 and number % every == 0)
        lines += [gga(time, place, **written), gst(time, 0.01, 0.02, 0.03)]
    return "".join(f"{prefix}{line}\r\n" for line in lines)


AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,altitude_above_seaLevel(meters),satellites, xSpeed(m/s),"
    " compass_heading(degrees), pitch(degrees), roll(degrees),message"
)


def airdata(times: np.ndarray, geodetic: np.ndarray, *, clock_ms: np.ndarray | None = None, satellites=17) -> str:
    """Return an AirData export with times since the first epoch, and with a message that contains a comma."""
    clock = (times - times[0]).astype("timedelta64[ms]").astype(int) + 100 if clock_ms is None else clock_ms
    lines = [AIRDATA]
    for number, (time, (latitude, longitude, height)) in enumerate(zip(times, geodetic, strict=True)):
        utc = str(time)[:19].replace("T", " ")
        message = '"Mode, changed"' if number == 3 else ""
        place = f"{latitude:.9f},{longitude:.9f},{height - 48:.6f}"
        lines.append(f"{clock[number]},{utc},{place},{satellites},0, 90.5, -2.5, 1.5,{message}")
    return "\n".join(lines) + "\n"


def capture(
    seconds: np.ndarray, bodies: dict[str, np.ndarray], *, unit: str = "Meters", lost: Sequence[int] = ()
) -> str:
    """Return a Motive take: per body (frame, 7) quaternion x, y, z, w and position x, y, z; and a marker."""
    names = [name for name in bodies for _ in range(7)]
    rows = [
        f"Format Version,1.23,Take Name,a,Capture Start Time,2019-07-23 04.54.06.021 PM,Rotation Type,Quaternion,"
        f"Length Units,{unit},Coordinate Space,Global",
        "",
        ",Type," + ",".join(["Rigid Body"] * len(names) + ["Marker"] * 3),
        ",Name," + ",".join(names + ["Radar:Marker1"] * 3),
        ",ID," + ",".join(['"7679C0"'] * (len(names) + 3)),
        ",," + ",".join([*["Rotation"] * 4, *["Position"] * 3] * len(bodies) + ["Position"] * 3),
        "Frame,Time (Seconds)," + ",".join([*"XYZWXYZ"] * len(bodies) + [*"XYZ"]),
    ]
    for frame, second in enumerate(seconds):
        poses = [["" if frame in lost else f"{value:.6f}" for value in poses[frame]] for poses in bodies.values()]
        rows.append(f"{frame},{second:.6f}," + ",".join([*itertools.chain(*poses), "", "", ""]))
    return "\r\n".join(rows) + "\r\n"


def poses(count: int = 12) -> dict[str, np.ndarray]:
    """Return the poses of a body on a rail and of a stationary body."""
    along = np.linspace(0, 1, count)
    turned = np.stack([0 * along, np.sin(along / 2), 0 * along, np.cos(along / 2)], -1)
    rail = np.stack([along - 5, 0 * along + 1.8, -3 * along], -1)
    still = np.tile([0, 0, 0, 1, -1.0, 0.07, -1.15], (count, 1))
    return {"Radar": np.hstack([turned, rail]), "Corner Reflector": still}


def solution(times: np.ndarray, columns: np.ndarray, names: str, *, system="UTC", separator=" ", head=()) -> str:
    """Return an RTKLIB solution with Q = 1 after columns with nine decimals."""
    lines = ["% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)", *head]
    lines.append("%  " + separator.join([system, *names.split(), "Q"]))
    for time, row in zip(times, columns, strict=True):
        stamp = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
        lines.append(separator.join([stamp, *(cell if isinstance(cell, str) else f"{cell:.9f}" for cell in row), "1"]))
    return "\n".join(lines) + "\n"
