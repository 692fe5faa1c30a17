"""Illumination of a scene by antenna beams: number of pulses that illuminate each point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beam, Beams
from apertura.core.geometry.aperture import Aperture

_PULSES = 1024  # largest number of pulses evaluated
_AT_ONCE = 64  # pulses or blocks evaluated together, to limit memory


@dataclass(frozen=True)
class Illumination:
    """Number of pulses that illuminate each point of a grid over the scene.

    Attributes
    ----------
    pulse_counts
        (point,) int64, number of pulses that illuminate each point.
    pulses
        Number of pulses of the aperture.

    Examples
    --------
    >>> Illumination(np.array([0, 20, 40, 60]), 100).line
    'each point of the scene is illuminated by 0 to 60 of 100 pulses (median 30); 25 % of points are not illuminated'
    """

    pulse_counts: NDArray[np.int64]
    pulses: int

    @property
    def unilluminated(self) -> float:
        """Fraction of the points that no pulse illuminates."""
        return float((self.pulse_counts == 0).mean())

    @property
    def counts(self) -> dict[str, int]:
        """Minimum, median and maximum number of pulses that illuminate a point."""
        least, median, most = np.quantile(self.pulse_counts, [0, 0.5, 1]).round().astype(int)
        return {"least": int(least), "median": int(median), "most": int(most)}

    @property
    def line(self) -> str:
        """Numbers of illuminating pulses in one line."""
        least, median, most = self.counts.values()
        line = f"each point of the scene is illuminated by {least} to {most} of {self.pulses} pulses (median {median})"
        if self.unilluminated:
            line += f"; {100 * self.unilluminated:.0f} % of points are not illuminated"
        return line


def illuminate(beams: Beams, aperture: Aperture, point_m: NDArray[np.float64]) -> Illumination:
    """Count the pulses that illuminate each point.

    Parameters
    ----------
    beams
        Beams of all pulses.
    aperture
        Aperture of all pulses; for more than 1024 pulses, an evenly spaced sample is evaluated.
    point_m
        (point, 3) float64, metres.
    """
    evaluated = slice(None, None, -(-len(aperture) // _PULSES))
    sample, beams = aperture[evaluated], beams[evaluated]
    pulse_counts = np.zeros(len(point_m), np.int64)
    for first in range(0, len(sample), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        pulse_counts += (beams[block].weight(sample[block], point_m) != 0).sum(axis=0)
    return Illumination(np.rint(pulse_counts * (len(aperture) / len(sample))).astype(np.int64), len(aperture))


def illumination_mask(
    beams: Beams | None,
    aperture: Aperture,
    middle_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
    *,
    pulses: int,
) -> NDArray[np.bool_]:
    """Return a mask of the blocks of pulses that may illuminate spheres of the scene.

    Parameters
    ----------
    beams
        Beams of all pulses; None: every pulse illuminates every point.
    aperture
        Aperture of all pulses.
    middle_m, radius_m
        (sphere, 3) centres and (sphere,) radii, float64, metres.
    pulses
        Block size in pulses.

    Returns
    -------
    ndarray
        (block, sphere) bool; False if the weight of every pulse of the block is known to be zero throughout the sphere.
    """
    count = -(-len(aperture) // pulses)
    mask = np.ones((count, len(middle_m)), bool)
    if beams is None:
        return mask
    for first in range(0, count, _AT_ONCE):
        selected = slice(first * pulses, (first + _AT_ONCE) * pulses)
        mask[first : first + _AT_ONCE] = _block_mask(beams[selected], aperture[selected], middle_m, radius_m, pulses)
    return mask


def _block_mask(
    beams: Beams, aperture: Aperture, middle_m: NDArray[np.float64], radius_m: NDArray[np.float64], pulses: int
) -> NDArray[np.bool_]:
    # For each block, only the middle pulse is evaluated, with spheres enlarged by the distance to the other pulses of
    # the block.
    starts = np.arange(0, len(aperture), pulses)
    middles = np.minimum(starts + pulses // 2, len(aperture) - 1)
    block = np.arange(len(aperture)) // pulses
    middle = aperture[middles]
    radius = [
        radius_m + np.maximum.reduceat(np.linalg.norm(position_m - middle_position_m[block], axis=1), starts)[:, None]
        for position_m, middle_position_m in zip(aperture.legs, middle.legs, strict=True)
    ]
    # Exclude spheres beyond the recorded paths, outside the integration sector, or outside either pattern; tolerances
    # include the motion and the rotation within a block.
    mask = np.ones((len(starts), len(middle_m)), bool)
    if beams.gate is not None:
        mask &= middle.path(middle_m) - radius[0] - radius[1] < np.maximum.reduceat(beams.gate.limit_m, starts)[:, None]
    if beams.sector is not None:
        sector = beams.sector[middles]
        rotation = beams.sector.axis_change(sector[block])
        slack = sector.slack(middle, middle_m, np.maximum(*radius)) + np.maximum.reduceat(rotation, starts)[:, None]
        mask &= np.abs(sector.place(middle, middle_m)) - slack < beams.sector.outer
    for beam, position_m, enlarged_m in zip((beams.transmit, beams.receive), middle.legs, radius, strict=True):
        if beam is not None:
            mask &= _in_pattern(beam, middles, starts, middle_m - position_m[:, None], enlarged_m)
    return mask


def _in_pattern(
    beam: Beam,
    middles: NDArray[np.int64],
    starts: NDArray[np.int64],
    offset_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return a mask, (block, sphere), of the spheres that may intersect the cone and the elevations of the pattern."""
    range_m = np.linalg.norm(offset_m, axis=-1)
    # half angle of the sphere; the rotation of the antenna is added below
    tolerance = np.arcsin(np.minimum(1.0, radius_m / range_m)) + 1e-6
    from_boresight, from_up = (np.empty(range_m.shape) for _ in range(2))
    for axis, angle in ((0, from_boresight), (2, from_up)):
        vector = beam.axes[:, axis]
        middle = vector[middles]
        rotation = _angle((vector * np.repeat(middle, np.diff(starts, append=len(vector)), axis=0)).sum(axis=1))
        tolerance += np.maximum.reduceat(rotation, starts)[:, None]
        angle[:] = _angle(np.einsum("bpx,bx->bp", offset_m, middle) / range_m)
    elevation = np.pi / 2 - from_up
    inside = (elevation + tolerance > beam.elevation_rad[0]) & (elevation - tolerance < beam.elevation_rad[-1])
    return np.asarray((radius_m >= range_m) | (inside & (from_boresight - tolerance < beam.cone_rad)))


