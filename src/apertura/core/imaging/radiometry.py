"""Radiometry of an image: conversion of pixel power to the radar cross-section of a point and to σ⁰ of terrain."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats, is_number
from apertura.common.constants import BOLTZMANN_J_K, REFERENCE_K, SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.common.errors import CampaignError, quoted
from apertura.core.antenna.beam import Beams
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import Lattice, fill, pitch_px, pulses_of
from apertura.core.scene.recorded import RecordedShares
from apertura.core.scene.terrain import FlatGround, Terrain

Quantity = Literal["sigma0", "beta0", "gamma0"]

# ---- Radio link of a pair: from radar cross-section to recorded samples

MOST_DBM = 90.0
"""Largest accepted transmit power, dBm: values above one megawatt are attributed to a wrong unit."""


@dataclass(frozen=True)
class Link:
    """Link budget of a pair, from the radar cross-section of a target to the recorded samples.

    Attributes
    ----------
    transmit_power_dbm
        Mean power of the signal during transmission, at the port of the transmitting antenna.
    transmit_gain_dbi, receive_gain_dbi
        Peak gains of the antennas, to which the patterns are relative.
    receiver_gain_db
        Gain from the port of the receiving antenna to the ADC.
    full_scale_dbm
        Power at the ADC of a complex sinusoid with |I + jQ| = `full_scale_counts`.
    full_scale_counts
        Full-scale amplitude in recorded samples.

    Examples
    --------
    >>> link = Link(30.0, 10.0, 10.0, 40.0, 0.0, 8192.0)
    >>> round(link.constant(wavelength_m=0.25, sent_power=1.0) / link.counts_w * (4 * np.pi) ** 3 / 0.25**2, 6)
    100.0
    """

    transmit_power_dbm: float
    transmit_gain_dbi: float
    receive_gain_dbi: float
    receiver_gain_db: float
    full_scale_dbm: float
    full_scale_counts: float

    def __post_init__(self) -> None:
        wrong = [field.name for field in fields(self) if not is_number(getattr(self, field.name))]
        wrong += ["full_scale_counts"] * (not wrong and self.full_scale_counts <= 0)
        wrong += ["transmit_power_dbm"] * (not wrong and self.transmit_power_dbm > MOST_DBM)
        if wrong:
            expected = f"numbers in dB, counts above 0, and a transmit power of at most {MOST_DBM:g} dBm"
            raise CampaignError(quoted(getattr(self, wrong[0])), f"Link: {wrong[0]}", expected, f"Correct {wrong[0]}.")

    @property
    def counts_w(self) -> float:
        """|y|² of recorded samples per watt at the port of the receiving antenna."""
        return self.full_scale_counts**2 * 10 ** ((self.receiver_gain_db - self.full_scale_dbm + 30) / 10)

    def constant(self, *, wavelength_m: float, sent_power: float) -> float:
        """Return K of docs/theory/radiometry.md, eq. 2: |H|² of 1 m² at R_tx·R_rx = 1 m², on both boresights.

        Parameters
        ----------
        wavelength_m
            Wavelength at band centre.
        sent_power
            Mean |s|² of the transmitted signal, in the units of the signal by which echoes are divided: Σ|c_n|² for an
            OFDM symbol.

        Raises
        ------
        CampaignError
            If an argument is not a number above 0.
        """
        for name, value in (("wavelength_m", wavelength_m), ("sent_power", sent_power)):
            if not (is_number(value) and value > 0):
                raise CampaignError(quoted(value), f"Link.constant: {name}", "a number above 0", f"Correct {name}.")
        sent_dbw = self.transmit_power_dbm - 30 + self.transmit_gain_dbi + self.receive_gain_dbi
        return 10 ** (sent_dbw / 10) * wavelength_m**2 / (4 * np.pi) ** 3 * self.counts_w / sent_power

    def pulse_noise(self, noise_figure_db: float, *, spacing_hz: float, squares: float) -> float:
        """Return the power of thermal noise in a range profile, kT₀F over the DFT bins (eq. 8).

        Parameters
        ----------
        noise_figure_db
            Noise figure of the receiver, referred to the port of the antenna.
        spacing_hz
            Δf, bandwidth of a bin.
        squares
            Σw_n²/|c_n|², with the window w_n over the subcarriers and the codes c_n by which echoes are divided.
        """
        noise_w = BOLTZMANN_J_K * REFERENCE_K * 10 ** (noise_figure_db / 10) * spacing_hz
        return noise_w * self.counts_w * squares


def cell_constant(frequency_hz: Floats, weight: Floats) -> float:
    """Return c²/Δf · Σ w_n²/f_n, m²: contribution of the band to the area of a resolution cell (eq. 5).

    For a flat band without a window, this value is λ·c/B.

    Parameters
    ----------
    frequency_hz, weight
        (subcarrier,) float64: frequencies in equal steps, and weights that sum to 1.

    Examples
    --------
    >>> frequency = 1.2e9 + 1e5 * (np.arange(1000) - 500)
    >>> round(cell_constant(frequency, np.full(1000, 1e-3)) / (0.25 * 3.0), 2)
    1.0
    """
    spacing_hz = (frequency_hz[-1] - frequency_hz[0]) / (len(frequency_hz) - 1)
    return float(SPEED_OF_LIGHT_M_S**2 / spacing_hz * (weight**2 / frequency_hz).sum())


Turn = tuple[Floats, tuple[bool, bool]]
"""Attitude error: rotation vector (3,), rad, and two booleans, which are true if the error applies to the transmitting
and to the receiving antenna, respectively."""


def pointing_std_db(beams: Beams | None, aperture: Aperture, place_m: Floats, turns: Sequence[Turn]) -> float:
    """Return the standard deviation of the power of a point due to beam mispointing by attitude errors.

    Parameters
    ----------
    beams, aperture
        Weights used in image formation; and phase centres of all pulses.
    place_m
        (3,) float64, point of the scene, metres, in the frame of the aperture.
    turns
        Independent attitude errors of one standard deviation each.

    Returns
    -------
    float
        Standard deviation, dB; 0 if no antenna has a beam, or no beam illuminates the point.

    Notes
    -----
    Source: docs/theory/radiometry.md, eq. 19.
    """
    sampled = aperture.sample(_PULSES)
    antennas, point = beams and beams[sampled].antennas, place_m[None]
    if beams is None or antennas is None:
        return 0.0
    aperture = aperture[sampled]
    spread_m2 = np.prod([np.linalg.norm(place_m - leg, axis=-1) for leg in aperture.legs], axis=0)
    weight = beams[sampled].weight(aperture, point)[:, 0] / spread_m2

    def amplitude(vector: Floats, turned: tuple[bool, bool]) -> float:
        both = zip((antennas.transmit, antennas.receive), turned, strict=True)
        transmit, receive = (beam.turned(vector) if beam and on else beam for beam, on in both)
        mispointed = Beams(transmit, receive)
        return float((weight * mispointed.weight(aperture, point)[:, 0]).sum())

    nominal = amplitude(np.zeros(3), (False, False))
    perturbed = np.array([[amplitude(sign * vector, turned) for sign in (1, -1)] for vector, turned in turns])
    if not (nominal > 0 and perturbed.size):
        return 0.0
    changes_db = 20 * np.log10(np.maximum(perturbed, _LEAST * nominal) / nominal)
    return float(np.sqrt((changes_db**2).mean(axis=1).sum()))


# ---- Calibration of an image, on a lattice

_RANGE_SHARE = 24  # node pitch is range / 24: interpolation error of log gain and area 0.1 dB in a beam of 20°
_PULSES = 128  # minimum number of pulses summed for a block of the lattice; the largest number is twice this number
_POINT_PULSES = 8192  # the same limit for a single point
_BINS = 32  # bins of the pulse density over spatial frequency, whose square is integrated
_LEAST = 1e-3  # weight relative to the strongest pulse, below which a pulse does not extend the aperture
# n·n_s below which σ⁰ is NaN: a slope error of 1° then causes an error of 0.7 dB; n·n_s = 0 is the onset of layover
_STEEPEST = 0.1


@dataclass(frozen=True, eq=False)
class Calibration:
    """Radiometric calibration of an image: conversion of pixel power to cross-section and backscattering coefficients.

    Attributes
    ----------
    grid, terrain
        The scene.
    aperture, beams
        Phase centres of all pulses, and weights of the pulses in image formation (antennas, sector and gate). The
        lattice contains the weights of antennas and sector; values at pixels are multiplied by the recorded fractions.
    count
        M, by which the sum over pulses is divided.
    constant
        K of eq. 2, configured or measured.
    cell_m2
        Value of `cell_constant`.
    lattice
        Nodes at which the following arrays are computed.
    gain, area_m2, noise
        (node row, node column) float64: ln A² (eq. 3), ln of the resolution cell area on level ground (eq. 5), and
        ln Σw²/M² of the pixel noise; -inf where no pulse illuminates the node.
    directions
        (node row, node column, 3, 3) float64, unit vectors: vertical, normal of the slant plane, and bisector of the
        directions to both antennas.
    across
        (node row, node column) float64, sine of the incidence angle across the track: 0 at nadir.

    Notes
    -----
    Source: docs/theory/radiometry.md.
    """

    grid: SceneGrid
    terrain: Terrain
    aperture: Aperture
    beams: Beams | None
    count: int
    constant: float
    cell_m2: float
    lattice: Lattice
    gain: Floats
    area_m2: Floats
    noise: Floats
    directions: Floats
    across: Floats

    @classmethod
    def of(
        cls,
        grid: SceneGrid,
        terrain: Terrain,
        aperture: Aperture,
        beams: Beams | None,
        *,
        constant: float,
        cell_m2: float,
        count: int | None = None,
        threads: int = 1,
    ) -> "Calibration":
        """Return the calibration of an image.

        Parameters
        ----------
        grid, terrain, aperture, beams, constant, cell_m2, count
            As for `Calibration`, with positions in the processing frame of the grid (default of `count`: number of
            pulses).
        threads
            Number of lattice blocks computed concurrently.

        Examples
        --------
        >>> grid = SceneGrid("local", -4.0, 24.0, 0.5, (8, 16))
        >>> track = np.stack([np.linspace(-9, 9, 37), np.zeros(37), np.full(37, 10.0)], -1)
        >>> calibration = Calibration.of(grid, FlatGround(0.0), Aperture(track, track), None, constant=2.0,
        ...                              cell_m2=0.25 * 3.0)
        >>> window = (slice(4, 5), slice(8, 9))
        >>> per_m2, level = calibration.rcs_power(window)[0, 0], calibration.cell(window)[0, 0]
        >>> bool(abs(per_m2 / (2 / 580**2) - 1) < 0.2), level.round(2)  # about 2/R⁴
        (True, np.float64(0.28))
        """
        lattice = Lattice.of(grid.shape, pitch_px(grid, terrain, aperture, share=_RANGE_SHARE))
        gain, area, noise = (np.full(lattice.shape, -np.inf) for _ in range(3))
        calibration = cls(
            grid,
            terrain,
            aperture,
            beams,
            count or len(aperture),
            constant,
            cell_m2,
            lattice,
            gain,
            area,
            noise,
            np.zeros((*lattice.shape, 3, 3)),
            np.ones(lattice.shape),
        )
        fill(lattice, calibration._fill, grid, terrain, aperture, beams and beams.on_profiles, threads=threads)
        return calibration

    def _fill(self, block: Window, reaching: NDArray[np.bool_]) -> None:
        """Compute the nodes of a block of the lattice from the pulses that may illuminate it."""
        rows, columns = (at[part] for at, part in zip(self.lattice.nodes, block, strict=True))
        row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
        height_m = np.asarray(self.terrain.heights_at(self.grid, row, column), np.float64)
        points, above = (self.grid.positions_at(row, column, height_m + more) for more in (0.0, 1.0))
        up = (above - points) / np.linalg.norm(above - points, axis=-1, keepdims=True)
        reached = pulses_of(reaching, len(self.aperture))
        every = max(1, (reached.stop - reached.start) // _PULSES)
        sampled, share = slice(reached.start, reached.stop, every), every / self.count
        gradient = self.aperture[sampled].path_gradient(points)
        applied = self.beams and self.beams[sampled].on_profiles
        parts, weight = point_weights(self.aperture[sampled], applied, points)
        amplitude = parts.sum(axis=0) * share
        slant, towards = _directions(gradient, parts, up)
        level = _spread(gradient.swapaxes(0, 1), parts.T, up)
        shape = (len(rows), len(columns))
        with np.errstate(divide="ignore"):
            self.gain[block] = 2 * np.log(amplitude).reshape(shape)
            self.area_m2[block] = np.log(self.cell_m2 * level).reshape(shape)
            self.noise[block] = np.log((weight**2).sum(axis=0) * share / self.count).reshape(shape)
        self.across[block] = _across(gradient, parts, up).reshape(shape)
        self.directions[block] = np.stack([up, slant, towards], axis=1).reshape(*shape, 3, 3)

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the image power of point targets, and the noise power relative to that of a pulse, at points.

        The power of a point target with a radar cross-section of 1 m² is K·A².

        Parameters
        ----------
        points
            (point, 3) float64, metres, in the frame of the aperture.

        Returns
        -------
        tuple of ndarray
            (point,) float64 each; zero where no pulse illuminates the point.
        """
        _, parts, noise = point_parts(self.aperture, self.beams, points, count=self.count)
        return self.constant * parts.sum(axis=0) ** 2, noise

    def _between(self, logarithms: Floats, window: Window) -> Floats:
        """Interpolate values at the pixels of a window between nodes with finite values; NaN if there are none."""
        known = np.isfinite(logarithms)
        share = self.lattice.between(known.astype(np.float64), window)
        mean = self.lattice.between(np.where(known, logarithms, 0.0), window)
        return np.where(share > 0, np.exp(mean / np.where(share > 0, share, 1.0)), np.nan)

    def rcs_power(self, window: Window) -> Floats:
        """Return the power |I|² of a point target with a radar cross-section of 1 m², K·A², at each pixel of a window.

        The power is NaN at pixels that are not illuminated.
        """
        power, shares = self.constant * self._between(self.gain, window), self._recorded.at(window)
        return power if shares is None else power * _or_nan(shares[0]) ** 2

    def cell(self, window: Window) -> Floats:
        """Return the area of a resolution cell on level ground, m², at each pixel of a window."""
        area_m2, shares = self._between(self.area_m2, window), self._recorded.at(window)
        return area_m2 if shares is None else area_m2 * shares[1] / _or_nan(shares[0]) ** 2

    def pixel_noise(self, window: Window) -> Floats:
        """Return the noise power at each pixel of a window relative to that of a pulse, Σw²/M²."""
        noise, shares = self._between(self.noise, window), self._recorded.at(window)
        return noise if shares is None else noise * _or_nan(shares[1])

    @cached_property
    def _recorded(self) -> RecordedShares:
        return RecordedShares(self.grid, self.terrain, self.aperture, self.beams)

    def power(self, window: Window, quantity: Quantity, normal: Floats | None = None) -> Floats:
        """Return the mean power |I|² of terrain whose σ⁰, β⁰ or γ⁰ is 1, at each pixel of a window.

        Parameters
        ----------
        window
            Rows and columns of the grid.
        quantity
            sigma0, normalised to terrain area; beta0, normalised to area in the slant plane; or gamma0, normalised to
            area perpendicular to the bisector.
        normal
            (row, column, 3) float64, upward unit normals of the terrain (default: level).

        Returns
        -------
        ndarray
            (row, column) float64. NaN where no pulse illuminates the pixel. For sigma0 of level terrain, also NaN
            within 5.7° of nadir. With `normal`, also NaN in and near layover, where the area is ill-conditioned; and
            for gamma0, on slopes that face away from the radar.
        """
        level = self.rcs_power(window) * self.cell(window)
        if quantity == "sigma0" and (normal is None or isinstance(self.terrain, FlatGround)):
            if not (self.across < _STEEPEST).any():
                return level
            return np.where(self.lattice.between(self.across, window) < _STEEPEST, np.nan, level)
        up, slant, towards = np.moveaxis(self.lattice.between(self.directions, window), -2, 0)
        slant, towards = _unit(slant), _unit(towards)
        normal = up if normal is None else normal
        in_plane = level * np.abs((up * slant).sum(-1))
        if quantity == "beta0":
            return np.asarray(in_plane)
        upright = (normal * slant).sum(-1)
        sigma0 = in_plane / np.where(upright >= _STEEPEST, upright, np.nan)
        if quantity == "sigma0":
            return np.asarray(sigma0)
        cosine = (normal * towards).sum(-1)
        return np.asarray(sigma0 * np.where(cosine > 0, cosine, np.nan))


