"""The error budget of an image: what is known to spoil it, and what each cause is expected to cost."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.path_errors import Effect, PointPaths

ARITHMETIC_BELOW_DB = 10.0
"""How far arithmetic stays below the largest other error."""

LEAST_ACCURACY_DB, MOST_ACCURACY_DB = -40.0, -60.0
"""Between them `accuracy_db: auto` stays: sidelobes show down to the first, nothing shows below the second."""

NOTHING = Effect(0.0, 0.0, 0.0)

_NOT_STATED = "not stated"


@dataclass(frozen=True)
class BudgetLine:
    """One cause.

    Attributes
    ----------
    cause
        Its name.
    stated
        What is stated or measured of it, in a few words; None where nobody said: then the effect is that of `unit`.
    unit
        The size that the effect is of where nothing is stated.
    effect
        What it is expected to do.
    """

    cause: str
    stated: str | None
    effect: Effect
    unit: str = ""

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values: metres, dB and radians, rounded."""
        expected = {
            name: float(f"{value:.3g}") + 0.0 if np.isfinite(value) else None
            for name, value in asdict(self.effect).items()
        }
        return {"cause": self.cause, "stated": self.stated or f"{_NOT_STATED}; {self.unit} would do this", **expected}


def is_stated(report: Mapping[str, Any]) -> bool:
    """Return whether the size of a cause is stated or measured, from the `report` of its line.

    Examples
    --------
    >>> is_stated(BudgetLine("heights", None, NOTHING, unit="1 m").report)
    False
    """
    return not report["stated"].startswith(_NOT_STATED)


@dataclass(frozen=True)
class NodePositions:
    """What is known of a node's positions.

    Attributes
    ----------
    std_m
        East, north, up, metres; None: nobody said.
    correlation_s
        How long an error lasts.
    stated_by
        Who said so.
    drift_m
        Of a slow error over the whole flight, in each axis.
    """

    std_m: tuple[float, float, float] | None
    correlation_s: float = 1.0
    stated_by: str = "nobody"
    drift_m: float = 0.0


def position_lines(paths: PointPaths, nodes: Sequence[NodePositions], *, sidelink: bool) -> list[BudgetLine]:
    """Return what errors of the logs do: of those that are stated, and what a centimetre in the others would do.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    nodes
        One for a node that does both, or transmitter and receiver, whose errors do not know of each other.
    sidelink
        As `PointPaths.by_node`.
    """
    slopes = paths.by_node(same=len(nodes) == 1, sidelink=sidelink)
    lines = []
    for stated in (True, False):
        some = [(slope, node) for slope, node in zip(slopes, nodes, strict=True) if (node.std_m is not None) == stated]
        if some:
            sizes = [np.sqrt((slope**2 * np.square(node.std_m or (0.01,) * 3)).sum(axis=1)) for slope, node in some]
            effect = paths.of_noise(*((size, node.correlation_s) for size, (_, node) in zip(sizes, some, strict=True)))
            words = "; ".join(_said(node) for _, node in some) if stated else None
            lines.append(BudgetLine("positions", words, effect, "1 cm in each axis of what nobody stated"))
    return lines


def _said(node: NodePositions) -> str:
    sizes = " ".join(f"{100 * std:.2g}" for std in node.std_m or ())
    return f"{sizes} cm east north up for {node.correlation_s:g} s, said by the {node.stated_by}"


def offset_line(
    paths: PointPaths, cause: str, slope: NDArray[np.float64], std: float | None, *, unit: str, common: bool = False
) -> BudgetLine:
    """Return what a constant error does.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    cause
        Its name.
    slope
        (pulse,) float64, metres of path per unit of the cause.
    std
        Its standard deviation in that unit; None: nobody said.
    unit
        Name of the unit.
    common
        As `PointPaths.of_offset`.
    """
    effect = paths.of_offset(slope * (1.0 if std is None else std), common=common)
    return BudgetLine(cause, None if std is None else f"{std:.3g} {unit}", effect, f"1 {unit}")


def summed(effects: Iterable[Effect]) -> Effect:
    """Return independent effects together: losses add in dB, shifts and phases by their squares.

    Examples
    --------
    >>> summed([Effect(-1.0, 0.03, 0.0), Effect(-0.5, 0.04, 0.1)])
    Effect(loss_db=-1.5, shift_m=0.05, phase_rad=0.1)
    """
    parts = list(effects)
    return Effect(
        sum(effect.loss_db for effect in parts),
        float(np.hypot.reduce([0.0, *(effect.shift_m for effect in parts)])),
        float(np.hypot.reduce([0.0, *(np.nan_to_num(effect.phase_rad) for effect in parts)])),
    )


def expected(lines: Iterable[BudgetLine]) -> Effect:
    """Return what all causes that somebody stated are expected to do together."""
    return summed(line.effect for line in lines if line.stated is not None)


def noise_loss(variance_rad2: float) -> Effect:
    """Return what phase noise that forgets itself from pulse to pulse does: exp(-σ²) of the peak's power."""
    return Effect(-10 * math.log10(math.e) * variance_rad2, 0.0, 0.0)


def strictest_accuracy_db(asked: float | Literal["auto"]) -> float:
    """Return the smallest numerical error that an image may ask for: what an echo, formed before images, must serve.

    Examples
    --------
    >>> strictest_accuracy_db("auto"), strictest_accuracy_db(-45.0)
    (-60.0, -45.0)
    """
    return MOST_ACCURACY_DB if asked == "auto" else asked


def accuracy_for(lines: Iterable[BudgetLine]) -> float:
    """Return the numerical error to ask for: below the largest other error by `ARITHMETIC_BELOW_DB`.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 5: a peak that lost a share of its power has spread that share around it.

    Examples
    --------
    >>> accuracy_for([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))])
    -50.4
    """
    largest = max((1 - 10 ** (line.effect.loss_db / 10) for line in lines if line.stated is not None), default=0.0)
    level = 10 * np.log10(max(largest, 1e-12)) - ARITHMETIC_BELOW_DB
    return round(float(np.clip(level, MOST_ACCURACY_DB, LEAST_ACCURACY_DB)), 1)
