"""Focus of an image without ground truth, from bright points, subapertures, and echoes from outside the scene."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.engines.engine import Engine
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.reach import PULSES
from apertura.core.echo.compression import compress, range_step
from apertura.core.geometry.aperture import Aperture, Weigh
from apertura.core.imaging.formation import PULSES_READ, Formation
from apertura.core.imaging.range_profiles import GUARD_SAMPLES, OVERSAMPLING, RangeWindow, range_compress
from apertura.core.imaging.view import ground_axes
from apertura.core.quality.bright_points import SPECKLE, BrightPoint, PointResponse, bright_points
from apertura.core.quality.focus import (
    Focus,
    PointFocus,
    SubApertures,
    band_focus,
    compare_parts,
    judge,
    judge_parts,
    loss_std_db,
    point_focus,
)
from apertura.core.quality.measures import coherence_factor, weighted_median
from apertura.core.quality.path_errors import Effect
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround, Terrain

# ---- Subaperture images of patches

PARTS = 8
"""Number of subapertures (docs/theory/focus.md, "Parts of the aperture")."""

PART_PX = 64
"""Side of a patch, pixels: the size of a `BandLimitedPatch`."""

_MARGIN_SAMPLES = 16  # range samples beyond a patch that are required by engines


def part_images(
    profiles: Profiles, places: Sequence[NDArray[np.float64]], *, beams: Beams | None = None
) -> NDArray[np.complex64]:
    """Form subaperture images of patches of the image; the sum over the subapertures is the image.

    Parameters
    ----------
    profiles
        Profiles of all pulses.
    places
        Patches of (PART_PX, PART_PX, 3) float64 positions, metres, in the frame of the phase centres.
    beams
        Antenna beams (default: isotropic).

    Returns
    -------
    ndarray
        (patch, 2, subaperture, y, x) complex64, formed from the even and from the odd pulses of each subaperture. The
        array contains no patches if there are fewer than four pulses per subaperture.
    """
    images = np.zeros((len(places), 2, PARTS, PART_PX, PART_PX), np.complex64)
    aperture = profiles.aperture
    if len(profiles) < 4 * PARTS:
        return images[:0]
    engine = table_engine()
    for patch, where in enumerate(places):
        illuminating = _illuminating_pulses(beams, aperture, where)
        for number, block in enumerate(aperture[illuminating].blocks(PARTS)):
            for first in range(illuminating.start + block.start, illuminating.start + block.stop, PULSES_READ):
                last = min(first + PULSES_READ, illuminating.start + block.stop)
                read = _around(profiles[first:last], where)
                for odd in range(min(2, last - first)):
                    tables = engine.prepare(read[odd::2])
                    weights = beams and beams[first + odd : last : 2]
                    images[patch, odd, number] += engine.form(tables, where, beams=weights) / len(profiles)
    return np.nan_to_num(images)


def _illuminating_pulses(beams: Beams | None, aperture: Aperture, places: NDArray[np.float64]) -> slice:
    """Return the slice from the first to the last pulse that may illuminate a patch."""
    middle = places[PART_PX // 2, PART_PX // 2]
    radius = np.linalg.norm(places - middle, axis=-1).max()
    blocks = np.flatnonzero(illumination_mask(beams, aperture, middle[None], np.array([radius]), pulses=PULSES)[:, 0])
    return (
        slice(int(blocks[0]) * PULSES, min(int(blocks[-1] + 1) * PULSES, len(aperture))) if blocks.size else slice(0, 0)
    )


def table_engine() -> Engine:
    """Return the first engine that reads profiles and is available on this machine."""
    engines = (load_engine(name) for name in ENGINES)
    return next(engine for engine in engines if engine.READS == "profiles" and engine.available())


def _around(profiles: Profiles, places: NDArray[np.float64]) -> Profiles:
    """Crop profiles to the samples needed by a patch."""
    corners = places[:: PART_PX - 1, :: PART_PX - 1].reshape(-1, 3)
    at = (profiles.aperture.path(corners) - profiles.start_m[:, None]) / profiles.step_m
    reach = (
        2 * np.linalg.norm(places[1, 1] - places[0, 0]) * PART_PX / 2 / profiles.step_m
    )  # the path minimum may lie inside the patch (nadir)
    first = max(0, int(np.nanmin(at) - reach) - _MARGIN_SAMPLES)
    last = min(profiles.samples.shape[1], int(np.nanmax(at)) + _MARGIN_SAMPLES + 1)
    start_m = profiles.start_m + first * profiles.step_m
    return replace(profiles, samples=profiles.samples[:, first:last], start_m=start_m)


# ---- Strongest echoes outside the scene

OUTSIDE_ECHO_DB = 20.0
"""Level relative to the strongest echo of the scene, dB. An echo from outside the scene that exceeds this level is not
a sidelobe: the scene is misplaced."""

UNFOCUSED_ECHO_DB = 25.0
"""Level relative to the median over the ranges of the scene, dB. An echo that exceeds this level is a point target,
which must be focused at some pixel, because speckle reaches only 10 dB."""

LEAST_PULSES = 64
"""Minimum number of pulses to determine whether a point dominates its resolution cell: 2 pulses in each of the 32
blocks of `point_focus`."""

_MOST_PULSES = 64  # pulses sampled in the search for echoes outside the scene
# range cells excluded about the direct path and at the edges of the swath, where sidelobes of point responses occur
_NEAR_CELLS = 4


LEAST_GATHERED = 0.2
"""Minimum ratio of the focused power of the points of an image to the power of the strongest echo in the pulses. Points
in one range cell add up to one echo, of which up to half may be missing in the ratio. An image with a peak loss of 7 dB
has a lower ratio."""

_BY_CHANCE = 2.0  # largest coherence factor of contributions with random phases, in units of ln(pixels)/pulses


def echo_outside_scene(
    inputs: PhaseHistory | Profiles,
    grid: SceneGrid,
    terrain: Terrain,
    *,
    points: Sequence[NDArray[np.complex128]] = (),
    measured: bool = False,
) -> str | None:
    """Return a one-line description of a strong echo that is not focused in the image; None if there is none.

    Parameters
    ----------
    inputs
        Data of all pulses, of which a sample is evaluated. Profiles cropped to the scene contain no echo from outside.
    grid, terrain
        The scene.
    points
        `Formation.contributions` at each bright point of the image, (pulse,) complex128.
    measured
        True if points of the image dominate their range cells. In that case, an echo from outside the scene is reported
        only if these points may be range sidelobes of the echo.

    Notes
    -----
    Source: docs/theory/focus.md, "Echo elsewhere". The direct path between the antennas is excluded.
    """
    sampled = inputs[inputs.aperture.sample(_MOST_PULSES)]
    # Power of the profiles within the total paths of the scene, and beyond these and a margin, without the direct path.
    path_m, power, cell_m, span_m = _profiles(sampled)
    nearest, farthest = swath(grid, terrain, sampled.aperture)
    margin = _NEAR_CELLS * cell_m
    beyond = (path_m - (nearest[:, None] - margin)) % span_m > (farthest - nearest)[:, None] + 2 * margin
    offset_m = path_m - np.linalg.norm(sampled.aperture.tx_m - sampled.aperture.rx_m, axis=1)[:, None]
    if np.isfinite(span_m):
        offset_m = (offset_m + span_m / 2) % span_m - span_m / 2
    power_outside = np.where(beyond & (np.abs(offset_m) > margin), power, 0.0)
    outside = power_outside.max(axis=1)
    within = np.where(beyond, np.nan, power)
    inside = np.nanmax(within, axis=1)
    scene = f"total paths of the scene are {nearest.min():.1f} to {farthest.max():.1f} m"
    # An echo from outside the scene that is stronger than all echoes of the scene and no sidelobe of a focused echo.
    above_db = _median_db(outside / np.maximum(inside, 1e-30))
    alone = min(above_db, _median_db(outside / np.maximum(np.median(power, axis=1), 1e-30))) > OUTSIDE_ECHO_DB
    if alone and measured:
        cells = (
            np.abs(power_outside.argmax(axis=1) - np.nanargmax(within, axis=1)) * (path_m[0, 1] - path_m[0, 0]) / cell_m
        )
        alone = _median_db(inside / outside) < _sidelobe_db(inputs, float(np.median(cells)))
    if alone:
        at_m = float(np.median(path_m[np.arange(len(sampled)), power_outside.argmax(axis=1)]))
        return (
            f"the strongest echo, {above_db:.0f} dB above all echoes of the scene, has a total path of {at_m:.1f} m, "
            f"but {scene}: heights, positions or path offsets are wrong, or a bright target lies outside the scene"
        )
    if measured:
        return None
    # An echo within the ranges of the scene that is too strong for speckle but not focused at any point of the image.
    alone_db = _median_db(inside / np.maximum(np.nanmedian(within, axis=1), 1e-30))
    if len(inputs) < LEAST_PULSES or alone_db <= UNFOCUSED_ECHO_DB:
        return None
    gathered = _gathered(points, pixels=grid.shape[0] * grid.shape[1]) / max(float(np.median(inside)), 1e-30)
    if gathered >= LEAST_GATHERED:
        return None
    share = (
        f"only {100 * gathered:.0f} % of its power is focused at points of the image"
        if gathered
        else "it is not focused at any pixel of the image"
    )
    return (
        f"pulses contain an echo {alone_db:.0f} dB above the median over the ranges of the scene, but {share}: times, "
        "positions or heights are wrong, or the echo originates outside the scene"
    )


_SIDELOBE_MARGIN_DB = 6.0
_LOBE_SAMPLES = 8  # samples of a response per range cell


def _sidelobe_db(inputs: PhaseHistory | Profiles, cells: float) -> float:
    """Return the sidelobe level relative to the peak at a distance in range cells, plus a margin, dB.

    The window of profiles is unknown: the sidelobe level without a window, 1/(π·cells), is used.
    """
    if isinstance(inputs, Profiles):
        return float(20 * np.log10(1 / (np.pi * max(cells, 1.0)))) + _SIDELOBE_MARGIN_DB
    count = len(inputs.weight)
    lobes = np.abs(np.fft.fft(inputs.weight / inputs.weight.sum(), _LOBE_SAMPLES * count))
    first = int((cells % count) * _LOBE_SAMPLES)
    about = np.take(lobes, np.arange(first - _LOBE_SAMPLES, first + _LOBE_SAMPLES), mode="wrap")
    return float(20 * np.log10(max(about.max(), 1e-15))) + _SIDELOBE_MARGIN_DB


def _gathered(points: Sequence[NDArray[np.complex128]], *, pixels: int) -> float:
    """Return the summed power of points with a coherence above the largest one expected for random phases."""
    return sum(
        abs(complex(terms.mean())) ** 2
        for terms in points
        if terms.size and coherence_factor(terms) > _BY_CHANCE * np.log(pixels) / terms.size
    )


def _median_db(ratio: NDArray[np.float64]) -> float:
    return decibels(float(np.median(ratio)))


def _profiles(
    inputs: PhaseHistory | Profiles,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Return total paths and powers (pulse, range), the range cell, and the ambiguity interval of the path, metres."""
    if isinstance(inputs, Profiles):
        samples = np.asarray(inputs.samples)
        path_m = inputs.start_m[:, None] + inputs.step_m * np.arange(samples.shape[1])
        return path_m, np.abs(samples).astype(np.float64) ** 2, inputs.step_m * inputs.oversampling, np.inf
    speed = inputs.wave_speed_m_s
    step_m, length = range_step(inputs.frequency_hz, oversampling=1.0, wave_speed_m_s=speed)
    samples = compress(
        inputs.transfer,
        inputs.frequency_hz,
        weight=inputs.weight,
        reference_delay_s=inputs.reference_delay_s,
        start_m=np.zeros(len(inputs)),
        count=length,
        oversampling=1.0,
        wave_speed_m_s=speed,
    )
    path_m = np.broadcast_to(step_m * np.arange(length), samples.shape)
    return path_m, np.abs(samples).astype(np.float64) ** 2, step_m, step_m * length


