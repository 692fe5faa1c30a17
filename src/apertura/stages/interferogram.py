"""Rule `interferogram`: coherence, unwrapped phase and heights of two images of one scene."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.config import CONFIG
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.atomic import write_json
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance, canonical_json
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.looks import Lattice, Looks
from apertura.formats.export import write_exports
from apertura.methods.interferometry.common_band import CommonBand
from apertura.methods.interferometry.comparison import (
    AssumedGround,
    Interferogram,
    form_interferogram,
    interferogram_flags,
)
from apertura.methods.interferometry.heights import KnownHeight, Level
from apertura.methods.interferometry.sensitivity import (
    FlownAntenna,
    Legs,
    Sensitivity,
    TrackPhase,
    baseline,
    sensitivity,
)
from apertura.stages.agreement import opened_layer
from apertura.stages.image_tags import acquisition_tags
from apertura.stages.pair import OpenPair, open_pair
from apertura.stages.planning import gated, weighing
from apertura.stages.refine import clock_s, open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import copied_inputs, tags_of
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import INTERFEROMETRY

_CONSTANT_S = 1e6  # correlation time of an error that is constant over a flight
_BAND_TOLERANCE = 1e-6  # tolerated relative difference between the limits of two bands


@dataclass(frozen=True, eq=False)
class TwoImages:
    """Two images of an interferogram, and the terrain assumed for both.

    Attributes
    ----------
    names
        flight/pair of each image.
    images
        Stages of both images.
    ground
        Assumed terrain, per pixel of the grid.
    baseline_m
        Perpendicular baseline at the scene centre.
    track_std_m
        Flight/node → standard deviation of the track errors in each axis; None if unknown.
    """

    names: tuple[str, str]
    images: tuple[xr.Dataset, xr.Dataset]
    ground: AssumedGround
    baseline_m: float
    track_std_m: Mapping[str, float | None]


def open_two(campaign: Campaign, name: str, scene: OpenScene) -> TwoImages:
    """Return the two images of an interferogram.

    Parameters
    ----------
    campaign, scene
        Campaign, and its scene with grid and terrain.
    name
        A key of `interferometry.pairs`.

    Raises
    ------
    CampaignError
        If the key does not exist, or the images have different frequency bands.
    """
    requested = campaign.settings.interferometry
    if name not in requested.pairs:
        names = ", ".join(requested.pairs)
        expected = f"one of {names}" if names else "a configured interferogram; none is configured"
        where = f"{CONFIG}: interferometry.pairs"
        raise CampaignError(f"no interferogram {name!r}", where, expected, "Add the key to interferometry.pairs.")
    images = requested.images(name)
    bands, looks, antennas, track_std_m = [], [], list[FlownAntenna](), dict[str, float | None]()
    began: np.datetime64 | None = None
    for sign, (flight, pair) in zip((1, -1), images, strict=True):
        echo = PairEcho.cleaned(campaign, flight, pair).stage
        profile = open_stage(campaign.stage("profile", flight, pair), "profile")
        opened = gated(campaign, open_pair(campaign, flight, pair, echo=echo), scene)
        bands.append((float(opened.frequency_hz.min()), float(opened.frequency_hz.max())))
        looks.append(Looks.of(scene.grid, scene.terrain, aperture_of(profile), weighing(campaign, opened, scene)))
        began = began or opened.began
        found = _antennas(campaign, opened, looks[-1], looks[0].lattice, sign=sign, began=began)
        antennas, track_std_m = antennas + found[0], track_std_m | found[1]
    if not np.allclose(bands[0], bands[1], rtol=_BAND_TOLERANCE, atol=0):
        measured = " and ".join(f"{low / 1e6:.6g} to {high / 1e6:.6g} MHz" for low, high in bands)
        where = f"{CONFIG}: interferometry.pairs.{name}"
        expected = "two images of the same frequency band"
        raise CampaignError(f"bands of {measured}", where, expected, "Specify two images of the same band.")
    first, second = ("/".join(image) for image in images)
    stages = [open_stage(campaign.stage("image", *image), "image") for image in images]
    legs = legs_of(looks[0]), legs_of(looks[1], looks[0].lattice)
    nodes_m, lattice = _nodes(scene, looks[0]), looks[0].lattice
    band = CommonBand.of(
        lattice,
        nodes_m,
        scene.axes,
        legs,
        (opened.frequency_hz, opened.weight),
        spacing_m=scene.grid.spacing_m,
        wave_speed_m_s=opened.wave_speed_m_s,
    )
    phase = TrackPhase(nodes_m, scene.axes, antennas, np.pi * sum(bands[0]) / opened.wave_speed_m_s)
    ground = AssumedGround(
        band,
        _node_sensitivity(scene, looks[0], legs, bands[0]),
        lambda window: np.broadcast_to(scene.terrain.heights(scene.grid[window]), scene.grid[window].shape),
        np.logical_and(*(_visible_pixels(campaign, *image) for image in images)),
        track_std=partial(_track_std, phase, lattice) if antennas else None,
    )
    points = [point.model_dump() for point in campaign.settings.scene.reference_points]
    heights = (_known_height(point, scene, ground) for point in points)
    ground = replace(ground, known=[height for height in heights if height is not None])
    middle = len(nodes_m) // 2 + lattice.shape[1] // 2 * (lattice.shape[0] % 2 == 0)
    at_middle = [(tx[middle], rx[middle]) for tx, rx in legs]
    baseline_m, _ = baseline(nodes_m[middle], scene.axes, *at_middle)
    return TwoImages((first, second), (stages[0], stages[1]), ground, baseline_m, track_std_m)


def _antennas(
    campaign: Campaign, opened: OpenPair, looks: Looks, lattice: Lattice, *, sign: int, began: np.datetime64
) -> tuple[list[FlownAntenna], dict[str, float | None]]:
    """Return the antennas of an image with errors of known size, and flight/node → standard deviation of its errors.

    The size is that of the residual errors after track refinement, otherwise the configured one or that of the log; in
    addition, a drift is constant over the flight.
    """
    pulses = _pulses(looks, lattice)
    at_s, refined = clock_s(opened, began)[pulses], open_refined(campaign, opened.flight)
    time = opened.began + (opened.time_s * 1e9).astype("timedelta64[ns]")
    names = dict.fromkeys(opened.name.split("-"))
    accuracies = dict(zip(names, opened.positions, strict=True))
    antennas, stated = list[FlownAntenna](), dict[str, float | None]()
    for node, leg in zip(opened.name.split("-"), looks.aperture.legs, strict=True):
        platform, positions, residual_m = (
            f"{opened.flight}/{node}",
            accuracies[node].assumed,
            refined.left_m(node, time),
        )
        errors = {platform: (positions.std_m, positions.correlation_s)}
        if np.isfinite(residual_m).any():
            errors = {platform: ((float(np.sqrt(np.nanmean(residual_m**2))),) * 3, positions.correlation_s)}
        elif positions.drift_m:
            errors[f"{platform} drift"] = ((positions.drift_m,) * 3, _CONSTANT_S)
        known = {
            name: (np.array(std), correlation_s) for name, (std, correlation_s) in errors.items() if std is not None
        }
        antennas += [FlownAntenna(name, sign, leg[pulses], at_s, *error) for name, error in known.items()]
        size = np.sqrt(sum(np.mean(std_m**2) for std_m, _ in known.values()))
        stated[platform] = round(float(size), 5) if platform in known else None
    return antennas, stated


def _nodes(scene: OpenScene, looks: Looks) -> NDArray[np.float64]:
    """Return the positions of the lattice nodes, (node, 3)."""
    rows, columns = np.meshgrid(*looks.lattice.nodes, indexing="ij")
    return scene.terrain.positions_at(scene.grid, rows, columns).reshape(-1, 3)


def _track_std(phase: TrackPhase, lattice: Lattice, known: Sequence[KnownHeight]) -> NDArray[np.float64]:
    """Return the standard deviation of each node's phase due to track errors, relative to points of known height."""
    columns = lattice.shape[1]
    nearest = [
        int(np.abs(lattice.nodes[0] - point.row).argmin()) * columns
        + int(np.abs(lattice.nodes[1] - point.column).argmin())
        for point in known
    ]
    return phase.std(nearest).reshape(lattice.shape)


