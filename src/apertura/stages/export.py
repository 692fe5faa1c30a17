"""Rules `export` and `export_fused`: rasters, pictures and report of one image, or of the sums of a flight's images."""

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
from apertura.common.atomic import write_json
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
from apertura.formats.export import product, remove_outdated, write_exports
from apertura.formats.export.radiometry import CROSS_SECTIONS, ECHO, of_sums
from apertura.stages.agreement import ComparedImage, assessment_of, bright_places
from apertura.stages.multilook import LazyLayer, coarse, mean_power_report, multilook_of
from apertura.stages.scene import settled_scene
from apertura.stages.tags import acquisition_tags, quality_tags, tags_of
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
    folder = campaign.result(flight, pair)
    written = write_exports(
        "pair",
        folder,
        {"image": held(image.image)},
        radiometry=report["radiometry"],
        titles={"image": f"{campaign.settings.campaign} · flight {flight} · {pair}"},
        tags=tags_of(origin, lineage) | quality_tags(report) | acquisition_tags(campaign, {pair: quality["view"]}),
        **_georeference(settled_scene(campaign).grid),
    )
    return _finish(folder, written, {"flight": flight, "pair": pair, **report}, lineage)


def _calibrated(campaign: Campaign, flight: str, pair: str, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the radiometric part of a report: cross-sections of points, budget lines, flags."""
    manifest = campaign.root / campaign.manifest("layers", flight, pair)
    calibration = open_listed(campaign.result(flight, pair, CROSS_SECTIONS), manifest)
    std_db = calibration["std_db"]
    stated = None if std_db is None else f"{std_db:.2g} dB"
    lines = [BudgetLine("amplitude", stated, NO_EFFECT, "an error of power or gain")]
    if calibration["pointing_std_db"]:
        lines.insert(0, BudgetLine("pointing", f"{calibration['pointing_std_db']:.2g} dB by attitude", NO_EFFECT))
    flags = Flags.merged(report["flags"], calibration["flags"])
    return {
        "cross_sections": calibration,
        "budget": [*report["budget"], *(one.report for one in lines)],
        "flags": flags,
    }


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the products of the sums of a flight's pairs, and image.json; return their paths."""
    lineage = result_of(campaign, "fused", flight).begin(campaign.root)
    cube = open_stage(campaign.stage("cube"), "cube")
    index = cube.attrs["flights"].index(flight)
    sums: dict[str, BlockRaster] = {
        "coherent": held(cube.coherent[index]),
        "noncoherent": held(Amplitude(cube.noncoherent[index])),
    }
    pairs, assessed = campaign.flight(flight).pairs, assessment_of(campaign, flight)
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    folder, grid = campaign.result(flight, FUSED), settled_scene(campaign).grid
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    measured, isolated = _in_phase(images, assessed, sums["noncoherent"], grid, windows)
    at_points = measured if isolated else None
    added = assessed["fusion"]["phases_rad"]
    of_pairs = {
        pair: Flags.merged(image.attrs["flags"], assessed["pairs"][pair]["flags"]) for pair, image in images.items()
    }
    of_sum = Flags.merged(
        _flags_of_choice(assessed["fusion"]), _incoherent(at_points), cube.attrs["flags"].get(flight, {})
    )
    against = {*of_sum, *(flag for pair in added for flag in of_pairs[pair])}  # of pairs left out, none
    worst = _worst(images, assessed["fusion"])
    focuses = [images[pair].attrs["quality"]["focus"] for pair in added]
    places = {name: max(one.get(name, 0.0) for one in focuses) for name in ("cell_m", "expected_shift_m")}
    report = {
        **worst,
        "focus": focus_with_flags(
            _focus(images, at_points, [*added]) | places, against, error_db=worst["numerical_error_db"]
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
        "agreement": cube.attrs["agreement"]["flights"].get(flight),
        "flags": Flags.merged(_flags_of_pairs(of_pairs), of_sum),
    }
    name = f"{campaign.settings.campaign} · flight {flight}"
    titles = {
        "coherent": f"coherent sum of {' + '.join(added)}",
        "noncoherent": f"non-coherent sum of {' + '.join(pairs)}",
        "magnitude": f"sum of magnitudes of {' + '.join(pairs)}",
    }
    # the cube depends on every flight, its files of one flight on that flight's pairs alone
    origin = Provenance.of(lineage.modules, images, settings={"fusion": assessed["fusion"]})
    code_sha256 = chained_sha256(lineage.result.code_sha256, [cube.attrs["code_sha256"]])
    tags = tags_of(replace(origin, code_sha256=code_sha256), lineage) | quality_tags(report)
    tags |= acquisition_tags(campaign, {pair: image.attrs["quality"]["view"] for pair, image in images.items()})
    written = write_exports(
        "fused",
        folder,
        {**sums, "magnitude": cube.magnitude[index]},
        radiometry=report["radiometry"],
        titles={source: f"{name} · {words}" for source, words in titles.items()},
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
    return _finish(folder, written, {"flight": flight, "pairs": list(pairs), **report}, lineage)


def _averaged_sum(
    raster: BlockRaster,
    grid: SceneGrid,
    multilook: Multilooking,
    means: Mapping[str, Any],
    noise: Callable[[Window], Floats] | None,
) -> tuple[LazyLayer, dict[str, Any]]:
    """Return the mean power of a sum on a coarser grid, less its noise, and what it means."""
    cells = multilook_of(lambda window: np.asarray(raster[window], np.complex64), grid, multilook)

    def less(window: Window) -> Floats:
        return cells.mean(window) - (0.0 if noise is None else noise(window))

    report = mean_power_report(cells, means, noise="in it" if noise is None else "subtracted")
    return coarse(grid, cells, threads=1, of=less), report


def _noise_of_sum(
    campaign: Campaign, flight: str, source: str, divisors: Mapping[str, float]
) -> Callable[[Window], Floats] | None:
    """Return the mean power of the noise in squares of pixels of a sum; None where it is not taken off or not known.

    Source: docs/theory/speckle.md, eq. 6.
    """
    multilook, kept = campaign.settings.processing.multilook, product("multilook_noise", "write_mean_power").file
    paths = [campaign.result(flight, pair, kept) for pair in divisors]
    if multilook is None or not multilook.subtract_noise or not all(path.is_file() for path in paths):
        return None
    # Noise of pairs is independent: powers add up, over n² where amplitudes are averaged and over n where powers are.
    count = len(divisors) ** (2 if source == "coherent" else 1)

    def noise(window: Window) -> Floats:
        total = np.zeros([part.stop - part.start for part in window])
        for path, divisor in zip(paths, divisors.values(), strict=True):
            with opened_raster(path, expected="what step layers wrote", remedy="Run the workflow again.") as one:
                part = one.read(1, window=rasterio.windows.Window.from_slices(*window)).astype(np.float64)
            total += np.nan_to_num(part) / divisor**2 / count
        return total

    return noise


def _finish(folder: Path, written: list[Path], report: Mapping[str, Any], lineage: Lineage) -> list[Path]:
    """Write image.json beside the products, then the manifest of all."""
    files = [*written, folder / "image.json"]
    write_json(files[-1], report)
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
    """Return the image statistics of the sums, cuts through the brightest target, and what is gained over one pair."""
    statistics = {source: image_statistics(layer, windows) for source, layer in sums.items()}
    peaks = {pair: image.attrs["quality"]["brightest"]["amplitude"] for pair, image in images.items()}
    radiometry, top = of_sums(peaks, assessed["fusion"]["phases_rad"]), statistics["coherent"]
    peak = find_peak(sums["coherent"], top.row, top.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    peaks = {source: one.peak for source, one in statistics.items()} | {"coherent": float(abs(peak.value))}
    levels = {
        source: radiometry[source].measured(peaks[source], one.noise_floor_db) for source, one in statistics.items()
    }
    along = images[assessed["reference"]].attrs["quality"]["brightest"]["cross_range_direction"]
    floors = {pair: images[pair].attrs["quality"]["noise_floor_db"] for pair in assessed["fusion"]["phases_rad"]}
    best = min(floors, key=lambda pair: floors[pair])
    return {
        "radiometry": {source: one.report for source, one in {**radiometry, **levels}.items()},
        "entropy": {source: round(one.entropy, 6) for source, one in statistics.items()},
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
    places: BlockRaster,
    grid: SceneGrid,
    windows: Sequence[Window],
) -> tuple[InPhase | None, bool]:
    """Measure the phase agreement of the summed images at bright places of the noncoherent sum; None of one image.

    And whether these are isolated points that all of them show. Without any, the brightest places are taken: of many
    scatterers in a cell each image has its own sum, and the phases need not agree.
    """
    added = assessed["fusion"]["phases_rad"]
    shown = {pair: ComparedImage.of(images[pair], grid, windows) for pair in added}
    cell_m = max(image.cell_m for image in shown.values())
    spectrum = np.mean([image.spectrum for image in shown.values()], axis=0)
    points = [
        point
        for point in bright_places(places, grid, windows, spectrum, cell_m=cell_m)
        if all(image.shows(point) for image in shown.values())
    ]
    isolated = bool(points)
    points = points or bright_places(places, grid, windows, spectrum, cell_m=cell_m, isolated=False)
    divisors = {
        pair: images[pair].attrs["quality"]["brightest"]["amplitude"] * np.exp(1j * turn)
        for pair, turn in added.items()
    }
    amplitudes = [[shown[pair].at(one.row, one.column) / by for pair, by in divisors.items()] for one in points]
    if len(added) == 1 or not points:
        return None, isolated
    return in_phase(np.array(amplitudes), np.array([one.background for one in points])), isolated


def _focus(images: Mapping[str, xr.Dataset], measured: InPhase | None, added: Sequence[str]) -> dict[str, Any]:
    """Return the verdict of the coherent sum: what its images lost, and what it lost by their phases."""
    of_pairs = {pair: images[pair].attrs["quality"]["focus"] for pair in added}
    if len(added) == 1:
        one = of_pairs[added[0]]
        return {name: one[name] for name in ("verdict", "loss_db", "std_db") if name in one} | {
            "why": f"{added[0]} alone: {one['why']}"
        }
    focuses = [one for one in of_pairs.values() if "loss_db" in one]
    if measured is None or not focuses:
        missing = "no isolated bright point is common to the pairs added" if measured is None else "no pair was judged"
        return {"verdict": "cannot tell", "why": missing}
    # Images are added at equal peaks; in focus each peak would be higher by what it lost.
    of_images = -20 * float(np.log10(np.mean([10 ** (-one["loss_db"] / 20) for one in focuses])))
    loss_db = of_images + measured.loss_db
    std_db = float(np.hypot(np.mean([one["std_db"] for one in focuses]), measured.loss_std_db))
    return {
        "verdict": verdict_of_loss(loss_db, std_db),
        "loss_db": round(loss_db, 3),
        "std_db": round(std_db, 3),
        "why": (
            f"{number_of(measured.places, 'bright point')} of the sum lost {abs(loss_db):.2f} ± {std_db:.2f} dB of "
            f"their peak, {abs(measured.loss_db):.2f} dB of it because the pairs differ in phase"
        ),
    }


def _incoherent(measured: InPhase | None) -> dict[str, str]:
    """Return the flag of a sum whose images are not in phase where it shows bright points."""
    if measured is None or measured.loss_db >= DEFOCUSED_DB - 2 * measured.loss_std_db:
        return {}
    line = (
        f"at {number_of(measured.places, 'bright point')} the pairs keep {measured.coherence:.2f} ± "
        f"{measured.std:.2f} of their power in phase, {measured.chance:.2f} by chance: the peaks of the sum lost "
        f"{abs(measured.loss_db):.1f} dB"
    )
    return {"sum_incoherent": line}


def _flags_of_pairs(of_pairs: Mapping[str, Mapping[str, str]]) -> Flags:
    """Merge the flags of all pairs, each line with its pairs unless all carry it."""
    raised: dict[tuple[str, str], list[str]] = {}
    for pair, flags in of_pairs.items():
        for flag in flags.items():
            raised.setdefault(flag, []).append(pair)
    return Flags.merged(
        *(
            {name: line if len(pairs) == len(of_pairs) else f"{' and '.join(pairs)}: {line}"}
            for (name, line), pairs in raised.items()
        )
    )


def _flags_of_choice(fusion: Mapping[str, Any]) -> Flags:
    """List the flags of the choice of pairs of a coherent sum: pairs left out, and phases not measured."""
    alone = "; ".join(f"{pair} is not in the coherent sum: {why}" for pair, why in fusion["left_out"].items())
    if ties := " or ".join(" and ".join(tie) for tie in fusion["ties"]):
        alone += f"; a tie: {ties} would make as large a sum, and the better focused one was taken"
    chosen = {"pair_excluded": alone} if alone else {}
    if unmeasured := fusion["unmeasured"]:
        known, unknown = len(fusion["phases_rad"]) - len(unmeasured), len(unmeasured)
        lost = [-20 * np.log10(abs(known + turn * unknown) / (known + unknown) + 1e-3) for turn in (1j, -1)]
        chosen["phase_unobservable"] = (
            "; ".join(f"{pair} is added with phase 0: {why}" for pair, why in unmeasured.items())
            + f"; wrong by a quarter of a turn the peak would be {lost[0]:.0f} dB lower, by half a turn "
            + (f"{lost[1]:.0f} dB" if known != unknown else "gone, and each target shown twice beside its place")
        )
    return Flags(chosen)


def _worst(images: Mapping[str, xr.Dataset], fusion: Mapping[str, Any]) -> dict[str, Any]:
    """Return the worst errors and models of the images, as those of their sum, and the budget of each."""
    qualities = [image.attrs["quality"] for image in images.values()]
    worst = max(qualities, key=lambda quality: quality["numerical_error_db"])
    left_out = "".join(f"; without {pair}: {why}" for pair, why in fusion["left_out"].items())
    return {
        "budgets": {pair: image.attrs["quality"]["budget"] for pair, image in images.items()},
        "models": {
            "fusion": f"mean of the peak-normalised images, with and without phase{left_out}",
            "numerical_error": "that of the worst pair",
        },
        "numerical_error_db": worst["numerical_error_db"],
        "numerical_error_confidence": round(1 - sum(1 - one["numerical_error_confidence"] for one in qualities), 4),
        "numerical_error_estimate_db": worst["numerical_error_estimate_db"],
        "instruction_set": ", ".join(sorted({quality["instruction_set"] for quality in qualities})),
        "recomputed": [one for quality in qualities for one in quality["recomputed"]],
    }
