"""Predicted images of a flight plan, pixel by pixel, computed by the functions that also assess processed images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.arrays import Floats
from apertura.common.flags import Flags
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import decide_antennas
from apertura.core.backprojection.job import Integration, Job, Signal
from apertura.core.echo.compression import centre_frequency
from apertura.core.imaging.radiometry import point_weights
from apertura.core.imaging.resolution import Resolution
from apertura.core.planning.plan import Decision, check_geometry
from apertura.core.quality.budget import BudgetLine, expected, summed
from apertura.core.quality.path_errors import MOST_PULSES, Effect
from apertura.core.scene.looks import BLOCK_PX, Looks
from apertura.core.scene.terrain import bilinear
from apertura.formats.export.layers import OUTSIDE
from apertura.stages.interferogram import legs_of, sensed_heights
from apertura.stages.layers import layer_rasters
from apertura.stages.pair import OpenPair, scene_illumination
from apertura.stages.planning import budget_of, gated, integration_of, recording_flags
from apertura.stages.radiometry import CalibratedPair, calibrated_pair
from apertura.stages.scene import OpenScene

LOSS_NODES = 3
"""Number of points along each side of the scene at which the loss is computed from an error budget.

Bilinear interpolation between these points suffices, because the loss varies with range only.
"""

AMBIGUITY_NODES = 9
"""Number of points along each side of the scene at which ambiguous echoes and range-window margins are computed."""

Layer = NDArray[Any]

UNITS: Mapping[str, tuple[str, str]] = {
    "resolution": ("m", "−3 dB width of a point in its coarsest direction"),
    "resolution_fine": ("m", "−3 dB width of a point in its finest direction"),
    "orientation": ("deg", "azimuth of the direction of finest resolution, clockwise from grid north"),
    "looks": ("pulses", "effective number of integrated pulses"),
    "incidence": ("deg", "incidence angle at closest approach, from the terrain normal"),
    "bistatic_angle": ("deg", "angle between transmitter and receiver at closest approach"),
    "mask": ("class", "0 visible, 1 shadow, 2 layover, 3 both, 255 outside"),
    "nesz": ("dB", "noise-equivalent sigma0"),
    "snr": ("dB", "SNR of terrain with expect.sigma0_db"),
    "point_snr": ("dB", "SNR of a point with expect.rcs_dbsm"),
    "ambiguity": ("1", "power of ambiguous echoes of the scene, relative to the echo of the pixel"),
    "path_margin": ("m", "margin of the total path to the end of the cyclic prefix or of the recording"),
    "loss": ("dB", "expected peak loss of a point due to all causes of the error budget, with the tracks as logged"),
    "loss_refined": ("dB", "loss after step refine; NaN if a measured limit of the refinement is exceeded"),
    "coherence": ("1", "coherence of stationary terrain between two images, from common spectrum and noise"),
    "height_ambiguity": ("m", "height of ambiguity of two images"),
}
"""Layer → unit and meaning."""


@dataclass(frozen=True)
class PlannedRefinement:
    """Predicted refinement of a flight's tracks.

    Attributes
    ----------
    decision
        On or off according to the plan's `processing.autofocus`, with the reason.
    remainder_db
        Expected loss due to residual position errors, dB, 0 or less; NaN if an obstacle prevents the refinement.
    obstacles
        Measured limits that the flight exceeds.
    """

    decision: Decision
    remainder_db: float
    obstacles: tuple[str, ...]

    @property
    def applied(self) -> bool:
        """True if requirements apply to refined tracks: refinement is requested, and no measured limit is exceeded."""
        return self.decision.value == "on" and not self.obstacles


@dataclass(frozen=True, eq=False)
class PlannedImage:
    """Predicted image of a pair, or of the sum of a flight's pairs.

    Attributes
    ----------
    name
        flight/transmitter-receiver, or flight/sum.
    layers
        Name → (row, column) values.
    resolution
        Resolution model of the image.
    budget
        Lines of the error budget at the scene centre; empty for a sum.
    flags
        Flag → measurement.
    looks
        Integrated pulses of a pair, for interferograms; None for a sum.
    doppler_hz
        Doppler spread over the scene, Hz; NaN for a sum.
    """

    name: str
    layers: Mapping[str, Layer]
    resolution: Resolution
    budget: tuple[BudgetLine, ...]
    flags: Mapping[str, str]
    looks: Looks | None
    doppler_hz: float


def planned_image(
    campaign: Campaign,
    pair: OpenPair,
    scene: OpenScene,
    *,
    sigma0_db: float | None,
    rcs_dbsm: float | None,
    refinement: PlannedRefinement | None = None,
    threads: int = 1,
) -> PlannedImage:
    """Predict the image of a pair.

    Parameters
    ----------
    campaign, pair, scene
        Settings; the planned pair, or the recorded pair with the tracks of its logs; grid and terrain.
    sigma0_db, rcs_dbsm
        Backscattering coefficient of the terrain and cross-section of a point for the predicted SNR; None: not
        computed.
    refinement
        Predicted refinement of the flight's tracks; None for tracks that are imaged unchanged.
    threads
        Number of tiles computed in parallel.
    """
    grid, pair = scene.grid, gated(campaign, pair, scene)
    job, integration, beams = planned_job(campaign, pair, scene)
    flags = Flags.merged(
        check_geometry(job),
        decide_antennas(job.beams, job.illumination)[1],
        integration.flags,
        recording_flags(campaign, pair, scene),
    )
    calibrated = calibrated_pair(campaign, pair, scene, weights=(beams, integration.count), threads=threads)
    noise = float("nan")  # noise of a pulse, if the receiver's noise figure is configured
    if calibrated is not None and calibrated.thermal_noise is not None and calibrated.noise_figure_db is not None:
        noise = calibrated.thermal_noise * 10 ** (calibrated.noise_figure_db / 10)
    looks = Looks.of(grid, scene.terrain, pair.aperture, beams, threads=threads)
    layers = {
        name: lazy[slice(0, grid.shape[0]), slice(0, grid.shape[1])]
        for name, lazy in layer_rasters(scene, looks, noise, calibrated, threads=threads).items()
    }
    band = {"frequency_hz": pair.frequency_hz, "weight": pair.weight}
    resolution = Resolution.of(grid, scene.terrain, pair.aperture, beams, **band, threads=threads)
    layers |= resolution_layers(resolution, grid.shape)
    if sigma0_db is not None:
        layers["snr"] = (sigma0_db - layers["nesz"]).astype(np.float32)
    if rcs_dbsm is not None:
        layers["point_snr"] = _point_snr(calibrated, noise, rcs_dbsm, grid.shape)
    contributing = _contributing(pair, beams, scene.middle_m)
    refined = contributing
    if refinement is not None:  # residual loss; displacements as without refinement, because they are not observable
        logged = summed(line.effect for line in budget_of(campaign, contributing, scene) if line.cause == "positions")
        refined = replace(contributing, left=replace(logged, loss_db=refinement.remainder_db, loss_std_db=0.0))
    layers |= _coarse_layers(campaign, pair, scene, beams, None if refinement is None else refined.left)
    outside = layers["mask"] == OUTSIDE
    layers["mask"] = np.where((layers["path_margin"] < 0) | outside, OUTSIDE, layers["mask"]).astype(np.uint8)
    spread, _ = pair.aperture.phase_rates(job.points_m, wavelength_m=pair.wave_speed_m_s / job.band_hz[1])
    rate_hz = 1 / float(np.median(np.diff(pair.time_s)))
    applied = refinement is not None and refinement.applied
    budget = tuple(budget_of(campaign, refined if applied else contributing, scene))
    return PlannedImage(f"{pair.flight}/{pair.name}", layers, resolution, budget, flags, looks, spread * rate_hz)


def summed_image(flight: str, images: list[PlannedImage]) -> PlannedImage:
    """Predict the sum of a flight's pairs, each divided by its peak (docs/theory.md, eq. 7).

    Parameters
    ----------
    flight
        Name of the flight.
    images
        Images of its pairs.

    Notes
    -----
    Source: docs/theory/design.md, eq. 4 and 5.
    """
    resolution = Resolution.summed([image.resolution for image in images])
    shape = images[0].layers["looks"].shape
    masks = np.stack([image.layers["mask"] for image in images])
    inside = masks != OUTSIDE
    layers: dict[str, Layer] = resolution_layers(resolution, shape)
    layers["looks"] = np.stack([image.layers["looks"] for image in images]).sum(axis=0)
    layers["mask"] = np.where((masks == 0).any(axis=0), 0, masks.min(axis=0)).astype(np.uint8)
    with np.errstate(divide="ignore", invalid="ignore"):
        count = np.maximum(inside.sum(axis=0), 1)
        for name, coherent, sign in (("nesz", False, 1), ("snr", False, -1), ("point_snr", True, -1)):
            if name in images[0].layers:
                values = np.stack([image.layers[name] for image in images])
                inverse = np.where(inside, np.exp(sign * np.float32(np.log(10) / 10) * values), np.float32(0))
                mean = inverse.sum(axis=0) / count
                mean = np.where(mean > 0, mean / (count if coherent else 1), np.nan)
                layers[name] = (sign * 10 * np.log10(mean)).astype(np.float32)
    for name, worst in (
        ("ambiguity", np.max),
        ("path_margin", np.min),
        ("loss", np.max),
        ("loss_refined", np.max),
    ):
        layers[name] = worst([image.layers[name] for image in images], axis=0)
    flags = Flags.merged(*(image.flags for image in images))
    return PlannedImage(f"{flight}/sum", layers, resolution, (), flags, None, float("nan"))


def coherence_layers(
    scene: OpenScene, pairs: tuple[OpenPair, OpenPair], images: tuple[PlannedImage, PlannedImage]
) -> dict[str, Layer]:
    """Return coherence of stationary terrain and height of ambiguity of two images in the same band.

    Notes
    -----
    Source: docs/theory/design.md, eq. 6; docs/theory/interferometry.md, eq. 1 and 11.
    """
    first, second = (image.looks for image in images)
    if first is None or second is None:
        raise TypeError("interferograms require images of pairs, not sums")
    band = float(pairs[0].frequency_hz[0]), float(pairs[0].frequency_hz[-1])
    sensed = sensed_heights(scene, first, [legs_of(first), legs_of(second, first.lattice)], band, pairs[0].weight)
    coherence = sensed.overlap
    for image in images:
        if "snr" in image.layers and np.isfinite(image.layers["snr"]).any():
            coherence = coherence / np.sqrt(1 + 10 ** (-image.layers["snr"] / 10))
    return {"coherence": coherence.astype(np.float32), "height_ambiguity": sensed.ambiguity_m.astype(np.float32)}


def resolution_layers(resolution: Resolution, shape: tuple[int, int]) -> dict[str, Layer]:
    """Return the widths along both principal axes of the point response, and the azimuth of the finer axis."""
    tiles = [(slice(row, min(row + BLOCK_PX, shape[0])), slice(0, shape[1])) for row in range(0, shape[0], BLOCK_PX)]
    blocks = [resolution.axes(tile) for tile in tiles]
    fine, coarse, azimuth = (np.concatenate(layer).astype(np.float32) for layer in zip(*blocks, strict=True))
    return {"resolution": coarse, "resolution_fine": fine, "orientation": azimuth}


def planned_job(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> tuple[Job, Integration, Beams | None]:
    """Return the planner's job with a placeholder signal, for checks of imaging limits, and integration and weights."""
    integration = integration_of(campaign, pair, scene)
    beams = Beams.within(integration.sector, pair.beams, pair.gate)
    grid, frequency_hz = scene.grid, pair.frequency_hz
    centre_hz, count = centre_frequency(frequency_hz), len(frequency_hz)
    job = Job(
        aperture=pair.aperture,
        ground_m=grid.sample_points(AMBIGUITY_NODES, scene.level.height_m),
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre_hz,
        bandwidth_hz=float(frequency_hz[-1] - frequency_hz[0]) * count / (count - 1),
        subcarriers=count,
        signal=Signal(centre_hz, 1.0, 1.0, 1),
        beams=beams,
        integration=integration,
        illumination=scene_illumination(campaign, pair.name, beams and beams.on_profiles, scene, pair.aperture),
    )
    return job, integration, beams


