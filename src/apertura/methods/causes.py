"""Causes of wrong images: quantities of the logs and the config, the trial errors of each, and their messages.

`apertura check` reports the causes that are observable in time tags, rule `assess` tries the causes one by one on a
bright point, and rule `refine` fits the causes that displace the nodes of a flight to all bright points.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.leap_seconds import LATEST_S

LEAST_GAIN_DB = 0.5
"""Minimum increase of the power of points by the correction of a reported cause, dB; log errors explain smaller
losses.
"""

# ---- Times in a different time system -------------------------------------------------------------------------------

_TAI_S = 19  # TAI − GPST
_TIME_SYSTEMS = {
    LATEST_S: " (possible cause: GPST interpreted as UTC)",
    -LATEST_S: " (possible cause: UTC interpreted as GPST)",
    LATEST_S + _TAI_S: " (possible cause: TAI interpreted as UTC)",
    _TAI_S: " (possible cause: TAI interpreted as GPST)",
}
_NEAR_S = 3.0  # the log and the recording of a flight start and stop within a few seconds of each other
_NEAR_ZONE_S = 120.0
_ZONE_S = 1800.0
_LONGEST_ZONE_S = 14 * 3600.0


def mistaken_time(shift_s: float, *, tolerance_s: float = _NEAR_S) -> str:
    """Return the probable cause of a delay of the times, as the end of a sentence; '' if no known mistake explains it.

    Examples
    --------
    >>> mistaken_time(17.9), mistaken_time(-7201.0), mistaken_time(400.0)
    (' (possible cause: GPST interpreted as UTC)', ' (possible cause: local time interpreted as UTC)', '')
    """
    for system_s, question in _TIME_SYSTEMS.items():
        if abs(shift_s - system_s) <= tolerance_s:
            return question
    size = abs(shift_s)
    zones = round(size / _ZONE_S)
    if zones and size <= _LONGEST_ZONE_S + _NEAR_ZONE_S and abs(size - zones * _ZONE_S) <= _NEAR_ZONE_S:
        return " (possible cause: local time interpreted as UTC)"
    return " (possible cause: a log of another day)" if size > 86400 else ""


# ---- Table of the quantities that may be wrong ----------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A quantity that may be wrong.

    Attributes
    ----------
    kind
        Short name of the cause.
    sentence
        Message template, with fields for the error, its size and direction, and other arguments.
    directions
        Words that describe a positive and a negative error.
    sizes
        Magnitudes of the trial errors, applied with both signs, the most probable first.
    std
        Prior standard deviation of a fitted error: as large as configuration mistakes, so that the estimate depends on
        the images rather than on the prior.
    question
        Function that returns the probable mistake behind an error, as the end of the sentence.

    Examples
    --------
    >>> TIME.line(18.0, whose="all logs")
    'the times of all logs are 18.00 s late (possible cause: GPST interpreted as UTC)'
    """

    kind: str
    sentence: str
    directions: tuple[str, str] = ("", "")
    sizes: Sequence[Any] = ()
    std: float = 0.0
    question: Callable[[float], str] = lambda _: ""

    @property
    def errors(self) -> list[Any]:
        """Trial errors, the most probable first."""
        return [sign * size for size in self.sizes for sign in (1, -1)]

    def line(self, *error: float, digits: int = 2, **words: str) -> str:
        """Return the message for an error, with `digits` decimals of its size."""
        first = error[0] if error else 0.0
        words |= {"size": f"{abs(first):.{digits}f}", "direction": self.directions[first <= 0]}
        return self.sentence.format(*error, **words) + self.question(first)


