"""Verdicts on the requirements of a plan: the dominant cause of a shortfall, and the most helpful change."""

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
"""Per cent of the pixels seen that must have what is required: edges of a scene are worse than what is flown for."""

COARSE_PX = 64
"""Pixels along the longer side of the grid on which changes are compared: its outermost lie 1 % of the side inside."""

_LAYERS = {
    "resolution_m": ("resolution", "most"),
    "nesz_db": ("nesz", "most"),
    "snr_db": ("snr", "least"),
    "point_snr_db": ("point_snr", "least"),
    "loss_db": ("loss", "most"),
    "ambiguity": ("ambiguity", "most"),
}
"""Requirement → layer, and whether the requirement is the most or the least of it."""

LEAST_GAIN_DB = 0.05
"""Least gain of a listed change that does not reduce every shortfall: a smaller one is printed as nothing."""

_LEAST = {"snr_db", "point_snr_db", "coverage", "coherence"}
_IN_DB = {"nesz_db", "snr_db", "point_snr_db", "loss_db"}


@dataclass(frozen=True)
class Verdict:
    """A requirement against what the plan gives.

    Attributes
    ----------
    requirement
        A key of `require`.
    required, found
        In its unit; found is NaN where the plan does not determine it.
    image
        Which is the worst.
    cause
        What it comes from first, in a few words.
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
        """True if it is met."""
        return self.short_db <= 0

    @property
    def report(self) -> dict[str, Any]:
        """JSON values of the verdict."""
        found = float(f"{self.found:.4g}") if np.isfinite(self.found) else None
        named = {"requirement": self.requirement, "asked": self.required, "found": found, "met": self.met}
        return named | {"image": self.image, "cause": self.cause}


def judge(design: Design, *, every: bool = False) -> list[Verdict]:
    """Return a verdict on each requirement that the plan states, worst image first; `every`: on all there are."""
    found = [*_of_images(design)]
    for name, layers in design.interferograms.items():
        values = layers["coherence"][np.isfinite(layers["coherence"])]
        value = float(np.percentile(values, 100 - SHARE)) if values.size else float("nan")
        first, second = design.opened.campaign.settings.interferometry.pairs[name]
        cause = f"spectra that {first} and {second} have in common, and their noise"
        found.append(("coherence", value, name, cause))
    recording = design.recording
    flight, duration_s = max(recording.flight_s.items(), key=lambda item: item[1])
    before = " with take-off, transit and landing" if recording.transfer_s[flight] else ""
    found.append(("flight_s", duration_s, flight, f"length of the tracks over their speed{before}"))
    pulses = f"{sum(recording.pulses.values())} pulses of all flights, by each node"
    found.append(("recorded_gb", recording.recorded_bytes / 1e9, "all", pulses))
    required = design.opened.plan.require
    verdicts = []
    for name in type(required).model_fields:
        limit, some = getattr(required, name), [one for one in found if one[0] == name]
        if some and (every or limit is not None):
            worst = (min if name in _LEAST else max)(some, key=lambda one: (np.isnan(one[1]), one[1]))
            verdicts.append(Verdict(name, limit, *worst[1:]))
        elif limit is not None:
            verdicts.append(Verdict(name, limit, float("nan"), "none", "nothing of the plan says it"))
    return verdicts


def report_of(design: Design) -> dict[str, Any]:
    """Return the values of a design, as JSON values."""
    return {
        "judgement": [verdict.report for verdict in judge(design)],
        "recording": asdict(design.recording),
        "refinement": {
            flight: {"decision": f"{one.decision.value}: {one.decision.reason}", "applied": one.applied}
            | {"expected": refinement_line(design, flight)}
            for flight, one in design.refinements.items()
        },
        "budget": {name: [line.report for line in image.budget] for name, image in design.images.items()},
        "flags": {name: dict(image.flags) for name, image in design.images.items()},
        "doppler_hz": {name: image.doppler_hz for name, image in design.images.items() if image.looks is not None},
    }


def _of_images(design: Design) -> Iterator[tuple[str, float, str, str]]:
    """Yield requirement, value, image and largest contribution of the images."""
    for image in design.judged:
        seen = image.layers["mask"] == 0
        applied = design.refinements[image.name.split("/")[0]].applied
        for name, (logged, side) in _LAYERS.items():
            layer = "loss_refined" if logged == "loss" and applied else logged
            if layer in image.layers:
                values = image.layers[layer][seen]
                values = values[~np.isnan(values)]
                at = SHARE if side == "most" else 100 - SHARE
                value = float(np.percentile(values, at, method="nearest")) if values.size else float("nan")
                yield name, value, image.name, _cause(name, design, image, seen, value)
        yield "coverage", float(seen.mean()), image.name, _coverage_cause(image)


def _cause(name: str, design: Design, image: PlannedImage, seen: np.ndarray, value: float) -> str:
    if not seen.any() or not np.isfinite(value):
        return "nothing is seen" if not seen.any() else "power, gains, receiver or its noise figure are not stated"
    if name == "resolution_m":
        return _resolution_cause(image)
    if name == "loss_db":
        pairs = [one for one in design.images.values() if one.budget and one.name.startswith(image.name.split("/")[0])]
        lines = [line for one in pairs for line in one.budget if line.counts]
        worst = min(lines, key=lambda line: line.effect.loss_db)
        return f"{worst.cause}: {worst.stated or worst.assumed}"
    if name == "ambiguity":
        spread_hz = max(one.doppler_hz for one in design.images.values() if one.looks is not None)
        return f"Doppler spreads {spread_hz:.0f} Hz over the scene, by speed, range and beams"
    looks = float(np.median(image.layers["looks"][seen]))
    return f"noise of {looks:.0f} pulses at the far side, by power, gains and range"


def refinement_line(design: Design, flight: str) -> str:
    """Return the decision on refinement of the tracks of a flight, and the points that it needs in the scene."""
    refinement = design.refinements[flight]
    if refinement.obstacles:
        return f"refinement is not expected to succeed: {', '.join(refinement.obstacles)}"
    what = "tracks refined" if refinement.applied else "tracks as logged; processing.autofocus: on refines them"
    return f"{what}, which needs {LEAST_POINTS} bright points in the scene, {_least_point(design, flight)}"


def _least_point(design: Design, flight: str) -> str:
    """Return the cross-section from which a point is bright enough for a refinement, in all pairs of a flight."""
    each = f"{LEAST_SNR_DB:g} dB above the noise of one pulse"
    rcs_dbsm, excess_db = design.opened.plan.expect.rcs_dbsm, list[float]()
    for image in design.images.values():
        if image.looks is not None and image.name.startswith(f"{flight}/") and "point_snr" in image.layers:
            seen = image.layers["mask"] == 0
            pulse_db = (image.layers["point_snr"] - 10 * np.log10(np.maximum(image.layers["looks"], 1)))[seen]
            pulse_db = pulse_db[np.isfinite(pulse_db)]
            excess_db.append(float(np.percentile(pulse_db, 100 - SHARE)) if pulse_db.size else np.nan)
    if rcs_dbsm is None or not excess_db or not np.isfinite(excess_db).all():
        return each
    return f"{each}: at least {rcs_dbsm + LEAST_SNR_DB - min(excess_db):.0f} dBsm"


def _resolution_cause(image: PlannedImage) -> str:
    """Return the cause of the coarsest resolution in the middle of the scene: the band or the aperture."""
    shape = image.layers["mask"].shape
    pixel = tuple(slice(size // 2, size // 2 + 1) for size in shape)
    _, _, fine_deg = image.resolution.axes((pixel[0], pixel[1]))
    ahead = image.resolution.look_azimuth_deg((pixel[0], pixel[1]))
    across_deg = abs((float(fine_deg[0, 0]) - float(ahead[0, 0]) + 90) % 180 - 90)
    if across_deg > 45:  # the finest direction is across the line of sight
        return "range: bandwidth over the sine of incidence"
    return "cross-range: wavelength over the angle that the aperture turns about the scene"


def _coverage_cause(image: PlannedImage) -> str:
    mask = image.layers["mask"]
    late = image.layers["path_margin"] < 0
    shares = {
        "beyond the prefix or the listening time": late.mean(),
        "outside the beams": ((mask == OUTSIDE) & ~late).mean(),
        "in shadow": ((mask != OUTSIDE) & (mask & SHADOW > 0)).mean(),
        "in layover": ((mask != OUTSIDE) & (mask & LAYOVER > 0)).mean(),
    }
    worst = max(shares, key=lambda name: shares[name])
    return f"{100 * shares[worst]:.1f} % {worst}" if shares[worst] > 0 else "all of it is seen"


# ---- Changes that help ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One change of a plan, and what it brings.

    Attributes
    ----------
    words
        What to do.
    gain_db
        By how much less the requirements are missed, all together, dB.
    meets
        Whether all are then met.
    found
        Requirement → what the plan then gives.
    breaks
        Requirements that are met before it, and not with it.
    """

    words: str
    gain_db: float
    meets: bool
    found: Mapping[str, float]
    breaks: tuple[str, ...] = ()


