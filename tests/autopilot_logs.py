"""Logs of a known flight in the formats of autopilots, after the public descriptions of ULog and DataFlash."""

import struct

import numpy as np

from apertura.common.leap_seconds import GPS_EPOCH, gps_from_utc

START = np.datetime64("2025-05-14T09:30:00", "ns")
LAG_S, BOOT_S = 0.11, 300.0
"""Latency of epochs at the autopilot, s; clock of the autopilot at `START`, s."""

N_M = 47.5
"""Geoid height above the ellipsoid, m."""


def flight(epochs=60, rate_hz=10.0):
    """Return time (s), geodetic (epoch, 3) and yaw (deg) of a climbing circle: radius 50 m, 8 m/s, climb 0.5 m/s."""
    time = np.arange(epochs) / rate_hz
    angle_rad = time * 8 / 50
    latitude = 48.42 + 50 * np.sin(angle_rad) / 111_200
    longitude = 9.955 - 50 * np.cos(angle_rad) / 73_900
    return time, np.stack([latitude, longitude, 600 + 0.5 * time], -1), np.degrees(angle_rad)


def velocity(epochs=60):
    """Return velocity to north, east and down (epoch, 3), m/s."""
    angle_rad = flight(epochs)[0] * 8 / 50
    return np.stack([8 * np.cos(angle_rad), 8 * np.sin(angle_rad), np.full(epochs, -0.5)], -1)


def utc_of(time_s):
    """Return the UTC of times in seconds of the flight."""
    return START + np.rint(np.asarray(time_s) * 1e9).astype("timedelta64[ns]")


# ULog: header, then messages of uint16 size, char type


_TYPES = {"uint64_t": "Q", "int32_t": "i", "uint8_t": "B", "float": "f", "double": "d"}


def _message(kind, payload):
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def ulog(*topics, delay_ms=LAG_S * 1e3):
    """Return a ULog with topics (name, instance, {field: (type, values)}); each starts with its timestamp, µs."""
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", round(BOOT_S * 1e6))]
    for name, fields in {name: fields for name, _, fields in topics}.items():
        text = f"{name}:" + "".join(f"{kind} {field};" for field, (kind, _) in fields.items())
        parts.append(_message("F", text.encode()))
    if delay_ms is not None:
        key = b"float EKF2_GPS_DELAY"
        parts.append(_message("P", bytes([len(key)]) + key + struct.pack("<f", delay_ms)))
    for number, (name, instance, _) in enumerate(topics):
        parts.append(_message("A", struct.pack("<BH", instance, number) + name.encode()))
    rows = []
    for number, (_, _, fields) in enumerate(topics):
        form = "<H" + "".join(_TYPES[kind] for kind, _ in fields.values())
        columns = [np.asarray(values).tolist() for _, values in fields.values()]
        rows += [(row[0], _message("D", struct.pack(form, number, *row))) for row in zip(*columns, strict=True)]
    return b"".join([*parts, *(data for _, data in sorted(rows, key=lambda row: row[0]))])


def boot_us(time_s, late_s=LAG_S):
    """Return the autopilot clock, µs, at which epochs are received."""
    return np.rint((np.asarray(time_s) + BOOT_S + late_s) * 1e6).astype(np.int64)


def ulog_receiver(*, old=True, epochs=60, **changes):
    """Return the fields of a receiver's topic in PX4 up to 1.13, or later; a change to None removes a field."""
    time, geodetic, _ = flight(epochs)
    names = ("lat", "lon", "alt", "alt_ellipsoid")
    scales, kind = (1e-7, 1e-7, 1e-3, 1e-3), "int32_t"
    if not old:
        names = ("latitude_deg", "longitude_deg", "altitude_msl_m", "altitude_ellipsoid_m")
        scales, kind = (1, 1, 1, 1), "double"
    columns = (*geodetic.T[:2], geodetic[:, 2] - N_M, geodetic[:, 2])
    places = {name: column / scale for name, column, scale in zip(names, columns, scales, strict=True)}
    fields = {
        "timestamp": ("uint64_t", boot_us(time)),
        "time_utc_usec": ("uint64_t", utc_of(time).astype("datetime64[us]").astype(np.int64)),
        **{name: (kind, np.rint(place).astype(np.int64) if old else place) for name, place in places.items()},
        "eph": ("float", np.full(epochs, 0.25)),
        "epv": ("float", np.full(epochs, 0.5)),
        "fix_type": ("uint8_t", np.full(epochs, 6)),
        **{f"vel_{axis}_m_s": ("float", along) for axis, along in zip("ned", velocity(epochs).T, strict=True)},
        "vel_ned_valid": ("uint8_t", np.ones(epochs, int)),
    }
    fields |= {name: (fields[name][0], np.asarray(values)) for name, values in changes.items() if values is not None}
    return {name: field for name, field in fields.items() if changes.get(name, ()) is not None}


