"""How well an image is focused, measured on itself: bright points, parts of the aperture, and the echo's own place."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags.raised import Flags
from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.aperture import Weigh
from apertura.core.imaging.echo_place import echo_elsewhere
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.parts import PART_PX, part_images
from apertura.core.imaging.view import ground_axes
from apertura.core.quality.bright_points import BrightPoint, bright_points
from apertura.core.quality.focus import Focus, PointFocus, judge, judge_parts, point_focus
from apertura.core.quality.sub_apertures import SubApertures, compare_parts

APART_CELLS = 6.0
"""Bright points stand so many resolution cells apart."""

SPECKLE = 0.06
"""Power about a bright point, against its own, above which it may be speckle: of 10⁶ cells the brightest has 0.07."""

_PATCHES = 4
_PLACES_PER_CELL = 2.5
_CELL_POINTS = 5
_BAND_SAMPLES = 9
_WINDOWED = 0.62  # a Hann window leaves a band as wide, in standard deviation, as this share of it without


def resolution_cell_m(formation: Formation) -> float:
    """Return the finest resolution cell of the image's scene, metres."""
    profiles, grid = formation.profiles, formation.grid
    half = _half_band_hz(profiles)
    pixels = grid.sample_pixels(_CELL_POINTS)
    band = profiles.centre_frequency_hz - half, profiles.centre_frequency_hz + half
    return profiles.aperture.resolution_cell_m(
        formation.positions_at(*pixels), band_hz=band, weigh=_sector_of(formation)
    )


def _sector_of(formation: Formation) -> Weigh | None:
    sector = None if formation.beams is None else formation.beams.sector
    return None if sector is None else sector.over(formation.profiles.aperture)


def _half_band_hz(profiles: Profiles) -> float:
    return SPEED_OF_LIGHT_M_S / (profiles.step_m * profiles.oversampling) / 2


def _spectrum(formation: Formation) -> NDArray[np.float64]:
    """Return the covariance of the spatial spectrum of a point in the scene's middle, east and north."""
    profiles, grid = formation.profiles, formation.grid
    row, column = ((size - 1) / 2 for size in grid.shape)
    here, axes = ground_axes(formation, row, column)
    half = _half_band_hz(profiles)
    band = profiles.centre_frequency_hz + half * np.linspace(-1, 1, _BAND_SAMPLES) * _WINDOWED
    return profiles.aperture.spectrum(here, axes, frequency_hz=band, weigh=_sector_of(formation))


def focus_report(formation: Formation, target: Any) -> dict[str, Any]:
    """Return what image.json says of the focus: verdict, loss, and each bright point.

    Parameters
    ----------
    formation
        What forms the image; it must hold a phase history.
    target
        (y, x) complex64, the image where it was written.

    Notes
    -----
    Source: docs/theory/focus.md.
    """
    cell_m, grid = resolution_cell_m(formation), formation.grid
    apart_px = max(8, int(np.ceil(APART_CELLS * cell_m / grid.spacing_m)))
    points = bright_points(target, formation.windows, apart_px=apart_px)
    terms = formation.contributions([point.row for point in points], [point.column for point in points])
    measured = [
        point_focus(each) if point.background <= SPECKLE else None for point, each in zip(points, terms, strict=True)
    ]
    parts = _parts(formation, points, cell_m)
    verdict = judge([(point.amplitude, focus) for point, focus in zip(points, measured, strict=True)])
    elsewhere = None
    if verdict.points == 0 and formation.history is not None:
        verdict = judge_parts(parts, cell_m=cell_m)
        elsewhere = echo_elsewhere(formation.history, grid, formation.plan.terrain)
    return {
        **_verdict_report(verdict),
        **({"elsewhere": elsewhere} if elsewhere else {}),
        "cell_m": round(cell_m, 4),
        "spectrum_cycles2_m2": [[float(f"{value:.4g}") for value in row] for row in _spectrum(formation)],
        "maxima": len(points),
        "parts": {name: round(value, 4) if np.isfinite(value) else None for name, value in asdict(parts).items()},
        "points": [
            _point_report(formation, point, focus) for point, focus in zip(points, measured, strict=True) if focus
        ],
    }


def focus_flags(report: dict[str, Any], expected_db: float) -> Flags:
    """Return the flags `defocused` where the bright points say so, and `echo_elsewhere`."""
    flags = Flags({"echo_elsewhere": report["elsewhere"]} if "elsewhere" in report else {})
    if report["verdict"] == "defocused":
        flags["defocused"] = (
            f"{report['why']}; {abs(expected_db):.1f} dB are expected of what is stated in the budget: positions, "
            "lever arms, heights or times are worse, or not stated"
        )
    return flags


def _parts(formation: Formation, points: list[BrightPoint], cell_m: float) -> SubApertures:
    """Return what images of parts of the aperture say about the brightest places."""
    spacing_m = cell_m / _PLACES_PER_CELL
    places = [_places(formation, point, spacing_m / formation.grid.spacing_m) for point in points[:_PATCHES]]
    images = part_images(formation.profiles, places, beams=formation.beams)
    return compare_parts(images, spacing_m=spacing_m, generator=np.random.default_rng(0))


def _places(formation: Formation, point: BrightPoint, step_px: float) -> NDArray[np.float64]:
    along = (np.arange(PART_PX) - PART_PX / 2) * step_px
    rows, columns = np.meshgrid(
        np.clip(point.row + along, 0, formation.grid.shape[0] - 1),
        np.clip(point.column + along, 0, formation.grid.shape[1] - 1),
        indexing="ij",
    )
    return formation.positions_at(rows, columns)


def _carrier(formation: Formation, point: BrightPoint) -> list[float]:
    """Return the spatial frequency of a point, east and north, at the middle of aperture and band, cycles per metre."""
    profiles = formation.profiles
    here, axes = ground_axes(formation, max(1.0, point.row), min(point.column, formation.grid.shape[1] - 2.0))
    weigh, some = _sector_of(formation), profiles.aperture.sample(64 if _sector_of(formation) is None else 1024)
    gradient = profiles.aperture[some].path_gradient(here)
    weight = np.ones(len(gradient)) if weigh is None else weigh(some, here[None])[:, 0]
    slope = np.average(gradient, axis=0, weights=weight) @ axes.T
    cycles = slope * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
    return [float(f"{value:.8g}") for value in cycles]


def _verdict_report(verdict: Focus) -> dict[str, Any]:
    measured = {} if verdict.points == 0 else {"loss_db": round(verdict.loss_db, 3), "std_db": round(verdict.std_db, 3)}
    return {"verdict": verdict.verdict, **measured, "why": verdict.why}


def _point_report(formation: Formation, point: BrightPoint, focus: PointFocus) -> dict[str, Any]:
    x, y = map(float, formation.grid.map_at(point.row, point.column))
    return {
        "x_m": round(x, 4),
        "y_m": round(y, 4),
        "amplitude": float(f"{point.amplitude:.6g}"),
        "loss_db": round(focus.loss_db, 3),
        "interference": round(focus.interference, 5),
        "pulses": focus.pulses,
        "snr_db": round(focus.snr_db, 2),
        "background": float(f"{point.background:.4g}"),
        "carrier_cycles_m": _carrier(formation, point),
        "coherence": round(focus.coherence, 5),
        "coherence_allowed": round(focus.coherence_allowed, 5),
    }
