"""Flight logs of the atlas: what a node's positions become when they go through a log that is wrong."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from apertura.common.arrays import Floats
from apertura.core.geometry.phase_centres import position_spline
from apertura.core.geometry.track_checks import CheckedTrack, check_track
from apertura.core.quality.budget import NodePositions
from apertura_research.error_atlas.flight import Flight, Told

NOISE_M = 0.002
"""Of every epoch by itself."""

USUAL_HZ = 20.0
_MARGIN_S = 9.0
_TOLERATED_WAVELENGTHS = 1 / 16


@dataclass(frozen=True)
class Log:
    """How a node's log is made.

    Attributes
    ----------
    rate_hz
        Epochs per second.
    wander_m, correlation_s
        Error of every epoch, per axis: white noise after a moving average of so long.
    gap_s
        Length of what is missing in the middle.
    """

    rate_hz: float = USUAL_HZ
    wander_m: float = 0.0
    correlation_s: float = 1.0
    gap_s: float = 0.0

    def checked(self, flown: Flight, node: str, generator: Generator) -> tuple[Floats, CheckedTrack]:
        """Return (pulse, 3) float64 positions as the log gives them, and what its checks say."""
        end_s = float(flown.time_s[-1])
        time_s = np.arange(-_MARGIN_S, end_s + _MARGIN_S, 1 / self.rate_hz)
        place_m = flown.nodes[node].position(time_s)
        place_m += NOISE_M * generator.standard_normal(place_m.shape)
        place_m += self.wander_m * self._wander(len(time_s), generator)
        there = np.abs(time_s - end_s / 2) >= self.gap_s / 2
        time_s, place_m = time_s[there], place_m[there]
        wavelength_m = flown.paths("a-a").wavelength_m
        checked = check_track(
            time_s,
            place_m,
            poor_fix=np.zeros(len(time_s), bool),
            tolerated_m=wavelength_m * _TOLERATED_WAVELENGTHS,
        )
        spline = position_spline(time_s[checked.kept], place_m[checked.kept])
        return np.asarray(spline(flown.time_s)), checked

    def _wander(self, count: int, generator: Generator) -> Floats:
        """Return (epoch, 3) float64 of unit variance."""
        width = max(1, round(self.correlation_s * self.rate_hz))
        white = generator.standard_normal((count + width - 1, 3)) / np.sqrt(width)
        return np.stack([np.convolve(axis, np.ones(width), "valid") for axis in white.T], -1)


def told_by(flown: Flight, generator: Generator, **logs: Log) -> Told:
    """Return what a pipeline is told whose nodes have these logs; nodes without one are where they are."""
    places, used, flags = {}, np.ones(len(flown.time_s), bool), dict[str, str]()
    for node, log in logs.items():
        places[node], checked = log.checked(flown, node, generator)
        barred = checked.excluded(flown.time_s)
        flags |= {cause: node for cause, out in barred.items() if out.any()}
        flags |= {cause: node for cause, found in checked.faults.items() if found}
        for out in barred.values():
            used &= ~out
    return replace(flown.truth, apertures=flown.apertures(**places), used=used, flags=flags)


def between_epochs(flown: Flight, log: Log) -> NodePositions:
    """Return what the checks of a log say of the spline between its epochs, as the budget takes positions."""
    _, checked = log.checked(flown, "a", np.random.default_rng(0))
    std_m = checked.interpolation_m or 0.0
    return NodePositions((std_m,) * 3, 1 / log.rate_hz, "the log's own epochs")
