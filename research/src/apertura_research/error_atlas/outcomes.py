"""Measured effect of each size of a cause on images, the effect that the budget expects, and the flags raised."""

import contextlib
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError
from apertura.core.antenna.illumination import illuminate
from apertura.core.backprojection.engines import load_engine
from apertura.core.imaging.certify import certified
from apertura.core.imaging.focus_check import focus_flags, focus_report
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.imaging.view import carriers_of
from apertura.core.planning.planner import make_plan
from apertura.core.quality.budget import NO_EFFECT, arithmetic_line
from apertura.core.quality.point_targets import locate_maximum
from apertura.core.scene.terrain import GroundModels
from apertura.stages.agreement import ComparedImage, agreement_of
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.flight import GRID, PAIRS, AssumedFlight, Received, TrueFlight

ACCURACY_DB = -70.0
"""Requested numerical accuracy: a larger error displaces the flat peaks of wide main lobes by millimetres."""

_TILE_PX = 256
_REACH_M = 2.4
_GHOST_DISTANCE_M = 1.5
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class PairImage:
    """Image of one pair, with the pipeline's report and the peaks of its targets.

    Attributes
    ----------
    image
        (y, x) complex64.
    at
        Rows and columns, (n, m) float64 each → values of the image at these points, formed by the same engine.
    focus, flags
        Entries of image.json.
    carriers
        Result of `carriers_of`, for points over the image.
    peaks
        (target, 3) float64: row, column, amplitude.
    error_db
        Certified numerical error.
    """

    image: NDArray[np.complex64]
    at: Callable[[Floats, Floats], NDArray[np.complex64]]
    focus: dict[str, Any]
    carriers: Floats
    flags: dict[str, str]
    peaks: Floats
    error_db: float

    @property
    def ghost_db(self) -> float:
        """Level of the brightest pixel away from all imaged targets, relative to the brightest pixel, dB."""
        rows, columns = np.indices(self.image.shape)
        away = np.ones(self.image.shape, bool)
        for row, column, _ in self.peaks:
            away &= np.hypot(rows - row, columns - column) * GRID.spacing_m > _GHOST_DISTANCE_M
        return float(decibels(np.abs(self.image[away]).max() / np.abs(self.image).max()))


def form_images(flown: TrueFlight, assumed: AssumedFlight, received: dict[str, Received]) -> dict[str, PairImage]:
    """Form both images of a flight, with the pipeline's report on each, and on both together."""
    images = {pair: _pair_image(flown, assumed, pair, received[pair]) for pair in PAIRS}
    together = _between(images)
    return {pair: replace(one, flags={**one.flags, **together}) for pair, one in images.items()}


def _pair_image(flown: TrueFlight, assumed: AssumedFlight, pair: str, received: Received) -> PairImage:
    """Form one image in the same way as step image."""
    formation = _formation(assumed, pair, assumed.history(pair, received, flown.frequency_hz))
    image = np.asarray(formation.image.compute(scheduler="synchronous"))
    with contextlib.redirect_stdout(io.StringIO()):  # the progress bars of recomputed tiles
        certificate = certified(formation, image, accuracy_db=ACCURACY_DB, threads=1)
    focus = focus_report(formation, image)
    flags = {**assumed.flags, **assumed.sidelink_flags(pair, received), **received.flags}
    flags |= {**formation.plan.flags, **certificate["flags"]}
    flags |= focus_flags(focus, NO_EFFECT)
    at = _interpolator(formation)
    peaks = _peaks(image, at, flown.targets_m)
    return PairImage(image, at, focus, carriers_of(formation), flags, peaks, certificate["numerical_error_db"])


def _formation(assumed: AssumedFlight, pair: str, history: Any) -> Formation:
    profiles, beams = range_compress(history, GRID, assumed.terrain), assumed.beams.get(pair)
    models = GroundModels.of(assumed.terrain, None, GRID)
    job = imaging_job(history.aperture, history.frequency_hz, history.weight, GRID, models, beams=beams)
    illumination = None if job.beams is None else illuminate(job.beams, job.aperture, job.points_m)
    plan = make_plan(
        replace(job, illumination=illumination),
        accuracy_db=ACCURACY_DB,
        overrides={"presum": assumed.presum},
        where="error atlas",
    )
    return Formation(history, profiles, GRID, plan, _TILE_PX)


