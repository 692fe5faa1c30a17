"""Rules `export` and `export_fused`: rasters, plots and report of one image, or of the sums of a flight's images."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.windows
import xarray as xr
from rasterio import Affine

from apertura.campaign.config import FUSED
from apertura.campaign.config.processing import Multilooking
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, open_stage, record_files
from apertura.common.arrays import Floats
from apertura.common.atomic import write_json, write_text
from apertura.common.contracts import Window
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance, chained_sha256
from apertura.common.raster import opened_raster
from apertura.common.units import decibels
from apertura.core.combination import InPhase, in_phase
from apertura.core.quality.budget import NO_EFFECT, BudgetLine
from apertura.core.quality.focus import DEFOCUSED_DB, focus_with_flags, verdict_of_loss
from apertura.core.quality.measures import Amplitude, BlockRaster, held, image_statistics
from apertura.core.quality.point_targets import CUT_REACH_M, cuts_report, find_peak
from apertura.core.scene.grid import SceneGrid
from apertura.formats.catalog import DOCUMENTS
from apertura.formats.catalog.ceos_ard import PAGE, SHEET, ImageFiles, ceos_ard_page, ceos_ard_sheet
from apertura.formats.export import product, remove_outdated, write_exports
from apertura.formats.export.radiometry import CROSS_SECTIONS, ECHO, of_sums
from apertura.stages.agreement import ComparedImage, assessment_of, bright_points_within, sum_of
from apertura.stages.image_tags import acquisition_tags, angle_tags, quality_tags
from apertura.stages.multilook import LazyLayer, coarse, mean_power_report, multilook_of
from apertura.stages.scene import settled_scene
from apertura.stages.tags import tags_of
from apertura.workflow.lineage import result_of


def export(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> list[Path]:
    """Write the products of one pair, or of 'fused', and image.json; return their paths."""
    with rasterio.Env(GDAL_NUM_THREADS=threads):
        return export_fused(campaign, flight) if pair == FUSED else export_pair(campaign, flight, pair)


def export_pair(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write the products of one pair, and image.json; return their paths."""
    lineage = result_of(campaign, "export", flight, pair).begin(campaign.root)
    image = open_stage(campaign.stage("image", flight, pair), "image")
    assessed = assessment_of(campaign, flight)
    agreed, quality = assessed["pairs"][pair], image.attrs["quality"]
    peak = quality["brightest"]["amplitude"]
    report = quality | {
        "reference": assessed["reference"],
        "agreement": agreed["agreement"],
        "hypotheses": assessed["hypotheses"],
        "flags": Flags.merged(image.attrs["flags"], agreed["flags"]),
        "radiometry": {"image": ECHO.measured(peak, quality["noise_floor_db"]).report},
    }
    if campaign.calibrated:
        report |= _calibrated(campaign, flight, pair, report)
    report["focus"] = focus_with_flags(quality["focus"], report["flags"], error_db=report["numerical_error_db"])
    origin = Provenance.of(lineage.modules, [image])
    origin = replace(origin, code_sha256=chained_sha256(origin.code_sha256, [assessed["code_sha256"]]))
    folder, title = campaign.result(flight, pair), f"{campaign.settings.campaign} · flight {flight} · {pair}"
    written = write_exports(
        "pair",
        folder,
        {"image": held(image.image)},
        radiometry=report["radiometry"],
        titles={"image": title},
        tags=tags_of(origin, lineage)
        | quality_tags(report)
        | acquisition_tags(campaign, {(flight, pair): quality["view"]})
        | angle_tags(campaign, flight, [pair]),
        **_georeference(settled_scene(campaign).grid),
    )
    return _finish(folder, written, title, {"flight": flight, "pair": pair, **report}, lineage)