def _angle(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


EXACT = (64, 8)
"""Block sizes, in pulses, of the exact illumination test, from coarse to fine."""


def any_illuminates(
    beams: Beams,
    aperture: Aperture,
    points: NDArray[np.float64],
    pulses: NDArray[np.int64],
    sizes: tuple[int, ...] = EXACT,
) -> NDArray[np.bool_]:
    """Return a mask of the points (point, 3) at which any of the pulses has a weight.

    One pulse of each block is evaluated first. Blocks that cannot illuminate a point are then excluded. This is
    repeated with smaller blocks, so that all pulses are evaluated only near the edges of beams.
    """
    if not pulses.size or not len(points):
        return np.zeros(len(points), bool)
    sample = pulses[sizes[0] // 2 :: sizes[0]] if sizes else pulses
    illuminated = (beams[sample].weight(aperture[sample], points) != 0).any(axis=0)
    if not sizes or illuminated.all():
        return np.asarray(illuminated)
    dark = np.flatnonzero(~illuminated)
    reaching = illumination_mask(beams[pulses], aperture[pulses], points[dark], np.zeros(dark.size), pulses=sizes[0])
    for number in np.flatnonzero(reaching.any(axis=1)):
        undecided = dark[reaching[number] & ~illuminated[dark]]
        block = pulses[number * sizes[0] : (number + 1) * sizes[0]]
        illuminated[undecided] = any_illuminates(beams, aperture, points[undecided], block, sizes[1:])
    return np.asarray(illuminated)


_POINTS_AT_ONCE = 4096


def recorded_mask(beams: Beams, aperture: Aperture, pixels: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Return a mask of the pixels (y, x, 3) with the weight of any pulse; None if the gate cuts no pulse.

    Around the end of a gate, the interpolation of range profiles yields a small value at pixels without a weight.
    """
    if beams.gate is None:
        return None
    points, pulses = pixels.reshape(-1, 3), np.arange(len(aperture))
    middle_m = points[len(points) // 2]
    radius_m = float(np.linalg.norm(points - middle_m, axis=1).max())
    if (aperture.path(middle_m[None])[:, 0] + 2 * radius_m < beams.gate.limit_m).all():
        return None
    parts = [points[first : first + _POINTS_AT_ONCE] for first in range(0, len(points), _POINTS_AT_ONCE)]
    return np.concatenate([any_illuminates(beams, aperture, part, pulses) for part in parts]).reshape(pixels.shape[:2])


def decide_antennas(
    beams: Beams | None, illumination: Illumination | None
) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """Return the antennas with beams and their illumination, and the flag `outside_beam`; both empty without beams."""
    if beams is None or beams.antennas is None or illumination is None:
        return [], {}
    with_beam = [name for name in ("transmit", "receive") if getattr(beams, name) is not None]
    misses = f"no pulse illuminates {100 * illumination.unilluminated:.1f} % of the scene: these pixels are zero"
    return (
        [(", ".join(with_beam), illumination.line)],
        {"outside_beam": misses} if illumination.unilluminated else {},
    )
