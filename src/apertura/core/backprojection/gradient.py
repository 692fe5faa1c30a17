"""Gradient of an objective of an image with respect to phase centres and paths: the exact adjoint of its formation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import Echoes, job_of, pulses_at_once, tiles
from apertura.core.backprojection.engines.native_binding import available, call
from apertura.core.backprojection.inputs import Profiles


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of a real objective, pulse by pulse; all in the objective's unit per metre.

    Attributes
    ----------
    tx_m, rx_m
        (pulse, 3) float64, with respect to the phase centre of transmitter and receiver, in the frame of the phase
        centres. Where one node does both, its derivative is their sum.
    path_m
        (pulse,) float64, with respect to a path added to all echoes of a pulse (`Profiles.moved`).
    """

    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    path_m: NDArray[np.float64]


def path_gradient(
    profiles: Profiles, places_m: NDArray[np.float64], slope: NDArray[np.complexfloating], *, beams: Beams | None = None
) -> Gradient:
    """Return the derivatives of an objective of Σ w·s(R)·exp(+j2πf_mid·R/c), the sum over all pulses at each place.

    Parameters
    ----------
    profiles
        At least twice oversampled; they may be read on access.
    places_m
        (place, 3) float64, metres, in the frame of the phase centres.
    slope
        (place,) complex, G = ∂J/∂Re + j·∂J/∂Im: the objective changes by Re Σ G*·change of the sum.
    beams
        Weight of each pulse at each place; that it changes with the phase centres is neglected. None by default.

    Returns
    -------
    Gradient
        Exact for the sum as `block_contributions` forms it, rounded to float32 for each pulse and place.

    Raises
    ------
    ValueError
        If shapes differ, or places or slopes are not finite.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 6 to 8. Without the compiled library numpy does the same.
    """
    if places_m.shape != (*slope.shape, 3) or slope.ndim != 1:
        raise ValueError(f"{places_m.shape=}, {slope.shape=}: must be (place, 3) and (place,)")
    if not (np.isfinite(places_m).all() and np.isfinite(slope).all()):
        raise ValueError("places and the objective's slopes there must be finite")
    derivatives, largest = np.zeros((7, len(profiles))), float(np.abs(slope).max(initial=0.0))
    if largest:
        # The library takes float32: an objective's own unit must not push it out of range.
        places_m, slope = np.ascontiguousarray(places_m, np.float64), (slope / largest).astype(np.complex64)
        for first in range(0, len(profiles), pulses_at_once(profiles)):
            part = slice(first, min(first + pulses_at_once(profiles), len(profiles)))
            derivatives[:, part] = _of_pulses(profiles, part, places_m, slope, beams) * largest
    return Gradient(derivatives[:3].T.copy(), derivatives[3:6].T.copy(), derivatives[6])


def _of_pulses(
    profiles: Profiles,
    part: slice,
    places_m: NDArray[np.float64],
    slope: NDArray[np.complex64],
    beams: Beams | None,
) -> NDArray[np.float64]:
    """Return (7, pulse): of transmitter, receiver and path."""
    echoes = Echoes.read(profiles, [part])
    derivatives = np.zeros((7, len(echoes)))
    add = _add_compiled if available() else _add
    for tile in [slice(None)] if beams is None else tiles(len(places_m), len(echoes)):
        weight = np.ones((1, len(echoes)), np.float32)
        if beams is not None:
            weight = beams[part].weight(profiles.aperture[part], places_m[tile]).T.astype(np.float32, order="C")
        add(echoes, places_m[tile], slope[tile], weight, derivatives)
    return derivatives


def _add_compiled(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    slope: NDArray[np.complex64],
    weight: NDArray[np.float32],
    derivatives: NDArray[np.float64],
) -> None:
    job = job_of(echoes, places_m, weight)
    job.objective, job.slopes = slope.ctypes.data, derivatives.ctypes.data
    call("apertura_differentiate", job)


def _add(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    slope: NDArray[np.complex64],
    weight: NDArray[np.float32],
    derivatives: NDArray[np.float64],
) -> None:
    weight = np.broadcast_to(weight, (len(places_m), len(echoes)))
    for tile in tiles(len(places_m), len(echoes)):
        of_path = (np.conj(slope[tile]) * echoes.at(places_m[tile])[1]).real * weight[tile].T
        for axis, leg in ((0, echoes.tx_m), (3, echoes.rx_m)):
            offset_m = leg.T[:, None] - places_m[tile]
            direction = offset_m / np.linalg.norm(offset_m, axis=-1, keepdims=True)
            derivatives[axis : axis + 3] += np.einsum("px,pxa->ap", of_path, direction)
        derivatives[6] -= of_path.sum(axis=1)
