"""Backprojection on an NVIDIA GPU with range tables and one thread block per patch of pixels; requires extra ``cuda``.

`prepare` stores profiles and filters. For the first tile, the profiles are expanded on the device to tables of cells
with polynomials that include the carrier (docs/theory/engine.md, "Cells"). `form` starts a thread block for each patch
of 16 × 16 pixels. Paths are computed by a series about the centre of the patch ("A GPU", eq. 8), or exactly in float64
if the error of the series is too large. Contributions are weighted by beams and sector. The kernels in `cuda_kernels`
are compiled at their first use. `candidates` predicts error and cost.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
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

# ---- Device and arrays on the device
#
# numba.cuda is imported when a device is used. The device executes one call at a time: threads that form tiles wait
# for the lock of the device without the GIL.

_LOCK = Lock()
# threads per block of the kernel that fills tables, and of the kernel that compares pulses
_THREADS, _CHUNK_THREADS = 128, 32


@cache
def missing() -> str | None:
    """Return the reason why no device can be used; None if there is one, or if the simulator of numba is enabled.

    Examples
    --------
    >>> missing() is None or isinstance(missing(), str)
    True
    """
    try:
        if not simulated():
            ctypes.CDLL("libcuda.so.1")  # fails without the library of the driver, before the slow imports below
        from numba import cuda

        if not cuda.is_available():
            return "no device"
        if not simulated():
            import_module("numba.cuda.np.arrayobj")  # fails with a NumPy that numba-cuda does not support
    except Exception as error:  # driver, toolkit or package is missing or incompatible
        return "no device" if isinstance(error, OSError) else " ".join(f"{type(error).__name__}: {error}".split())
    return None


def available() -> bool:
    """Return True if a device can be used or the simulator of numba is enabled; never raises.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    return missing() is None


def instruction_set() -> str:
    """Return the device on this machine and the package with which it is used, or the reason why none can be used.

    Examples
    --------
    >>> instruction_set().split()[0]
    'cuda:'
    """
    if reason := missing():
        return f"cuda: {reason}"
    from numba import cuda

    try:
        package = f"numba-cuda {version('numba-cuda')}"
    except PackageNotFoundError:  # numba.cuda of package numba
        package = f"numba {version('numba')}"
    if simulated():
        return f"cuda: simulator of {package}"
    device = cuda.get_current_device()
    name = device.name.decode() if isinstance(device.name, bytes) else device.name
    return f"cuda: {name}, compute capability {'.'.join(map(str, device.compute_capability))}, {package}"