def _point_snr(calibrated: CalibratedPair | None, noise: float, rcs_dbsm: float, shape: tuple[int, int]) -> Layer:
    if calibrated is None:
        return np.full(shape, np.nan, np.float32)
    whole = slice(0, shape[0]), slice(0, shape[1])
    calibration = calibrated.calibration
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = calibration.rcs_power(whole) / (noise * calibration.pixel_noise(whole))
        return (rcs_dbsm + 10 * np.log10(ratio)).astype(np.float32)


def _coarse_layers(
    campaign: Campaign, pair: OpenPair, scene: OpenScene, beams: Beams | None, left: Effect | None
) -> dict[str, Layer]:
    """Return layers of expected loss, ambiguous echoes and range-window margin, interpolated bilinearly."""
    wavelength_m = pair.wave_speed_m_s / float(pair.frequency_hz[-1])

    def loss_db(points: Floats, residual: Effect | None = None) -> Floats:
        pairs = [replace(_contributing(pair, beams, point), left=residual or pair.left) for point in points]
        effects = [
            expected(budget_of(campaign, contributing, scene, place_m=point))
            for contributing, point in zip(pairs, points, strict=True)
        ]
        return -np.array([effect.loss_db for effect in effects])

    def ambiguity(points: Floats) -> Floats:
        return pair.aperture.ambiguities(points, wavelength_m=wavelength_m)

    def margin_m(points: Floats) -> Floats:
        return np.asarray(pair.path_limit_m - pair.aperture[pair.aperture.sample(MOST_PULSES)].path(points).min(axis=0))

    counts: dict[str, tuple[int, Callable[[Floats], Floats]]] = {
        "loss": (LOSS_NODES, loss_db),
        "loss_refined": (LOSS_NODES, partial(loss_db, residual=left)),
        "ambiguity": (AMBIGUITY_NODES, ambiguity),
        "path_margin": (AMBIGUITY_NODES, margin_m),
    }
    return {name: _interpolated(scene, count, values) for name, (count, values) in counts.items()}


