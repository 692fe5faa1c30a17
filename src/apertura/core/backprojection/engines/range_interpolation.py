"""Range tables of the compiled engine: polynomials of the profile inside each cell, and error of these polynomials.

A cell contains the coefficients of the least-squares polynomial of the profile over the cell, multiplied by the carrier
at the centre of the cell. The carrier relative to the centre is a short polynomial as well (docs/theory/engine.md).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.units import decibels
from apertura.core.backprojection.engines.native_binding import KERNEL

TAPS = KERNEL.taps
MARGIN = KERNEL.window  # number of empty cells at each end, for look-up windows that extend beyond the profile
# Polynomials of native/phase.hpp, in ascending order of cost: sine terms, cosine terms, reduction by multiples of π.
PHASE_POLYNOMIALS = ((2, 3, False), (3, 4, False), (4, 4, False), (3, 4, True))

BAND = np.cos(np.pi * (np.arange(160) + 0.5) / 160)
"""Frequencies at which errors are evaluated, with the band edges at ±1: Chebyshev nodes, which are dense at the edges.
"""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_WITHIN = _NODES / 2  # positions inside a cell at which errors are evaluated, cells
_WITHIN_WEIGHTS = _WEIGHTS / 2


@dataclass(frozen=True)
class Tables:
    """Range profiles as polynomials per cell that include the carrier; common to all tiles.

    Attributes
    ----------
    cells
        (pulse, 2·(degree + 1), cell) float32: real and imaginary parts of each coefficient; zero outside the profile.
    transmitter_m, receiver_m
        (3, padded) float64, phase centres in the frame of the pixels; pulses are padded to a multiple of 8.
    first_path_m
        (padded,) float64, total path at the centre of cell 0, metres.
    cell_m
        Total path across one cell, metres.
    carrier_rad_per_cell
        Change of the carrier phase over one cell, rad.
    phase_polynomial, phase_coefficients
        Index of a polynomial in `PHASE_POLYNOMIALS`; and coefficients of this polynomial, (9,) float32.
    degree
        Degree of the polynomials, 1 or 2.
    error_db
        Predicted RMS error at random pixels for a profile with a flat spectrum, dB.
    """

    cells: NDArray[np.float32]
    transmitter_m: NDArray[np.float64]
    receiver_m: NDArray[np.float64]
    first_path_m: NDArray[np.float64]
    cell_m: float
    carrier_rad_per_cell: float
    phase_polynomial: int
    phase_coefficients: NDArray[np.float32]
    degree: int
    error_db: float

    def __getitem__(self, pulses: slice) -> "Tables":
        """Return the tables of a slice of pulses that starts at a multiple of the batch size."""
        first, last, _ = pulses.indices(len(self.cells))
        padded = slice(first, first - (first - last) // KERNEL.batch * KERNEL.batch)
        return replace(
            self,
            cells=self.cells[first:last],
            transmitter_m=np.ascontiguousarray(self.transmitter_m[:, padded]),
            receiver_m=np.ascontiguousarray(self.receiver_m[:, padded]),
            first_path_m=self.first_path_m[padded],
        )


@dataclass(frozen=True)
class TableDesign:
    """Filters from samples to cells.

    Attributes
    ----------
    up, down
        `up` cells cover `down` samples.
    taps
        (up, degree + 1, tap) float32, filter for each coefficient of each of the `up` cells.
    lead
        (up,) int32, sample at the first tap relative to the first of the `down` samples.
    phase_polynomial, phase_coefficients
        As in `Tables`.
    squared_error
        (160,) float64, mean squared error over a cell at each frequency of `BAND`.
    """

    up: int
    down: int
    taps: NDArray[np.float32]
    lead: NDArray[np.int32]
    phase_polynomial: int
    phase_coefficients: NDArray[np.float32]
    squared_error: NDArray[np.float64]

    def error_db(self, window: NDArray[np.float64]) -> float:
        """Return the predicted RMS error at random pixels for echoes with a window, dB; see `band_error_db`."""
        return band_error_db(self.squared_error, window)


def band_error_db(squared_error: NDArray[np.float64], window: NDArray[np.float64]) -> float:
    """Return the RMS error of a windowed echo with a white spectrum, relative to the echo, dB.

    Parameters
    ----------
    squared_error
        (160,) float64, squared error at each frequency of `BAND`.
    window
        (subcarrier,) float64, weights from the lowest to the highest subcarrier, with an arbitrary scale.

    Returns
    -------
    float
        RMS error, dB.

    Notes
    -----
    Source: docs/theory/planner.md, eq. 1.

    Examples
    --------
    >>> at_the_edges = 1e-6 * BAND**8
    >>> [round(band_error_db(at_the_edges, window)) for window in (np.ones(64), np.hanning(64))]
    [-70, -87]
    """
    count = len(window)
    power = np.interp(BAND, (np.arange(count) - count // 2) * 2 / count, window**2)
    power *= np.sqrt(1 - BAND**2)  # weights for integration over the band at Chebyshev nodes
    return decibels(float((squared_error * power).sum() / power.sum()))


def ratio(profile_oversampling: float, oversampling: float) -> tuple[int, int]:
    """Return the numbers of cells and samples that span equal lengths, with `oversampling` cells per Nyquist cell.

    Examples
    --------
    >>> ratio(2.0, 5), ratio(2.0, 6), ratio(2.5, 5)
    ((5, 2), (3, 1), (2, 1))
    """
    up, down = int(np.ceil(2 * oversampling / profile_oversampling - 1e-9)), 2
    return (up // 2, 1) if up % 2 == 0 else (up, down)


@lru_cache(maxsize=64)
def design_table(
    profile_oversampling: float, carrier_rad_per_sample: float, *, oversampling: float, degree: int, taps: int = TAPS
) -> TableDesign:
    """Design the filters and the phase polynomials of a table, and predict its error.

    Parameters
    ----------
    profile_oversampling
        Samples of the profiles per Nyquist cell, at least 1.5.
    carrier_rad_per_sample
        Change of the carrier phase over one sample of total path, rad.
    oversampling
        Minimum number of cells of the table per Nyquist cell.
    degree
        Degree of the polynomials, 1 or 2.
    taps
        Number of taps of the filters.

    Notes
    -----
    Source: docs/theory/engine.md, "Cells". The filters are optimal in the least-squares sense over the band of the
    profiles, so that oversampled profiles require a small number of taps.

    Examples
    --------
    >>> design = design_table(2.0, 9.2, oversampling=6, degree=2)
    >>> design.up, design.down, design.error_db(np.ones(1)) < -74
    (3, 1, True)
    """
    # Positions of the `up` cells within `down` samples, and the band of the profiles.
    up, down = ratio(profile_oversampling, oversampling)
    starts = np.arange(up) * down / up
    first_sample = np.floor(starts)
    omega = np.pi / profile_oversampling * BAND
    # Ideal coefficients at each frequency in each cell, and filter taps fitted by least squares.
    ideal = np.exp(1j * omega * (starts - first_sample)[:, None])[:, None] * _coefficients(omega * down / up, degree)
    before = taps // 2 - 1
    basis = np.exp(1j * omega[:, None] * (np.arange(taps) - before))
    target = ideal.reshape(-1, omega.size).T
    filters = np.linalg.lstsq(_stacked(basis), _stacked(target), rcond=1e-9)[0].T.reshape(up, degree + 1, taps)
    # Error of the polynomials; the carrier inside a cell is approximated by a short polynomial.
    coefficients = np.einsum("pkt,wt->pkw", filters, basis)
    carrier_rad_per_cell = carrier_rad_per_sample * down / up
    polynomial, phase = _phase(carrier_rad_per_cell)
    error = _squared_error(
        coefficients,
        omega,
        starts - first_sample,
        samples_per_cell=down / up,
        carrier_rad_per_cell=carrier_rad_per_cell,
        polynomial=polynomial,
        phase=phase,
    )
    lead = first_sample.astype(np.int32) - before
    return TableDesign(up, down, np.ascontiguousarray(filters, np.float32), lead, polynomial, phase, error)


def _stacked(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.concatenate([values.real, values.imag])


def _coefficients(omega: NDArray[np.float64], degree: int) -> NDArray[np.complex128]:
    """Return (degree + 1, omega) coefficients of least-squares polynomials of exp(jωu) over -½ ≤ u ≤ ½ (Legendre)."""
    wave = np.exp(1j * omega[:, None] * _WITHIN) * _WITHIN_WEIGHTS
    level, slope = wave.sum(1), 12 * (wave * _WITHIN).sum(1)
    if degree == 1:
        return np.stack([level, slope])
    curvature = 180 * (wave * (_WITHIN**2 - 1 / 12)).sum(1)
    return np.stack([level - curvature / 12, slope, curvature])


def _phase(carrier_rad_per_cell: float) -> tuple[int, NDArray[np.float32]]:
    """Return the index and coefficients of the cheapest sufficiently accurate phase polynomial inside a cell."""
    u = 0.5 * np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    for sines, cosines, reduced in PHASE_POLYNOMIALS:
        scale = np.pi if reduced else carrier_rad_per_cell
        even, odd = u[:, None] ** (2 * np.arange(cosines)), u[:, None] ** (2 * np.arange(sines) + 1)
        cosine = np.linalg.lstsq(even, np.cos(scale * u), rcond=None)[0]
        sine = np.linalg.lstsq(odd, np.sin(scale * u), rcond=None)[0]
        worst = max(np.abs(even @ cosine - np.cos(scale * u)).max(), np.abs(odd @ sine - np.sin(scale * u)).max())
        if reduced or worst < 4e-4:
            break
    phase = np.zeros(9, np.float32)
    phase[:cosines], phase[4 : 4 + sines], phase[8] = cosine, sine, carrier_rad_per_cell / np.pi
    return PHASE_POLYNOMIALS.index((sines, cosines, reduced)), phase


def _squared_error(
    coefficients: NDArray[np.complex128],
    omega: NDArray[np.float64],
    starts: NDArray[np.float64],
    *,
    samples_per_cell: float,
    carrier_rad_per_cell: float,
    polynomial: int,
    phase: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Return the mean squared error at each frequency, over positions inside a cell and over the `up` cells."""
    powers = _WITHIN ** np.arange(coefficients.shape[1])[:, None]
    value = np.einsum("pkw,ku->pwu", coefficients, powers)
    sines, cosines, reduced = PHASE_POLYNOMIALS[polynomial]
    half_cycles = _WITHIN * phase[8] if reduced else np.zeros_like(_WITHIN)
    u = half_cycles - np.rint(half_cycles) if reduced else _WITHIN
    sign = np.where(np.rint(half_cycles) % 2 == 0, 1, -1)
    cosine = u[:, None] ** (2 * np.arange(cosines)) @ phase[:cosines]
    sine = u[:, None] ** (2 * np.arange(sines) + 1) @ phase[4 : 4 + sines]
    carrier = sign * (cosine + 1j * sine)
    position = starts[:, None, None] + samples_per_cell * _WITHIN
    truth = np.exp(1j * omega[:, None] * position) * np.exp(1j * carrier_rad_per_cell * _WITHIN)
    return np.asarray((np.abs(value * carrier - truth) ** 2 @ _WITHIN_WEIGHTS).mean(axis=0))
