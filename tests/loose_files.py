"""Loose files of recorders and autopilots, taken from simulated campaigns without folder, config and headers."""

import json
import shutil

import numpy as np
from autopilot_logs import LAG_S, boot_us, ulog

from apertura.campaign.folder import Campaign
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.formats.reading import open_recording, read_track


def write_samples(campaign, node, folder, name, *, conjugate=False):
    """Write a recording as int16 samples without header and a text file of time tags."""
    recording = open_recording(campaign.recording_files("f01", node))
    captures = recording.captures
    iq = np.asarray(recording.samples.captures(captures.start, captures.length))
    iq = iq * np.array([1, -1 if conjugate else 1], iq.dtype)
    iq.astype("<i2").tofile(folder / f"{name}.iq")
    tags = [f"{time}Z" for time in np.datetime_as_string(captures.time)]
    (folder / f"{name}_tags.txt").write_text("\n".join(tags) + "\n")


def epochs(campaign, node):
    """Return times, and latitude, longitude (deg) and ellipsoidal height (m), of a node's log."""
    track = read_track(campaign.track_file("f01", node), node=node)
    return track.time.values, geodetic_from_ecef(track.position.values)


def write_nmea(path, time, geodetic, *, separation_m=47.2):
    """Write RMC and GGA sentences with a fixed solution, to 1 nm of a minute and 0.1 mm."""
    lines = []
    for at, (latitude, longitude, height) in zip(time, geodetic, strict=True):
        text = str(at.astype("datetime64[ms]"))
        clock, date = text[11:].replace(":", ""), text[8:10] + text[5:7] + text[2:4]
        north = f"{int(latitude):02d}{latitude % 1 * 60:012.9f},N,{int(longitude):03d}{longitude % 1 * 60:012.9f},E"
        rmc = f"GNRMC,{clock},A,{north},0.0,0.0,{date},,,R"
        gga = f"GNGGA,{clock},{north},4,20,0.6,{height - separation_m:.4f},M,{separation_m:.4f},M,1.0,0001"
        for sentence in (rmc, gga):
            checksum = 0
            for byte in sentence.encode():
                checksum ^= byte
            lines.append(f"${sentence}*{checksum:02X}\r\n")
    path.write_text("".join(lines), newline="")


def write_csv(path, time, geodetic):
    rows = [
        f"{at}Z,{latitude:.11f},{longitude:.11f},{height:.5f}"
        for at, (latitude, longitude, height) in zip(np.datetime_as_string(time), geodetic, strict=True)
    ]
    path.write_text("\n".join(["time_utc,latitude_deg,longitude_deg,height_m", *rows]) + "\n")


def write_ulog(path, time, geodetic):
    """Write the log of a PX4 autopilot, with a receiver of double precision and a fixed solution."""
    start = np.datetime64("2025-05-14T09:30:00", "ns")
    seconds = (time - start) / np.timedelta64(1, "s")
    step = np.gradient(geodetic, seconds, axis=0) * [111_200, 74_000, -1]
    fields = {
        "timestamp": ("uint64_t", boot_us(seconds)),
        "time_utc_usec": ("uint64_t", time.astype("datetime64[us]").astype(np.int64)),
        "latitude_deg": ("double", geodetic[:, 0]),
        "longitude_deg": ("double", geodetic[:, 1]),
        "altitude_msl_m": ("double", geodetic[:, 2] - 47.5),
        "altitude_ellipsoid_m": ("double", geodetic[:, 2]),
        "eph": ("float", np.full(len(time), 0.01)),
        "epv": ("float", np.full(len(time), 0.02)),
        "fix_type": ("uint8_t", np.full(len(time), 6)),
        **{f"vel_{axis}_m_s": ("float", along) for axis, along in zip("ned", step.T, strict=True)},
        "vel_ned_valid": ("uint8_t", np.ones(len(time), int)),
    }
    path.write_bytes(ulog(("vehicle_gps_position", 0, fields), delay_ms=LAG_S * 1e3))


def int16_and_logs(root, folder):
    """Take a campaign of two nodes apart: int16 samples, time tags, an NMEA log, a CSV log and the codes."""
    campaign = Campaign.load(root)
    folder.mkdir(parents=True)
    for node, name in zip(("uav1", "uav2"), ("alpha", "bravo"), strict=True):
        write_samples(campaign, node, folder, name)
    write_nmea(folder / "alpha_gnss.nmea", *epochs(campaign, "uav1"))
    write_csv(folder / "bravo.csv", *epochs(campaign, "uav2"))
    shutil.copyfile(root / "raw/codes.npy", folder / "codes.npy")
    return folder


def truth(root):
    """Return easting and northing of the targets of a simulated campaign, m."""
    targets = json.loads((root / "truth.json").read_text())["targets"]
    return np.array([[target["x"], target["y"]] for target in targets])
