"""Sums of the images of one flight: choice of coherent pairs, sums, and clutter reduction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

# ---- Clutter reduction


def clutter_reduction_db(single_db: Sequence[float], coherent_db: float) -> float:
    """Return by how much clutter lies lower, against the peak, in a coherent sum than in its images.

    Parameters
    ----------
    single_db
        (pair,) clutter of each image of the sum: its median power over its peak power, dB.
    coherent_db
        The same of the sum.

    Returns
    -------
    float
        dB; 10 lg of the number of images where the targets add in phase and the clutter does not, 0 where the images
        show one thing, less where targets do not add in phase.

    Raises
    ------
    ValueError
        If there is no image.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 3.

    Examples
    --------
    >>> round(clutter_reduction_db([-40.0, -40.0], -43.01), 2)
    3.01
    """
    if not single_db:
        raise ValueError("no image: a sum of nothing reduces nothing")
    return float(10 * np.log10(np.mean(10 ** (np.asarray(single_db) / 10))) - coherent_db)


# ---- Choice of the pairs that are added coherently


class Phase(Protocol):
    """Phase of a pair against the reference."""

    @property
    def phase_rad(self) -> float: ...  # noqa: D102
    @property
    def phase_std_rad(self) -> float: ...  # noqa: D102
    @property
    def coherence(self) -> float: ...  # noqa: D102
    @property
    def points(self) -> int: ...  # noqa: D102
    @property
    def out_of_phase(self) -> bool: ...  # noqa: D102


LEAST_COHERENCE = 0.5
"""Mean phasor over common points, 0 to 1: below it phases scatter too much for a constant phase to correct."""


@dataclass(frozen=True)
class CoherentSum:
    """The pairs of a coherent sum.

    Attributes
    ----------
    phases_rad
        Pair → phase removed before it is added; 0 where none was requested or needed.
    left_out
        Pair → why it is only in the sums without phase.
    why
        Pair → why it is in, in one line.
    """

    phases_rad: Mapping[str, float]
    left_out: Mapping[str, str]
    why: Mapping[str, str]

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        phases = {pair: round(phase, 4) for pair, phase in self.phases_rad.items()}
        return {"phases_rad": phases, "left_out": dict(self.left_out), "why": dict(self.why)}


def choose_fusion(
    reference: str, measured: Mapping[str, Phase | None], *, unfit: Mapping[str, str], align: bool
) -> CoherentSum:
    """Return which pairs add coherently to the reference.

    Parameters
    ----------
    reference
        The pair that others are measured against.
    measured
        Every other pair → its phase against the reference at bright points; None where they share none.
    unfit
        Pairs that show other places than the reference → why.
    align
        Whether a constant phase is removed.

    Examples
    --------
    >>> choose_fusion("a-a", {"a-b": None}, unfit={}, align=False).phases_rad
    {'a-a': 0.0, 'a-b': 0.0}
    """
    phases, left_out, why = {reference: 0.0}, {}, {reference: "the others are measured against it"}
    for pair, phase in measured.items():
        if pair in unfit:
            left_out[pair] = unfit[pair]
        elif phase is None:
            phases[pair], why[pair] = 0.0, f"phase not measured: no bright point in common with {reference}"
        else:
            line = f"{phase.phase_rad:+.2f} ± {phase.phase_std_rad:.2f} rad at {phase.points} bright points"
            if phase.coherence < LEAST_COHERENCE:
                left_out[pair] = f"{line}, coherence {phase.coherence:.2f}: no common phase"
            elif align:
                phases[pair], why[pair] = phase.phase_rad, f"{line}, taken off"
            elif phase.out_of_phase:
                left_out[pair] = f"{line}; processing.fusion.align_phase takes it off"
            else:
                phases[pair], why[pair] = 0.0, line
    return CoherentSum(phases, left_out, why)


# ---- Sums


def coherent_sum(
    images: NDArray[np.complex64], peaks: NDArray[np.float64], phases_rad: NDArray[np.float64] | float = 0.0
) -> NDArray[np.complex64]:
    """Return the complex mean of peak-normalised images.

    Their spectra lie side by side, so the sum resolves finer than either: mono- and bistatic images add in phase
    once sidelink and path offsets are right (docs/theory.md, eq. 7).

    Parameters
    ----------
    images
        (pair, y, x) complex64 on one grid or a block of it, carriers kept; NaN where no pulse of a pair illuminates
        the pixel: it adds nothing.
    peaks
        (pair,) float64, largest magnitude of each whole image.
    phases_rad
        (pair,) float64, removed from each image first.

    Returns
    -------
    ndarray
        (y, x) complex64, 1 where every image peaks in phase, NaN where no pair illuminates the pixel.

    Raises
    ------
    ValueError
        If an image is empty.

    Examples
    --------
    >>> coherent_sum(np.array([[[2.0, 0.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0])).round(3)
    array([[0.5+0.5j, 0. +0.j ]], dtype=complex64)
    """
    rotation = np.exp(-1j * np.asarray(phases_rad)).astype(np.complex64)
    return np.asarray(_mean(_normalised(images, peaks) * rotation.reshape(-1, 1, 1)), np.complex64)


def noncoherent_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean power of peak-normalised images: no gain in resolution, less speckle, no phase errors.

    Parameters and errors as `coherent_sum`; returns (y, x) float32, linear power.

    Examples
    --------
    >>> noncoherent_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.   , 0.125]], dtype=float32)
    """
    power = np.abs(_normalised(images, peaks)).astype(np.float64) ** 2
    return np.asarray(_mean(power), np.float32)


def magnitude_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean magnitude of peak-normalised images, the paper's sum without phase.

    Parameters and errors as `coherent_sum`; returns (y, x) float32.

    Examples
    --------
    >>> magnitude_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.  , 0.25]], dtype=float32)
    """
    return np.asarray(_mean(np.abs(_normalised(images, peaks))), np.float32)


def _mean(images: NDArray[Any]) -> NDArray[Any]:
    """Return the mean over all pairs; one without a value at a pixel counts as zero, and NaN if none has one."""
    missing = np.isnan(images)
    mean: NDArray[Any] = np.where(missing, 0, images).mean(axis=0)
    mean[missing.all(axis=0)] = np.nan
    return mean


def _normalised(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.complex64]:
    if not (peaks > 0).all():
        raise ValueError(f"{peaks=}: an empty image adds nothing; leave its pair out")
    return np.asarray(images / peaks[:, None, None], np.complex64)
