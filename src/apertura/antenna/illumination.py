"""What beams make of a scene: how many pulses see each place, and how the compiled engine may weigh its patches."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.geometry.aperture import Aperture

_PULSES = 1024
_AT_ONCE = 64
_HALF_PATCH = 7.5  # pixels
_CHANGE, _BEND = 0.12, 0.025  # native/beam.hpp, `spread`


@dataclass(frozen=True)
class Illumination:
    """How many pulses see each place of a net over the scene.

    Attributes
    ----------
    seen
        (place,) int64.
    pulses
        How many there are.

    Examples
    --------
    >>> Illumination(np.array([0, 20, 40, 60]), 100).line
    'of 100 pulses a place of the scene is seen by 0 to 60 (median 30); 25 % of places are seen by none'
    """

    seen: NDArray[np.int64]
    pulses: int

    @property
    def unseen(self) -> float:
        """Share of the places that no pulse sees."""
        return float((self.seen == 0).mean())

    @property
    def counts(self) -> dict[str, int]:
        """Least, median and most pulses that see a place."""
        least, median, most = np.quantile(self.seen, [0, 0.5, 1]).round().astype(int)
        return {"least": int(least), "median": int(median), "most": int(most)}

    @property
    def line(self) -> str:
        """All of it in a few words."""
        least, median, most = self.counts.values()
        line = f"of {self.pulses} pulses a place of the scene is seen by {least} to {most} (median {median})"
        return f"{line}; {100 * self.unseen:.0f} % of places are seen by none" if self.unseen else line


def illuminate(beams: Beams, aperture: Aperture, place_m: NDArray[np.float64]) -> Illumination:
    """Return how many pulses see each place.

    Parameters
    ----------
    beams
        Of every pulse.
    aperture
        Of more than 1024 pulses, evenly spread ones stand for all.
    place_m
        (place, 3) float64, metres.
    """
    some = slice(None, None, -(-len(aperture) // _PULSES))
    few, beams = aperture[some], beams[some]
    seen = np.zeros(len(place_m), np.int64)
    for first in range(0, len(few), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        seen += (beams[part].weight(few[part], place_m) != 0).sum(axis=0)
    return Illumination(np.rint(seen * (len(aperture) / len(few))).astype(np.int64), len(aperture))


def decide_antennas(
    beams: Beams | None, illumination: Illumination | None
) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """Return which antennas have beams and what they see, in one line, and the flag `beam_misses`; neither without."""
    if beams is None or illumination is None:
        return [], {}
    looking = [name for name in ("transmit", "receive") if getattr(beams, name) is not None]
    misses = f"{100 * illumination.unseen:.1f} % of the scene is seen by no pulse: its pixels are zero"
    return (
        [(", ".join(looking), illumination.line)],
        {"beam_misses": misses} if illumination.unseen else {},
    )


@dataclass(frozen=True)
class Footprint:
    """What beams make of patches × pulses for the compiled engine.

    Attributes
    ----------
    smooth, rough, dark
        Parts that are weighed by a polynomial, pixel by pixel, and not at all; they sum to 1.
    error
        RMS error of the polynomials, relative to the RMS of the weights.
    antennas
        How many beams there are.
    """

    smooth: float = 1.0
    rough: float = 0.0
    dark: float = 0.0
    error: float = 0.0
    antennas: int = 0


NO_BEAMS = Footprint()


def footprint(
    beams: Beams,
    aperture: Aperture,
    steps_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
) -> Footprint:
    """Return what beams make of patches of 16 × 16 pixels about places of the scene.

    Parameters
    ----------
    beams
        One set of axes for each of the pulses given.
    aperture
        The pulses.
    steps_m
        (2, place, 3) float64, metres: from pixel to pixel along columns and rows.
    place_m
        (place, 3) float64, metres.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas".
    """
    across = _HALF_PATCH * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(9, 2)
    nodes = place_m + np.einsum("ns,spc->npc", across, steps_m)
    gain = beams.weight(aperture, nodes.reshape(-1, 3)).reshape(len(aperture), 3, 3, len(place_m))
    bends = [np.abs(np.diff(gain, 2, axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    changes = [np.abs(np.diff(gain.take([0, 2], axis), axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    dark, whole = (gain == 0).all(axis=(1, 2)), (gain != 0).all(axis=(1, 2))
    smooth = whole & (np.maximum(*changes) <= _CHANGE) & (np.maximum(*bends) <= _BEND)
    held = np.where(smooth, np.hypot(*bends), 0.0)
    error = np.hypot((3 / 16) ** 2 / 2 * held, 1.4 / (9 * np.sqrt(3)) * held**1.5)
    strength = float((gain**2).mean())
    return Footprint(
        float(smooth.mean()),
        float((~smooth & ~dark).mean()),
        float(dark.mean()),
        float(np.sqrt((error**2).mean() / strength)) if strength else 0.0,
        sum(beam is not None for beam in (beams.transmit, beams.receive)),
    )
