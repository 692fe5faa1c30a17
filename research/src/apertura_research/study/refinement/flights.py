"""Flights of two nodes 4.7 m apart past a scene of 18 m × 20 m, and the errors of their logs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from apertura.common.arrays import Floats
from apertura.methods.autofocus.inputs import TrackErrors

PULSES_HZ = 100.0
NODES = ("uav1", "uav2")
_APART_M = 4.7


@dataclass(frozen=True, eq=False)
class Flight:
    """Where the logs have both nodes, metres, east, north, up.

    Attributes
    ----------
    time_s
        (pulse,) float64.
    logged_m
        Node → (pulse, 3) float64.
    reach_m
        East and north of a point, within which its peak is looked for.
    """

    time_s: Floats
    logged_m: Mapping[str, Floats]
    reach_m: tuple[float, float] = (0.5, 0.6)


def _straight() -> Flight:
    time_s = np.arange(3000) / PULSES_HZ
    first = np.stack([time_s - 15, 0 * time_s, np.full(3000, 10.0)], -1)
    return Flight(time_s, dict(zip(NODES, (first, first + [_APART_M, 0, 0]), strict=True)))


def _wobble() -> Flight:
    plain = _straight()
    swing = [np.sin(2 * np.pi * plain.time_s / period) for period in (4.3, 7.3, 2.9, 6.1, 8.3)]
    rise = np.sin(2 * np.pi * plain.time_s / 5.1 + 1)
    common = np.stack([0.2 * swing[0], 0.6 * swing[1] + 0.2 * swing[2], 0.5 * rise], -1)
    second = np.stack([0 * rise, 0.5 * swing[3], 0.4 * swing[4]], -1)
    first, other = plain.logged_m.values()
    return Flight(plain.time_s, dict(zip(NODES, (first + common, other + common + second), strict=True)))


def _circle() -> Flight:
    """Around the scene's middle at 14 m, once."""
    radius = 14.0
    time_s = np.arange(int(2 * np.pi * radius * PULSES_HZ)) / PULSES_HZ

    def around(turn: Floats) -> Floats:
        return np.stack([radius * np.sin(turn), 15 - radius * np.cos(turn), np.full(len(turn), 10.0)], -1)

    turn = time_s / radius
    return Flight(time_s, dict(zip(NODES, (around(turn), around(turn + _APART_M / radius)), strict=True)))


def _far() -> Flight:
    """Past the scene at a kilometre, ten times as fast: one phase per pulse is the same for all of it."""
    time_s = np.arange(3000) / PULSES_HZ
    first = np.stack([10 * (time_s - 15), np.full(3000, -985.0), np.full(3000, 300.0)], -1)
    return Flight(time_s, dict(zip(NODES, (first, first + [_APART_M, 0, 0]), strict=True)), (1.2, 0.6))


FLIGHTS: Mapping[str, Callable[[], Flight]] = {
    "straight": _straight,
    "wobble": _wobble,
    "circle": _circle,
    "far": _far,
}


def drawn_errors(time_s: Floats, errors: TrackErrors, generator: np.random.Generator) -> Floats:
    """Return (pulse, 3) metres: white noise after a moving average over the correlation time, and a slow drift."""
    step_s = time_s[1] - time_s[0]
    width = max(1, round(errors.correlation_s / step_s))
    total = np.cumsum(np.vstack([np.zeros(3), generator.standard_normal((len(time_s) + width, 3))]), axis=0)
    noise = (total[width:] - total[:-width])[: len(time_s)] / np.sqrt(width)
    return np.asarray(noise * errors.std_m + _drift(time_s) @ generator.standard_normal((4, 3)) * errors.drift_std_m)


def _drift(time_s: Floats) -> Floats:
    """Return (pulse, 4): offset, slope and a bow either way, together of about unit variance."""
    part = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    return np.stack([np.ones_like(part), 2 * part - 1, np.sin(np.pi * part), np.cos(np.pi * part)], -1) / 2
