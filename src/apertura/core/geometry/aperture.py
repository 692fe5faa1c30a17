"""Synthetic aperture of a pair: phase centres at each pulse, total paths, phase rates and resolution."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, quoted

Weigh = Callable[[slice, NDArray[np.float64]], NDArray[np.float64]]
"""Slice of pulses and points (point, 3) → weights (pulse, point) float64."""

_PULSES_AT_ONCE = 2048
_STRETCHES = 64  # number of subapertures at which phase rates are evaluated
_STEPS_IN_A_ROW = 63  # consecutive steps over which the median is computed, so that missing pulses have no effect


_COARSEST_M = 2.0**-10
"""Spacing of floating-point numbers, metres, from which a track is rejected: the rounding error of the two-way path is
then 0.01 cycles at L-band."""


def distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance between points, (...,) float64.

    Parameters
    ----------
    first, second
        (..., 3) float64, in shapes that broadcast.

    Notes
    -----
    The result equals `numpy.linalg.norm` of the difference to the last bit. The computation takes at most a quarter of
    the time of `numpy.linalg.norm`, because the axes are processed separately.

    Examples
    --------
    >>> distance(np.zeros((2, 1, 3)), np.array([[3.0, 4.0, 0.0], [2.0, 3.0, 6.0]]))
    array([[5., 7.],
           [5., 7.]])
    """
    total, *others = (np.square(second[..., axis] - first[..., axis]) for axis in range(3))
    for other in others:
        total += other
    return np.sqrt(total)


def as_array(value: Any, kind: type, where: str) -> Any:
    """Convert an argument to an array of real or complex numbers; arrays, including lazy ones, are unchanged.

    Parameters
    ----------
    value
        An array, a list or a number.
    kind
        ``np.float64`` or ``np.complex64``. Real numbers are not accepted as complex samples, because the phase of the
        samples is lost.
    where
        Name of the argument in error messages.

    Raises
    ------
    CampaignError
        If the argument is not an array of numbers of this kind, or is a masked array.

    Examples
    --------
    >>> as_array([1, 2], np.float64, "weight")
    array([1., 2.])
    """
    try:
        # Arrays that are lazy by rows (tables of other modules) remain lazy; dask arrays are computed.
        lazy = hasattr(value, "ndim") and not hasattr(value, "__dask_graph__")
        array = value if lazy else np.asarray(value)
        usable = array.dtype.kind in ("c" if kind is np.complex64 else "iuf")
    except (TypeError, ValueError, AttributeError):
        usable = False
    if not usable:
        numbers = {"i": "integer", "u": "integer", "f": "real", "c": "complex"}.get(
            getattr(array, "dtype", np.dtype(object)).kind
        )
        raise CampaignError(
            f"an array of {numbers} numbers" if numbers and array.ndim else quoted(value),
            where=where,
            expected=f"an array of {'complex numbers' if kind is np.complex64 else 'real numbers'}",
            remedy="Pass complex samples I + jQ, including their phase."
            if kind is np.complex64 and numbers
            else "Pass a numpy array.",
        )
    if np.ma.is_masked(value):
        raise CampaignError(
            f"{int(np.ma.getmaskarray(value).sum())} masked values",
            where=where,
            expected="an array without masked values, because masks are ignored",
            remedy="Remove the pulses with masked values, or fill them.",
        )
    return _native(array, kind) if isinstance(array, np.ndarray) or not array.dtype.isnative else array


_KEPT: Mapping[type, tuple[type, ...]] = {
    np.float64: (np.float32, np.float64),
    np.complex64: (np.complex64, np.complex128),
}


def _native(array: Any, kind: type) -> NDArray[Any]:
    """Return a numpy array in native byte order, with a precision that the engines support."""
    plain = np.asarray(array)
    return plain if plain.dtype.isnative and plain.dtype.type in _KEPT[kind] else plain.astype(kind)


