"""Backprojection by the project's compiled kernel: range tables, no gathers, AVX-512, AVX2 or portable.

`prepare` turns range profiles into tables once; `form` sums them over the pixels of a tile. Both release
the GIL and start no threads of their own. Without a compiler at installation `available` is False.
"""

import ctypes
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.engine import EngineOptions, checked_pixels
from apertura.core.backprojection.engines.native_binding import (
    INSTRUCTION_SETS,
    KERNEL,
    ApertureJob,
    TableJob,
    available,
    call,
    instruction_set,
    weights_of,
)
from apertura.core.backprojection.engines.native_prediction import candidates
from apertura.core.backprojection.engines.native_tables import MARGIN, TAPS, TableDesign, Tables, design_table
from apertura.core.backprojection.inputs import Profiles

__all__ = ["INSTRUCTION_SETS", "NEEDS", "READS", "available", "candidates", "form", "instruction_set", "prepare"]

READS: Literal["profiles"] = "profiles"
NEEDS = "a C++ compiler when apertura is installed"


class Options(EngineOptions):
    """Options of the engine."""

    degree: Annotated[int, Field(ge=1, le=2)] | None = Field(None, description="of the polynomials in a table cell")
    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="largest phase error that the path series may make, rad"
    )
    accumulate: Literal["complex64", "complex128"] | None = Field(None, description="type of sums over pulses")


def prepare(profiles: Profiles, *, oversampling: int = 6, degree: int = 2) -> Tables:
    """Turn range profiles into tables of polynomials with the carrier folded in.

    Parameters
    ----------
    profiles
        Band-limited profiles with eight samples or more beyond the scene at both ends.
    oversampling
        Table cells per Nyquist cell c/B of total path; 6 with degree 2 errs by about
        -75 dB, 10 with degree 1 by -62 dB; `Tables.error_db` predicts it.
    degree
        Of the polynomials, 1 or 2.

    Returns
    -------
    Tables
        pulses × cells × 8·(degree + 1) bytes.

    Raises
    ------
    ValueError
        If `degree` is neither 1 nor 2, the profiles are oversampled less than 1.5 times or have no pulse,
        or a position or start is not finite.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells".
    """
    if degree not in (1, 2):
        raise ValueError(f"{degree=}: must be 1 or 2")
    samples, start_m, places = profiles.for_tables()
    wavenumber = profiles.wavenumber_rad_m
    design = design_table(profiles.oversampling, wavenumber * profiles.step_m, oversampling=oversampling, degree=degree)
    cell_m = profiles.step_m * design.down / design.up
    padding = [(0, -len(samples) % KERNEL.batch)]
    return Tables(
        cells=_expand(samples, np.exp(1j * _turn(wavenumber * start_m)), wavenumber * cell_m, design, degree),
        transmitter_m=np.ascontiguousarray(np.pad(places[0], [*padding, (0, 0)], mode="edge").T),
        receiver_m=np.ascontiguousarray(np.pad(places[1], [*padding, (0, 0)], mode="edge").T),
        first_path_m=np.pad(start_m - MARGIN * cell_m, padding, mode="edge"),
        cell_m=cell_m,
        carrier_rad_per_cell=wavenumber * cell_m,
        phase_polynomial=design.phase_polynomial,
        phase_coefficients=design.phase_coefficients,
        degree=degree,
        error_db=design.error_db(np.ones(1)),
    )


def form(
    tables: Tables,
    pixels: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    accumulate: Literal["complex64", "complex128"] = "complex64",
    tolerance_rad: float = 1.5e-3,
    counts: NDArray[np.int64] | None = None,
) -> NDArray[np.complex64]:
    """Sum the tables over the pixels of one tile.

    Parameters
    ----------
    tables
        From `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres (ECEF or local): any surface. A tile of
        a larger grid that begins at multiples of 16 pixels gets the same bits as in the larger grid.
    beams
        Weight of each pulse at each pixel; none by default. A beam or sector that misses a patch costs little.
    accumulate
        Type of the sum over blocks of pulses.
    tolerance_rad
        Largest phase error the path series may make anywhere in a patch of 16 × 16 pixels; patches and pulses that
        would exceed it take exact paths, pixel by pixel in float64.
    counts
        (4,) int64 to which the number of patches × pulses is added that took shared curvature, own
        curvature, exact paths, or had no echo.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses whose profile does not reach a pixel add zero; a pixel without a finite
        position is NaN.

    Raises
    ------
    ValueError
        If `pixels` has another shape, `accumulate` is unknown, or a beam is of other pulses.
    MemoryError
        If the kernel found no memory.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths" and "Antennas"; docs/theory/integration.md, "Edges".
    """
    if accumulate not in ("complex64", "complex128"):
        raise ValueError(f"{accumulate=}: must be 'complex64' or 'complex128'")
    pixels = checked_pixels(pixels)
    image = np.empty(pixels.shape[:2], np.complex64)
    tally = np.zeros(4, np.int64)
    padded = tables.first_path_m.size
    antennas, sector, _kept = weights_of(beams, len(tables.cells), padded)
    job = ApertureJob(
        *(array.ctypes.data for array in (tables.cells, tables.transmitter_m, tables.receiver_m, tables.first_path_m)),
        pixels.ctypes.data, image.ctypes.data, tally.ctypes.data,
        len(tables.cells), padded, tables.cells.shape[2], *image.shape,
        1 / tables.cell_m, tables.carrier_rad_per_cell, tolerance_rad,
        tables.degree, tables.phase_polynomial, accumulate == "complex128",
        (ctypes.c_float * 9)(*tables.phase_coefficients), antennas, sector,
    )  # fmt: skip
    call("apertura_image", job)
    if counts is not None:
        counts += tally
    return image


def _expand(
    samples: NDArray[np.complex64],
    turn: NDArray[np.complex128],
    carrier_rad_per_cell: float,
    design: TableDesign,
    degree: int,
) -> NDArray[np.float32]:
    """Return the cells of `Tables`; `turn` is the carrier at the first sample of each pulse."""
    pulses, length = samples.shape
    used = (length - 1) * design.up // design.down + 1
    steps = -(-used // (design.up * TAPS)) * TAPS
    width = -(-(used + 2 * MARGIN) // TAPS) * TAPS
    width += 16 * (width % 256 == 0)  # else all rows share lines of the cache: up to four times as long
    index = np.arange(steps) * design.up + np.arange(design.up)[:, None]
    carrier = _parts(np.exp(1j * _turn(np.asarray(carrier_rad_per_cell * index))), axis=1)
    cells = np.zeros((pulses, 2 * (degree + 1), width), np.float32)
    arrays = (samples, design.taps, design.lead, carrier, _parts(turn, axis=-1), cells)
    job = TableJob(
        *(array.ctypes.data for array in arrays),
        pulses, length, width, design.up, design.down, steps, MARGIN, used, degree,
    )  # fmt: skip
    call("apertura_expand", job)
    return cells


def _parts(values: NDArray[np.complex128], *, axis: int) -> NDArray[np.float32]:
    return np.ascontiguousarray(np.stack([values.real, values.imag], axis), np.float32)


def _turn(phase_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.remainder(phase_rad, 2 * np.pi)
