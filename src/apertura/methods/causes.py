"""Causes of wrong images: quantities of the logs and of the config, the errors tried of each, and their words.

`apertura check` names those that times show, rule `assess` tries them one by one on a bright place, and rule `refine`
fits those that move the nodes of a flight to all places.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.leap_seconds import LATEST_S

LEAST_GAIN_DB = 0.5
"""Power of points that a cause must bring back to be named: less needs no explanation beyond the logs' errors."""

# ---- Times that look like those of another time system --------------------------------------------------------------

_TAI_S = 19  # by which TAI is ahead of GPST
_TIME_SYSTEMS = {
    LATEST_S: ": GPST taken for UTC?",
    -LATEST_S: ": UTC taken for GPST?",
    LATEST_S + _TAI_S: ": TAI taken for UTC?",
    _TAI_S: ": TAI taken for GPST?",
}
_NEAR_S = 3.0  # logs and recordings of one flight begin and end within a few seconds of each other
_NEAR_ZONE_S = 120.0
_ZONE_S = 1800.0
_LONGEST_ZONE_S = 14 * 3600.0


def mistaken_time(shift_s: float, *, tolerance_s: float = _NEAR_S) -> str:
    """Return which mistake makes times late by so many seconds, as the end of a sentence; '' where none comes to mind.

    Examples
    --------
    >>> mistaken_time(17.9), mistaken_time(-7201.0), mistaken_time(400.0)
    (': GPST taken for UTC?', ': local time taken for UTC?', '')
    """
    for system_s, question in _TIME_SYSTEMS.items():
        if abs(shift_s - system_s) <= tolerance_s:
            return question
    size = abs(shift_s)
    zones = round(size / _ZONE_S)
    if zones and size <= _LONGEST_ZONE_S + _NEAR_ZONE_S and abs(size - zones * _ZONE_S) <= _NEAR_ZONE_S:
        return ": local time taken for UTC?"
    return ": a log of another day?" if size > 86400 else ""


# ---- Table of the quantities that may be wrong ----------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A quantity that may be wrong.

    Attributes
    ----------
    kind
        Short name of the cause.
    sentence
        That it is wrong: with places for the error, for its size and direction, and for further words.
    directions
        Words of a positive and of a negative error.
    sizes
        Errors that are tried with both signs, the likeliest first.
    std
        Standard deviation of an error that is fitted: as wide as hands err, so that images decide and not the prior.
    question
        Which mistake makes such an error, to end the sentence.

    Examples
    --------
    >>> TIME.line(18.0, whose="all logs")
    'the times of all logs are 18.00 s late: GPST taken for UTC?'
    """

    kind: str
    sentence: str
    directions: tuple[str, str] = ("", "")
    sizes: Sequence[Any] = ()
    std: float = 0.0
    question: Callable[[float], str] = lambda _: ""

    @property
    def errors(self) -> list[Any]:
        """Errors that are tried, the likeliest first."""
        return [sign * size for size in self.sizes for sign in (1, -1)]

    def line(self, *error: float, digits: int = 2, **words: str) -> str:
        """Return the sentence of an error, whose size is given to so many digits after the point."""
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
ARM_SIGN = Quantity("lever arm", "{axis} axis of the lever arms of {node} has the other sign")
ARM = Quantity(
    "lever arm",
    "lever arms of {node} are wrong by [{0:+.3f}, {1:+.3f}, {2:+.3f}] m, or its attitude by a constant",
    std=0.3,
)
TRACKS = Quantity("tracks swapped", "the tracks of {first} and {second} are swapped")
HEIGHT = Quantity(
    "height",
    "the ground lies {size} m {direction} where the config has it",
    ("above", "below"),
    (50.0, 47.0, 20.0, 10.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5),
    std=3.0,
    # from 10 m on heights above a geoid may have been taken for ellipsoidal ones, or the reverse
    question=lambda height_m: ": another vertical datum?" if abs(height_m) >= 10.0 else "",
)
PREFIX = Quantity(
    "prefix",
    "paths of {pair} are {path_m} m off: captures begin {0:+d} samples from {begin}?",
    sizes=(1, 2, 3, 5, 10, 20, 50),
)
RANGE = Quantity(
    "range", "paths of {pair} are {0:+.2f} m off: a path offset?", sizes=(0.05, 0.1, 0.15, 0.3, 0.5, 1.0, 2.0, 4.0)
)
CARRIER = Quantity("carrier_is", "waveform.carrier_is is {other}")
CHANNELS = Quantity("channels", "the channels of {node} are swapped")


def whose(nodes: Sequence[str]) -> str:
    """Return whose times are wrong in the sentence of `TIME`: of one node, or of all."""
    return f"the log of {nodes[0]}" if len(nodes) == 1 else "all logs"


# ---- Causes that move the nodes of a flight ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Cause:
    """A wrong quantity whose error moves nodes in proportion.

    Attributes
    ----------
    quantity
        What is wrong.
    time_s
        (sample,) float64, seconds of the flight's clock.
    moved_m
        Node → (unknown, sample, 3) float64, by how much a unit of each moves the node, metres in the frame; nodes that
        are not named stay.
    words
        Of the sentence.

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
        """(unknown,) float64, standard deviation of each, in its unit."""
        return np.full(len(next(iter(self.moved_m.values()))), self.quantity.std)

    def line(self, values: Floats) -> str:
        """Describe the wrong quantity, with its error."""
        return self.quantity.line(*values.tolist(), **self.words)


def late_logs(nodes: Sequence[str], flown: Mapping[str, tuple[Floats, Floats]]) -> Cause:
    """Return the cause that the times of some logs are late by one delay.

    Parameters
    ----------
    nodes
        Whose logs.
    flown
        Node → (sample,) seconds and (sample, 3) metres: where its log has it.
    """
    time_s, moved = flown[nodes[0]][0], dict[str, Floats]()
    for node in nodes:  # logs differ in epochs: all at those of the first
        own_s, speed = flown[node][0], np.gradient(flown[node][1], flown[node][0], axis=0)
        moved[node] = np.stack([np.interp(time_s, own_s, axis) for axis in speed.T], axis=-1)[None]
    return Cause(TIME, time_s, moved, {"whose": whose(nodes), "digits": 3})


def other_arm(node: str, time_s: Floats, body_axes: Floats) -> Cause:
    """Return the cause that a node's antennas lie elsewhere on the body, or the body is turned against its attitude.

    Parameters
    ----------
    node
        Its name.
    time_s, body_axes
        (sample,) seconds, and (sample, 3, 3): columns are forward, right and down in the frame.

    Notes
    -----
    A constant error δθ of attitude moves an antenna on the arm l as an arm that is wrong by δθ × l does.
    """
    return Cause(ARM, time_s, {node: np.moveaxis(body_axes, -1, 0)}, {"node": node})


def other_height(nodes: Sequence[str], time_s: Floats, up: Floats) -> Cause:
    """Return the cause that the ground lies higher than stated, as if all nodes flew lower; `up` (3,) in the frame."""
    return Cause(HEIGHT, time_s, {node: np.broadcast_to(-up, (1, len(time_s), 3)) for node in nodes})
