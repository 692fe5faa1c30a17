"""Scans of Time Domain PulsON P4xx radars (.out): real echo samples in messages MRM_SCAN_INFO.

Scans are read as stage `echo`, because the radar itself correlates the samples. Times are milliseconds since power-on.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.atomic import naming
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.formats.phase_histories.phase_history import distinct
from apertura.formats.tracks.csv_track import LARGEST_LOG

SAMPLE_RATE_HZ = 16.384e9
"""Sample rate of a scan; a sample interval is 32 of the radar's bins of 1.907 ps."""

BAND_HZ = 3.1e9, 5.3e9
"""Frequency band of the radar according to its data sheet."""

_CONFIG_BYTES = 32  # radar configuration at the start of a file
_SAMPLES = 350  # samples of a scan in each message
MESSAGE = np.dtype(
    [("type", ">u2"), ("id", ">u2"), ("source", ">u4"), ("time_ms", ">u4"), ("reserved", "V16")]
    + [("start_ps", ">i4"), ("stop_ps", ">i4"), ("step_bins", ">i2")]
    + [("kind", "u1"), ("filter", "u1"), ("antenna", "u1"), ("mode", "u1")]
    + [("held", ">u2"), ("total", ">u4"), ("index", ">u2"), ("messages", ">u2"), ("scan", ">i4", (_SAMPLES,))]
)
_SCAN_INFO, _STEP_BINS, _RAW_SCAN = 0xF201, 32, 1
_MOST_SAMPLES = 1 << 16
_EPOCH = np.datetime64("1970-01-01", "ns")
_SHARED = ("source", "start_ps", "stop_ps", "step_bins", "kind", "antenna", "total", "messages")