def ulog_attitude(epochs=60, rate_hz=40.0):
    """Return fields of vehicle_attitude of an aircraft along its circle with a roll of 10° and a pitch of 3°."""
    time = np.arange(-0.5, epochs / 10 + 0.5, 1 / rate_hz)
    half = np.radians([np.full(time.size, 10.0), np.full(time.size, 3.0), np.degrees(time * 8 / 50)]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    parts = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    quaternion = {f"q[{n}]": ("float", part) for n, part in enumerate(parts)}
    return {"timestamp": ("uint64_t", boot_us(time, 0.0)), **quaternion}


def ulog_fused(epochs=60, **changes):
    """Return fields of vehicle_global_position at times between the receiver's epochs."""
    time, geodetic, _ = flight(2 * epochs, 20.0)
    fields = {
        "timestamp": ("uint64_t", boot_us(time, 0.0)),
        "lat": ("double", geodetic[:, 0]),
        "lon": ("double", geodetic[:, 1]),
        "alt": ("float", geodetic[:, 2] - N_M),
        "alt_ellipsoid": ("float", geodetic[:, 2]),
        "eph": ("float", np.full(time.size, 0.25)),
        "epv": ("float", np.full(time.size, 0.5)),
        "dead_reckoning": ("uint8_t", np.zeros(time.size, int)),
    }
    return fields | {name: (fields[name][0], np.asarray(values)) for name, values in changes.items()}


# DataFlash: FMT messages define the columns; binary messages begin with a3 95 and the message type

_FMT = ("BBnNZ", "Type,Length,Name,Format,Columns")
_FORMS = {
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": ("QBCCCCfBIHeHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,AEl,RTCMFU,RTCMFD"),
    "ATT": ("QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF"),
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
}
_STRUCTS = {"n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}
_SCALED = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 10_000_000}


def dataflash_rows(*, epochs=60, receivers=(0,), parameters=None, without_ael=False, **changes):
    """Return messages (name, {column: value}) in order of time; `changes` replace columns of GPS."""
    time, geodetic, _ = flight(epochs)
    gps = gps_from_utc(utc_of(time)) - GPS_EPOCH
    week, ms = np.divmod(gps // np.timedelta64(1, "ms"), 604_800_000)
    motion = {"Spd": np.full(epochs, 8.0), "GCrs": np.degrees(time * 8 / 50) % 360, "VZ": np.full(epochs, -0.5)}
    columns = {"Status": np.full(epochs, 6), "GMS": ms, "GWk": week, **motion, **changes}
    rows = [(0, "PARM", {"Name": name, "Value": value}) for name, value in (parameters or {}).items()]
    for receiver in receivers:
        for n in range(epochs):
            latitude, longitude, height = geodetic[n] + receiver * np.array([1e-5, 0, 0])
            at = {"TimeUS": int(boot_us(time[n], 0.12)) + receiver, "I": receiver}
            of = {name: values[n].item() for name, values in columns.items()}
            rows.append((at["TimeUS"], "GPS", {**at, **of, "Lat": latitude, "Lng": longitude, "Alt": height - N_M}))
            known = -(2**31) / 100 if without_ael else height
            rows.append((at["TimeUS"], "GPA", {**at, "HAcc": 0.02, "VAcc": 0.03, "VV": 1, "AEl": known}))
    for time_s in np.arange(-0.5, epochs / 10 + 0.5, 0.05):
        angles_deg = {"Roll": 10.0, "Pitch": 3.0, "Yaw": np.degrees(time_s * 8 / 50) % 360}
        rows.append((int(boot_us(time_s, 0.0)), "ATT", {"TimeUS": int(boot_us(time_s, 0.0)), **angles_deg}))
    return [(name, values) for _, name, values in sorted(rows, key=lambda row: row[0])]


def _formats(forms):
    own = {"FMT": (128, 89, _FMT), **{name: (130 + n, 0, form) for n, (name, form) in enumerate(forms.items())}}
    for name, (number, _, (form, columns)) in own.items():
        size = struct.calcsize("<" + "".join(_STRUCTS.get(letter, letter) for letter in form)) + 3
        yield {"Type": number, "Length": size, "Name": name, "Format": form, "Columns": columns}


def dataflash(rows, forms=None):
    """Return messages as a binary log."""
    forms = {**_FORMS, **(forms or {})}
    described = list(_formats(forms))
    number = {row["Name"]: row["Type"] for row in described}
    parts = []
    for name, values in [*(("FMT", row) for row in described), *rows]:
        form, columns = {**forms, "FMT": _FMT}[name]
        cells = []
        for kind, column in zip(form, columns.split(","), strict=True):
            cell = values.get(column, "" if kind in "nNZ" else 0)
            whole = round(cell * _SCALED[kind]) if kind in _SCALED else cell
            cells.append(whole.encode() if kind in "nNZ" else whole if kind in "fd" else int(whole))
        packed = struct.pack("<" + "".join(_STRUCTS.get(letter, letter) for letter in form), *cells)
        parts.append(b"\xa3\x95" + bytes([number[name]]) + packed)
    return b"".join(parts)


def dataflash_text(rows, forms=None):
    """Return messages as the text log into which ground stations convert a binary log."""
    forms = {**_FORMS, **(forms or {})}
    digits = {"L": 7, "e": 2, "E": 2, "c": 2, "C": 2, "f": 6}
    lines = [", ".join(["FMT", *(str(value) for value in row.values())]) for row in _formats(forms)]
    for name, values in rows:
        form, columns = forms[name]
        cells = [
            values.get(column, "x") if kind in "nNZ" else f"{values.get(column, 0):.{digits.get(kind, 0)}f}"
            for kind, column in zip(form, columns.split(","), strict=True)
        ]
        lines.append(", ".join([name, *cells]))
    return "\n".join([*lines, ""]).encode()
