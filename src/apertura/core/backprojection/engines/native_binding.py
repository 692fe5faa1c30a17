"""ctypes binding of the compiled library: structures, sizes and error bounds, instruction sets."""

import ctypes
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted, shown
from apertura.core.antenna.beam import Beam, Beams
from apertura.core.geometry.sector import Sector

# ---- Sizes and error bounds of the compiled kernel
# The planner requires these values even if the engine is not compiled; a test compares them with those of the library.


@dataclass(frozen=True)
class KernelConstants:
    """Sizes and error bounds of the kernel.

    D is the largest distance of a block from the origin of its patch, δ is the largest distance of a pixel from the
    centre of its block, and R is the range. Errors refer to the one-way path, in the unit of D, δ and R.

    Attributes
    ----------
    patch_side, block_side
        Number of pixels along a patch, over which paths are series about the origin of the patch; and number of pixels
        along a block, over which a path is one polynomial.
    batch
        Number of pulses for which paths are computed together; phase centres are padded to a multiple of this number.
    taps
        Number of taps of the table filters.
    window
        Number of table cells within reach of one look-up; tables have the same number of empty cells at each end.
    echo_taps, echo_degree
        Number of samples used for an echo at a single point, and degree of the weight polynomials of these samples
        (docs/theory/autofocus.md, "What pulses add").
    term_taps
        Number of samples used for an echo in float64, for certificates.
    window_margin
        Margin of a window, cells: a path lies up to ½ cell beyond the cell to which it is rounded; the remainder
        accounts for float32 rounding.
    fifth_order
        Factor of D⁵/R⁴. Order n of |w + d| is at most max |P_{n-2} − P_n| / (2n − 1) · dⁿ/Rⁿ⁻¹, that is, 0.083 for
        n = 5; the factor includes a margin for higher orders.
    third_order
        Factor of δ³/R²: 1/(3√3).
    shared_curvature_error
        Factor of Dδ²/R² if all blocks of a patch share one curvature: three terms of 1/(3√3).
    own_curvature_error
        Factor of D²δ²/R³ if each block has its own curvature: a tenth of the six terms of 1/8, because the curvature of
        the block includes the remainder.
    curvature_span
        Second-order terms displace a pixel of a block by at most 1.5² times their coefficients; twice this value is a
        bound for all blocks.
    weight_change, weight_curvature
        Largest first and second differences of antenna weights between the nodes of a patch, relative to the peak of
        the beam, for which the weights are represented by a polynomial.
    sector_bend
        Largest curvature, within a block, of the position of a pixel in the edge of a sector, relative to the width of
        the edge, for which the position is represented by a linear function.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths", "Look-ups" and "Antennas".
    """

    patch_side: int = 16
    block_side: int = 4
    batch: int = 8
    taps: int = 16
    window: int = 16
    echo_taps: int = 8
    echo_degree: int = 4
    term_taps: int = 24
    window_margin: float = 0.51
    fifth_order: float = 0.14
    third_order: float = 0.19
    shared_curvature_error: float = 0.58
    own_curvature_error: float = 0.075
    curvature_span: float = 4.5
    weight_change: float = 0.12
    weight_curvature: float = 0.025
    sector_bend: float = 0.002


KERNEL = KernelConstants()


@dataclass(frozen=True)
class TreeConstants:
    """Sizes of subaperture trees, as in native/tree_job.hpp.

    Attributes
    ----------
    nodes, side, levels
        Largest numbers of nodes and of pixels along an axis of a tile, and of levels of a tree.
    slots
        Number of slots for node counts, followed by slots for the sides of tiles in pixels, to which nodes are
        interpolated.
    leaf
        Number of pulses of a leaf, which are all summed by the same variant.
    virtual, virtual_margin
        Largest number of virtual pulses of a leaf, and excess of this number over the degree of the curve on which the
        virtual pulses lie.
    terms
        Number of polynomials of the track over a leaf: one more than the highest degree of a curve.
    degree
        Degree of a nonplanar surface of a tile.
    delays
        Number of taps of the filter that aligns a pulse to a tile.
    weights
        Number of coefficients of the antenna gain over a tile.
    weighted_rad
        Additional band at the nodes of a tile due to smooth weights, rad per half tile.
    """

    nodes: int = 128
    side: int = 256
    levels: int = 4
    slots: int = 136
    leaf: int = 64
    virtual: int = 28
    virtual_margin: int = 4
    terms: int = 21
    degree: int = 6
    delays: int = 12
    weights: int = 16
    weighted_rad: float = 1.5


TREE = TreeConstants()


