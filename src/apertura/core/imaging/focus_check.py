"""Focus of an image measured on itself: bright points, subapertures, noise, and echoes from elsewhere."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from apertura.core.quality.focus import PointFocus, SubApertures, compare_parts, judge, judge_parts, point_focus
from apertura.core.quality.measures import coherence_factor
from apertura.core.quality.path_errors import Effect
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround, Terrain

# ---- Subaperture images of a few places

PARTS = 8
"""Subapertures (docs/theory/focus.md, "Parts of the aperture")."""

PART_PX = 64
"""Places along a side of a patch: the size of a `BandLimitedPatch`."""

_MARGIN_SAMPLES = 16  # that engines need beyond the places


def part_images(
    profiles: Profiles, places: Sequence[NDArray[np.float64]], *, beams: Beams | None = None
) -> NDArray[np.complex64]:
    """Return patches of the image by subapertures; their sum over subapertures is the image.

    Parameters
    ----------
    profiles
        Of every pulse.
    places
        Patches of (PART_PX, PART_PX, 3) float64 positions, metres, in the frame of the phase centres.
    beams
        Of the antennas; isotropic by default.

    Returns
    -------
    ndarray
        (patch, 2, part, y, x) complex64: by even and by odd pulses of each part. Zero with fewer than four
        pulses a part.
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
    """Return the first to the last pulse that may illuminate a patch."""
    middle = places[PART_PX // 2, PART_PX // 2]
    radius = np.linalg.norm(places - middle, axis=-1).max()
    blocks = np.flatnonzero(illumination_mask(beams, aperture, middle[None], np.array([radius]), pulses=PULSES)[:, 0])
    return (
        slice(int(blocks[0]) * PULSES, min(int(blocks[-1] + 1) * PULSES, len(aperture))) if blocks.size else slice(0, 0)
    )


def table_engine() -> Engine:
    """Return the first engine that reads profiles and runs here."""
    engines = (load_engine(name) for name in ENGINES)
    return next(engine for engine in engines if engine.READS == "profiles" and engine.available())


def _around(profiles: Profiles, places: NDArray[np.float64]) -> Profiles:
    """Return the profiles cropped to the samples that a patch needs."""
    corners = places[:: PART_PX - 1, :: PART_PX - 1].reshape(-1, 3)
    at = (profiles.aperture.path(corners) - profiles.start_m[:, None]) / profiles.step_m
    reach = 2 * np.linalg.norm(places[1, 1] - places[0, 0]) * PART_PX / 2 / profiles.step_m  # nadir inside the patch
    first = max(0, int(np.nanmin(at) - reach) - _MARGIN_SAMPLES)
    last = min(profiles.samples.shape[1], int(np.nanmax(at)) + _MARGIN_SAMPLES + 1)
    start_m = profiles.start_m + first * profiles.step_m
    return replace(profiles, samples=profiles.samples[:, first:last], start_m=start_m)


# ---- Strongest echoes outside the scene

OUTSIDE_ECHO_DB = 20.0
"""dB above the strongest echo from the scene: an echo outside this strong means a misplaced scene, no sidelobe."""

UNFOCUSED_ECHO_DB = 25.0
"""dB above the median of the scene's ranges: such an echo is a point's and must focus at some place; speckle has 10."""

LEAST_PULSES = 64
"""Pulses: fewer cannot show whether a point dominates its cell (2 in each of the 32 blocks of `point_focus`)."""

_MOST_PULSES = 64  # sampled to search echoes outside the scene
_NEAR_CELLS = 4  # about the direct path and at the swath's edges, where responses have their sidelobes


LEAST_GATHERED = 0.2
"""Power of an image's points over that of the strongest echo in its pulses: where points share a range cell they add
up to a pulse's echo and half of it may miss the count; an image 7 dB out of focus has less."""

_BY_CHANCE = 2.0  # times ln(pixels)/pulses, the largest coherence factor of contributions with random phases


def echo_outside_scene(
    inputs: PhaseHistory | Profiles,
    grid: SceneGrid,
    terrain: Terrain,
    *,
    points: Sequence[NDArray[np.complex128]] = (),
    measured: bool = False,
) -> str | None:
    """Return one line where pulses contain a strong echo that an image does not focus, else None.

    Parameters
    ----------
    inputs
        Of every pulse; a sample of them is evaluated. Profiles that are cropped to the scene show nothing beyond it.
    grid, terrain
        The scene.
    points
        `Formation.contributions` at each bright point of the image, (pulse,) complex128.
    measured
        Whether points of the image dominate their range cells: it is then wrong only where these are sidelobes, in
        range, of the strongest echo outside.

    Notes
    -----
    Source: docs/theory/focus.md, "Echo elsewhere". The direct path between the antennas does not count.
    """
    some = inputs[inputs.aperture.sample(_MOST_PULSES)]
    # Power of the profiles beyond the scene's paths and a margin, the direct path left out, and inside.
    path_m, power, cell_m, span_m = _profiles(some)
    nearest, farthest = swath(grid, terrain, some.aperture)
    margin = _NEAR_CELLS * cell_m
    beyond = (path_m - (nearest[:, None] - margin)) % span_m > (farthest - nearest)[:, None] + 2 * margin
    offset_m = path_m - np.linalg.norm(some.aperture.tx_m - some.aperture.rx_m, axis=1)[:, None]
    if np.isfinite(span_m):
        offset_m = (offset_m + span_m / 2) % span_m - span_m / 2
    beside = np.where(beyond & (np.abs(offset_m) > margin), power, 0.0)
    outside = beside.max(axis=1)
    within = np.where(beyond, np.nan, power)
    inside = np.nanmax(within, axis=1)
    scene = f"the scene's are {nearest.min():.1f} to {farthest.max():.1f} m"
    # An echo outside stronger than all inside, and no sidelobe of one that the image focuses.
    above_db = _median_db(outside / np.maximum(inside, 1e-30))
    alone = min(above_db, _median_db(outside / np.maximum(np.median(power, axis=1), 1e-30))) > OUTSIDE_ECHO_DB
    if alone and measured:
        cells = np.abs(beside.argmax(axis=1) - np.nanargmax(within, axis=1)) * (path_m[0, 1] - path_m[0, 0]) / cell_m
        alone = _median_db(inside / outside) < _sidelobe_db(inputs, float(np.median(cells)))
    if alone:
        at_m = float(np.median(path_m[np.arange(len(some)), beside.argmax(axis=1)]))
        return (
            f"the strongest echo, {above_db:.0f} dB above all from the scene, has a total path of {at_m:.1f} m, while "
            f"{scene}: heights, positions or path offsets are wrong, or something bright is elsewhere"
        )
    if measured:
        return None
    # An echo inside, too strong to be speckle, that no point of the image focuses.
    alone_db = _median_db(inside / np.maximum(np.nanmedian(within, axis=1), 1e-30))
    if len(inputs) < LEAST_PULSES or alone_db <= UNFOCUSED_ECHO_DB:
        return None
    gathered = _gathered(points, pixels=grid.shape[0] * grid.shape[1]) / max(float(np.median(inside)), 1e-30)
    if gathered >= LEAST_GATHERED:
        return None
    found = (
        f"the image's points gather {100 * gathered:.0f} % of it" if gathered else "no place of the image gathers it"
    )
    return (
        f"pulses hold an echo {alone_db:.0f} dB above the median of the scene's ranges, and {found}: times, positions "
        "or heights are wrong, or it comes from beside the scene"
    )


_SIDELOBE_MARGIN_DB = 6.0
_LOBE_SAMPLES = 8  # of a response, per range cell


def _sidelobe_db(inputs: PhaseHistory | Profiles, cells: float) -> float:
    """Return the level of sidelobes, and a margin, against their echo so many range cells away; dB.

    Of profiles, whose window is not known, those without one: 1/(π·cells).
    """
    if isinstance(inputs, Profiles):
        return float(20 * np.log10(1 / (np.pi * max(cells, 1.0)))) + _SIDELOBE_MARGIN_DB
    count = len(inputs.weight)
    lobes = np.abs(np.fft.fft(inputs.weight / inputs.weight.sum(), _LOBE_SAMPLES * count))
    first = int((cells % count) * _LOBE_SAMPLES)
    about = np.take(lobes, np.arange(first - _LOBE_SAMPLES, first + _LOBE_SAMPLES), mode="wrap")
    return float(20 * np.log10(max(about.max(), 1e-15))) + _SIDELOBE_MARGIN_DB


def _gathered(points: Sequence[NDArray[np.complex128]], *, pixels: int) -> float:
    """Return the power of the points at which contributions add up more than by chance at the best of all pixels."""
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
    """Return total paths and powers (pulse, range), a range cell, and the path after which they repeat."""
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

_EVERY = 8  # points along a side that bound the paths of a piece of ground


def joint_peak_power(histories: Sequence[PhaseHistory], grid: SceneGrid, height_m: float) -> float:
    """Return the peak power of the joint image of several pairs, relative to that of perfectly focused echoes.

    Parameters
    ----------
    histories
        Of pairs that image one scene.
    grid
        Places to image; level ground.
    height_m
        Of the ground above the ellipsoid (z in a local frame).

    Returns
    -------
    float
        0 to 1: mean of the non-coherent and of the coherent sum over pairs, relative to an echo with all the energy of
        its pulses; two hypotheses about one recording compare by its ratio.

    Raises
    ------
    ValueError
        If the places are deeper than the unambiguous range.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> frequency = 1.2e9 + 1e6 * np.arange(128)
    >>> track = np.stack([np.linspace(-4, 4, 64), np.full(64, -20.0), np.full(64, 10.0)], -1)
    >>> flown = Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * flown.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(64), flown)
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
    """Return the amplitude of the strongest echo from some places, mean over the pulses, relative to all their energy.

    What a focused image has at most at its brightest place, whatever its geometry; parameters as `joint_peak_power`.
    """
    window = _window(history, FlatGround(height_m).positions(grid))
    profiles = range_compress(history, grid, FlatGround(height_m), window=window)
    return float(np.abs(profiles.samples).max(axis=1).mean() / np.sqrt(_echo_power(history)))


def _window(history: PhaseHistory, places: NDArray[np.float64]) -> RangeWindow:
    """Return a window of total paths that covers a small piece of ground, from some of its points."""
    every = max(1, min(places.shape[:2]) // _EVERY)
    some = places[::every, ::every]
    paths = history.aperture.path(some).reshape(len(history), -1)
    between = 2 * float(np.linalg.norm(some[1, 1] - some[0, 0]))  # a path grows by two metres per metre at most
    speed = history.wave_speed_m_s
    step, length = range_step(history.frequency_hz, oversampling=OVERSAMPLING, wave_speed_m_s=speed)
    first = paths.min(axis=1) - between - GUARD_SAMPLES * step
    samples = int(np.ceil((np.ptp(paths, axis=1).max() + 2 * between) / step)) + 2 * GUARD_SAMPLES + 1
    return RangeWindow(first, samples, step, length, paths.max(axis=1), speed)


def _echo_power(history: PhaseHistory) -> float:
    """Return the profile's power of an echo with all the energy of a pulse, mean over the pulses."""
    power: NDArray[np.float64] = (np.abs(history.transfer) ** 2).astype(np.float64) @ history.weight
    return float(power.mean()) * float(history.weight.sum())


# ---- Focus report of an image

_SQUARE_CELLS, _LEAST_PX = 2.0, 4  # side of the squares of which the brightest maximum is looked at
_PATCHES = 4  # imaged by subapertures: the brightest places
_PATCHES_APART = PART_PX / 2  # places between two at least: what both show twice is no second measurement
_PLACES_PER_CELL = 2.5  # of a patch along a side
_CELL_POINTS = 5  # along a side of the scene, at which the resolution cell is computed
_BAND_SAMPLES = 9  # frequencies of the spatial spectrum
_UNEXPECTED_SIGMAS = 3.0  # by which a loss must exceed the expected one to be flagged
_RESPONSE_OVERSAMPLING = 8.0  # of the response of a pulse: between samples it is taken as linear
_WINDOWED = 0.62  # a Hann window leaves a band as wide, in standard deviation, as this share of it without


def resolution_cell_m(formation: Formation) -> float:
    """Return the finest resolution cell of the image's scene, metres."""
    profiles, grid = formation.profiles, formation.grid
    half = profiles.bandwidth_hz / 2
    pixels = grid.sample_pixels(_CELL_POINTS)
    band = profiles.centre_frequency_hz - half, profiles.centre_frequency_hz + half
    return profiles.aperture.resolution_cell_m(
        formation.positions_at(*pixels), band_hz=band, weigh=_sector_of(formation)
    )


def _sector_of(formation: Formation) -> Weigh | None:
    sector = None if formation.beams is None else formation.beams.sector
    return None if sector is None else sector.over(formation.profiles.aperture)


def _response(formation: Formation) -> PointResponse:
    """Return what of one point the image shows at other places."""
    history, profiles = formation.history, formation.profiles
    if history is None:  # a full and flat band, as the planner takes it
        count = 2 * profiles.samples.shape[1]
        frequency_hz = profiles.centre_frequency_hz + profiles.bandwidth_hz * (np.arange(count) / count - 0.5)
        weight = np.full(count, 1 / count)
    else:
        frequency_hz, weight = history.frequency_hz, history.weight / history.weight.sum()
    how = {"oversampling": _RESPONSE_OVERSAMPLING, "wave_speed_m_s": profiles.wave_speed_m_s}
    step_m, length = range_step(frequency_hz, **how)
    envelope = compress(
        np.ones((1, len(frequency_hz)), np.complex64),
        frequency_hz,
        weight=weight,
        reference_delay_s=np.zeros(1),
        start_m=np.array([-step_m * (length // 2)]),
        count=length,
        **how,
    )[0]
    wavelength_m, aperture, beams = profiles.wavelength_m, profiles.aperture, formation.beams
    weigh = None if beams is None else lambda some, points_m: beams[some].weight(aperture[some], points_m)
    return PointResponse(aperture, envelope, step_m, wavelength_m, weigh)


def _shown(
    formation: Formation, response: PointResponse, pixel: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return what a point at a pixel shows at others."""
    return response.at(formation.positions_at(*pixel), formation.positions_at(*others.T))


def _spectrum(formation: Formation) -> NDArray[np.float64]:
    """Return the covariance of the spatial spectrum of a point in the scene's middle, east and north."""
    profiles, grid = formation.profiles, formation.grid
    row, column = ((size - 1) / 2 for size in grid.shape)
    here, axes = ground_axes(formation, row, column)
    half = profiles.bandwidth_hz / 2
    band = profiles.centre_frequency_hz + half * np.linspace(-1, 1, _BAND_SAMPLES) * _WINDOWED
    return profiles.aperture.spectrum(here, axes, frequency_hz=band, weigh=_sector_of(formation))


def focus_report(formation: Formation, target: Any) -> dict[str, Any]:
    """Return the focus section of image.json: verdict, loss, and each bright point.

    Parameters
    ----------
    formation
        Formation of the image.
    target
        (y, x) complex64, the image as written.

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
    inputs, found = formation.history or formation.profiles, verdict.points > 0
    elsewhere = echo_outside_scene(inputs, grid, formation.plan.terrain, points=terms, measured=found)
    if elsewhere:
        measured = [None] * len(points)  # sidelobes of it
    if elsewhere or not found:
        verdict = judge_parts(parts, cell_m=cell_m)
    peak = max((point.amplitude for point in points), default=0.0)
    conjugated = elsewhere or verdict.loss_db < _CONJUGATED_LOSS_DB
    return {
        "verdict": verdict.verdict,
        **({"loss_db": round(verdict.loss_db, 3), "std_db": round(verdict.std_db, 3)} if verdict.points else {}),
        "why": verdict.why,
        **({"elsewhere": elsewhere} if elsewhere else {}),
        **({"conjugated": line} if conjugated and (line := _conjugated(formation, peak)) else {}),
        "cell_m": round(cell_m, 4),
        "spectrum_cycles2_m2": [[float(f"{value:.4g}") for value in row] for row in _spectrum(formation)],
        "maxima": len(points),
        "parts": {name: round(value, 4) if np.isfinite(value) else None for name, value in asdict(parts).items()},
        "points": [
            _point_report(formation, point, focus) for point, focus in zip(points, measured, strict=True) if focus
        ],
    }


_CONJUGATED_LOSS_DB = -6.0  # beyond which a defocused image may be one of conjugated samples
_CONJUGATED_DB = 10.0  # that their image must be brighter by, which no wrong track of a right image is
_CONJUGATED_S = 60.0  # that it may take


def _conjugated(formation: Formation, peak: float) -> str | None:
    """Return one line where the image of conjugated samples has a far brighter peak than that of the samples.

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
        f"with conjugated samples its brightest place is {min(gained_db, 99):.0f} dB brighter: "
        "I and Q are swapped, or phases count the other way: change waveform.iq between complex and conjugate, of real "
        "beats the sign of waveform.bandwidth_hz; from Python, conjugate the samples"
    )


UNEXPECTED_DB = 0.2
"""dB of loss beyond the expected that are flagged at least: the accuracy to which images of many points tell it."""


def focus_flags(report: dict[str, Any], expected: Effect) -> Flags:
    """Return the flags `defocused`, `loss_unexpected` and `echo_outside_scene`.

    Parameters
    ----------
    report
        From `focus_report`.
    expected
        Effect that the budget expects of all causes.

    Notes
    -----
    Source: docs/theory/focus.md, "Focus of a point". Both losses have a deviation: the measured one by its points, the
    expected one from flight to flight.
    """
    flags = Flags({"echo_outside_scene": report["elsewhere"]} if "elsewhere" in report else {})
    told = f"{abs(expected.loss_db):.1f} ± {expected.loss_std_db:.1f} dB are expected by the budget"
    if report["verdict"] == "defocused":
        flags["defocused"] = (
            f"{report['why']}; {told}: positions, lever arms, heights or times are worse, or not stated"
        )
    elif "loss_db" in report:
        beyond_db = expected.loss_db - report["loss_db"]
        if beyond_db > max(UNEXPECTED_DB, _UNEXPECTED_SIGMAS * float(np.hypot(report["std_db"], expected.loss_std_db))):
            flags["loss_unexpected"] = f"{report['why']}; {told}: something is worse than the budget states"
    if "conjugated" in report:
        return Flags({name: f"{line}; {report['conjugated']}" for name, line in flags.items()})
    return flags


def _parts(formation: Formation, points: list[BrightPoint], cell_m: float) -> SubApertures:
    """Return the subaperture measures of the brightest places."""
    spacing_m = cell_m / _PLACES_PER_CELL
    step_px, some = spacing_m / formation.grid.spacing_m, list[BrightPoint]()
    for point in points:
        near = any(np.hypot(point.row - one.row, point.column - one.column) < _PATCHES_APART * step_px for one in some)
        if not near and len(some) < _PATCHES:
            some.append(point)
    places = [_places(formation, point, step_px) for point in some]
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
