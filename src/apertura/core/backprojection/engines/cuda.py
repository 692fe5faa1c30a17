"""Backprojection on an NVIDIA GPU: range tables, a block of threads per patch of pixels; the extra ``cuda``.

`prepare` keeps profiles and filters; the first tile expands them on the device to tables, cells of polynomials with the
carrier folded in (docs/theory/engine.md, "Cells"). `form` then starts a block of threads for each patch of 16 × 16
pixels: paths by a series about the patch's middle ("A GPU", eq. 8), exact in float64 where it errs too much, weighted
by beams and sector. Kernels are in `cuda_kernels`, compiled when they are first used; `candidates` predicts error and
cost.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from threading import Lock
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.cuda_prediction import CHUNK, DEGREE, SIDE, candidates, simulated
from apertura.core.backprojection.engines.engine import (
    EngineOptions,
    checked_pixels,
)
from apertura.core.backprojection.engines.range_interpolation import PHASE_POLYNOMIALS, TableDesign, design_table
from apertura.core.backprojection.inputs import Profiles

# ---- The device, and arrays on it
#
# numba.cuda is imported when a device is used. One call is on the device at a time: threads that form tiles wait for
# its lock without the GIL.

_LOCK = Lock()
_THREADS, _CHUNK_THREADS = 128, 32  # of blocks that fill tables, and that compare pulses of chunks


@cache
def available() -> bool:
    """Return whether a device can be used, or numba's simulator is enabled; never raises.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    try:
        if not simulated():
            ctypes.CDLL("libcuda.so.1")  # the driver's own library: without it the import below would be for nothing
        from numba import cuda

        return bool(cuda.is_available())
    except Exception:  # driver, toolkit or package missing or incompatible
        return False


def instruction_set() -> str:
    """Return which device forms images here, and by which package.

    Examples
    --------
    >>> instruction_set().split()[0]
    'cuda:'
    """
    if not available():
        return "cuda: no device"
    from numba import cuda

    try:
        by = f"numba-cuda {version('numba-cuda')}"
    except PackageNotFoundError:  # numba's own numba.cuda
        by = f"numba {version('numba')}"
    if simulated():
        return f"cuda: simulator of {by}"
    device = cuda.get_current_device()
    name = device.name.decode() if isinstance(device.name, bytes) else device.name
    return f"cuda: {name}, compute capability {'.'.join(map(str, device.compute_capability))}, {by}"


class Resident:
    """Arrays on the device, shared by all slices of one engine's tables from the first tile on; not pickled."""

    def __init__(self) -> None:
        self.arrays: tuple[Any, ...] | None = None

    def __reduce__(self) -> tuple[type["Resident"], tuple[()]]:
        return Resident, ()


