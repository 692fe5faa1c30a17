"""Beat signals that a sound card recorded (.wav): a channel of triggers, one of beats, as of MIT's coffee-can radar."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.echo.dechirp import Sweep
from apertura.formats.phase_histories.fmcw import Sweeps, beginning, joined_sweeps, read_fields, sweep_of

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
        raise _error(f"{len(paths)} files", paths[1], "one .wav file of a node and flight", "Make one file of them.")
    path, found = next(iter(read_fields("apertura.formats.phase_histories.fmcw_fields:read_wav", paths)))
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
        raise _error(f"{rate:g} samples/s", path, f"waveform.sample_rate_hz, {sweep.sample_rate_hz:g}")
    channels = {name: trigger[f"{name}_channel"] for name in ("sync", "beat")}
    if max(channels.values()) > samples.shape[1]:
        raise _error(f"{samples.shape[1]} channels", path, f"waveform.trigger's channels {[*channels.values()]}")
    with np.errstate(invalid="ignore"):  # what is no number stays none, and is refused as such
        sync = samples[:, channels["sync"] - 1].astype(np.float64)
        beat = samples[:, channels["beat"] - 1].astype(np.float32)
    falling = trigger["edge"] == "falling"
    starts = trigger_starts(-sync if falling else sync, threshold=trigger["threshold"])
    first, whole = np.ceil(starts).astype(np.int64), _whole(starts, sweep, len(samples))
    if not whole.any():
        raise _error(f"{len(starts)} triggers, none with a whole sweep of {sweep.whole} samples after it", path)
    if samples.dtype == np.uint8:
        beat -= 128  # of 8 bits that is zero
    rows = np.lib.stride_tricks.sliding_window_view(beat, sweep.whole)[first[whole]]
    time = beginning(described, path) + np.round(starts[whole] * (1e9 / rate)).astype("timedelta64[ns]")
    return Sweeps(path, rows, time, (first - starts)[whole] / rate, {"incomplete": int((~whole).sum())})


def trigger_starts(sync: NDArray[np.float64], *, threshold: float) -> NDArray[np.float64]:
    """Return where a channel rises through the middle of its levels, in samples and fractions.

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


def _whole(starts: NDArray[np.float64], sweep: Sweep, count: int) -> NDArray[np.bool_]:
    """Return which sweeps end before the next trigger and the file do."""
    ends = np.ceil(starts).astype(np.int64) + sweep.whole
    following = np.append(np.ceil(starts[1:]), count)
    return np.asarray(ends <= following)


def _error(found: str, path: Path, expected: str = "triggers in the sync channel", remedy: str = "") -> CampaignError:
    return CampaignError(found, path, expected, remedy or "Correct waveform in the config.")
