"""Rule `layers`: angles, mask, looks, noise and σ⁰ of a pair, as GeoTIFFs on the campaign's grid."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rasterio import Affine

from apertura.common.atomic import write_json
from apertura.common.contracts import Window
from apertura.common.provenance import Provenance
from apertura.core.antenna.beam import Beams
from apertura.core.focus.inputs import Profiles
from apertura.core.imaging.noise import PLACES, noise_power
from apertura.core.imaging.radiometry import Quantity
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import BLOCK_PX, Looks
from apertura.core.scene.terrain import FlatGround
from apertura.core.scene.visibility import Relief, bistatic_angle_deg, incidence_deg, surface, visibility
from apertura.formats.export import write_exports
from apertura.formats.export.layers import OUTSIDE
from apertura.formats.export.radiometry import CROSS_SECTIONS, of_coefficient, remove_outdated
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.pair import open_pair, pattern_digests
from apertura.pipeline.opening.plan import weighing
from apertura.pipeline.opening.radiometry import CalibratedPair, calibrated_pair, points_of
from apertura.pipeline.opening.scene import OpenScene, open_scene
from apertura.pipeline.steps.stamping import tags_of
from apertura.pipeline.store import open_stage, record_files


def layers(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> list[Path]:
    """Write incidence, bistatic angle, mask, looks and noise of one pair, and σ⁰ where its radio is stated.

    Returns their paths. What the radio makes of bright points and of noise is in radiometry.json.
    """
    lineage = result_of(campaign, "layers", flight, pair).begin(campaign.root)
    echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
    scene, profiles = open_scene(campaign), profiles_of(profile, lazy=True)
    opened = open_pair(campaign, flight, pair, echo=echo)
    beams, calibrated = weighing(campaign, opened, scene), calibrated_pair(campaign, opened, scene, threads=threads)
    looks = Looks.of(scene.grid, scene.terrain, profiles.aperture, beams, threads=threads)
    noise = _noise(profiles, scene, beams)
    origin = Provenance.of(
        lineage.modules,
        [echo, profile, *scene.parents],
        settings={**lineage.result.settings, **scene.spec},
        inputs=pattern_digests(campaign, pair) | scene.inputs,
    )
    rasters = {"layers": _rasters(scene, looks, noise, calibrated, threads=threads)}
    image = None if calibrated is None else open_stage(campaign.stage("image", flight, pair), "image")
    means: dict[str, dict[str, Any]] = {}
    if calibrated is not None and image is not None:
        asked, std_db = campaign.settings.processing.radiometry, calibrated.stated_std_db
        rasters["radiometry"] = {name: _coefficient(scene, image, calibrated, name, threads=threads) for name in asked}
        means = {name: of_coefficient(name, std_db=std_db) for name in asked}
        means |= {"nesz": of_coefficient("sigma0", std_db=std_db, noise="alone")}
        origin = Provenance.of(
            lineage.modules,
            [echo, profile, image, *scene.parents],
            settings={**lineage.result.settings, **scene.spec},
            inputs=pattern_digests(campaign, pair) | scene.inputs,
        )
    folder, written = campaign.result(flight, pair), []
    for kind, some in rasters.items():
        written += write_exports(
            kind,
            folder,
            some,
            titles={name: f"{campaign.settings.campaign} · flight {flight} · {pair} · {name}" for name in some},
            tags=tags_of(origin, lineage) | {"APERTURA_PULSE_NOISE": f"{noise:.4g}"},
            radiometry=means,
            transform=Affine(*scene.grid.transform),
            crs=scene.grid.crs_wkt,
        )
    if calibrated is not None and image is not None:
        written.append(folder / CROSS_SECTIONS)
        write_json(written[-1], _report(scene, image, calibrated, noise))
    remove_outdated(folder, written)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _noise(profiles: Profiles, scene: OpenScene, beams: Beams | None) -> float:
    """Return the noise of one pulse, measured at random places of the scene."""
    rows, columns = np.random.default_rng(0).integers(0, scene.grid.shape, (PLACES, 2)).T
    return noise_power(profiles, scene.terrain.positions_at(scene.grid, rows, columns), beams=beams)


@dataclass(frozen=True)
class LazyLayer:
    """A raster whose blocks are computed on reading, tile by tile, in threads.

    Attributes
    ----------
    grid
        Its pixels.
    dtype
        Of the values.
    of
        Window of the grid → values (row, column).
    threads
        Tiles computed at once.
    """

    grid: SceneGrid
    dtype: type[np.generic]
    of: Callable[[Window], NDArray[Any]]
    threads: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.shape

    def __getitem__(self, block: Window) -> NDArray[Any]:
        """Return the values of a block of rows and columns."""
        part = self.grid[block]
        values = np.empty(part.shape, self.dtype)

        def work(tile: Window) -> None:
            rows, columns = (slice(at.start + by, at.stop + by) for at, by in zip(tile, part.first, strict=True))
            values[tile] = self.of((rows, columns))

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, part.tiles(BLOCK_PX)))
        return values


def _coefficient(
    scene: OpenScene, image: xr.Dataset, calibrated: CalibratedPair, name: Quantity, *, threads: int
) -> LazyLayer:
    """Return the image whose power is σ⁰, β⁰ or γ⁰, complex64."""
    level = isinstance(scene.terrain, FlatGround) and name == "sigma0"

    def scaled(window: Window) -> NDArray[np.complex64]:
        normal = None if level else surface(scene.grid, scene.terrain, window)[1]
        per_one = calibrated.calibration.power(window, name, normal)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(image.image[window].values / np.sqrt(per_one), np.complex64)

    return LazyLayer(scene.grid, np.complex64, scaled, threads)


def _report(scene: OpenScene, image: xr.Dataset, calibrated: CalibratedPair, noise: float) -> dict[str, Any]:
    """Return what the radio says of an image, for radiometry.json."""
    found = points_of(image.image, image.attrs["quality"], scene, list(scene.grid.tiles(BLOCK_PX)))
    constant = calibrated.calibration.constant
    return {
        "calibrated_by": "the radio that the config states",
        "constant_db": round(10 * float(np.log10(constant)), 3),
        "std_db": calibrated.stated_std_db,
        "pointing_std_db": round(calibrated.pointing_std_db, 3),
        "link": asdict(calibrated.link),
        "noise": {"pulse": noise if np.isfinite(noise) else None, **calibrated.noise_report(noise)},
        "points": calibrated.points(found, scene, noise),
    }


def _rasters(
    scene: OpenScene, looks: Looks, noise: float, calibrated: CalibratedPair | None, *, threads: int
) -> dict[str, LazyLayer]:
    """Return the layers; `noise` is that of one pulse."""
    grid, terrain = scene.grid, scene.terrain

    def incidence(window: Window) -> NDArray[np.float64]:
        return _inside(looks, window, incidence_deg(*surface(grid, terrain, window), looks.centre(window)[0]))

    def bistatic_angle(window: Window) -> NDArray[np.float64]:
        angle_deg = bistatic_angle_deg(terrain.positions(grid[window]), *looks.centre(window))
        return _inside(looks, window, angle_deg)

    def nesz(window: Window) -> NDArray[np.float64]:
        if calibrated is not None:
            calibration = calibrated.calibration
            power = (noise or np.nan) * calibration.pixel_noise(window) / calibration.power(window, "sigma0", None)
            return _inside(looks, window, 10 * np.log10(power))
        effective = looks.effective(window).astype(np.float64)
        return 10 * np.log10((noise or np.nan) / np.where(effective > 0, effective, np.nan))

    return {
        "incidence": LazyLayer(grid, np.float32, incidence, threads),
        "bistatic_angle": LazyLayer(grid, np.float32, bistatic_angle, threads),
        "mask": LazyLayer(grid, np.uint8, _mask(scene, looks), threads),
        "looks": LazyLayer(grid, np.float32, looks.effective, threads),
        "nesz": LazyLayer(grid, np.float32, nesz, threads),
    }


def _inside(looks: Looks, window: Window, values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(looks.illuminated(window), values, np.nan)


def _mask(scene: OpenScene, looks: Looks) -> Callable[[Window], NDArray[np.uint8]]:
    """Return the mask of a window, each pixel by the pulses that form the nearest node of the lattice."""
    level = isinstance(scene.terrain, FlatGround)
    relief = None if level else Relief.of(scene.grid, scene.terrain, scene.level.height_m)

    def mask(window: Window) -> NDArray[np.uint8]:
        illuminated = looks.illuminated(window)
        marked = np.where(illuminated, 0, OUTSIDE).astype(np.uint8)
        if relief is None or not illuminated.any():
            return marked
        for node, part in looks.lattice.nearest(window):
            here = tuple(slice(at.start - by.start, at.stop - by.start) for at, by in zip(part, window, strict=True))
            if illuminated[here].any():
                tx, rx = (relief.above(leg) for leg in looks.aperture[looks.pulses[node].astype(np.int64)].legs)
                marked[here] = np.where(illuminated[here], visibility(relief, tx, rx, part), OUTSIDE)
        return marked

    return mask