def sum_on_device(
    tables: "ResidentTables",
    pixels: NDArray[np.float64],
    beams: Beams | None,
    tolerance_rad: float,
    counts: NDArray[np.int64] | None = None,
    *,
    rejecting: bool = True,
) -> NDArray[np.complex64]:
    """Return what `apertura.core.backprojection.engines.cuda.form` returns, of one or more pixels.

    Parameters
    ----------
    tables, pixels, beams, tolerance_rad, counts
        As of `form`.
    rejecting
        False: every pulse is weighed at every pixel, also where its weight is one or zero all over a patch. The same
        bits, for tests.

    Raises
    ------
    CampaignError
        If no device can be used, or it fails.
    """
    sector = beams and beams.sector
    weights = _weights(beams or Beams())
    with _device() as cuda:
        from apertura.core.backprojection.engines import cuda_kernels as kernels

        if tables.resident.arrays is None:
            tables.resident.arrays = _tables_on_device(cuda, tables)
        places, start_m, cells = (array[tables.pulses] for array in tables.resident.arrays)
        # Numbers of the kernel: scales, phase polynomial, sector.
        scales = (1 / tables.cell_m, tables.wavenumber_rad_m, tolerance_rad, cells.shape[2])
        bounds = (sector.centre, sector.inner, sector.outer) if sector else (0.0, 0.0, 0.0)
        phase = tables.design.phase_coefficients.copy()
        if not PHASE_POLYNOMIALS[tables.design.phase_polynomial][2]:
            phase[-1] = 0  # no half turns are removed
        numbers = np.array([*scales, *phase, *bounds], np.float64)
        # Weights, and how far axes and antennas spread within each chunk of 64 pulses, by which chunks are rejected.
        on_device = [cuda.to_device(array) for array in weights]
        spread = cuda.to_device(np.full((-(-len(start_m) // CHUNK) + 1, 2, 3), np.inf))
        if beams and rejecting:
            blocks = -(-len(spread) // _CHUNK_THREADS)
            kernels.spread_of_chunks[blocks, _CHUNK_THREADS](places, *on_device[:2], spread)
        # One block of threads per patch.
        rows, columns = pixels.shape[:2]
        image, tally = (
            cuda.device_array((rows, columns), np.complex64),
            cuda.to_device(np.zeros(len(VARIANTS), np.int64)),
        )
        patches = (-(-columns // SIDE), -(-rows // SIDE))
        form = kernels.form_weighed if beams else kernels.form
        form[patches, (SIDE, kernels.ROWS)](
            cuda.to_device(pixels),
            (places, start_m, cells),
            cuda.to_device(numbers),
            (*on_device, spread),
            (image, tally),
        )
        if counts is not None:
            counts += tally.copy_to_host()
        return np.asarray(image.copy_to_host())


def _weights(beams: Beams) -> tuple[NDArray[Any], ...]:
    """Return beams and sector as arrays of the kernels; empty where there are none.

    (pulse, 2, 3) float64, axes of the sector for transmitter and receiver; (pulse, 2, 3, 3) float64, those of their
    beams; (2, 2, 3) float32, first angle, samples per radian and place of the last sample of both cuts, or -1 without a
    beam; (2, 2, sample) float32, gains; (end, 2, 2, 3) float64, phase centres and axes of the sector's ends.
    """
    sector, legs = beams.sector, [(n, beam) for n, beam in enumerate((beams.transmit, beams.receive)) if beam]
    axes = np.zeros((len(legs[0][1].axes) if legs else 0, 2, 3, 3))
    longest = max((gain.size for _, beam in legs for gain in (beam.azimuth_gain, beam.elevation_gain)), default=2)
    cuts, gains = np.full((2, 2, 3), -1, np.float32), np.zeros((2, 2, longest), np.float32)
    for leg, beam in legs:
        axes[:, leg] = beam.axes
        patterns = ((beam.azimuth_rad, beam.azimuth_gain), (beam.elevation_rad, beam.elevation_gain))
        for cut, (angle, gain) in enumerate(patterns):
            cuts[leg, cut] = angle[0], (angle.size - 1) / (angle[-1] - angle[0]), angle.size - 1
            gains[leg, cut, : gain.size] = gain
    flown, ends = np.zeros((0, 2, 3)), np.zeros((0, 2, 2, 3))
    if sector:
        flown = np.stack([sector.tx_axis, sector.rx_axis], axis=1)
    if sector and sector.ends:
        aperture, there = sector.ends
        ends = np.stack([np.stack(aperture.legs, 1), np.stack([there.tx_axis, there.rx_axis], 1)], axis=1)
    return flown, axes, cuts, gains, ends


def _tables_on_device(cuda: Any, tables: "ResidentTables") -> tuple[Any, ...]:
    """Return phase centres, starts and cells of all pulses on the device."""
    from apertura.core.backprojection.engines.cuda_kernels import expand

    design, k = tables.design, tables.wavenumber_rad_m
    pulses, length = tables.samples.shape
    used = (length - 1) * design.up // design.down + 1
    carrier = np.exp(1j * np.remainder(k * tables.cell_m * np.arange(used), 2 * np.pi)).astype(np.complex64)
    turn = np.exp(1j * np.remainder(k * tables.start_m, 2 * np.pi)).astype(np.complex64)
    cells = cuda.device_array((pulses, 6, used), np.float32)
    samples, taps, lead, carrier, turn = map(cuda.to_device, (tables.samples, design.taps, design.lead, carrier, turn))
    expand[-(-pulses * used // _THREADS), _THREADS](samples, taps, lead, design.down, carrier, turn, cells)
    return cuda.to_device(tables.places_m), cuda.to_device(tables.start_m), cells


@contextmanager
def _device() -> Iterator[Any]:
    """Yield numba.cuda under the device's lock; its failures become one message."""
    if not available():
        raise _unusable("no device can be used")
    from numba import cuda
    from numba.cuda.cudadrv.driver import CudaAPIError, LinkerError

    with _LOCK:
        try:
            yield cuda
        except (CudaAPIError, LinkerError, ImportError) as error:  # ImportError: driver or compiler missing
            raise _unusable(f"the device failed: {' '.join(str(error).split())}") from error


def _unusable(found: str) -> CampaignError:
    return CampaignError(
        f"engine cuda: {found}",
        where="processing.engine",
        expected="an NVIDIA GPU with its driver and memory for a block of pulses (docs/howto/gpu.md)",
        remedy="Choose engine native or numba, or free the device.",
    )


# ---- The engine

__all__ = ["NEEDS", "READS", "TIMED", "VARIANTS", "available", "candidates", "form", "instruction_set", "prepare"]

READS: Literal["profiles"] = "profiles"
TIMED = False  # the seconds below are published ones of others, auto compares measured ones
VARIANTS = ("by series", "by exact paths", "without an echo", "without an echo of 64")
NEEDS = "an NVIDIA GPU with its driver, and apertura[cuda] (docs/howto/gpu.md)"


class Options(EngineOptions):
    """Options of the engine."""

    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="largest phase error that the path series may make, rad"
    )


@dataclass(frozen=True, eq=False)
class ResidentTables:
    """Profiles, and their tables on the device: polynomials per cell, carrier folded in.

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
        Filters from samples to cells.
    error_db
        Predicted RMS error on random pixels of a profile with a flat spectrum.
    pulses
        Pulses of these tables.
    resident
        Arrays on the device.
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

    def __getitem__(self, pulses: slice) -> "ResidentTables":
        """Return the tables of some pulses; they are on the device once."""
        first, last, _ = pulses.indices(self.pulses.stop - self.pulses.start)
        start = self.pulses.start
        return replace(self, pulses=slice(start + first, start + max(first, last)))


def prepare(profiles: Profiles, *, oversampling: int = 6) -> ResidentTables:
    """Return the inputs of tables; the tables are made on the device with the first tile.

    Parameters
    ----------
    profiles
        Band-limited profiles with eight samples or more beyond the scene at both ends.
    oversampling
        Table cells per Nyquist cell c/B of total path; `ResidentTables.error_db` predicts their error.

    Returns
    -------
    Tables
        On the device pulses × cells × 24 bytes.

    Raises
    ------
    ValueError
        If the profiles are oversampled less than 1.5 times or have no pulse, or a position or start is not finite.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells" and "A GPU".
    """
    samples, start_m, places = profiles.for_tables()
    wavenumber = profiles.wavenumber_rad_m
    design = design_table(profiles.oversampling, wavenumber * profiles.step_m, oversampling=oversampling, degree=DEGREE)
    return ResidentTables(
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
    tables: ResidentTables,
    pixels: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    tolerance_rad: float = 1.5e-3,
    counts: NDArray[np.int64] | None = None,
) -> NDArray[np.complex64]:
    """Sum the tables over the pixels of one tile.

    Parameters
    ----------
    tables
        From `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres: any surface. A tile of a larger grid that begins
        at multiples of 16 pixels gets the same bits as in the larger grid.
    beams
        Weight of each pulse at each pixel; none by default. Pulses whose beam or sector misses a patch cost little.
    tolerance_rad
        Largest phase error that the path series may make anywhere in a patch of 16 × 16 pixels; patches and pulses that
        would exceed it take exact paths, pixel by pixel in float64.
    counts
        (4,) int64 to which the number of pixels × pulses is added that were summed by series, by exact paths, had no
        echo, or no echo together with 63 others: those cost next to nothing.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses whose profile does not reach a pixel add zero; a pixel without a finite position is
        NaN.

    Raises
    ------
    ValueError
        If `pixels` has another shape, or a beam or the sector is of other pulses.
    CampaignError
        If no device can be used, or it fails.

    Notes
    -----
    Source: docs/theory/engine.md, "A GPU" and "Antennas"; docs/theory/integration.md.
    """
    pixels = checked_pixels(pixels)
    if beams is not None:
        beams.check_pulses(tables.pulses.stop - tables.pulses.start)
    if not pixels.size:
        return np.zeros(pixels.shape[:2], np.complex64)
    return sum_on_device(tables, pixels, beams, tolerance_rad, counts)