class Resident:
    """Arrays on the device, shared by all slices of the tables and all tiles; not pickled.

    Attributes
    ----------
    tables
        Phase centres, starts and cells of all pulses; None before the first tile.
    """

    def __init__(self) -> None:
        self.tables: tuple[Any, ...] | None = None
        self._memory: dict[str, Any] = {}

    def __reduce__(self) -> tuple[type["Resident"], tuple[()]]:
        return Resident, ()

    def array(self, cuda: Any, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
        """Return an array of undefined content; arrays of the same name share their memory from tile to tile."""
        size = int(np.prod(shape))
        if size == 0:
            return cuda.device_array(shape, dtype)
        if name not in self._memory or self._memory[name].size < size:
            self._memory[name] = cuda.device_array(size, dtype)
        return self._memory[name][:size].reshape(shape)

    def copied(self, cuda: Any, name: str, values: NDArray[Any]) -> Any:
        """Return a copy on the device."""
        array = self.array(cuda, name, values.shape, values.dtype)
        if values.size:
            array.copy_to_device(np.ascontiguousarray(values))
        return array


def sum_on_device(
    tables: "ResidentTables",
    pixels: NDArray[np.float64],
    beams: Beams | None,
    tolerance_rad: float,
    counts: NDArray[np.int64] | None = None,
    *,
    rejecting: bool = True,
) -> NDArray[np.complex64]:
    """Return the result of `apertura.core.backprojection.engines.cuda.form` for one or more pixels.

    Parameters
    ----------
    tables, pixels, beams, tolerance_rad, counts
        As for `form`.
    rejecting
        If False, the weight of every pulse is evaluated at every pixel, even if the weight is one or zero over a whole
        patch; the result is bit-identical. For tests.

    Raises
    ------
    CampaignError
        If no device can be used, or if the device fails.
    """
    resident, (rows, columns) = tables.resident, pixels.shape[:2]
    with _device() as cuda:
        from apertura.core.backprojection.engines import cuda_kernels as kernels

        if resident.tables is None:
            resident.tables = _tables_on_device(cuda, tables)
        phase_centres, start_m, cells = (array[tables.pulses] for array in resident.tables)
        # Inputs of the tile: pixels; weights; spread of axes and antenna positions within each chunk of 64 pulses,
        # which is used to reject chunks.
        copied = partial(resident.copied, cuda)
        places = copied("pixels", pixels)
        numbers = copied("numbers", _numbers(tables, beams, tolerance_rad, cells.shape[1] // 3 - 1))
        weights = [copied(f"weights {n}", array) for n, array in enumerate(_weights(beams or Beams()))]
        spread = copied("spread", np.full((-(-len(start_m) // CHUNK) + 1, 2, 3), np.inf))
        if beams and rejecting:
            blocks = -(-len(spread) // _CHUNK_THREADS)
            kernels.spread_of_chunks[blocks, _CHUNK_THREADS](phase_centres, *weights[:2], spread)
        # One thread block per patch.
        image = resident.array(cuda, "image", (rows, columns), np.complex64)
        tally = copied("tally", np.zeros(len(VARIANTS), np.int64))
        patches = (-(-columns // SIDE), -(-rows // SIDE))
        form = kernels.form_weighed if beams else kernels.form
        form[patches, (SIDE, kernels.ROWS)](
            places, (phase_centres, start_m, cells), numbers, (*weights, spread), (image, tally)
        )
        if counts is not None:
            counts += tally.copy_to_host()
        return np.asarray(image.copy_to_host())


def _numbers(tables: "ResidentTables", beams: Beams | None, tolerance_rad: float, cells: int) -> NDArray[np.float64]:
    """Return the parameters of the kernel: scales, phase polynomial, sector."""
    sector = beams and beams.sector
    scales = (1 / tables.cell_m, tables.wavenumber_rad_m, tolerance_rad, cells)
    bounds = (sector.centre, sector.inner, sector.outer) if sector else (0.0, 0.0, 0.0)
    phase = tables.design.phase_coefficients.copy()
    if not PHASE_POLYNOMIALS[tables.design.phase_polynomial][2]:
        phase[-1] = 0  # no reduction by multiples of π
    return np.array([*scales, *phase, *bounds], np.float64)


def _weights(beams: Beams) -> tuple[NDArray[Any], ...]:
    """Return beams and sector as arrays of the kernels; empty arrays without beams or sector.

    The arrays are: (pulse, 2, 3) float64, axes of the sector for transmitter and receiver; (pulse, 2, 3, 3) float64,
    axes of the beams of both; (2, 2, 3) float32, first angle, samples per radian and index of the last sample of both
    cuts, or -1 without a beam; (2, 2, sample) float32, gains; and (end, 2, 2, 3) float64, phase centres and axes at the
    ends of the sector.
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
    sector_axes, ends = np.zeros((0, 2, 3)), np.zeros((0, 2, 2, 3))
    if sector:
        sector_axes = np.stack([sector.tx_axis, sector.rx_axis], axis=1)
    if sector and sector.ends:
        aperture, end_sector = sector.ends
        ends = np.stack([np.stack(aperture.legs, 1), np.stack([end_sector.tx_axis, end_sector.rx_axis], 1)], axis=1)
    return sector_axes, axes, cuts, gains, ends


def _tables_on_device(cuda: Any, tables: "ResidentTables") -> tuple[Any, ...]:
    """Return phase centres, starts and cells of all pulses on the device."""
    from apertura.core.backprojection.engines.cuda_kernels import expand

    design, k = tables.design, tables.wavenumber_rad_m
    pulses, length = tables.samples.shape
    used = (length - 1) * design.up // design.down + 1
    carrier = np.exp(1j * np.remainder(k * tables.cell_m * np.arange(used), 2 * np.pi)).astype(np.complex64)
    carrier_at_start = np.exp(1j * np.remainder(k * tables.start_m, 2 * np.pi)).astype(np.complex64)
    cells = cuda.device_array((pulses, 3 * (used + 1)), np.uint64)  # the last cell of a pulse is 0
    samples, taps, lead, carrier, carrier_at_start = map(
        cuda.to_device, (tables.samples, design.taps, design.lead, carrier, carrier_at_start)
    )
    blocks = -(-pulses * (used + 1) // _THREADS)
    expand[blocks, _THREADS](samples, taps, lead, design.down, carrier, carrier_at_start, cells)
    return cuda.to_device(tables.places_m), cuda.to_device(tables.start_m), cells


@contextmanager
def _device() -> Iterator[Any]:
    """Yield numba.cuda under the lock of the device; report failures of the device as CampaignError."""
    if reason := missing():
        raise _unusable(f"no device can be used ({reason})")
    from numba import cuda
    from numba.cuda.cudadrv.driver import CudaAPIError, LinkerError

    with _LOCK:
        try:
            yield cuda
        except (CudaAPIError, LinkerError, ImportError) as error:  # ImportError: driver or compiler is missing
            raise _unusable(f"the device failed: {' '.join(str(error).split())}") from error


def _unusable(found: str) -> CampaignError:
    return CampaignError(
        f"engine cuda: {found}",
        where="processing.engine",
        expected="an NVIDIA GPU with driver and sufficient memory for a pulse block (docs/howto/gpu.md)",
        remedy="Select engine native or numba, or free memory on the device.",
    )


# ---- Engine

__all__ = ["NEEDS", "READS", "VARIANTS", "available", "candidates", "form", "instruction_set", "prepare"]

READS: Literal["profiles"] = "profiles"
VARIANTS = ("by series", "by exact paths", "without an echo", "without an echo of 64")
NEEDS = "an NVIDIA GPU with driver, and apertura[cuda] (docs/howto/gpu.md)"


class Options(EngineOptions):
    """Options of the engine."""

    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="largest tolerated phase error of the path series, rad"
    )


@dataclass(frozen=True, eq=False)
class ResidentTables:
    """Profiles, and tables of the profiles on the device: polynomials per cell that include the carrier.

    Attributes
    ----------
    samples
        (pulse, range) complex64.
    places_m
        (pulse, 2, 3) float64, phase centres of transmitter and receiver in the frame of the pixels.
    start_m
        (pulse,) float64, total path of sample 0 and of the centre of cell 0, metres.
    cell_m
        Total path across one cell, metres.
    wavenumber_rad_m
        2πf_mid/c.
    design
        Filters from samples to cells.
    error_db
        Predicted RMS error at random pixels for a profile with a flat spectrum, dB.
    pulses
        Slice of the pulses of these tables.
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
        """Return the tables of a slice of pulses, which use the same arrays on the device."""
        first, last, _ = pulses.indices(self.pulses.stop - self.pulses.start)
        start = self.pulses.start
        return replace(self, pulses=slice(start + first, start + max(first, last)))


def prepare(profiles: Profiles, *, oversampling: int = 6) -> ResidentTables:
    """Return the inputs of tables; the first tile creates the tables on the device.

    Parameters
    ----------
    profiles
        Band-limited profiles with at least eight samples beyond the scene at both ends.
    oversampling
        Table cells per Nyquist cell c/B of total path; `ResidentTables.error_db` is the predicted error.

    Returns
    -------
    ResidentTables
        Tables of pulses × cells × 24 bytes on the device.

    Raises
    ------
    ValueError
        If the oversampling of the profiles is below 1.5, if there is no pulse, or if a position or start is not finite.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells" and "A GPU".
    """
    samples, start_m, phase_centres = profiles.for_tables()
    wavenumber = profiles.wavenumber_rad_m
    design = design_table(profiles.oversampling, wavenumber * profiles.step_m, oversampling=oversampling, degree=DEGREE)
    return ResidentTables(
        samples=samples,
        places_m=np.ascontiguousarray(np.stack(phase_centres, axis=1)),
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
    """Sum the tables at the pixels of one tile.

    Parameters
    ----------
    tables
        Tables from `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres, on any surface. A tile of a larger grid that
        starts at multiples of 16 pixels is bit-identical to this part of the image of the larger grid.
    beams
        Weight of each pulse at each pixel (default: 1). Pulses for which beam or sector does not illuminate a patch
        require little time.
    tolerance_rad
        Largest phase error of the path series anywhere in a patch of 16 × 16 pixels. For patches and pulses that exceed
        this error, exact paths are computed pixel by pixel in float64.
    counts
        (4,) int64 array to which the numbers of pixel-pulse contributions are added: summed with path series, summed
        with exact paths, without an echo, and in chunks of 64 pulses without any echo, which require very little time.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses do not contribute to pixels that are not covered by their profiles; a pixel without a
        finite position is NaN.

    Raises
    ------
    ValueError
        If the shape of `pixels` is not (y, x, 3), or if a beam or the sector has a different number of pulses.
    CampaignError
        If no device can be used, or if the device fails.

    Notes
    -----
    Source: docs/theory/engine.md, "A GPU" and "Antennas"; docs/theory/integration.md.
    """
    pixels, beams = checked_pixels(pixels), beams and beams.on_profiles
    if beams is not None:
        beams.check_pulses(tables.pulses.stop - tables.pulses.start)
    if not pixels.size:
        return np.zeros(pixels.shape[:2], np.complex64)
    return sum_on_device(tables, pixels, beams, tolerance_rad, counts)