def shortfall_db(verdicts: Sequence[Verdict]) -> float:
    """Return by how much requirements are missed, all together, dB."""
    return sum(max(0.0, one.short_db) for one in verdicts)


def helpful_changes(plan: FlightPlan, root: Path, before: Sequence[Verdict], *, threads: int = 1) -> list[Change]:
    """Return single changes that bring a plan nearer to what is required: first those that break nothing, by gain.

    Parameters
    ----------
    plan, root
        As `designed`.
    before
        Verdicts on the grid itself. Changes are compared on a coarser one, and what that says of the plan as it is in
        another way than these is taken off.
    threads
        Tiles computed at once.
    """
    missed_db, kept, found = shortfall_db(before), {one.requirement for one in before if one.met}, []
    if not missed_db:
        return []
    coarse = {one.requirement: one.found for one in judge(designed(plan, root, threads=threads, coarse=COARSE_PX))}
    off = {one.requirement: one.found - coarse.get(one.requirement, np.nan) for one in before}
    for words, change in _candidates(plan):
        try:
            after = judge(designed(change(plan), root, threads=threads, coarse=COARSE_PX))
        except (CampaignError, ValueError):  # the changed plan is impossible
            continue
        after = [replace(one, found=one.found + np.nan_to_num(off.get(one.requirement, 0.0))) for one in after]
        gain = missed_db - shortfall_db(after)
        if gain >= min(LEAST_GAIN_DB, missed_db):
            values = {one.requirement: one.found for one in after}
            breaks = tuple(one.requirement for one in after if one.requirement in kept and not one.met)
            found.append(Change(words, gain, all(one.met for one in after), values, breaks))
    return sorted(found, key=lambda change: (len(change.breaks), -change.gain_db))


