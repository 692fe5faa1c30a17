"""The error budget of an image: stated causes of error, and the expected effect of each."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.flags import Flags
from apertura.core.quality.path_errors import Effect, PointPaths

ARITHMETIC_BELOW_DB = 10.0
"""dB of numerical error below the largest other error: it then adds 0.4 dB to the sum."""

LEAST_ACCURACY_DB, MOST_ACCURACY_DB = -40.0, -60.0
"""dB, range of `accuracy_db: auto`: errors above the first show as sidelobes, errors below the second are invisible."""

NO_EFFECT = Effect(0.0, 0.0, 0.0)  # of a cause without error

_NOT_STATED, _ASSUMED = "not stated", "assumed"

RECEIVER_STD_M = {"fix": 0.01, "float": 0.3, "sbas": 1.0, "dgps": 0.5, "single": 1.0, "ppp": 0.1, "unknown": 0.01}
"""Metres in each axis that positions of a receiver's class err where nobody states it: a fixed RTK solution within a
centimetre or two, a float one by decimetres, without RTK by metres; a log that does not say is taken as fixed, as
positions must be for a radar image."""

ATTITUDE_STD_DEG = {"log": (1.0, 3.0), "course": (8.0, 10.0)}
"""Degrees, of the vertical (roll and pitch, each) and of heading, that body axes err by where nobody states it: a small
inertial unit holds the vertical to about 1°, a magnetometer beside motors north to a few. Axes by the course are those
of a level body that flies straight ahead, but multirotors lean by 5° to 15°, and wind makes all of them crab."""

LEVER_ARM_STD_M = 0.01
"""Metres in each axis that a lever arm errs by where nobody states it: measured with a ruler, to a phase centre that
lies somewhere in its antenna."""

LEAST_FIELD = 0.1
"""Of the strongest pulse: weaker ones do not decide what the phase of a pattern does to a point."""

UNDETECTABLE_LOSS_DB = 0.2
"""dB that images do not tell of a loss: so much the phase of antenna patterns, or another height, may cost unseen."""

GROUND_STD_M = 3.0
"""Metres that the ground's height errs by where nobody states it and no image shows it: heights above a geoid and above
an ellipsoid differ by tens of metres, which images end for; a map's contours, a barometer, crops and roofs by these."""

_SMALL_M = 1e-2  # by which heights differ where a loss grows with their square

_FEWEST_PULSES = 3  # that a shift over ground and a rest can be told apart from

_FIXED = frozenset({"fix", "unknown"})
_SLOW_S = 100.0
"""Correlation time of what is not a fixed solution: ambiguities, orbits and the atmosphere change over minutes."""


@dataclass(frozen=True)
class BudgetLine:
    """One cause of error.

    Attributes
    ----------
    cause
        Its name.
    stated
        Its stated or measured size, in a few words; None if unstated: the effect is then that of `unit`.
    unit
        Size that the effect is computed for where none is stated.
    effect
        Expected effect.
    assumed
        What is taken for it where nothing is stated, and why; it counts as expected. None: nothing is.
    """

    cause: str
    stated: str | None
    effect: Effect
    unit: str = ""
    assumed: str | None = None

    @property
    def counts(self) -> bool:
        """True if its effect is expected: stated, measured or assumed."""
        return self.stated is not None or self.assumed is not None

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values: metres, dB and radians, rounded."""
        expected = {
            name: float(f"{value:.3g}") + 0.0 if np.isfinite(value) else None
            for name, value in asdict(self.effect).items()
            if name != "loss_std_db"
        }
        would = f"; {self.unit} would do this" if self.unit else ""
        otherwise = would if self.assumed is None else f"; {_ASSUMED} {self.assumed}"
        return {"cause": self.cause, "stated": self.stated or f"{_NOT_STATED}{otherwise}", **expected}


def is_stated(report: Mapping[str, Any]) -> bool:
    """Test whether the size of a cause is stated or measured, from the `report` of its line.

    Examples
    --------
    >>> is_stated(BudgetLine("heights", None, NO_EFFECT, unit="1 m").report)
    False
    """
    return not report["stated"].startswith(_NOT_STATED)


def is_counted(report: Mapping[str, Any]) -> bool:
    """Test whether the effect of a cause is expected: its size is stated, measured or assumed.

    Examples
    --------
    >>> is_counted(BudgetLine("positions", None, NO_EFFECT, assumed="1 cm of an RTK fix").report)
    True
    """
    return is_stated(report) or report["stated"].startswith(f"{_NOT_STATED}; {_ASSUMED}")


@dataclass(frozen=True)
class NodePositions:
    """Stated errors of a node's positions.

    Attributes
    ----------
    std_m
        Standard deviation east, north, up, metres; None: unstated.
    correlation_s
        Correlation time, seconds, as `autocorrelation`.
    stated_by
        Source of the statement: config or log.
    drift_m
        Of a slow error over the whole flight, in each axis.
    receiver
        Class of the receiver, a key of `RECEIVER_STD_M`; None where positions come from no receiver's log.
    """

    std_m: tuple[float, float, float] | None
    correlation_s: float = 1.0
    stated_by: str = "nobody"
    drift_m: float = 0.0
    receiver: str | None = None

    @property
    def assumed(self) -> "NodePositions":
        """The same with the error of its receiver's class where none is stated."""
        if self.std_m is not None or self.receiver is None:
            return self
        correlation_s = self.correlation_s if self.receiver in _FIXED else max(self.correlation_s, _SLOW_S)
        return replace(self, std_m=(RECEIVER_STD_M[self.receiver],) * 3, correlation_s=correlation_s)