@dataclass(frozen=True, eq=False)
class Aperture:
    """Phase centres of a transmitter–receiver pair, pulse by pulse; both phase centres are equal for a monostatic node.

    Attributes
    ----------
    tx_m, rx_m
        (pulse, 3) float64, metres, in one Cartesian frame: ECEF or local.

    Raises
    ------
    CampaignError
        If an argument is not an array of numbers, or if the shapes differ or are not (pulse, 3).

    Examples
    --------
    >>> along = np.stack([np.arange(5.0), np.zeros(5), np.full(5, 3.0)], -1)
    >>> aperture = Aperture(along, along)
    >>> len(aperture), aperture.path(np.array([[0.0, 4.0, 0.0]]))[0], len(aperture[::2])
    (5, array([10.]), 3)
    """

    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("tx_m", "rx_m"):
            argument = getattr(self, name)
            position_m = as_array(argument, np.float64, f"Aperture: {name}")
            object.__setattr__(self, name, position_m)
            dtype = np.dtype(getattr(argument, "dtype", np.float64))
            farthest = float(np.abs(position_m).max(initial=0)) if dtype.kind == "f" and dtype.itemsize < 8 else 0.0
            spacing_m = float(np.spacing(np.array(farthest, dtype))) if farthest else 0.0
            if spacing_m >= _COARSEST_M:
                raise CampaignError(
                    f"{dtype.name}, in which adjacent numbers near {farthest:.3g} m differ by {spacing_m:.2g} m",
                    where=f"Aperture: {name}",
                    expected="float64, because phase centres must be accurate to a fraction of a wavelength",
                    remedy="Use float64 throughout, starting with the log.",
                )
        if self.tx_m.shape != self.rx_m.shape or self.tx_m.ndim != 2 or self.tx_m.shape[1] != 3:
            raise CampaignError(
                f"tx_m {self.tx_m.shape}, rx_m {self.rx_m.shape}",
                where="Aperture",
                expected="phase centres of the same number of pulses, (pulse, 3) each, metres",
                remedy="Pass one row of x, y and z per pulse; for a monostatic antenna, pass the same array twice.",
            )

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.tx_m)

    def copied(self) -> "Aperture":
        """Return a copy of the aperture; a monostatic aperture still has a single array."""
        tx_m = self.tx_m.copy()
        return Aperture(tx_m, tx_m if self.rx_m is self.tx_m else self.rx_m.copy())

    def __getitem__(self, pulses: slice | NDArray[np.bool_] | NDArray[np.int64]) -> "Aperture":
        """Return the aperture of the selected pulses; for slices, the arrays are views."""
        return Aperture(self.tx_m[pulses], self.rx_m[pulses])

    @property
    def legs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Phase centres of the transmitter and of the receiver."""
        return self.tx_m, self.rx_m

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Midpoints between both phase centres, (pulse, 3) float64."""
        return (self.tx_m + self.rx_m) / 2

    def sample(self, most: int) -> slice:
        """Return a slice that selects evenly spaced pulses, fewer than twice `most`.

        Examples
        --------
        >>> track = np.zeros((100, 3))
        >>> len(Aperture(track, track)[Aperture(track, track).sample(30)])
        34
        """
        return slice(None, None, max(1, len(self) // most))

    def blocks(self, count: int) -> list[slice]:
        """Divide the pulses into `count` consecutive slices whose lengths differ by at most one.

        Examples
        --------
        >>> track = np.zeros((7, 3))
        >>> Aperture(track, track).blocks(3)
        [slice(0, 2, None), slice(2, 4, None), slice(4, 7, None)]
        """
        ends = [number * len(self) // count for number in range(count + 1)]
        return [slice(*pair) for pair in pairwise(ends)]

    def path(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the total path transmitter → point → receiver.

        Parameters
        ----------
        points_m
            (..., 3) float64, metres, in the frame of the phase centres.

        Returns
        -------
        ndarray
            (pulse, ...) float64, metres.

        Notes
        -----
        Source: docs/theory.md, eq. 3.
        """
        tx, rx = (distance(self._against(leg, points_m), points_m) for leg in self.legs)
        return np.asarray(tx + rx)

    def path_gradient(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient of the total path with respect to the point, (pulse, ..., 3) float64, metres per metre.

        The gradient is the sum of the unit vectors from both phase centres to the point. Multiplied by 2πf/c, it is the
        spatial frequency at which a pulse samples the scene (docs/theory.md, eq. 8).
        """
        gradient = np.zeros((len(self), *points_m.shape))
        for leg in self.legs:
            offset_m = points_m - self._against(leg, points_m)
            gradient += offset_m / np.linalg.norm(offset_m, axis=-1, keepdims=True)
        return gradient

    def phase_rates(self, points_m: NDArray[np.float64], *, wavelength_m: float) -> tuple[float, float]:
        """Return the spread of phase rates over the scene, and the largest deviation from the rate at the centre.

        Both results are in cycles per pulse.

        Parameters
        ----------
        points_m
            (point, 3) float64, metres, distributed over the scene; the central element of the array is the scene
            centre.
        wavelength_m
            Wavelength of the highest frequency.

        Notes
        -----
        Source: docs/theory/planner.md, "Pulses". A spread above 1 causes azimuth ambiguities. The spread is the largest
        median of 63 consecutive steps, so that missing pulses and gaps are not mistaken for undersampling.

        Examples
        --------
        >>> track = np.stack([0.05 * np.arange(50.0), np.zeros(50), np.full(50, 10.0)], -1)
        >>> points = np.array([[-5.0, 10, 0], [1.25, 10, 0], [7.5, 10, 0]])
        >>> spread, widest = Aperture(track, track).phase_rates(points, wavelength_m=0.25)
        >>> 0.3 < spread < 0.4, widest < spread
        (True, True)
        """
        if len(self) < 2:
            return 0.0, 0.0
        spread, widest = np.zeros(len(self) - 1), 0.0
        for first in range(0, len(spread), _PULSES_AT_ONCE):
            rate = np.diff(self[first : first + _PULSES_AT_ONCE + 1].path(points_m), axis=0)
            spread[first : first + len(rate)] = np.ptp(rate, axis=1)
            widest = max(widest, float(np.abs(rate - rate[:, [len(points_m) // 2]]).max()))
        windows = np.lib.stride_tricks.sliding_window_view(spread, min(_STEPS_IN_A_ROW, len(spread)))
        return float(np.median(windows, axis=1).max()) / wavelength_m, widest / wavelength_m

    def ambiguities(self, points_m: NDArray[np.float64], *, wavelength_m: float) -> NDArray[np.float64]:
        """Return the level of azimuth ambiguities at each point of the scene, from echoes of the scene itself.

        Parameters
        ----------
        points_m
            (point, 3) float64, metres, distributed over the scene and including its corners.
        wavelength_m
            Wavelength of the highest frequency.

        Returns
        -------
        ndarray
            (point,) float64, number of orders n ≠ 0, mean over the pulses, for which any other point of the scene has a
            phase rate that differs by n cycles per pulse from the rate of the point. 0: unambiguous; 1: ambiguities are
            as strong as the echoes of the surroundings.

        Notes
        -----
        Source: docs/theory/planner.md, eq. 4. Rates are medians of 63 consecutive steps, as in `phase_rates`.

        Examples
        --------
        >>> track = np.stack([0.3 * np.arange(50.0), np.zeros(50), np.full(50, 10.0)], -1)
        >>> points = np.array([[-5.0, 10, 0], [1.25, 10, 0], [7.5, 10, 0]])
        >>> aperture = Aperture(track, track)
        >>> aperture.ambiguities(points, wavelength_m=1.0), aperture.ambiguities(points, wavelength_m=0.4).round(1)
        (array([0., 0., 0.]), array([1., 0., 1.]))
        """
        if len(self) < 2:
            return np.zeros(len(points_m))
        steps = min(_STEPS_IN_A_ROW, len(self) - 1)
        starts = np.unique(np.linspace(0, len(self) - 1 - steps, _STRETCHES).astype(int))
        stretches = (self[first : first + steps + 1].path(points_m) for first in starts)
        rate = np.array([np.median(np.diff(path, axis=0), axis=0) for path in stretches]) / wavelength_m
        lowest, highest = rate.min(axis=1, keepdims=True), rate.max(axis=1, keepdims=True)
        return np.asarray((np.floor(highest - rate) + np.floor(rate - lowest)).mean(axis=0))

    def resolution_cell_m(
        self, ground_m: NDArray[np.float64], *, band_hz: tuple[float, float], weigh: Weigh | None = None
    ) -> float:
        """Return the finest resolution cell of the scene along rows or columns, metres.

        Parameters
        ----------
        ground_m
            (row, column, 3) float64, metres: terrain points distributed over the scene, including its corners, rows
            from north to south.
        band_hz
            Lowest and highest frequency.
        weigh
            Pulses and points → weights; pulses with a weight below one half at a point are excluded at this point
            (default: all pulses are used).

        Notes
        -----
        Source: docs/theory.md, eq. 8: the inverse of the widest spatial spectrum of a point.
        """
        points, sample = ground_m.reshape(-1, 3), self.sample(64 if weigh is None else 1024)
        gradient = self[sample].path_gradient(points)
        if weigh is not None:
            gradient[weigh(sample, points) < 0.5] = np.nan
        finite = np.isfinite(gradient).all(axis=-1).any(axis=0)
        gradient, widest = gradient[:, finite], 1e-9
        for side in (ground_m[0, -1] - ground_m[0, 0], ground_m[-1, 0] - ground_m[0, 0]):
            slope = gradient @ side / max(float(np.linalg.norm(side)), 1e-9)
            cycles = np.concatenate([slope * frequency / SPEED_OF_LIGHT_M_S for frequency in band_hz])
            if cycles.size:
                widest = max(widest, float((np.nanmax(cycles, axis=0) - np.nanmin(cycles, axis=0)).max()))
        return 1 / widest

    def cross_cell_m(self, ground_m: NDArray[np.float64], *, wavelength_m: float) -> float:
        """Return the cross-range resolution at the scene centre, metres; infinite without motion.

        Parameters
        ----------
        ground_m
            (row, column, 3) float64, metres: terrain points distributed over the scene, including its corners, rows
            from north to south.
        wavelength_m
            Wavelength at band centre.

        Notes
        -----
        Source: docs/theory.md, eq. 8 at one frequency: λ divided by the largest spread of the path gradient along the
        terrain, that is, λ/2Δθ for a monostatic node that moves by an angle Δθ about the point.
        """
        middle = ground_m.reshape(-1, 3)[ground_m.size // 6]
        gradient = self[self.sample(64)].path_gradient(middle[None])[:, 0]
        sides = np.stack([ground_m[0, -1] - ground_m[0, 0], ground_m[-1, 0] - ground_m[0, 0]])
        sides = sides / np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), 1e-9)
        in_plane = (gradient - gradient.mean(axis=0)) @ sides.T
        _, _, directions = np.linalg.svd(in_plane, full_matrices=False)
        spread = float(np.ptp(in_plane @ directions[0]))
        return wavelength_m / spread if spread > 0 else float("inf")

    def spectrum(
        self,
        point_m: NDArray[np.float64],
        axes: NDArray[np.float64],
        *,
        frequency_hz: NDArray[np.float64],
        weigh: Weigh | None = None,
    ) -> NDArray[np.float64]:
        """Return the covariance of the spatial spectrum of a point along given axes, cycles² per m².

        Parameters
        ----------
        point_m
            (3,) float64, metres.
        axes
            (axis, 3) float64, unit vectors.
        frequency_hz
            (frequency,) float64, samples of the band, of equal weight.
        weigh
            As for `resolution_cell_m`.

        Returns
        -------
        ndarray
            (axis, axis) float64. If the noise power is ε relative to the power of the point, the position of the peak
            has the covariance ε/2·(4π²·spectrum)⁻¹ (docs/theory/focus.md, eq. 6).
        """
        sample = self.sample(64 if weigh is None else 1024)
        slope = self[sample].path_gradient(point_m) @ axes.T
        if weigh is not None:
            used = weigh(sample, point_m[None])[:, 0] >= 0.5
            slope = slope[used] if used.any() else slope  # for a point outside all sectors, all pulses are used
        cycles = slope[:, None] * (frequency_hz / SPEED_OF_LIGHT_M_S)[None, :, None]
        return np.asarray(np.cov(cycles.reshape(-1, len(axes)), rowvar=False, bias=True))

    @property
    def wobble_m(self) -> float:
        """RMS distance of the midpoints between both phase centres from the best-fitting straight line, metres.

        Examples
        --------
        >>> along = np.linspace(0, 30, 301)
        >>> track = np.stack([along, 0.1 * np.sin(4 * np.pi * along / 3), 0 * along], -1)
        >>> round(Aperture(track, track).wobble_m, 3)  # 0.1/√2
        0.071
        """
        offset_m = self.middle_m - self.middle_m.mean(axis=0)
        singular = np.linalg.svd(offset_m, compute_uv=False)
        return float(np.sqrt((singular[1:] ** 2).sum() / len(offset_m)))

    @staticmethod
    def _against(leg_m: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return phase centres reshaped to broadcast against the points."""
        return leg_m.reshape(-1, *(1,) * (points_m.ndim - 1), 3)