TIME = Quantity(
    "time",
    "the times of {whose} are {size} s {direction}",
    ("late", "early"),
    (LATEST_S, LATEST_S + _TAI_S, _TAI_S, LATEST_S - 1, 5, 3, 2, 1, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05),
    std=0.3,
    question=partial(mistaken_time, tolerance_s=0.0),
)
ARM_SIGN = Quantity("lever arm", "{axis} axis of the lever arms of {node} has the opposite sign")
ARM = Quantity(
    "lever arm",
    "the lever arms of {node} are wrong by [{0:+.3f}, {1:+.3f}, {2:+.3f}] m, or its attitude has a constant error",
    std=0.3,
)
TRACKS = Quantity("tracks swapped", "the tracks of {first} and {second} are swapped")
HEIGHT = Quantity(
    "height",
    "the terrain lies {size} m {direction} its configured height",
    ("above", "below"),
    (50.0, 47.0, 20.0, 10.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5),
    std=3.0,
    # an error of 10 m or more may be due to geoid heights that are interpreted as ellipsoidal, or the reverse
    question=lambda height_m: " (possible cause: a different vertical datum)" if abs(height_m) >= 10.0 else "",
)
PREFIX = Quantity(
    "prefix",
    "the path of {pair} has an error of {path_m} m (possible cause: captures start {0:+d} samples from {begin})",
    sizes=(1, 2, 3, 5, 10, 20, 50),
)
RANGE = Quantity(
    "range",
    "the path of {pair} has an error of {0:+.2f} m (possible cause: a wrong path offset)",
    sizes=(0.05, 0.1, 0.15, 0.3, 0.5, 1.0, 2.0, 4.0),
)
CARRIER = Quantity("carrier_is", "waveform.carrier_is is {other}")
CHANNELS = Quantity("channels", "the channels of {node} are swapped")


def whose(nodes: Sequence[str]) -> str:
    """Return the logs with wrong times as named in the message of `TIME`: the log of a single node, or all logs."""
    return f"the log of {nodes[0]}" if len(nodes) == 1 else "all logs"


# ---- Causes that displace the nodes of a flight ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Cause:
    """A wrong quantity that displaces nodes in proportion to its error.

    Attributes
    ----------
    quantity
        The wrong quantity.
    time_s
        (sample,) float64, seconds of the flight's clock.
    moved_m
        Node → (unknown, sample, 3) float64, displacement of the node per unit of each unknown, metres in the frame;
        nodes without an entry are not displaced.
    words
        Arguments of the message template.

    Examples
    --------
    >>> time_s, flown_m = np.arange(3.0), np.array([[0.0, 0, 0], [5, 0, 0], [10, 0, 0]])
    >>> late = late_logs(["a"], {"a": (time_s, flown_m)})
    >>> late.moved_m["a"][0, :, 0], late.line(np.array([0.02]))
    (array([5., 5., 5.]), 'the times of the log of a are 0.020 s late')
    """

    quantity: Quantity
    time_s: Floats
    moved_m: Mapping[str, Floats]
    words: Mapping[str, Any] = field(default_factory=dict)

    @property
    def std(self) -> Floats:
        """(unknown,) float64, standard deviation of each unknown, in its unit."""
        return np.full(len(next(iter(self.moved_m.values()))), self.quantity.std)

    def line(self, values: Floats) -> str:
        """Return a sentence that contains the wrong quantity and its error."""
        return self.quantity.line(*values.tolist(), **self.words)


def late_logs(nodes: Sequence[str], flown: Mapping[str, tuple[Floats, Floats]]) -> Cause:
    """Return the cause of a time delay that is common to the logs of the given nodes.

    Parameters
    ----------
    nodes
        Nodes with late logs.
    flown
        Node → (sample,) seconds and (sample, 3) metres: logged positions.
    """
    time_s, moved = flown[nodes[0]][0], dict[str, Floats]()
    for node in nodes:  # as the epochs of the logs differ, interpolate to the epochs of the first log
        own_s, speed = flown[node][0], np.gradient(flown[node][1], flown[node][0], axis=0)
        moved[node] = np.stack([np.interp(time_s, own_s, axis) for axis in speed.T], axis=-1)[None]
    return Cause(TIME, time_s, moved, {"whose": whose(nodes), "digits": 3})


def other_arm(node: str, time_s: Floats, body_axes: Floats) -> Cause:
    """Return the cause of a constant error of the lever arms or of the attitude of a node.

    Parameters
    ----------
    node
        Name of the node.
    time_s, body_axes
        (sample,) seconds, and (sample, 3, 3): columns are forward, right and down in the frame.

    Notes
    -----
    A constant attitude error δθ displaces an antenna on the lever arm l by δθ × l, as a lever-arm error does.
    """
    return Cause(ARM, time_s, {node: np.moveaxis(body_axes, -1, 0)}, {"node": node})


def other_height(nodes: Sequence[str], time_s: Floats, up: Floats) -> Cause:
    """Return the cause of a terrain height above the configured one, equivalent to lower heights of all nodes.

    `up` is the (3,) unit vector in the frame.
    """
    return Cause(HEIGHT, time_s, {node: np.broadcast_to(-up, (1, len(time_s), 3)) for node in nodes})