# ---- Joint focus of several pairs, to compare hypotheses

_EVERY = 8  # number of points along a side of a patch, from which bounds of the total paths are computed


def joint_peak_power(histories: Sequence[PhaseHistory], grid: SceneGrid, height_m: float) -> float:
    """Return the peak power of the joint image of several pairs relative to that of perfectly focused echoes.

    Parameters
    ----------
    histories
        Phase histories of pairs that image the same scene.
    grid
        Grid to image, on level ground.
    height_m
        Height of the ground above the ellipsoid (z in a local frame).

    Returns
    -------
    float
        Value from 0 to 1: mean of the incoherent and the coherent sum over pairs, relative to an echo that contains all
        the energy of the pulses. Two hypotheses about the same recording are compared by the ratio of these values.

    Raises
    ------
    ValueError
        If the grid is deeper than the unambiguous range.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> frequency = 1.2e9 + 1e6 * np.arange(128)
    >>> track = np.stack([np.linspace(-4, 4, 64), np.full(64, -20.0), np.full(64, 10.0)], -1)
    >>> aperture = Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(64), aperture)
    >>> joint_peak_power([history], SceneGrid("local", -3.2, 3.2, 0.1, (64, 64)), 0.0) > 0.9
    True
    """
    engine, ground = table_engine(), FlatGround(height_m)
    places = ground.positions(grid)
    power, total = np.zeros(grid.shape), np.zeros(grid.shape, np.complex128)
    for history in histories:
        tables = engine.prepare(range_compress(history, grid, ground, window=_window(history, places)))
        image = np.nan_to_num(engine.form(tables, places)) / (len(history) * np.sqrt(_echo_power(history)))
        power += np.abs(image) ** 2
        total += image
    return float((power / len(histories) + np.abs(total / len(histories)) ** 2).max() / 2)


