"""Reference reflectors: radar cross-sections by shape and size, and the combined calibration constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S

Shape = Literal["trihedral", "dihedral", "sphere"]

MOST_TURNED_DB = 1.0
"""Largest bistatic loss (dB) up to which the cross-section of a corner reflector is computed: the second-order formula
then has an error of at most 0.05 dB."""

DRIFT_SIGMAS = 3.0
"""Significance threshold for a change of the constant, standard deviations: the false-alarm probability is 1/370."""

_SEAMS = np.array(
    [
        [1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [-1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [0.0, np.sqrt(2 / 3), 1 / np.sqrt(3)],
    ]
)
"""Seams of a trihedral, (seam, axis), with the axes right, up, ahead; the third seam lies in the boresight's vertical
plane."""

_HEXAGON = 5 / (36 * np.sqrt(3))  # mean square of a coordinate over a regular hexagon, divided by its area
_DB = 20 / np.log(10)  # dB per relative error of an amplitude
_BAND = 9  # frequencies at which the cross-section of a sphere is sampled over the band

# ---- Cross-sections by shape ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reflector:
    """Conducting reflector of known shape.

    Attributes
    ----------
    shape
        'trihedral' (three right-angled triangles), 'dihedral' (two rectangles) or 'sphere'.
    size_m
        Trihedral: leg length of the triangles. Dihedral: width of a rectangle across the seam, and length along the
        seam. Sphere: radius.
    axes
        (3, 3) float64, rows are the unit vectors right, up and ahead (along the boresight) in the frame of the
        antennas; the seam of a dihedral is parallel to the first vector.

    Notes
    -----
    Source: docs/theory/radiometry.md, eqs. 11 to 14.

    Examples
    --------
    >>> corner = Reflector("trihedral", (1.0,), np.eye(3))
    >>> (rcs_m2,), _ = corner.cross_section(np.array([[0, 0, 1.0]]), np.array([[0, 0, 1.0]]), wavelength_m=0.25)
    >>> round(float(rcs_m2 / (4 * np.pi / (3 * 0.25**2))), 6)
    1.0
    """

    shape: Shape
    size_m: tuple[float, ...]
    axes: Floats

    def cross_section(self, towards_tx: Floats, towards_rx: Floats, *, wavelength_m: float) -> tuple[Floats, Floats]:
        """Return the radar cross-section, m², and the standard deviation of its formula, dB.

        Parameters
        ----------
        towards_tx, towards_rx
            (direction, 3) float64, unit vectors from the reflector to the antennas.
        wavelength_m
            Wavelength.

        Returns
        -------
        tuple of ndarray
            (direction,) float64 each. The cross-section is 0 m² in directions outside the opening of a corner, and NaN
            where the bistatic angle is too large for the formula.
        """
        tx, rx = towards_tx @ self.axes.T, towards_rx @ self.axes.T
        if self.shape == "sphere":
            return _sphere(self.size_m[0], -(tx * rx).sum(axis=-1), 2 * np.pi / wavelength_m)
        corner = _trihedral if self.shape == "trihedral" else _dihedral
        area_m2, lost, edge_m2 = corner(self.size_m, tx, rx, 2 * np.pi / wavelength_m)
        turned_db = -_DB * np.log(np.maximum(lost, 1e-3))
        rcs_m2 = 4 * np.pi * (area_m2 * lost / wavelength_m) ** 2
        with np.errstate(divide="ignore"):
            edge_db = _DB * np.sqrt(edge_m2 / np.where(rcs_m2 > 0, rcs_m2, np.nan) / 2)
        return np.where(turned_db <= MOST_TURNED_DB, rcs_m2, np.nan), np.hypot(turned_db, edge_db)

    def seen(self, towards_tx: Floats, towards_rx: Floats, weight: Floats, frequency_hz: Floats) -> tuple[float, float]:
        """Return the effective cross-section in an image, m², and the standard deviation of its formula, dB.

        Parameters
        ----------
        towards_tx, towards_rx
            (pulse, 3) float64, unit vectors from the reflector to the antennas.
        weight
            (pulse,) float64, contribution of each pulse to the image of an isotropic target.
        frequency_hz
            (subcarrier,) float64.

        Notes
        -----
        An image is a sum of amplitudes, not of powers. Therefore the square root of the cross-section is averaged over
        the pulses.

        Examples
        --------
        >>> ahead = np.array([[0.0, 0.0, 1.0]])
        >>> sphere = Reflector("sphere", (0.5,), np.eye(3))
        >>> rcs_m2, _ = sphere.seen(ahead, ahead, np.ones(1), np.linspace(1.2e9, 1.4e9, 9))
        >>> round(rcs_m2 / (np.pi * 0.5**2), 2)
        0.95
        """
        middle_hz = (frequency_hz[0] + frequency_hz[-1]) / 2
        rcs_m2, std_db = self._mean(towards_tx, towards_rx, weight, middle_hz)
        if self.shape == "sphere":
            sampled_hz = np.linspace(frequency_hz[0], frequency_hz[-1], _BAND)
            over_band = np.mean([self._mean(towards_tx, towards_rx, weight, at_hz)[0] for at_hz in sampled_hz])
            std_db = float(np.hypot(std_db, 10 * np.log10(over_band / rcs_m2)))
        return rcs_m2, std_db

    def _mean(self, towards_tx: Floats, towards_rx: Floats, weight: Floats, frequency_hz: float) -> tuple[float, float]:
        rcs_m2, std_db = self.cross_section(towards_tx, towards_rx, wavelength_m=SPEED_OF_LIGHT_M_S / frequency_hz)
        part = np.where(weight > 0, weight * np.sqrt(rcs_m2), 0.0)
        counts = part > 0
        std = float((part[counts] * std_db[counts]).sum() / part[counts].sum()) if counts.any() else float("nan")
        return float((part.sum() / weight.sum()) ** 2), std


def _trihedral(size_m: Sequence[float], tx: Floats, rx: Floats, k: float) -> tuple[Floats, Floats, float]:
    """Return effective area, bistatic amplitude factor and edge diffraction power of a trihedral, eq. 11."""
    (leg_m,) = size_m
    first, second, third = np.sort(_unit(tx + rx) @ _SEAMS.T, axis=-1).T
    total = first + second + third
    into = (first > 0) & (total > 0)
    total = np.where(into, total, 1.0)
    wide = first + second > third
    area = np.where(into, leg_m**2 * np.where(wide, total - 2 / total, 4 * first * second / total), 0.0)
    lost = 1 - ((k * (rx - tx)) ** 2).sum(axis=-1) * _HEXAGON * area / 2
    return area, lost, (np.sqrt(2) * leg_m) ** 2 / np.pi


def _dihedral(size_m: Sequence[float], tx: Floats, rx: Floats, k: float) -> tuple[Floats, Floats, float]:
    """Return effective area, bistatic amplitude factor and edge diffraction power of a dihedral, eq. 12."""
    across_m, along_m = size_m
    between = _unit(tx + rx)
    off = np.abs(np.arctan2(between[:, 1], between[:, 2]))
    width_m = 2 * across_m * np.sin(np.maximum(np.pi / 4 - off, 0.0))
    level = np.sqrt(np.maximum(1 - between[:, 0] ** 2, 0.0))
    seam = np.sinc(k * along_m * (tx[:, 0] + rx[:, 0]) / (2 * np.pi))
    turned = ((rx - tx)[:, 1:] ** 2).sum(axis=-1)
    return along_m * width_m * level * np.abs(seam), 1 - k**2 * turned * width_m**2 / 24, along_m**2 / np.pi


def _sphere(radius_m: float, cosine: Floats, k: float) -> tuple[Floats, Floats]:
    """Return the cross-section of a conducting sphere by the Mie series at cosines of the scattering angle, eq. 13.

    The result is the mean of the cross-sections in both polarisations, which are equal only for backscattering. Half of
    their difference is used as the standard deviation.
    """
    from scipy.special import spherical_jn, spherical_yn

    x = k * radius_m
    orders = np.arange(1, int(np.ceil(x + 4.05 * x ** (1 / 3) + 8)) + 1)
    j, dj = spherical_jn(orders, x), spherical_jn(orders, x, derivative=True)
    h, dh = j + 1j * spherical_yn(orders, x), dj + 1j * spherical_yn(orders, x, derivative=True)
    electric, magnetic = (j + x * dj) / (h + x * dh), j / h
    share = (2 * orders + 1) / (orders * (orders + 1))
    before, now = np.zeros_like(cosine), np.ones_like(cosine)
    both = np.zeros((2, len(cosine)), np.complex128)
    for n, a, b, part in zip(orders, electric, magnetic, share, strict=True):
        tau = n * cosine * now - (n + 1) * before
        both += part * np.array([a * now + b * tau, a * tau + b * now])
        before, now = now, ((2 * n + 1) * cosine * now - (n + 1) * before) / n
    power = 4 * np.pi * np.abs(both) ** 2 / k**2
    mean = power.mean(axis=0)
    return mean, 10 / np.log(10) * np.abs(power[0] - power[1]) / (2 * mean)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


# ---- Combined constant ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mean:
    """Combined estimate from measurements at several reflectors in several flights.

    Attributes
    ----------
    value, std
        Mean and its standard deviation, in the unit of the measurements.
    chi2, freedom
        χ² of the differences between reflectors, and its degrees of freedom.
    drift
        The two flights with the most significant difference: first flight, second flight, difference (second minus
        first), and its standard deviation. None if no reflector was measured in two flights.
    """

    value: float
    std: float
    chi2: float
    freedom: int
    drift: tuple[str, str, float, float] | None

    @property
    def chance(self) -> float:
        """Probability of a χ² of at least this value, given the stated deviations; 1 for a single reflector."""
        from scipy.stats import chi2

        return float(chi2.sf(self.chi2, self.freedom)) if self.freedom else 1.0

    @property
    def drifts(self) -> bool:
        """True if the difference between two flights is statistically significant."""
        return self.drift is not None and abs(self.drift[2]) > DRIFT_SIGMAS * self.drift[3]


def together(value: Floats, scatter: Floats, common: Floats, reflectors: Sequence[str], flights: Sequence[str]) -> Mean:
    """Combine measurements, each at a reflector in a flight.

    Parameters
    ----------
    value
        (measurement,) float64.
    scatter
        (measurement,) float64, standard deviation of the error that is independent between measurements.
    common
        (measurement,) float64, standard deviation of the error common to the measurements at a reflector.
    reflectors, flights
        Reflector and flight of each measurement.

    Notes
    -----
    Source: docs/theory/radiometry.md, eqs. 16 and 17.

    Examples
    --------
    >>> mean = together(np.array([1.0, 3.0]), np.full(2, 0.5), np.full(2, 0.5), ["a", "a"], ["f01", "f02"])
    >>> mean.value, round(mean.std**2, 3), mean.drift[2:], mean.drifts
    (2.0, 0.375, (2.0, 0.7071067811865476), False)
    """
    of, at = np.array(reflectors), np.array(flights)
    names = list(dict.fromkeys(reflectors))
    weight = 1 / scatter**2
    total = np.array([weight[of == name].sum() for name in names])
    means = np.array([(weight * value)[of == name].sum() for name in names]) / total
    variance = 1 / total + np.array([common[of == name].max() for name in names]) ** 2
    mean = float((means / variance).sum() / (1 / variance).sum())
    chi2, freedom = float(((means - mean) ** 2 / variance).sum()), len(names) - 1
    std = float(np.sqrt(max(1.0, chi2 / freedom if freedom else 1.0) / (1 / variance).sum()))
    pairs = [
        _difference(value, scatter**2, of, at == first, at == second, first, second)
        for first, second in combinations(dict.fromkeys(flights), 2)
    ]
    known = [pair for pair in pairs if pair is not None]
    return Mean(mean, std, chi2, freedom, max(known, key=lambda pair: abs(pair[2]) / pair[3], default=None))


def _difference(
    value: Floats,
    variance: Floats,
    of: NDArray[np.str_],
    first: NDArray[np.bool_],
    second: NDArray[np.bool_],
    *names: str,
) -> tuple[str, str, float, float] | None:
    """Return the difference between two flights at their common reflectors, and its standard deviation."""
    both = [(np.flatnonzero(first & (of == name)), np.flatnonzero(second & (of == name))) for name in np.unique(of)]
    shared = [(in_first[0], in_second[0]) for in_first, in_second in both if in_first.size and in_second.size]
    if not shared:
        return None
    weight = np.array([1 / (variance[i] + variance[j]) for i, j in shared])
    differences = np.array([value[j] - value[i] for i, j in shared])
    return (*names, float((weight * differences).sum() / weight.sum()), float(weight.sum() ** -0.5))  # type: ignore[return-value]
