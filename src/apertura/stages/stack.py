"""Rules `stack_image` and `stack`: images of several flights, their phases referred to one reference flight."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.config import Stack
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, open_stage, record_files
from apertura.common.arrays import Floats
from apertura.common.atomic import write_json, write_text
from apertura.common.contracts import Window
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance, canonical_json
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.looks import Looks
from apertura.formats.export import write_exports
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.interferometry.coherence import box_sum, chance, map_coherence, unbiased
from apertura.methods.interferometry.heights import least_coherence
from apertura.methods.interferometry.sensitivity import Sensitivity, baseline
from apertura.methods.stack.limits import FlightFit
from apertura.methods.stack.residual_motion import (
    LEAST_WINDOWS,
    ResidualMotion,
    ResidualTracks,
    SeenAntenna,
    WindowPhases,
    estimate_motion,
)
from apertura.stages.agreement import opened_layer
from apertura.stages.image_tags import acquisition_tags
from apertura.stages.interferogram import legs_of, sensed_heights
from apertura.stages.multilook import LazyLayer
from apertura.stages.pair import OpenPair, open_pair
from apertura.stages.planning import gated, integration_of, weighing
from apertura.stages.refine import errors_of, open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import copied_inputs, tags_of
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import STACK

STACK_JSON = "stack.json"
"""Report on a flight of the stack, and on the whole stack."""

BASELINES = "baselines.csv"
"""Table of the flights of the stack."""

_COLUMNS = (
    "flight",
    "used",
    "start_utc",
    "temporal_baseline_days",
    "perpendicular_baseline_m",
    "along_track_offset_m",
    "height_of_ambiguity_m",
    "coherence",
    "expected_coherence",
    "residual_phase_std_rad",
    "reason",
)


_NODES = 1024  # lattice nodes processed at once
_SPREAD_NODES, _DRAWS = 64, 24  # nodes and drawn tracks from which the likely variation over the aperture follows
# largest constant displacement of the search, in standard deviations of the logs, and in metres: beyond the latter,
# resolution cells of both images do not overlap
_SEARCH_SIGMAS, _MOST_RADIUS_M = 3.0, 1.0
_MOST_AMBIGUITY_M = 1e6  # a height of ambiguity above this is not stated


@dataclass(frozen=True, eq=False)
class StackedImage:
    """Image of a flight of the stack, with its geometry.

    Attributes
    ----------
    opened, looks
        Pair with its geometry, and the pulses of each pixel.
    image
        (y, x) complex64.
    visible
        (y, x) bool, False in shadow, in layover and outside the beams.
    noise
        (y, x) float64, noise power of the pixels; NaN where it is unknown.
    stage
        Stage `image`.
    """

    opened: OpenPair
    looks: Looks
    image: NDArray[np.complex64]
    visible: NDArray[np.bool_]
    noise: Floats
    stage: Any

    def looks_in(self, side_m: float) -> float:
        """Return the independent samples in a square window, from the local spectrum at the scene centre.

        The autocorrelation of a large block overestimates them at short range, where the carrier varies over the block.
        """
        spectrum = np.array(self.stage.attrs["quality"]["focus"]["spectrum_cycles2_m2"])
        return float(12 * np.sqrt(max(np.linalg.det(spectrum), 0.0)) * side_m**2)

    def places(self, scene: OpenScene, row: NDArray[Any], column: NDArray[Any]) -> tuple[Floats, list[SeenAntenna]]:
        """Return the positions of pixels on the terrain, and the antennas at the pulses that form them."""
        lattice = self.looks.lattice
        nearest = (np.abs(at[:, None] - px).argmin(axis=0) for at, px in zip(lattice.nodes, (row, column), strict=True))
        pulses = self.looks.pulses[tuple(nearest)].astype(np.int64)
        time_s, legs = (
            self.opened.time_s[pulses],
            zip(self.opened.name.split("-"), self.looks.aperture.legs, strict=True),
        )
        antennas = [SeenAntenna(node, leg[pulses], time_s) for node, leg in legs]
        return scene.terrain.positions_at(scene.grid, row, column), antennas


def open_stacked(campaign: Campaign, flight: str, pair: str, scene: OpenScene) -> StackedImage:
    """Open the image of a flight of the stack."""
    echo = PairEcho.cleaned(campaign, flight, pair).stage
    profile = open_stage(campaign.stage("profile", flight, pair), "profile")
    opened = gated(campaign, open_pair(campaign, flight, pair, echo=echo), scene)
    looks = Looks.of(scene.grid, scene.terrain, aperture_of(profile), weighing(campaign, opened, scene))
    stage = open_stage(campaign.stage("image", flight, pair), "image")
    with opened_layer(campaign, flight, pair, "mask.tif") as raster:
        visible, pulse_noise = raster.read(1) == 0, float(raster.tags()["APERTURA_PULSE_NOISE"])
    # a pixel is Σw·profile over the count of integrated pulses: its noise power is Σw² times that of one pulse
    noise = pulse_noise / integration_of(campaign, opened, scene).count ** 2 * looks.weight_squares(whole_of(scene))
    return StackedImage(opened, looks, stage.image.values, visible, np.asarray(noise, np.float64), stage)


# ---- Phase of a flight referred to the reference --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Referred:
    """Image of a flight without the phase of its residual track.

    Attributes
    ----------
    image
        (y, x) complex64.
    removed_rad, coherence, expected
        (y, x) float32: removed phase; measured and expected coherence with the reference, NaN where not common.
    looks
        Independent samples of a window.
    fit
        Measures of the fit, from which the flags follow.
    track
        Estimated residual track, for stack.json.
    sensed
        Sensitivity of the phase to height; None for the reference.
    """

    image: NDArray[np.complex64]
    removed_rad: NDArray[np.float32]
    coherence: NDArray[np.float32]
    expected: NDArray[np.float32]
    looks: float
    fit: FlightFit
    track: Mapping[str, Any]
    sensed: Sensitivity | None = None

    @classmethod
    def unchanged(cls, image: NDArray[np.complex64], common: NDArray[np.bool_]) -> "Referred":
        """Return the reference itself."""
        one = np.where(common, np.float32(1), np.float32(np.nan))
        fit = FlightFit(0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0)
        return cls(image, np.zeros(image.shape, np.float32), one, one, np.nan, fit, {})


def refer(
    image: StackedImage,
    reference: StackedImage,
    scene: OpenScene,
    errors: Mapping[str, TrackErrors],
    common: NDArray[np.bool_],
    *,
    tiles: Sequence[Window],
    window: int,
) -> Referred:
    """Estimate the residual track between two flights and remove its phase from the image.

    Parameters
    ----------
    image, reference
        Images of a flight and of the reference flight.
    scene
        Scene with grid and terrain.
    errors
        Node → errors of the difference between its logs of both flights.
    common
        (y, x) bool, pixels of both images.
    tiles, window
        Windows that cover the grid, and side of the window of coherence, pixels.

    Notes
    -----
    Source: docs/theory/stack.md.
    """
    low, high = float(image.opened.frequency_hz.min()), float(image.opened.frequency_hz.max())
    wavenumber = np.pi * (low + high) / image.opened.wave_speed_m_s
    lattice = image.looks.lattice
    node_rows, node_columns = (at.ravel() for at in np.meshgrid(*lattice.nodes, indexing="ij"))
    nodes_m, of_nodes = image.places(scene, node_rows, node_columns)
    tracks = ResidualTracks.of(errors, scene.axes, of_nodes, wavenumber)
    looks = min(one.looks_in(window * scene.grid.spacing_m) for one in (image, reference))
    phases = WindowPhases.of(image.image, reference.image, common, window=window, looks=looks)
    motion, failure, spread = None, "", 0.0
    removed = np.zeros(scene.grid.shape, np.float32)
    if len(phases) < LEAST_WINDOWS:
        failure = f"{len(phases)} windows of significant coherence, less than {LEAST_WINDOWS}"
    else:
        places_m, antennas = image.places(scene, phases.row, phases.column)
        largest_m = max(max(*error.std_m, error.drift_std_m) for error in errors.values())
        radius_m = min(_SEARCH_SIGMAS * largest_m, _MOST_RADIUS_M)
        constants = tracks.constant_phase(places_m, antennas)
        motion = estimate_motion(phases, tracks.phase(places_m, antennas), constants, radius_m=radius_m)
        # Phase at the nodes of the lattice, in blocks, and between them (eq. 4).
        at_nodes = np.empty(len(nodes_m))
        for start in range(0, len(nodes_m), _NODES):
            part = slice(start, start + _NODES)
            some = [replace(one, position_m=one.position_m[part], time_s=one.time_s[part]) for one in of_nodes]
            at_nodes[part] = tracks.phase(nodes_m[part], some) @ motion.unknowns + motion.constant_rad
        removed = lattice.between(at_nodes.reshape(lattice.shape), whole_of(scene)).astype(np.float32)
        # Variation over the aperture, which the removed phase does not correct (eq. 7).
        few = slice(None, None, max(1, len(nodes_m) // _SPREAD_NODES))
        some = [replace(one, position_m=one.position_m[few], time_s=one.time_s[few]) for one in of_nodes]
        draws = max(1.0, motion.scale) * np.random.default_rng(0).standard_normal((_DRAWS, tracks.prior.size))
        spread = float(np.sqrt(tracks.spread(nodes_m[few], some, draws).mean()))
    corrected = (image.image * np.exp(-1j * removed.astype(np.float64))).astype(np.complex64)
    magnitude, *_ = map_coherence(corrected, reference.image, tiles, window=window)
    common = common & np.isfinite(magnitude)
    # Expected coherence: noise, spectral overlap, and the residual track (eq. 7).
    sensed = sensed_heights(scene, image.looks, [legs_of(one.looks) for one in (image, reference)], (low, high))
    expected = sensed.overlap
    for one in (image, reference):
        power = box_sum(np.abs(np.where(common, one.image, 0)).astype(np.float64) ** 2, window)
        noise = box_sum(np.where(common & np.isfinite(one.noise), one.noise, 0.0), window)
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = expected * np.sqrt(np.clip(1 - noise / power, 0.0, 1.0))
    known = unbiased(magnitude, looks) if looks > 1 else magnitude
    if common.any():
        # loss common to the scene, as far as the residual track can explain it
        share = float(np.median((known / np.maximum(expected, 1e-3))[common]))
        explained = float(np.clip(share, np.exp(-(spread**2) / 2), 1.0))
        expected, spread = expected * explained, float(np.sqrt(-2 * np.log(explained)))
    fit = FlightFit(
        np.inf if motion is None else motion.std_rad,
        spread,
        coherence=float(np.median(known[common])) if common.any() else np.nan,
        expected=float(np.median(expected[common])) if common.any() else np.nan,
        coherent=float((magnitude > least_coherence(looks))[common].mean()) if common.any() and looks > 1 else 0.0,
        stable=0.0 if motion is None else motion.stable_fraction,
        windows=len(phases),
        failure=failure,
    )
    return Referred(
        corrected,
        removed,
        np.where(common, magnitude, np.nan).astype(np.float32),
        np.where(common, expected, np.nan).astype(np.float32),
        looks,
        fit,
        {} if motion is None else _track_report(motion, tracks, spread),
        sensed,
    )


def _track_report(motion: ResidualMotion, tracks: ResidualTracks, spread_rad: float) -> dict[str, Any]:
    """Return the residual track for stack.json: knots, displacements east, north and up, and their accuracy."""
    moved = tracks.prior.tracks(motion.unknowns)
    return {
        "constant_rad": round(motion.constant_rad, 4),
        "prior_scale": round(motion.scale, 3),
        "parameters": round(motion.parameters, 2),
        "spread_rad": round(spread_rad, 4),
        "stable_fraction": round(motion.stable_fraction, 4),
        "time_s": np.round(tracks.knots_s, 4).tolist(),
        "displacement_m": {
            node: np.round(moved[node] @ prior.axes.T, 5).tolist() for node, prior in tracks.prior.nodes.items()
        },
    }


def whole_of(scene: OpenScene) -> Window:
    """Return the window of the whole grid."""
    return slice(0, scene.grid.shape[0]), slice(0, scene.grid.shape[1])


def _errors(campaign: Campaign, *pairs: OpenPair) -> dict[str, TrackErrors]:
    """Return node → errors of the difference between its positions in two flights, which are independent."""
    of_flights = []
    for pair in pairs:
        refined, own = open_refined(campaign, pair.flight), errors_of([pair])
        time = pair.began + (pair.time_s * 1e9).astype("timedelta64[ns]")
        for node, stated in own.items():
            residual_m = refined.left_m(node, time)
            if np.isfinite(residual_m).any():
                std_m = float(np.sqrt(np.nanmean(residual_m**2)))
                own = {**own, node: replace(stated, std_m=(std_m,) * 3, drift_std_m=std_m)}
        of_flights.append(own)
    both = {}
    for node in of_flights[0]:
        one, other = (own[node] for own in of_flights)
        east, north, up = np.hypot(one.std_m, other.std_m).tolist()
        longest_s = max(one.correlation_s, other.correlation_s)
        both[node] = TrackErrors((east, north, up), longest_s, float(np.hypot(one.drift_std_m, other.drift_std_m)))
    return both


# ---- Rules ----------------------------------------------------------------------------------------------------------


def stack_image(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/stack/<flight>: the image with the phase of the reference, coherence and stack.json.

    Parameters
    ----------
    campaign
        Campaign with a section `stack`.
    flight
        The reference or another flight of the stack.
    """
    requested, scene = requested_stack(campaign), open_scene(campaign)
    lineage = result_of(campaign, "stack_image", flight).begin(campaign.root)
    reference = open_stacked(campaign, requested.reference, requested.pair, scene)
    image = reference if flight == requested.reference else open_stacked(campaign, flight, requested.pair, scene)
    tiles = list(scene.grid.tiles(campaign.settings.processing.tile_px))
    common = reference.visible & image.visible & np.isfinite(image.image) & np.isfinite(reference.image)
    if image is reference:
        referred = Referred.unchanged(image.image, common)
    else:
        errors = _errors(campaign, image.opened, reference.opened)
        referred = refer(image, reference, scene, errors, common, tiles=tiles, window=requested.window_px)
    fit = referred.fit
    report = {
        "flight": flight,
        "pair": requested.pair,
        "reference": requested.reference,
        "used": fit.reason is None,
        "reason": fit.reason,
        "residual_track": referred.track,
        "residual_phase_std_rad": round(fit.residual_rad, 4) if np.isfinite(fit.residual_rad) else None,
        **_baseline(image, reference, scene, referred.sensed),
        **_times(image, reference),
        "coherence": _rounded(fit.coherence),
        "expected_coherence": _rounded(fit.expected),
        "looks": _rounded(referred.looks),
        "chance": round(chance(referred.looks), 4) if referred.looks > 1 else 1.0,
        "flags": Flags.merged(copied_inputs(image.stage, reference.stage), fit.flags),
    }
    report["says"] = f"left out: {fit.reason}" if fit.reason else _summary(report)
    origin = Provenance.of(
        lineage.modules,
        {name: one.stage for name, one in ((requested.reference, reference), (flight, image))},
        settings=lineage.result.settings,
    )
    rasters = {
        "stack_image": referred.image,
        "flattened_phase": np.angle(referred.image),
        "residual_phase": referred.removed_rad,
        "stack_coherence": referred.coherence,
        "expected_coherence": referred.expected,
        "line_of_sight": LazyLayer(scene.grid, np.float32, image.looks.line_of_sight_enu, 1, components=3),
        "slant_range": LazyLayer(scene.grid, np.float32, image.looks.slant_ranges_m, 1, components=2),
    }
    title = f"{campaign.settings.campaign} · stack of {requested.pair} · {flight}"
    folder = campaign.result(STACK, flight)
    views = {(flight, requested.pair): image.stage.attrs["quality"]["view"]}
    written = write_exports(
        "stack",
        folder,
        rasters,
        titles={source: f"{title} · {source.replace('_', ' ')}" for source in rasters},
        tags=tags_of(origin, lineage) | acquisition_tags(campaign, views) | _tags(report),
        transform=Affine(*scene.grid.transform),
        crs=scene.grid.crs_wkt,
    )
    written.append(folder / STACK_JSON)
    write_json(written[-1], report)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _summary(report: dict[str, Any]) -> str:
    """Return the summary of a flight that is used, one line."""
    return (
        f"perpendicular baseline {report['perpendicular_baseline_m']:.2f} m, coherence {report['coherence']:.2f} "
        f"({report['expected_coherence']:.2f} expected), residual phase {report['residual_phase_std_rad']:.2f} rad"
    )


