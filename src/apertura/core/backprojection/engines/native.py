"""Backprojection by the project's compiled kernel: range tables, no gathers, AVX-512, AVX2 or portable.

1. `prepare` turns range profiles into tables (native/expand.hpp): in each cell the least-squares polynomial of the
   profile, times the carrier (docs/theory/engine.md, "Cells"; `range_interpolation` designs the filters).
2. `form` sums them over patches of 16 × 16 pixels (native/patch.cpp, batch.hpp). Paths are polynomials in blocks of
   4 × 4 pixels with one curvature for the patch or one for each block, or exact in float64, the cheapest within
   `tolerance_rad` ("Paths"). Weights of beams are polynomials over the patch where they are smooth (7), those of a
   sector at its edge (docs/theory/integration.md, 3).
3. `candidates` predicts the share of each path variant, error and cost (docs/theory/planner.md).

`prepare` and `form` release the GIL and start no threads of their own. Without a compiler at installation `available`
is False.
"""

import ctypes
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.engine import (
    EngineOptions,
    Setting,
    checked_pixels,
    option_values,
    power_sum_db,
)
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
from apertura.core.backprojection.engines.range_interpolation import (
    MARGIN,
    TAPS,
    TableDesign,
    Tables,
    design_table,
    ratio,
)
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Job
from apertura.core.geometry.aperture import Aperture, distance

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


# ---- Prediction: weights of antennas over patches


@dataclass(frozen=True)
class PatchWeights:
    """Shares of patches × pulses by how antenna weights are computed.

    Attributes
    ----------
    smooth, pixelwise, dark
        Shares that are weighted by a polynomial, pixel by pixel, and not at all; they sum to 1.
    error
        RMS error of the polynomials, relative to the RMS of the weights.
    antennas
        Number of beams.
    edge
        Share at the smooth edge of the sector, of that not outside of it.
    """

    smooth: float = 1.0
    pixelwise: float = 0.0
    dark: float = 0.0
    error: float = 0.0
    antennas: int = 0
    edge: float = 0.0


NO_BEAMS = PatchWeights()


