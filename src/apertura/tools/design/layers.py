"""Predicted images of a flight plan, pixel by pixel: by the functions that describe images after a flight."""

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
from apertura.stages.planning import budget_of, integration_of
from apertura.stages.radiometry import CalibratedPair, calibrated_pair
from apertura.stages.scene import OpenScene

LOSS_NODES = 3
"""Points along a side of the scene at which the error budget is made; bilinear between: it varies with range alone."""

AMBIGUITY_NODES = 9
"""The same of echoes that fold, and of paths against the end of the recording."""

Layer = NDArray[Any]

UNITS: Mapping[str, tuple[str, str]] = {
    "resolution": ("m", "−3 dB width of a point in its coarsest direction"),
    "resolution_fine": ("m", "−3 dB width of a point in its finest direction"),
    "orientation": ("deg", "azimuth of the finest direction, clockwise from grid north"),
    "looks": ("pulses", "effective number of pulses that make the pixel"),
    "incidence": ("deg", "incidence at closest approach, from the terrain's normal"),
    "bistatic_angle": ("deg", "angle between transmitter and receiver at closest approach"),
    "mask": ("class", "0 visible, 1 shadow, 2 layover, 3 both, 255 outside"),
    "nesz": ("dB", "noise-equivalent sigma0"),
    "snr": ("dB", "ground of expect.sigma0_db over noise"),
    "point_snr": ("dB", "point of expect.rcs_dbsm over noise"),
    "ambiguity": ("1", "share of the scene's echo that folds onto the place"),
    "path_margin": ("m", "total path left before the prefix or the recording ends"),
    "loss": ("dB", "expected loss of a point's peak by all causes of the error budget, with the tracks as logged"),
    "loss_refined": ("dB", "the same after step refine; NaN where a measured limit of the refinement is exceeded"),
    "coherence": ("1", "of still ground between two images: common spectrum and noise"),
    "height_ambiguity": ("m", "height that turns the phase between two images once"),
}
"""Layer → unit and meaning."""


@dataclass(frozen=True)
class PlannedRefinement:
    """Refinement of a flight's tracks, before the flight.

    Attributes
    ----------
    decision
        On or off by the plan's `processing.autofocus`, and why.
    remainder_db
        Loss by position errors that it is expected to leave, 0 or less; NaN where an obstacle prevents it.
    obstacles
        Measured limits that the flight exceeds.
    """

    decision: Decision
    remainder_db: float
    obstacles: tuple[str, ...]

    @property
    def applied(self) -> bool:
        """True if images are judged with refined tracks: requested by the plan, and within the measured limits."""
        return self.decision.value == "on" and not self.obstacles


@dataclass(frozen=True, eq=False)
class PlannedImage:
    """An image of a plan: of a pair, or the sum of a flight's pairs.

    Attributes
    ----------
    name
        flight/transmitter-receiver, or flight/sum.
    layers
        Name → (row, column) values.
    resolution
        From which widths follow.
    budget
        Lines of the error budget in the middle of the scene; none of a sum.
    flags
        Limits crossed → what was found.
    looks
        Of a pair: for interferograms; None of a sum.
    doppler_hz
        Spread of Doppler over the scene, as sampled by the pulses, Hz; NaN of a sum.
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
        Settings, the pair as it will fly, or as its logs say that it flew; grid and ground.
    sigma0_db, rcs_dbsm
        Of the ground and of a point, to be seen above the noise; None: not computed.
    refinement
        Of the flight's tracks before the flight; None: the pair is as it will be imaged.
    threads
        Tiles computed at once.
    """
    grid = scene.grid
    job, integration, beams = planned_job(campaign, pair, scene)
    flags = Flags.merged(check_geometry(job), decide_antennas(job.beams, job.illumination)[1], integration.flags)
    calibrated = calibrated_pair(campaign, pair, scene, weights=(beams, integration.count), threads=threads)
    noise = float("nan")  # of a pulse by the receiver's noise figure, where it is stated
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
    seen = _seen_from(pair, beams, scene.middle_m)
    refined = seen
    if refinement is not None:  # the loss that it leaves, and the shifts of the logs, which no refinement observes
        logged = summed(line.effect for line in budget_of(campaign, seen, scene) if line.cause == "positions")
        refined = replace(seen, left=replace(logged, loss_db=refinement.remainder_db, loss_std_db=0.0))
    layers |= _coarse_layers(campaign, pair, scene, beams, None if refinement is None else refined.left)
    outside = layers["mask"] == OUTSIDE
    layers["mask"] = np.where((layers["path_margin"] < 0) | outside, OUTSIDE, layers["mask"]).astype(np.uint8)
    spread, _ = pair.aperture.phase_rates(job.points_m, wavelength_m=pair.wave_speed_m_s / job.band_hz[1])
    rate_hz = 1 / float(np.median(np.diff(pair.time_s)))
    applied = refinement is not None and refinement.applied
    budget = tuple(budget_of(campaign, refined if applied else seen, scene))
    return PlannedImage(f"{pair.flight}/{pair.name}", layers, resolution, budget, flags, looks, spread * rate_hz)