def position_lines(paths: PointPaths, nodes: Sequence[NodePositions], *, sidelink: bool) -> list[BudgetLine]:
    """Return the effect of position errors: those stated, those of a receiver's class, a centimetre where neither is.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    nodes
        One for a node that does both, or transmitter and receiver, whose errors are independent.
    sidelink
        As `PointPaths.by_node`.
    """
    slopes = paths.by_node(same=len(nodes) == 1, sidelink=sidelink)
    lines = []
    for kind in ("stated", "assumed", "nothing"):
        some = [(slope, node) for slope, node in zip(slopes, nodes, strict=True) if _known(node) == kind]
        if some:
            taken = [node.assumed for _, node in some]
            sizes = [
                np.sqrt((slope**2 * np.square(node.std_m or (0.01,) * 3)).sum(axis=1))
                for (slope, _), node in zip(some, taken, strict=True)
            ]
            effect = paths.of_noise(*((size, node.correlation_s) for size, node in zip(sizes, taken, strict=True)))
            accuracy = "; ".join(f"{_sizes(node)}, said by the {node.stated_by}" for node in taken)
            assumed = "; ".join(f"{_sizes(node)}, {_CLASSES[node.receiver]}" for node in taken if node.receiver)
            lines.append(
                BudgetLine(
                    "positions",
                    accuracy if kind == "stated" else None,
                    effect,
                    "1 cm in each axis of what nobody stated",
                    assumed=assumed if kind == "assumed" else None,
                )
            )
    return lines


_CLASSES = {name: f"a solution of kind {name}" for name in RECEIVER_STD_M} | {
    "fix": "an RTK fix", "unknown": "as an RTK fix: the log does not say"
}  # fmt: skip


def _known(node: NodePositions) -> Literal["stated", "assumed", "nothing"]:
    return "stated" if node.std_m is not None else "assumed" if node.receiver is not None else "nothing"


def _sizes(node: NodePositions) -> str:
    sizes = " ".join(f"{100 * std:.2g}" for std in node.std_m or ())
    return f"{sizes} cm east north up for {node.correlation_s:g} s"


