"""Contributions of pulses and pulse blocks at single points, and their derivatives, for certificates and autofocus."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.native_binding import KERNEL, EchoJob, TermsJob, available, call
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import distance
from apertura.core.windowed_sinc import kaiser_sinc

# ---- Contributions of profiles by band-limited interpolation in float64

_HALF_TAPS = KERNEL.term_taps // 2
# shape parameter of the window: the error is below -148 dB with `_HALF_TAPS` and half of the band as transition
_KAISER_BETA = 16.0
_FRACTIONS = 4096  # number of tabulated weights per sample; with linear interpolation, the error of a weight is 3e-8
_PULSES_AT_ONCE = 256  # number of pulses for which terms are in memory at once
_ROWS_AT_ONCE = 16  # number of pulses for which numpy gathers samples at once, so that these fit into the cache


def band_limited_image(
    profiles: Profiles, pixels: NDArray[np.float64], *, beams: Beams | None = None
) -> NDArray[np.complex128]:
    """Return the sum of `band_limited_terms` over the pulses, (pixel,) complex128."""
    image = np.zeros(len(pixels), np.complex128)
    for first in range(0, len(profiles), _PULSES_AT_ONCE):
        part = slice(first, first + _PULSES_AT_ONCE)
        image += band_limited_terms(profiles[part], pixels, beams=beams and beams[part]).sum(axis=0)
    return image


def band_limited_terms(
    profiles: Profiles, pixels: NDArray[np.float64], *, beams: Beams | None = None
) -> NDArray[np.complex128]:
    """Return p(ρ)·exp(+j2πf_mid ρ/c) of each pulse at each pixel, with p interpolated by a long windowed sinc.

    Parameters
    ----------
    profiles
        Profiles with an oversampling of at least 2 and with at least 12 samples beyond the scene at both ends; samples
        outside the profiles are zero.
    pixels
        (pixel, 3) float64, metres, in the frame of the phase centres.
    beams
        Antenna weight of each pulse at each pixel (default: 1).

    Returns
    -------
    ndarray
        (pulse, pixel) complex128; NaN where a pixel is not finite.

    Notes
    -----
    Source: docs/theory.md, eq. 6. The error is -148 dB for a tone at the band edge. The computation is in float64 and
    independent of all engines. If the compiled library is not available, numpy is used.
    """
    terms = (_compiled_terms if available() else _terms)(profiles, np.ascontiguousarray(pixels, np.float64))
    if weights := beams and beams.on_profiles:
        terms *= weights.weight(profiles.aperture, pixels)
    return terms


def _compiled_terms(profiles: Profiles, pixels: NDArray[np.float64]) -> NDArray[np.complex128]:
    terms = np.empty((len(profiles), len(pixels)), np.complex128)
    samples = np.ascontiguousarray(profiles.samples, np.complex64)
    inputs = (*profiles.aperture.legs, profiles.start_m, pixels)
    geometry = [np.ascontiguousarray(values, np.float64) for values in inputs]
    arrays: list[NDArray[Any]] = [samples, _paired_weights(), *geometry, terms]
    job = TermsJob(
        *(array.ctypes.data for array in arrays),
        pulses=len(profiles),
        length=samples.shape[1],
        count=len(pixels),
        fractions=_FRACTIONS,
        step=profiles.step_m,
        turns_per_metre=profiles.centre_frequency_hz / profiles.wave_speed_m_s,
    )
    call("apertura_terms", job)
    return terms


def _terms(profiles: Profiles, pixels: NDArray[np.float64]) -> NDArray[np.complex128]:
    k = profiles.wavenumber_rad_m
    taps = np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    padded = np.pad(profiles.samples.astype(np.complex128), [(0, 0), (_HALF_TAPS, _HALF_TAPS)])
    terms, table = np.empty((len(profiles), len(pixels)), np.complex128), _interpolator()
    for first in range(0, len(profiles), _ROWS_AT_ONCE):
        part = slice(first, first + _ROWS_AT_ONCE)
        path = profiles.aperture[part].path(pixels)
        position = (path - profiles.start_m[part, None]) / profiles.step_m
        base = np.nan_to_num(np.floor(position)).astype(np.int64)
        fraction = (position - base) * _FRACTIONS
        row = np.clip(np.nan_to_num(fraction).astype(np.int64), 0, _FRACTIONS - 1)
        index = np.clip(base[..., None] + taps + _HALF_TAPS, 0, padded.shape[1] - 1)
        samples = padded[np.arange(first, first + len(path))[:, None, None], index]
        lower, upper = (np.einsum("pxt,pxt->px", samples, table[row + step]) for step in (0, 1))
        terms[part] = (lower + (fraction - row) * (upper - lower)) * np.exp(1j * np.remainder(k * path, 2 * np.pi))
    return terms


@lru_cache(maxsize=1)
def _interpolator() -> NDArray[np.float64]:
    """Return (fraction, tap) weights of the samples around a position that follows a sample by a tabulated fraction."""
    distance = np.arange(_FRACTIONS + 1)[:, None] / _FRACTIONS - np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    return kaiser_sinc(distance, half=_HALF_TAPS, beta=_KAISER_BETA)


@lru_cache(maxsize=1)
def _paired_weights() -> NDArray[np.float64]:
    """Return `_interpolator` with each weight repeated for interleaved real and imaginary parts."""
    return np.repeat(_interpolator(), 2, axis=1)


# ---- Echoes of single pulses at single points

TAPS, DEGREE = KERNEL.echo_taps, KERNEL.echo_degree

_BYTES_AT_ONCE = 2**25  # bytes of samples in memory at once
_VALUES_AT_ONCE = 2**17  # limit of pulses × points, for beams and for the computation without the compiled library


@lru_cache
def tap_polynomials() -> NDArray[np.float64]:
    """Return the interpolation weight of each sample as a polynomial of the position between two samples.

    Returns
    -------
    ndarray
        (degree + 1, tap) float64, constant term first; the variable is -½…½ relative to the midpoint between taps 3
        and 4.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 5: least-squares fit over the band of profiles with an oversampling of 2, such
    that value and slope are continuous at the samples.

    Examples
    --------
    >>> weights = 0.25 ** np.arange(DEGREE + 1) @ tap_polynomials()
    >>> tone = np.exp(0.5j * np.pi * 0.9 * np.arange(TAPS))
    >>> bool(abs(weights @ tone - np.exp(0.5j * np.pi * 0.9 * 3.75)) < 1e-3)
    True
    """
    # Eq. 5: frequencies of the band, and positions between two samples with their Gauss-Legendre weights.
    omega = np.pi / 2 * np.cos(np.pi * (np.arange(160) + 0.5) / 160)
    position, share = (values / 2 for values in np.polynomial.legendre.leggauss(24))
    powers = position[:, None] ** np.arange(DEGREE + 1)
    tap = np.arange(TAPS) - (TAPS - 1) / 2
    root = np.sqrt(share)
    design = np.einsum("wt,un,u->wutn", np.exp(1j * omega[:, None] * tap), powers, root).reshape(
        -1, powers[0].size * TAPS
    )
    ideal = (np.exp(1j * omega[:, None] * position) * root).ravel()
    # Least squares among polynomials with continuous values and slopes.
    matrix, target = (np.concatenate([values.real, values.imag]) for values in (design, ideal))
    basis = _continuous_basis()
    coefficients = basis @ np.linalg.lstsq(matrix @ basis, target, rcond=None)[0]
    return np.ascontiguousarray(coefficients.reshape(TAPS, DEGREE + 1).T)


@lru_cache
def _rounded_taps() -> NDArray[np.float32]:
    return tap_polynomials().astype(np.float32)


def _continuous_basis() -> NDArray[np.float64]:
    """Return the (tap·power, free) basis of polynomials with value and slope continuous at the samples."""
    power = np.arange(DEGREE + 1)
    joins: list[NDArray[np.float64]] = []
    for end in (0.5**power, power * 0.5 ** (power - 1.0)):
        parity = end * (-1.0) ** (power + len(joins))
        joins.append(np.kron(np.eye(TAPS + 1, TAPS), end) - np.kron(np.eye(TAPS + 1, TAPS, k=-1), parity))
    conditions = np.concatenate(joins)
    return np.linalg.qr(conditions.T, mode="complete")[0][:, len(conditions) :]


@dataclass(frozen=True, eq=False)
class Echoes:
    """Zero-padded samples of pulses in the layout of the compiled library.

    Attributes
    ----------
    samples
        (pulse, 2, sample) float32: real and imaginary parts.
    tx_m, rx_m
        (3, pulse) float64, phase centres, metres, in the frame of the points.
    start_m
        (pulse,) float64, total path of sample 0.
    step_m
        Total path between samples.
    turns_per_m
        Cycles per metre of path, f_mid/v.
    """

    samples: NDArray[np.float32]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    start_m: NDArray[np.float64]
    step_m: float
    turns_per_m: float

    @classmethod
    def read(cls, profiles: Profiles, parts: list[slice]) -> "Echoes":
        """Read and concatenate the pulses of the given slices; no other pulses are read."""
        read = np.concatenate([np.asarray(profiles.samples[part]) for part in parts])
        samples = np.zeros((len(read), 2, read.shape[1] + 2 * TAPS), np.float32)
        samples[:, 0, TAPS:-TAPS], samples[:, 1, TAPS:-TAPS] = read.real, read.imag
        tx, rx = (np.concatenate([leg[part] for part in parts]).T for leg in profiles.aperture.legs)
        return cls(
            samples,
            np.ascontiguousarray(tx, np.float64),
            np.ascontiguousarray(rx, np.float64),
            np.concatenate([profiles.start_m[part] for part in parts]) - TAPS * profiles.step_m,
            profiles.step_m,
            profiles.centre_frequency_hz / profiles.wave_speed_m_s,
        )

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.samples)

    def at(self, places_m: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return s(R)·exp(j2πf_mid R/c) at points, and its derivative with respect to the path R.

        The computation is the same as in the compiled library, but in float64.

        Parameters
        ----------
        places_m
            (point, 3) float64, metres.

        Returns
        -------
        value, slope
            (pulse, point) complex128 each; the slope is per metre.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 4 and 5.
        """
        tx, rx = (distance(leg.T[:, None], places_m) for leg in (self.tx_m, self.rx_m))
        path = tx + rx
        position = (path - self.start_m[:, None]) / self.step_m
        position = np.clip(position, TAPS / 2 - 0.5, self.samples.shape[-1] - TAPS / 2 - 0.5)
        base = np.rint(position - 0.5)
        first = np.nan_to_num(base).astype(np.int64) - (TAPS // 2 - 1)
        near = np.clip(first, 0, None)[..., None] + np.arange(TAPS)
        pulse = np.arange(len(self))[:, None, None]
        samples = self.samples[pulse, 0, near] + 1j * self.samples[pulse, 1, near]
        u, taps = position - 0.5 - base, tap_polynomials()
        powers = u[..., None] ** np.arange(DEGREE + 1)
        level = np.einsum("pxn,nt,pxt->px", powers, taps, samples)
        rate = np.einsum("pxn,nt,pxt->px", powers[..., :-1], taps[1:] * np.arange(1, DEGREE + 1)[:, None], samples)
        carrier = np.exp(2j * np.pi * np.remainder(self.turns_per_m * path, 1.0))
        return level * carrier, (rate / self.step_m + 2j * np.pi * self.turns_per_m * level) * carrier


def job_of(echoes: Echoes, places_m: NDArray[np.float64], weight: NDArray[np.float32]) -> EchoJob:
    """Return the job of the compiled library for points; the caller sets the outputs.

    Parameters
    ----------
    echoes
        Echoes; the caller must keep the echoes and the other arrays in memory while the job runs.
    places_m
        (point, 3) float64, contiguous.
    weight
        (point or 1, pulse) float32, contiguous: weight of each pulse at each point, or at all points.
    """
    arrays = (echoes.samples, _rounded_taps(), echoes.tx_m, echoes.rx_m, echoes.start_m, weight, places_m)
    return EchoJob(
        *(array.ctypes.data for array in arrays),
        pulses=len(echoes),
        length=echoes.samples.shape[2],
        count=len(places_m),
        weight_step=len(echoes) if len(weight) > 1 else 0,
        samples_per_metre=1 / echoes.step_m,
        turns_per_metre=echoes.turns_per_m,
    )


def pulses_at_once(profiles: Profiles) -> int:
    """Return the number of pulses that are read at once."""
    return max(1, _BYTES_AT_ONCE // (8 * (int(profiles.samples.shape[1]) + 2 * TAPS)))


def tiles(places: int, pulses: int) -> Iterator[slice]:
    """Yield slices of points that are computed together without exceeding the memory bound."""
    step = max(1, _VALUES_AT_ONCE // max(1, pulses))
    for first in range(0, places, step):
        yield slice(first, first + step)


# ---- Contributions of blocks of pulses

Piece = tuple[int, slice]
"""Block number, and a slice of its pulses."""


def block_contributions(
    profiles: Profiles,
    places_m: NDArray[np.float64],
    *,
    edges: NDArray[np.int64],
    weights: NDArray[np.float64] | None = None,
) -> NDArray[np.complex64]:
    """Return Σ w·s(R)·exp(+j2πf_mid·R/c) over the pulses of each block at each point, with R the total path.

    Parameters
    ----------
    profiles
        Profiles with an oversampling of at least 2, which may be read on access; samples outside the profiles are zero.
    places_m
        (point, 3) float64, metres, in the frame of the phase centres.
    edges
        (block + 1,) int64, ascending: block b contains pulses edges[b] to edges[b + 1].
    weights
        (pulse,) float64, weight of each pulse (default: 1). Blocks with zero weight are not read.

    Returns
    -------
    ndarray
        (point, block) complex64, not normalised; NaN where a point is not finite.

    Raises
    ------
    ValueError
        If shapes differ, or if edges do not ascend within the pulses.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 4 and 5. The error is below -65 dB over the whole band of profiles with an
    oversampling of 2. Paths and carrier phase are computed in float64. If the compiled library is not available, numpy
    is used.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> track = np.array([[0.0, 0.0, 5.0]] * 4)
    >>> echo = np.exp(-((np.arange(32) - 16.0) ** 2) / 8).astype(np.complex64)
    >>> profiles = Profiles(np.tile(echo, (4, 1)), np.full(4, 2.0), 0.5, 299792458.0, 2.0, Aperture(track, track))
    >>> abs(block_contributions(profiles, np.zeros((1, 3)), edges=np.array([0, 1, 4]))).round(2)
    array([[1., 3.]], dtype=float32)
    """
    weights = np.ones(len(profiles)) if weights is None else weights
    edges = np.asarray(edges, np.int64)
    if places_m.ndim != 2 or places_m.shape[1] != 3 or weights.shape != (len(profiles),):
        raise ValueError(f"{places_m.shape=}, {weights.shape=}: must be (point, 3) and ({len(profiles)},)")
    if edges.size < 2 or (np.diff(edges) < 0).any() or edges[0] < 0 or edges[-1] > len(profiles):
        raise ValueError(f"{edges=}: must ascend and lie between 0 and the number of pulses, {len(profiles)}")
    places_m = np.ascontiguousarray(places_m, np.float64)
    sums = np.zeros((len(places_m), edges.size - 1), np.complex64)
    add = _add_compiled if available() else _add
    for pieces in _chunks(edges, weights, pulses_at_once(profiles)):
        parts = _joined(pieces)
        add(Echoes.read(profiles, parts), places_m, pieces, np.concatenate([weights[part] for part in parts]), sums)
    return sums


def _chunks(edges: NDArray[np.int64], weights: NDArray[np.float64], most: int) -> Iterator[list[Piece]]:
    """Yield chunks of at most `most` pulses, as lists of blocks or parts of blocks with nonzero weight."""
    chunk: list[Piece] = []
    free, weighted = most, [0, *np.cumsum(weights != 0).tolist()]
    for block, (first, end) in enumerate(pairwise(edges.tolist())):
        start = first
        while start < end and weighted[start] < weighted[end]:
            count = min(free, end - start)
            chunk.append((block, slice(start, start + count)))
            start += count
            free -= count
            if not free:
                yield chunk
                chunk, free = [], most
    if chunk:
        yield chunk


def _joined(pieces: list[Piece]) -> list[slice]:
    """Return the pulses of pieces as slices; adjacent pieces are joined."""
    parts: list[slice] = []
    for _block, part in pieces:
        if parts and parts[-1].stop == part.start:
            parts[-1] = slice(parts[-1].start, part.stop)
        else:
            parts.append(part)
    return parts


def _borders(pieces: list[Piece]) -> NDArray[np.int64]:
    """Return the offsets of pieces in their concatenation."""
    return np.cumsum([0, *(part.stop - part.start for _block, part in pieces)])


def _add_compiled(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    pieces: list[Piece],
    weights: NDArray[np.float64],
    sums: NDArray[np.complex64],
) -> None:
    columns = np.array([block for block, _part in pieces], np.int64)
    weight, borders = weights.astype(np.float32)[None], _borders(pieces)
    job = job_of(echoes, places_m, weight)
    job.edges, job.columns, job.sums = borders.ctypes.data, columns.ctypes.data, sums.ctypes.data
    job.blocks, job.width = columns.size, sums.shape[1]
    call("apertura_contribute", job)


def _add(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    pieces: list[Piece],
    weights: NDArray[np.float64],
    sums: NDArray[np.complex64],
) -> None:
    borders = _borders(pieces)
    for tile in tiles(len(places_m), len(echoes)):
        values = echoes.at(places_m[tile])[0] * weights[:, None]
        for (block, _part), (start, end) in zip(pieces, pairwise(borders), strict=True):
            sums[tile, block] += values[start:end].sum(axis=0)


# ---- Gradient of an objective with respect to phase centres and paths: the exact adjoint of the contributions


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of a real objective for each pulse, in the unit of the objective per metre.

    Attributes
    ----------
    tx_m, rx_m
        (pulse, 3) float64, derivatives with respect to the phase centres of transmitter and receiver, in the frame of
        the phase centres. The derivative for a monostatic node is the sum of both.
    path_m
        (pulse,) float64, derivative with respect to a path added to all echoes of a pulse (`Profiles.moved`).
    """

    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    path_m: NDArray[np.float64]


def path_gradient(
    profiles: Profiles, places_m: NDArray[np.float64], slope: NDArray[np.complexfloating], *, beams: Beams | None = None
) -> Gradient:
    """Return the derivatives of an objective that depends on Σ w·s(R)·exp(+j2πf_mid·R/c) over all pulses at each point.

    Parameters
    ----------
    profiles
        Profiles with an oversampling of at least 2, which may be read on access.
    places_m
        (point, 3) float64, metres, in the frame of the phase centres.
    slope
        (point,) complex, G = ∂J/∂Re + j·∂J/∂Im: if the sums change by dI, the objective changes by Re Σ G*·dI.
    beams
        Weight of each pulse at each point (default: 1); the dependence of the weight on the phase centres is neglected.

    Returns
    -------
    Gradient
        Exact derivatives of the sum of `block_contributions`, rounded to float32 for each pulse and point.

    Raises
    ------
    ValueError
        If shapes differ, or if points or slopes are not finite.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 6 to 8. If the compiled library is not available, numpy is used.
    """
    if places_m.shape != (*slope.shape, 3) or slope.ndim != 1:
        raise ValueError(f"{places_m.shape=}, {slope.shape=}: must be (point, 3) and (point,)")
    if not (np.isfinite(places_m).all() and np.isfinite(slope).all()):
        raise ValueError("points and slopes of the objective must be finite")
    derivatives, largest = np.zeros((7, len(profiles))), float(np.abs(slope).max(initial=0.0))
    if largest:
        # Slopes are normalised, because the library uses float32 and the unit of the objective is arbitrary.
        places_m, slope = np.ascontiguousarray(places_m, np.float64), (slope / largest).astype(np.complex64)
        for first in range(0, len(profiles), pulses_at_once(profiles)):
            part = slice(first, min(first + pulses_at_once(profiles), len(profiles)))
            derivatives[:, part] = _derivatives(profiles, part, places_m, slope, beams) * largest
    return Gradient(derivatives[:3].T.copy(), derivatives[3:6].T.copy(), derivatives[6])


def _derivatives(
    profiles: Profiles,
    part: slice,
    places_m: NDArray[np.float64],
    slope: NDArray[np.complex64],
    beams: Beams | None,
) -> NDArray[np.float64]:
    """Return (7, pulse) derivatives with respect to transmitter, receiver and path."""
    echoes, beams = Echoes.read(profiles, [part]), beams and beams.on_profiles
    derivatives = np.zeros((7, len(echoes)))
    add = _differentiate_compiled if available() else _differentiate
    for tile in [slice(None)] if beams is None else tiles(len(places_m), len(echoes)):
        weight = np.ones((1, len(echoes)), np.float32)
        if beams is not None:
            weight = beams[part].weight(profiles.aperture[part], places_m[tile]).T.astype(np.float32, order="C")
        add(echoes, places_m[tile], slope[tile], weight, derivatives)
    return derivatives


def _differentiate_compiled(
    echoes: Echoes,
    places_m: NDArray[np.float64],
    slope: NDArray[np.complex64],
    weight: NDArray[np.float32],
    derivatives: NDArray[np.float64],
) -> None:
    job = job_of(echoes, places_m, weight)
    job.objective, job.slopes = slope.ctypes.data, derivatives.ctypes.data
    call("apertura_differentiate", job)


def _differentiate(
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
