"""Effect of an error of the total path on a point: loss of the peak, shift and phase."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.aperture import Aperture

MOST_PULSES = 200
"""Pulses of `PointPaths`, evenly spread: effects of errors that last longer than a few of them are those of all."""


def autocorrelation(lag_s: NDArray[np.float64], correlation_s: float) -> NDArray[np.float64]:
    """Return the autocorrelation of position errors at a time lag: the definition of `position_correlation_s`.

    Parameters
    ----------
    lag_s
        Any shape, float64, seconds; not negative.
    correlation_s
        Correlation time, seconds: the length of the moving average that forms the errors from white noise; 0: errors of
        epochs are independent.

    Returns
    -------
    ndarray
        As `lag_s`; 1 at lag 0, falling linearly to 0 at `correlation_s`.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 3.

    Examples
    --------
    >>> autocorrelation(np.array([0.0, 0.5, 1.0, 2.0]), 1.0)
    array([1. , 0.5, 0. , 0. ])
    """
    if correlation_s <= 0:
        alone: NDArray[np.float64] = (lag_s == 0).astype(np.float64)
        return alone
    falling: NDArray[np.float64] = np.clip(1 - lag_s / correlation_s, 0, None)
    return falling


@dataclass(frozen=True)
class Effect:
    """Effect of an error on the image of a point.

    Attributes
    ----------
    loss_db
        Loss of the peak's power, 0 or less.
    shift_m
        Shift over ground, metres.
    phase_rad
        At a place on the ground, against a pair without that error; NaN where that is not predicted.
    loss_std_db
        Standard deviation of the loss from flight to flight, where the error is random.
    """

    loss_db: float
    shift_m: float
    phase_rad: float
    loss_std_db: float = 0.0


@dataclass(frozen=True, eq=False)
class PointPaths:
    """The total paths of one point of the scene, on at most a few hundred pulses.

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
        Of the band's middle.

    Examples
    --------
    >>> along = np.linspace(-5, 5, 101)
    >>> track = np.stack([along, np.full(101, -10.0), np.full(101, 10.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along, np.zeros(3), np.eye(3), 0.2)
    >>> higher = paths.of_offset(-paths.gradient[:, 2])  # the point lies a metre higher than it is taken to
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
        """Return the paths of a point at evenly spread pulses; parameters as the attributes, of all pulses."""
        some = aperture.sample(MOST_PULSES)
        return cls(aperture[some], time_s[some], point_m, axes, wavelength_m)

    @property
    def gradient(self) -> NDArray[np.float64]:
        """(pulse, 3) float64, growth of the path per metre that the point moves east, north, up."""
        return self.aperture.path_gradient(self.point_m) @ self.axes.T

    @property
    def rate_m_s(self) -> NDArray[np.float64]:
        """(pulse,) float64, growth of the path per second as the nodes fly, metres per second."""
        return np.gradient(self.aperture.path(self.point_m), self.time_s)

    def by_node(self, *, same: bool, sidelink: bool) -> tuple[NDArray[np.float64], ...]:
        """Return the growth of the measured path per metre of position error, (pulse, 3) east, north, up of each node.

        Parameters
        ----------
        same
            Transmitter and receiver are one node, whose error acts on both legs: one array instead of two.
        sidelink
            The echo was divided by a sidelink whose length comes from the same logs.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 4.
        """
        tx, rx, tx_sidelink, rx_sidelink = self.by_point(sidelink=sidelink and not same)
        legs = (tx + rx,) if same else (tx + tx_sidelink, rx + rx_sidelink)
        return tuple(leg @ self.axes.T for leg in legs)

    def by_point(self, *, sidelink: bool) -> tuple[NDArray[np.float64], ...]:
        """Return the growth of the measured path per metre that an antenna lies elsewhere than taken.

        Parameters
        ----------
        sidelink
            As of `by_node`, of two nodes.

        Returns
        -------
        tuple of ndarray
            (pulse, 3) float64 each, in the frame of the phase centres: radar antennas of transmitter and receiver,
            their sidelink antennas.

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
        """Return the effect of an error of the path.

        Parameters
        ----------
        error_m
            (pulse,) float64, metres by which paths are longer than the image takes them for.
        common
            All pairs share its cause, which moves their images nearly alike: the remaining phase between them is not
            predicted.

        Notes
        -----
        Source: docs/theory/focus.md, eq. 2: the part that fits a shift over ground moves the point, the rest defocuses
        it.
        """
        # Δx = G⁺e, r = e − GΔx and L of eq. 2.
        ground = self.gradient[:, :2]
        moved = np.linalg.pinv(ground) @ error_m
        rest = error_m - ground @ moved
        wavenumber = 2 * np.pi / self.wavelength_m
        loss_db = 20 * np.log10(max(abs(np.exp(1j * wavenumber * (rest - rest.mean())).mean()), 1e-6))
        phase_rad = float("nan") if common else float(abs(wavenumber * error_m.mean()))
        return Effect(float(loss_db), float(np.linalg.norm(moved)), phase_rad)

    def of_noise(self, *parts: tuple[NDArray[np.float64], float]) -> Effect:
        """Return the mean effect of independent random errors of the path.

        Parameters
        ----------
        *parts
            Standard deviation at each pulse, (pulse,) float64 metres, and correlation time, seconds, as
            `autocorrelation`.

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
        moved = ground @ (inverse @ covariance)  # of a projection onto two columns no square matrix is multiplied
        rest = covariance - moved - moved.T + (moved @ ground) @ inverse
        wavenumber = 2 * np.pi / self.wavelength_m
        # q, the mean variance about the mean over the pulses; N = (tr R)²/tr R²; L of eq. 3.
        centred = rest - rest.mean(axis=0) - rest.mean(axis=1)[:, None] + rest.mean()
        power = float(np.trace(centred)) / len(rest)
        independent = float(np.trace(centred) ** 2 / max((centred**2).sum(), 1e-300))
        kept = np.exp(-(wavenumber**2) * power)
        loss_db = 10 * np.log10(kept + (1 - kept) ** 2 / max(independent, 1.0))
        shift = np.sqrt(max(0.0, float(np.trace(inverse @ covariance @ inverse.T))))
        # q is a sum of `independent` squares of equal weight: its deviation is √(2/N) of itself
        scatter_db = 10 / np.log(10) * wavenumber**2 * power * np.sqrt(2 / max(independent, 1.0))
        phase_rad = float(wavenumber * np.sqrt(covariance.mean()))
        return Effect(float(loss_db), float(shift), phase_rad, float(min(scatter_db, -loss_db)))