@dataclass(frozen=True, eq=False)
class NodeAttitude:
    """Lever arms of a node, and the errors of what turns them.

    Attributes
    ----------
    axes
        (pulse, 3, 3) float64; columns are the body's forward, right and down in the frame of the phase centres.
    arms_m
        Lever arms, metres forward, right, down: of its radar antenna that sends, the one that receives, and its
        sidelink antenna, of which each may be zero.
    source
        Where attitude comes from, a key of `ATTITUDE_STD_DEG`.
    std_deg
        Stated standard deviations of the vertical (roll and pitch, each) and of heading, degrees; None: unstated.
    correlation_s
        How long an error of attitude lasts, seconds, as `autocorrelation`.
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
"""What path grows by per metre that the antennas of `NodeAttitude.arms_m` are elsewhere, (pulse, 3) each."""


def attitude_lines(paths: PointPaths, nodes: Sequence[NodeAttitude | None], *, sidelink: bool) -> list[BudgetLine]:
    """Return the effect of errors of attitude on the ends of lever arms, and of errors of the arms; none without arms.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    nodes
        One for a node that does both, or transmitter and receiver, at the pulses of `paths`; None without lever arms.
    sidelink
        As `PointPaths.by_node`.

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
    for cause, name, error in (("attitude", "std_deg", _turned), ("lever arms", "arm_std_m", _other_arms)):
        for is_stated in (True, False):
            some = [error(paths, *one) for one in armed if (getattr(one[0], name) is not None) == is_stated]
            if some:
                sizes = "; ".join(words for words, _ in some)
                effect = paths.of_noise(*(part for _, parts in some for part in parts))
                lines.append(
                    BudgetLine(cause, sizes if is_stated else None, effect, assumed=None if is_stated else sizes)
                )
    return lines


_Errors = tuple[str, list[tuple[NDArray[np.float64], float]]]


def _turned(paths: PointPaths, node: NodeAttitude, growth: Growth) -> _Errors:
    """Return errors of attitude in words, and the errors of path by them: about east, north and up."""
    tilt, heading = node.std_deg or ATTITUDE_STD_DEG[node.source]
    torque = sum(np.cross(node.axes @ arm, grown) for arm, grown in zip(np.array(node.arms_m), growth, strict=True))
    words = f"{tilt:g}° of roll and pitch, {heading:g}° of heading by the {node.source} for {node.correlation_s:g} s"
    sizes = np.radians([tilt, tilt, heading]) * (torque @ paths.axes.T)
    return words, [(size, node.correlation_s) for size in sizes.T]


def _other_arms(_: PointPaths, node: NodeAttitude, growth: Growth) -> _Errors:
    """Return errors of lever arms in words, and the errors of path by them: of each antenna, along each body axis."""
    std_m = LEVER_ARM_STD_M if node.arm_std_m is None else node.arm_std_m
    sizes = [std_m * np.einsum("pc,pcb->bp", grown, node.axes) for grown in growth if grown.any()]
    return f"{100 * std_m:.2g} cm in each axis", [(size, np.inf) for antenna in sizes for size in antenna]


def antenna_line(paths: PointPaths, phase_rad: NDArray[np.float64], weight: NDArray[np.float64]) -> BudgetLine:
    """Return the effect of the phase of antenna patterns, which no image is corrected for.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    phase_rad, weight
        (pulse,) float64: of both antennas towards the point, and their field; pulses that see it by less than
        `LEAST_FIELD` of the strongest do not count.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 4c.
    """
    illuminating = weight >= LEAST_FIELD * weight.max()
    if weight.max() <= 0 or illuminating.sum() < _FEWEST_PULSES:
        return BudgetLine("antenna", None, NO_EFFECT, "a pattern that sees the middle of the scene")
    part = replace(paths, aperture=paths.aperture[np.flatnonzero(illuminating)], time_s=paths.time_s[illuminating])
    # A constant phase turns the point and moves it nowhere.
    phase, mean = phase_rad[illuminating], float(phase_rad[illuminating].mean())
    effect = replace(part.of_offset(paths.wavelength_m / (2 * np.pi) * (mean - phase)), phase_rad=abs(mean))
    turn = float(np.ptp(phase))
    return BudgetLine("antenna", f"weighed by the beams stated, whose phase turns by {turn:.2g} rad over them", effect)


def antenna_flags(lines: Iterable[BudgetLine]) -> Flags:
    """Return the flag `antenna_phase` where the phase of the patterns costs more than `UNDETECTABLE_LOSS_DB`."""
    flags = Flags()
    for line in lines:
        if line.cause == "antenna" and line.effect.loss_db < -UNDETECTABLE_LOSS_DB:
            lost, off = f"{-line.effect.loss_db:.1f} dB", f"{100 * line.effect.shift_m:.2g} cm"
            flags["antenna_phase"] = f"a point loses {lost} and lies {off} off: {line.stated}"
    return flags