def _calibrated(campaign: Campaign, flight: str, pair: str, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the radiometric part of a report: cross-sections of points, budget lines, flags."""
    manifest = campaign.root / campaign.manifest("layers", flight, pair)
    calibration = open_listed(campaign.result(flight, pair, CROSS_SECTIONS), manifest)
    std_db = calibration["std_db"]
    stated = None if std_db is None else f"{std_db:.2g} dB"
    lines = [BudgetLine("amplitude", stated, NO_EFFECT, "an error of power or gain")]
    if calibration["pointing_std_db"]:
        pointing = f"{calibration['pointing_std_db']:.2g} dB from the attitude"
        lines.insert(0, BudgetLine("pointing", pointing, NO_EFFECT))
    flags = Flags.merged(report["flags"], calibration["flags"])
    return {
        "cross_sections": calibration,
        "budget": [*report["budget"], *(line.report for line in lines)],
        "flags": flags,
    }


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the products of the sums of a flight's pairs, and image.json; return their paths."""
    lineage = result_of(campaign, "fused", flight).begin(campaign.root)
    pairs, assessed = campaign.flight(flight).pairs, assessment_of(campaign, flight)
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    sums: dict[str, BlockRaster] = {
        "coherent": held(sum_of(images, assessed, "coherent")),
        "noncoherent": held(Amplitude(sum_of(images, assessed, "noncoherent"))),
    }
    folder, grid = campaign.result(flight, FUSED), settled_scene(campaign).grid
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    measured, isolated = _in_phase(images, assessed, sums["noncoherent"], grid, windows)
    at_points = measured if isolated else None
    added = assessed["fusion"]["phases_rad"]
    pair_flags = {
        pair: Flags.merged(image.attrs["flags"], assessed["pairs"][pair]["flags"]) for pair, image in images.items()
    }
    sum_flags = Flags.merged(
        _flags_of_choice(assessed["fusion"]), _incoherent(at_points), assessed["first_flight"].get("flags", {})
    )
    # Flags of pairs outside the coherent sum do not affect the focus of the sum.
    relevant = {*sum_flags, *(flag for pair in added for flag in pair_flags[pair])}
    worst = _worst(images, assessed["fusion"])
    focuses = [images[pair].attrs["quality"]["focus"] for pair in added]
    geolocation = {name: max(focus.get(name, 0.0) for focus in focuses) for name in ("cell_m", "expected_shift_m")}
    report = {
        **worst,
        "focus": focus_with_flags(
            _focus(images, at_points, [*added]) | geolocation, relevant, error_db=worst["numerical_error_db"]
        ),
        **_measures(grid, windows, sums, images, assessed),
        "fusion": assessed["fusion"],
        "coherence": {
            "mean": None if measured is None else round(measured.coherence, 4),
            "std": None if measured is None else round(measured.std, 4),
            "chance": round(1 / len(added), 4),
            "pairs": len(added),
            "points": 0 if measured is None else measured.places,
            "isolated": isolated,
        },
        "agreement": assessed["first_flight"].get("agreement"),
        "flags": Flags.merged(_flags_of_pairs(pair_flags), sum_flags),
    }
    name = f"{campaign.settings.campaign} · flight {flight}"
    titles = {
        "coherent": f"coherent sum of {' + '.join(added)}",
        "noncoherent": f"non-coherent sum of {' + '.join(pairs)}",
        "magnitude": f"sum of magnitudes of {' + '.join(pairs)}",
    }
    origin = Provenance.of(lineage.modules, images, settings={"fusion": assessed["fusion"]})
    code_sha256 = chained_sha256(origin.code_sha256, [assessed["code_sha256"]])
    tags = tags_of(replace(origin, code_sha256=code_sha256), lineage) | quality_tags(report)
    tags |= acquisition_tags(
        campaign, {(flight, pair): image.attrs["quality"]["view"] for pair, image in images.items()}
    )
    tags |= angle_tags(campaign, flight, pairs)
    written = write_exports(
        "fused",
        folder,
        {**sums, "magnitude": sum_of(images, assessed, "magnitude")},
        radiometry=report["radiometry"],
        titles={source: f"{name} · {title}" for source, title in titles.items()},
        tags=tags,
        **_georeference(grid),
    )
    if multilook := campaign.settings.processing.multilook:
        for source, raster in sums.items():
            noise = _noise_of_sum(campaign, flight, source, report["radiometry"][source]["divided_by"])
            layer, power_report = _averaged_sum(raster, grid, multilook, report["radiometry"][source], noise)
            written += write_exports(
                "multilook_fused",
                folder,
                {f"multilook_{source}": held(layer)},
                radiometry={f"multilook_{source}": power_report},
                titles={f"multilook_{source}": f"{name} · mean power of the {titles[source]}"},
                tags=tags,
                **_georeference(layer.grid),
            )
    remove_outdated(folder, written)
    return _finish(folder, written, f"{name} · sums", {"flight": flight, "pairs": list(pairs), **report}, lineage)


def _averaged_sum(
    raster: BlockRaster,
    grid: SceneGrid,
    multilook: Multilooking,
    means: Mapping[str, Any],
    noise: Callable[[Window], Floats] | None,
) -> tuple[LazyLayer, dict[str, Any]]:
    """Return the mean power of a sum on a coarser grid, minus the noise, and its radiometric report."""
    cells = multilook_of(lambda window: np.asarray(raster[window], np.complex64), grid, multilook)

    def without_noise(window: Window) -> Floats:
        return cells.mean(window) - (0.0 if noise is None else noise(window))

    report = mean_power_report(cells, means, noise="in it" if noise is None else "subtracted")
    return coarse(grid, cells, threads=1, of=without_noise), report


def _noise_of_sum(
    campaign: Campaign, flight: str, source: str, divisors: Mapping[str, float]
) -> Callable[[Window], Floats] | None:
    """Return the mean noise power in multilook cells of a sum; None if the noise is not subtracted or not known.

    Source: docs/theory/speckle.md, eq. 6.
    """
    multilook, kept = campaign.settings.processing.multilook, product("multilook_noise", "write_mean_power").file
    paths = [campaign.result(flight, pair, kept) for pair in divisors]
    if multilook is None or not multilook.subtract_noise or not all(path.is_file() for path in paths):
        return None
    # Noise is independent between pairs: powers add up, divided by n² in a mean of n amplitudes, by n in a mean of n
    # powers.
    count = len(divisors) ** (2 if source == "coherent" else 1)

    def noise(window: Window) -> Floats:
        total = np.zeros([part.stop - part.start for part in window])
        for path, divisor in zip(paths, divisors.values(), strict=True):
            with opened_raster(path, expected="a raster of step layers", remedy="Run the workflow again.") as layer:
                power = layer.read(1, window=rasterio.windows.Window.from_slices(*window)).astype(np.float64)
            total += np.nan_to_num(power) / divisor**2 / count
        return total

    return noise


def _finish(folder: Path, written: list[Path], title: str, report: Mapping[str, Any], lineage: Lineage) -> list[Path]:
    """Write image.json and the CEOS-ARD sheet next to the products, then the manifest of all files."""
    files = [*written, *(folder / name for name in DOCUMENTS)]
    write_json(folder / "image.json", report)
    sheet = ceos_ard_sheet(ImageFiles(folder, report), title)
    write_json(folder / SHEET, sheet)
    write_text(folder / PAGE, ceos_ard_page(sheet))
    record_files(folder / "export.manifest.json", files, lineage)
    return files


def _georeference(grid: SceneGrid) -> dict[str, Any]:
    return {"transform": Affine(*grid.transform), "crs": grid.crs_wkt}


def _measures(
    grid: SceneGrid,
    windows: Sequence[Window],
    sums: Mapping[str, BlockRaster],
    images: Mapping[str, xr.Dataset],
    assessed: Mapping[str, Any],
) -> dict[str, Any]:
    """Return image statistics of the sums, cuts through the brightest target, and the gain over the best pair."""
    statistics = {source: image_statistics(layer, windows) for source, layer in sums.items()}
    peaks = {pair: image.attrs["quality"]["brightest"]["amplitude"] for pair, image in images.items()}
    radiometry, top = of_sums(peaks, assessed["fusion"]["phases_rad"]), statistics["coherent"]
    peak = find_peak(sums["coherent"], top.row, top.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    peaks = {source: measured.peak for source, measured in statistics.items()} | {"coherent": float(abs(peak.value))}
    levels = {
        source: radiometry[source].measured(peaks[source], measured.noise_floor_db)
        for source, measured in statistics.items()
    }
    along = images[assessed["reference"]].attrs["quality"]["brightest"]["cross_range_direction"]
    floors = {pair: images[pair].attrs["quality"]["noise_floor_db"] for pair in assessed["fusion"]["phases_rad"]}
    best = min(floors, key=lambda pair: floors[pair])
    return {
        "radiometry": {source: scale.report for source, scale in {**radiometry, **levels}.items()},
        "entropy": {source: round(measured.entropy, 6) for source, measured in statistics.items()},
        "noise_floor_db": top.noise_floor_db,
        "gain": {
            "best_pair": best,
            "over_best_pair_db": round(floors[best] - top.noise_floor_db, 2),
            "allowed_db": round(decibels(len(floors)), 2),
        },
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "cross_range_direction": along,
            **cuts_report(
                sums["coherent"],
                peak,
                cross_range=(along[0], along[1]),
                spacing_m=grid.spacing_m,
                reach_m=CUT_REACH_M,
            ),
        },
    }


def _in_phase(
    images: Mapping[str, xr.Dataset],
    assessed: Mapping[str, Any],
    noncoherent: BlockRaster,
    grid: SceneGrid,
    windows: Sequence[Window],
) -> tuple[InPhase | None, bool]:
    """Measure the phase agreement of the summed images at bright points of the noncoherent sum.

    The first value is None for a single image. The second value is True if the points are isolated and present in all
    images. If there are no such points, the brightest pixels are used; phases of images need not agree in cells with
    several scatterers.
    """
    added = assessed["fusion"]["phases_rad"]
    compared = {pair: ComparedImage.of(images[pair], grid, windows) for pair in added}
    cell_m = max(image.cell_m for image in compared.values())
    spectrum = np.mean([image.spectrum for image in compared.values()], axis=0)
    points = [
        point
        for point in bright_points_within(noncoherent, grid, windows, spectrum, cell_m=cell_m)
        if all(image.shows(point) for image in compared.values())
    ]
    isolated = bool(points)
    points = points or bright_points_within(noncoherent, grid, windows, spectrum, cell_m=cell_m, isolated=False)
    divisors = {
        pair: images[pair].attrs["quality"]["brightest"]["amplitude"] * np.exp(1j * phase_rad)
        for pair, phase_rad in added.items()
    }
    amplitudes = [
        [compared[pair].at(point.row, point.column) / divisor for pair, divisor in divisors.items()] for point in points
    ]
    if len(added) == 1 or not points:
        return None, isolated
    return in_phase(np.array(amplitudes), np.array([point.background for point in points])), isolated


def _focus(images: Mapping[str, xr.Dataset], measured: InPhase | None, added: Sequence[str]) -> dict[str, Any]:
    """Return the focus of the coherent sum, from the peak loss of its images and the loss due to phase differences."""
    pair_focus = {pair: images[pair].attrs["quality"]["focus"] for pair in added}
    if len(added) == 1:
        focus = pair_focus[added[0]]
        return {name: focus[name] for name in ("verdict", "loss_db", "std_db") if name in focus} | {
            "reason": f"{added[0]} alone: {focus['reason']}"
        }
    focuses = [focus for focus in pair_focus.values() if "loss_db" in focus]
    if measured is None or not focuses:
        missing = (
            "no isolated bright point is common to the summed pairs"
            if measured is None
            else "the focus of no pair was measured"
        )
        return {"verdict": "inconclusive", "reason": missing}
    # Images are normalised to equal peaks before they are added; if focused, each peak is higher by its loss.
    image_loss_db = -20 * float(np.log10(np.mean([10 ** (-focus["loss_db"] / 20) for focus in focuses])))
    loss_db = image_loss_db + measured.loss_db
    std_db = float(np.hypot(np.mean([focus["std_db"] for focus in focuses]), measured.loss_std_db))
    return {
        "verdict": verdict_of_loss(loss_db, std_db),
        "loss_db": round(loss_db, 3),
        "std_db": round(std_db, 3),
        "reason": (
            f"peak loss of the coherent sum, {number_of(measured.places, 'bright point')}: {abs(loss_db):.2f} ± "
            f"{std_db:.2f} dB ({abs(measured.loss_db):.2f} dB from phase differences between pairs)"
        ),
    }


def _incoherent(measured: InPhase | None) -> dict[str, str]:
    """Return the flag of a sum whose images are not in phase at bright points."""
    if measured is None or measured.loss_db >= DEFOCUSED_DB - 2 * measured.loss_std_db:
        return {}
    line = (
        f"{measured.coherence:.2f} ± {measured.std:.2f} of the pairs' power is in phase at "
        f"{number_of(measured.places, 'bright point')} ({measured.chance:.2f} expected for random phases): peak loss "
        f"of the sum {abs(measured.loss_db):.1f} dB"
    )
    return {"sum_incoherent": line}


def _flags_of_pairs(pair_flags: Mapping[str, Mapping[str, str]]) -> Flags:
    """Merge the flags of all pairs; a line that only some pairs have is prefixed with their names."""
    raised: dict[tuple[str, str], list[str]] = {}
    for pair, flags in pair_flags.items():
        for flag in flags.items():
            raised.setdefault(flag, []).append(pair)
    return Flags.merged(
        *(
            {name: line if len(pairs) == len(pair_flags) else f"{' and '.join(pairs)}: {line}"}
            for (name, line), pairs in raised.items()
        )
    )


def _flags_of_choice(fusion: Mapping[str, Any]) -> Flags:
    """Return the flags of the choice of a coherent sum: excluded pairs, and pairs added with an unmeasured phase."""
    excluded = "; ".join(f"{pair} is not in the coherent sum: {reason}" for pair, reason in fusion["excluded"].items())
    if ties := " or ".join(" and ".join(tie) for tie in fusion["ties"]):
        excluded += f"; {ties} form an equally large set of pairs that agree, but the used set is better focused"
    flags = {"pair_excluded": excluded} if excluded else {}
    if unmeasured := fusion["unmeasured"]:
        known, unknown = len(fusion["phases_rad"]) - len(unmeasured), len(unmeasured)
        loss_db = [-20 * np.log10(abs(known + phasor * unknown) / (known + unknown) + 1e-3) for phasor in (1j, -1)]
        half_cycle = f"{loss_db[1]:.0f} dB" if known != unknown else "total, with each target split in two"
        flags["phase_unobservable"] = (
            "; ".join(f"{pair} is added with phase 0: {reason}" for pair, reason in unmeasured.items())
            + f"; peak loss for a phase error of a quarter cycle: {loss_db[0]:.0f} dB, of half a cycle: {half_cycle}"
        )
    return Flags(flags)


def _worst(images: Mapping[str, xr.Dataset], fusion: Mapping[str, Any]) -> dict[str, Any]:
    """Return the largest errors of the images, reported for their sum, and the error budget of each image."""
    qualities = [image.attrs["quality"] for image in images.values()]
    worst = max(qualities, key=lambda quality: quality["numerical_error_db"])
    without = "".join(f"; without {pair}: {reason}" for pair, reason in fusion["excluded"].items())
    return {
        "budgets": {pair: image.attrs["quality"]["budget"] for pair, image in images.items()},
        "models": {
            "fusion": f"mean of the peak-normalised images, with and without phase{without}",
            "numerical_error": "largest numerical error of the pairs",
        },
        "numerical_error_db": worst["numerical_error_db"],
        "numerical_error_confidence": round(1 - sum(1 - one["numerical_error_confidence"] for one in qualities), 4),
        "numerical_error_estimate_db": worst["numerical_error_estimate_db"],
        "instruction_set": ", ".join(sorted({quality["instruction_set"] for quality in qualities})),
        "recomputed": [one for quality in qualities for one in quality["recomputed"]],
    }
