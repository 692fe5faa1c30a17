"""Backprojection on an NVIDIA GPU: range tables, a block of threads per patch of pixels; the extra ``cuda``.

What runs on the device is in `cuda_cells` and `cuda_kernels`, how it gets there in `cuda_device`, what it is predicted
to do in `cuda_prediction`. Nothing of numba.cuda is imported before a device is asked for.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.focus.engines.cuda_constants import DEGREE
from apertura.core.focus.engines.cuda_device import Resident, available, instruction_set, sum_there
from apertura.core.focus.engines.cuda_prediction import candidates
from apertura.core.focus.engines.engine import EngineOptions, checked_pixels
from apertura.core.focus.engines.native_tables import TableDesign, design_table
from apertura.core.focus.inputs import Profiles

__all__ = ["NEEDS", "READS", "TIMED", "available", "candidates", "form", "instruction_set", "prepare"]

READS: Literal["profiles"] = "profiles"
TIMED = False  # no device was at hand: the seconds of cuda_prediction are others', and auto compares measured ones
NEEDS = "an NVIDIA GPU with its driver, and apertura[cuda] (docs/howto/gpu.md)"


class Options(EngineOptions):
    """What may be asked of the engine."""

    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="largest phase error that the path series may make, rad"
    )


@dataclass(frozen=True, eq=False)
class Tables:
    """Profiles, and what they become on the device: polynomials per cell, carrier folded in.

    Attributes
    ----------
    samples
        (pulse, range) complex64.
    places_m
        (pulse, 2, 3) float64, phase centres of transmitter and receiver in the frame of the pixels.
    start_m
        (pulse,) float64, total path of sample 0 and of the middle of cell 0, metres.
    cell_m
        Total path across one cell, metres.
    wavenumber_rad_m
        2πf_mid/c.
    design
        How samples become cells.
    error_db
        Predicted RMS error on random pixels of a profile with a flat spectrum.
    pulses
        Those that count.
    resident
        What is on the device.
    """

    samples: NDArray[np.complex64]
    places_m: NDArray[np.float64]
    start_m: NDArray[np.float64]
    cell_m: float
    wavenumber_rad_m: float
    design: TableDesign
    error_db: float
    pulses: slice
    resident: Resident

    def __getitem__(self, pulses: slice) -> "Tables":
        """Return the tables of some pulses; they are on the device once."""
        first, last, _ = pulses.indices(self.pulses.stop - self.pulses.start)
        start = self.pulses.start
        return replace(self, pulses=slice(start + first, start + max(first, last)))


def prepare(profiles: Profiles, *, oversampling: int = 6) -> Tables:
    """Return what tables are made from; they are made on the device when the first tile is formed there.

    Parameters
    ----------
    profiles
        Band-limited profiles with eight samples or more beyond the scene at both ends.
    oversampling
        Table cells per Nyquist cell c/B of total path; `Tables.error_db` predicts what that errs by.

    Returns
    -------
    Tables
        On the device pulses × cells × 24 bytes.

    Raises
    ------
    ValueError
        If the profiles are oversampled less than 1.5 times or hold no pulse, or a position or start is not finite.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells" and "A GPU".
    """
    samples, start_m, places = profiles.for_tables()
    wavenumber = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
    design = design_table(profiles.oversampling, wavenumber * profiles.step_m, oversampling=oversampling, degree=DEGREE)
    return Tables(
        samples=samples,
        places_m=np.ascontiguousarray(np.stack(places, axis=1)),
        start_m=start_m,
        cell_m=profiles.step_m * design.down / design.up,
        wavenumber_rad_m=wavenumber,
        design=design,
        error_db=design.error_db(np.ones(1)),
        pulses=slice(0, len(samples)),
        resident=Resident(),
    )


def form(
    tables: Tables, pixels: NDArray[np.float64], *, beams: Beams | None = None, tolerance_rad: float = 1.5e-3
) -> NDArray[np.complex64]:
    """Sum the tables over the pixels of one tile.

    Parameters
    ----------
    tables
        From `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres: any surface. A tile of a larger grid that begins
        at multiples of 16 pixels gets the same bits as in the whole.
    beams
        Must be None: this engine weighs no pulses.
    tolerance_rad
        Largest phase error that the path series may make anywhere in a patch of 16 × 16 pixels; patches and pulses that
        would exceed it take exact paths, pixel by pixel in float64.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses whose profile does not reach a pixel add zero; a pixel without a finite position is
        NaN.

    Raises
    ------
    ValueError
        If `pixels` has another shape, or there are beams.
    CampaignError
        If no device can be used, or it fails.

    Notes
    -----
    Source: docs/theory/engine.md, "A GPU".
    """
    pixels = checked_pixels(pixels)
    if beams is not None:
        raise ValueError("engine cuda does not weigh pulses by antennas or a sector")
    if not pixels.size:
        return np.zeros(pixels.shape[:2], np.complex64)
    return sum_there(tables, pixels, tolerance_rad)