def _interpolator(formation: Formation) -> Callable[[Floats, Floats], NDArray[np.complex64]]:
    """Return a function that forms the planned image at any point; raster pixels locate a peak only to a centimetre."""
    setting, inputs = formation.plan.setting, formation.plan.inputs(formation.profiles)
    engine = load_engine(setting.engine)
    tables = engine.prepare(inputs, **setting.options)

    def at(row: Floats, column: Floats) -> NDArray[np.complex64]:
        places = formation.positions_at(row, column)
        values = engine.form(tables, places, beams=formation.beams, **setting.form_options)
        return np.asarray(values / formation.count)

    return at


def _peaks(image: NDArray[np.complex64], at: Callable[..., NDArray[np.complex64]], targets_m: Floats) -> Floats:
    """Return row, column and amplitude of the peak near each target, (target, 3) float64."""
    peaks = []
    reach = round(_REACH_M / GRID.spacing_m)
    for row, column in np.transpose(GRID.pixel_of(targets_m[:, 0], targets_m[:, 1])).round().astype(int):
        first, left = max(0, row - reach), max(0, column - reach)
        near = np.abs(image[first : row + reach, left : column + reach])
        down, right = np.unravel_index(int(near.argmax()), near.shape)
        start = float(first + down), float(left + right)
        place, height = locate_maximum(lambda i, j: np.abs(at(i, j)), start, (1.0, 1.0), rounds=_ROUNDS)
        peaks.append((*place, height))
    return np.array(peaks)


def _between(images: dict[str, PairImage]) -> dict[str, str]:
    """Return the flags that step assess raises for a pair of images."""
    two = [images[pair] for pair in PAIRS]
    windows = list(GRID.tiles(_TILE_PX))
    first, second = (ComparedImage.from_raster(one.image, one.focus, one.carriers, GRID, windows) for one in two)
    agreement = agreement_of(first, second, GRID, windows)
    if agreement is None:
        has_bright_point = any(point["snr_db"] > 20.0 for point in two[0].focus["points"])
        return {"pair_unconfirmed": "no common point"} if has_bright_point else {}
    shifted = {"pairs_displaced": f"{agreement.shift_m:.3f} m"} if agreement.shifted else {}
    return shifted | ({"pairs_out_of_phase": f"{agreement.phase_rad:.2f} rad"} if agreement.out_of_phase else {})


def decibels(ratio: Floats | float) -> Floats:
    """Return 20·log10 of amplitude ratios, at least −60 dB."""
    return np.asarray(20 * np.log10(np.maximum(ratio, 1e-3)))


@dataclass(frozen=True)
class ErrorAtlasRow:
    """One draw of one size of one cause: a row of the CSV.

    Attributes
    ----------
    pair
        Pair of the losses and displacements: the pair with the larger expected effect, or the monostatic pair if no
        effect is expected.
    loss_db, shift_m
        Mean over the five targets, relative to the same draw without the error.
    phase_rad
        Phase difference of the pairs midway between their peaks, relative to the same draw without the error.
    ghost_db
        Increase of the brightest pixel at 1.5 m or more from all targets, relative to the brightest target.
    cell_m
        Resolution cell.
    expected_loss_db, expected_shift_m, expected_phase_rad
        Effects expected by the budget if the size is configured, with the measured numerical error.
    flags
        Flags raised on either pair, separated by blanks; `refused`: an error was raised instead, and losses are NaN.
    """

    cause: str
    unit: str
    size: float
    draw: int
    pair: str
    loss_db: float
    shift_m: float
    phase_rad: float
    ghost_db: float
    cell_m: float
    expected_loss_db: float
    expected_shift_m: float
    expected_phase_rad: float
    flags: str


def draws_of(cause: str) -> range:
    """Return the draw numbers of one of `CAUSES`."""
    return range(CAUSES[cause].draws)