def summed_image(flight: str, images: list[PlannedImage]) -> PlannedImage:
    """Predict the sum of a flight's pairs, each divided by its peak (docs/theory.md, eq. 7).

    Parameters
    ----------
    flight
        Its name.
    images
        Of its pairs.

    Notes
    -----
    Source: docs/theory/design.md, eq. 4 and 5.
    """
    resolution = Resolution.summed([image.resolution for image in images])
    shape = images[0].layers["looks"].shape
    masks = np.stack([image.layers["mask"] for image in images])
    seen = masks != OUTSIDE
    layers: dict[str, Layer] = resolution_layers(resolution, shape)
    layers["looks"] = np.stack([image.layers["looks"] for image in images]).sum(axis=0)
    layers["mask"] = np.where((masks == 0).any(axis=0), 0, masks.min(axis=0)).astype(np.uint8)
    with np.errstate(divide="ignore", invalid="ignore"):
        count = np.maximum(seen.sum(axis=0), 1)
        for name, coherent, sign in (("nesz", False, 1), ("snr", False, -1), ("point_snr", True, -1)):
            if name in images[0].layers:
                values = np.stack([image.layers[name] for image in images])
                inverse = np.where(seen, np.exp(sign * np.float32(np.log(10) / 10) * values), np.float32(0))
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
    """Return coherence of still ground, and the height that turns the phase once, of two images of one band.

    Notes
    -----
    Source: docs/theory/design.md, eq. 6; docs/theory/interferometry.md, eq. 1 and 11.
    """
    first, second = (image.looks for image in images)
    if first is None or second is None:
        raise TypeError("interferograms are of pairs")
    if first.lattice.shape != second.lattice.shape:
        rows, columns = np.meshgrid(*first.lattice.nodes, indexing="ij")
        nearest = [
            np.abs(at[:, None] - of).argmin(axis=0)
            for at, of in zip(second.lattice.nodes, (rows[:, 0], columns[0]), strict=True)
        ]
        second = replace(second, pulses=second.pulses[np.ix_(*nearest)], lattice=first.lattice)
    band = float(pairs[0].frequency_hz[0]), float(pairs[0].frequency_hz[-1])
    sensed = sensed_heights(scene, first, [legs_of(first), legs_of(second)], band, pairs[0].weight)
    coherence = sensed.overlap
    for image in images:
        if "snr" in image.layers and np.isfinite(image.layers["snr"]).any():
            coherence = coherence / np.sqrt(1 + 10 ** (-image.layers["snr"] / 10))
    return {"coherence": coherence.astype(np.float32), "height_ambiguity": sensed.ambiguity_m.astype(np.float32)}


def resolution_layers(resolution: Resolution, shape: tuple[int, int]) -> dict[str, Layer]:
    """Return widths of a point along both axes of its response, and the azimuth of the finer one."""
    tiles = [(slice(row, min(row + BLOCK_PX, shape[0])), slice(0, shape[1])) for row in range(0, shape[0], BLOCK_PX)]
    parts = [resolution.axes(tile) for tile in tiles]
    fine, coarse, azimuth = (np.concatenate(one).astype(np.float32) for one in zip(*parts, strict=True))
    return {"resolution": coarse, "resolution_fine": fine, "orientation": azimuth}


def planned_job(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> tuple[Job, Integration, Beams | None]:
    """Return the job that limits of imaging are checked on, the planner's without its signal; and its weights."""
    integration = integration_of(campaign, pair, scene)
    beams = Beams.within(integration.sector, pair.beams)
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
        path_limit_m=pair.path_limit_m,
        beams=beams,
        integration=integration,
        illumination=scene_illumination(campaign, pair.name, beams, scene, pair.aperture),
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
    """Return losses by expected errors, echoes that fold, and path left before the recording ends; bilinear."""
    wavelength_m = pair.wave_speed_m_s / float(pair.frequency_hz[-1])

    def loss_db(points: Floats, after: Effect | None = None) -> Floats:
        seen = [replace(_seen_from(pair, beams, point), left=after or pair.left) for point in points]
        found = [
            expected(budget_of(campaign, one, scene, place_m=point)) for one, point in zip(seen, points, strict=True)
        ]
        return -np.array([effect.loss_db for effect in found])

    def folded(points: Floats) -> Floats:
        return pair.aperture.ambiguities(points, wavelength_m=wavelength_m)

    def left_m(points: Floats) -> Floats:
        return np.asarray(pair.path_limit_m - pair.aperture[pair.aperture.sample(MOST_PULSES)].path(points).min(axis=0))

    counts: dict[str, tuple[int, Callable[[Floats], Floats]]] = {
        "loss": (LOSS_NODES, loss_db),
        "loss_refined": (LOSS_NODES, partial(loss_db, after=left)),
        "ambiguity": (AMBIGUITY_NODES, folded),
        "path_margin": (AMBIGUITY_NODES, left_m),
    }
    return {name: _interpolated(scene, count, values) for name, (count, values) in counts.items()}


def _interpolated(scene: OpenScene, count: int, values: Callable[[Floats], Floats]) -> Layer:
    """Return values computed at count × count points of the ground, bilinear at all pixels."""
    rows, columns = (np.linspace(0, size - 1, count) for size in scene.grid.shape)
    row, column = np.meshgrid(rows, columns, indexing="ij")
    points = scene.terrain.positions_at(scene.grid, np.round(row), np.round(column)).reshape(-1, 3)
    found = np.asarray(values(points)).reshape(1, count, count)
    at = [np.arange(size) * (count - 1) / max(size - 1, 1) for size in scene.grid.shape]
    values_px: Layer = bilinear(found, at[0][:, None], at[1][None])[0].astype(np.float32)
    return values_px


def _seen_from(pair: OpenPair, beams: Beams | None, place_m: Floats) -> OpenPair:
    """Return a pair with those pulses alone that make the image of a place: half or more of the strongest."""
    if beams is None:
        return pair
    weight = np.abs(point_weights(pair.aperture, beams, place_m[None])[0][:, 0])
    pulses = np.flatnonzero(weight >= weight.max() / 2)
    if weight.max() == 0 or len(pulses) < 3:
        return pair
    return replace(
        pair,
        aperture=pair.aperture[pulses],
        time_s=pair.time_s[pulses],
        beams=pair.beams and pair.beams[pulses],
        axes={point: axes[pulses] for point, axes in pair.axes.items()},
    )
