"""Beat signals as bytes in all formats, and readers of a file of each format."""

import io
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat, wavfile

from apertura.common.errors import CampaignError
from apertura.core.echo.dechirp import FrequencySweep
from apertura.formats.phase_histories.fmcw import cut_sweeps, joined_sweeps, read_beat_npy, sweeps_of
from apertura.formats.phase_histories.fmcw_fields import read_beat_fields, read_wav

SWEEP = FrequencySweep(2.26e9, 330e6, 1e-3, 44_100.0)
DESCRIBED = {
    **asdict(SWEEP),
    "prf_hz": 500.0,
    "start_utc": "2025-05-14T09:30",
    "trigger": {"sync_channel": 1, "beat_channel": 2, "edge": "rising", "threshold": 0.3},
}
_COUNT = 6


def _beats() -> np.ndarray:
    return np.cos(np.arange(_COUNT)[:, None] + 0.5 * np.arange(SWEEP.sweep_samples))


def _saved(array: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, array)
    return target.getvalue()


def arrays() -> list[bytes]:
    """Return beats as .npy, of two types."""
    return [_saved(_beats()), _saved((1000 * _beats()).astype("<i2"))]


def times() -> list[bytes]:
    """Return times of sweeps as .npy in two representations."""
    seconds = 1.7e9 + 0.002 * np.arange(_COUNT)
    return [_saved(seconds), _saved((1e9 * seconds).astype("datetime64[ns]"))]


def matlab() -> list[bytes]:
    """Return MATLAB files with and without times, one compressed."""
    files = []
    for fields in ({"beat": _beats()}, {"beat": _beats(), "time": 1.7e9 + 0.002 * np.arange(_COUNT)}):
        target = io.BytesIO()
        savemat(target, fields, do_compression="time" in fields)
        files.append(target.getvalue())
    return files


def sounds() -> list[bytes]:
    """Return recordings of a sound card, of two types."""
    files = []
    for dtype, scale in (("<i2", 8000), ("<f4", 0.5)):
        high = np.zeros((_COUNT, 88))
        high[:, 10 : 10 + SWEEP.sweep_samples] = 1
        beat = np.zeros_like(high)
        beat[:, 10 : 10 + SWEEP.sweep_samples] = _beats()
        target = io.BytesIO()
        wavfile.write(target, 44_100, (scale * np.stack([high.ravel(), beat.ravel()], 1)).astype(dtype))
        files.append(target.getvalue())
    return files


def read_array(path: Path) -> Any:
    """Read beats at a regular rate."""
    return read_beat_npy([path], pair="a-a", described=DESCRIBED)


def read_times(path: Path) -> Any:
    """Read times together with a valid file of beats."""
    beats = path.with_name(path.name.replace(".time.npy", ".npy"))
    beats.write_bytes(arrays()[0])
    return read_beat_npy([beats, path], pair="a-a", described=DESCRIBED)


def read_matlab(path: Path) -> Any:
    """Read like `read_beat_mat`, but in this process, which may crash."""
    return joined_sweeps([sweeps_of(path, _fields(read_beat_fields, path))], pair="a-a", described=DESCRIBED)


def read_sound(path: Path) -> Any:
    """Read like `read_beat_wav`, but in this process."""
    sweeps = cut_sweeps(path, _fields(read_wav, path), DESCRIBED)
    return joined_sweeps([sweeps], pair="a-a", described=DESCRIBED)


def _fields(read: Any, path: Path) -> Any:
    try:
        return read(path)
    except Exception as error:  # of any type: the isolated reader prints the exception as its last line
        raise CampaignError(str(error), path, "beat signals", "Copy it again.") from error
