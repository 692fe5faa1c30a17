"""Hand-off of a stack to InSAR time series software: images, mask, geometry and configuration of dolphin."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from rasterio import Affine
from scipy.stats import chi2

from apertura.campaign.folder import Campaign
from apertura.campaign.store import check_listed, open_listed
from apertura.common.atomic import replacement, write_json, write_text
from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.formats.export.cog import Band, only, write_cog
from apertura.methods.interferometry.coherence import map_coherence
from apertura.methods.interferometry.heights import phase_std
from apertura.stages.agreement import opened_layer
from apertura.stages.scene import open_scene
from apertura.stages.stack import STACK_JSON
from apertura.workflow.rules import STACK

DATE_FORMAT = "%Y%m%dT%H%M%S"
"""Start of an acquisition in file names, UTC; several flights of a day differ in the time."""

HANDOFF = "handoff.json"
"""Description of an exported stack, for `apertura export time-series`."""

GEOMETRY = ("line_of_sight_enu.tif", "slant_range_distance.tif")
"""Layers of the reference flight that are copied."""

_STRIDES_PER_WINDOW = 5
"""Output pixels of dolphin along the averaging window: neighbouring output pixels share most of their samples."""

_PS_DISPERSION = 0.25  # default of dolphin: largest amplitude dispersion that approximates the phase deviation, rad
_PS_CHANCE = 0.01  # probability that a pixel is selected whose dispersion is that of a window

_HEIGHT = Band("float32", np.nan, "m", "terrain height in the CRS of the scene", "AVERAGE", smooth=True)
_GOOD = Band("uint8", 255, "class", "1 valid in all flights of the stack, 0 invalid", "MODE")


def write_stack(campaign: Campaign, out: Path) -> list[Path]:
    """Write the stack of a campaign in the layout that dolphin reads; return the paths of the files.

    Parameters
    ----------
    campaign
        Campaign with a finished stack.
    out
        Folder to write: `slc/<time>.slc.tif`, `mask.tif`, `geometry/`, `dolphin_config.yaml`, `handoff.json`.

    Raises
    ------
    CampaignError
        If the stack is missing, has fewer than two flights, or two flights begin in the same second.
    """
    requested = campaign.settings.stack
    if requested is None:
        remedy = "Add the section stack, then run the workflow."
        raise CampaignError("no stack is configured", "config/config.yaml: stack", "a section stack", remedy)
    flights, scene = _flights(campaign), open_scene(campaign)
    grid, window = scene.grid, requested.window_px
    tiles = list(grid.tiles(campaign.settings.processing.tile_px))
    reference, tags = _image(campaign, requested.reference)
    written, similarity = list[Path](), np.ones(grid.shape, np.float32)
    for one in flights:
        flight, target = one["flight"], out / "slc" / f"{one['time']}.slc.tif"
        written.append(_copied(campaign, flight, "slc.tif", target))
        with opened_layer(campaign, flight, requested.pair, "mask.tif") as visible:
            similarity[visible.read(1) != 0] = np.nan
        if flight != requested.reference:
            magnitude, phase, _, _ = map_coherence(_image(campaign, flight)[0], reference, tiles, window=window)
            similarity = np.minimum(similarity, magnitude * np.cos(phase))  # NaN if either is
    written += [_copied(campaign, requested.reference, name, out / "geometry" / name) for name in GEOMETRY]
    placed: dict[str, Any] = {"transform": Affine(*grid.transform), "crs": grid.crs_wkt, "tags": {}}
    height = np.broadcast_to(scene.terrain.heights(grid), grid.shape).astype(np.float32)
    good = np.isfinite(similarity).astype(np.uint8)
    for name, raster, band in (("geometry/height.tif", height, _HEIGHT), ("mask.tif", good, _GOOD)):
        written.append(out / name)
        write_cog(written[-1], raster, band, value=only(band.dtype), **placed)
    wavelength_m, stride = float(tags["APERTURA_WAVELENGTH_M"]), max(1, window // _STRIDES_PER_WINDOW)
    # The cells of dolphin have their centres at these pixels. The best reference is coherent and has not moved.
    cells = np.nan_to_num(similarity[stride // 2 :: stride, stride // 2 :: stride], nan=-1.0)
    row, column = map(int, np.unravel_index(cells.argmax(), cells.shape))
    names = [path.relative_to(out).as_posix() for path in written if path.parent.name == "slc"]
    std_rad = float(np.median([one["phase_std_rad"] for one in flights if one["phase_std_rad"] is not None]))
    config = dolphin_config(
        names, wavelength_m, window_px=window, stride=stride, phase_std_rad=std_rad, reference_point=(row, column)
    )
    note = (
        "# Run in this folder: dolphin run dolphin_config.yaml\n"
        "# Displacements in dolphin/timeseries are metres along the line of sight, positive towards the sensor.\n"
    )
    write_text(out / "dolphin_config.yaml", note + yaml.safe_dump(config, sort_keys=False))
    write_json(
        out / HANDOFF,
        {
            "campaign": campaign.settings.campaign,
            "pair": requested.pair,
            "wavelength_m": wavelength_m,
            "heading_deg": float(tags.get("APERTURA_HEADING_DEG", 0.0)),
            "reference_point_m": grid.map_at((row + 0.5) * stride - 0.5, (column + 0.5) * stride - 0.5).tolist(),
            "flights": flights,
        },
    )
    return [*written, out / "dolphin_config.yaml", out / HANDOFF]


def dolphin_config(
    images: Sequence[str],
    wavelength_m: float,
    *,
    window_px: int,
    stride: int,
    phase_std_rad: float,
    reference_point: tuple[int, int],
) -> dict[str, Any]:
    """Return the configuration of dolphin's displacement workflow; options not listed keep their defaults.

    A persistent scatterer keeps its own phase instead of that of its window. The amplitude dispersion of a pixel
    approximates the standard deviation σ of its phase, radians, which shall not exceed that of a window. The dispersion
    D of n images is an estimate, n D²/σ² being distributed as χ² with n - 1 degrees of freedom: the limit of D is
    the quantile at which 1 % of the pixels with the deviation of a window are selected by chance.

    Parameters
    ----------
    images
        Paths of the images, relative to the working folder.
    wavelength_m
        Wavelength at the centre frequency.
    window_px, stride
        Side of the averaging window, and output spacing, pixels.
    phase_std_rad
        Standard deviation of the phase of a window.
    reference_point
        Row and column of the reference point in the output.

    Examples
    --------
    >>> config = dolphin_config(
    ...     5 * ["a.tif"], 0.25, window_px=15, stride=3, phase_std_rad=0.05, reference_point=(4, 5)
    ... )
    >>> config["phase_linking"]["half_window"], config["ps_options"]["amp_dispersion_threshold"]
    ({'x': 7, 'y': 7}, 0.0122)
    """
    count = len(images)
    dispersion = min(_PS_DISPERSION, phase_std_rad * np.sqrt(chi2.ppf(_PS_CHANCE, count - 1) / count))
    return {
        "input_options": {"cslc_date_fmt": DATE_FORMAT, "wavelength": wavelength_m},
        "cslc_file_list": list(images),
        "mask_file": "mask.tif",
        "work_directory": "dolphin",
        "output_options": {"strides": {"x": stride, "y": stride}},
        "ps_options": {"amp_dispersion_threshold": round(float(dispersion), 4)},
        "phase_linking": {"half_window": {"x": window_px // 2, "y": window_px // 2}},
        "interferogram_network": {"max_bandwidth": 2},
        "unwrap_options": {"unwrap_method": "snaphu"},
        "timeseries_options": {"reference_point": list(reference_point)},
    }


def _flights(campaign: Campaign) -> list[dict[str, Any]]:
    """Return the flights of the stack that are used, by time, as listed in `HANDOFF`.

    Each has its name, the start of its acquisition in `DATE_FORMAT`, its baselines to the reference flight, and the
    standard deviation of the phase of a window against that flight (None for the reference itself).
    """
    folder = campaign.result(STACK)
    flights = []
    for name in open_listed(folder / STACK_JSON, folder / "stack.manifest.json")["flights"]:
        report = open_listed(folder / name / STACK_JSON, folder / name / "stack_image.manifest.json")
        start = np.datetime64(report["acquisition"]["start_utc"].removesuffix("Z"), "s")
        coherence, looks = report["coherence"], report["looks"]
        std_rad = None if looks is None else float(phase_std(np.array([coherence], np.float32), looks)[0])
        flights.append(
            {
                "flight": name,
                "time": start.item().strftime(DATE_FORMAT),
                "perpendicular_baseline_m": report["perpendicular_baseline_m"] or 0.0,
                "temporal_baseline_days": report["temporal_baseline_days"],
                "phase_std_rad": std_rad,
            }
        )
    flights.sort(key=lambda one: str(one["time"]))
    times = [one["time"] for one in flights]
    if len(set(times)) < max(2, len(times)):
        raise CampaignError(
            f"flights at {', '.join(times)}",
            where="results/stack/stack.json",
            expected="two or more flights that start in different seconds",
            remedy="Correct stack.flights, or the times of the recordings.",
        )
    return flights


def _image(campaign: Campaign, flight: str) -> tuple[NDArray[np.complex64], dict[str, str]]:
    """Return the image of a flight of the stack, (y, x) complex64, and its tags."""
    expected, remedy = "a raster of the workflow", "Run the workflow again."
    with opened_raster(campaign.result(STACK, flight, "slc.tif"), expected=expected, remedy=remedy) as raster:
        return raster.read(1), raster.tags()


def _copied(campaign: Campaign, flight: str, name: str, target: Path) -> Path:
    """Copy a raster of the stack, checked against its manifest."""
    source = campaign.result(STACK, flight, name)
    check_listed(source, source.with_name("stack_image.manifest.json"))
    with replacement(target) as temporary:
        temporary.write_bytes(source.read_bytes())
    return target
