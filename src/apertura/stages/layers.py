"""Rule `layers`: angles, mask, looks, noise, σ⁰ and mean power of a pair, as GeoTIFFs."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from rasterio import Affine

from apertura.campaign.config import polarisation_of
from apertura.campaign.config.processing import Multilooking
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.arrays import Floats
from apertura.common.atomic import write_json
from apertura.common.contracts import Window
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance
from apertura.common.raster import opened_raster
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import Profiles
from apertura.core.imaging.multilook import Multilook
from apertura.core.imaging.noise import PulseNoise, noise_places, noise_power
from apertura.core.imaging.radiometry import Quantity
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.imaging.view import view_report
from apertura.core.scene.angles import surface
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import BLOCK_PX, Looks
from apertura.core.scene.terrain import FlatGround, Terrain
from apertura.formats.export import product, remove_outdated, write_exports
from apertura.formats.export.layers import OUTSIDE
from apertura.formats.export.radiometry import CROSS_SECTIONS, ECHO, of_coefficient
from apertura.stages.image_tags import acquisition_tags, angle_tags, quality_tags
from apertura.stages.multilook import LazyLayer, coarse, mean_power_report, multilook_of, side_of
from apertura.stages.pair import open_pair, pattern_digests
from apertura.stages.planning import gated, integration_of, weighing
from apertura.stages.radiometry import POINTS_LISTED, CalibratedPair, calibrated_pair, points_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import tags_of
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of


def layers(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> list[Path]:
    """Write incidence, bistatic angle, mask, looks and noise of a pair, and σ⁰ and mean power if configured.

    Returns the paths of the files. Cross-sections of bright points and the noise figure are written to radiometry.json.
    """
    lineage = result_of(campaign, "layers", flight, pair).begin(campaign.root)
    echo = PairEcho.cleaned(campaign, flight, pair).stage
    profile = open_stage(campaign.stage("profile", flight, pair), "profile")
    scene, profiles = open_scene(campaign), profiles_of(profile, lazy=True)
    opened = gated(campaign, open_pair(campaign, flight, pair, echo=echo), scene)
    beams, calibrated = weighing(campaign, opened, scene), calibrated_pair(campaign, opened, scene, threads=threads)
    looks = Looks.of(scene.grid, scene.terrain, profiles.aperture, beams, threads=threads)
    points_m = noise_places(scene.grid, scene.terrain)
    measured_noise = noise_power(profiles, points_m, time_s=opened.time_s, beams=beams)
    noise = measured_noise.power
    coefficients, multilook = campaign.settings.processing.radiometry, campaign.settings.processing.multilook
    needs_image = campaign.calibrated or multilook is not None
    image = open_stage(campaign.stage("image", flight, pair), "image") if needs_image else None
    origin = Provenance.of(
        lineage.modules,
        [echo, profile, *([] if image is None else [image]), *scene.parents],
        settings={**lineage.result.settings, **scene.spec},
        inputs=pattern_digests(campaign, pair) | scene.inputs,
    )
    folder, written = campaign.result(flight, pair), list[Path]()
    viewed = _Viewed(profiles, beams, scene.grid, scene.terrain)
    tags = tags_of(origin, lineage) | {"APERTURA_PULSE_NOISE": f"{noise:.4g}"}
    tags |= acquisition_tags(campaign, {(flight, pair): view_report(viewed, opened.began, opened.time_s)})

    def write(kind: str, rasters: Mapping[str, LazyLayer], means: Mapping[str, Mapping[str, Any]]) -> None:
        (grid,) = {raster.grid for raster in rasters.values()} or {scene.grid}
        written.extend(
            write_exports(
                kind,
                folder,
                rasters,
                titles={name: f"{campaign.settings.campaign} · flight {flight} · {pair} · {name}" for name in rasters},
                tags=tags,
                radiometry=means,
                transform=Affine(*grid.transform),
                crs=grid.crs_wkt,
            )
        )

    label, std_db = polarisation_of(campaign.settings.nodes, pair), None if calibrated is None else calibrated.std_db
    means_of = partial(of_coefficient, std_db=std_db, polarisation=label)
    absolute = {} if calibrated is None else {"nesz": means_of("sigma0", noise="alone")}
    write("layers", layer_rasters(scene, looks, noise, calibrated, threads=threads), absolute)
    if image is not None:
        tags |= angle_tags(campaign, flight, [pair]) | _quality_tags(image)
        powers, means = dict[str, GroundPower](), dict[str, Mapping[str, Any]]()
        if campaign.calibrated:
            mask = folder / product("mask", "write_mask").file
            one = GroundPower(scene, image, calibrated, mask, is_known=calibrated is not None)
            powers = {name: replace(one, quantity=name) for name in coefficients}
            means = {name: means_of(name) for name in coefficients}
            images = ((name, power.amplitude) for name, power in powers.items())
            rasters = {name: LazyLayer(scene.grid, np.complex64, of, threads) for name, of in images}
            write(
                "radiometry",
                rasters | (gamma0_layers(one, looks, threads=threads) if "gamma0" in powers else {}),
                means,
            )
            written.append(folder / CROSS_SECTIONS)
            report = _report(scene, image, calibrated, measured_noise) if calibrated else _no_constant(campaign, pair)
            write_json(written[-1], report | {"polarisation": label})
        if multilook is not None:
            per_weight = noise / integration_of(campaign, opened, scene).count ** 2
            averaged = {f"multilook_{name}": (power, means[name]) for name, power in powers.items()}
            for source, (power, meaning) in (
                averaged or {"multilook": (GroundPower(scene, image), ECHO.report)}
            ).items():
                raster, power_report = _multilooked(power, meaning, looks, per_weight, multilook, threads=threads)
                write("multilook", {source: raster}, {source: power_report})
            if multilook.subtract_noise and np.isfinite(noise):
                write("multilook", *_noise_of_echoes(scene, image, looks, per_weight, multilook, threads=threads))
    remove_outdated(folder, written)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


@dataclass(frozen=True, eq=False)
class _Viewed:
    """Scene and profiles of a pair, for `view_report`."""

    profiles: Profiles
    beams: Beams | None
    grid: SceneGrid
    terrain: Terrain

    def positions_at(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the terrain."""
        return self.terrain.positions_at(self.grid, row, column)


