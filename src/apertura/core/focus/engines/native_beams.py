"""Beams and sectors as the compiled engine reads them."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beam, Beams
from apertura.core.focus.engines.native_structs import BeamJob, SectorJob
from apertura.core.geometry.sector import Sector

Held = list[NDArray[np.generic]]
"""Arrays that a struct points into: they must live as long as it is used."""


def weights_of(beams: Beams | None, pulses: int, padded: int) -> tuple[Any, Any, Held]:
    """Return the pointers `beam` and `sector` of an `ApertureJob`, and what they point into.

    Parameters
    ----------
    beams
        Over as many pulses.
    pulses, padded
        Of the tables, without and with those that fill a batch.

    Raises
    ------
    ValueError
        If a beam or the sector is of other pulses.
    """
    beams = beams or Beams()
    pointers, held = (ctypes.POINTER(BeamJob) * 2)(), Held()
    for leg, beam in enumerate((beams.transmit, beams.receive)):
        if beam is not None:
            job, arrays = _beam(beam, pulses, padded)
            pointers[leg] = ctypes.pointer(job)
            held += arrays
    if beams.sector is None:
        return pointers, None, held
    sector, arrays = _sector(beams.sector, pulses, padded)
    return pointers, ctypes.pointer(sector), held + arrays


def _beam(beam: Beam, pulses: int, padded: int) -> tuple[BeamJob, Held]:
    if len(beam.axes) != pulses:
        raise ValueError(f"{len(beam.axes)=}: must be one for each of {pulses} pulses")
    axes = np.pad(beam.axes, [(0, padded - pulses), (0, 0), (0, 0)], mode="edge")
    axes = np.ascontiguousarray(np.moveaxis(axes, 0, -1), np.float64)
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


def _sector(sector: Sector, pulses: int, padded: int) -> tuple[SectorJob, Held]:
    if len(sector.tx_axis) != pulses:
        raise ValueError(f"{len(sector.tx_axis)=}: must be one for each of {pulses} pulses")
    filling = [(0, padded - pulses), (0, 0)]
    axes = [
        np.ascontiguousarray(np.pad(axis, filling, mode="edge").T, np.float64)
        for axis in (sector.tx_axis, sector.rx_axis)
    ]
    pointers = (ctypes.c_void_p * 2)(*(axis.ctypes.data for axis in axes))
    return SectorJob(pointers, sector.centre, sector.inner, sector.outer), [*axes]
