"""Antenna patterns and axes, and the weight of each pulse at each pixel."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.aperture import Aperture, Weigh
from apertura.core.geometry.gate import RangeGate
from apertura.core.geometry.sector import Sector

# ---- Antenna patterns: Gaussian or sampled cuts, and antenna axes

Cut = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Cut through a pattern: equally spaced angles (rad), and field relative to the peak of the cut."""

LIMITS_RAD = {"azimuth": np.pi, "elevation": np.pi / 2}
"""Largest angle of each cut from the boresight, radians."""

# number of samples of a Gaussian cut: with a cutoff of -20 dB, linear interpolation has an error of -100 dB
_SAMPLES = 513
_FINE = 4097  # number of samples of a sampled cut: a spacing of 0.09° over 360°


def antenna_axes(body_axes: NDArray[np.float64], boresight_deg: tuple[float, float]) -> NDArray[np.float64]:
    """Return the axes of an antenna as required by `Beam`.

    Parameters
    ----------
    body_axes
        (pulse, 3, 3) float64; columns are the forward, right and down unit vectors of the body in the frame of the
        pixels.
    boresight_deg
        Azimuth clockwise from forward, and elevation above the forward-right plane, degrees.

    Returns
    -------
    ndarray
        (pulse, 3, 3) float64; rows are unit vectors along boresight, towards increasing azimuth (in the forward-right
        plane) and towards increasing elevation.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas".

    Examples
    --------
    >>> antenna_axes(np.eye(3)[None], (90.0, -30.0)).round(3)[0] + 0.0  # to the right and down
    array([[ 0.   ,  0.866,  0.5  ],
           [-1.   ,  0.   ,  0.   ],
           [ 0.   ,  0.5  , -0.866]])
    """
    azimuth, elevation = np.radians(boresight_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    below = np.array([0.0, 0.0, 1.0])
    axes = np.stack(
        [
            np.cos(elevation) * ahead - np.sin(elevation) * below,
            np.array([-ahead[1], ahead[0], 0.0]),
            -np.sin(elevation) * ahead - np.cos(elevation) * below,
        ]
    )
    return np.asarray(np.einsum("pij,aj->pai", body_axes, axes))


def gaussian_cut(width_deg: float, *, cutoff_db: float, limit_rad: float) -> Cut:
    """Return a Gaussian cut of -12.04 (angle/width)² dB, limited to gains above `cutoff_db`.

    Parameters
    ----------
    width_deg
        Full width at half power, degrees.
    cutoff_db
        Gain at which the cut ends, dB relative to the peak.
    limit_rad
        Largest angle of the cut, radians.

    Examples
    --------
    >>> angle, gain = gaussian_cut(20.0, cutoff_db=-20.0, limit_rad=np.pi)
    >>> round(float(np.interp(np.radians(10.0), angle, gain)) ** 2, 4), np.degrees(angle[-1]).round(1)
    (0.5, np.float64(25.8))
    """
    steepness = np.log(4) / np.radians(width_deg) ** 2
    reach = min(limit_rad, float(np.sqrt(-cutoff_db / 20 * np.log(10) / steepness)))
    angle = np.linspace(-reach, reach, _SAMPLES)
    return angle, np.exp(-steepness * angle**2)


def sampled_cut(angle_deg: NDArray[np.float64], gain_db: NDArray[np.float64], *, cutoff_db: float) -> Cut:
    """Return the main lobe of a sampled cut: the interval about the peak with a gain of at least `cutoff_db`.

    Parameters
    ----------
    angle_deg
        (sample,) float64, ascending, degrees from boresight.
    gain_db
        (sample,) float64, dB relative to an arbitrary level; interpolated linearly between samples.
    cutoff_db
        Gain at which the cut ends, dB relative to the peak.

    Notes
    -----
    Sidelobes are excluded, because the sign of the field changes at a null, and a gain in dB does not contain the sign.

    Examples
    --------
    >>> angle, gain = sampled_cut(np.array([-30.0, 0, 10, 20, 30]), np.array([-30.0, 5, 2, -25, -5]), cutoff_db=-10)
    >>> np.degrees(angle[[0, -1]]).round(1), gain.max().round(3)
    (array([-8.6, 12.6]), np.float64(1.0))
    """
    fine = np.linspace(angle_deg[0], angle_deg[-1], _FINE)
    level = np.interp(fine, angle_deg, gain_db - gain_db.max())
    peak, low = int(level.argmax()), np.flatnonzero(level < cutoff_db)  # `low`: samples below the cutoff
    first = int(low[low < peak].max(initial=-1)) + 1
    last = int(low[low > peak].min(initial=_FINE))
    return np.radians(fine[first:last]), 10 ** (level[first:last] / 20)


def sampled_phase(
    angle_deg: NDArray[np.float64], phase_deg: NDArray[np.float64], at_rad: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unwrapped phase of a sampled cut at the angles `at_rad`, interpolated linearly, rad.

    Examples
    --------
    >>> sampled_phase(np.array([-30.0, 0, 30]), np.array([170.0, -170, -150]), np.radians([15.0])).round(4)
    array([3.4907])
    """
    return np.asarray(np.interp(at_rad, np.radians(angle_deg), np.unwrap(np.radians(phase_deg))))


# ---- Gain of each pulse at each pixel


@dataclass(frozen=True)
class Beam:
    """Separable antenna pattern about axes that rotate with the antenna; the gain is 0 outside the sampled angles.

    A direction with components (a, b, c) along the axes has azimuth atan2(b, a) and elevation
    atan2(c, √(a² + b²)). The gain is the product of the two cuts, each interpolated linearly between
    samples.

    Attributes
    ----------
    axes
        (pulse, 3, 3) float64; rows are orthogonal unit vectors along boresight, towards increasing azimuth and towards
        increasing elevation, in the frame of the pixels.
    azimuth_rad, elevation_rad
        (n,) and (m,) float64, equally spaced and ascending.
    azimuth_gain, elevation_gain
        (n,) and (m,) float64, field (not power) relative to boresight.
    azimuth_phase_rad, elevation_phase_rad
        (n,) and (m,) float64, phase of each cut; the phase of the field is the sum of both. None: unknown. Engines do
        not compensate this phase.

    Raises
    ------
    ValueError
        If shapes differ, if angles are not equally spaced, or if axes are not orthogonal unit vectors.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas".

    Examples
    --------
    >>> angles = np.radians([-20.0, 0.0, 20.0])
    >>> beam = Beam(np.eye(3)[None], angles, np.array([0.5, 1, 0.5]), angles, np.array([0.5, 1, 0.5]))
    >>> tilted = np.array([[5.0, 0.0, 0.0], [5.0, 5 * np.tan(np.radians(10)), 0.0], [5.0, 5.0, 0.0]])
    >>> beam.gain(np.zeros((1, 3)), tilted).round(3)
    array([[1.  , 0.75, 0.  ]])
    """

    axes: NDArray[np.float64]
    azimuth_rad: NDArray[np.float64]
    azimuth_gain: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    elevation_gain: NDArray[np.float64]
    azimuth_phase_rad: NDArray[np.float64] | None = None
    elevation_phase_rad: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.axes.ndim != 3 or self.axes.shape[1:] != (3, 3):
            raise ValueError(f"{self.axes.shape=}: must be (pulse, 3, 3)")
        if not np.allclose(self.axes @ self.axes.swapaxes(1, 2), np.eye(3), atol=1e-6):
            raise ValueError("axes: rows must be orthogonal unit vectors")
        for name, angle, gain in self._patterns():
            if angle.ndim != 1 or angle.size < 2 or gain.shape != angle.shape:
                raise ValueError(f"{name}: {angle.shape=} and {gain.shape=} must be equal, with at least two samples")
            step = (angle[-1] - angle[0]) / (angle.size - 1)
            if not (step > 0 and np.allclose(np.diff(angle), step, rtol=1e-6, atol=1e-9) and np.isfinite(gain).all()):
                raise ValueError(f"{name}: angles must ascend in equal steps, and gains must be finite")

    def __getitem__(self, pulses: slice | NDArray[np.int64]) -> "Beam":
        """Return the beam over the selected pulses."""
        selected = copy(self)  # the attributes of this beam are valid and are not checked again
        object.__setattr__(selected, "axes", self.axes[pulses])
        return selected

    def turned(self, vector_rad: NDArray[np.float64]) -> "Beam":
        """Return the beam rotated by a rotation vector, (3,) rad, in the frame of the pixels."""
        from scipy.spatial.transform import Rotation  # slow to import, and rarely needed

        axes = Rotation.from_rotvec(vector_rad).apply(self.axes.reshape(-1, 3))
        return replace(self, axes=axes.reshape(self.axes.shape))

    def gain(self, position_m: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gain of each pulse towards each pixel.

        Parameters
        ----------
        position_m
            (pulse, 3) float64, phase centres of this antenna, in the frame of the pixels.
        pixels
            (pixel, 3) float64, metres.

        Returns
        -------
        ndarray
            (pulse, pixel) float64.

        Raises
        ------
        ValueError
            If the number of axes differs from the number of pulses.
        """
        angles = self.angles(position_m, pixels)
        gains = [
            np.interp(angle, samples, values, left=0, right=0)
            for angle, (_, samples, values) in zip(angles, self._patterns(), strict=True)
        ]
        return np.asarray(gains[0] * gains[1])

    def phase(self, position_m: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the phase of the field of each pulse towards each pixel, (pulse, pixel) rad; 0 if unknown."""
        azimuth, elevation = self.angles(position_m, pixels)
        total: NDArray[np.float64] = np.zeros_like(azimuth)
        for angle, samples, values in (
            (azimuth, self.azimuth_rad, self.azimuth_phase_rad),
            (elevation, self.elevation_rad, self.elevation_phase_rad),
        ):
            if values is not None:
                total += np.interp(angle, samples, values)
        return total

    def angles(self, position_m: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return azimuth and elevation of each pixel, (2, pulse, pixel) rad; parameters and errors as for `gain`."""
        if len(self.axes) != len(position_m):
            raise ValueError(f"{len(self.axes)=}: must equal the number of pulses, {len(position_m)}")
        # Matrix products relative to a nearby origin, to preserve the precision of the coordinates.
        offset_m, antenna_m = (pixels - position_m[:1]).T, position_m - position_m[:1]
        ahead, right, above = (
            axis @ offset_m - (axis * antenna_m).sum(axis=1)[:, None] for axis in self.axes.swapaxes(0, 1)
        )
        return np.stack([np.arctan2(right, ahead), np.arctan2(above, np.hypot(ahead, right))])

    @property
    def cone_rad(self) -> float:
        """Half angle of the narrowest cone about the boresight that contains the pattern."""
        widest = [float(np.cos(np.abs(angle[[0, -1]]).max())) for angle in (self.azimuth_rad, self.elevation_rad)]
        return float(np.arccos(widest[0] if widest[0] < 0 else widest[0] * max(widest[1], 0.0)))

    @property
    def steepest(self) -> float:
        """Upper bound of the slope of the gain in any direction, per radian."""
        slopes = [np.abs(np.diff(gain)).max() / (angle[1] - angle[0]) for _, angle, gain in self._patterns()]
        peaks = [np.abs(gain).max() for _, _, gain in self._patterns()]
        return float(np.hypot(slopes[0] * peaks[1], slopes[1] * peaks[0]))

    def _patterns(self) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
        return [
            ("azimuth", self.azimuth_rad, self.azimuth_gain),
            ("elevation", self.elevation_rad, self.elevation_gain),
        ]


@dataclass(frozen=True)
class Beams:
    """Weights of pulses: beams of transmitter and receiver, integration sector of each pixel, and recorded paths.

    Attributes
    ----------
    transmit, receive
        Beams at the pulses of an image; None: isotropic.
    sector
        Sector at the same pulses; None: all pulses are integrated.
    gate
        Gate of the recorded paths at the same pulses; None: all echoes are recorded.

    Examples
    --------
    >>> Beams().weight(Aperture(np.zeros((2, 3)), np.zeros((2, 3))), np.ones((4, 3))).shape
    (2, 4)
    """

    transmit: Beam | None = None
    receive: Beam | None = None
    sector: Sector | None = None
    gate: RangeGate | None = None

    def __getitem__(self, pulses: slice | NDArray[np.int64]) -> "Beams":
        """Return the beams over the selected pulses."""
        transmit, receive = (beam and beam[pulses] for beam in (self.transmit, self.receive))
        return Beams(transmit, receive, self.sector and self.sector[pulses], self.gate and self.gate[pulses])

    def check_pulses(self, pulses: int) -> None:
        """Raise ValueError if beams, sector or gate have a different number of pulses."""
        for beam in (self.transmit, self.receive):
            if beam is not None and len(beam.axes) != pulses:
                raise ValueError(f"{len(beam.axes)=}: must equal the number of pulses, {pulses}")
        if self.sector is not None and len(self.sector.tx_axis) != pulses:
            raise ValueError(f"{len(self.sector.tx_axis)=}: must equal the number of pulses, {pulses}")
        if self.gate is not None and len(self.gate.limit_m) != pulses:
            raise ValueError(f"{len(self.gate.limit_m)=}: must equal the number of pulses, {pulses}")

    @property
    def antennas(self) -> "Beams | None":
        """The beams without sector and gate; None if neither antenna has a beam."""
        return Beams(self.transmit, self.receive) if self.transmit or self.receive else None

    @property
    def on_profiles(self) -> "Beams | None":
        """The weights that multiply range profiles, which contain the gate; None if there are none."""
        return Beams.within(self.sector, self.antennas)

    def coverage(self, aperture: Aperture) -> Weigh | None:
        """Return the weights by sector and gate as a function of pulses and points; None if all pulses contribute."""
        if self.sector is None and self.gate is None:
            return None
        covered = Beams(sector=self.sector, gate=self.gate)
        return lambda pulses, points_m: covered[pulses].weight(aperture[pulses], points_m)

    @classmethod
    def within(cls, sector: Sector | None, antennas: "Beams | None", gate: RangeGate | None = None) -> "Beams | None":
        """Combine the beams of antennas with a sector and a gate; None if all three are absent."""
        beams = antennas or cls()
        return cls(beams.transmit, beams.receive, sector, gate) if antennas or sector or gate else None

    def phase(self, aperture: Aperture, pixels: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the sum of the phases of both antennas towards each pixel, (pulse, pixel) rad; None: unknown."""
        legs = zip((self.transmit, self.receive), aperture.legs, strict=True)
        known = [
            beam.phase(position_m, pixels)
            for beam, position_m in legs
            if beam and (beam.azimuth_phase_rad is not None or beam.elevation_phase_rad is not None)
        ]
        return np.asarray(np.sum(known, axis=0)) if known else None

    def weight(self, aperture: Aperture, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the product of gains and the weights of sector and gate, (pulse, pixel) float64; see `Beam.gain`."""
        total = np.ones((len(aperture), len(pixels)))
        for beam, position_m in zip((self.transmit, self.receive), aperture.legs, strict=True):
            if beam is not None:
                total *= beam.gain(position_m, pixels)
        if self.sector is not None:
            total *= self.sector.weight(aperture, pixels)
        if self.gate is not None:
            total *= self.gate.weight(aperture, pixels)
        return total