def point_weights(aperture: Aperture, beams: Beams | None, points: Floats) -> tuple[Floats, Floats]:
    """Return the contribution of each pulse to a point target, w·f/(R_tx·R_rx), and w, (pulse, point) each.

    Parameters as for `point_parts`, which divides these contributions by the number of pulses.

    Examples
    --------
    >>> track = np.array([[0.0, 0.0, 10.0]])
    >>> [array.tolist() for array in point_weights(Aperture(track, track), None, np.zeros((1, 3)))]
    [[[0.01]], [[1.0]]]
    """
    tx_range_m, rx_range_m = (np.linalg.norm(points - leg[:, None], axis=-1) for leg in aperture.legs)
    antennas, coverage = (beams.antennas, beams.coverage(aperture)) if beams else (None, None)
    field = np.ones(tx_range_m.shape) if antennas is None else antennas.weight(aperture, points)
    weight = field if coverage is None else field * coverage(slice(None), points)
    return weight * field / (tx_range_m * rx_range_m), weight


def point_parts(
    aperture: Aperture, beams: Beams | None, points: Floats, *, count: int
) -> tuple[Aperture, Floats, Floats]:
    """Return the contributions of pulses to the image of points of 1 m² with K = 1, the terms of A in eq. 3.

    Parameters
    ----------
    aperture, beams, count
        As for `Calibration`.
    points
        (point, 3) float64, metres, in the frame of the aperture.

    Returns
    -------
    tuple
        Phase centres of the pulses used, a regular subsample; (pulse, point) float64, contributions of these pulses,
        which add up to A; and (point,) float64, noise power relative to that of a pulse.

    Examples
    --------
    >>> track = np.array([[0.0, 0.0, 10.0]] * 4)
    >>> _, parts, noise = point_parts(Aperture(track, track), None, np.zeros((1, 3)), count=4)
    >>> round(float(parts.sum()), 6), float(noise[0])
    (0.01, 0.25)
    """
    sampled = aperture.sample(_POINT_PULSES)
    pulses, share = aperture[sampled], sampled.step / count
    parts, weight = point_weights(pulses, beams and beams[sampled], points)
    return pulses, parts * share, (weight**2).sum(axis=0) * share / count


