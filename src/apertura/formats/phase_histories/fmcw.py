"""Beat signals of FMCW radars as arrays (.npy, .mat) or audio (.wav), read as stage `echo` without positions."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.core.echo.captures import Saturation, blocks_of
from apertura.core.echo.dechirp import FrequencySweep, SweepPower, transfer_of
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.npy import read_npy
from apertura.formats.phase_histories import fmcw_fields
from apertura.formats.phase_histories.phase_history import LARGEST, LEAST, distinct
from apertura.formats.times import utc_times

# ---- Beat signals of FMCW radars as arrays (.npy, .mat) -------------------------------------------------------------
#
# The sweep is configured in section `waveform` of kind fmcw.

_TIMES = ".time.npy"
_MOST_VALUES = 1 << 34
_FARTHEST_S = 2.0**33
"""Limit of times since 1970, s, within the range of int64 nanoseconds."""

_DATENUM = 723_181, 803_534
"""The years 1980 and 2200 as MATLAB datenum (days)."""

_LEAST_STEP = 0.9
"""Minimum interval between sweep starts, relative to the sweep duration.

The value is below 1, because float64 seconds since 1970 have a resolution of 0.2 us.
"""

_MOST_INTERVALS = 1.05
"""Maximum duration of a row of samples relative to the interval between sweeps."""

_CLIPPED_CONTRAST = 4.0
"""Frequency of the extreme value of a clipped beat signal relative to the adjacent value, at least; 2.4 at the crest of
a stable tone."""

_EXPECTED = "beat signals (sweep, sample), real or complex as configured in waveform.iq, all finite"
_REMEDY = "Correct the file, or waveform in the config."


@dataclass(frozen=True)
class Sweeps:
    """Sweeps of a file.

    Attributes
    ----------
    path
        The file.
    beat
        (sweep, sample) from the start of each sweep.
    time
        (sweep,) datetime64[ns], start of each sweep; None: not in the file.
    late_s
        (sweep,) delay of the first sample relative to the start of the sweep, s; None: zero.
    dropped
        Reason → number of excluded sweeps.
    """

    path: Path
    beat: NDArray[Any]
    time: Times | None
    late_s: NDArray[np.float64] | None = None
    dropped: Mapping[str, int] | None = None


def read_beat_npy(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Read <node>.npy or <node>.<part>.npy, (sweep, sample), as `echo` stage without positions.

    An additional file <stem>.time.npy may contain the start of each sweep in <stem>.npy, as datetime64 or as float64
    seconds since 1970.

    Raises
    ------
    CampaignError
        If arrays are inconsistent with each other or with the waveform.
    """
    by_name = {path.name: path for path in paths}
    files = [path for path in paths if not path.name.endswith(_TIMES)]
    orphans = [
        path for path in paths if path.name.endswith(_TIMES) and path.name[: -len(_TIMES)] + ".npy" not in by_name
    ]
    if orphans or not files:
        raise _error("times without beat signals", (orphans or list(paths))[0])
    limits: dict[str, Any] = {"most": _MOST_VALUES, "expected": _EXPECTED, "remedy": _REMEDY}
    read = []
    for path in files:
        time_path = by_name.get(path.name.removesuffix(".npy") + _TIMES)
        time = None if time_path is None else times_of(read_npy(time_path, kinds="Mf", **limits), time_path)
        read.append(Sweeps(path, read_npy(path, kinds="fiuc", **limits), time))
    return joined_sweeps(read, pair=pair, described=described)