def legs_of(looks: Looks, lattice: Lattice | None = None) -> Legs:
    """Return the phase centres at the sampled pulses of each node of a lattice, (node, pulse, 3).

    Parameters
    ----------
    looks
        Looks of an image.
    lattice
        Lattice of the same grid (default: that of `looks`), for whose nodes the nearest nodes of `looks` are used.
    """
    tx, rx = (leg[_pulses(looks, lattice or looks.lattice)] for leg in looks.aperture.legs)
    return tx, rx


def _pulses(looks: Looks, lattice: Lattice) -> NDArray[np.int32]:
    """Return the sampled pulses of the node of `looks` nearest to each node of a lattice, (node, pulse)."""
    nearest = [
        np.abs(own[:, None] - nodes).argmin(axis=0)
        for own, nodes in zip(looks.lattice.nodes, lattice.nodes, strict=True)
    ]
    return looks.pulses[np.ix_(*nearest)].reshape(-1, looks.pulses.shape[-1])


def sensed_heights(
    scene: OpenScene,
    looks: Looks,
    legs: Sequence[Legs],
    band_hz: tuple[float, float],
    window: NDArray[np.float64] | None = None,
) -> Sensitivity:
    """Return the sensitivity to height at every pixel, interpolated bilinearly between the lattice nodes.

    Parameters
    ----------
    scene, looks
        Scene with grid and terrain; looks with the lattice.
    legs
        Phase centres of both images at the lattice nodes, as returned by `legs_of`.
    band_hz, window
        Lowest and highest frequency, and the spectral weights between them (default: flat) for the spectral overlap.
    """
    rows, columns = (slice(0, size) for size in scene.grid.shape)
    return _node_sensitivity(scene, looks, legs, band_hz, window).between(looks.lattice, (rows, columns))