_Changing = Callable[[FlightPlan], FlightPlan]


def _candidates(plan: FlightPlan) -> Iterator[tuple[str, _Changing]]:
    several = any(len(flight.participants) > 1 for flight in plan.flights.values())
    lines = any(isinstance(track, LineTrack) for flight in plan.flights.values() for track in flight.tracks.values())
    for factor in (0.5, 0.75, 1.5):
        change = partial(_scaled_speed, factor=factor)
        yield f"fly at {factor:g} times the speed (speed_m_s)", partial(_tracks, change=change)
    for height_m in (-10.0, 10.0, 20.0):
        direction = "higher" if height_m > 0 else "lower"
        now_m = plan.moved.height_m + height_m
        yield f"fly {abs(height_m):g} m {direction} (moved.height_m: {now_m:g})", partial(moved, height_m=height_m)
    for offset_m in (-10.0, 10.0, 20.0):
        direction = "farther from" if offset_m > 0 else "nearer to"
        now_m = plan.moved.offset_m + offset_m
        yield (
            f"fly {abs(offset_m):g} m {direction} the scene (moved.offset_m: {now_m:g})",
            partial(moved, offset_m=offset_m),
        )
    for factor in (0.5, 2.0) if several else ():
        yield f"separations times {factor:g} (moved.spacing)", partial(moved, spacing=plan.moved.spacing * factor)
    if lines:
        yield "lines longer by half (start_m, end_m)", partial(_tracks, change=partial(_lengthened, factor=1.5))
    prf_hz = getattr(plan.waveform, "prf_hz", None)
    if prf_hz:
        yield "twice the pulse rate (waveform.prf_hz)", partial(_radar, prf_hz=2 * prf_hz)
    if isinstance(plan.waveform, OfdmWaveform):
        yield "twice the bandwidth (waveform.subcarriers)", partial(_radar, subcarriers=2 * plan.waveform.subcarriers)
    if plan.processing.autofocus != "on":
        yield "refine the tracks by the images (processing.autofocus: on)", _with_autofocus
    yield "3 dB more power (transmit_power_dbm)", _with_more_power
    yield "positions known twice as well (position_std_m)", _with_surer_positions


