"""Patches of the scene about bright places, and the pixels that their images are asked at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.inputs import Profiles
from apertura.methods.autofocus.inputs import Sighting

Floats = NDArray[np.float64]

MOST_PATCHES, CLEAR = 32, 20.0
"""Patches are taken until they tell as much as a dozen whose points stand out so many times."""

LEAST_PATCHES = 4
"""With fewer, none would be left to judge by."""

MOST_VALUES = 2**27
"""Complex values, a gigabyte, of what blocks add to patches: with more, fewer patches are looked at."""

_ENOUGH = 12 * CLEAR
_SAMPLING = 0.7  # of Nyquist of the image: at 0.5 no better, at 0.85 places are worse held
_RANGE_CELLS = 1.5  # half of a patch along the line of sight
_LEAST_CELLS, _MOST_CELLS = 6.0, 24.0  # half of a patch across it
_BANDWIDTH = 0.66  # of an error that lasts τ, in 1/τ: its sidelobes should stay in the patch
_MOST_PIXELS = 1000
_PULSES = 256
_SHARE = 0.4  # of all patches, at most, in one ninth of the scene


@dataclass(frozen=True, eq=False)
class Patch:
    """A bright place.

    Attributes
    ----------
    place_m
        (3,) float64, metres in the frame.
    pixels_m
        (pixel, 3) float64, metres, level about the place.
    """

    place_m: Floats
    pixels_m: Floats


def spread_out(places_m: Floats, ratio: Floats, axes: Floats, *, apart_m: float) -> Floats:
    """Return the first of some places that stand apart and do not crowd one part of the scene, as many as are needed.

    Parameters
    ----------
    places_m
        (place, 3) float64, metres in the frame, clearest first.
    ratio
        (place,) float64, power of each against what lies about it.
    axes
        (3, 3) float64, rows are east, north, up.
    apart_m
        Least distance between two.

    Returns
    -------
    ndarray
        (patch, 3) float64.

    Examples
    --------
    >>> places = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [0, 5, 0]])
    >>> len(spread_out(places, np.full(4, 10.0), np.eye(3), apart_m=1.0))
    3
    """
    level = (places_m - places_m.mean(axis=0)) @ axes[:2].T
    low, extent = level.min(axis=0), np.maximum(np.ptp(level, axis=0), 1e-9)
    ninth = np.minimum((level - low) / extent * 3, 2.999).astype(int) @ np.array([3, 1])
    taken: list[int] = []
    for number in range(len(places_m)):
        told = float(np.minimum(ratio[taken], CLEAR).sum())
        if len(taken) == MOST_PATCHES or told >= _ENOUGH:
            break
        most = max(2, int(np.ceil(_SHARE * min(MOST_PATCHES, _ENOUGH / min(CLEAR, ratio[number])))))
        near = any(np.linalg.norm(level[number] - level[other]) < apart_m for other in taken)
        if not near and sum(ninth[other] == ninth[number] for other in taken) < most:
            taken.append(number)
    return places_m[taken]


def patch_at(place_m: Floats, sightings: Sequence[Sighting], axes: Floats, *, correlation_s: float) -> Patch:
    """Return the pixels about a place: as fine as the sharpest pair needs, as wide as errors throw its energy.

    Parameters
    ----------
    place_m
        (3,) float64, metres in the frame.
    sightings
        All pairs that see it.
    axes
        (3, 3) float64, rows are east, north, up.
    correlation_s
        How long an error of the tracks lasts.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches".
    """
    spans = [_spans(place_m, sighting, axes, correlation_s) for sighting in sightings]
    across = max(spans, key=lambda one: one[1][1])[0]
    cell = np.min([one[1] for one in spans], axis=0)
    half = np.max([one[2] for one in spans], axis=0)
    counts = 2 * np.ceil(half / _SAMPLING) + 1
    shrink = min(1.0, np.sqrt(_MOST_PIXELS / counts.prod()))
    sides = [
        np.arange(-(n := int(shrink * reach / _SAMPLING)), n + 1) * _SAMPLING * size
        for reach, size in zip(half, cell, strict=True)
    ]
    along, aside = np.meshgrid(*sides, indexing="ij")
    level = along[..., None] * across[0] + aside[..., None] * across[1]
    return Patch(place_m, place_m + level.reshape(-1, 2) @ axes[:2])


def affordable(values: Sequence[int]) -> int:
    """Return how many patches may be kept in memory, of which each has so many complex values: long flights have many.

    Examples
    --------
    >>> affordable([2**24] * 32)
    8
    """
    return max(int((np.cumsum(values) <= MOST_VALUES).sum()), min(LEAST_PATCHES, len(values)))


def bandwidth_hz(profiles: Profiles) -> float:
    """Return the bandwidth of some profiles."""
    return SPEED_OF_LIGHT_M_S / (profiles.step_m * profiles.oversampling)


def _spans(place_m: Floats, sighting: Sighting, axes: Floats, correlation_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the directions along and across the line of sight, the cells along both, half a patch in cells."""
    profiles = sighting.profiles
    some = profiles.aperture.sample(_PULSES)
    slope, time_s = profiles.aperture[some].path_gradient(place_m) @ axes[:2].T, sighting.time_s[some]
    if sighting.beams is not None:
        seen = sighting.beams[some].weight(profiles.aperture[some], place_m[None])[:, 0] > 0
        slope, time_s = (slope[seen], time_s[seen]) if seen.sum() > 2 else (slope, time_s)
    ahead = slope.mean(axis=0)
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-3 else np.array([0.0, 1.0])
    turned = np.stack([ahead, [-ahead[1], ahead[0]]])
    by_time = slope @ turned.T
    band = profiles.centre_frequency_hz + np.array([-0.5, 0.5]) * bandwidth_hz(profiles)
    cycles = np.concatenate([by_time * frequency / SPEED_OF_LIGHT_M_S for frequency in band])
    cell = 1 / np.maximum(np.ptp(cycles, axis=0), 1e-9)
    thrown = np.clip(_BANDWIDTH * float(np.ptp(time_s)) / correlation_s, _LEAST_CELLS, _MOST_CELLS)
    turning = np.ptp(by_time, axis=0)
    half = np.array([max(_RANGE_CELLS, thrown * min(1.0, turning[0] / max(turning[1], 1e-9)) ** 2), thrown])
    return turned, cell, half
