"""Illumination of a scene by antenna beams: how many pulses illuminate each place."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beam, Beams
from apertura.core.geometry.aperture import Aperture

_PULSES = 1024  # evaluated at most, of longer apertures
_AT_ONCE = 64  # pulses, or blocks, evaluated together: bounds memory


@dataclass(frozen=True)
class Illumination:
    """Numbers of pulses that illuminate each point of a grid over the scene.

    Attributes
    ----------
    pulse_counts
        (place,) int64, pulses that illuminate each place.
    pulses
        Number of pulses of the aperture.

    Examples
    --------
    >>> Illumination(np.array([0, 20, 40, 60]), 100).line
    'of 100 pulses a place of the scene is illuminated by 0 to 60 (median 30); 25 % of places by none'
    """

    pulse_counts: NDArray[np.int64]
    pulses: int

    @property
    def unilluminated(self) -> float:
        """Share of the places that no pulse illuminates."""
        return float((self.pulse_counts == 0).mean())

    @property
    def counts(self) -> dict[str, int]:
        """Least, median and most pulses that illuminate a place."""
        least, median, most = np.quantile(self.pulse_counts, [0, 0.5, 1]).round().astype(int)
        return {"least": int(least), "median": int(median), "most": int(most)}

    @property
    def line(self) -> str:
        """The counts in one line."""
        least, median, most = self.counts.values()
        line = f"of {self.pulses} pulses a place of the scene is illuminated by {least} to {most} (median {median})"
        return f"{line}; {100 * self.unilluminated:.0f} % of places by none" if self.unilluminated else line


def illuminate(beams: Beams, aperture: Aperture, place_m: NDArray[np.float64]) -> Illumination:
    """Count the pulses that illuminate each place.

    Parameters
    ----------
    beams
        Of every pulse.
    aperture
        Of more than 1024 pulses an evenly spaced sample is evaluated.
    place_m
        (place, 3) float64, metres.
    """
    some = slice(None, None, -(-len(aperture) // _PULSES))
    few, beams = aperture[some], beams[some]
    pulse_counts = np.zeros(len(place_m), np.int64)
    for first in range(0, len(few), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        pulse_counts += (beams[part].weight(few[part], place_m) != 0).sum(axis=0)
    return Illumination(np.rint(pulse_counts * (len(aperture) / len(few))).astype(np.int64), len(aperture))


def illumination_mask(
    beams: Beams | None,
    aperture: Aperture,
    middle_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
    *,
    pulses: int,
) -> NDArray[np.bool_]:
    """Return a mask of the blocks of pulses that may illuminate balls about places.

    Parameters
    ----------
    beams
        Of every pulse; None illuminates everything.
    aperture
        Of every pulse.
    middle_m, radius_m
        (place, 3) and (place,) float64, metres.
    pulses
        Of a block.

    Returns
    -------
    ndarray
        (block, place) bool. False where the weight of every pulse of the block is zero all over the ball.
    """
    count = -(-len(aperture) // pulses)
    mask = np.ones((count, len(middle_m)), bool)
    if beams is None:
        return mask
    for first in range(0, count, _AT_ONCE):
        part = slice(first * pulses, (first + _AT_ONCE) * pulses)
        mask[first : first + _AT_ONCE] = _block_mask(beams[part], aperture[part], middle_m, radius_m, pulses)
    return mask


def _block_mask(
    beams: Beams, aperture: Aperture, middle_m: NDArray[np.float64], radius_m: NDArray[np.float64], pulses: int
) -> NDArray[np.bool_]:
    # Balls as seen from the middle pulse of each block: as much larger as its other pulses are away from that one.
    starts = np.arange(0, len(aperture), pulses)
    middles = np.minimum(starts + pulses // 2, len(aperture) - 1)
    block = np.arange(len(aperture)) // pulses
    middle = aperture[middles]
    radius = [
        radius_m + np.maximum.reduceat(np.linalg.norm(leg - there[block], axis=1), starts)[:, None]
        for leg, there in zip(aperture.legs, middle.legs, strict=True)
    ]
    # Outside the integration sector, or outside either antenna's pattern, with the block's rotation as slack.
    mask = np.ones((len(starts), len(middle_m)), bool)
    if beams.sector is not None:
        there = beams.sector[middles]
        rotation = beams.sector.axis_change(there[block])
        slack = there.slack(middle, middle_m, np.maximum(*radius)) + np.maximum.reduceat(rotation, starts)[:, None]
        mask &= np.abs(there.place(middle, middle_m)) - slack < beams.sector.outer
    for beam, leg, around in zip((beams.transmit, beams.receive), middle.legs, radius, strict=True):
        if beam is not None:
            mask &= _in_pattern(beam, middles, starts, middle_m - leg[:, None], around)
    return mask


def _in_pattern(
    beam: Beam,
    middles: NDArray[np.int64],
    starts: NDArray[np.int64],
    away_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return a mask of balls (block, place) that may intersect the pattern's cone and elevations at some pulse."""
    range_m = np.linalg.norm(away_m, axis=-1)
    near = np.arcsin(np.minimum(1.0, radius_m / range_m)) + 1e-6
    off, above = (np.empty(range_m.shape) for _ in range(2))
    for axis, angle in ((0, off), (2, above)):
        each = beam.axes[:, axis]
        there = each[middles]
        rotation = _angle((each * np.repeat(there, np.diff(starts, append=len(each)), axis=0)).sum(axis=1))
        near += np.maximum.reduceat(rotation, starts)[:, None]
        angle[:] = _angle(np.einsum("bpx,bx->bp", away_m, there) / range_m)
    elevation = np.pi / 2 - above
    inside = (elevation + near > beam.elevation_rad[0]) & (elevation - near < beam.elevation_rad[-1])
    return np.asarray((radius_m >= range_m) | (inside & (off - near < beam.cone_rad)))


def _angle(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def decide_antennas(
    beams: Beams | None, illumination: Illumination | None
) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """List the antennas with beams and the illumination, and the flag `outside_beam`; empty without beams."""
    if beams is None or beams.antennas is None or illumination is None:
        return [], {}
    with_beam = [name for name in ("transmit", "receive") if getattr(beams, name) is not None]
    misses = f"{100 * illumination.unilluminated:.1f} % of the scene is illuminated by no pulse: its pixels are zero"
    return (
        [(", ".join(with_beam), illumination.line)],
        {"outside_beam": misses} if illumination.unilluminated else {},
    )