def requested_stack(campaign: Campaign) -> Stack:
    """Return the section `stack` of the config."""
    requested = campaign.settings.stack
    if requested is None:
        raise CampaignError(
            "no stack is configured", "config/config.yaml: stack", "a section stack", "Add the section to the config."
        )
    return requested


def _times(image: StackedImage, reference: StackedImage) -> dict[str, Any]:
    """Return the acquisition times of a flight, and the days since the reference flight."""
    times = [
        one.opened.began + np.array([0, one.opened.time_s[-1] / 2, one.opened.time_s[-1]]) * np.timedelta64(10**9, "ns")
        for one in (image, reference)
    ]
    names = ("start_utc", "middle_utc", "end_utc")
    stated = {name: f"{np.datetime_as_string(time, unit='us')}Z" for name, time in zip(names, times[0], strict=True)}
    days = float((times[0][1] - times[1][1]) / np.timedelta64(1, "D"))
    return {"acquisition": stated, "temporal_baseline_days": round(days, 6)}


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def _baseline(
    image: StackedImage, reference: StackedImage, scene: OpenScene, sensed: Sensitivity | None
) -> dict[str, float | None]:
    """Return the baseline at the scene centre (docs/theory/stack.md, eq. 8) and the height of ambiguity."""
    row, column = (size // 2 for size in scene.grid.shape)
    legs = []
    for one in (reference, image):
        place, antennas = one.places(scene, np.array([row]), np.array([column]))
        tx, rx = (antenna.position_m[0] for antenna in antennas)
        legs.append((tx, rx))
    perpendicular_m, along_m = baseline(place[0], scene.axes, *legs)
    ambiguity_m = np.inf if sensed is None else float(sensed.ambiguity_m[row, column])
    return {
        "perpendicular_baseline_m": round(perpendicular_m, 4),
        "along_track_offset_m": round(along_m, 4),
        "height_of_ambiguity_m": round(ambiguity_m, 3) if ambiguity_m < _MOST_AMBIGUITY_M else None,
    }


def _tags(report: dict[str, Any]) -> dict[str, str]:
    return {
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_STACK_REFERENCE": report["reference"],
        "APERTURA_PERPENDICULAR_BASELINE_M": f"{report['perpendicular_baseline_m']:.4g}",
        "APERTURA_LOOKS": "none" if report["looks"] is None else f"{report['looks']:.2f}",
        "APERTURA_CHANCE": f"{report['chance']:.3f}",
    }


def stack(campaign: Campaign) -> list[Path]:
    """Write results/stack/baselines.csv and stack.json from the reports of all flights of the stack."""
    requested = requested_stack(campaign)
    lineage = result_of(campaign, "stack").begin(campaign.root)
    reports = [
        open_listed(
            campaign.result(STACK, flight, STACK_JSON), campaign.result(STACK, flight, "stack_image.manifest.json")
        )
        for flight in requested.all_flights
    ]
    folder = campaign.result(STACK)
    table = io.StringIO()
    writer = csv.DictWriter(table, _COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({**report, "start_utc": report["acquisition"]["start_utc"]} for report in reports)
    write_text(folder / BASELINES, table.getvalue())
    write_json(
        folder / STACK_JSON,
        {
            "reference": requested.reference,
            "pair": requested.pair,
            "flights": [report["flight"] for report in reports if report["used"]],
            "excluded": {report["flight"]: report["reason"] for report in reports if not report["used"]},
            "flags": {report["flight"]: report["flags"] for report in reports if report["flags"]},
        },
    )
    written: list[Path] = [folder / BASELINES, folder / STACK_JSON]
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
