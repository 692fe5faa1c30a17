"""Reading of antenna patterns from CSV: cut, angle_deg, gain_db, and phase_deg if measured."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.core.antenna.beam import LIMITS_RAD
from apertura.formats.tracks.csv_track import numbers, read_table

Samples = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None]
"""Sampled cut: increasing angles from boresight (deg), gain (dB), and phase (deg) or None if not measured."""

_LARGEST_DB, _LARGEST_DEG = 300.0, 1e5
_COLUMNS = ["cut", "angle_deg", "gain_db"]
_PHASE = "phase_deg"


def read_beam_pattern(path: Path) -> tuple[Samples, Samples]:
    """Read the azimuth and elevation cuts of a CSV file.

    The columns are cut (azimuth or elevation), angle_deg (from boresight, increasing within each cut), gain_db and, if
    measured, phase_deg: phase of the far field relative to the end of the lever arm, positive if the field leads.

    Raises
    ------
    CampaignError
        If a column or a cut is missing, a cell is not a number, or angles do not increase or exceed their limits.
    """
    try:
        table = read_table(path, _COLUMNS, optional=[_PHASE])
        unknown = sorted(set(table["cut"].fillna("").astype(str)) - LIMITS_RAD.keys())
        if unknown:
            raise ValueError(f"unknown cut {quoted(unknown[0])}")
        azimuth, elevation = (_samples(table[table["cut"] == name], name) for name in LIMITS_RAD)
    except (ValueError, ArithmeticError) as error:
        raise CampaignError(
            str(error).partition("\n")[0],
            where=path,
            expected="columns cut (azimuth, elevation), angle_deg and gain_db, with increasing angles in both cuts",
            remedy="Correct the table: one line per sample, the samples of each cut in consecutive lines.",
        ) from error
    return azimuth, elevation


def _samples(cut: pd.DataFrame, name: str) -> Samples:
    angle, gain = numbers(cut[["angle_deg", "gain_db"]]).T
    phase = numbers(cut[[_PHASE]])[:, 0] if _PHASE in cut else None
    limit = np.degrees(LIMITS_RAD[name])
    if len(angle) < 3:
        raise ValueError(f"{len(angle)} samples in the {name} cut, at least 3 are required")
    if not all(np.isfinite(values).all() for values in (angle, gain, phase) if values is not None):
        raise ValueError(f"the {name} cut contains a cell that is not a number")
    if np.abs(gain).max() > _LARGEST_DB:
        raise ValueError(f"a gain of {gain[np.abs(gain).argmax()]:g} dB in the {name} cut, beyond ±{_LARGEST_DB:g} dB")
    if not (np.diff(angle) > 0).all():
        raise ValueError(f"angles of the {name} cut do not increase")
    if angle[0] < -limit or angle[-1] > limit:
        raise ValueError(f"angles of the {name} cut range from {angle[0]:g}° to {angle[-1]:g}°, beyond ±{limit:g}°")
    if phase is not None and np.abs(phase).max() > _LARGEST_DEG:
        raise ValueError(f"a phase of {phase[np.abs(phase).argmax()]:g}° in the {name} cut, beyond ±{_LARGEST_DEG:g}°")
    return angle, gain, phase
