"""The GPU itself: whether there is one, what it is, and arrays there and back; numba.cuda is imported when one is used.

One call is on the device at a time: threads that form tiles take turns at its lock, and wait for it without the GIL.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.focus.engines.cuda_constants import SIDE
from apertura.core.focus.engines.cuda_prediction import simulated
from apertura.core.focus.engines.native_tables import PHASE_POLYNOMIALS

if TYPE_CHECKING:
    from apertura.core.focus.engines.cuda import Tables

_LOCK = Lock()
_THREADS = 128  # of a block that fills tables


@cache
def available() -> bool:
    """Return whether a device can be used, or numba's simulator is asked for; never raises.

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
    except Exception:  # whatever of driver, toolkit and package is missing or does not fit the others
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
    except PackageNotFoundError:  # numba brought a numba.cuda of its own
        by = f"numba {version('numba')}"
    if simulated():
        return f"cuda: simulator of {by}"
    device = cuda.get_current_device()
    name = device.name.decode() if isinstance(device.name, bytes) else device.name
    return f"cuda: {name}, compute capability {'.'.join(map(str, device.compute_capability))}, {by}"


class Resident:
    """What all slices of one engine's tables have on the device, once the first tile is formed; it is not pickled."""

    def __init__(self) -> None:
        self.arrays: tuple[Any, ...] | None = None

    def __reduce__(self) -> tuple[type["Resident"], tuple[()]]:
        return Resident, ()


def sum_there(tables: "Tables", pixels: NDArray[np.float64], tolerance_rad: float) -> NDArray[np.complex64]:
    """Return what `apertura.core.focus.engines.cuda.form` returns, of one or more pixels.

    Raises
    ------
    CampaignError
        If no device can be used, or it fails.
    """
    with _device() as cuda:
        from apertura.core.focus.engines.cuda_kernels import ROWS, form

        if tables.resident.arrays is None:
            tables.resident.arrays = _tables_there(cuda, tables)
        places, start_m, cells = (array[tables.pulses] for array in tables.resident.arrays)
        scales = (1 / tables.cell_m, tables.wavenumber_rad_m, tolerance_rad, cells.shape[2])
        numbers = np.array([*scales, *tables.design.phase_coefficients], np.float64)
        if not PHASE_POLYNOMIALS[tables.design.phase_polynomial][2]:
            numbers[-1] = 0  # no half turns are taken off
        rows, columns = pixels.shape[:2]
        image = cuda.device_array((rows, columns), np.complex64)
        patches = (-(-columns // SIDE), -(-rows // SIDE))
        form[patches, (SIDE, ROWS)](cuda.to_device(pixels), places, start_m, cells, cuda.to_device(numbers), image)
        return np.asarray(image.copy_to_host())


def _tables_there(cuda: Any, tables: "Tables") -> tuple[Any, ...]:
    """Return phase centres, starts and cells of all pulses on the device."""
    from apertura.core.focus.engines.cuda_cells import expand

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
    """Give numba.cuda while nobody else uses the device; what it fails by becomes one message."""
    if not available():
        raise _unfit("no device can be used")
    from numba import cuda
    from numba.cuda.cudadrv.driver import CudaAPIError, LinkerError

    with _LOCK:
        try:
            yield cuda
        except (CudaAPIError, LinkerError, ImportError) as error:  # the last: driver or compiler is not to be found
            raise _unfit(f"the device failed: {' '.join(str(error).split())}") from error


def _unfit(found: str) -> CampaignError:
    return CampaignError(
        f"engine cuda: {found}",
        where="processing.engine",
        expected="an NVIDIA GPU with its driver and memory for a block of pulses (docs/howto/gpu.md)",
        remedy="Choose engine native or numba, or free the device.",
    )
