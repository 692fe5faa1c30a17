"""What the compiled library takes, field by field as in native/job.hpp and native/tree_job.hpp."""

import ctypes

_pointer = ctypes.c_void_p
_int64 = ctypes.c_int64
_double = ctypes.c_double

TREE_NODES, TREE_SLOTS, TREE_LEVELS, TREE_GROUP, TREE_SIDE, TREE_DELAYS, TREE_FEWER = 128, 136, 4, 64, 256, 12, 28
TREE_TERMS, TREE_MORE, TREE_WEIGHTS = 21, 4, 16
"""As in native/tree_job.hpp: nodes along an axis; places of them and of pixels; levels; pulses of
a leaf; pixels along a tile; taps that align a pulse; pulses that stand for those of a leaf, at most."""


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

    _fields_ = [("axis", _pointer * 2), *((name, _double) for name in ("centre", "inner", "outer"))]


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


class TreeTile(ctypes.Structure):
    """native/tree_job.hpp, TreeTile."""

    _fields_ = [
        *((name, _pointer) for name in ("surface", "pixels", "image", "weight", "way", "nodes", "fewer")),
        ("centre", _double * 3),
        ("rest", _double),
        ("first_path", _double),
        *((name, _int64) for name in ("degree", "rows", "columns", "row_slot", "column_slot", "samples", "top")),
    ]


class TreeJob(ctypes.Structure):
    """native/tree_job.hpp, TreeJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "start", "transmitter", "receiver", "stray", "rough", "track")),
        *((name, _pointer) for name in ("taps", "delay", "presum", "curve", "supports", "places", "spread", "mix")),
        ("tiles", _pointer),
        *((name, _int64) for name in ("pulses", "length", "up", "lead", "stride", "count", "levels", "mono")),
        *((name, _int64) for name in ("phase_polynomial", "taps_count", "delay_terms")),
        ("sizes", _int64 * TREE_LEVELS),
        *((name, _double) for name in ("step", "wavenumber", "band", "smooth")),
        ("phase_coefficients", ctypes.c_float * 9),
    ]


STRUCTS = (BeamJob, SectorJob, ApertureJob, TableJob, EchoJob, TreeTile, TreeJob)
"""All of them."""