def _or_nan(share: Floats) -> Floats:
    """Return shares with NaN where nothing is recorded."""
    return np.where(share > 0, share, np.nan)


def _directions(gradient: Floats, parts: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Return the upward normals of the slant planes, and unit vectors along the bisectors, (point, 3) each."""
    size = np.abs(parts)
    weight = size / np.maximum(size.sum(axis=0), 1e-300)
    mean = np.einsum("pk,pkc->kc", weight, gradient)
    deviation = gradient - mean
    spread = np.einsum("pk,pkc,pkd->kcd", weight, deviation, deviation)
    slant = np.cross(mean, np.linalg.eigh(spread)[1][..., -1])
    slant *= np.where((slant * up).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    return _unit(slant), _unit(-mean)


def _across(gradient: Floats, parts: Floats, up: Floats) -> Floats:
    """Return the sine of the incidence angle across the track, (point,).

    The value is half the RMS of a component of the horizontal gradient, perpendicular to the principal axis of the
    gradient's spread over the pulses. It equals sin θ to the side of a straight track, and has the same order of
    magnitude at the centre of a circular track.
    """
    size = np.abs(parts)
    weight = size / np.maximum(size.sum(axis=0), 1e-300)
    level = gradient - (gradient * up).sum(-1, keepdims=True) * up
    deviation = level - np.einsum("pk,pkc->kc", weight, level)
    spread = np.einsum("pk,pkc,pkd->kcd", weight, deviation, deviation)
    aside = np.cross(up, np.linalg.eigh(spread)[1][..., -1])
    return np.asarray(np.sqrt(np.einsum("pk,pk->k", weight, (level * aside).sum(-1) ** 2)) / 2)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _spread(gradient: Floats, parts: Floats, up: Floats) -> Floats:
    """Return ∫(dU/ds)² ds / U² at each point, per unit of spatial frequency on level ground (eq. 5).

    Pulses are sorted by azimuth, so that contributions of an irregular or repeated track accumulate at their spatial
    frequency. The density of contributions is averaged over bins of the aperture, because finer structure of the
    density affects only points far from the cell.

    Parameters
    ----------
    gradient
        (point, pulse, 3) float64, gradient of the total path.
    parts
        (point, pulse) float64, contribution of each pulse to a point target.
    up
        (point, 3) float64, unit vectors.

    Returns
    -------
    ndarray
        (point,) float64; NaN where fewer than two pulses have a significant weight, or where all pulses with a
        significant weight have the same spatial frequency.
    """
    # Spatial frequency of each pulse on level ground: its azimuth relative to the mean, and its squared magnitude.
    points, pulses = parts.shape
    size = np.abs(parts)
    counts = size > _LEAST * size.max(axis=1, initial=0.0, keepdims=True)
    many = counts.sum(axis=1)
    parts = np.where(counts, parts, 0.0)
    level = gradient - (gradient @ up[:, :, None]) * up[:, None]
    mean = (parts[:, None] @ level)[:, 0]
    ahead = _unit(mean)
    across = np.cross(up, ahead)
    azimuth = np.arctan2((level @ across[:, :, None])[..., 0], (level @ ahead[:, :, None])[..., 0])
    # Insignificant pulses are sorted behind the significant ones, and the steps between them are set to zero.
    order = np.argsort(np.where(counts, azimuth, np.inf), axis=1, kind="stable")
    parts, azimuth = (np.take_along_axis(array, order, axis=1) for array in (parts, azimuth))
    # s: ∫|f|² dφ from pulse to pulse.
    squared = np.take_along_axis((level**2).sum(axis=-1), order, axis=1)
    counted = np.arange(pulses) < many[:, None]
    steps = np.diff(azimuth, axis=1) * (squared[:, 1:] + squared[:, :-1]) / 2 * counted[:, 1:]
    arc = np.concatenate([np.zeros((points, 1)), np.cumsum(steps, axis=1)], axis=1)
    spread, known = np.full(points, np.nan), (many > 1) & (arc[:, -1] > 0)
    if not known.any():
        return spread
    # U(s): running sum of the contributions from half a step before the first pulse to half a step after the last one.
    arc, parts, many = arc[known], parts[known], many[known, None]
    length, edge = arc[:, -1:], 1 / (2 * (many - 1))  # a pulse represents half a step on both sides
    arc = np.concatenate([-edge, arc / length, 1 + edge], axis=1)
    summed = np.cumsum(parts, axis=1)
    total = summed[:, -1:]
    summed = np.concatenate([np.zeros_like(total), summed - parts / 2, total], axis=1)
    # One interpolation for all points: on a common axis, the interval of each point is offset by 4 from the previous.
    bins = np.minimum(_BINS, many)
    at = np.minimum(np.arange(_BINS + 1) / bins, 1.0) * (1 + 2 * edge) - edge
    offset = 4.0 * np.arange(len(arc))[:, None]
    # dU/ds in bins, and eq. 5.
    density = np.diff(
        np.interp((at + offset).ravel(), (arc + offset).ravel(), summed.ravel()).reshape(at.shape), axis=1
    )
    spread[known] = (density**2).sum(axis=1) / ((1 + 2 * edge) * length / bins * total**2)[:, 0]
    return spread