BY_TREE, DIRECTLY, NO_ECHO = range(3)
"""Variants of the sum of a group of pulses over a tile: native/tree_job.hpp, TreeVariant."""


# ---- Structures of the compiled library

_pointer = ctypes.c_void_p
_int64 = ctypes.c_int64
_double = ctypes.c_double


class BeamJob(ctypes.Structure):
    """native/job.hpp, BeamJob."""

    _fields_ = [
        ("axes", _pointer),
        ("gain", _pointer * 2),
        ("count", _int64 * 2),
        ("first_rad", _double * 2),
        ("samples_per_rad", _double * 2),
        ("peak", _double),
    ]


class SectorJob(ctypes.Structure):
    """native/job.hpp, SectorJob."""

    _fields_ = [
        ("axis", _pointer * 2),
        *((name, _double) for name in ("centre", "inner", "outer")),
        *((name, _pointer * 2) for name in ("end", "end_axis")),
        ("ends", _int64),
    ]


class ApertureJob(ctypes.Structure):
    """native/job.hpp, ApertureJob."""

    _fields_ = [
        *((name, _pointer) for name in ("cells", "transmitter", "receiver", "first_path", "pixels")),
        *((name, _pointer) for name in ("image", "counts")),
        *((name, _int64) for name in ("pulses", "padded", "width", "rows", "columns")),
        *((name, _double) for name in ("cells_per_metre", "radians_per_cell", "tolerance_rad")),
        *((name, ctypes.c_int32) for name in ("degree", "phase_polynomial", "wide_sum")),
        ("phase_coefficients", ctypes.c_float * 9),
        ("beam", ctypes.POINTER(BeamJob) * 2),
        ("sector", ctypes.POINTER(SectorJob)),
    ]


class TableJob(ctypes.Structure):
    """native/job.hpp, TableJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "taps", "lead", "carrier", "turn", "cells")),
        *((name, _int64) for name in ("pulses", "length", "width", "up", "down", "steps", "margin", "used")),
        ("degree", ctypes.c_int32),
    ]


class EchoJob(ctypes.Structure):
    """native/job.hpp, EchoJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "taps", "transmitter", "receiver", "start", "weight", "pixels")),
        *((name, _pointer) for name in ("edges", "columns", "sums", "objective", "slopes")),
        *((name, _int64) for name in ("pulses", "length", "count", "blocks", "width", "weight_step")),
        *((name, _double) for name in ("samples_per_metre", "turns_per_metre")),
    ]


class TermsJob(ctypes.Structure):
    """native/job.hpp, TermsJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "weights", "transmitter", "receiver", "start", "pixels", "terms")),
        *((name, _int64) for name in ("pulses", "length", "count", "fractions")),
        *((name, _double) for name in ("step", "turns_per_metre")),
    ]


class TreeTile(ctypes.Structure):
    """native/tree_job.hpp, TreeTile."""

    _fields_ = [
        *((name, _pointer) for name in ("surface", "pixels", "image", "weight", "variant", "nodes")),
        *((name, _pointer) for name in ("n_virtual_pulses", "edge", "slope", "band", "turn")),
        ("centre", _double * 3),
        ("rest", _double),
        *((name, _double) for name in ("first_path", "span", "slope_rms")),
        *((name, _int64) for name in ("degree", "rows", "columns", "row_slot", "column_slot", "samples", "top")),
    ]


class TreeJob(ctypes.Structure):
    """native/tree_job.hpp, TreeJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "start", "transmitter", "receiver")),
        *((name, _pointer) for name in ("max_track_residual", "rms_track_residual", "track")),
        *((name, _pointer) for name in ("taps", "delay", "presum", "curve", "supports", "places", "spread", "mix")),
        ("tiles", _pointer),
        *((name, _int64) for name in ("pulses", "length", "up", "lead", "stride", "count", "levels", "mono")),
        *((name, _int64) for name in ("phase_polynomial", "taps_count", "delay_terms")),
        ("sizes", _int64 * TREE.levels),
        ("curve_degrees", _int64 * 4),
        *((name, _double) for name in ("step", "wavenumber", "band", "presum_error", "node_error")),
        ("beam", ctypes.POINTER(BeamJob) * 2),
        ("sector", ctypes.POINTER(SectorJob)),
        ("phase_coefficients", ctypes.c_float * 9),
    ]


STRUCTS = (BeamJob, SectorJob, ApertureJob, TableJob, EchoJob, TermsJob, TreeTile, TreeJob)
"""All structures."""


# ---- Loading the compiled library
#
# The library is bound with ctypes, so that the GIL is released during a call and one wheel supports every Python
# version. The library reports the layout of its structs. A library with a different layout is rejected on loading.