def read_beat_mat(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Read MATLAB files with beat (sweep, sample) and optionally time (sweep,) in s since 1970 as `echo` stage.

    Raises
    ------
    CampaignError
        See `read_beat_npy`.
    """
    read = read_fields(fmcw_fields.read_beat_fields, paths)
    return joined_sweeps([sweeps_of(path, variables) for path, variables in read], pair=pair, described=described)


def read_fields(
    function: Callable[[Path], Any], paths: Sequence[Path]
) -> Iterable[tuple[Path, dict[str, NDArray[Any]]]]:
    """Read files in a separate process; return each file, sorted by name, with its fields.

    Raises
    ------
    CampaignError
        If the function rejects a file or its process crashes.
    """
    paths = sorted(paths)
    try:
        return list(zip(paths, read_isolated(function, paths), strict=True))
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error


def sweeps_of(path: Path, variables: Mapping[str, NDArray[Any]]) -> Sweeps:
    """Convert the variables beat and time of a MATLAB file to sweeps; raise CampaignError if time is invalid."""
    return Sweeps(path, variables["beat"], times_of(variables["time"], path) if "time" in variables else None)


def sweep_of(described: Mapping[str, Any]) -> FrequencySweep:
    """Return the sweep configured in section `waveform`."""
    return FrequencySweep(**{field.name: described[field.name] for field in fields(FrequencySweep)})


def joined_sweeps(read: Sequence[Sweeps], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Build the `echo` stage of sweeps, without positions; `dropped` counts excluded sweeps by reason.

    Parameters
    ----------
    read
        Sweeps of the files, in the order of time.
    pair
        Transmitter-receiver.
    described
        Section `waveform`.

    Raises
    ------
    CampaignError
        If sweeps are too short, contradict waveform.iq, or contain values that are not finite, or if times are missing
        or do not increase.
    """
    sweep, dropped = sweep_of(described), Counter[str]()
    all_starts, echoes = list[Times](), list[NDArray[np.bool_]]()
    for file in read:
        _check(file, sweep, described)
        starts = _regular(file, described, is_single=len(read) == 1) if file.time is None else file.time
        if len(starts) != len(file.beat):
            raise _error(f"{len(starts)} times for {len(file.beat)} sweeps", file.path)
        all_starts.append(starts)
        echoes.append(np.asarray(file.beat[:, sweep.first : sweep.sweep_samples].any(axis=1)))
        dropped.update({**(file.dropped or {}), "all samples zero": int((~echoes[-1]).sum())})
    used = [file.beat[:, sweep.first : sweep.sweep_samples] for file in read]
    kept, flags, repeats = distinct(used, echoes, node=pair.rpartition("-")[2])
    dropped.update(repeats)
    times, transfers = list[Times](), list[NDArray[np.complex64]]()
    saturation, power = Saturation(_CLIPPED_CONTRAST), SweepPower(sweep)
    for file, starts, mask in zip(read, all_starts, kept, strict=True):
        for block in blocks_of(np.flatnonzero(mask)):
            samples = file.beat[block, sweep.first : sweep.sweep_samples]
            saturation.count({"radar": _parts(samples)})
            power.count(samples)
        late_s = None if file.late_s is None else file.late_s[mask]
        times.append(starts[mask])
        transfers.append(transfer_of(file.beat[mask], sweep, late_s=late_s))
    time = np.concatenate(times) + np.timedelta64(round(sweep.middle_s * 1e9), "ns")
    if not len(time):
        raise _error("no sweep with a non-zero sample", read[0].path)
    steps_s = np.diff(time) / np.timedelta64(1, "s")
    early = np.flatnonzero(steps_s < _LEAST_STEP * sweep.sweep_samples / sweep.sample_rate_hz)
    if early.size:
        found = (
            f"sweep {int(early[0]) + 1} starts {steps_s[early[0]]:.6g} s after the previous sweep, whose duration is "
            f"{sweep.sweep_s:g} s"
        )
        raise _error(f"{found} ({early.size} such sweeps in all files)", read[0].path)
    return xr.Dataset(
        {
            "time": ("pulse", time),
            "transfer": (("pulse", "subcarrier"), np.concatenate(transfers)),
            "frequency": ("subcarrier", sweep.frequency_hz),
            "reference_delay": ("pulse", np.full(len(time), sweep.reference_delay_s)),
            "path_limit": ("pulse", np.full(len(time), sweep.path_limit_m)),
        },
        attrs={
            "pair": pair,
            "flags": Flags.merged(flags, saturation.clipped, power.flags),
            "wave_speed_m_s": SPEED_OF_LIGHT_M_S,
            "dropped": {reason: count for reason, count in dropped.items() if count},
            "sweep_used_s": sweep.samples / sweep.sample_rate_hz,
        },
    )


def _parts(beat: NDArray[Any]) -> NDArray[Any]:
    """Return the real part of beat signals and, if they are complex, the imaginary part: (sweep, sample, part)."""
    return np.stack([beat.real, beat.imag], -1) if np.iscomplexobj(beat) else np.asarray(beat)[..., None]


def _check(file: Sweeps, sweep: FrequencySweep, described: Mapping[str, Any]) -> None:
    beat = file.beat
    if beat.ndim == 2 and _is_by_columns(file, sweep, described):
        raise CampaignError(
            f"{beat.shape[0]} × {beat.shape[1]} samples, with a sweep in each column",
            file.path,
            f"a sweep in each row: (sweep, sample), at least {sweep.sweep_samples} samples",
            "Save the transpose; or correct waveform.sweep_s, waveform.sample_rate_hz and waveform.prf_hz.",
        )
    if beat.ndim != 2 or beat.dtype.kind not in "fiuc" or beat.shape[1] < sweep.sweep_samples or not len(beat):
        raise _error(f"{beat.dtype} of shape {beat.shape}; a sweep has {sweep.sweep_samples} samples", file.path)
    if (beat.dtype.kind == "c") != (sweep.iq != "real"):
        raise _error(f"{beat.dtype} samples, but waveform.iq is {sweep.iq}", file.path)
    if beat.dtype.kind == "c" and beat.real.any() and not beat.imag.any():
        raise _error(f"the imaginary parts of all samples are zero, but waveform.iq is {sweep.iq}", file.path)
    with np.errstate(invalid="ignore"):
        magnitude = np.abs(beat).max(axis=1)
    bad = np.flatnonzero(~(magnitude < LARGEST))
    if bad.size:
        raise _error(
            f"sweep {int(bad[0])} contains a sample that is not a number or exceeds {LARGEST:g} ({bad.size} such "
            "sweeps)",
            file.path,
        )
    if 0 < magnitude.max() < LEAST:
        found = f"the largest sample is {magnitude.max():.3g}, at least {LEAST:g} is accepted"
        raise CampaignError(found, file.path, _EXPECTED, "Multiply the samples by a constant.")


def _is_by_columns(file: Sweeps, sweep: FrequencySweep, described: Mapping[str, Any]) -> bool:
    """Return True if the columns of an array are sweeps, according to its times, its shape and the sweep interval."""
    rows, columns = file.beat.shape
    if file.time is not None and rows != columns and len(file.time) in {rows, columns}:
        return bool(len(file.time) == columns)
    exact = {sweep.sweep_samples}
    if described.get("prf_hz"):
        exact.add(round(sweep.sample_rate_hz / described["prf_hz"]))
    if (rows in exact) != (columns in exact):
        return bool(rows in exact)
    too_long = columns < sweep.sweep_samples or (described.get("prf_hz") and columns > _MOST_INTERVALS * max(exact))
    return bool(too_long and rows >= sweep.sweep_samples)


def _regular(file: Sweeps, described: Mapping[str, Any], *, is_single: bool) -> Times:
    """Return sweep starts at rate waveform.prf_hz, the first at waveform.start_utc."""
    if described["prf_hz"] is None or not is_single:
        found = "no sweep times" if is_single else "several files without sweep times"
        raise _error(found, file.path, "sweep times in the file, or a single file and waveform.prf_hz")
    steps_ns = np.round(np.arange(len(file.beat)) * (1e9 / described["prf_hz"]))
    times: Times = beginning(described, file.path) + steps_ns.astype("timedelta64[ns]")
    return times


def beginning(described: Mapping[str, Any], path: Path) -> np.datetime64:
    """Return waveform.start_utc; with the default, 1970, a configured clock offset relates the times to the log."""
    start_utc = described["start_utc"]
    try:
        first: np.datetime64 = np.datetime64("1970-01-01", "ns") if start_utc is None else utc_times([start_utc])[0]
    except ValueError as error:
        raise _error(f"waveform.start_utc: {error}", path, "ISO 8601 in UTC") from error
    return first


def times_of(stored: NDArray[Any], path: Path) -> Times:
    """Convert times of sweeps, datetime64 or seconds since 1970, to datetime64[ns]; raise CampaignError if invalid."""
    known = stored.dtype.kind in "fiu" or (stored.dtype.kind == "M" and stored.dtype != np.dtype("M8"))
    if not known or stored.ndim != 1 or not stored.size:
        raise _error(f"array of times is {stored.dtype} of shape {stored.shape}", path)
    if stored.dtype.kind != "M":
        with np.errstate(invalid="ignore", over="ignore"):  # NaN becomes NaT and is rejected below
            seconds = stored.astype(np.float64)
            seconds = np.where(np.abs(seconds) < _FARTHEST_S, seconds, np.nan)
            if _are_datenum(seconds):
                found = "times in days (MATLAB datenum)"
                raise CampaignError(found, path, "seconds since 1970", "Save 86400 * (time - 719529).")
            whole = np.floor(seconds)
            # integer and fraction separately: float64 cannot resolve nanoseconds since 1970
            rest = np.round((seconds - whole) * 1e9).astype("timedelta64[ns]")
            stored = whole.astype("datetime64[s]").astype("datetime64[ns]") + rest
    years = stored.astype("datetime64[Y]").astype(np.int64) + 1970
    wrong = np.flatnonzero(np.isnat(stored) | (years < 1970) | (years > 2199))
    if wrong.size:
        raise _error(f"time {int(wrong[0])} is not between 1970 and 2199", path)
    return stored.astype("datetime64[ns]")


def _are_datenum(time: NDArray[np.float64]) -> bool:
    """Return True if times are MATLAB days of 1980 to 2199, which as seconds lie in January 1970."""
    return bool(time.size and (time > _DATENUM[0]).all() and (time < _DATENUM[1]).all() and np.ptp(time) < 1)


def _error(found: str, path: Path, expected: str = _EXPECTED) -> CampaignError:
    return CampaignError(found, where=path, expected=expected, remedy=_REMEDY)


# ---- Beat signals of a sound card (.wav): sync channel and beat channel ---------------------------------------------

_EXTREMES = 0.1, 99.9
"""Percentiles that are used as levels of the sync channel; clicks of a sound card are thereby excluded."""

_SAME_RATE = 1e-6


def read_beat_wav(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Read a .wav file as `echo` stage; a sweep starts where the sync channel crosses the mean of its two levels.

    Sweeps truncated by the next trigger or the end of the file are excluded and counted.

    Raises
    ------
    CampaignError
        If the file is not a WAV file, lacks a channel or triggers, or its rate is not waveform.sample_rate_hz.

    Notes
    -----
    Source: docs/theory/fmcw.md, "Triggers"; G. L. Charvat et al., MIT OpenCourseWare RES.LL-003, 2011.
    """
    if len(paths) != 1:
        raise _bad(f"{len(paths)} files", paths[1], "one .wav file per node and flight", "Merge the files into one.")
    path, recording = next(iter(read_fields(fmcw_fields.read_wav, paths)))
    return joined_sweeps([cut_sweeps(path, recording, described)], pair=pair, described=described)


def cut_sweeps(path: Path, recording: Mapping[str, NDArray[Any]], described: Mapping[str, Any]) -> Sweeps:
    """Extract the complete sweeps of a recording.

    Parameters
    ----------
    path
        The file, for messages.
    recording
        rate (1,), Hz, and samples (sample, channel), from `apertura.formats.phase_histories.fmcw_fields.read_wav`.
    described
        Section `waveform`.

    Raises
    ------
    CampaignError
        See `read_beat_wav`.
    """
    sweep, trigger, samples = sweep_of(described), described["trigger"], recording["samples"]
    rate = float(recording["rate"][0])
    if abs(rate - sweep.sample_rate_hz) > _SAME_RATE * rate:
        raise _bad(f"{rate:g} samples/s", path, f"waveform.sample_rate_hz, {sweep.sample_rate_hz:g}")
    channels = {name: trigger[f"{name}_channel"] for name in ("sync", "beat")}
    if max(channels.values()) > samples.shape[1]:
        raise _bad(f"{samples.shape[1]} channels", path, f"channels {[*channels.values()]} of waveform.trigger")
    with np.errstate(invalid="ignore"):  # NaN is kept and rejected later
        sync = samples[:, channels["sync"] - 1].astype(np.float64)
        beat = samples[:, channels["beat"] - 1].astype(np.float32)
    falling = trigger["edge"] == "falling"
    starts = trigger_starts(-sync if falling else sync, threshold=trigger["threshold"])
    first, whole = np.ceil(starts).astype(np.int64), _whole(starts, sweep, len(samples))
    if not whole.any():
        raise _bad(f"{len(starts)} triggers, none followed by a complete sweep of {sweep.sweep_samples} samples", path)
    if samples.dtype == np.uint8:
        beat -= 128  # zero level of 8-bit WAV
    rows = np.lib.stride_tricks.sliding_window_view(beat, sweep.sweep_samples)[first[whole]]
    time = beginning(described, path) + np.round(starts[whole] * (1e9 / rate)).astype("timedelta64[ns]")
    return Sweeps(path, rows, time, (first - starts)[whole] / rate, {"incomplete": int((~whole).sum())})


def trigger_starts(sync: NDArray[np.float64], *, threshold: float) -> NDArray[np.float64]:
    """Find the instants at which a channel rises through the mean of its two levels, in fractional samples.

    Parameters
    ----------
    sync
        (sample,) float64.
    threshold
        Minimum excursion to both sides of the mean, relative to half the difference of the levels.

    Examples
    --------
    >>> trigger_starts(np.tile([0.0, 0.0, 1.0, 1.0], 3), threshold=0.3).tolist()
    [1.5, 5.5, 9.5]
    """
    if not sync.size or not np.isfinite(sync).all():
        return np.zeros(0)
    low, high = np.percentile(sync, _EXTREMES)
    middle, excursion = (low + high) / 2, threshold * (high - low) / 2
    marks = np.flatnonzero(np.abs(sync - middle) > excursion) if high > low else np.zeros(0, np.int64)
    up = sync[marks] > middle
    rises = marks[1:][up[1:] & ~up[:-1]]
    below = np.flatnonzero(sync <= middle)
    last = below[np.searchsorted(below, rises) - 1]  # last sample below the mean; exists because a low level precedes
    at: NDArray[np.float64] = last + (middle - sync[last]) / (sync[last + 1] - sync[last])
    return at


def _whole(starts: NDArray[np.float64], sweep: FrequencySweep, count: int) -> NDArray[np.bool_]:
    """Return a mask of sweeps that end before the next trigger and the end of the file."""
    ends = np.ceil(starts).astype(np.int64) + sweep.sweep_samples
    following = np.append(np.ceil(starts[1:]), count)
    return np.asarray(ends <= following)


def _bad(found: str, path: Path, expected: str = "triggers in the sync channel", remedy: str = "") -> CampaignError:
    return CampaignError(found, path, expected, remedy or "Correct waveform in the config.")
