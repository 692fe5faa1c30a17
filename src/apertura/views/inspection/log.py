"""A flight log: epochs, fix, gaps, where it was, and what of it images may rest on."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.geodesy import geodetic_from_ecef, ned_axes
from apertura.core.geometry.track_checks import LONG_GAP, check_track
from apertura.formats.names import log_format, log_suffixes
from apertura.formats.reading import read_track
from apertura.formats.tracks.track import FIXES
from apertura.pipeline.opening.node_log import poorer_fix
from apertura.views.inspection.report import Report
from apertura.views.inspection.surroundings import NODE, Surroundings
from apertura.views.inspection.timing import gaps, seconds, timing

if TYPE_CHECKING:
    import xarray as xr

WAVE_M = 0.25
"""Wavelength that errors between epochs are held against: L-band."""

_NAMES = {number: name for name, number in FIXES.items()}


def log_report(path: Path, beside: Surroundings) -> Report:
    """Return what is told of a flight log.

    Raises
    ------
    CampaignError
        If it is none, or leaves open what `LogOptions` must say.
    """
    track = read_track(path, node=beside.node, options=beside.options)
    from apertura.views.inspection.pictures import draw_log

    return Report(
        path,
        "flight log",
        log_format(path, beside.options),
        log_facts(track),
        tuple(_missing(path, track, beside)),
        picture=lambda: draw_log(track, path.name),
    )


def log_facts(track: "xr.Dataset") -> dict[str, Any]:
    """Return the facts of a `track` stage."""
    times, position = track.time.values, track.position.values
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / np.diff(seconds(times))
    attitude = np.isfinite(track.attitude.values).all(axis=1)
    poor = poorer_fix(track.fix.values, "auto") if "fix" in track else np.zeros(len(times), bool)
    checked = check_track(seconds(times), position, poor_fix=poor, tolerated_m=WAVE_M / 16)
    found: dict[str, Any] = {
        "epochs": len(times),
        "left_out": {why: int(count) for why, count in track.attrs["dropped"].items()},
        **timing(times, longer=LONG_GAP),
        "fix": fixes(track),
        "attitude_share": float(attitude.mean()),
        "frame": track.attrs["frame"],
        "bounds": bounds(position, track.attrs["frame"]),
        "length_m": float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()),
        "speed_m_s": {"median_m_s": float(np.median(speed)), "largest_m_s": float(speed.max())},
        "unusable_epochs": int((~checked.kept).sum()),
        "faults": {name: len(where) for name, where in checked.faults.items()},
        "error_between_epochs_m": checked.interpolation_m,
    }
    if "position_std" in track and np.isfinite(track.position_std.values).any():
        found["stated_std_m"] = [float(value) for value in np.nanmedian(track.position_std.values, axis=0)]
    if track.attrs.get("remarks"):
        found["remarks"] = list(track.attrs["remarks"])
    return found


def fixes(track: "xr.Dataset") -> dict[str, int] | None:
    """Return kind of solution → epochs; None where the log says none."""
    if "fix" not in track:
        return None
    kinds, counts = np.unique(track.fix.values, return_counts=True)
    return {
        _NAMES.get(kind, "not stated" if kind == 0 else f"Q {kind}"): count
        for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True)
    }


def bounds(position_m: NDArray[np.float64], frame: str) -> dict[str, list[float]]:
    """Return lowest and highest of each coordinate of (n, 3) positions, geodetic where they are on Earth.

    Examples
    --------
    >>> bounds(np.array([[0.0, 1, 2], [5, 1, 2]]), "local")
    {'east_m': [0.0, 5.0], 'north_m': [1.0, 1.0], 'up_m': [2.0, 2.0]}
    """
    earth = frame == "ecef"
    names = ("latitude_deg", "longitude_deg", "height_m") if earth else ("east_m", "north_m", "up_m")
    values = geodetic_from_ecef(position_m) if earth else position_m
    return {name: [float(one.min()), float(one.max())] for name, one in zip(names, values.T, strict=True)}


def east_north_up(position_m: NDArray[np.float64], frame: str, middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 3) positions as metres to east and north of a place on Earth, and height above the ellipsoid.

    In a frame without a place on Earth they are its axes as they stand.

    Examples
    --------
    >>> east_north_up(np.array([[6378147.0, 30.0, 40.0]]), "ecef", np.array([6378137.0, 0.0, 0.0])).round(3)[:, :2]
    array([[30., 40.]])
    """
    if frame != "ecef":
        return position_m
    north_east = ((position_m - middle) @ ned_axes(middle))[:, :2]
    return np.column_stack([north_east[:, ::-1], geodetic_from_ecef(position_m)[:, 2]])


def _missing(path: Path, track: "xr.Dataset", beside: Surroundings) -> list[str]:
    found = []
    suffixes = log_suffixes()
    if beside.node == NODE:
        suffix = path.suffix[1:].lower()
        found.append(f"its name: copy it to raw/<flight>/{NODE}.track.{suffix if suffix in suffixes else suffixes[0]}")
    found += [f"what --set gives here: put nodes.{NODE}.log.{key} into config/config.yaml" for key in beside.asked]
    if not np.isfinite(track.attitude.values).any():
        found.append(f"attitude: set nodes.{NODE}.attitude to course, or lever arms to zero and antennas to null")
    late = gaps(track.time.values, LONG_GAP)
    if late.size:
        found.append(f"epochs where it has gaps ({late.size}): pulses there may be left out")
    logged = fixes(track) or {}
    if logged and not {"fix", "float"} & logged.keys():
        found.append("a solution with carrier phase (RTK or PPK): positions err by many wavelengths")
    elif logged.get("float") or any(name not in {"fix", "float", "not stated"} for name in logged):
        found.append(f"a fixed solution throughout: pulses at other epochs are left out, see nodes.{NODE}.worst_fix")
    if "fix" not in track and "position_std" not in track:
        found.append(f"how far it errs: the log does not say; state nodes.{NODE}.position_std_m")
    return found