def run_draw(name: str, draw: int, *, seed: int = 1) -> Iterator[ErrorAtlasRow]:
    """Simulate one draw at each size of one of `CAUSES`, with the same random numbers for every size."""
    cause = CAUSES[name]
    flown = cause.flight()
    generator = np.random.default_rng([seed, draw])
    received = {pair: flown.receive(pair, generator) for pair in PAIRS}
    right = form_images(flown, flown.truth, received)
    for size in cause.sizes:
        assumed = cause.assume(flown, size, np.random.default_rng([seed, draw, 1]))
        disturbed = {
            pair: cause.receive(flown, pair, received[pair], size, np.random.default_rng([seed, draw, 2, number]))
            for number, pair in enumerate(PAIRS)
        }
        yield _outcome(name, size, draw, right, _images_or_none(flown, assumed, disturbed))


def _images_or_none(
    flown: TrueFlight, assumed: AssumedFlight, received: dict[str, Received]
) -> dict[str, PairImage] | None:
    try:
        return form_images(flown, assumed, received)
    except CampaignError:
        return None


def _outcome(
    name: str, size: float, draw: int, right: dict[str, PairImage], wrong: dict[str, PairImage] | None
) -> ErrorAtlasRow:
    cause = CAUSES[name]
    effects = {pair: cause.expect(cause.flight(), pair, size) for pair in PAIRS}
    pair = min(PAIRS, key=lambda one: (effects[one].loss_db, -effects[one].shift_m))
    loss_db, shift_m, phase_rad, ghost_db = (np.nan,) * 4 if wrong is None else _harm(right, wrong, pair)
    arithmetic_db = 0.0 if wrong is None else arithmetic_line(wrong[pair].error_db).effect.loss_db
    flags = {"refused"} if wrong is None else {flag for one in wrong.values() for flag in one.flags}
    return ErrorAtlasRow(
        cause=name,
        unit=cause.unit,
        size=float(size),
        draw=draw,
        pair=pair,
        loss_db=_sum_loss_db(right, wrong) if cause.added and wrong else loss_db,
        shift_m=shift_m,
        phase_rad=phase_rad,
        ghost_db=ghost_db,
        cell_m=right[pair].focus["cell_m"],
        expected_loss_db=-effects[pair].loss_db - arithmetic_db,
        expected_shift_m=effects[pair].shift_m,
        expected_phase_rad=max(effect.phase_rad for effect in effects.values()),
        flags=" ".join(sorted(flags)),
    )


def _harm(right: dict[str, PairImage], wrong: dict[str, PairImage], pair: str) -> tuple[float, float, float, float]:
    """Return loss (dB), displacement (m), phase (rad) and increase of ghosts (dB)."""
    loss_db = -float(decibels(wrong[pair].peaks[:, 2] / right[pair].peaks[:, 2]).mean())
    displacement_m = (wrong[pair].peaks - right[pair].peaks)[:, :2] * GRID.spacing_m
    before, after = _phasors(right), _phasors(wrong)
    phase_change = ((after[1] * after[0].conj()) * (before[1] * before[0].conj()).conj()).sum()
    ghost_db = max(wrong[one].ghost_db - right[one].ghost_db for one in PAIRS)
    return loss_db, float(np.hypot(*displacement_m.T).mean()), float(abs(np.angle(phase_change))), ghost_db


def _sum_loss_db(right: dict[str, PairImage], wrong: dict[str, PairImage]) -> float:
    """Return the loss of the coherent sum of both pairs, averaged over the targets, dB."""
    before, after = (np.abs(_phasors(images).sum(axis=0)) for images in (right, wrong))
    return -float(decibels(after / before).mean())


def _phasors(images: dict[str, PairImage]) -> NDArray[np.complex128]:
    """Return values of both images midway between their peaks, (pair, target) complex128."""
    middle = np.mean([one.peaks[:, :2] for one in images.values()], axis=0)
    return np.array([one.at(middle[:, :1], middle[:, 1:])[:, 0] for one in images.values()], np.complex128)
