"""Waveform, nodes and scene of a campaign from its files (docs/theory/recordings.md, eqs. 3 to 9)."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config.template import WAVEFORMS
from apertura.check.facts import dem_facts
from apertura.check.times import LOST_CAPTURE, time_facts
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, quoted, shown
from apertura.core.echo.structure import CaptureStructure, capture_structure
from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef, map_from_frame
from apertura.core.scene.auto_grid import GRAZING_LIMIT_DEG, utm_crs
from apertura.formats.phase_histories.fmcw import sweep_of, times_of
from apertura.formats.time_tags import read_time_tags
from apertura.tools.init.draft import SIDE, Draft
from apertura.tools.init.files import Found, FoundRecording, likest

_STRAIGHT = 0.5
"""Smallest distance between the ends of a track, relative to its length, at which a side is defined."""

_SQUINT_DEG = 20.0
"""Largest squint at which echoes from the far edge of the scene are recorded."""

Placed = dict[str, Path]
"""Target in the campaign folder → file."""

# ---- Waveform --------------------------------------------------------------------------------------------------------

_KINDS = {"beat": "fmcw", "history": "phase_history"}
_FILES = {"ofdm": ("codes", "raw/codes.npy"), "samples": ("pulse", "raw/pulse.npy")}


def describe_waveform(draft: Draft, found: Found, kind: str | None) -> Placed:
    """Fill in section `waveform`; return the file of the transmitted signal.

    Raises
    ------
    CampaignError
        If the recordings are of different kinds, or the sample rate of samples without header is not known.
    """
    first = found.recordings[0]
    others = {_KINDS.get(one.kind, "sampled pulses"): one.path.name for one in found.recordings}
    if len(others) > 1:
        problem = " and ".join(f"{kind} ({shown(name)})" for kind, name in others.items())
        raise CampaignError(problem, "init", "recordings of one kind of radar", "Name the files of one radar.")
    if first.kind not in _KINDS:
        return _describe_pulses(draft, found, kind)
    draft.kind = _KINDS[first.kind]
    draft.set("waveform.kind", draft.kind, f"format of {shown(first.path.name)}")
    draft.set("waveform.format", first.format, f"format of {shown(first.path.name)}")
    if first.kind == "beat":
        _describe_sweep(draft, found)
    return {}


def _describe_pulses(draft: Draft, found: Found, kind: str | None) -> Placed:
    recordings = found.recordings
    path, structure = _sent(found)
    if structure is not None:
        kind = "samples" if structure.dft_samples is None else "ofdm"
    draft.kind = kind or "ofdm"
    draft.set("waveform.kind", draft.kind, "assumed" if structure is None else "the signal was found in the recordings")
    headers = [one.content for one in recordings if one.kind == "sigmf"]
    stated = {
        "waveform.sample_rate_hz": [float(header.sample_rate_hz) for header in headers],
        "waveform.carrier_hz": [float(header.frequency_hz) for header in headers if header.frequency_hz],
    }
    meanings = {
        "waveform.sample_rate_hz": ("complex sample rate of the recordings, Hz", "50e6"),
        "waveform.carrier_hz": ("RF frequency of zero baseband frequency, Hz", "1.3e9"),
    }
    for key, values in stated.items():
        if values:
            draft.set(key, values[0], "in the metadata of the recordings")
    rest = {key: meanings[key] for key, values in stated.items() if not values}
    draft.need(rest, "not contained in the recordings; write the value, Hz")
    if "waveform.sample_rate_hz" not in draft.values:
        expected, remedy = "a known sample rate, for the SigMF header", "Add --set waveform.sample_rate_hz=HERTZ."
        raise CampaignError("samples without header", recordings[0].path, expected, remedy)
    _describe_rate(draft, [one for one in recordings if one.is_triggered], "pulses")
    key, target = _FILES[draft.kind]
    if structure is None:
        why = "the recordings do not contain the signal" if path else f"no file of the signal, {target}"
        for name, info in WAVEFORMS[draft.kind].model_fields.items():
            if info.is_required() and f"waveform.{name}" not in {*draft.values, *draft.open}:
                draft.leave(f"waveform.{name}", f"{why}; write the {info.description}")
        return {target: path} if path else {}
    share = f"{structure.compression:.0%} of the energy of a capture at one delay"
    draft.set(f"waveform.{key}", target, f"{shown(str(path and path.name))}: {share}")
    if structure.iq != "complex":
        draft.set("waveform.iq", structure.iq, "the recordings contain the conjugate of the signal")
    _describe_timing(draft, recordings, structure)
    return {target: path} if path else {}


def _sent(found: Found) -> tuple[Path | None, CaptureStructure | None]:
    """Return the file of the transmitted signal, and the structure of the captures; set numbers of channels."""
    signals = {path: signal for path, array in found.arrays.items() if (signal := _signal(array)) is not None}
    triggered = [one for one in found.recordings if one.is_triggered]
    structures = {
        (path, one.path): capture_structure(one.numbers(), one.sent(signal), channels=one.channels or None)
        for path, signal in signals.items()
        for one in triggered
    }
    clear = {pair: structure for pair, structure in structures.items() if structure is not None}
    best = max(clear, key=lambda pair: clear[pair].compression, default=None)
    for one in triggered:
        own = structures.get((best[0], one.path)) if best else None
        one.channels = one.channels or (own.channels if own else 1)
    path = best[0] if best else next(iter(signals)) if len(signals) == 1 else None
    return path, clear[best] if best else None


def _signal(array: NDArray[Any]) -> NDArray[np.complex128] | None:
    """Return code symbols, or the samples of a pulse, as complex numbers; None for other arrays."""
    if array.ndim == 2 and array.shape[1] == 2 and array.dtype.kind == "i":
        return np.asarray(array[:, 0] + 1j * array[:, 1].astype(np.float64))
    is_signal = array.dtype.kind == "c" and array.ndim in {1, 2} and 1 < array.shape[-1] <= 1 << 22
    return np.asarray(array, np.complex128) if is_signal and array.ndim == 1 else array if is_signal else None


def _describe_rate(draft: Draft, recordings: list[FoundRecording], what: str) -> None:
    """Fill in waveform.prf_hz, rounded to the accuracy that the time tags give to the mean over the recording."""
    times = next((one.times for one in recordings if one.times is not None and len(one.times) > 1), None)
    rate_hz = None if times is None else time_facts(times, longer=LOST_CAPTURE).rate_hz
    if rate_hz is None or times is None:
        missing = f"no times of {what}; write the number of {what} per second"
        draft.need({"waveform.prf_hz": (f"number of {what} per second, Hz", "100")}, missing)
        return
    rounded = (float(f"{rate_hz:.{digits}g}") for digits in range(2, 12))
    nearest = next((one for one in rounded if abs(one - rate_hz) < 0.01 * rate_hz / len(times)), rate_hz)
    draft.set("waveform.prf_hz", nearest, f"mean rate of the {what} outside gaps")


def _describe_timing(draft: Draft, recordings: list[FoundRecording], structure: CaptureStructure) -> None:
    """Fill in spacing and durations from the structure of the captures (eqs. 3 and 6)."""
    rate_hz, size = float(draft.values["waveform.sample_rate_hz"]), structure.sent_samples
    length = min(one.numbers().shape[1] // one.channels for one in recordings if one.is_triggered)
    period = structure.dft_samples
    if period is None:
        lead = "time from the start of a capture to the start of the pulse, s"
        draft.need({"waveform.lead_s": (lead, "0")}, f"not observable, 0 is assumed; write the {lead}")
        lead_s = float(draft.values.get("waveform.lead_s", 0.0))
        draft.set("waveform.pulse_s", size / rate_hz, "length of the file of the pulse")
        draft.set("waveform.listen_s", (length - size) / rate_hz - lead_s, "rest of a capture after lead and pulse")
        return
    draft.set("waveform.subcarriers", size, "number of code symbols")
    draft.set("waveform.subcarrier_spacing_hz", rate_hz / period, f"the samples repeat after {period} samples")
    draft.set("waveform.carrier_is", structure.carrier_is, "subcarriers in which the code was found")
    example = f"{(length - period) / rate_hz:.9g}"
    prefix = f"duration of the cyclic prefix, s; {example} if a capture consists of prefix and one period"
    missing = f"not observable, because the symbol is periodic; write the {prefix}"
    if draft.need({"waveform.cyclic_prefix_s": (prefix, example)}, missing):
        symbol_s = length / rate_hz - float(draft.values["waveform.cyclic_prefix_s"])
        draft.set("waveform.symbol_s", symbol_s, "length of a capture without the prefix")
    else:
        draft.leave("waveform.symbol_s", f"length of a capture, {length / rate_hz:.9g} s, minus the cyclic prefix")


def _describe_sweep(draft: Draft, found: Found) -> None:
    first = found.recordings[0]
    if first.format == "beat_wav":
        draft.set("waveform.sample_rate_hz", float(first.content["rate"][0]), "in the header of the recording")
    missing = "beat signals do not contain it; write the value of the radar"
    sweep = {
        "waveform.start_hz": ("first frequency of the sweep, Hz", "2.2e9"),
        "waveform.bandwidth_hz": ("bandwidth, Hz, negative for a falling frequency", "400e6"),
        "waveform.sweep_s": ("duration of the sweep, s", "20e-6"),
    }
    draft.need(sweep, missing)
    if first.format == "beat_wav":
        draft.leave(
            "waveform.start_utc", "not in sound files; write the UTC of the first sample, or run apertura align"
        )
        return
    draft.need({"waveform.sample_rate_hz": ("sample rate of the beat signal, Hz", "25e6")}, missing)
    is_real = first.content.dtype.kind != "c"
    why = "type of the array" + ("" if is_real else "; conjugate if beat frequencies have the opposite sign")
    draft.set("waveform.iq", "real" if is_real else "complex", why)
    for recording in found.recordings:
        if recording.times is None and recording.format == "beat_npy":
            recording.times = _sweep_times(recording, found)
    if any(one.times is None for one in found.recordings):
        _describe_rate(draft, found.recordings, "sweeps")
        draft.leave("waveform.start_utc", "no times of sweeps; write the UTC of the first sweep, or run apertura align")


def _sweep_times(recording: FoundRecording, found: Found) -> Any:
    """Return the only suitable times of sweeps, from time tags or an array; None if there are none."""
    read: dict[Path, Any] = {}
    for path in (*found.tags, *found.arrays):
        with suppress(CampaignError):
            times = read_time_tags(path)[0] if path in found.tags else times_of(np.asarray(found.arrays[path]), path)
            read |= {path: times} if len(times) == len(recording.content) else {}
    fitting = likest(recording.path, read)
    return read[fitting[0]] if len(fitting) == 1 else None


# ---- Nodes -----------------------------------------------------------------------------------------------------------


def describe_nodes(draft: Draft, found: Found) -> None:
    """Fill in section `nodes`: source of the attitude, settings of logs, open keys; CampaignError for other nodes."""
    nodes = list(dict.fromkeys(recording.node for recording in found.recordings))
    stated = [key.split(".")[1] for key in draft.given if key.startswith("nodes.")]
    if other := next((node for node in stated if node not in nodes), None):
        raise CampaignError(f"node {quoted(other)}", "--set", f"one of {', '.join(nodes)}", "Correct the key.")
    for node in nodes:
        own = [recording for recording in found.recordings if recording.node == node]
        logs = {id(one.log): one.log for one in own if one.log is not None}.values()
        facts = [log.facts for log in logs if log.facts is not None]
        has_attitude = bool(facts) and all(one.attitude_share > 0.99 for one in facts)
        why = "the log contains roll, pitch and yaw" if has_attitude else "no attitude in the log"
        draft.set(f"nodes.{node}.attitude", "log" if has_attitude else "none", why)
        for log in logs:
            for key, value in log.options.items():
                draft.set(f"nodes.{node}.log.{key}", value, f"not in {shown(log.path.name)}")
        if any(one.has_positions for one in own):
            continue
        arms = "in no file, zero is assumed; write {radar_tx: [forward, right, down], radar_rx: […], sidelink: […]}, m"
        draft.leave(f"nodes.{node}.lever_arms_m", arms + ("" if has_attitude else "; requires attitude log or course"))
        paths = "in no file, zero is assumed; write {radar: …, sidelink: …}: paths of cables and filters, m"
        draft.leave(f"nodes.{node}.path_offset_m", f"{paths} (apertura bench, apertura align)")
        if not facts or any(one.fixes is None and one.stated_std_m is None for one in facts):
            draft.leave(f"nodes.{node}.position_std_m", "not in the log; write the standard deviation of positions, m")


# ---- Scene -----------------------------------------------------------------------------------------------------------


def describe_scene(draft: Draft, found: Found, side: str | None) -> Placed:
    """Fill in section `scene`; return the DEM."""
    tracks = _tracks(found)
    middle = np.median(tracks[0][1], axis=0) if tracks else None
    is_local = any(frame == "local" for frame, _ in tracks)
    draft.set("scene.crs", LOCAL if is_local else "auto", "frame of the positions" if tracks else "no positions")
    placed: Placed = {}
    if found.dems:
        target = f"raw/{found.dems[0].name}"
        draft.set("scene.dem", target, shown(found.dems[0].name))
        datum = "vertical datum of the DEM: ellipsoid, egm96, egm2008, or carried if its CRS states it"
        draft.need({"scene.dem_datum": (datum, "egm2008")}, f"not stated; write the {datum}")
        placed[target] = found.dems[0]
    else:
        height = "z of the ground in the local frame, m" if is_local else "ground height above the ellipsoid, m"
        flown_m = None if middle is None else middle[2] if is_local else geodetic_from_ecef(middle)[2]
        above = "" if flown_m is None else f" (median of the track: {flown_m:.0f} m)"
        keys = {"scene.height_m": (height + above, "0" if is_local else "620")}
        if side is None and "scene.height_m" not in draft.given:
            keys[SIDE] = ("optionally the side of the track on which the scene lies: left, right or both", "right")
        draft.need(keys, f"in no file; write the {height}")
    draft.open.pop(SIDE, None)
    draft.comments.pop(SIDE, None)
    side = draft.values.pop(SIDE, side) or "both"
    draft.set(
        "scene.bounds_m", "auto", "both sides of the tracks; for one side write [xmin, ymin, xmax, ymax] in crs, m"
    )
    if side == "both" or middle is None:
        return placed
    crs = str(draft.values["scene.crs"])
    crs = utm_crs(middle) if crs == "auto" else crs
    height_m, limit_m = _ellipsoidal_m(draft, found), _path_limit_m(draft)
    bounds_m = None
    if height_m is not None:
        bounds_m = swath([track for _, track in tracks], crs=crs, side=side, height_m=height_m, limit_m=limit_m)
    if bounds_m:
        draft.set("scene.crs", crs, "frame of the positions" if is_local else "UTM zone of the tracks")
        draft.set("scene.bounds_m", bounds_m, f"{side} of the tracks, at grazing angles of 10° to 80°")
    else:
        cause = "the ground height above the ellipsoid is not known" if height_m is None else "the tracks turn"
        draft.set("scene.bounds_m", "auto", f"{cause}: side {side} does not determine the bounds")
    return placed


def _ellipsoidal_m(draft: Draft, found: Found) -> float | None:
    """Return the ground height above the ellipsoid, from the config or the DEM; None if it refers to a geoid."""
    if not found.dems:
        is_ellipsoidal = draft.given.get("scene.height_datum", "ellipsoid") == "ellipsoid"
        return draft.values.get("scene.height_m") if is_ellipsoidal else None
    heights = dem_facts(found.dems[0]).heights if draft.values.get("scene.dem_datum") == "ellipsoid" else None
    return None if heights is None else float(np.nanmedian(heights))


def _tracks(found: Found) -> list[tuple[str, NDArray[np.float64]]]:
    """Return frame and positions of each antenna of the first flight, during the recordings."""
    tracks = []
    for one in (one for one in found.recordings if one.flight == found.recordings[0].flight):
        if one.has_positions:
            tracks.append((str(one.content.attrs["frame"]), one.content.tx_position.values))
        elif one.log is not None:
            time, inside = one.log.track.time.values, np.s_[:]
            if one.span is not None:
                zone = np.timedelta64(round((one.zone_s or 0.0) * 1e9), "ns")
                during = (time >= one.span[0] + zone) & (time <= one.span[1] + zone)
                inside = during if during.sum() > 1 else inside
            tracks.append((str(one.log.track.attrs["frame"]), one.log.track.position.values[inside]))
    return tracks


def _path_limit_m(draft: Draft) -> float:
    """Return the longest total path whose echo a capture contains, m; inf if it is not known."""
    values: dict[str, Any] = {key.removeprefix("waveform."): value for key, value in draft.values.items()}
    delay_s = values.get("cyclic_prefix_s", values.get("listen_s"))
    if delay_s is not None:
        return SPEED_OF_LIGHT_M_S * float(delay_s)
    if draft.kind == "fmcw" and {"start_hz", "sweep_s", "sample_rate_hz"} <= values.keys():
        defaults = {name: info.default for name, info in WAVEFORMS["fmcw"].model_fields.items()}
        return float(sweep_of(defaults | values).path_limit_m)
    return np.inf


def swath(
    tracks: list[NDArray[np.float64]], *, crs: str, side: str, height_m: float, limit_m: float
) -> list[float] | None:
    """Return the bounds of a strip on one side of the tracks (recordings.md, eqs. 8, 9); None if the first track turns.

    Parameters
    ----------
    tracks
        (position, 3) float64 of each node, in ECEF or the local frame.
    crs
        CRS of the bounds, or local.
    side
        left or right, in the direction from the first to the last position.
    height_m
        Ground height, m.
    limit_m
        Longest total path, m; inf if unlimited.

    Examples
    --------
    >>> track = np.stack([np.zeros(9), np.linspace(0, 40, 9), np.full(9, 10.0)], -1)
    >>> swath([track], crs="local", side="right", height_m=0.0, limit_m=100.0)
    [1.0, 0.0, 46.0, 40.0]
    """
    flat = [map_from_frame(crs, track) for track in tracks]
    along = flat[0][-1, :2] - flat[0][0, :2]
    length_m = float(np.linalg.norm(along))
    if length_m <= _STRAIGHT * float(np.linalg.norm(np.diff(flat[0][:, :2], axis=0), axis=1).sum()):
        return None
    places = np.concatenate(flat)
    above_m, grazing_rad = max(float(np.median(places[:, 2])) - height_m, 1.0), np.radians(GRAZING_LIMIT_DEG)
    slant_m = min(limit_m / 2 * np.cos(np.radians(_SQUINT_DEG)), above_m / np.sin(grazing_rad))
    reach_m = float(np.sqrt(max(slant_m**2 - above_m**2, 1.0)))
    near_m = min(above_m * float(np.tan(grazing_rad)), reach_m / 2)
    u = along / length_m
    across = np.array([u[1], -u[0]]) * (1 if side == "right" else -1)
    middle = places[:, :2].mean(axis=0)
    ends = (places[:, :2] - middle) @ u
    corners = [middle + u * end + across * far for end in (ends.min(), ends.max()) for far in (near_m, reach_m)]
    low, high = np.floor(np.min(corners, axis=0)), np.ceil(np.max(corners, axis=0))
    return [float(low[0]), float(low[1]), float(high[0]), float(high[1])]
