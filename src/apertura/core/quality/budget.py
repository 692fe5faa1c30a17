"""Error budget of an image: error sources, their configured, measured or assumed sizes, and their expected effects."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.flags import Flags
from apertura.core.quality.path_errors import Effect, PointPaths

ARITHMETIC_BELOW_DB = 10.0
"""Margin of the numerical error below the largest other error, dB: the numerical error then adds 0.4 dB to the total
error."""

LEAST_ACCURACY_DB, MOST_ACCURACY_DB = -40.0, -60.0
"""Range of `accuracy_db: auto`, dB: errors above the first limit are visible as sidelobes, errors below the second are
invisible."""

NO_EFFECT = Effect(0.0, 0.0, 0.0)  # effect of an error source whose error is zero

_NOT_STATED, _ASSUMED = "not configured", "assumed"

RECEIVER_STD_M = {"fix": 0.01, "float": 0.3, "sbas": 1.0, "dgps": 0.5, "single": 1.0, "ppp": 0.1, "unknown": 0.01}
"""Assumed standard deviation of positions in each axis by solution class, metres, if no accuracy is stated: one
centimetre for a fixed RTK solution, decimetres for a float solution, metres without RTK. A log without a solution class
is assumed to contain fixed solutions, as required for a radar image."""

ATTITUDE_STD_DEG = {"log": (1.0, 3.0), "course": (8.0, 10.0)}
"""Assumed standard deviations of roll and pitch (each) and of heading by attitude source, degrees, if none are stated.
A small inertial unit has errors of about 1° in roll and pitch; a magnetometer near motors has errors of a few degrees
in heading. Axes derived from the course presuppose a level body that flies straight ahead, whereas multirotors tilt by
5° to 15° and crab in wind."""

LEVER_ARM_STD_M = 0.01
"""Assumed standard deviation of a lever arm in each axis, metres, if none is stated: a lever arm is measured with a
ruler, to a phase centre whose position is not exactly known."""

LEAST_FIELD = 0.1
"""Minimum field of a pulse relative to the strongest pulse: the phase of the pattern is neglected at weaker pulses."""

UNDETECTABLE_LOSS_DB = 0.2
"""Peak loss that is not detectable in an image, dB; tolerated for the phase of antenna patterns and for height errors.
"""

GROUND_STD_M = 3.0
"""Assumed standard deviation of the terrain height, metres, if none is stated and height errors are not observable in
the image. The value covers errors of map contours and barometers, and the heights of crops and roofs. A confusion of
geoid and ellipsoid causes an error of tens of metres, which other checks detect."""

_SMALL_M = 1e-2  # height error for which the loss is quadratic

_FEWEST_PULSES = 3  # minimum number of pulses to separate a horizontal shift from the residual

_FIXED = frozenset({"fix", "unknown"})
_SLOW_S = 100.0
"""Correlation time of solutions that are not fixed, seconds: ambiguities, orbits and the atmosphere vary over minutes.
"""


@dataclass(frozen=True)
class BudgetLine:
    """One error source of the budget.

    Attributes
    ----------
    cause
        Name of the error source.
    stated
        Stated or measured size of the error, a phrase. None if no size is stated: the effect is then computed for an
        error of the size `unit`.
    unit
        Size for which the effect is computed if no size is stated.
    effect
        Expected effect.
    assumed
        Size that is assumed if none is stated, with the reason; the effect of an error of this size is expected. None:
        no size is assumed.
    """

    cause: str
    stated: str | None
    effect: Effect
    unit: str = ""
    assumed: str | None = None

    @property
    def counts(self) -> bool:
        """True if the effect is expected, that is, if the size of the error is stated, measured or assumed."""
        return self.stated is not None or self.assumed is not None

    @property
    def report(self) -> dict[str, Any]:
        """Line as JSON values: metres, dB and radians, rounded."""
        expected = {
            name: float(f"{value:.3g}") + 0.0 if np.isfinite(value) else None
            for name, value in asdict(self.effect).items()
            if name != "loss_std_db"
        }
        per_unit = f"; effect computed for {self.unit}" if self.unit else ""
        basis = per_unit if self.assumed is None else f"; {_ASSUMED} {self.assumed}"
        return {"cause": self.cause, "stated": self.stated or f"{_NOT_STATED}{basis}", **expected}


def is_stated(report: Mapping[str, Any]) -> bool:
    """Return True if the size of an error source is stated or measured, from the `report` of its line.

    Examples
    --------
    >>> is_stated(BudgetLine("heights", None, NO_EFFECT, unit="1 m").report)
    False
    """
    return not report["stated"].startswith(_NOT_STATED)


def is_counted(report: Mapping[str, Any]) -> bool:
    """Return True if the effect of an error is expected, that is, if its size is stated, measured or assumed.

    Examples
    --------
    >>> is_counted(BudgetLine("positions", None, NO_EFFECT, assumed="1 cm of an RTK fix").report)
    True
    """
    return is_stated(report) or report["stated"].startswith(f"{_NOT_STATED}; {_ASSUMED}")


@dataclass(frozen=True)
class NodePositions:
    """Position accuracy of a node.

    Attributes
    ----------
    std_m
        Standard deviation east, north, up, metres; None: unstated.
    correlation_s
        Correlation time of `autocorrelation`, seconds.
    stated_by
        Source of the accuracy: 'config' or 'log'.
    drift_m
        Standard deviation of a slow error over the whole flight, in each axis, metres.
    receiver
        Solution class, a key of `RECEIVER_STD_M`; None if positions are not from a receiver's log.
    """

    std_m: tuple[float, float, float] | None
    correlation_s: float = 1.0
    stated_by: str = "none"
    drift_m: float = 0.0
    receiver: str | None = None

    @property
    def assumed(self) -> "NodePositions":
        """Stated accuracy, otherwise the accuracy assumed for the solution class."""
        if self.std_m is not None or self.receiver is None:
            return self
        correlation_s = self.correlation_s if self.receiver in _FIXED else max(self.correlation_s, _SLOW_S)
        return replace(self, std_m=(RECEIVER_STD_M[self.receiver],) * 3, correlation_s=correlation_s)


def position_lines(paths: PointPaths, nodes: Sequence[NodePositions], *, sidelink: bool) -> list[BudgetLine]:
    """Return the budget lines of position errors of stated size, of a size assumed by solution class, or of 1 cm.

    Parameters
    ----------
    paths
        Paths to a point at the scene centre.
    nodes
        One node that transmits and receives, or a transmitter and a receiver with independent errors.
    sidelink
        As for `PointPaths.by_node`.
    """
    slopes = paths.by_node(same=len(nodes) == 1, sidelink=sidelink)
    lines = []
    for kind in ("stated", "assumed", "nothing"):
        of_kind = [(slope, node) for slope, node in zip(slopes, nodes, strict=True) if _known(node) == kind]
        if of_kind:
            assumed_nodes = [node.assumed for _, node in of_kind]
            sizes = [
                np.sqrt((slope**2 * np.square(node.std_m or (0.01,) * 3)).sum(axis=1))
                for (slope, _), node in zip(of_kind, assumed_nodes, strict=True)
            ]
            noise = ((size, node.correlation_s) for size, node in zip(sizes, assumed_nodes, strict=True))
            effect = paths.of_noise(*noise)
            accuracy = "; ".join(f"{_sizes(node)}, stated by the {node.stated_by}" for node in assumed_nodes)
            assumed = "; ".join(f"{_sizes(node)}, {_CLASSES[node.receiver]}" for node in assumed_nodes if node.receiver)
            lines.append(
                BudgetLine(
                    "positions",
                    accuracy if kind == "stated" else None,
                    effect,
                    "1 cm in each axis",
                    assumed=assumed if kind == "assumed" else None,
                )
            )
    return lines


_CLASSES = {name: f"solution class {name}" for name in RECEIVER_STD_M} | {
    "fix": "fixed RTK solution", "unknown": "treated as a fixed RTK solution (no solution class in the log)"
}  # fmt: skip


def _known(node: NodePositions) -> Literal["stated", "assumed", "nothing"]:
    return "stated" if node.std_m is not None else "assumed" if node.receiver is not None else "nothing"


def _sizes(node: NodePositions) -> str:
    sizes = " ".join(f"{100 * std:.2g}" for std in node.std_m or ())
    return f"{sizes} cm east, north, up, correlation time {node.correlation_s:g} s"


@dataclass(frozen=True, eq=False)
class NodeAttitude:
    """Lever arms of a node, and the accuracy of its attitude and lever arms.

    Attributes
    ----------
    axes
        (pulse, 3, 3) float64; columns are the body's forward, right and down in the frame of the phase centres.
    arms_m
        Lever arms, metres forward, right, down, of the transmitting radar antenna, the receiving radar antenna, and the
        sidelink antenna; each may be zero.
    source
        Source of the attitude, a key of `ATTITUDE_STD_DEG`.
    std_deg
        Stated standard deviations of roll and pitch (each) and of heading, degrees; None: unstated.
    correlation_s
        Correlation time of attitude errors (`autocorrelation`), seconds.
    arm_std_m
        Stated standard deviation of lever arms in each axis, metres; None: unstated.
    """

    axes: NDArray[np.float64]
    arms_m: tuple[tuple[float, float, float], ...]
    source: str
    std_deg: tuple[float, float] | None
    correlation_s: float
    arm_std_m: float | None


Growth = Sequence[NDArray[np.float64]]
"""Derivatives of the path with respect to the positions of the antennas of `NodeAttitude.arms_m`, (pulse, 3) each."""


def attitude_lines(paths: PointPaths, nodes: Sequence[NodeAttitude | None], *, sidelink: bool) -> list[BudgetLine]:
    """Return the budget lines of attitude errors and of lever arm errors; no lines without lever arms.

    Parameters
    ----------
    paths
        Paths to a point at the scene centre.
    nodes
        One node that transmits and receives, or a transmitter and a receiver, at the pulses of `paths`; None for a node
        without lever arms.
    sidelink
        As for `PointPaths.by_node`.

    Notes
    -----
    Source: docs/theory/focus.md, eqs. 4a and 4b.
    """
    same = len(nodes) == 1
    tx, rx, tx_sidelink, rx_sidelink = paths.by_point(sidelink=sidelink and not same)
    none = np.zeros_like(tx)
    growths: tuple[Growth, ...] = ((tx, rx, none),) if same else ((tx, none, tx_sidelink), (none, rx, rx_sidelink))
    armed = [(node, growth) for node, growth in zip(nodes, growths, strict=True) if node and np.any(node.arms_m)]
    lines = []
    sources = (("attitude", "std_deg", _attitude_errors), ("lever arms", "arm_std_m", _lever_arm_errors))
    for cause, name, errors_of in sources:
        for is_stated in (True, False):
            errors = [
                errors_of(paths, node, growth)
                for node, growth in armed
                if (getattr(node, name) is not None) == is_stated
            ]
            if errors:
                sizes = "; ".join(words for words, _ in errors)
                effect = paths.of_noise(*(part for _, parts in errors for part in parts))
                lines.append(
                    BudgetLine(cause, sizes if is_stated else None, effect, assumed=None if is_stated else sizes)
                )
    return lines


_Errors = tuple[str, list[tuple[NDArray[np.float64], float]]]


def _attitude_errors(paths: PointPaths, node: NodeAttitude, growth: Growth) -> _Errors:
    """Return the size of attitude errors as a phrase, and the path errors from rotations about east, north and up."""
    tilt, heading = node.std_deg or ATTITUDE_STD_DEG[node.source]
    torque = sum(np.cross(node.axes @ arm, grown) for arm, grown in zip(np.array(node.arms_m), growth, strict=True))
    words = f"{tilt:g}° roll and pitch, {heading:g}° heading, from the {node.source}"
    words += f", correlation time {node.correlation_s:g} s"
    sizes = np.radians([tilt, tilt, heading]) * (torque @ paths.axes.T)
    return words, [(size, node.correlation_s) for size in sizes.T]


def _lever_arm_errors(_: PointPaths, node: NodeAttitude, growth: Growth) -> _Errors:
    """Return the size of lever arm errors as a phrase, and the path errors of each antenna along each body axis."""
    std_m = LEVER_ARM_STD_M if node.arm_std_m is None else node.arm_std_m
    sizes = [std_m * np.einsum("pc,pcb->bp", grown, node.axes) for grown in growth if grown.any()]
    return f"{100 * std_m:.2g} cm in each axis", [(size, np.inf) for antenna in sizes for size in antenna]


def antenna_line(paths: PointPaths, phase_rad: NDArray[np.float64], weight: NDArray[np.float64]) -> BudgetLine:
    """Return the budget line of the phase of antenna patterns, which is not corrected in images.

    Parameters
    ----------
    paths
        Paths to a point at the scene centre.
    phase_rad, weight
        (pulse,) float64: sum of the phases, and product of the fields, of both antennas in the direction of the point.
        Pulses with a field below `LEAST_FIELD` of the strongest pulse are excluded.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 4c.
    """
    illuminating = weight >= LEAST_FIELD * weight.max()
    if weight.max() <= 0 or illuminating.sum() < _FEWEST_PULSES:
        return BudgetLine("antenna", None, NO_EFFECT, "beams that do not illuminate the scene centre")
    part = replace(paths, aperture=paths.aperture[np.flatnonzero(illuminating)], time_s=paths.time_s[illuminating])
    # A constant phase does not displace the point.
    phase, mean = phase_rad[illuminating], float(phase_rad[illuminating].mean())
    effect = replace(part.of_offset(paths.wavelength_m / (2 * np.pi) * (mean - phase)), phase_rad=abs(mean))
    span_rad = float(np.ptp(phase))
    return BudgetLine("antenna", f"weighted by the configured beams, whose phase varies by {span_rad:.2g} rad", effect)


def antenna_flags(lines: Iterable[BudgetLine]) -> Flags:
    """Return the flag `antenna_phase` if the loss from the phase of the patterns exceeds `UNDETECTABLE_LOSS_DB`."""
    flags = Flags()
    for line in lines:
        if line.cause == "antenna" and line.effect.loss_db < -UNDETECTABLE_LOSS_DB:
            loss, shift = f"{-line.effect.loss_db:.1f} dB", f"{100 * line.effect.shift_m:.2g} cm"
            flags["antenna_phase"] = f"peak loss {loss}, displacement {shift}: {line.stated}"
    return flags


def offset_line(
    paths: PointPaths,
    cause: str,
    slope: NDArray[np.float64],
    std: float | None,
    *,
    unit: str,
    quantity: str = "",
    common: bool = False,
) -> BudgetLine:
    """Return the budget line of a constant error.

    Parameters
    ----------
    paths
        Paths to a point at the scene centre.
    cause
        Name of the error source.
    slope
        (pulse,) float64, metres of path per unit of the error.
    std
        Standard deviation of the error in that unit; None: unstated.
    unit
        Name of the unit.
    quantity
        Name of the quantity in that unit, if it is not obvious from the error source.
    common
        As for `PointPaths.of_offset`.
    """
    effect = paths.of_offset(slope * (1.0 if std is None else std), common=common)
    effect = replace(effect, loss_std_db=math.sqrt(2) * -effect.loss_db)  # the loss is quadratic in a Gaussian error
    stated = None if std is None else f"{quantity} {std:.3g} {unit}".lstrip()
    return BudgetLine(cause, stated, effect, f"a {quantity} of 1 {unit}" if quantity else f"1 {unit}")


def arithmetic_line(error_db: float) -> BudgetLine:
    """Return the budget line of the measured numerical error."""
    return BudgetLine(
        "arithmetic", f"{error_db:.1f} dB measured", Effect(10 * np.log10(1 - 10 ** (error_db / 10)), 0, 0)
    )


def height_line(paths: PointPaths, std_m: float | None, *, expected_db: float = 0.0) -> BudgetLine:
    """Return the budget line of the terrain height: its stated error, or the largest one not observable in the image.

    Parameters
    ----------
    paths
        Paths to a point at the scene centre.
    std_m
        Configured standard deviation of the heights, metres; None: not configured.
    expected_db
        Expected loss from other error sources, dB, 0 or less: a height error that causes this loss is not detectable.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 2a. An assumed height error is expected to displace points without a peak loss,
    because an error that causes a loss would be observable in the image.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> along = np.linspace(-5, 5, 101)
    >>> track = np.stack([along, np.full(101, -10.0), np.full(101, 10.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along, np.zeros(3), np.eye(3), 0.2)
    >>> print(height_line(paths, None).report["stated"])
    not configured; assumed 3 m, because height errors are not observable with this track
    """
    slope = -paths.gradient[:, 2]
    if std_m is not None:
        return offset_line(paths, "heights", slope, std_m, unit="m", common=True)
    loss_db_m2 = -paths.of_offset(_SMALL_M * slope, common=True).loss_db / _SMALL_M**2
    undetectable_db = UNDETECTABLE_LOSS_DB - expected_db
    observable_m = math.sqrt(undetectable_db / max(loss_db_m2, 1e-9))
    assumed_m, reason = GROUND_STD_M, "height errors are not observable with this track"
    if observable_m < assumed_m:
        assumed_m, reason = (
            observable_m,
            f"a larger error would cause an observable peak loss of more than {undetectable_db:.2g} dB",
        )
    effect = replace(paths.of_offset(assumed_m * slope, common=True), loss_db=0.0, loss_std_db=0.0)
    return BudgetLine("heights", None, effect, assumed=f"{assumed_m:.2g} m, because {reason}")


def summed(effects: Iterable[Effect]) -> Effect:
    """Return the sum of independent effects: losses add in dB, shifts and phases in quadrature.

    Examples
    --------
    >>> summed([Effect(-1.0, 0.03, 0.0, 0.3), Effect(-0.5, 0.04, 0.1, 0.4)])
    Effect(loss_db=-1.5, shift_m=0.05, phase_rad=0.1, loss_std_db=0.5)
    """
    parts = list(effects)
    return Effect(
        sum(effect.loss_db for effect in parts),
        float(np.hypot.reduce([0.0, *(effect.shift_m for effect in parts)])),
        float(np.hypot.reduce([0.0, *(np.nan_to_num(effect.phase_rad) for effect in parts)])),
        float(np.hypot.reduce([0.0, *(effect.loss_std_db for effect in parts)])),
    )


def expected(lines: Iterable[BudgetLine]) -> Effect:
    """Return the total expected effect of all error sources whose size is stated, measured or assumed."""
    return summed(line.effect for line in lines if line.counts)


def noise_loss(variance_rad2: float) -> Effect:
    """Return the effect of phase noise that is independent between pulses: the peak power is multiplied by exp(-σ²)."""
    return Effect(-10 * math.log10(math.e) * variance_rad2, 0.0, 0.0)


def strictest_accuracy_db(requested: float | Literal["auto"]) -> float:
    """Return the smallest numerical error that may be requested, which determines the accuracy of echo processing.

    Examples
    --------
    >>> strictest_accuracy_db("auto"), strictest_accuracy_db(-45.0)
    (-60.0, -45.0)
    """
    return MOST_ACCURACY_DB if requested == "auto" else requested


def accuracy_for(lines: Iterable[BudgetLine]) -> float:
    """Return the numerical error to request: `ARITHMETIC_BELOW_DB` below the largest other error.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 5: the power lost by a peak is spread around the peak.

    Examples
    --------
    >>> accuracy_for([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))])
    -50.4
    """
    largest = max((1 - 10 ** (line.effect.loss_db / 10) for line in lines if line.stated is not None), default=0.0)
    level = 10 * np.log10(max(largest, 1e-12)) - ARITHMETIC_BELOW_DB
    return round(float(np.clip(level, MOST_ACCURACY_DB, LEAST_ACCURACY_DB)), 1)