def _interpolated(scene: OpenScene, count: int, values: Callable[[Floats], Floats]) -> Layer:
    """Compute values at count × count points of the terrain and interpolate them bilinearly to all pixels."""
    rows, columns = (np.linspace(0, size - 1, count) for size in scene.grid.shape)
    row, column = np.meshgrid(rows, columns, indexing="ij")
    points = scene.terrain.positions_at(scene.grid, np.round(row), np.round(column)).reshape(-1, 3)
    computed = np.asarray(values(points)).reshape(1, count, count)
    at = [np.arange(size) * (count - 1) / max(size - 1, 1) for size in scene.grid.shape]
    values_px: Layer = bilinear(computed, at[0][:, None], at[1][None])[0].astype(np.float32)
    return values_px


def _contributing(pair: OpenPair, beams: Beams | None, point_m: Floats) -> OpenPair:
    """Return a pair reduced to the pulses with at least half of the maximum weight at a point."""
    if beams is None:
        return pair
    weight = np.abs(point_weights(pair.aperture, beams, point_m[None])[0][:, 0])
    pulses = np.flatnonzero(weight >= weight.max() / 2)
    if weight.max() == 0 or len(pulses) < 3:
        return pair
    return replace(
        pair,
        aperture=pair.aperture[pulses],
        time_s=pair.time_s[pulses],
        beams=pair.beams and pair.beams[pulses],
        gate=pair.gate and pair.gate[pulses],
        axes={point: axes[pulses] for point, axes in pair.axes.items()},
    )
