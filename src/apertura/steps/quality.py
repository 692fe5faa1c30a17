"""What an image says of itself: its measured numerical error, and what its pixels and its brightest target tell."""

from dataclasses import asdict
from typing import Any

import numpy as np

from apertura.focus.engines import reference
from apertura.focus.engines.engine import Setting
from apertura.focus.inputs import PhaseHistory
from apertura.quality.error_check import Certificate, certified_pixels
from apertura.quality.measures import coherence_factor, survey
from apertura.quality.point_targets import cut_through, find_peak, ground_position
from apertura.steps.forming import Work

CERTIFIED_PIXELS = 256

CUT_REACH_M = 3.0
"""How far the cuts through the brightest target go to both sides."""


def certified(work: Work, target: Any, better: tuple[Setting, ...], accuracy_db: float) -> dict[str, Any]:
    """Return the measured error; redo tiles that are worse than asked with the next better settings first.

    Parameters
    ----------
    work, target
        What was formed, and where: a (y, x) zarr array.
    better
        Settings, in the order to try them.
    accuracy_db
        Error asked.
    """
    history, windows = work.history["phase_history"], work.windows
    pixels = certified_pixels(target, windows, CERTIFIED_PIXELS, np.random.default_rng(0))
    exact = reference.form(history, work.places(*pixels.T), beams=work.beams) / len(history)
    certificate = Certificate(pixels, exact, CERTIFIED_PIXELS)
    redone: list[dict[str, Any]] = []
    for choice in better:
        uncertified, worse = certificate.failing(target, windows, accuracy_db)
        if not worse:
            break
        print(f"{len(worse)} tiles are worse than {accuracy_db} dB: again with {choice.line}", flush=True)
        work.form(target, choice, uncertified)
        work.form(target, choice, worse)  # last: while one fails, a run that was killed here does all of it again
        redone.append({"tiles": len(worse) + len(uncertified), "with": f"{choice.line}, every pulse"})
    error = certificate.error(target)
    missed = error.rms_db > accuracy_db
    line = f"numerical error {error.rms_db:.1f} dB, {accuracy_db:.1f} dB asked"
    return {
        "numerical_error_db": round(error.rms_db, 2),
        "numerical_error_std_db": round(error.std_db, 2),
        "peak_error_db": round(error.peak_db, 2),
        "certified_pixels": len(pixels),
        "redone": redone,
        "crossed": {"accuracy_missed": line} if missed else {},
    }


def measures(work: Work, target: Any) -> dict[str, Any]:
    """Return what one pass over the pixels and a close look at the brightest target tell."""
    found, grid = survey(target, work.windows), work.grid
    peak = find_peak(target, found.row, found.column)
    x, y = ground_position(grid, peak)
    history: PhaseHistory = work.history["phase_history"]
    terms = reference.terms(history, work.places(np.array([peak.row]), np.array([peak.column])), work.beams)
    along = grid.direction(history.aperture.tx_m[-1] - history.aperture.tx_m[0], peak.row, peak.column)
    cuts = {
        name: cut_through(target, peak, direction=way, spacing_m=grid.spacing_m, reach_m=CUT_REACH_M)
        for name, way in (("cross_range", along), ("ground_range", (along[1], -along[0])))
    }
    return {
        "entropy": round(found.entropy, 6),
        "noise_floor_db": found.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(terms[terms[:, 0] != 0, 0]),
            **{
                f"{name}_{measure}": None if np.isnan(value) else round(value, 4)
                for name, cut in cuts.items()
                for measure, value in asdict(cut).items()
            },
        },
    }