def strongest_echo(history: PhaseHistory, grid: SceneGrid, height_m: float) -> float:
    """Return the mean amplitude of the strongest echo of a grid, relative to the root of the pulse energy.

    This value is an upper bound for the brightest pixel of an image focused with any geometry. Parameters as for
    `joint_peak_power`.
    """
    window = _window(history, FlatGround(height_m).positions(grid))
    profiles = range_compress(history, grid, FlatGround(height_m), window=window)
    return float(np.abs(profiles.samples).max(axis=1).mean() / np.sqrt(_echo_power(history)))


def _window(history: PhaseHistory, places: NDArray[np.float64]) -> RangeWindow:
    """Return a window of total paths that covers a small patch, from a sample of its points."""
    every = max(1, min(places.shape[:2]) // _EVERY)
    sampled = places[::every, ::every]
    paths = history.aperture.path(sampled).reshape(len(history), -1)
    between = 2 * float(np.linalg.norm(sampled[1, 1] - sampled[0, 0]))  # the path gradient is at most 2 m per metre
    speed = history.wave_speed_m_s
    step, length = range_step(history.frequency_hz, oversampling=OVERSAMPLING, wave_speed_m_s=speed)
    first = paths.min(axis=1) - between - GUARD_SAMPLES * step
    samples = int(np.ceil((np.ptp(paths, axis=1).max() + 2 * between) / step)) + 2 * GUARD_SAMPLES + 1
    return RangeWindow(first, samples, step, length, paths.max(axis=1), speed)


def _echo_power(history: PhaseHistory) -> float:
    """Return the power in a range profile of an echo that contains all energy of a pulse, mean over the pulses."""
    power: NDArray[np.float64] = (np.abs(history.transfer) ** 2).astype(np.float64) @ history.weight
    return float(power.mean()) * float(history.weight.sum())


# ---- Focus report of an image

# side of the squares in which the brightest maximum is evaluated, resolution cells; and minimum side, pixels
_SQUARE_CELLS, _LEAST_PX = 2.0, 4
_PATCHES = 4  # number of patches imaged by subapertures, at the brightest points
_PATCHES_APART = PART_PX / 2  # minimum distance of two patches, in patch pixels, for independent measurements
_PLACES_PER_CELL = 2.5  # pixels of a patch per resolution cell, along a side
_CELL_POINTS = 5  # points along a side of the scene at which the resolution cell is computed
_BAND_SAMPLES = 9  # frequency samples of the spatial spectrum
_UNEXPECTED_SIGMAS = 3.0  # standard deviations by which a loss must exceed the expected loss to raise a flag
_RESPONSE_OVERSAMPLING = 8.0  # oversampling of the response of a pulse, which is interpolated linearly between samples
_WINDOWED = 0.62  # standard deviation of a Hann-windowed band relative to that of the unwindowed band


def resolution_cell_m(formation: Formation) -> float:
    """Return the finest resolution cell of the image over the scene, metres."""
    profiles, grid = formation.profiles, formation.grid
    half = profiles.bandwidth_hz / 2
    pixels = grid.sample_pixels(_CELL_POINTS)
    band = profiles.centre_frequency_hz - half, profiles.centre_frequency_hz + half
    return profiles.aperture.resolution_cell_m(
        formation.positions_at(*pixels), band_hz=band, weigh=_coverage_of(formation)
    )


def _coverage_of(formation: Formation) -> Weigh | None:
    return None if formation.beams is None else formation.beams.coverage(formation.profiles.aperture)


def _response(formation: Formation) -> PointResponse:
    """Return the point response of the image, from which the sidelobes of a point at other points are computed."""
    history, profiles = formation.history, formation.profiles
    if history is None:  # assume a full and flat band, like the planner
        count = 2 * profiles.samples.shape[1]
        frequency_hz = profiles.centre_frequency_hz + profiles.bandwidth_hz * (np.arange(count) / count - 0.5)
        weight = np.full(count, 1 / count)
    else:
        frequency_hz, weight = history.frequency_hz, history.weight / history.weight.sum()
    sampling = {"oversampling": _RESPONSE_OVERSAMPLING, "wave_speed_m_s": profiles.wave_speed_m_s}
    step_m, length = range_step(frequency_hz, **sampling)
    envelope = compress(
        np.ones((1, len(frequency_hz)), np.complex64),
        frequency_hz,
        weight=weight,
        reference_delay_s=np.zeros(1),
        start_m=np.array([-step_m * (length // 2)]),
        count=length,
        **sampling,
    )[0]
    wavelength_m, aperture, beams = profiles.wavelength_m, profiles.aperture, formation.beams
    weigh = None if beams is None else lambda pulses, points_m: beams[pulses].weight(aperture[pulses], points_m)
    return PointResponse(aperture, envelope, step_m, wavelength_m, weigh)


def _shown(
    formation: Formation, response: PointResponse, pixel: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the response at other pixels of a point at a given pixel."""
    return response.at(formation.positions_at(*pixel), formation.positions_at(*others.T))


_NARROWEST = 1e-7
"""Least variance of the spatial spectrum in any direction, relative to the trace; above the rounding of image.json."""


def _spectrum(formation: Formation) -> NDArray[np.float64]:
    """Return the covariance of the spatial spectrum of a point at the scene centre, east and north.

    It is positive definite even without an aperture.
    """
    profiles, grid = formation.profiles, formation.grid
    row, column = ((size - 1) / 2 for size in grid.shape)
    middle_m, axes = ground_axes(formation, row, column)
    half = profiles.bandwidth_hz / 2
    band = profiles.centre_frequency_hz + half * np.linspace(-1, 1, _BAND_SAMPLES) * _WINDOWED
    spectrum = profiles.aperture.spectrum(middle_m, axes, frequency_hz=band, weigh=_coverage_of(formation))
    return np.asarray(spectrum + _NARROWEST * np.trace(spectrum) * np.eye(2))


def focus_report(formation: Formation, target: Any) -> dict[str, Any]:
    """Measure focus for section `focus` of image.json: verdict, loss, and each bright point.

    Parameters
    ----------
    formation
        Formation of the image.
    target
        (y, x) complex64, the stored image.

    Notes
    -----
    Source: docs/theory/focus.md.
    """
    cell_m, grid = resolution_cell_m(formation), formation.grid
    cell_px = max(_LEAST_PX, round(_SQUARE_CELLS * cell_m / grid.spacing_m))
    points = bright_points(
        target, formation.windows, cell_px=cell_px, shown=partial(_shown, formation, _response(formation))
    )
    terms = formation.contributions([point.row for point in points], [point.column for point in points])
    measured = [
        point_focus(each) if point.background <= SPECKLE else None for point, each in zip(points, terms, strict=True)
    ]
    parts = _parts(formation, points, cell_m)
    verdict = judge([(point.amplitude, focus) for point, focus in zip(points, measured, strict=True)])
    inputs, has_points = formation.history or formation.profiles, verdict.points > 0
    elsewhere = echo_outside_scene(inputs, grid, formation.plan.terrain, points=terms, measured=has_points)
    if elsewhere:
        measured = [None] * len(points)  # the points may be sidelobes of an echo outside the scene
    if elsewhere or not has_points:
        verdict = judge_parts(parts, cell_m=cell_m)
    peak = max((point.amplitude for point in points), default=0.0)
    conjugated = elsewhere or verdict.loss_db < _CONJUGATED_LOSS_DB
    return {
        "verdict": verdict.verdict,
        **({"loss_db": round(verdict.loss_db, 3), "std_db": round(verdict.std_db, 3)} if verdict.points else {}),
        "reason": verdict.reason,
        **({"uneven": line} if (line := _uneven(grid, points, measured, verdict)) else {}),
        **({"elsewhere": elsewhere} if elsewhere else {}),
        **({"conjugated": line} if conjugated and (line := _conjugated(formation, peak)) else {}),
        "cell_m": round(cell_m, 4),
        "spectrum_cycles2_m2": [[float(f"{value:.9g}") for value in row] for row in _spectrum(formation)],
        **_range_report(formation, points),
        "maxima": len(points),
        "parts": {name: round(value, 4) if np.isfinite(value) else None for name, value in asdict(parts).items()},
        "points": [
            _point_report(formation, point, focus) for point, focus in zip(points, measured, strict=True) if focus
        ],
    }


_UNEVEN_DB, _UNEVEN_SIGMAS = -1.0, 5.0  # limits of eq. 1″


def _uneven(
    grid: SceneGrid, points: Sequence[BrightPoint], measured: Sequence[PointFocus | None], verdict: Focus
) -> str | None:
    """Return one line on points that lose more than the others; None if there are none, or all are defocused.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1″.
    """
    pairs = [(point, focus) for point, focus in zip(points, measured, strict=True) if focus is not None]
    worse = [
        (focus.loss_db, point)
        for point, focus in pairs
        if focus.loss_db - verdict.loss_db < _UNEVEN_DB - _UNEVEN_SIGMAS * loss_std_db(focus)
    ]
    if verdict.verdict == "defocused" or not worse:
        return None
    loss_db, point = min(worse, key=lambda one: one[0])
    x_m, y_m = (float(coordinate) for coordinate in grid.map_at(point.row, point.column))
    return (
        f"{len(worse)} of {len(pairs)} bright points lose at least {-max(loss for loss, _ in worse):.1f} dB, median "
        f"{abs(verdict.loss_db):.1f} dB; most at ({x_m:.1f}, {y_m:.1f}): {-loss_db:.1f} dB"
    )


_BAND_POINTS = 4  # number of points whose spectra are evaluated, the brightest


def _range_report(formation: Formation, points: Sequence[BrightPoint]) -> dict[str, Any]:
    """Measure the focus of the brightest points in range; {} if less than half of them dominate their surroundings."""
    history, points = formation.history, points[:_BAND_POINTS]
    if history is None or not points:
        return {}
    spectra = formation.spectra([point.row for point in points], [point.column for point in points])
    found = [band_focus(spectrum, history.weight) for spectrum in spectra]
    measured = [(point.amplitude, focus) for point, focus in zip(points, found, strict=True) if focus is not None]
    if 2 * len(measured) < len(points):
        return {}
    verdict = judge(measured)
    phase_rad = weighted_median(
        np.array([focus.phase_rad for _, focus in measured]), np.array([amplitude for amplitude, _ in measured])
    )
    numbers = {"loss_db": verdict.loss_db, "std_db": verdict.std_db, "phase_rad": phase_rad}
    rounded = {name: round(value, 3) for name, value in numbers.items()}
    return {"range": {"verdict": verdict.verdict, **rounded, "points": verdict.points}}


_CONJUGATED_LOSS_DB = -6.0  # loss beyond which the samples of a defocused image are tested for conjugation
_CONJUGATED_DB = 10.0  # minimum increase of the peak by conjugation, dB; a track error does not cause such an increase
_CONJUGATED_S = 60.0  # longest predicted run time (s) of an image to which this test is applied


def _conjugated(formation: Formation, peak: float) -> str | None:
    """Detect conjugated samples: return one line if the image of their conjugates has a much brighter peak, else None.

    Notes
    -----
    Source: docs/theory/focus.md, "Conjugated samples".
    """
    if formation.plan.predicted_seconds > _CONJUGATED_S:
        return None
    history, profiles = formation.history, formation.profiles
    if history is None:
        other = replace(profiles, samples=np.conj(np.asarray(profiles.samples)))
    else:
        history = replace(history, transfer=np.conj(np.asarray(history.transfer)))
        other = range_compress(history, formation.grid, formation.plan.terrain)
    image = replace(formation, history=history, profiles=other).image
    brightest = float(np.abs(image).max().compute(scheduler="synchronous"))
    gained_db = 20 * float(np.log10(max(brightest, 1e-30) / max(peak, 1e-30)))
    if gained_db < _CONJUGATED_DB:
        return None
    return (
        f"with conjugated samples, the brightest pixel is {min(gained_db, 99):.0f} dB brighter: I and Q are swapped, "
        "or the opposite phase convention applies; change waveform.iq from complex to conjugate or vice versa, or the "
        "sign of waveform.bandwidth_hz for real beat signals; in Python, conjugate the samples"
    )


UNEXPECTED_DB = 0.2
"""Minimum loss in excess of the expected loss that raises a flag, dB: accuracy of the loss measured with a number of
points."""


def focus_flags(report: dict[str, Any], expected: Effect) -> Flags:
    """Evaluate the flags `defocused`, `loss_unexpected`, `focus_uneven`, `range_defocused` and `echo_outside_scene`.

    Parameters
    ----------
    report
        Result of `focus_report`.
    expected
        Expected effect of all error sources in the error budget.

    Notes
    -----
    Source: docs/theory/focus.md, "Focus of a point". The standard deviation of the measured loss is estimated from the
    points. The standard deviation of the expected loss describes the variation between flights.
    """
    flags = Flags({"echo_outside_scene": report["elsewhere"]} if "elsewhere" in report else {})
    if "uneven" in report:
        flags["focus_uneven"] = report["uneven"]
    budget = f"{abs(expected.loss_db):.1f} ± {expected.loss_std_db:.1f} dB expected from the error budget"
    if report["verdict"] == "defocused":
        flags["defocused"] = (
            f"{report['reason']}; {budget}: positions, lever arms, heights or times are less accurate than configured, "
            "or the accuracy of one of these is not configured"
        )
    elif "loss_db" in report:
        beyond_db = expected.loss_db - report["loss_db"]
        if beyond_db > max(UNEXPECTED_DB, _UNEXPECTED_SIGMAS * float(np.hypot(report["std_db"], expected.loss_std_db))):
            flags["loss_unexpected"] = (
                f"{report['reason']}; {budget}: an error source exceeds the value in the error budget"
            )
    in_range = report.get("range", {})
    if in_range.get("verdict") == "defocused" and report["verdict"] != "defocused":
        flags["range_defocused"] = (
            f"peak loss {abs(in_range['loss_db']):.1f} ± {in_range['std_db']:.1f} dB from phase errors over frequency, "
            f"{number_of(in_range['points'], 'bright point')}; quadratic phase {in_range['phase_rad']:+.1f} rad at the "
            "edges of the band: the transmitted waveform differs from the configured one, or the radar is dispersive"
        )
    if "conjugated" in report:
        return Flags({name: f"{line}; {report['conjugated']}" for name, line in flags.items()})
    return flags


def _parts(formation: Formation, points: list[BrightPoint], cell_m: float) -> SubApertures:
    """Return the subaperture measures of the brightest points."""
    spacing_m = cell_m / _PLACES_PER_CELL
    step_px, centres = spacing_m / formation.grid.spacing_m, list[BrightPoint]()
    for point in points:
        offsets_px = [np.hypot(point.row - other.row, point.column - other.column) for other in centres]
        near = any(offset_px < _PATCHES_APART * step_px for offset_px in offsets_px)
        if not near and len(centres) < _PATCHES:
            centres.append(point)
    places = [_places(formation, point, step_px) for point in centres]
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
        "coherence": round(focus.coherence, 5),
        "coherence_noise_limit": round(focus.coherence_noise_limit, 5),
    }