def read_pulson(paths: Sequence[Path], *, pair: str) -> xr.Dataset:
    """Read scans as `echo` stage: transfer functions over the band, without positions, which are in a flight log.

    `time` is the time since power-on of the radar, counted from 1970. Scans with missing or damaged messages, and a
    scan truncated by the end of its file, are excluded and counted in flag `scans_incomplete`.

    Parameters
    ----------
    paths
        Files of one radar, in the order of their scans.
    pair
        Transmitter-receiver.

    Raises
    ------
    CampaignError
        If a file contains no scan messages, or scans with different delay windows or antennas.

    Notes
    -----
    Source: Time Domain, "Monostatic Radar Module Application Programming Interface (API) Specification", messages
    MRM_SCAN_INFO and MRM_SET_CONFIG_REQUEST; docs/formats.md. A scan is the real echo sampled at `SAMPLE_RATE_HZ`; the
    bins of its Fourier transform inside `BAND_HZ` are the transfer function, referred to the start of the scan.
    """
    scans = [_scans(path) for path in sorted(paths)]
    messages = np.concatenate([first for first, _, _ in scans])
    samples = np.concatenate([scan for _, scan, _ in scans])
    incomplete = sum(count for _, _, count in scans)
    (kept,), flags, repeats = distinct([samples], [np.ones(len(samples), bool)], node=pair.rpartition("-")[2])
    messages, samples = messages[kept], samples[kept]
    start_ps, total = int(messages["start_ps"][0]), int(messages["total"][0])
    time_ms = messages["time_ms"].astype(np.int64)
    backwards = np.flatnonzero(np.diff(time_ms) <= 0)
    if backwards.size:
        at = int(backwards[0]) + 1
        found = f"scan {at} at {time_ms[at]} ms is not later than the previous scan at {time_ms[at - 1]} ms"
        raise _error(found, paths[0])
    frequency = np.arange(total // 2 + 1) * (SAMPLE_RATE_HZ / total)
    band = (frequency >= BAND_HZ[0]) & (frequency <= BAND_HZ[1])
    transfer = np.fft.rfft(samples, axis=1, norm="forward")[:, band].astype(np.complex64)
    duration_s = total / SAMPLE_RATE_HZ
    if incomplete:
        flags["scans_incomplete"] = f"{incomplete} of {incomplete + len(kept)} scans"
    return xr.Dataset(
        {
            "time": ("pulse", _EPOCH + time_ms.astype("timedelta64[ms]").astype("timedelta64[ns]")),
            "transfer": (("pulse", "subcarrier"), transfer),
            "frequency": ("subcarrier", frequency[band]),
            "reference_delay": ("pulse", np.full(len(samples), start_ps * 1e-12)),
            "path_limit": ("pulse", np.full(len(samples), (start_ps * 1e-12 + duration_s) * SPEED_OF_LIGHT_M_S)),
        },
        attrs={"pair": pair, "flags": flags, "dropped": repeats, "wave_speed_m_s": SPEED_OF_LIGHT_M_S},
    )


def _scans(path: Path) -> tuple[NDArray[np.void], NDArray[np.float64], int]:
    """Return the first message and the samples (scan, sample) of complete scans, and the number of incomplete scans."""
    if path.stat().st_size > LARGEST_LOG:
        raise _error(f"{path.stat().st_size} bytes, at most {LARGEST_LOG} are supported", path)
    with naming(path):
        content = path.read_bytes()
    messages, cut = _messages(content)
    if not messages.size:
        raise _error(f"{len(content)} bytes without a message MRM_SCAN_INFO", path)
    total = int(np.median(messages["total"]))
    count = -(-total // _SAMPLES)
    if not 0 < total <= _MOST_SAMPLES or count != int(np.median(messages["messages"])):
        raise _error(f"scans of {total} samples in {int(np.median(messages['messages']))} messages", path)
    kept = messages[(messages["total"] == total) & (messages["index"] < count)]
    first = np.flatnonzero(kept["index"] == 0)
    following = first[:, None] + np.arange(count)
    inside = following[:, -1] < len(kept)
    rows = kept[following[inside]]
    same = np.all([rows[name] == rows[name][:, :1] for name in ("id", "time_ms", *_SHARED)], axis=(0, 2))
    complete = rows[same & (rows["index"] == np.arange(count)).all(axis=1)]
    if not len(complete):
        raise _error("no complete scan", path)
    numbers = np.unique(messages["id"].astype(np.int64) << 32 | messages["time_ms"])
    _check(complete[:, 0], path)
    samples = complete["scan"].reshape(len(complete), -1)[:, :total].astype(np.float64)
    # A truncated last message starts another scan only after a complete scan; otherwise its scan is already counted.
    starts_scan = cut and messages["index"][-1] == count - 1
    return complete[:, 0], samples, len(numbers) - len(complete) + int(starts_scan)


def _messages(content: bytes) -> tuple[NDArray[np.void], bool]:
    """Return the messages of a file, skipping other bytes, and True if the file ends within a message."""
    size, sign = MESSAGE.itemsize, _SCAN_INFO.to_bytes(2, "big")
    at, blocks = min(_CONFIG_BYTES, len(content)), []
    last = at
    while (at := content.find(sign, at)) >= 0 and at + size <= len(content):
        last = at
        while content[last : last + 2] == sign and last + size <= len(content):
            last += size
        blocks.append(np.frombuffer(content[at:last], MESSAGE))
        at = last
    messages = np.concatenate(blocks) if blocks else np.empty(0, MESSAGE)
    scans = messages[(messages["step_bins"] == _STEP_BINS) & (messages["kind"] == _RAW_SCAN)]
    return np.asarray(scans), len(content) > last and sign.startswith(content[last : last + 2])


def _check(scans: NDArray[np.void], path: Path) -> None:
    """Raise CampaignError unless all scans have the same delay window and antennas."""
    for name in _SHARED:
        other = np.flatnonzero(scans[name] != scans[name][0])
        if other.size:
            found = f"scan {int(other[0])} has {name} {scans[name][other[0]]}, the first scan {scans[name][0]}"
            raise _error(found, path)
    duration_ps = int(scans["stop_ps"][0]) - int(scans["start_ps"][0])
    if abs(duration_ps * 1e-12 * SAMPLE_RATE_HZ - int(scans["total"][0])) > 2:
        raise _error(f"{scans['total'][0]} samples for {duration_ps} ps", path)


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected=f"{_CONFIG_BYTES} bytes of configuration, then messages MRM_SCAN_INFO of {MESSAGE.itemsize} bytes, "
        "raw scans in steps of 32 bins",
        remedy="Copy the file again, or record it with the radar's own software and these settings.",
    )