def _node_sensitivity(
    scene: OpenScene,
    looks: Looks,
    legs: Sequence[Legs],
    band_hz: tuple[float, float],
    window: NDArray[np.float64] | None = None,
) -> Sensitivity:
    """Return the sensitivity to height at the lattice nodes, (node row, node column, …)."""
    sensed = sensitivity(_nodes(scene, looks), scene.axes, legs[0], legs[1], band_hz=band_hz, window=window)
    shape = looks.lattice.shape
    return Sensitivity(**{name: values.reshape(*shape, *values.shape[1:]) for name, values in vars(sensed).items()})


def _visible_pixels(campaign: Campaign, flight: str, pair: str) -> NDArray[np.bool_]:
    """Return the pixels visible to a pair, without shadow or layover."""
    with opened_layer(campaign, flight, pair, "mask.tif") as raster:
        visible: NDArray[np.bool_] = raster.read(1) == 0
    return visible


def _known_height(point: Mapping[str, Any], scene: OpenScene, ground: AssumedGround) -> KnownHeight | None:
    """Return the pixel at which a point is imaged, and the topographic phase of the point; None outside the grid."""
    x_m, y_m, z_m = point["position_m"]
    map_pixel = np.array(scene.grid.pixel_of(x_m, y_m))
    pixel = np.round(map_pixel).astype(int)
    for _ in range(5):  # iterate the displacement due to the point's height above the assumed terrain
        if not ((pixel >= 0) & (pixel < scene.grid.shape)).all():
            return None
        row, column = map(int, pixel)
        at = slice(row, row + 1), slice(column, column + 1)
        rise = z_m - ground.height_m(at).item()
        pixel = np.round(map_pixel - ground.shift_px(at)[0, 0] * rise).astype(int)
    sensed = ground.at(at)
    return KnownHeight(point["name"], row, column, (sensed.slope * rise + sensed.bend * rise**2).item())