INSTRUCTION_SETS = ("avx512", "avx2", "portable")

NAMED_BY = "APERTURA_KERNEL"
"""Environment variable: path of a library that replaces the installed one."""

# Resolved only once, because calls may be short.
_BUILT = Path(str(files("apertura.core.backprojection.engines") / "_backprojection.so"))


def layout() -> dict[str, str]:
    """Return the layout of the structs of this module: field → offset and size; struct → size.

    Examples
    --------
    >>> layout()["ApertureJob.transmitter"]
    'byte 8, 8 bytes'
    """
    lines: dict[str, str] = {}
    for struct in STRUCTS:
        for name, *_ in struct._fields_:
            field = getattr(struct, name)
            lines[f"{struct.__name__}.{name}"] = _extent(field.offset, field.size)
        lines[struct.__name__] = _extent(0, ctypes.sizeof(struct))
    return lines


def _extent(offset: int, size: int) -> str:
    return f"byte {offset}, {size} bytes"


def check_layout(theirs: dict[str, str], path: Path) -> None:
    """Reject a library whose structs differ from those of this module.

    Parameters
    ----------
    theirs
        Layout reported by the library, in the form of `layout`.
    path
        Path of the library.

    Raises
    ------
    CampaignError
        For the first field that differs, with both layouts.
    """
    ours = layout()
    for name in [*ours, *(theirs.keys() - ours.keys())]:
        if ours.get(name) != theirs.get(name):
            raise CampaignError(
                f"{name}: {theirs.get(name, 'no such field')}",
                where=str(path),
                expected=f"{name}: {ours.get(name, 'no such field')}, as in native_binding.py of apertura",
                remedy="Reinstall apertura to obtain the library of the same version, and unset APERTURA_KERNEL.",
            )


