"""Radiometry of an image: from the power of a pixel to the radar cross-section of a point, and to σ⁰ of ground."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
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
from apertura.core.scene.terrain import FlatGround, Terrain

Quantity = Literal["sigma0", "beta0", "gamma0"]

# ---- The radio link of a pair: radar cross-section to numbers recorded

MOST_DBM = 90.0
"""A megawatt: more is a slip of units."""


@dataclass(frozen=True)
class Link:
    """What lies between the radar cross-section of a target and the numbers that a receiver records of it.

    Attributes
    ----------
    transmit_power_dbm
        Mean power of the signal while it is sent, at the port of the transmitting antenna.
    transmit_gain_dbi, receive_gain_dbi
        Peak gains of the antennas; patterns are relative to them.
    receiver_gain_db
        From the port of the receiving antenna to the converter.
    full_scale_dbm
        Power at the converter of a complex sine whose |I + jQ| is `full_scale_counts`.
    full_scale_counts
        In the numbers recorded.

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
        wrong = [one.name for one in fields(self) if not is_number(getattr(self, one.name))]
        wrong += ["full_scale_counts"] * (not wrong and self.full_scale_counts <= 0)
        wrong += ["transmit_power_dbm"] * (not wrong and self.transmit_power_dbm > MOST_DBM)
        if wrong:
            expected = f"numbers in dB, counts above 0, and no more than {MOST_DBM:g} dBm sent"
            raise CampaignError(
                quoted(getattr(self, wrong[0])), f"Link: {wrong[0]}", expected, "Correct what is named."
            )

    @property
    def counts_w(self) -> float:
        """|y|² of the numbers recorded per watt at the receiving antenna's port."""
        return self.full_scale_counts**2 * 10 ** ((self.receiver_gain_db - self.full_scale_dbm + 30) / 10)

    def constant(self, *, wavelength_m: float, sent_power: float) -> float:
        """Return K of docs/theory/radiometry.md, eq. 2: |H|² of 1 m² at R_tx·R_rx = 1 m², on both boresights.

        Parameters
        ----------
        wavelength_m
            At the middle of the band.
        sent_power
            Mean |s|² of the transmitted signal in the units that echoes are divided by: Σ|c_n|² of an OFDM symbol.

        Raises
        ------
        CampaignError
            If one of them is no number above 0.
        """
        for name, value in (("wavelength_m", wavelength_m), ("sent_power", sent_power)):
            if not (is_number(value) and value > 0):
                raise CampaignError(
                    quoted(value), f"Link.constant: {name}", "a number above 0", "Correct what is named."
                )
        sent_dbw = self.transmit_power_dbm - 30 + self.transmit_gain_dbi + self.receive_gain_dbi
        return 10 ** (sent_dbw / 10) * wavelength_m**2 / (4 * np.pi) ** 3 * self.counts_w / sent_power

    def pulse_noise(self, noise_figure_db: float, *, spacing_hz: float, squares: float) -> float:
        """Return the power of thermal noise in a range profile, kT₀F over the DFT's bins: eq. 8.

        Parameters
        ----------
        noise_figure_db
            Of the receiver, at the antenna's port.
        spacing_hz
            Δf, bandwidth of a bin.
        squares
            Σw_n²/|c_n|²: window over the subcarriers, and codes by which echoes are divided.
        """
        noise_w = BOLTZMANN_J_K * REFERENCE_K * 10 ** (noise_figure_db / 10) * spacing_hz
        return noise_w * self.counts_w * squares


def cell_constant(frequency_hz: Floats, weight: Floats) -> float:
    """Return c²/Δf · Σ w_n²/f_n, m²: what the band contributes to the area of a resolution cell (eq. 5).

    λ·c/B of a flat band without window.

    Parameters
    ----------
    frequency_hz, weight
        (subcarrier,) float64, in equal steps; weights that sum to 1.

    Examples
    --------
    >>> frequency = 1.2e9 + 1e5 * (np.arange(1000) - 500)
    >>> round(cell_constant(frequency, np.full(1000, 1e-3)) / (0.25 * 3.0), 2)
    1.0
    """
    spacing_hz = (frequency_hz[-1] - frequency_hz[0]) / (len(frequency_hz) - 1)
    return float(SPEED_OF_LIGHT_M_S**2 / spacing_hz * (weight**2 / frequency_hz).sum())