def moved(plan: FlightPlan, **changes: float) -> FlightPlan:
    """Return a plan whose tracks are moved: height_m, offset_m, heading_deg to be added, spacing as it will be."""
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


def _with_surer_positions(plan: FlightPlan) -> FlightPlan:
    solutions = {node: flight.solution for flight in plan.flights.values() for node in flight.participants}
    nodes = {}
    for name, node in plan.nodes.items():
        stated = node.position_std_m or RECEIVER_STD_M[solutions.get(name, "fix")]
        half = tuple(one / 2 for one in stated) if isinstance(stated, tuple) else stated / 2
        nodes[name] = node.model_copy(update={"position_std_m": half})
    return plan.model_copy(update={"nodes": nodes})


# ---- Search within bounds -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tried:
    """A plan that a search tried.

    Attributes
    ----------
    moved
        Key of `moved` → value.
    verdicts
        On every requirement there is.
    objective
        What is minimised, dB: what is missed, tenfold, the scarcest margin, and a hundredth of the mean of margins: of
        plans alike in the others none is taken that another beats.
    on_front
        Whether none that was tried is better in one requirement and as good in the others.
    """

    moved: Mapping[str, float]
    verdicts: tuple[Verdict, ...]
    objective: float
    on_front: bool = False


AXES = {"height": "height_m", "offset": "offset_m", "spacing": "spacing", "heading": "heading_deg"}
"""Word of `--optimise` → key of `moved`."""

IMPOSSIBLE_DB = 1000.0
"""Objective of a plan that cannot be flown."""


def search(
    plan: FlightPlan, root: Path, words: Sequence[str], *, most: int = 150, threads: int = 1
) -> tuple[FlightPlan, list[Tried]]:
    """Return the best plan found by moving tracks within the plan's bounds, and all that were tried; deterministic.

    Parameters
    ----------
    plan, root
        As `designed`.
    words
        Of `AXES`.
    most
        Plans tried, about.
    threads
        Tiles computed at once.

    Raises
    ------
    CampaignError
        If a word is unknown, no requirement is stated, or none of the plans can be flown.

    Notes
    -----
    Source: DIRECT (D. R. Jones, C. D. Perttunen, B. E. Stuckman, J. Optim. Theory Appl. 79, 1993), which draws nothing.
    """
    from scipy.optimize import direct

    unknown = [word for word in words if word not in AXES]
    if unknown or not words:
        raise CampaignError(",".join(words) or "nothing", "--optimise", f"some of {','.join(AXES)}", "Correct it.")
    if not plan.require.model_fields_set:
        raise CampaignError("no requirement", "the plan: require", "what the flight must give", "State some of it.")
    keys, tried = [AXES[word] for word in words], list[Tried]()

    def objective(place: np.ndarray) -> float:
        values = {key: round(float(value), 3) for key, value in zip(keys, place, strict=True)}
        one = plan.model_copy(update={"moved": plan.moved.model_copy(update=values)})
        try:
            verdicts = judge(designed(one, root, threads=threads, coarse=COARSE_PX), every=True)
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
            "no plan within the bounds can be flown", "the plan: bounds", "some that can", "Widen them."
        )
    best = min(tried, key=lambda one: one.objective)
    found = plan.model_copy(update={"moved": plan.moved.model_copy(update=dict(best.moved))})
    return found, with_front(tried)


def tried_report(tried: Sequence[Tried]) -> list[dict[str, Any]]:
    """Return the plans that no other beats, the one taken first, as JSON values: moves, and what it gives."""
    front = sorted((one for one in tried if one.on_front), key=lambda one: one.objective)
    return [
        {"moved": dict(one.moved), "found": {v.requirement: v.report["found"] for v in one.verdicts}} for one in front
    ]


def with_front(tried: Sequence[Tried]) -> list[Tried]:
    """Mark the Pareto-optimal plans: no other is as good in all requirements and better in some."""
    short = np.array([[v.short_db for v in one.verdicts if v.required is not None] for one in tried])
    front = [not ((short <= own).all(axis=1) & (short < own).any(axis=1)).any() for own in short]
    return [replace(one, on_front=on) for one, on in zip(tried, front, strict=True)]