def available() -> bool:
    """Return True if the kernel was compiled at the installation of the package.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    return library_path().is_file()


def instruction_set() -> str:
    """Return the instruction set in use: the best one on this machine, or the one requested by APERTURA_ISA.

    Raises
    ------
    RuntimeError
        If the kernel was not compiled.
    CampaignError
        If APERTURA_ISA is unknown or not supported by this machine.

    Examples
    --------
    >>> not available() or instruction_set() in INSTRUCTION_SETS
    True
    """
    requested = os.environ.get("APERTURA_ISA", "")
    if requested and requested not in INSTRUCTION_SETS:
        raise _unsupported(requested, f"one of {', '.join(INSTRUCTION_SETS)}, or unset")
    chosen = library().apertura_isa(requested.encode())
    if chosen is None:
        raise _unsupported(requested, "an instruction set that this machine supports")
    return str(chosen.decode())


def supports(isa: str) -> bool:
    """Return True if the kernel was compiled and this machine supports the named instruction set."""
    return available() and library().apertura_isa(isa.encode()) is not None


def _unsupported(requested: str, expected: str) -> CampaignError:
    return CampaignError(
        f"{requested!r}", where="environment variable APERTURA_ISA", expected=expected, remedy="Unset the variable."
    )


def call(function: str, job: ctypes.Structure) -> None:
    """Run `function` of the library on `job` with the GIL released.

    Raises
    ------
    MemoryError
        If the library cannot allocate its work memory.
    RuntimeError
        If the function fails for another reason.
    """
    status = getattr(library(), function)(instruction_set().encode(), ctypes.byref(job))
    if status == 1:
        raise MemoryError(f"{function}: the work memory cannot be allocated")
    if status:
        raise RuntimeError(f"{function} failed with status {status}")


def library_path() -> Path:
    """Return the path of the compiled library: the installed one, or APERTURA_KERNEL, for instance with sanitizers.

    Raises
    ------
    CampaignError
        If APERTURA_KERNEL is not an existing file, or if it is a relative path: processes may have different working
        directories.
    """
    named = os.environ.get(NAMED_BY)
    if not named:
        return _BUILT
    if not (Path(named).is_absolute() and Path(named).is_file()):
        raise _no_kernel(named, "no such file" if Path(named).is_absolute() else "relative path")
    return Path(named)


def _no_kernel(named: str, found: str) -> CampaignError:
    where = f"environment variable {NAMED_BY}"
    expected = "the absolute path of a library built from native/ of this version"
    return CampaignError(f"{quoted(named)}: {found}", where=where, expected=expected, remedy="Unset the variable.")


def library() -> ctypes.CDLL:
    """Return the compiled library.

    Raises
    ------
    RuntimeError
        If the library was not compiled.
    CampaignError
        If the layout of the structs of the library differs from that of this module.
    """
    return _load(library_path())


def kernel_constants() -> dict[str, float]:
    """Return the constants of the compiled library by name (native/bounds.hpp, native/tree_job.hpp).

    Examples
    --------
    >>> not available() or kernel_constants()["window"] == 16
    True
    """
    return {name: float(value) for name, value in _lines(library().apertura_constants)}


@lru_cache
def _load(path: Path) -> ctypes.CDLL:
    if not path.is_file():
        raise RuntimeError(
            "the compiled kernel is missing: install a C++ compiler and reinstall apertura, or use engine numba"
        )
    try:
        loaded = ctypes.CDLL(str(path))
    except OSError as error:
        raise _no_kernel(str(path), shown(error, 200)) from error
    if not hasattr(loaded, "apertura_layout"):
        check_layout({}, path)
    for function in (loaded.apertura_isa, loaded.apertura_layout, loaded.apertura_constants):
        function.restype = ctypes.c_char_p
    loaded.apertura_isa.argtypes = [ctypes.c_char_p]
    check_layout({name: _extent(int(at), int(size)) for name, at, size in _lines(loaded.apertura_layout)}, path)
    return loaded


def _lines(function: Callable[[], bytes]) -> list[list[str]]:
    return [line.split() for line in function().decode().splitlines()]


# ---- Beams and sectors as structures

KeptArrays = list[NDArray[np.generic]]
"""Arrays referenced by a struct, which must remain in memory while the struct is used."""


def weights_of(beams: Beams | None, pulses: int, padded: int) -> tuple[Any, Any, KeptArrays]:
    """Return the pointers `beam` and `sector` of a job, and the arrays that they reference.

    Parameters
    ----------
    beams
        Beams of the same number of pulses.
    pulses, padded
        Number of pulses of the tables, without and with padding to a batch.

    Raises
    ------
    ValueError
        If a beam or the sector has a different number of pulses.
    """
    beams = beams or Beams()
    beams.check_pulses(pulses)
    pointers, kept = (ctypes.POINTER(BeamJob) * 2)(), KeptArrays()
    for leg, beam in enumerate((beams.transmit, beams.receive)):
        if beam is not None:
            job, arrays = _beam(beam, padded)
            pointers[leg] = ctypes.pointer(job)
            kept += arrays
    if beams.sector is None:
        return pointers, None, kept
    sector, arrays = _sector(beams.sector, padded)
    return pointers, ctypes.pointer(sector), kept + arrays


def _beam(beam: Beam, padded: int) -> tuple[BeamJob, KeptArrays]:
    axes = np.ascontiguousarray(np.moveaxis(_padded(beam.axes, padded), 0, -1), np.float64)
    angles = (beam.azimuth_rad, beam.elevation_rad)
    gains = [np.ascontiguousarray(gain, np.float32) for gain in (beam.azimuth_gain, beam.elevation_gain)]
    job = BeamJob(
        axes.ctypes.data,
        (ctypes.c_void_p * 2)(*(gain.ctypes.data for gain in gains)),
        (ctypes.c_int64 * 2)(*(gain.size for gain in gains)),
        (ctypes.c_double * 2)(*(angle[0] for angle in angles)),
        (ctypes.c_double * 2)(*((angle.size - 1) / (angle[-1] - angle[0]) for angle in angles)),
        float(np.prod([np.abs(gain).max() for gain in gains])),
    )
    return job, [axes, *gains]


def _padded(axes: NDArray[np.float64], padded: int) -> NDArray[np.float64]:
    """Return the axes padded to `padded` pulses by repeating the axes of the last pulse."""
    return np.concatenate([axes, np.repeat(axes[-1:], padded - len(axes), axis=0)]) if padded > len(axes) else axes


def _sector(sector: Sector, padded: int) -> tuple[SectorJob, KeptArrays]:
    axes = [np.ascontiguousarray(_padded(axis, padded).T, np.float64) for axis in (sector.tx_axis, sector.rx_axis)]
    at = [] if sector.ends is None else [*sector.ends[0].legs, sector.ends[1].tx_axis, sector.ends[1].rx_axis]
    kept: KeptArrays = [*axes, *(np.ascontiguousarray(array, np.float64) for array in at)]
    pair, pointers = ctypes.c_void_p * 2, [array.ctypes.data for array in kept]
    fields = pair(*pointers[:2]), sector.centre, sector.inner, sector.outer, pair(*pointers[2:4]), pair(*pointers[4:])
    return SectorJob(*fields, len(at[0]) if at else 0), kept