Turn = tuple[Floats, tuple[bool, bool]]
"""One error of attitude: rotation vector (3,), rad, and whether it turns the transmitting and the receiving antenna."""


def pointing_std_db(beams: Beams | None, aperture: Aperture, place_m: Floats, turns: Sequence[Turn]) -> float:
    """Return what errors of attitude do to the power of a point, by beams that look elsewhere than they are taken to.

    Parameters
    ----------
    beams, aperture
        Weights as they formed the image, and every pulse.
    place_m
        (3,) float64, metres, in the frame of the aperture.
    turns
        Independent errors, each of one standard deviation.

    Returns
    -------
    float
        Standard deviation, dB; 0 without antennas that have a beam, or where none sees the place.

    Notes
    -----
    Source: docs/theory/radiometry.md, eq. 19.
    """
    some = aperture.sample(_PULSES)
    antennas, place = beams and beams[some].antennas, place_m[None]
    if beams is None or antennas is None:
        return 0.0
    aperture = aperture[some]
    spread_m2 = np.prod([np.linalg.norm(place_m - leg, axis=-1) for leg in aperture.legs], axis=0)
    weight = beams[some].weight(aperture, place)[:, 0] / spread_m2

    def amplitude(vector: Floats, turned: tuple[bool, bool]) -> float:
        both = zip((antennas.transmit, antennas.receive), turned, strict=True)
        transmit, receive = (beam.turned(vector) if beam and on else beam for beam, on in both)
        moved = Beams(transmit, receive)
        return float((weight * moved.weight(aperture, place)[:, 0]).sum())

    right = amplitude(np.zeros(3), (False, False))
    seen = np.array([[amplitude(sign * vector, turned) for sign in (1, -1)] for vector, turned in turns])
    if not (right > 0 and seen.size):
        return 0.0
    changes_db = 20 * np.log10(np.maximum(seen, _LEAST * right) / right)
    return float(np.sqrt((changes_db**2).mean(axis=1).sum()))


# ---- Calibration of an image, on a lattice

_RANGE_SHARE = 24  # ranges to the scene: logarithms of gain and area between nodes then err by 0.1 dB in a beam of 20°
_PULSES = 128  # summed for a block of the lattice, or up to twice as many
_POINT_PULSES = 8192  # summed for a point, or up to twice as many
_BINS = 32  # of the density of pulses over spatial frequency, whose square is integrated
_LEAST = 1e-3  # of the strongest pulse: weaker ones do not decide how wide the aperture is
_STEEPEST = 0.1  # n·n_s below which no σ⁰ is told: there 1° of error of the slope is 0.7 dB, and zero is layover