def patch_weights(
    beams: Beams,
    aperture: Aperture,
    steps_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
) -> PatchWeights:
    """Return the shares of patches about places of the scene by how their weights are computed.

    Parameters
    ----------
    beams
        One set of axes for each of the pulses given.
    aperture
        The pulses.
    steps_m
        (2, place, 3) float64, metres: from pixel to pixel along columns and rows.
    place_m
        (place, 3) float64, metres.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas", (7) and the errors below it.
    """
    # The 3 × 3 nodes of a patch about each place.
    half_patch = (KERNEL.patch_side - 1) / 2  # pixels
    across = half_patch * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(9, 2)
    nodes = place_m + np.einsum("ns,spc->npc", across, steps_m)
    # Share at the edge of the sector, of the pulses not outside of it.
    weight = None if beams.sector is None else beams.sector.weight(aperture, place_m)
    illuminated = np.array([]) if weight is None else weight > 0
    edge = float((weight[illuminated] < 1).mean()) if weight is not None and illuminated.any() else 0.0
    if beams.antennas is None:
        return PatchWeights(edge=edge)
    # (7): a polynomial where first and second differences between the nodes are small.
    gain = beams.antennas.weight(aperture, nodes.reshape(-1, 3)).reshape(len(aperture), 3, 3, len(place_m))
    curvature = [np.abs(np.diff(gain, 2, axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    change = [np.abs(np.diff(gain.take([0, 2], axis), axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    dark, everywhere = (gain == 0).all(axis=(1, 2)), (gain != 0).all(axis=(1, 2))
    smooth = everywhere & (np.maximum(*change) <= KERNEL.weight_change)
    smooth &= np.maximum(*curvature) <= KERNEL.weight_curvature
    beta = np.where(smooth, np.hypot(*curvature), 0.0)
    if illuminated.any():
        gain, beta, smooth, dark = (
            np.moveaxis(gain, -1, 1)[illuminated],
            beta[illuminated],
            smooth[illuminated],
            dark[illuminated],
        )
    # Error of the polynomial inside a block, and of the surface between nodes, relative to the RMS weight.
    error = np.hypot((3 / 16) ** 2 / 2 * beta, 1.4 / (9 * np.sqrt(3)) * beta**1.5)
    strength = float((gain**2).mean())
    return PatchWeights(
        float(smooth.mean()),
        float((~smooth & ~dark).mean()),
        float(dark.mean()),
        float(np.sqrt((error**2).mean() / strength)) if strength else 0.0,
        sum(beam is not None for beam in (beams.transmit, beams.receive)),
        edge,
    )


# ---- Prediction: error and cost of settings

OVERSAMPLINGS: Mapping[int, tuple[int, ...]] = {
    1: (4, 5, 6, 8, 10, 12, 16, 20, 24, 32),
    2: (2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20),
}
"""Degree of the polynomials → cells per resolution cell that are considered."""

TOLERANCES_RAD = (1.5e-3, 1e-3, 7e-4, 5e-4, 3e-4, 1.5e-4, 5e-5, 1.5e-5)
"""Phase errors of the path series that are considered, rad."""

WIDE_SUM_DB = -105.0
"""Below this error the sum over pulses is float64; in float32 it errs by about -115 dB."""

_PULSES, _PULSES_OF_SECTOR = 48, 512  # sampled for the geometry
_WORST_TO_RMS = 1 / 3  # RMS phase error over the largest in a patch
_FLOAT32_RAD = 2e-6  # of tables and look-ups
_NO_ERROR = 1e-20  # added before a logarithm

# Seconds on one core: per pulse, cell and coefficient; per pixel and pulse by degree, for each path variant; with beams
# per pixel and pulse that antennas weigh smoothly (on top), pixel by pixel (instead), and not at all.
_CELL_S = 1.5e-9
_SHARED_S, _WIDE_S, _EXACT_S = {1: 2.1e-10, 2: 2.6e-10}, {1: 2.9e-10, 2: 3.7e-10}, {1: 3.2e-9, 2: 3.8e-9}
_BEAM_S, _EDGE_S, _DARK_S = 6.7e-10, 3.4e-8, 1.2e-10
_SECTOR_S = 6.7e-10  # per pixel and pulse at the edge of a sector, on top


_BLOCK_REACH = np.sqrt(2) * (KERNEL.patch_side - KERNEL.block_side) / 2
"""D of a flat patch, in pixels: from its middle to the centre of the block in its corner."""
_PIXEL_REACH = np.sqrt(2) * (KERNEL.block_side - 1) / 2
"""δ, in pixels: from the centre of a block to the pixel in its corner."""


@dataclass(frozen=True, eq=False)
class View:
    """Imaging geometry: points of the scene from some of the pulses.

    Attributes
    ----------
    range_m
        (leg, pulse, point) float64, from transmitter and receiver, metres.
    slope
        (2, pulse, point) float64, change of total path per pixel along columns and rows, metres.
    spacing_m
        Pixel spacing.
    weights
        Of the antennas.
    """

    range_m: NDArray[np.float64]
    slope: NDArray[np.float64]
    spacing_m: float
    weights: PatchWeights = NO_BEAMS


@lru_cache(maxsize=8)
def view_of(job: Job) -> View:
    """Return the imaging geometry of a job's scene."""
    some = job.aperture.sample(_PULSES if job.sector is None else _PULSES_OF_SECTOR)
    aperture, points = job.aperture[some], job.points_m
    right, down = (pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    range_m = np.stack([distance(leg[:, None], points) for leg in aperture.legs])
    gradient = aperture.path_gradient(points)
    slope = np.stack([(gradient * step).sum(-1) for step in (right, down)])
    weights = (
        NO_BEAMS if job.beams is None else patch_weights(job.beams[some], aperture, np.stack([right, down]), points)
    )
    if job.sector is not None:
        illuminated = job.sector[some].weight(aperture, points) > 0
        if illuminated.any():
            range_m, slope = range_m[:, illuminated][..., None], slope[:, illuminated][..., None]
    return View(range_m, slope, job.spacing_m, weights)


def pixel_steps(ground_m: NDArray[np.float64], axis: int, spacing_m: float) -> NDArray[np.float64]:
    """Return the vectors from pixel to pixel along an axis of points (row, column, 3), metres."""
    if ground_m.shape[axis] < 2:
        return np.zeros_like(ground_m)
    along = np.gradient(ground_m, axis=axis)
    return np.asarray(spacing_m * along / np.linalg.norm(along, axis=-1, keepdims=True))


def path_variants(
    view: View, *, cell_m: float, wavenumber_rad_m: float, tolerance_rad: float
) -> tuple[tuple[float, float, float], float]:
    """Return the share of pulses × patches of each path variant, and the phase error of their paths.

    Parameters
    ----------
    view
        Imaging geometry of the scene.
    cell_m
        Total path across one cell of the table.
    wavenumber_rad_m
        2πf_mid/c.
    tolerance_rad
        Largest phase error that the path series may make.

    Returns
    -------
    shares : tuple of float
        Of shared curvature in narrow windows, of wide windows (shared or own curvature), of exact paths.
    error_rad : float
        RMS over patches and pulses of the largest error in a patch.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths" and "Look-ups", for flat patches and windows of AVX-512.

    Examples
    --------
    >>> near, far = (View(np.full((2, 1, 1), m), np.full((2, 1, 1), 0.05), 0.05) for m in (1.0, 100.0))
    >>> limits = {"cell_m": 0.06, "wavenumber_rad_m": 25.0, "tolerance_rad": 1e-3}
    >>> path_variants(near, **limits)[0], path_variants(far, **limits)[0]
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    """
    # Error bounds of one leg, D = reach and δ = inner: terms that both series neglect, and those of shared and own
    # curvature (native/bounds.hpp).
    reach, inner = _BLOCK_REACH * view.spacing_m, _PIXEL_REACH * view.spacing_m
    inverse = (1 / view.range_m) ** 2
    base = inverse * (KERNEL.third_order * inner**3 + inverse * reach**4 * (KERNEL.fifth_order * reach + inner))
    shared = base + KERNEL.shared_curvature_error * reach * inner**2 * inverse
    own = base + KERNEL.own_curvature_error * reach**2 * inner**2 * inverse**1.5
    shared_rad, own_rad = (wavenumber_rad_m * path_m.sum(axis=0) for path_m in (shared, own))
    # Cells that a block of pixels spans, and the 2 × 2 blocks of a narrow window.
    step = np.abs(view.slope).sum(axis=0)
    curvature = KERNEL.curvature_span * view.spacing_m**2 * (1 / view.range_m).sum(axis=0)
    block_cells = ((KERNEL.block_side - 1) * step + 2 * curvature) / cell_m + 1
    group_cells = block_cells + KERNEL.block_side * step / cell_m  # of the 2 × 2 blocks that a narrow window serves
    window_cells = KERNEL.window - KERNEL.window_margin
    # The cheapest variant whose bound meets the tolerance; exact paths where none does.
    has_shared_curvature = (block_cells <= window_cells) & (shared_rad <= tolerance_rad)
    has_own_curvature = (block_cells <= window_cells) & (shared_rad > tolerance_rad) & (own_rad <= tolerance_rad)
    narrow = has_shared_curvature & (group_cells <= window_cells)
    parts = (float(narrow.mean()), float((has_shared_curvature & ~narrow).mean() + has_own_curvature.mean()))
    error = np.where(has_shared_curvature, shared_rad, np.where(has_own_curvature, own_rad, 0.0))
    return (*parts, float(1 - sum(parts))), float(np.sqrt((error**2).mean()))


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield settings of the compiled engine, as `apertura.core.backprojection.engines.engine.Engine` describes.

    Notes
    -----
    Source: docs/theory/planner.md, "Error" and "Cost".
    """
    view = view_of(job)
    for degree in option_values(requested, "degree", OVERSAMPLINGS):
        for oversampling in option_values(requested, "oversampling", OVERSAMPLINGS[degree]):
            for tolerance_rad in option_values(requested, "tolerance_rad", TOLERANCES_RAD):
                yield _setting(job, view, pulses, degree, oversampling, tolerance_rad, requested.get("accumulate"))


def _setting(  # noqa: PLR0917
    job: Job, view: View, pulses: int, degree: int, oversampling: int, tolerance_rad: float, accumulate: str | None
) -> Setting:
    # Errors of tables (planner.md, eq. 1), paths and polynomials of weights add as independent ones.
    signal, k = job.signal, job.signal.wavenumber_rad_m
    up, down = ratio(signal.oversampling, oversampling)
    design = design_table(signal.oversampling, k * signal.step_m, oversampling=oversampling, degree=degree)
    table_db = design.error_db(signal.window)
    shares, path_rad = path_variants(
        view, cell_m=signal.step_m * down / up, wavenumber_rad_m=k, tolerance_rad=tolerance_rad
    )
    paths_db = 20 * np.log10(_WORST_TO_RMS * path_rad + _FLOAT32_RAD)
    beams_db = 20 * np.log10(view.weights.error + _NO_ERROR)
    error_db = power_sum_db(table_db, paths_db, beams_db)
    coefficients = pulses * -(-((signal.samples - 1) * up // down + 1 + 2 * MARGIN) // TAPS) * TAPS * (degree + 1)
    return Setting(
        "native",
        {"degree": degree, "oversampling": oversampling},
        {
            "accumulate": accumulate or ("complex64" if error_db > WIDE_SUM_DB else "complex128"),
            "tolerance_rad": tolerance_rad,
        },
        error_db,
        job.pixels * pulses * job.share * pixel_seconds(shares, degree, view.weights),
        table_seconds=_CELL_S * coefficients,
        table_bytes=8 * coefficients,
        reasons=_reasons(table_db, paths_db, beams_db if view.weights.antennas else None, shares),
    )


def pixel_seconds(shares: tuple[float, float, float], degree: int, weights: PatchWeights) -> float:
    """Return the seconds per pixel and pulse."""
    each = (_SHARED_S[degree], _WIDE_S[degree], _EXACT_S[degree])
    plain = sum(share * seconds for share, seconds in zip(shares, each, strict=True))
    if not weights.antennas:
        return plain + weights.edge * (1 - shares[2]) * _SECTOR_S
    weighed = plain + (1 - shares[2]) * _BEAM_S + shares[2] * (_EDGE_S - each[2])
    return weights.smooth * weighed + weights.pixelwise * _EDGE_S + weights.dark * _DARK_S


def _reasons(
    table_db: float, paths_db: float, beams_db: float | None, shares: tuple[float, float, float]
) -> dict[str, str]:
    shared, wide, exact = (100 * share for share in shares)
    paths = f"of pixel·pulses {shared:.0f} % share curvature, {wide:.0f} % take wide windows, {exact:.0f} % exact paths"
    beams = "" if beams_db is None else f", weights of antennas by {beams_db:.1f} dB"
    return {
        "degree": "cheapest with this oversampling",
        "oversampling": f"table errs by {table_db:.1f} dB, paths by {paths_db:.1f} dB{beams}",
        "tolerance_rad": paths,
        "accumulate": f"sums in float32 err by -115 dB, wider below {WIDE_SUM_DB:.0f} dB; paths start in float64",
    }
