"""Verdicts on the requirements of a plan, causes of shortfalls, single changes that help, and search for tracks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from apertura.campaign.config import OfdmWaveform
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.quality.budget import RECEIVER_STD_M
from apertura.formats.export.layers import LAYOVER, OUTSIDE, SHADOW
from apertura.methods.autofocus.expected import LEAST_POINTS, LEAST_SNR_DB
from apertura.tools.design.expected_images import Design, designed
from apertura.tools.design.flight_plan import BesideTrack, FlightPlan, LineTrack
from apertura.tools.design.layers import PlannedImage

SHARE = 95.0
"""Percentage of the visible pixels that must meet a requirement; image quality is lower at the edges of a scene."""

COARSE_PX = 64
"""Number of pixels along the longer side of the grid on which changes are compared.

The centres of the outermost pixels are 1 % of the side length away from the edges.
"""

_LAYERS = {
    "resolution_m": ("resolution", "most"),
    "nesz_db": ("nesz", "most"),
    "snr_db": ("snr", "least"),
    "point_snr_db": ("point_snr", "least"),
    "loss_db": ("loss", "most"),
    "ambiguity": ("ambiguity", "most"),
}
"""Requirement → layer, and "most" for an upper or "least" for a lower limit of its values."""

LEAST_GAIN_DB = 0.05
"""Minimum gain of a listed change, dB, or the whole shortfall if that is smaller; smaller gains are printed as 0."""

_LEAST = {"snr_db", "point_snr_db", "coverage", "coherence"}
_IN_DB = {"nesz_db", "snr_db", "point_snr_db", "loss_db"}


@dataclass(frozen=True)
class Verdict:
    """Comparison of a requirement with the predicted value.

    Attributes
    ----------
    requirement
        A key of `require`.
    required, found
        Required and predicted value, in the unit of the requirement; `found` is NaN if not determined by the plan.
    image
        Name of the worst image.
    cause
        Largest contribution to the value.
    """

    requirement: str
    required: float | None
    found: float
    image: str
    cause: str

    @property
    def short_db(self) -> float:
        """Shortfall, dB; negative: margin."""
        if self.required is None:
            return -np.inf
        if not np.isfinite(self.found):
            return 100.0
        sign = -1 if self.requirement in _LEAST else 1
        if self.requirement in _IN_DB:
            return sign * (self.found - self.required)
        return sign * decibels(max(self.found, 1e-9) / self.required)

    @property
    def met(self) -> bool:
        """True if the requirement is met."""
        return self.short_db <= 0

    @property
    def report(self) -> dict[str, Any]:
        """JSON values of the verdict."""
        found = float(f"{self.found:.4g}") if np.isfinite(self.found) else None
        values = {"requirement": self.requirement, "required": self.required, "found": found, "met": self.met}
        return values | {"image": self.image, "cause": self.cause}


def judge(design: Design, *, every: bool = False) -> list[Verdict]:
    """Return the verdict for the worst image on each requirement of the plan; `every`: on each possible requirement."""
    predictions = [*_of_images(design)]
    for name, layers in design.interferograms.items():
        values = layers["coherence"][np.isfinite(layers["coherence"])]
        value = float(np.percentile(values, 100 - SHARE)) if values.size else float("nan")
        first, second = design.opened.campaign.settings.interferometry.pairs[name]
        cause = f"common spectrum of {first} and {second}, and noise of both"
        predictions.append(("coherence", value, name, cause))
    recording = design.recording
    flight, duration_s = max(recording.flight_s.items(), key=lambda item: item[1])
    transfer = ", plus take-off, transit and landing" if recording.transfer_s[flight] else ""
    predictions.append(("flight_s", duration_s, flight, f"length of the tracks divided by speed{transfer}"))
    pulses = f"{sum(recording.pulses.values())} pulses of all flights, recorded by each node"
    predictions.append(("recorded_gb", recording.recorded_bytes / 1e9, "all", pulses))
    required = design.opened.plan.require
    verdicts = []
    for name in type(required).model_fields:
        limit, predicted = getattr(required, name), [entry for entry in predictions if entry[0] == name]
        if predicted and (every or limit is not None):
            worst = (min if name in _LEAST else max)(predicted, key=lambda entry: (np.isnan(entry[1]), entry[1]))
            verdicts.append(Verdict(name, limit, *worst[1:]))
        elif limit is not None:
            verdicts.append(Verdict(name, limit, float("nan"), "none", "not determined by the plan"))
    return verdicts


def report_of(design: Design) -> dict[str, Any]:
    """Return the results of a design as JSON values."""
    return {
        "judgement": [verdict.report for verdict in judge(design)],
        "recording": asdict(design.recording),
        "refinement": {
            flight: {"decision": f"{planned.decision.value}: {planned.decision.reason}", "applied": planned.applied}
            | {"expected": refinement_line(design, flight)}
            for flight, planned in design.refinements.items()
        },
        "budget": {name: [line.report for line in image.budget] for name, image in design.images.items()},
        "flags": {name: dict(image.flags) for name, image in design.images.items()},
        "doppler_hz": {name: image.doppler_hz for name, image in design.images.items() if image.looks is not None},
    }


def _of_images(design: Design) -> Iterator[tuple[str, float, str, str]]:
    """Yield requirement, value, image and largest contribution of the images."""
    for image in design.judged:
        visible = image.layers["mask"] == 0
        applied = design.refinements[image.name.split("/")[0]].applied
        for name, (logged, side) in _LAYERS.items():
            layer = "loss_refined" if logged == "loss" and applied else logged
            if layer in image.layers:
                values = image.layers[layer][visible]
                values = values[~np.isnan(values)]
                percentile = SHARE if side == "most" else 100 - SHARE
                value = float(np.percentile(values, percentile, method="nearest")) if values.size else float("nan")
                yield name, value, image.name, _cause(name, design, image, visible, value)
        yield "coverage", float(visible.mean()), image.name, _coverage_cause(image)


def _cause(name: str, design: Design, image: PlannedImage, visible: np.ndarray, value: float) -> str:
    if not visible.any() or not np.isfinite(value):
        return (
            "no pixel is visible"
            if not visible.any()
            else "transmit power, antenna gains, the receiver or its noise figure is not configured"
        )
    if name == "resolution_m":
        return _resolution_cause(image)
    if name == "loss_db":
        flight = image.name.split("/")[0]
        pairs = [pair for pair in design.images.values() if pair.budget and pair.name.startswith(flight)]
        lines = [line for pair in pairs for line in pair.budget if line.counts]
        worst = min(lines, key=lambda line: line.effect.loss_db)
        return f"{worst.cause}: {worst.stated or worst.assumed}"
    if name == "ambiguity":
        spread_hz = max(pair.doppler_hz for pair in design.images.values() if pair.looks is not None)
        return f"Doppler spread of {spread_hz:.0f} Hz over the scene, from speed, range and beams"
    looks = float(np.median(image.layers["looks"][visible]))
    return f"noise with {looks:.0f} integrated pulses, from transmit power, antenna gains and range"


def refinement_line(design: Design, flight: str) -> str:
    """Return the decision on the refinement of a flight's tracks, and the bright points required for the refinement."""
    refinement = design.refinements[flight]
    if refinement.obstacles:
        return f"refinement is not expected to succeed: {', '.join(refinement.obstacles)}"
    needs = f"requires {LEAST_POINTS} bright points in the scene, {_least_point(design, flight)}"
    if refinement.applied:
        return f"tracks refined; the refinement {needs}"
    return f"tracks as logged; refinement (processing.autofocus: on) {needs}"