@dataclass(frozen=True, eq=False)
class Calibration:
    """What turns the power of an image's pixels into radar cross-section and backscattering coefficients.

    Attributes
    ----------
    grid, terrain
        The scene.
    aperture, beams
        Every pulse, and its weights as they formed the image: antennas and sector.
    count
        M, by which the image's sum was divided.
    constant
        K of eq. 2, stated or measured.
    cell_m2
        Of `cell_constant`.
    lattice
        Nodes at which the following are computed.
    gain, area_m2, noise
        (node row, node column) float64: ln A² (eq. 3), ln of the cell's area on level ground (eq. 5), and ln Σw²/M² of
        the pixel's noise; -inf where no pulse sees the node.
    directions
        (node row, node column, 3, 3) float64, unit vectors: up, normal of the slant plane, towards the bisector of
        both antennas.
    across
        (node row, node column) float64, sine of the incidence across the track: 0 at nadir.

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
            As of `Calibration`; positions in the grid's processing frame; `count` is every pulse by default.
        threads
            Blocks of the lattice in work at once.

        Examples
        --------
        >>> grid = SceneGrid("local", -4.0, 24.0, 0.5, (8, 16))
        >>> track = np.stack([np.linspace(-9, 9, 37), np.zeros(37), np.full(37, 10.0)], -1)
        >>> one = Calibration.of(grid, FlatGround(0.0), Aperture(track, track), None, constant=2.0, cell_m2=0.25 * 3.0)
        >>> window = (slice(4, 5), slice(8, 9))
        >>> per_m2, level = one.rcs_power(window)[0, 0], one.cell(window)[0, 0]
        >>> bool(abs(per_m2 / (2 / 580**2) - 1) < 0.2), level.round(2)  # about 2/R⁴
        (True, np.float64(0.28))
        """
        lattice = Lattice.of(grid.shape, pitch_px(grid, terrain, aperture, share=_RANGE_SHARE))
        gain, area, noise = (np.full(lattice.shape, -np.inf) for _ in range(3))
        found = cls(
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
        fill(lattice, found._fill, grid, terrain, aperture, beams, threads=threads)
        return found

    def _fill(self, block: Window, reaching: NDArray[np.bool_]) -> None:
        """Compute the nodes of a block of the lattice from the pulses that may illuminate it."""
        rows, columns = (at[part] for at, part in zip(self.lattice.nodes, block, strict=True))
        row, column = (one.ravel() for one in np.meshgrid(rows, columns, indexing="ij"))
        height_m = np.asarray(self.terrain.heights_at(self.grid, row, column), np.float64)
        points, above = (self.grid.positions_at(row, column, height_m + more) for more in (0.0, 1.0))
        up = (above - points) / np.linalg.norm(above - points, axis=-1, keepdims=True)
        reached = pulses_of(reaching, len(self.aperture))
        every = max(1, (reached.stop - reached.start) // _PULSES)
        some, share = slice(reached.start, reached.stop, every), every / self.count
        gradient = self.aperture[some].path_gradient(points)
        share_of, weight = point_weights(self.aperture[some], self.beams and self.beams[some], points)
        amplitude = share_of.sum(axis=0) * share
        slant, towards = _directions(gradient, share_of, up)
        level = _spread(gradient.swapaxes(0, 1), share_of.T, up)
        shape = (len(rows), len(columns))
        with np.errstate(divide="ignore"):
            self.gain[block] = 2 * np.log(amplitude).reshape(shape)
            self.area_m2[block] = np.log(self.cell_m2 * level).reshape(shape)
            self.noise[block] = np.log((weight**2).sum(axis=0) * share / self.count).reshape(shape)
        self.across[block] = _across(gradient, share_of, up).reshape(shape)
        self.directions[block] = np.stack([up, slant, towards], axis=1).reshape(*shape, 3, 3)

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the power of 1 m² in the image, K·A², and of the noise in units of a pulse's, at points.

        Parameters
        ----------
        points
            (point, 3) float64, metres, in the frame of the aperture.

        Returns
        -------
        tuple of ndarray
            (point,) float64 each; zero where no pulse sees the point.
        """
        _, parts, noise = point_parts(self.aperture, self.beams, points, count=self.count)
        return self.constant * parts.sum(axis=0) ** 2, noise

    def _between(self, logarithms: Floats, window: Window) -> Floats:
        """Return values at the pixels of a window, between those nodes that have any; NaN where none has."""
        known = np.isfinite(logarithms)
        share = self.lattice.between(known.astype(np.float64), window)
        mean = self.lattice.between(np.where(known, logarithms, 0.0), window)
        return np.where(share > 0, np.exp(mean / np.where(share > 0, share, 1.0)), np.nan)

    def rcs_power(self, window: Window) -> Floats:
        """Return the power |I|² of a point of 1 m² at each pixel of a window, K·A²; NaN where nothing sees it."""
        return self.constant * self._between(self.gain, window)

    def cell(self, window: Window) -> Floats:
        """Return the area of a resolution cell on level ground, m², at each pixel of a window."""
        return self._between(self.area_m2, window)

    def pixel_noise(self, window: Window) -> Floats:
        """Return the noise of each pixel of a window in units of a pulse's, Σw²/M²."""
        return self._between(self.noise, window)

    def power(self, window: Window, quantity: Quantity, normal: Floats | None = None) -> Floats:
        """Return the mean power |I|² of ground whose σ⁰, β⁰ or γ⁰ is 1, at each pixel of a window.

        Parameters
        ----------
        window
            Of the grid.
        quantity
            sigma0, per area of ground; beta0, per area of the slant plane; gamma0, per area across the bisector.
        normal
            (row, column, 3) float64, unit normals of the ground, upward; level ground by default.

        Returns
        -------
        ndarray
            (row, column) float64, NaN where no pulse sees the pixel, and for sigma0 of level ground within 5.7° of
            nadir; with normals where the ground is so near to layover that its area is hardly known, beyond it, or
            faces away (gamma0).
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
    """Return what each pulse adds to a point target, w·f/(R_tx·R_rx), and w, (pulse, point) each.

    Parameters as of `point_parts`, which divides them by the count of pulses.

    Examples
    --------
    >>> track = np.array([[0.0, 0.0, 10.0]])
    >>> [one.tolist() for one in point_weights(Aperture(track, track), None, np.zeros((1, 3)))]
    [[[0.01]], [[1.0]]]
    """
    there, back = (np.linalg.norm(points - leg[:, None], axis=-1) for leg in aperture.legs)
    antennas, sector = beams and beams.antennas, beams and beams.sector
    field = np.ones(there.shape) if antennas is None else antennas.weight(aperture, points)
    weight = field if sector is None else field * sector.weight(aperture, points)
    return weight * field / (there * back), weight


def point_parts(
    aperture: Aperture, beams: Beams | None, points: Floats, *, count: int
) -> tuple[Aperture, Floats, Floats]:
    """Return what pulses add to the image of points of 1 m² where K is 1, the parts of A of eq. 3.

    Parameters
    ----------
    aperture, beams, count
        As of `Calibration`.
    points
        (point, 3) float64, metres, in the frame of the aperture.

    Returns
    -------
    tuple
        The pulses taken, every so many; (pulse, point) float64, their parts, which add up to A; (point,) float64,
        the noise in units of a pulse's.

    Examples
    --------
    >>> track = np.array([[0.0, 0.0, 10.0]] * 4)
    >>> _, parts, noise = point_parts(Aperture(track, track), None, np.zeros((1, 3)), count=4)
    >>> round(float(parts.sum()), 6), float(noise[0])
    (0.01, 0.25)
    """
    some = aperture.sample(_POINT_PULSES)
    taken, share = aperture[some], some.step / count
    parts, weight = point_weights(taken, beams and beams[some], points)
    return taken, parts * share, (weight**2).sum(axis=0) * share / count


def _directions(gradient: Floats, parts: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Return the normals of the slant planes, on the side of up, and directions towards the bisectors, (point, 3)."""
    size = np.abs(parts)
    weight = size / np.maximum(size.sum(axis=0), 1e-300)
    mean = np.einsum("pk,pkc->kc", weight, gradient)
    apart = gradient - mean
    spread = np.einsum("pk,pkc,pkd->kcd", weight, apart, apart)
    slant = np.cross(mean, np.linalg.eigh(spread)[1][..., -1])
    slant *= np.where((slant * up).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    return _unit(slant), _unit(-mean)


def _across(gradient: Floats, parts: Floats, up: Floats) -> Floats:
    """Return the sine of the incidence across the direction in which the gradient moves along the track, (point,).

    Half of the rms of the level gradient's component across the main axis of its own spread over the pulses: R sin θ
    aside a straight track, and of the same order at the middle of a circle.
    """
    size = np.abs(parts)
    weight = size / np.maximum(size.sum(axis=0), 1e-300)
    level = gradient - (gradient * up).sum(-1, keepdims=True) * up
    apart = level - np.einsum("pk,pkc->kc", weight, level)
    spread = np.einsum("pk,pkc,pkd->kcd", weight, apart, apart)
    aside = np.cross(up, np.linalg.eigh(spread)[1][..., -1])
    return np.asarray(np.sqrt(np.einsum("pk,pk->k", weight, (level * aside).sum(-1) ** 2)) / 2)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _spread(gradient: Floats, parts: Floats, up: Floats) -> Floats:
    """Return ∫(dU/ds)² ds / U² of each place, per unit of spatial frequency on level ground: eq. 5.

    Pulses are sorted by azimuth, so that a track which wobbles or passes twice is counted as it adds up, and their
    density is taken over parts of the aperture, since what is finer scatters far beyond the cell.

    Parameters
    ----------
    gradient
        (place, pulse, 3) float64, of the total path.
    parts
        (place, pulse) float64, what each pulse adds to a point target.
    up
        (place, 3) float64, unit vectors.

    Returns
    -------
    ndarray
        (place,) float64; NaN where fewer than two pulses count, or none moves the spatial frequency.
    """
    # Spatial frequency of each pulse on level ground: its azimuth about the mean, and its square.
    places, pulses = parts.shape
    size = np.abs(parts)
    counts = size > _LEAST * size.max(axis=1, initial=0.0, keepdims=True)
    many = counts.sum(axis=1)
    parts = np.where(counts, parts, 0.0)
    level = gradient - (gradient @ up[:, :, None]) * up[:, None]
    mean = (parts[:, None] @ level)[:, 0]
    ahead = _unit(mean)
    across = np.cross(up, ahead)
    azimuth = np.arctan2((level @ across[:, :, None])[..., 0], (level @ ahead[:, :, None])[..., 0])
    # Pulses that do not count are sorted behind the others, where steps between them are nothing.
    order = np.argsort(np.where(counts, azimuth, np.inf), axis=1, kind="stable")
    parts, azimuth = (np.take_along_axis(one, order, axis=1) for one in (parts, azimuth))
    # s: ∫|f|² dφ from pulse to pulse.
    squared = np.take_along_axis((level**2).sum(axis=-1), order, axis=1)
    counted = np.arange(pulses) < many[:, None]
    steps = np.diff(azimuth, axis=1) * (squared[:, 1:] + squared[:, :-1]) / 2 * counted[:, 1:]
    place = np.concatenate([np.zeros((places, 1)), np.cumsum(steps, axis=1)], axis=1)
    spread, known = np.full(places, np.nan), (many > 1) & (place[:, -1] > 0)
    if not known.any():
        return spread
    # U(s): the running sum of the parts, from half a step before the first pulse to half a step behind the last.
    place, parts, many = place[known], parts[known], many[known, None]
    length, edge = place[:, -1:], 1 / (2 * (many - 1))  # a pulse stands for half a step on both sides
    place = np.concatenate([-edge, place / length, 1 + edge], axis=1)
    summed = np.cumsum(parts, axis=1)
    total = summed[:, -1:]
    summed = np.concatenate([np.zeros_like(total), summed - parts / 2, total], axis=1)
    # All places end to end on one axis, so far apart that none reaches the next: one interpolation for all of them.
    bins = np.minimum(_BINS, many)
    at = np.minimum(np.arange(_BINS + 1) / bins, 1.0) * (1 + 2 * edge) - edge
    apart = 4.0 * np.arange(len(place))[:, None]
    # dU/ds in bins, and (5).
    density = np.diff(
        np.interp((at + apart).ravel(), (place + apart).ravel(), summed.ravel()).reshape(at.shape), axis=1
    )
    spread[known] = (density**2).sum(axis=1) / ((1 + 2 * edge) * length / bins * total**2)[:, 0]
    return spread
