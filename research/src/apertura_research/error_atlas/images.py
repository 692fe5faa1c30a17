"""The images of the atlas: formed and judged as the pipeline's steps do, and where truth sees their targets."""

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.antenna.illumination import illuminate
from apertura.core.focus.engines import load_engine
from apertura.core.imaging.certify import certified
from apertura.core.imaging.focus_check import focus_flags, focus_report
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.quality.point_targets import locate_maximum
from apertura.core.scene.terrain import GroundModels
from apertura.pipeline.opening.images import agreement_by_focus
from apertura_research.error_atlas.flight import GRID, PAIRS, Flight, Heard, Told

ACCURACY_DB = -70.0
"""Worse arithmetic moves the flat tops of wide lobes by millimetres."""

_TILE_PX = 256
_REACH_M = 2.4
_BESIDE_M = 1.5
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Seen:
    """The image of one pair: what the pipeline says of it, and where its targets are.

    Attributes
    ----------
    image
        (y, x) complex64.
    at
        Rows and columns, (n, m) float64 each → the image there, formed there by the same engine.
    focus, flags
        As image.json has them.
    peaks
        (target, 3) float64: row, column, amplitude.
    error_db
        Numerical, as certified.
    """

    image: NDArray[np.complex64]
    at: Callable[[Floats, Floats], NDArray[np.complex64]]
    focus: dict[str, Any]
    flags: dict[str, str]
    peaks: Floats
    error_db: float

    @property
    def ghost_db(self) -> float:
        """Brightest pixel far from all targets, wherever these are seen, against the brightest of all, dB."""
        rows, columns = np.indices(self.image.shape)
        away = np.ones(self.image.shape, bool)
        for row, column, _ in self.peaks:
            away &= np.hypot(rows - row, columns - column) * GRID.spacing_m > _BESIDE_M
        return float(decibels(np.abs(self.image[away]).max() / np.abs(self.image).max()))


def look(flown: Flight, told: Told, heard: dict[str, Heard]) -> dict[str, Seen]:
    """Return both images of a flight, and what the pipeline says of each and of both together."""
    seen = {pair: _seen(flown, told, pair, heard[pair]) for pair in PAIRS}
    together = _between(seen)
    return {pair: replace(one, flags={**one.flags, **together}) for pair, one in seen.items()}


def _seen(flown: Flight, told: Told, pair: str, heard: Heard) -> Seen:
    """Return one image, by the way of step image."""
    formation = _formation(told, pair, told.history(pair, heard, flown.frequency_hz))
    image = np.asarray(formation.image.compute(scheduler="synchronous"))
    with contextlib.redirect_stdout(io.StringIO()):  # the bars of tiles formed again
        said = certified(formation, image, accuracy_db=ACCURACY_DB, threads=1)
    focus = focus_report(formation, image)
    flags = {**told.flags, **told.sidelink_flags(pair, heard), **formation.plan.flags, **said["flags"]}
    flags |= focus_flags(focus, 0.0)
    at = _interpolator(formation)
    return Seen(image, at, focus, flags, _peaks(image, at, flown.targets_m), said["numerical_error_db"])


def _formation(told: Told, pair: str, history: Any) -> Formation:
    profiles, beams = range_compress(history, GRID, told.terrain), told.beams.get(pair)
    models = GroundModels.of(told.terrain, None, GRID)
    job = imaging_job(history.aperture, history.frequency_hz, history.weight, GRID, models, beams=beams)
    lit = None if job.beams is None else illuminate(job.beams, job.aperture, job.points_m)
    plan = make_plan(
        replace(job, illumination=lit), accuracy_db=ACCURACY_DB, overrides={"presum": told.presum}, where="atlas"
    )
    return Formation(history, profiles, GRID, plan, _TILE_PX)


def _interpolator(formation: Formation) -> Callable[[Floats, Floats], NDArray[np.complex64]]:
    """Return the planned image at any place, formed there: a raster tells a peak to a centimetre only."""
    setting, inputs = formation.plan.setting, formation.plan.inputs(formation.profiles)
    engine = load_engine(setting.engine)
    tables = engine.prepare(inputs, **setting.options)

    def at(row: Floats, column: Floats) -> NDArray[np.complex64]:
        places = formation.positions_at(row, column)
        values = engine.form(tables, places, beams=formation.beams, **setting.form_options)
        return np.asarray(values / formation.count)

    return at


def _peaks(image: NDArray[np.complex64], at: Callable[..., NDArray[np.complex64]], targets_m: Floats) -> Floats:
    """Return (target, 3) float64: row, column and amplitude of the highest place near each target."""
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


def _between(seen: dict[str, Seen]) -> dict[str, str]:
    """Return the flags that step assess raises on two images."""
    two = [seen[pair] for pair in PAIRS]
    found = agreement_by_focus((two[0].image, two[1].image), (two[0].focus, two[1].focus), GRID)
    if found is None:
        sure = any(point["snr_db"] > 20.0 for point in two[0].focus["points"])
        return {"pair_unconfirmed": "no point in common"} if sure else {}
    shifted = {"pairs_apart": f"{found.shift_m:.3f} m"} if found.shifted else {}
    return shifted | ({"pairs_out_of_phase": f"{found.phase_rad:.2f} rad"} if found.out_of_phase else {})


def decibels(ratio: Floats | float) -> Floats:
    """Return 20·log10 of amplitude ratios, at least −60 dB."""
    return np.asarray(20 * np.log10(np.maximum(ratio, 1e-3)))