def _least_point(design: Design, flight: str) -> str:
    """Return the minimum SNR of a point for a refinement, and if known the cross-section sufficient for all pairs."""
    minimum = f"{LEAST_SNR_DB:g} dB above the noise of one pulse"
    rcs_dbsm, excess_db = design.opened.plan.expect.rcs_dbsm, list[float]()
    for image in design.images.values():
        if image.looks is not None and image.name.startswith(f"{flight}/") and "point_snr" in image.layers:
            visible = image.layers["mask"] == 0
            pulse_db = (image.layers["point_snr"] - 10 * np.log10(np.maximum(image.layers["looks"], 1)))[visible]
            pulse_db = pulse_db[np.isfinite(pulse_db)]
            excess_db.append(float(np.percentile(pulse_db, 100 - SHARE)) if pulse_db.size else np.nan)
    if rcs_dbsm is None or not excess_db or not np.isfinite(excess_db).all():
        return minimum
    return f"{minimum}: at least {rcs_dbsm + LEAST_SNR_DB - min(excess_db):.0f} dBsm"


def _resolution_cause(image: PlannedImage) -> str:
    """Return the cause of the coarsest resolution at the scene centre: bandwidth or aperture."""
    shape = image.layers["mask"].shape
    pixel = tuple(slice(size // 2, size // 2 + 1) for size in shape)
    _, _, fine_deg = image.resolution.axes((pixel[0], pixel[1]))
    ahead = image.resolution.look_azimuth_deg((pixel[0], pixel[1]))
    across_deg = abs((float(fine_deg[0, 0]) - float(ahead[0, 0]) + 90) % 180 - 90)
    if across_deg > 45:  # the finest direction is perpendicular to the line of sight
        return "ground range: bandwidth and incidence angle"
    return "cross-range: wavelength and angle subtended by the aperture"


def _coverage_cause(image: PlannedImage) -> str:
    mask = image.layers["mask"]
    late = image.layers["path_margin"] < 0
    shares = {
        "beyond the end of the prefix or of the recording": late.mean(),
        "outside the beams": ((mask == OUTSIDE) & ~late).mean(),
        "in shadow": ((mask != OUTSIDE) & (mask & SHADOW > 0)).mean(),
        "in layover": ((mask != OUTSIDE) & (mask & LAYOVER > 0)).mean(),
    }
    worst = max(shares, key=lambda name: shares[name])
    return f"{100 * shares[worst]:.1f} % {worst}" if shares[worst] > 0 else "all pixels are visible"


# ---- Helpful changes ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """A single change of a plan, with its effect on the requirements.

    Attributes
    ----------
    words
        Description of the change.
    gain_db
        Reduction of the total shortfall, dB.
    meets
        True if all requirements are met with the change.
    found
        Requirement → predicted value with the change.
    breaks
        Requirements that are met only without the change.
    """

    words: str
    gain_db: float
    meets: bool
    found: Mapping[str, float]
    breaks: tuple[str, ...] = ()


def shortfall_db(verdicts: Sequence[Verdict]) -> float:
    """Return the total shortfall of all requirements, dB."""
    return sum(max(0.0, verdict.short_db) for verdict in verdicts)


def helpful_changes(plan: FlightPlan, root: Path, before: Sequence[Verdict], *, threads: int = 1) -> list[Change]:
    """Return single changes that reduce the shortfall, sorted by number of requirements no longer met, then by gain.

    Parameters
    ----------
    plan, root
        As in `designed`.
    before
        Verdicts of the unchanged plan on the full grid. Changes are evaluated on a coarser grid, and the values are
        corrected by the difference between the two grids for the unchanged plan.
    threads
        Number of tiles computed in parallel.
    """
    missed_db, met, changes = shortfall_db(before), {verdict.requirement for verdict in before if verdict.met}, []
    if not missed_db:
        return []
    unchanged = judge(designed(plan, root, threads=threads, coarse=COARSE_PX))
    coarse = {verdict.requirement: verdict.found for verdict in unchanged}
    correction = {verdict.requirement: verdict.found - coarse.get(verdict.requirement, np.nan) for verdict in before}
    for words, change in _candidates(plan):
        try:
            after = judge(designed(change(plan), root, threads=threads, coarse=COARSE_PX))
        except (CampaignError, ValueError):  # the changed plan is impossible
            continue
        after = [
            replace(verdict, found=verdict.found + np.nan_to_num(correction.get(verdict.requirement, 0.0)))
            for verdict in after
        ]
        gain = missed_db - shortfall_db(after)
        if gain >= min(LEAST_GAIN_DB, missed_db):
            values = {verdict.requirement: verdict.found for verdict in after}
            breaks = tuple(verdict.requirement for verdict in after if verdict.requirement in met and not verdict.met)
            changes.append(Change(words, gain, all(verdict.met for verdict in after), values, breaks))
    return sorted(changes, key=lambda change: (len(change.breaks), -change.gain_db))


_Changing = Callable[[FlightPlan], FlightPlan]


def _candidates(plan: FlightPlan) -> Iterator[tuple[str, _Changing]]:
    has_several_nodes = any(len(flight.participants) > 1 for flight in plan.flights.values())
    lines = any(isinstance(track, LineTrack) for flight in plan.flights.values() for track in flight.tracks.values())
    for factor in (0.5, 0.75, 1.5):
        change = partial(_scaled_speed, factor=factor)
        yield f"fly at {factor:g} times the speed (speed_m_s)", partial(_tracks, change=change)
    for height_m in (-10.0, 10.0, 20.0):
        direction = "higher" if height_m > 0 else "lower"
        new_m = plan.moved.height_m + height_m
        yield f"fly {abs(height_m):g} m {direction} (moved.height_m: {new_m:g})", partial(moved, height_m=height_m)
    for offset_m in (-10.0, 10.0, 20.0):
        direction = "farther from" if offset_m > 0 else "nearer to"
        new_m = plan.moved.offset_m + offset_m
        yield (
            f"fly {abs(offset_m):g} m {direction} the scene (moved.offset_m: {new_m:g})",
            partial(moved, offset_m=offset_m),
        )
    for factor in (0.5, 2.0) if has_several_nodes else ():
        yield (
            f"multiply the node separations by {factor:g} (moved.spacing)",
            partial(moved, spacing=plan.moved.spacing * factor),
        )
    if lines:
        change = partial(_lengthened, factor=1.5)
        yield "extend the lines to 1.5 times their length (start_m, end_m)", partial(_tracks, change=change)
    prf_hz = getattr(plan.waveform, "prf_hz", None)
    if prf_hz:
        yield "double the pulse rate (waveform.prf_hz)", partial(_radar, prf_hz=2 * prf_hz)
    if isinstance(plan.waveform, OfdmWaveform):
        yield "double the bandwidth (waveform.subcarriers)", partial(_radar, subcarriers=2 * plan.waveform.subcarriers)
    if plan.processing.autofocus != "on":
        yield "refine the tracks from the images (processing.autofocus: on)", _with_autofocus
    yield "increase the transmit power by 3 dB (transmit_power_dbm)", _with_more_power
    yield "halve the position errors (position_std_m)", _with_halved_position_errors


def moved(plan: FlightPlan, **changes: float) -> FlightPlan:
    """Return a plan with displaced tracks: increments of height_m, offset_m and heading_deg, new value of spacing."""
    values = plan.moved.model_dump()
    values = {key: changes[key] if key == "spacing" else values[key] + changes[key] for key in changes}
    return plan.model_copy(update={"moved": plan.moved.model_copy(update=values)})


def _scaled_speed(track: Any, factor: float) -> dict[str, Any]:
    return {"speed_m_s": factor * track.speed_m_s} if getattr(track, "speed_m_s", None) else {}


def _lengthened(track: Any, factor: float) -> dict[str, Any]:
    if not isinstance(track, LineTrack):
        return {}
    ends = np.array([track.start_m, track.end_m])
    start, end = ends.mean(axis=0) + factor * (ends - ends.mean(axis=0))
    return {"start_m": tuple(start.tolist()), "end_m": tuple(end.tolist())}


def _tracks(plan: FlightPlan, change: Callable[[Any], dict[str, Any]]) -> FlightPlan:
    flights = {
        name: flight.model_copy(
            update={
                "tracks": {
                    node: track if isinstance(track, BesideTrack) else track.model_copy(update=change(track))
                    for node, track in flight.tracks.items()
                }
            }
        )
        for name, flight in plan.flights.items()
    }
    return plan.model_copy(update={"flights": flights})


def _radar(plan: FlightPlan, **changes: Any) -> FlightPlan:
    waveform = type(plan.waveform).model_validate(plan.waveform.model_dump() | changes)
    return plan.model_copy(update={"waveform": waveform})


def _with_autofocus(plan: FlightPlan) -> FlightPlan:
    return plan.model_copy(update={"processing": plan.processing.model_copy(update={"autofocus": "on"})})


def _with_more_power(plan: FlightPlan) -> FlightPlan:
    nodes = {
        name: node
        if node.transmit_power_dbm is None
        else node.model_copy(update={"transmit_power_dbm": node.transmit_power_dbm + 3})
        for name, node in plan.nodes.items()
    }
    return plan.model_copy(update={"nodes": nodes})


def _with_halved_position_errors(plan: FlightPlan) -> FlightPlan:
    solutions = {node: flight.solution for flight in plan.flights.values() for node in flight.participants}
    nodes = {}
    for name, node in plan.nodes.items():
        stated = node.position_std_m or RECEIVER_STD_M[solutions.get(name, "fix")]
        half = tuple(std_m / 2 for std_m in stated) if isinstance(stated, tuple) else stated / 2
        nodes[name] = node.model_copy(update={"position_std_m": half})
    return plan.model_copy(update={"nodes": nodes})


# ---- Search within bounds -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tried:
    """Plan evaluated by a search.

    Attributes
    ----------
    moved
        Key of `moved` → value.
    verdicts
        Verdicts on all possible requirements.
    objective
        Minimised value, dB: ten times the total shortfall, plus the largest shortfall (or smallest margin, negative),
        plus a hundredth of the mean shortfall, so that the minimum is Pareto-optimal.
    on_front
        True if the plan is Pareto-optimal among the plans tried.
    """

    moved: Mapping[str, float]
    verdicts: tuple[Verdict, ...]
    objective: float
    on_front: bool = False


AXES = {"height": "height_m", "offset": "offset_m", "spacing": "spacing", "heading": "heading_deg"}
"""Argument of `--optimise` → key of `moved`."""

IMPOSSIBLE_DB = 1000.0
"""Objective of an invalid plan."""


def search(
    plan: FlightPlan, root: Path, words: Sequence[str], *, most: int = 150, threads: int = 1
) -> tuple[FlightPlan, list[Tried]]:
    """Search for the best track displacement within the plan's bounds; return the best plan and all plans tried.

    Parameters
    ----------
    plan, root
        As in `designed`.
    words
        Keys of `AXES`.
    most
        Approximate maximum number of plans to try.
    threads
        Number of tiles computed in parallel.

    Raises
    ------
    CampaignError
        If a word is unknown, the plan has no requirement, or none of the plans is valid.

    Notes
    -----
    Source: DIRECT (D. R. Jones, C. D. Perttunen, B. E. Stuckman, J. Optim. Theory Appl. 79, 1993), which is
    deterministic.
    """
    from scipy.optimize import direct

    unknown = [word for word in words if word not in AXES]
    if unknown or not words:
        found = ",".join(words) or "an empty list"
        raise CampaignError(found, "--optimise", f"one or more of {','.join(AXES)}", "Correct the list.")
    if not plan.require.model_fields_set:
        raise CampaignError("no requirement", "the plan: require", "at least one requirement", "Add requirements.")
    keys, tried = [AXES[word] for word in words], list[Tried]()

    def objective(point: np.ndarray) -> float:
        values = {key: round(float(value), 3) for key, value in zip(keys, point, strict=True)}
        displaced = plan.model_copy(update={"moved": plan.moved.model_copy(update=values)})
        try:
            verdicts = judge(designed(displaced, root, threads=threads, coarse=COARSE_PX), every=True)
        except CampaignError:
            return IMPOSSIBLE_DB
        required = [verdict for verdict in verdicts if verdict.required is not None]
        short = [verdict.short_db for verdict in required]
        missed = 10 * shortfall_db(required) + max(short) + 0.01 * float(np.mean(short))
        tried.append(Tried(values, tuple(verdicts), missed))
        return missed

    limits = [getattr(plan.bounds, key) for key in keys]
    direct(objective, limits, maxfun=most, locally_biased=True, len_tol=1e-2, vol_tol=0.0)
    if not tried:
        raise CampaignError(
            "no valid plan within the bounds", "the plan: bounds", "at least one valid plan", "Widen the bounds."
        )
    best = min(tried, key=lambda trial: trial.objective)
    best_plan = plan.model_copy(update={"moved": plan.moved.model_copy(update=dict(best.moved))})
    return best_plan, with_front(tried)


def tried_report(tried: Sequence[Tried]) -> list[dict[str, Any]]:
    """Return the Pareto-optimal plans as JSON values, the best plan first: displacement and predicted values."""
    front = sorted((trial for trial in tried if trial.on_front), key=lambda trial: trial.objective)
    return [
        {"moved": dict(trial.moved), "found": {v.requirement: v.report["found"] for v in trial.verdicts}}
        for trial in front
    ]


def with_front(tried: Sequence[Tried]) -> list[Tried]:
    """Mark the Pareto-optimal plans: no other plan is at least as good in all requirements and better in one."""
    short = np.array([[v.short_db for v in trial.verdicts if v.required is not None] for trial in tried])
    front = [not ((short <= row).all(axis=1) & (short < row).any(axis=1)).any() for row in short]
    return [replace(trial, on_front=is_optimal) for trial, is_optimal in zip(tried, front, strict=True)]