def _quality_tags(image: xr.Dataset) -> dict[str, str]:
    """Return the quality of the image of a pair alone; the verdict also depends on the other pairs of the flight."""
    quality = image.attrs["quality"]
    focus = {name: value for name, value in quality["focus"].items() if name not in {"verdict", "reason"}}
    return quality_tags({**quality, "focus": focus})


@dataclass(frozen=True, eq=False)
class GroundPower:
    """Power of an image: backscattering coefficient of a calibrated pair, else the echo power.

    Attributes
    ----------
    scene, image
        Scene with grid and terrain, and the image stage.
    calibrated, mask, quantity
        For a calibrated pair: its calibration, the mask file and the coefficient. Pixels with a mask other than 0 are
        excluded, because their power is not caused by their own terrain alone. None: echo power.
    is_known
        False for a pair without a calibration constant in a calibrated campaign; the power of that pair is NaN.
    """

    scene: OpenScene
    image: xr.Dataset
    calibrated: CalibratedPair | None = None
    mask: Path | None = None
    quantity: Quantity = "sigma0"
    is_known: bool = True

    def per_one(self, window: Window) -> NDArray[np.float64]:
        """Return the echo power per unit of the coefficient in a window, (row, column); NaN where it is unknown."""
        if self.calibrated is None:
            return np.full([part.stop - part.start for part in window], 1.0 if self.is_known else np.nan)
        scene, flat = self.scene, isinstance(self.scene.terrain, FlatGround)
        normal = None if flat and self.quantity == "sigma0" else surface(scene.grid, scene.terrain, window)[1]
        power = self.calibrated.calibration.power(window, self.quantity, normal)
        if flat or self.mask is None:
            return power
        remedy = "Run the workflow again."
        with opened_raster(self.mask, expected="the mask that this step writes", remedy=remedy) as raster:
            return np.where(raster.read(1, window=rasterio.windows.Window.from_slices(*window)) == 0, power, np.nan)

    def amplitude(self, window: Window) -> NDArray[np.complex64]:
        """Return the complex pixels of a window scaled to this power, (row, column)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.image.image[window].values / np.sqrt(self.per_one(window)), np.complex64)


def gamma0_layers(power: GroundPower, looks: Looks, *, threads: int) -> dict[str, LazyLayer]:
    """Return the layers of a calibrated pair that γ⁰ requires.

    Parameters
    ----------
    power
        Power of a coefficient, of which only scene, calibration and mask are used.
    looks
        The pulses that contribute to each pixel.
    threads
        Number of tiles processed in parallel.

    Returns
    -------
    dict
        `scattering_area`, β⁰/γ⁰, `gamma_sigma_ratio`, σ⁰/γ⁰ (docs/theory/radiometry.md, eq. 6a), and
        `ellipsoidal_incidence`, the incidence angle from the vertical.
    """

    def ratio(normalised_to: Quantity, window: Window) -> NDArray[np.float32]:
        # The power of terrain with a coefficient of 1 is proportional to the area to which it is normalised.
        areas = (replace(power, quantity=quantity).per_one(window) for quantity in ("gamma0", normalised_to))
        return np.asarray(next(areas) / next(areas), np.float32)

    def from_vertical(window: Window) -> NDArray[np.float32]:
        return np.asarray(_inside(looks, window, looks.ellipsoidal_incidence_deg(window)), np.float32)

    values: dict[str, Callable[[Window], NDArray[np.float32]]] = {
        "scattering_area": partial(ratio, "beta0"),
        "gamma_sigma_ratio": partial(ratio, "sigma0"),
        "ellipsoidal_incidence": from_vertical,
    }
    return {name: LazyLayer(power.scene.grid, np.float32, of, threads) for name, of in values.items()}


def _multilooked(
    power: GroundPower,
    means: Mapping[str, Any],
    looks: Looks,
    pulse_noise: float,
    multilook: Multilooking,
    *,
    threads: int,
) -> tuple[LazyLayer, dict[str, Any]]:
    """Return the mean power on a coarser grid, and its radiometric report.

    `pulse_noise`: noise power of a pixel divided by the sum of its squared pulse weights, Σw².
    """

    def noise(window: Window) -> Floats:
        return pulse_noise * looks.weight_squares(window) / power.per_one(window)

    subtracted = noise if multilook.subtract_noise and np.isfinite(pulse_noise) else None
    cells = multilook_of(power.amplitude, power.scene.grid, multilook, noise=subtracted)
    noise_is = "in it" if subtracted is None else "subtracted"
    return coarse(power.scene.grid, cells, threads=threads), mean_power_report(cells, means, noise=noise_is)


def _noise_of_echoes(
    scene: OpenScene, image: xr.Dataset, looks: Looks, pulse_noise: float, multilook: Multilooking, *, threads: int
) -> tuple[dict[str, LazyLayer], dict[str, dict[str, Any]]]:
    """Return the mean noise power in the pixels of power.tif, on the coarser grid, for the sums of pairs."""
    side = side_of(scene.grid, multilook)
    cells = Multilook(
        GroundPower(scene, image).amplitude,
        scene.grid.shape,
        side,
        lambda window: pulse_noise * looks.weight_squares(window),
        False,
        *3 * [float("nan")],
    )
    raster = coarse(scene.grid, cells, threads=threads, of=cells.mean_noise)
    means = {"amplitude": "square root of the noise power", "power": f"mean noise power of {side} x {side} pixels"}
    return {"multilook_noise": raster}, {"multilook_noise": ECHO.report | means}


def _report(scene: OpenScene, image: xr.Dataset, calibrated: CalibratedPair, noise: PulseNoise) -> dict[str, Any]:
    """Return the link budget and noise of an image, for radiometry.json."""
    points = points_of(image.image, image.attrs["quality"], scene, list(scene.grid.tiles(BLOCK_PX)))
    constant = calibrated.calibration.constant
    noise_report, noise_flags = calibrated.noise_report(noise, bound="azimuth_undersampled" in image.attrs["flags"])
    return {
        "calibrated_by": calibrated.calibrated_by,
        "constant_db": round(decibels(constant), 3),
        "std_db": calibrated.std_db,
        "pointing_std_db": round(calibrated.pointing_std_db, 3),
        "flags": Flags.merged(calibrated.flags, noise_flags),
        "link": calibrated.link and asdict(calibrated.link),
        "noise": {"pulse": noise.power if np.isfinite(noise.power) else None, **noise_report},
        "points": calibrated.points(points, scene, noise.power),
        "points_listed": POINTS_LISTED,
    }


def _no_constant(campaign: Campaign, pair: str) -> dict[str, Any]:
    """Return the radiometry.json of a pair without a calibration constant in a calibrated campaign."""
    line = f"{campaign.calibration_file and campaign.calibration_file.name} has no constant for {pair}"
    return {
        "calibrated_by": None,
        "constant_db": None,
        "std_db": None,
        "pointing_std_db": 0.0,
        "flags": Flags({"pair_uncalibrated": f"{line}: the backscattering coefficients of the pair are NaN"}),
        "link": None,
        "noise": {"pulse": None, "noise_figure_db": None, "noise_figure_measured_db": None, "std_db": None},
        "points": [],
        "points_listed": POINTS_LISTED,
    }


def layer_rasters(
    scene: OpenScene, looks: Looks, noise: float, calibrated: CalibratedPair | None, *, threads: int
) -> dict[str, LazyLayer]:
    """Return the layers of a pair.

    Parameters
    ----------
    scene, looks
        Scene with grid and terrain, and the pulses that contribute to each pixel.
    noise
        Noise power of one pulse in its range profile; NaN where it is unknown.
    calibrated
        Calibration of the pair; None: the noise is relative.
    threads
        Number of tiles processed in parallel.
    """
    grid, terrain = scene.grid, scene.terrain
    level, noise_db = isinstance(terrain, FlatGround), np.float32(10 * np.log10(noise or np.nan))

    def angle(of: Callable[[Window], NDArray[Any]], window: Window) -> NDArray[Any]:
        return _inside(looks, window, of(window))

    def nesz(window: Window) -> NDArray[Any]:
        if calibrated is not None:
            calibration, normal = calibrated.calibration, None if level else surface(grid, terrain, window)[1]
            power = (noise or np.nan) * calibration.pixel_noise(window) / calibration.power(window, "sigma0", normal)
            return _inside(looks, window, 10 * np.log10(power))
        effective = looks.effective(window)
        with np.errstate(divide="ignore"):
            power_db = noise_db - 10 * np.log10(effective)
        return np.where(effective > 0, power_db, np.float32(np.nan))

    return {
        "incidence": LazyLayer(grid, np.float32, partial(angle, looks.incidence_deg), threads),
        "bistatic_angle": LazyLayer(grid, np.float32, partial(angle, looks.bistatic_angle_deg), threads),
        "mask": LazyLayer(grid, np.uint8, _mask(scene, looks), threads),
        "looks": LazyLayer(grid, np.float32, looks.effective, threads),
        "nesz": LazyLayer(grid, np.float32, nesz, threads),
    }


def _inside(looks: Looks, window: Window, values: NDArray[Any]) -> NDArray[Any]:
    lit = looks.illuminated(window)
    return values if lit.all() else np.where(lit, values, values.dtype.type(np.nan))


def _mask(scene: OpenScene, looks: Looks) -> Callable[[Window], NDArray[np.uint8]]:
    """Return the function that computes the mask of a window, from the pulses of each pixel's nearest lattice node."""

    def outside(window: Window) -> NDArray[np.uint8]:
        return np.where(looks.illuminated(window), 0, OUTSIDE).astype(np.uint8)

    if isinstance(scene.terrain, FlatGround):
        return outside
    from apertura.core.scene.visibility import Relief, visibility  # slow to import: it loads numba

    relief = Relief.of(scene.grid, scene.terrain, scene.level.height_m)

    def mask(window: Window) -> NDArray[np.uint8]:
        illuminated, values = looks.illuminated(window), outside(window)
        if not illuminated.any():
            return values
        for node, part in looks.lattice.nearest(window):
            inner = tuple(slice(at.start - by.start, at.stop - by.start) for at, by in zip(part, window, strict=True))
            if illuminated[inner].any():
                tx, rx = (relief.above(leg) for leg in looks.aperture[looks.pulses[node].astype(np.int64)].legs)
                values[inner] = np.where(illuminated[inner], visibility(relief, tx, rx, part), OUTSIDE)
        return values

    return mask
