"""What one size of a cause did to the images of the atlas, what the budget had expected, and which flags came."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.illumination import illuminate
from apertura.errors import CampaignError
from apertura.imaging.certify import certified
from apertura.imaging.focus_check import focus_flags, focus_report
from apertura.imaging.formation import Formation
from apertura.imaging.job import imaging_job
from apertura.imaging.range_profiles import range_compress
from apertura.load.budget import arithmetic_line
from apertura.planning.planner import make_plan
from apertura.quality.agreement import agreement
from apertura.quality.bright_points import BrightPoint
from apertura.quality.path_errors import Effect
from apertura.quality.point_targets import Patch, find_peak
from apertura.scene.ground_models import GroundModels
from apertura.study.atlas.causes import CAUSES, Cause
from apertura.study.atlas.flight import GRID, PAIRS, Flight, Heard, Told

ACCURACY_DB = -50.0
_TILE_PX = 256
_REACH_M = 2.4
_BESIDE_M = 1.5


@dataclass(frozen=True)
class Outcome:
    """One draw of one size of one cause: a row of the CSV.

    Attributes
    ----------
    loss_db, shift_m
        Mean over the five targets, of the pair that is worse; against the same draw with nothing wrong.
    phase_rad
        Between both pairs halfway between their peaks, against the same draw with nothing wrong.
    ghost_db
        How much brighter, against the brightest target, the brightest pixel became that is 1.5 m from all of them.
    cell_m
        Resolution cell.
    expected_loss_db, expected_shift_m, expected_phase_rad
        By the budget of the pair that is worse, when the size is stated; arithmetic as measured.
    flags
        Names of what was raised on either pair, with blanks between; `refused`: an error instead of an image, whose
        losses are NaN.
    """

    cause: str
    unit: str
    size: float
    draw: int
    loss_db: float
    shift_m: float
    phase_rad: float
    ghost_db: float
    cell_m: float
    expected_loss_db: float
    expected_shift_m: float
    expected_phase_rad: float
    flags: str


@dataclass(frozen=True, eq=False)
class Seen:
    """The image of one pair: what the pipeline says of it, and where its targets are.

    Attributes
    ----------
    image
        (y, x) complex64.
    focus, flags
        As image.json has them.
    peaks
        (target, 3) float64: row, column, amplitude.
    error_db
        Numerical, as certified.
    """

    image: NDArray[np.complex64]
    focus: dict[str, Any]
    flags: dict[str, str]
    peaks: NDArray[np.float64]
    error_db: float

    @property
    def ghost_db(self) -> float:
        """Brightest pixel far from all targets, wherever these are seen, against the brightest of all, dB."""
        rows, columns = np.indices(self.image.shape)
        away = np.ones(self.image.shape, bool)
        for row, column, _ in self.peaks:
            away &= np.hypot(rows - row, columns - column) * GRID.spacing_m > _BESIDE_M
        return float(_decibels(np.abs(self.image[away]).max() / np.abs(self.image).max()))


def run_cause(name: str, *, seed: int = 1) -> Iterator[Outcome]:
    """Yield every draw at each size of one of `CAUSES`; every size meets the same random numbers."""
    cause = CAUSES[name]
    flown = cause.flight()
    for draw in range(cause.draws):
        generator = np.random.default_rng([seed, draw])
        heard = {pair: flown.hear(pair, generator) for pair in PAIRS}
        right = look(flown, flown.truth, heard)
        for size in cause.sizes:
            told = cause.tell(flown, size, np.random.default_rng([seed, draw, 1]))
            yield _outcome(name, size, draw, right, _looked(flown, told, heard))


def _looked(flown: Flight, told: Told, heard: dict[str, Heard]) -> dict[str, Seen] | None:
    try:
        return look(flown, told, heard)
    except CampaignError:
        return None


def look(flown: Flight, told: Told, heard: dict[str, Heard]) -> dict[str, Seen]:
    """Return both images of a flight, and what the pipeline says of each and of both together."""
    seen = {pair: _seen(flown, told, pair, heard[pair]) for pair in PAIRS}
    together = _between(seen)
    return {pair: replace(one, flags={**one.flags, **together}) for pair, one in seen.items()}


def _seen(flown: Flight, told: Told, pair: str, heard: Heard) -> Seen:
    """Return one image, by the way of step image."""
    formation = _formation(told, pair, told.history(pair, heard, flown.frequency_hz))
    image = np.asarray(formation.image.compute(scheduler="synchronous"))
    said = certified(formation, image, accuracy_db=ACCURACY_DB, threads=1)
    focus = focus_report(formation, image)
    flags = {**told.flags, **told.sidelink_flags(pair, heard), **formation.plan.flags, **said["flags"]}
    flags |= focus_flags(focus, 0.0)
    return Seen(image, focus, flags, _peaks(image, flown.targets_m), said["numerical_error_db"])


def _formation(told: Told, pair: str, history: Any) -> Formation:
    profiles, beams = range_compress(history, GRID, told.terrain), told.beams.get(pair)
    models = GroundModels.of(told.terrain, None, GRID)
    job = imaging_job(history.aperture, history.frequency_hz, history.weight, GRID, models, beams=beams)
    lit = None if beams is None else illuminate(beams, job.aperture, job.points_m)
    plan = make_plan(
        replace(job, illumination=lit), accuracy_db=ACCURACY_DB, overrides={"presum": told.presum}, where="atlas"
    )
    return Formation(history, profiles, GRID, plan, _TILE_PX, beams)


def _peaks(image: NDArray[np.complex64], targets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (target, 3) float64: row, column and amplitude of the highest place near each target."""
    peaks = []
    reach = round(_REACH_M / GRID.spacing_m)
    for row, column in np.transpose(GRID.pixel_of(targets_m[:, 0], targets_m[:, 1])).round().astype(int):
        first, left = max(0, row - reach), max(0, column - reach)
        near = np.abs(image[first : row + reach, left : column + reach])
        down, right = np.unravel_index(int(near.argmax()), near.shape)
        peak = find_peak(image, first + int(down), left + int(right))
        peaks.append((peak.row, peak.column, abs(peak.value)))
    return np.array(peaks)


