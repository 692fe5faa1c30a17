"""Beat signals of FMCW radars as arrays (.npy, .mat) or sound (.wav): they enter at `echo`, placed by flight logs."""

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
from apertura.core.echo.dechirp import FrequencySweep, transfer_of
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.npy import read_npy
from apertura.formats.phase_histories import fmcw_fields
from apertura.formats.times import utc_times

# ---- Beat signals of FMCW radars as arrays (.npy, .mat) -------------------------------------------------------------
#
# The sweep is stated by the config: section `waveform` of kind fmcw.

_TIMES = ".time.npy"
_MOST_VALUES = 1 << 34
_LARGEST = 1e15
"""Largest sample: its square is a float32."""

_FARTHEST_S = 2.0**33
"""Since 1970, what nanoseconds can count."""

_DATENUM = 723_181, 803_534
"""1980 and 2200 as MATLAB counts days."""

_LEAST_STEP = 0.9
"""Of a sweep, what at least is between the beginnings of two; float64 seconds since 1970 are good to 0.2 us."""

_MOST_INTERVALS = 1.05
"""Of the interval between sweeps, how many samples a row may hold."""

_EXPECTED = "beat signals (sweep, sample), real or complex as waveform.iq says, all finite"
_REMEDY = "Correct the file, or waveform in the config."


@dataclass(frozen=True)
class Sweeps:
    """Content of one file.

    Attributes
    ----------
    path
        The file.
    beat
        (sweep, sample) from the beginning of each sweep.
    time
        (sweep,) datetime64[ns], start of each; None: not stated by the file.
    late_s
        (sweep,) seconds by which the first sample is later than that; None: by nothing.
    dropped
        Reason → sweeps that are left out.
    """

    path: Path
    beat: NDArray[Any]
    time: Times | None
    late_s: NDArray[np.float64] | None = None
    dropped: Mapping[str, int] | None = None


