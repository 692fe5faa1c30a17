"""Effect of errors of the total path on the image of a point: peak loss, displacement and phase."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.aperture import Aperture

MOST_PULSES = 200
"""Largest number of evenly spaced pulses of `PointPaths`: sufficient if errors are correlated over several samples."""


def autocorrelation(lag_s: NDArray[np.float64], correlation_s: float) -> NDArray[np.float64]:
    """Return the autocorrelation of position errors at a time lag: the definition of `position_correlation_s`.

    Parameters
    ----------
    lag_s
        Any shape, float64, seconds; not negative.
    correlation_s
        Correlation time, seconds: length of the moving average that forms the errors from white noise; 0: independent
        errors at each epoch.

    Returns
    -------
    ndarray
        Shape of `lag_s`; 1 at lag 0, decreasing linearly to 0 at `correlation_s`.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 3.

    Examples
    --------
    >>> autocorrelation(np.array([0.0, 0.5, 1.0, 2.0]), 1.0)
    array([1. , 0.5, 0. , 0. ])
    """
    if correlation_s <= 0:
        white: NDArray[np.float64] = (lag_s == 0).astype(np.float64)
        return white
    triangle: NDArray[np.float64] = np.clip(1 - lag_s / correlation_s, 0, None)
    return triangle


@dataclass(frozen=True)
class Effect:
    """Effect of an error on the image of a point.

    Attributes
    ----------
    loss_db
        Change of the peak power, 0 or less.
    shift_m
        Horizontal displacement, metres.
    phase_rad
        Phase at a point of the terrain relative to a pair without the error; NaN if not predicted.
    loss_std_db
        Standard deviation of the loss between flights, for random errors.
    """

    loss_db: float
    shift_m: float
    phase_rad: float
    loss_std_db: float = 0.0


@dataclass(frozen=True, eq=False)
class PointPaths:
    """Total paths to one point of the scene, at up to `MOST_PULSES` pulses.

    Attributes
    ----------
    aperture
        Phase centres.
    time_s
        (pulse,) float64, seconds.
    point_m
        (3,) float64, in the frame of the phase centres.
    axes
        (3, 3) float64, rows are the unit vectors east, north, up at the point.
    wavelength_m
        Wavelength at band centre.

    Examples
    --------
    >>> along = np.linspace(-5, 5, 101)
    >>> track = np.stack([along, np.full(101, -10.0), np.full(101, 10.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along, np.zeros(3), np.eye(3), 0.2)
    >>> higher = paths.of_offset(-paths.gradient[:, 2])  # the point lies a metre higher than assumed
    >>> round(higher.shift_m, 2), round(higher.loss_db, 2) > -0.5
    (1.0, True)
    """

    aperture: Aperture
    time_s: NDArray[np.float64]
    point_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    wavelength_m: float

    @classmethod
    def of(
        cls,
        aperture: Aperture,
        time_s: NDArray[np.float64],
        *,
        point_m: NDArray[np.float64],
        axes: NDArray[np.float64],
        wavelength_m: float,
    ) -> "PointPaths":
        """Return the paths to a point at evenly spaced pulses; the parameters are the attributes at all pulses."""
        sampled = aperture.sample(MOST_PULSES)
        return cls(aperture[sampled], time_s[sampled], point_m, axes, wavelength_m)

    @property
    def gradient(self) -> NDArray[np.float64]:
        """(pulse, 3) float64, derivative of the path with respect to the point's position east, north, up."""
        return self.aperture.path_gradient(self.point_m) @ self.axes.T

    @property
    def rate_m_s(self) -> NDArray[np.float64]:
        """(pulse,) float64, rate of change of the path during the flight, metres per second."""
        return np.gradient(self.aperture.path(self.point_m), self.time_s)

    def by_node(self, *, same: bool, sidelink: bool) -> tuple[NDArray[np.float64], ...]:
        """Return the derivatives of the measured path with respect to each node's position, (pulse, 3) east, north, up.

        Parameters
        ----------
        same
            True if a single node transmits and receives, so that its position error affects both one-way paths: a
            single array is returned.
        sidelink
            True if the echo was corrected by the sidelink; the sidelink's path length is computed from the same logs.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 4.
        """
        tx, rx, tx_sidelink, rx_sidelink = self.by_point(sidelink=sidelink and not same)
        legs = (tx + rx,) if same else (tx + tx_sidelink, rx + rx_sidelink)
        return tuple(leg @ self.axes.T for leg in legs)

    def by_point(self, *, sidelink: bool) -> tuple[NDArray[np.float64], ...]:
        """Return the derivatives of the measured path with respect to the position of each antenna.

        Parameters
        ----------
        sidelink
            As for `by_node`, with two nodes.

        Returns
        -------
        tuple of ndarray
            (pulse, 3) float64 each, in the frame of the phase centres: transmitting and receiving radar antenna, then
            the sidelink antennas of transmitter and receiver.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 4.
        """
        legs = []
        for leg in self.aperture.legs:
            offset_m = leg - self.point_m
            legs.append(offset_m / np.linalg.norm(offset_m, axis=1, keepdims=True))
        along = np.zeros_like(legs[0])
        if sidelink:
            between = self.aperture.tx_m - self.aperture.rx_m
            along = between / np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-9)
        return legs[0], legs[1], -along, along

    def of_offset(self, error_m: NDArray[np.float64], *, common: bool = False) -> Effect:
        """Return the effect of a deterministic path error.

        Parameters
        ----------
        error_m
            (pulse,) float64, true path minus the path assumed in image formation, metres.
        common
            True if the cause is common to all pairs. Their images then have nearly the same displacement, and the
            residual phase between the images is not predicted.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 2: the component equivalent to a horizontal shift displaces the point, and the
        residual defocuses the point.
        """
        # Δx = G⁺e, r = e − GΔx and L of eq. 2.
        ground = self.gradient[:, :2]
        shift = np.linalg.pinv(ground) @ error_m
        residual = error_m - ground @ shift
        wavenumber = 2 * np.pi / self.wavelength_m
        loss_db = 20 * np.log10(max(abs(np.exp(1j * wavenumber * (residual - residual.mean())).mean()), 1e-6))
        phase_rad = float("nan") if common else float(abs(wavenumber * error_m.mean()))
        return Effect(float(loss_db), float(np.linalg.norm(shift)), phase_rad)

    def of_noise(self, *parts: tuple[NDArray[np.float64], float]) -> Effect:
        """Return the mean effect of independent random path errors.

        Parameters
        ----------
        *parts
            For each error, its standard deviation at each pulse, (pulse,) float64, metres, and its correlation time as
            for `autocorrelation`, seconds.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 3.
        """
        # C, and R = PCP with P = 1 − GG⁺.
        lag = np.abs(np.subtract.outer(self.time_s, self.time_s))
        covariance = np.zeros_like(lag)
        for std_m, correlation_s in parts:
            covariance += autocorrelation(lag, correlation_s) * np.multiply.outer(std_m, std_m)
        ground = self.gradient[:, :2]
        inverse = np.linalg.pinv(ground)
        projected = ground @ (inverse @ covariance)  # in this order no product of square matrices is needed
        residual = covariance - projected - projected.T + (projected @ ground) @ inverse
        wavenumber = 2 * np.pi / self.wavelength_m
        # q, the mean variance about the mean over the pulses; N = (tr R)²/tr R²; L of eq. 3.
        centred = residual - residual.mean(axis=0) - residual.mean(axis=1)[:, None] + residual.mean()
        power = float(np.trace(centred)) / len(residual)
        independent = float(np.trace(centred) ** 2 / max((centred**2).sum(), 1e-300))
        kept = np.exp(-(wavenumber**2) * power)
        loss_db = 10 * np.log10(kept + (1 - kept) ** 2 / max(independent, 1.0))
        shift = np.sqrt(max(0.0, float(np.trace(inverse @ covariance @ inverse.T))))
        # q is a mean of N independent squares of equal weight: its relative standard deviation is √(2/N).
        scatter_db = 10 / np.log(10) * wavenumber**2 * power * np.sqrt(2 / max(independent, 1.0))
        phase_rad = float(wavenumber * np.sqrt(covariance.mean()))
        return Effect(float(loss_db), float(shift), phase_rad, float(min(scatter_db, -loss_db)))