def _between(seen: dict[str, Seen]) -> dict[str, str]:
    """Return the flags that step assess raises on two images."""
    two, cell_m = [seen[pair] for pair in PAIRS], max(one.focus["cell_m"] for one in seen.values())
    points = [[_point(point) for point in one.focus["points"]] for one in two]
    found = agreement((two[0].image, two[1].image), (points[0], points[1]), spacing_m=GRID.spacing_m, cell_m=cell_m)
    if found is None:
        sure = any(point["snr_db"] > 20.0 for point in two[0].focus["points"])
        return {"pair_unconfirmed": "no point in common"} if sure else {}
    shifted = {"pairs_apart": f"{found.shift_m:.3f} m"} if found.shifted(cell_m) else {}
    return shifted | ({"pairs_out_of_phase": f"{found.phase_rad:.2f} rad"} if found.out_of_phase else {})


def _point(point: dict[str, float]) -> BrightPoint:
    row, column = GRID.pixel_of(point["x_m"], point["y_m"])
    return BrightPoint(float(row), float(column), point["amplitude"])


def _outcome(name: str, size: float, draw: int, right: dict[str, Seen], wrong: dict[str, Seen] | None) -> Outcome:
    cause = CAUSES[name]
    done = (np.nan,) * 4 if wrong is None else _harm(right, wrong, added=cause.added)
    expected = _expected(cause, size, [] if wrong is None else [one.error_db for one in wrong.values()])
    flags = {"refused"} if wrong is None else {flag for one in wrong.values() for flag in one.flags}
    loss_db, shift_m, phase_rad, ghost_db = (round(value, 4) for value in done)
    return Outcome(
        cause=name,
        unit=cause.unit,
        size=float(size),
        draw=draw,
        loss_db=loss_db,
        shift_m=shift_m,
        phase_rad=phase_rad,
        ghost_db=ghost_db,
        cell_m=max(one.focus["cell_m"] for one in right.values()),
        expected_loss_db=round(-expected.loss_db, 4),
        expected_shift_m=round(expected.shift_m, 4),
        expected_phase_rad=round(expected.phase_rad, 4),
        flags=" ".join(sorted(flags)),
    )


def _harm(right: dict[str, Seen], wrong: dict[str, Seen], *, added: bool) -> tuple[float, float, float, float]:
    """Return loss (dB), shift (m), phase (rad) and rise of ghosts (dB)."""
    losses, shifts = [], []
    for pair in PAIRS:
        losses.append(-float(_decibels(wrong[pair].peaks[:, 2] / right[pair].peaks[:, 2]).mean()))
        moved = (wrong[pair].peaks - right[pair].peaks)[:, :2] * GRID.spacing_m
        shifts.append(float(np.hypot(*moved.T).mean()))
    before, after = _phasors(right), _phasors(wrong)
    if added:
        losses = [-float(_decibels(np.abs(after.sum(axis=0)) / np.abs(before.sum(axis=0))).mean())]
    turned = ((after[1] * after[0].conj()) * (before[1] * before[0].conj()).conj()).sum()
    ghosts = [wrong[pair].ghost_db - right[pair].ghost_db for pair in PAIRS]
    return max(losses), max(shifts), float(abs(np.angle(turned))), max(ghosts)


def _expected(cause: Cause, size: float, errors_db: list[float]) -> Effect:
    """Return the most that the budget expects of either pair, with arithmetic as it was measured."""
    effects = [cause.expect(cause.flight(), pair, size) for pair in PAIRS]
    arithmetic = [arithmetic_line(error_db).effect.loss_db for error_db in errors_db]
    return Effect(
        min(effect.loss_db for effect in effects) + min(arithmetic, default=0.0),
        max(effect.shift_m for effect in effects),
        max(effect.phase_rad for effect in effects),
    )


def _phasors(seen: dict[str, Seen]) -> NDArray[np.complex128]:
    """Return (pair, target) complex128, both images halfway between their peaks."""
    middle = np.mean([one.peaks[:, :2] for one in seen.values()], axis=0)
    places = [(row, column, round(row), round(column)) for row, column in middle.tolist()]
    return np.array([[Patch(one.image, i, j).at(row, column) for row, column, i, j in places] for one in seen.values()])


def _decibels(ratio: NDArray[np.float64] | float) -> NDArray[np.float64]:
    return np.asarray(20 * np.log10(np.maximum(ratio, 1e-3)))
