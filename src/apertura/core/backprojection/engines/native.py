"""Backprojection by the compiled kernel: range tables without gather instructions, AVX-512, AVX2 or portable code.

1. `prepare` converts range profiles to tables (native/expand.hpp): each cell contains the least-squares polynomial of
   the profile, multiplied by the carrier (docs/theory/engine.md, "Cells"; `range_interpolation` designs the filters).
2. `form` sums the tables over patches of 16 × 16 pixels (native/patch.cpp, batch.hpp). Paths are polynomials in blocks
   of 4 × 4 pixels with a shared curvature for the patch or a curvature for each block, or are computed exactly in
   float64; the variant with the lowest cost within `tolerance_rad` is used ("Paths"). Beam weights are polynomials over
   the patch if the weights are smooth (eq. 7). Sector weights are polynomials at the edge of the sector
   (docs/theory/integration.md, eq. 3).
3. `candidates` predicts the fraction of each path variant, the error and the cost (docs/theory/planner.md).

`prepare` and `form` release the GIL and start no threads. `available` returns False if no compiler was available at
installation.
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

    degree: Annotated[int, Field(ge=1, le=2)] | None = Field(
        None, description="degree of the polynomials in a table cell"
    )
    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="largest tolerated phase error of the path series, rad"
    )
    accumulate: Literal["complex64", "complex128"] | None = Field(
        None, description="numeric type of the sums over pulses"
    )


def prepare(profiles: Profiles, *, oversampling: int = 6, degree: int = 2) -> Tables:
    """Convert range profiles to tables of polynomials that include the carrier.

    Parameters
    ----------
    profiles
        Band-limited profiles with at least eight samples beyond the scene at both ends.
    oversampling
        Table cells per Nyquist cell c/B of total path. The error is about -75 dB for 6 cells with degree 2, and -62 dB
        for 10 cells with degree 1; `Tables.error_db` is the predicted error.
    degree
        Degree of the polynomials, 1 or 2.

    Returns
    -------
    Tables
        Tables of pulses × cells × 8·(degree + 1) bytes.

    Raises
    ------
    ValueError
        If `degree` is neither 1 nor 2, if the oversampling of the profiles is below 1.5, if there is no pulse, or if a
        position or start is not finite.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells".
    """
    if degree not in (1, 2):
        raise ValueError(f"{degree=}: must be 1 or 2")
    samples, start_m, phase_centres = profiles.for_tables()
    wavenumber = profiles.wavenumber_rad_m
    design = design_table(profiles.oversampling, wavenumber * profiles.step_m, oversampling=oversampling, degree=degree)
    cell_m = profiles.step_m * design.down / design.up
    padding = [(0, -len(samples) % KERNEL.batch)]
    return Tables(
        cells=_expand(samples, np.exp(1j * _turn(wavenumber * start_m)), wavenumber * cell_m, design, degree),
        transmitter_m=np.ascontiguousarray(np.pad(phase_centres[0], [*padding, (0, 0)], mode="edge").T),
        receiver_m=np.ascontiguousarray(np.pad(phase_centres[1], [*padding, (0, 0)], mode="edge").T),
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
    """Sum the tables at the pixels of one tile.

    Parameters
    ----------
    tables
        Tables from `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres (ECEF or local), on any surface. A tile of a
        larger grid that starts at multiples of 16 pixels is bit-identical to this part of the image of the larger grid.
    beams
        Weight of each pulse at each pixel (default: 1). Pulses for which beam or sector does not illuminate a patch
        require little time.
    accumulate
        Numeric type of the sum over pulse blocks.
    tolerance_rad
        Largest phase error of the path series anywhere in a patch of 16 × 16 pixels. For patches and pulses that exceed
        this error, exact paths are computed pixel by pixel in float64.
    counts
        (4,) int64 array to which the numbers of patch-pulse pairs are added: with a shared curvature, with a curvature
        for each block, with exact paths, and without an echo.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses do not contribute to pixels that are not covered by their profiles; a pixel without a
        finite position is NaN.

    Raises
    ------
    ValueError
        If the shape of `pixels` is not (y, x, 3), if `accumulate` is unknown, or if a beam has a different number of
        pulses.
    MemoryError
        If the kernel cannot allocate memory.

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
    carrier_at_start: NDArray[np.complex128],
    carrier_rad_per_cell: float,
    design: TableDesign,
    degree: int,
) -> NDArray[np.float32]:
    """Return the cells of `Tables`; `carrier_at_start` is the carrier at the first sample of each pulse."""
    pulses, length = samples.shape
    used = (length - 1) * design.up // design.down + 1
    steps = -(-used // (design.up * TAPS)) * TAPS
    width = -(-(used + 2 * MARGIN) // TAPS) * TAPS
    # padding, without which all rows map to the same cache lines and the sum is up to four times slower
    width += 16 * (width % 256 == 0)
    index = np.arange(steps) * design.up + np.arange(design.up)[:, None]
    carrier = _parts(np.exp(1j * _turn(np.asarray(carrier_rad_per_cell * index))), axis=1)
    cells = np.zeros((pulses, 2 * (degree + 1), width), np.float32)
    arrays = (samples, design.taps, design.lead, carrier, _parts(carrier_at_start, axis=-1), cells)
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


# ---- Prediction: antenna weights over patches


@dataclass(frozen=True)
class PatchWeights:
    """Fractions of patch-pulse pairs by the method of computing antenna weights.

    Attributes
    ----------
    smooth, pixelwise, dark
        Fractions that are weighted by a polynomial, weighted pixel by pixel, and not illuminated; the sum is 1.
    error
        RMS error of the polynomials relative to the RMS of the weights.
    antennas
        Number of beams.
    edge
        Fraction of the pairs inside the sector that are at the smooth edge of the sector.
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
    """Return the fractions of patches about points of the scene by the method of computing weights.

    Parameters
    ----------
    beams
        Beams with one set of axes for each pulse.
    aperture
        Aperture of the pulses.
    steps_m
        (2, point, 3) float64, vectors from pixel to pixel along columns and rows, metres.
    place_m
        (point, 3) float64, metres.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas", eq. 7 and the errors below it.
    """
    # The 3 × 3 nodes of a patch about each point.
    half_patch = (KERNEL.patch_side - 1) / 2  # pixels
    across = half_patch * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(9, 2)
    nodes = place_m + np.einsum("ns,spc->npc", across, steps_m)
    # Fraction of the pulses inside the sector that are at the edge of the sector.
    weight = None if beams.sector is None else beams.sector.weight(aperture, place_m)
    illuminated = np.array([]) if weight is None else weight > 0
    edge = float((weight[illuminated] < 1).mean()) if weight is not None and illuminated.any() else 0.0
    if beams.antennas is None:
        return PatchWeights(edge=edge)
    # Eq. 7: a polynomial is used if first and second differences between the nodes are small.
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
"""Degree of the polynomials → candidate cells per resolution cell."""

TOLERANCES_RAD = (1.5e-3, 1e-3, 7e-4, 5e-4, 3e-4, 1.5e-4, 5e-5, 1.5e-5)
"""Candidate phase tolerances of the path series, rad."""

WIDE_SUM_DB = -105.0
"""Error below which the sum over pulses is computed in float64, dB; the error of a float32 sum is about -115 dB."""

_PULSES, _PULSES_OF_SECTOR = 48, 512  # numbers of pulses sampled for the geometry, without and with a sector
_WORST_TO_RMS = 1 / 3  # RMS phase error relative to the largest phase error in a patch
_FLOAT32_RAD = 2e-6  # rounding error of tables and look-ups
_NO_ERROR = 1e-20  # added before taking a logarithm

# Seconds on one core: per pulse, cell and coefficient; per pixel and pulse by degree, for each path variant; with
# beams, per pixel and pulse for smooth antenna weights (additional), pixelwise weights (instead), and no illumination.
_CELL_S = 1.5e-9
_SHARED_S, _WIDE_S, _EXACT_S = {1: 2.1e-10, 2: 2.6e-10}, {1: 2.9e-10, 2: 3.7e-10}, {1: 3.2e-9, 2: 3.8e-9}
_BEAM_S, _EDGE_S, _DARK_S = 6.7e-10, 3.4e-8, 1.2e-10
_SECTOR_S = 6.7e-10  # per pixel and pulse at the edge of a sector (additional)


_BLOCK_REACH = np.sqrt(2) * (KERNEL.patch_side - KERNEL.block_side) / 2
"""D of a flat patch, pixels: distance from the centre of the patch to the centre of a corner block."""
_PIXEL_REACH = np.sqrt(2) * (KERNEL.block_side - 1) / 2
"""δ, pixels: distance from the centre of a block to a corner pixel."""


@dataclass(frozen=True, eq=False)
class View:
    """Imaging geometry: paths from sampled pulses to points of the scene.

    Attributes
    ----------
    range_m
        (leg, pulse, point) float64, distances from transmitter and receiver, metres.
    slope
        (2, pulse, point) float64, change of total path per pixel along columns and rows, metres.
    spacing_m
        Pixel spacing.
    weights
        Antenna weights over patches.
    """

    range_m: NDArray[np.float64]
    slope: NDArray[np.float64]
    spacing_m: float
    weights: PatchWeights = NO_BEAMS


@lru_cache(maxsize=8)
def view_of(job: Job) -> View:
    """Return the imaging geometry of the scene of a job."""
    pulses = job.aperture.sample(_PULSES if job.sector is None else _PULSES_OF_SECTOR)
    aperture, points = job.aperture[pulses], job.points_m
    right, down = (pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    range_m = np.stack([distance(leg[:, None], points) for leg in aperture.legs])
    gradient = aperture.path_gradient(points)
    slope = np.stack([(gradient * step).sum(-1) for step in (right, down)])
    weights = (
        NO_BEAMS if job.beams is None else patch_weights(job.beams[pulses], aperture, np.stack([right, down]), points)
    )
    if job.sector is not None:
        illuminated = job.sector[pulses].weight(aperture, points) > 0
        if illuminated.any():
            range_m, slope = range_m[:, illuminated][..., None], slope[:, illuminated][..., None]
    return View(range_m, slope, job.spacing_m, weights)


def pixel_steps(ground_m: NDArray[np.float64], axis: int, spacing_m: float) -> NDArray[np.float64]:
    """Return the vectors from pixel to pixel along an axis of points (row, column, 3), metres."""
    if ground_m.shape[axis] < 2:
        return np.zeros_like(ground_m)
    along = np.gradient(ground_m, axis=axis)
    return np.asarray(spacing_m * along / np.linalg.norm(along, axis=-1, keepdims=True))


@lru_cache(maxsize=1024)
def path_variants(
    view: View, *, cell_m: float, wavenumber_rad_m: float, tolerance_rad: float
) -> tuple[tuple[float, float, float], float]:
    """Return the fractions of patch-pulse pairs with each path variant, and the phase error of the paths.

    Parameters
    ----------
    view
        Imaging geometry of the scene.
    cell_m
        Total path across one cell of the table, metres.
    wavenumber_rad_m
        2πf_mid/c.
    tolerance_rad
        Largest tolerated phase error of the path series.

    Returns
    -------
    shares : tuple of float
        Fractions with a shared curvature in narrow windows, with wide windows (shared curvature or a curvature for each
        block), and with exact paths.
    error_rad : float
        RMS over patches and pulses of the largest phase error in a patch, rad.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths" and "Look-ups", for flat patches and AVX-512 windows.

    Examples
    --------
    >>> near, far = (View(np.full((2, 1, 1), m), np.full((2, 1, 1), 0.05), 0.05) for m in (1.0, 100.0))
    >>> limits = {"cell_m": 0.06, "wavenumber_rad_m": 25.0, "tolerance_rad": 1e-3}
    >>> path_variants(near, **limits)[0], path_variants(far, **limits)[0]
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    """
    # Error bounds of a one-way path, with D = reach and δ = inner: terms neglected by both series, and errors of a
    # shared curvature and of a curvature for each block (native/bounds.hpp).
    reach, inner = _BLOCK_REACH * view.spacing_m, _PIXEL_REACH * view.spacing_m
    inverse = (1 / view.range_m) ** 2
    base = inverse * (KERNEL.third_order * inner**3 + inverse * reach**4 * (KERNEL.fifth_order * reach + inner))
    shared = base + KERNEL.shared_curvature_error * reach * inner**2 * inverse
    own = base + KERNEL.own_curvature_error * reach**2 * inner**2 * inverse**1.5
    shared_rad, own_rad = (wavenumber_rad_m * path_m.sum(axis=0) for path_m in (shared, own))
    # Number of cells spanned by a block of pixels, and by the 2 × 2 blocks of a narrow window.
    step = np.abs(view.slope).sum(axis=0)
    curvature = KERNEL.curvature_span * view.spacing_m**2 * (1 / view.range_m).sum(axis=0)
    block_cells = ((KERNEL.block_side - 1) * step + 2 * curvature) / cell_m + 1
    group_cells = block_cells + KERNEL.block_side * step / cell_m
    window_cells = KERNEL.window - KERNEL.window_margin
    # Cheapest variant with an error bound within the tolerance, otherwise exact paths.
    has_shared_curvature = (block_cells <= window_cells) & (shared_rad <= tolerance_rad)
    has_own_curvature = (block_cells <= window_cells) & (shared_rad > tolerance_rad) & (own_rad <= tolerance_rad)
    narrow = has_shared_curvature & (group_cells <= window_cells)
    parts = (float(narrow.mean()), float((has_shared_curvature & ~narrow).mean() + has_own_curvature.mean()))
    error = np.where(has_shared_curvature, shared_rad, np.where(has_own_curvature, own_rad, 0.0))
    return (*parts, float(1 - sum(parts))), float(np.sqrt((error**2).mean()))


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield settings of the compiled engine, as described in `apertura.core.backprojection.engines.engine.Engine`.

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
    # Errors of tables (planner.md, eq. 1), paths and weight polynomials are independent.
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
    """Return the predicted seconds per pixel and pulse."""
    by_variant = (_SHARED_S[degree], _WIDE_S[degree], _EXACT_S[degree])
    unweighted = sum(share * seconds for share, seconds in zip(shares, by_variant, strict=True))
    if not weights.antennas:
        return unweighted + weights.edge * (1 - shares[2]) * _SECTOR_S
    weighted = unweighted + (1 - shares[2]) * _BEAM_S + shares[2] * (_EDGE_S - by_variant[2])
    return weights.smooth * weighted + weights.pixelwise * _EDGE_S + weights.dark * _DARK_S


def _reasons(
    table_db: float, paths_db: float, beams_db: float | None, shares: tuple[float, float, float]
) -> dict[str, str]:
    shared, wide, exact = (100 * share for share in shares)
    paths = (
        f"fractions of pixel-pulse pairs: shared curvature {shared:.0f} %, wide windows {wide:.0f} %, exact paths "
        f"{exact:.0f} %"
    )
    beams = "" if beams_db is None else f", antenna weights {beams_db:.1f} dB"
    return {
        "degree": "lowest cost with this oversampling",
        "oversampling": f"predicted errors: table {table_db:.1f} dB, paths {paths_db:.1f} dB{beams}",
        "tolerance_rad": paths,
        "accumulate": "the error of float32 sums is -115 dB; float64 sums are used for a predicted error below "
        f"{WIDE_SUM_DB:.0f} dB",
    }