def offset_line(
    paths: PointPaths, cause: str, slope: NDArray[np.float64], std: float | None, *, unit: str, common: bool = False
) -> BudgetLine:
    """Return the effect of a constant error.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    cause
        Its name.
    slope
        (pulse,) float64, metres of path per unit of the cause.
    std
        Its standard deviation in that unit; None: unstated.
    unit
        Name of the unit.
    common
        As `PointPaths.of_offset`.
    """
    effect = paths.of_offset(slope * (1.0 if std is None else std), common=common)
    effect = replace(effect, loss_std_db=math.sqrt(2) * -effect.loss_db)  # of the square of one Gaussian number
    return BudgetLine(cause, None if std is None else f"{std:.3g} {unit}", effect, f"1 {unit}")


def arithmetic_line(error_db: float) -> BudgetLine:
    """Return the loss by the measured numerical error."""
    return BudgetLine(
        "arithmetic", f"{error_db:.1f} dB measured", Effect(10 * np.log10(1 - 10 ** (error_db / 10)), 0, 0)
    )


def height_line(paths: PointPaths, std_m: float | None, *, expected_db: float = 0.0) -> BudgetLine:
    """Return the effect of another height of the ground; where none is stated, of the largest that no image shows.

    Parameters
    ----------
    paths
        Of a point in the middle of the scene.
    std_m
        Standard deviation of heights that somebody stated, metres; None: nobody did.
    expected_db
        Loss by other causes, 0 or less: of so much a height may be the reason instead, and nobody sees it.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 2a. What is assumed moves points and costs nothing: more would show in the image.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> along = np.linspace(-5, 5, 101)
    >>> track = np.stack([along, np.full(101, -10.0), np.full(101, 10.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along, np.zeros(3), np.eye(3), 0.2)
    >>> print(height_line(paths, None).report["stated"])
    not stated; assumed 3 m: along this track no image shows it
    """
    slope = -paths.gradient[:, 2]
    if std_m is not None:
        return offset_line(paths, "heights", slope, std_m, unit="m", common=True)
    lost_db = -paths.of_offset(_SMALL_M * slope, common=True).loss_db / _SMALL_M**2  # per square metre
    undetectable_db = UNDETECTABLE_LOSS_DB - expected_db
    shown_m = math.sqrt(undetectable_db / max(lost_db, 1e-9))
    taken_m, why = GROUND_STD_M, "along this track no image shows it"
    if shown_m < taken_m:
        taken_m, why = shown_m, f"more costs {undetectable_db:.2g} dB, which images show"
    moved = replace(paths.of_offset(taken_m * slope, common=True), loss_db=0.0, loss_std_db=0.0)
    return BudgetLine("heights", None, moved, assumed=f"{taken_m:.2g} m: {why}")


def summed(effects: Iterable[Effect]) -> Effect:
    """Return the sum of independent effects: losses add in dB, shifts and phases by their squares.

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
    """Return the expected effect of all causes together that are stated, measured or assumed."""
    return summed(line.effect for line in lines if line.counts)


def noise_loss(variance_rad2: float) -> Effect:
    """Return the effect of phase noise that is independent from pulse to pulse: exp(-σ²) of the peak's power."""
    return Effect(-10 * math.log10(math.e) * variance_rad2, 0.0, 0.0)


def strictest_accuracy_db(requested: float | Literal["auto"]) -> float:
    """Return the smallest numerical error that an image may request, for which the echo is formed.

    Examples
    --------
    >>> strictest_accuracy_db("auto"), strictest_accuracy_db(-45.0)
    (-60.0, -45.0)
    """
    return MOST_ACCURACY_DB if requested == "auto" else requested


def accuracy_for(lines: Iterable[BudgetLine]) -> float:
    """Return the numerical error to request: below the largest other error by `ARITHMETIC_BELOW_DB`.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 5: the power that a peak loses is spread around it.

    Examples
    --------
    >>> accuracy_for([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))])
    -50.4
    """
    largest = max((1 - 10 ** (line.effect.loss_db / 10) for line in lines if line.stated is not None), default=0.0)
    level = 10 * np.log10(max(largest, 1e-12)) - ARITHMETIC_BELOW_DB
    return round(float(np.clip(level, MOST_ACCURACY_DB, LEAST_ACCURACY_DB)), 1)