def read_beat_npy(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Return the `echo` stage of <node>.npy or <node>.<part>.npy, (sweep, sample), without positions.

    Beside <stem>.npy, <stem>.time.npy may state the start of each sweep: datetime64, or float64 seconds since 1970.

    Raises
    ------
    CampaignError
        If arrays do not fit each other or the waveform.
    """
    by_name = {path.name: path for path in paths}
    files = [path for path in paths if not path.name.endswith(_TIMES)]
    alone = [path for path in paths if path.name.endswith(_TIMES) and path.name[: -len(_TIMES)] + ".npy" not in by_name]
    if alone or not files:
        raise _error("times without beat signals", (alone or list(paths))[0])
    limits: dict[str, Any] = {"most": _MOST_VALUES, "expected": _EXPECTED, "remedy": _REMEDY}
    read = []
    for path in files:
        beside = by_name.get(path.name.removesuffix(".npy") + _TIMES)
        time = None if beside is None else _times(read_npy(beside, kinds="Mf", **limits), beside)
        read.append(Sweeps(path, read_npy(path, kinds="fiuc", **limits), time))
    return joined_sweeps(read, pair=pair, described=described)


def read_beat_mat(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Return the `echo` stage of MATLAB files with beat (sweep, sample) and, or not, time (sweep,) in s since 1970.

    Raises
    ------
    CampaignError
        As `read_beat_npy`.
    """
    read = read_fields(fmcw_fields.read_beat_fields, paths)
    return joined_sweeps([sweeps_of(path, one) for path, one in read], pair=pair, described=described)


def read_fields(
    function: Callable[[Path], Any], paths: Sequence[Path]
) -> Iterable[tuple[Path, dict[str, NDArray[Any]]]]:
    """Return each file, in the order of names, and what a function in a process of its own makes of it.

    Raises
    ------
    CampaignError
        If it refuses one, or dies of it.
    """
    paths = sorted(paths)
    try:
        return list(zip(paths, read_isolated(function, paths), strict=True))
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error


def sweeps_of(path: Path, found: Mapping[str, NDArray[Any]]) -> Sweeps:
    """Return the variables beat and time of a MATLAB file as sweeps; raise CampaignError if time is none."""
    return Sweeps(path, found["beat"], _times(found["time"], path) if "time" in found else None)


def sweep_of(described: Mapping[str, Any]) -> FrequencySweep:
    """Return the sweep of section `waveform`."""
    return FrequencySweep(**{field.name: described[field.name] for field in fields(FrequencySweep)})


def joined_sweeps(read: Sequence[Sweeps], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Return the `echo` stage of sweeps, without positions; `dropped` counts those left out by reason.

    Parameters
    ----------
    read
        What files hold, in the order of time.
    pair
        Transmitter-receiver.
    described
        Section `waveform`.

    Raises
    ------
    CampaignError
        If sweeps are too short, are not what waveform.iq says, are no finite numbers, or have no times that ascend.
    """
    sweep, dropped = sweep_of(described), dict[str, int]()
    times, transfers = list[Times](), list[NDArray[np.complex64]]()
    for one in read:
        _check(one, sweep, described)
        began = _regular(one, described, alone=len(read) == 1) if one.time is None else one.time
        if len(began) != len(one.beat):
            raise _error(f"{len(began)} times for {len(one.beat)} sweeps", one.path)
        sound = one.beat[:, sweep.first : sweep.sweep_samples].any(axis=1)
        left_out = {**(one.dropped or {}), "silent": int((~sound).sum())}
        dropped = {why: dropped.get(why, 0) + left_out.get(why, 0) for why in {**dropped, **left_out}}
        late_s = None if one.late_s is None else one.late_s[sound]
        times.append(began[sound])
        transfers.append(transfer_of(one.beat[sound], sweep, late_s=late_s))
    time = np.concatenate(times) + np.timedelta64(round(sweep.middle_s * 1e9), "ns")
    if not len(time):
        raise _error("no sweep with a signal", read[0].path)
    steps_s = np.diff(time) / np.timedelta64(1, "s")
    early = np.flatnonzero(steps_s < _LEAST_STEP * sweep.sweep_samples / sweep.sample_rate_hz)
    if early.size:
        found = (
            f"sweep {int(early[0]) + 1} begins {steps_s[early[0]]:.6g} s after another that lasts {sweep.sweep_s:g} s"
        )
        raise _error(f"{found} ({early.size} such in all files)", read[0].path)
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
            "flags": {},
            "wave_speed_m_s": SPEED_OF_LIGHT_M_S,
            "dropped": {why: count for why, count in dropped.items() if count},
            "sweep_used_s": sweep.samples / sweep.sample_rate_hz,
        },
    )


def _check(one: Sweeps, sweep: FrequencySweep, described: Mapping[str, Any]) -> None:
    beat = one.beat
    if beat.ndim == 2 and _is_by_columns(one, sweep, described):
        raise CampaignError(
            f"{beat.shape[0]} × {beat.shape[1]} samples, with a sweep in each column",
            one.path,
            f"a sweep in each row: (sweep, sample), at least {sweep.sweep_samples} samples",
            "Save the transpose; or correct waveform.sweep_s, waveform.sample_rate_hz and waveform.prf_hz.",
        )
    if beat.ndim != 2 or beat.dtype.kind not in "fiuc" or beat.shape[1] < sweep.sweep_samples or not len(beat):
        raise _error(f"{beat.dtype} of shape {beat.shape}: a sweep has {sweep.sweep_samples} samples", one.path)
    if (beat.dtype.kind == "c") != (sweep.iq != "real"):
        raise _error(f"{beat.dtype} samples where waveform.iq is {sweep.iq}", one.path)
    with np.errstate(invalid="ignore"):
        bad = np.flatnonzero(~(np.abs(beat).max(axis=1) < _LARGEST))
    if bad.size:
        raise _error(
            f"sweep {int(bad[0])} holds what is no number, or beyond {_LARGEST:g} ({bad.size} in all)", one.path
        )


def _is_by_columns(one: Sweeps, sweep: FrequencySweep, described: Mapping[str, Any]) -> bool:
    """Test whether columns of an array are sweeps: by its times, its sides, and the interval between sweeps."""
    rows, columns = one.beat.shape
    if one.time is not None and rows != columns and len(one.time) in {rows, columns}:
        return bool(len(one.time) == columns)
    exact = {sweep.sweep_samples}
    if described.get("prf_hz"):
        exact.add(round(sweep.sample_rate_hz / described["prf_hz"]))
    if (rows in exact) != (columns in exact):
        return bool(rows in exact)
    too_long = columns < sweep.sweep_samples or (described.get("prf_hz") and columns > _MOST_INTERVALS * max(exact))
    return bool(too_long and rows >= sweep.sweep_samples)


def _regular(one: Sweeps, described: Mapping[str, Any], *, alone: bool) -> Times:
    """Return when sweeps began that come at waveform.prf_hz from waveform.start_utc on."""
    if described["prf_hz"] is None or not alone:
        found = "no times of sweeps" if alone else "several files without times of their sweeps"
        raise _error(found, one.path, "the file's own times, or one file and waveform.prf_hz")
    steps_ns = np.round(np.arange(len(one.beat)) * (1e9 / described["prf_hz"]))
    times: Times = beginning(described, one.path) + steps_ns.astype("timedelta64[ns]")
    return times


def beginning(described: Mapping[str, Any], path: Path) -> np.datetime64:
    """Return waveform.start_utc; without one 1970, from where a clock of the config leads to the log's times."""
    stated = described["start_utc"]
    try:
        first: np.datetime64 = np.datetime64("1970-01-01", "ns") if stated is None else utc_times([stated])[0]
    except ValueError as error:
        raise _error(f"waveform.start_utc: {error}", path, "ISO 8601 in UTC") from error
    return first


def _times(stored: NDArray[Any], path: Path) -> Times:
    known = stored.dtype.kind in "fiu" or (stored.dtype.kind == "M" and stored.dtype != np.dtype("M8"))
    if not known or stored.ndim != 1 or not stored.size:
        raise _error(f"times as {stored.dtype} of shape {stored.shape}", path)
    if stored.dtype.kind != "M":
        with np.errstate(invalid="ignore", over="ignore"):  # what is no number becomes no time, and is refused as such
            seconds = stored.astype(np.float64)
            seconds = np.where(np.abs(seconds) < _FARTHEST_S, seconds, np.nan)
            if _are_datenum(seconds):
                found = "times as days of MATLAB (datenum)"
                raise CampaignError(found, path, "seconds since 1970", "Write 86400 * (time - 719529).")
            whole = np.floor(seconds)
            # apart, because float64 holds nanoseconds of one second but not of all since 1970
            rest = np.round((seconds - whole) * 1e9).astype("timedelta64[ns]")
            stored = whole.astype("datetime64[s]").astype("datetime64[ns]") + rest
    years = stored.astype("datetime64[Y]").astype(np.int64) + 1970
    wrong = np.flatnonzero(np.isnat(stored) | (years < 1970) | (years > 2199))
    if wrong.size:
        raise _error(f"time {int(wrong[0])} is none between 1970 and 2199", path)
    return stored.astype("datetime64[ns]")


def _are_datenum(time: NDArray[np.float64]) -> bool:
    """Test whether times are days since the year 0, of 1980 to 2199; as seconds they were of January 1970."""
    return bool(time.size and (time > _DATENUM[0]).all() and (time < _DATENUM[1]).all() and np.ptp(time) < 1)


def _error(found: str, path: Path, expected: str = _EXPECTED) -> CampaignError:
    return CampaignError(found, where=path, expected=expected, remedy=_REMEDY)


# ---- Beat signals of a sound card (.wav): channels of triggers and beats --------------------------------------------

_EXTREMES = 0.1, 99.9
"""Percentiles that are the levels of the sync channel: clicks of a sound card are beyond."""

_SAME_RATE = 1e-6


def read_beat_wav(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Return the `echo` stage of one .wav file: a sweep begins where the sync channel passes the middle of its levels.

    Sweeps that the next trigger or the end of the file cuts short are left out and counted.

    Raises
    ------
    CampaignError
        If the file is none, lacks a channel or triggers, or its rate is not waveform.sample_rate_hz.

    Notes
    -----
    Source: docs/theory/fmcw.md, "Triggers"; G. L. Charvat et al., MIT OpenCourseWare RES.LL-003, 2011.
    """
    if len(paths) != 1:
        raise _bad(f"{len(paths)} files", paths[1], "one .wav file of a node and flight", "Make one file of them.")
    path, found = next(iter(read_fields(fmcw_fields.read_wav, paths)))
    return joined_sweeps([cut_sweeps(path, found, described)], pair=pair, described=described)


def cut_sweeps(path: Path, found: Mapping[str, NDArray[Any]], described: Mapping[str, Any]) -> Sweeps:
    """Return the whole sweeps of a recording.

    Parameters
    ----------
    path
        For messages.
    found
        rate (1,), Hz, and samples (sample, channel), as `apertura.formats.phase_histories.fmcw_fields` reads them.
    described
        Section `waveform`.

    Raises
    ------
    CampaignError
        As `read_beat_wav`.
    """
    sweep, trigger, samples = sweep_of(described), described["trigger"], found["samples"]
    rate = float(found["rate"][0])
    if abs(rate - sweep.sample_rate_hz) > _SAME_RATE * rate:
        raise _bad(f"{rate:g} samples/s", path, f"waveform.sample_rate_hz, {sweep.sample_rate_hz:g}")
    channels = {name: trigger[f"{name}_channel"] for name in ("sync", "beat")}
    if max(channels.values()) > samples.shape[1]:
        raise _bad(f"{samples.shape[1]} channels", path, f"waveform.trigger's channels {[*channels.values()]}")
    with np.errstate(invalid="ignore"):  # what is no number stays none, and is refused as such
        sync = samples[:, channels["sync"] - 1].astype(np.float64)
        beat = samples[:, channels["beat"] - 1].astype(np.float32)
    falling = trigger["edge"] == "falling"
    starts = trigger_starts(-sync if falling else sync, threshold=trigger["threshold"])
    first, whole = np.ceil(starts).astype(np.int64), _whole(starts, sweep, len(samples))
    if not whole.any():
        raise _bad(f"{len(starts)} triggers, none with a whole sweep of {sweep.sweep_samples} samples after it", path)
    if samples.dtype == np.uint8:
        beat -= 128  # of 8 bits that is zero
    rows = np.lib.stride_tricks.sliding_window_view(beat, sweep.sweep_samples)[first[whole]]
    time = beginning(described, path) + np.round(starts[whole] * (1e9 / rate)).astype("timedelta64[ns]")
    return Sweeps(path, rows, time, (first - starts)[whole] / rate, {"incomplete": int((~whole).sum())})


def trigger_starts(sync: NDArray[np.float64], *, threshold: float) -> NDArray[np.float64]:
    """Return the places where a channel rises through the middle of its levels, in samples and fractions.

    Parameters
    ----------
    sync
        (sample,) float64.
    threshold
        Of half the distance of its levels: how far on either side of the middle it must go.

    Examples
    --------
    >>> trigger_starts(np.tile([0.0, 0.0, 1.0, 1.0], 3), threshold=0.3).tolist()
    [1.5, 5.5, 9.5]
    """
    if not sync.size or not np.isfinite(sync).all():
        return np.zeros(0)
    low, high = np.percentile(sync, _EXTREMES)
    middle, beyond = (low + high) / 2, threshold * (high - low) / 2
    marks = np.flatnonzero(np.abs(sync - middle) > beyond) if high > low else np.zeros(0, np.int64)
    up = sync[marks] > middle
    rose = marks[1:][up[1:] & ~up[:-1]]
    low_ones = np.flatnonzero(sync <= middle)
    last = low_ones[np.searchsorted(low_ones, rose) - 1]  # there is one: the mark before `rose`
    at: NDArray[np.float64] = last + (middle - sync[last]) / (sync[last + 1] - sync[last])
    return at


def _whole(starts: NDArray[np.float64], sweep: FrequencySweep, count: int) -> NDArray[np.bool_]:
    """Return a mask of sweeps that end before the next trigger and the file do."""
    ends = np.ceil(starts).astype(np.int64) + sweep.sweep_samples
    following = np.append(np.ceil(starts[1:]), count)
    return np.asarray(ends <= following)


def _bad(found: str, path: Path, expected: str = "triggers in the sync channel", remedy: str = "") -> CampaignError:
    return CampaignError(found, path, expected, remedy or "Correct waveform in the config.")