def interferogram(campaign: Campaign, name: str) -> list[Path]:
    """Write results/interferometry/<name>: GeoTIFFs, a plot and interferogram.json; return their paths.

    Parameters
    ----------
    campaign
        Campaign with settings and flights.
    name
        A key of `interferometry.pairs`.

    Raises
    ------
    CampaignError
        If the key does not exist, or the images have different frequency bands.
    """
    scene = open_scene(campaign)
    two = open_two(campaign, name, scene)
    lineage = result_of(campaign, "interferogram", name).begin(campaign.root)
    tiles = scene.grid.tiles(campaign.settings.processing.tile_px)
    first, second = (stage.image for stage in two.images)
    window = campaign.settings.interferometry.window_px
    formed = form_interferogram(first, second, two.ground, tiles, window=window)
    origin = Provenance.of(
        lineage.modules,
        dict(zip(two.names, two.images, strict=True)),
        settings=lineage.result.settings,
    )
    report = _report(formed, two)
    at = [name.partition("/")[::2] for name in two.names]
    views = {where: stage.attrs["quality"]["view"] for where, stage in zip(at, two.images, strict=True)}
    folder = campaign.result(INTERFEROMETRY, name)
    title = f"{campaign.settings.campaign} · {two.names[0]} against {two.names[1]}"
    written = write_exports(
        "interferogram",
        folder,
        {**formed.panels, "panels": formed.panels},
        titles={source: f"{title} · {source}" for source in formed.panels} | {"panels": title},
        tags=tags_of(origin, lineage) | acquisition_tags(campaign, views) | _tags(report),
        transform=Affine(*scene.grid.transform),
        crs=scene.grid.crs_wkt,
    )
    written.append(folder / "interferogram.json")
    write_json(written[-1], report)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _report(formed: Interferogram, two: TwoImages) -> dict[str, Any]:
    """Return the values of interferogram.json."""
    flagged = {name: stage.attrs["flags"] for name, stage in zip(two.names, two.images, strict=True)}
    stds = formed.panels["height_std"]
    finite = stds[np.isfinite(stds)]
    std_m = round(float(np.median(finite)), 4) if finite.size else None
    measured = {
        key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(formed.measured).items()
    }
    return {
        "images": list(two.names),
        "perpendicular_baseline_m": round(two.baseline_m, 4),
        "track_std_m": two.track_std_m,
        "flags_of_images": {name: flags for name, flags in flagged.items() if flags},
        "measured": measured,
        "level": None if formed.level is None else {**asdict(formed.level), "says": _level_line(formed.level)},
        "height_std_m": std_m,
        "says": _summary(formed, std_m, [platform for platform, std in two.track_std_m.items() if std is None]),
        "flags": Flags.merged(copied_inputs(*two.images), interferogram_flags(formed.measured)),
    }


def _summary(formed: Interferogram, std_m: float | None, unknown: Sequence[str]) -> str:
    """Return a one-line summary: coherence, height accuracy, height of ambiguity, reference, and unknown errors."""
    coherence = f"coherence {formed.measured.coherence:.2f} ({formed.measured.chance:.2f} for unrelated images)"
    if formed.level is None or std_m is None:
        return f"{coherence}; no heights"
    excluded = f"; unknown track errors of {' and '.join(unknown)} are not included" if unknown else ""
    return (
        f"{coherence}; height accuracy {std_m:.2g} m{excluded}; height of ambiguity "
        f"{formed.measured.ambiguity_m:.3g} m; {_level_line(formed.level)}"
    )


def _level_line(level: Level) -> str:
    """Return the height reference of an interferogram in one line."""
    if not level.points:
        return "heights relative to the terrain: the median phase is set to zero"
    spread = "" if level.spread_rad is None else f", which agree within {level.spread_rad:.2f} rad"
    accuracy = "" if level.std_rad is None else f", accuracy {level.std_rad:.2f} rad"
    return f"heights relative to {' and '.join(level.points)}{spread}{accuracy}"


def _tags(report: dict[str, Any]) -> dict[str, str]:
    measured = report["measured"]
    method = measured["by"] or "no: snaphu is not installed"
    return {
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_LEVEL": report["level"]["says"] if report["level"] else "no heights",
        "APERTURA_LOOKS": f"{measured['looks']:.2f}",
        "APERTURA_CHANCE": f"{measured['chance']:.3f}",
        "APERTURA_UNWRAPPED": method if measured["jumps"] else "not needed: no jumps",
    }
