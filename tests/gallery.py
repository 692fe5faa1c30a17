"""Pictures of docs/gallery.md, generated with the commands of the how-tos, the tests and the examples.

`make gallery` generates all pictures, `make gallery PICTURES="bench dem"` a selection; the names are those of how-tos
and examples. Folders of build/gallery are kept; the campaigns of several pictures, `demo` and `two_flights`, are
reused.
"""

import json
import os
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import chdir
from dataclasses import replace
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from folders import ROOT, SHARED, copy_writable, edit_config
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from PIL import Image
from walked import run_commands, walk

import apertura as ap
from apertura.formats.export.change import CLASSES
from apertura.methods.interferometry.coherence import box_sum
from apertura.simulation import ImageGrid, preset, simulate

HOWTOS = ROOT / "docs/howto"
PICTURES = ROOT / "docs/assets/gallery"
WORK = ROOT / "build/gallery"
AIM_BYTES, MOST_BYTES = 40_000, 60_000
WIDTHS, COLOURS = (660, 600, 560), (256, 64, 32, 20)
"""Widths in pixels and palette sizes, tried in order after full colour until a picture is small enough."""

WITHOUT = {
    "antenna_coupling": "shown by the example of the UAV flight",
    "describe": "its results are tags, attributes and a sheet",
    "from_files": "its results are a folder and a table",
    "publish": "its results are copies in an object store",
    "payload": "its results are bits and tables; its plot is a line of SNR over time",
    "raw_imu": "its recipe runs a library that apertura does not install, and ends in a log",
    "sizing": "its only results are tables of estimates",
}
"""How-to without a picture → reason."""

Made = Path | Figure


# ---- Building blocks of the pictures --------------------------------------------------------------------------------


def apertura(*words: object) -> None:
    """Run a command line of apertura."""
    run_commands(f"$ apertura {' '.join(map(str, words))}")


def walked(name: str) -> dict[str, Any]:
    """Run a how-to in this folder; return the names that it defines."""
    return walk(HOWTOS / f"{name}.md")


def empty_folder(name: str) -> Path:
    """Return an empty folder below build/gallery."""
    shutil.rmtree(WORK / name, ignore_errors=True)
    (WORK / name).mkdir(parents=True)
    return WORK / name


def demo() -> Path:
    """Return the campaign of the notebook how-to, run and with its report."""
    folder = WORK / "demo"
    if not (folder / "campaign/results/report.html").exists():
        with chdir(empty_folder("demo")):
            walked("notebook")
            apertura("report", "campaign")
    return folder / "campaign"


def two_flights() -> Path:
    """Return the campaign of the GIS how-to, run."""
    folder = WORK / "two_flights"
    if not (folder / "campaign/results/cube.manifest.json").exists():
        with chdir(empty_folder("two_flights")):
            walked("gis")
    return folder / "campaign"


def figure_of(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """Return a figure with the width of the page, in inches of 100 pixels, and its axes."""
    figure = Figure(figsize=(WIDTHS[0] / 100, height), dpi=100, layout="compressed")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, **options)


def draw(
    axes: Axes,
    values: np.ndarray,
    spacing_m: float,
    title: str,
    *,
    left: bool = True,
    local: bool = False,
    **colours: Any,
) -> Any:
    """Draw values (north-up) with axes in metres from the lower left corner; only the leftmost axes have a y label."""
    extent = (0, values.shape[1] * spacing_m, 0, values.shape[0] * spacing_m)
    shown = axes.imshow(np.ma.masked_invalid(values), extent=extent, interpolation="nearest", **colours)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("x, m" if local else "east, m")
    if left:
        axes.set_ylabel("y, m" if local else "north, m")
    return shown


def raster(path: Path) -> tuple[np.ndarray, float, str]:
    """Return the values of a GeoTIFF with NaN for no data, the pixel spacing in metres, and the unit."""
    with rasterio.open(path) as opened:
        values = opened.read(1, masked=True).astype(float).filled(np.nan)
        return values, opened.res[0], opened.units[0] or ""


def below_peak(pixels: Any) -> np.ndarray:
    """Return the level in dB relative to the brightest pixel."""
    amplitude = np.abs(np.asarray(pixels))
    peak = np.nanmax(amplitude, initial=1e-30)
    return 20 * np.log10(np.maximum(amplitude / peak, 1e-6))


DB = {"cmap": "inferno", "vmin": -40, "vmax": 0}


# ---- How-tos --------------------------------------------------------------------------------------------------------


def bench(_: Path) -> Made:
    walked("bench")
    return Path("on_the_bench/results/b01/bench.png")


def calibrate_radiometry(folder: Path) -> Made:
    from test_47_radiometry import plan

    simulate(folder / "campaign", plan(), seed=3)
    apertura("run", "campaign")
    figure, both = figure_of(1, 2, 3.3, sharey=True)
    for axes, pair in zip(both, ("uav1-uav1", "uav1-uav2"), strict=True):
        values, spacing_m, _ = raster(Path(f"campaign/results/f01/{pair}/sigma0_db.tif"))
        mesh = draw(axes, values, spacing_m, pair, left=axes is both[0], cmap="gray", vmin=-40, vmax=20)
    figure.colorbar(mesh, ax=both, extend="both").set_label("σ⁰, dB")
    return figure


def calibration_flight(_: Path) -> Made:
    walked("calibration_flight")
    apertura("report", "campaign")
    return Path("campaign/results/f01/fused/panels.png")


def catalog(_: Path) -> Made:
    import pystac

    results = two_flights() / "results"
    items = sorted(
        pystac.Catalog.from_file(str(results / "stac/catalog.json")).get_items(recursive=True), key=lambda item: item.id
    )
    figure, grid = figure_of(2, len(items) // 2, 3.9)
    for axes, item in zip(grid.flat, items, strict=True):
        (asset,) = (asset for name, asset in item.assets.items() if name in {"db", "coherent_db", "noncoherent_db"})
        values, _, _ = raster(Path(asset.get_absolute_href()))
        axes.imshow(np.ma.masked_invalid(values - np.nanmax(values)), interpolation="nearest", **DB)
        properties = item.properties
        acquired = f"{item.datetime or properties['start_datetime']:%H:%M}"
        words = f"{item.id}, {acquired}\n{properties['sar:instrument_mode']}, {properties['apertura:verdict']}"
        axes.set_title(words, fontsize=8)
        axes.set_axis_off()
    return figure


def cluster(folder: Path) -> Made:
    from matplotlib.patches import Rectangle

    jobs, side = 3, 32
    shutil.copytree(demo(), folder / "campaign", ignore=shutil.ignore_patterns("results", ".snakemake"))
    edit_config(folder / "campaign", lambda config: config.setdefault("processing", {}).update(tile_px=side))
    apertura("run", "campaign", "--set-scatter", f"tiles={jobs}")
    values, spacing_m, _ = raster(Path("campaign/results/f01/uav1-uav2/db.tif"))
    rows, columns = (-(-size // side) for size in values.shape)
    figure, axes = figure_of(1, 1, 4.2)
    title = f"{rows * columns} tiles, a colour for each of {jobs} jobs"
    mesh = draw(axes, values - np.nanmax(values), spacing_m, title, cmap="gray", vmin=-40, vmax=0)
    for number, (row, column) in enumerate(np.ndindex(rows, columns)):
        size, top = side * spacing_m, values.shape[0] * spacing_m
        place, colour = (column * size, top - (row + 1) * size), f"C{number % jobs}"
        axes.add_patch(Rectangle(place, size, size, facecolor=colour, edgecolor=colour, alpha=0.3))
    axes.set(xlim=(0, values.shape[1] * spacing_m), ylim=(0, values.shape[0] * spacing_m))
    figure.colorbar(mesh, ax=axes, extend="min").set_label("power re peak, dB")
    return figure


def dem(_: Path) -> Made:
    names = walked("dem")
    grid, targets = names["grid"], names["targets"]
    figure, both = figure_of(1, 2, 3.4, sharey=True)
    surfaces = {
        "flat ground": ap.FlatGround(names["flat_m"]),
        "on the DEM": ap.open_dem("campaign/raw/dem.tif", grid, datum="ellipsoid"),
    }
    west, south, _, _ = grid.bounds_m
    for axes, (title, terrain) in zip(both, surfaces.items(), strict=True):
        image = ap.backproject(names["echo"], grid, terrain=terrain).compute()
        mesh = draw(axes, below_peak(image), grid.spacing_m, title, left=axes is both[0], **DB)
        places = np.array([[target["x"] - west, target["y"] - south] for target in targets])
        axes.plot(*places.T, "o", markersize=14, markerfacecolor="none", markeredgecolor="cyan")
        axes.set(xlim=(0, 4.5), ylim=(4, 8.5))
    figure.colorbar(mesh, ax=both, extend="min").set_label("power re peak, dB")
    return figure


def design(folder: Path) -> Made:
    text = (HOWTOS / "design.md").read_text(encoding="utf-8")
    plan = text.split("```yaml\n")[1].split("```")[0]
    (folder / "plan.yaml").write_text(plan, encoding="utf-8")
    corners = [(48.42205, 9.95455), (48.42205, 9.95455), (48.42205, 9.95565), (48.42205, 9.95455)]
    items = [
        {"type": "SimpleItem", "command": 22 if at == 0 else 16, "frame": 3, "params": [0, 0, 0, None, *place, 30]}
        for at, place in enumerate(corners)
    ]
    mission = {"vehicleType": 2, "hoverSpeed": 5, "plannedHomePosition": [*corners[0], 0], "items": items}
    (folder / "dike.plan").write_text(json.dumps({"fileType": "Plan", "mission": mission}), encoding="utf-8")
    command = [Path(sys.executable).parent / "apertura", "design", "plan.yaml", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in {0, 2}:  # 2: a requirement is not met
        raise RuntimeError(done.stderr)
    return Path("out/layers.png")


def fmcw(folder: Path) -> Made:
    from test_42_fmcw import FLIGHT

    from apertura.simulation.fmcw import write_fmcw_campaign

    write_fmcw_campaign(folder / "campaign", FLIGHT, waveform={})
    apertura("run", "campaign")
    return Path("campaign/results/f01/uav1-uav1/quicklook.png")


def gis(_: Path) -> Made:
    pair = two_flights() / "results/f01/uav1-uav2"
    figure, four = figure_of(2, 2, 5.6, sharex=True, sharey=True)
    shown: Mapping[str, Mapping[str, Any]] = {
        "db": {"cmap": "gray"},
        "incidence": {"cmap": "viridis"},
        "bistatic_angle": {"cmap": "viridis"},
        "../fused/coherent_db": {"cmap": "gray"},
    }
    for place, (axes, (name, colours)) in enumerate(zip(four.flat, shown.items(), strict=True)):
        values, spacing_m, unit = raster(pair / f"{name}.tif")
        low = {"vmin": np.nanmax(values) - 40} if name.endswith("db") else {}
        mesh = draw(axes, values, spacing_m, f"{Path(name).name}.tif", left=place % 2 == 0, **colours, **low)
        axes.set_xlabel("east, m" if place > 1 else "")
        figure.colorbar(mesh, ax=axes, extend="min" if low else "neither").set_label(unit)
    return figure


def formed(engine: str) -> None:
    """Save an image of the example scene formed by an engine; numba may simulate a device in this process."""
    from website.picture import example_history

    np.save(f"{engine}.npy", ap.backproject(example_history()[::5], GRID_OF_POSTS, engine=engine).values)


GRID_OF_POSTS = ap.SceneGrid("local", -5.0, 8.0, 0.1, (64, 96))


def gpu(_: Path) -> Made:
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    for engine in ("cuda", "reference"):
        code = f"import gallery; gallery.formed({engine!r})"
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    image, exact = np.load("cuda.npy"), np.load("reference.npy")
    figure, (above, below) = figure_of(2, 1, 5.2, sharex=True)
    axes_of = {"cmap": "inferno", "vmin": -40, "vmax": 0}
    mesh = draw(above, below_peak(image), 0.1, "engine cuda, in numba's simulator", local=True, **axes_of)
    above.set_xlabel("")
    figure.colorbar(mesh, ax=above, extend="min").set_label("power re peak, dB")
    error_db = 20 * np.log10(np.maximum(np.abs(image - exact) / np.abs(exact).max(), 1e-9))
    mesh = draw(below, error_db, 0.1, "difference from the double sum", local=True, cmap="viridis")
    figure.colorbar(mesh, ax=below).set_label("re peak, dB")
    return figure


def inspect(_: Path) -> Made:
    apertura("inspect", ROOT / ".test/raw/f01/uav2.track.pos", "--plot", "log.png")
    return Path("log.png")


def interferometry(folder: Path) -> Made:
    from test_49_interferogram import NAME, made

    results = made(folder, half_width_m=4.5, density_per_m2=30.0) / "results/interferometry" / NAME
    figure, four = figure_of(2, 2, 5.2, sharex=True, sharey=True)
    colours: Mapping[str, Mapping[str, Any]] = {
        "coherence": {"cmap": "gray", "vmin": 0, "vmax": 1},
        "unwrapped": {"cmap": "twilight_shifted"},
        "height": {"cmap": "viridis"},
        "height_std": {"cmap": "magma"},
    }
    for place, (axes, (name, scale)) in enumerate(zip(four.flat, colours.items(), strict=True)):
        values, spacing_m, unit = raster(results / f"{name}.tif")
        mesh = draw(axes, values, spacing_m, f"{name}.tif", left=place % 2 == 0, **scale)
        axes.set_xlabel("east, m" if place > 1 else "")
        bar = figure.colorbar(mesh, ax=axes)
        bar.set_label("" if unit == "1" else unit)
        bar.formatter.set_useOffset(False)
    return figure


def long_flights(folder: Path) -> Made:
    flown = preset("flight", pulses=2400)
    (line,) = flown.flights
    waveform = replace(flown.waveform, prf_hz=40.0)
    start = replace(line.tracks["uav1"], start_m=(-150.0, -90.0, 40.0))
    line = replace(line, tracks={"uav1": start})
    east, north = 570661.0, 5363707.0
    scene = ImageGrid("EPSG:32632", bounds_m=(east - 130, north - 40, east + 130, north + 40), spacing_m=0.5)
    plan = replace(flown, flights=(line,), nodes={"uav1": flown.nodes["uav1"]}, waveform=waveform, scene=scene)
    simulate(folder / "campaign", plan, seed=1)
    apertura("run", "campaign")
    return Path("campaign/results/coverage.png")


def map_(folder: Path) -> Made | None:
    from playwright.sync_api import sync_playwright
    from test_54_map_page import SOFTWARE_GL, serving

    browser = shutil.which("chromium")
    if browser is None:
        print("map: no chromium; the picture stays unchanged", file=sys.stderr)
        return None
    with serving(demo()) as address, sync_playwright() as tool:
        opened = tool.chromium.launch(executable_path=browser, headless=True, args=list(SOFTWARE_GL))
        page = opened.new_page(viewport={"width": 900, "height": 640})
        page.goto(f"{address}#image=f01/fused&right=f01/uav1-uav2&right_layer=incidence.tif")
        _, frame = page.frames
        frame.wait_for_selector("html[data-drawn]", timeout=60_000)
        frame.wait_for_timeout(500)
        page.screenshot(path=folder / "map.png")
        opened.close()
    return Path("map.png")


def me_or_the_radar(_: Path) -> Made:
    from website.picture import example_history

    grid, right = ap.SceneGrid("local", -14.0, 10.0, 0.1, (200, 280)), example_history()
    wave_m = 0.04 * np.sin(np.arange(len(right)) / 40)[:, None] * [0, 1, 1]
    displaced = ap.Aperture(right.aperture.tx_m + wave_m, right.aperture.rx_m + wave_m)
    cases = {
        "right": right,
        "log oscillation of 4 cm": replace(right, aperture=displaced),
        "I and Q swapped": replace(right, transfer=right.transfer.conj()),
        "every 16th pulse": right[::16],
    }
    figure, four = figure_of(2, 2, 4.6, sharex=True, sharey=True)
    for place, (axes, (title, history)) in enumerate(zip(four.flat, cases.items(), strict=True)):
        image = ap.backproject(history, grid)
        words = f"{title}: {', '.join(json.loads(image.attrs['flags'])) or image.verdict}"
        mesh = draw(axes, below_peak(image.values), 0.1, words, left=place % 2 == 0, local=True, **DB | {"vmin": -30})
        axes.set_title(words, fontsize=8)
        axes.set_xlabel("x, m" if place > 1 else "")
    figure.colorbar(mesh, ax=four, extend="min", shrink=0.8).set_label("power re peak, dB")
    return figure


def notebook(_: Path) -> Made:
    return demo().parent / "image.png"


def refine_tracks(folder: Path) -> Made:
    plan = replace(preset("first-flight"), scene=ImageGrid("EPSG:32632", half_width_m=4.0, spacing_m=0.05))
    simulate(folder / "campaign", plan, seed=1)
    copied = copy_writable(folder / "campaign", folder / "as_logged")
    edit_config(copied, lambda document: document.setdefault("processing", {}).update(autofocus="off"))
    figure, both = figure_of(1, 2, 3.5, sharey=True)
    for axes, (title, name) in zip(both, {"as logged": "as_logged", "refined": "campaign"}.items(), strict=True):
        apertura("run", name)
        campaign = ap.open_campaign(name)
        image, report = campaign.image("f01", "uav1-uav2").values, campaign.report("f01", "uav1-uav2")["focus"]
        words = f"{title}: {report['verdict']}"
        mesh = draw(axes, below_peak(image), 0.05, words, left=axes is both[0], **DB)
    figure.colorbar(mesh, ax=both, extend="min").set_label("power re peak, dB")
    return figure


def report(_: Path) -> Made:
    return demo() / "results/f01/uav1-uav2/pictures/phase.png"


def run(_: Path) -> Made:
    return demo() / "results/f01/uav1-uav2/quicklook.png"


def samples(folder: Path) -> Made:
    from test_42_samples import PULSES, TARGETS

    simulate(folder / "campaign", preset("demo", pulses=150), waveform=PULSES["chirp"], targets=TARGETS)
    apertura("report", "campaign")
    return Path("campaign/results/f01/uav1-uav2/pictures/range_profiles.png")


def change(folder: Path) -> Made:
    flights = ["f01", "f05"]
    apertura("simulate", "campaign", "--preset", "revisit")
    requested = {"reference": flights[0], "flights": flights[1:], "pair": "uav1-uav1"}
    edit_config(folder / "campaign", lambda config: config.update(stack=requested, processing={"autofocus": "off"}))
    apertura("run", "campaign", "--until", "change")
    return changes(folder / "campaign/results/stack" / flights[-1])


def changes(results: Path) -> Figure:
    """Draw the rasters of the changes of a flight."""
    figure, row = figure_of(1, 3, 2.9, sharey=True)
    colours = ListedColormap([np.array(CLASSES[value][1]) / 255 for value in range(4)])
    panels: list[tuple[str, dict[str, Any], str]] = [
        ("amplitude_ratio.tif", {"cmap": "RdBu_r", "vmin": -10, "vmax": 10}, "dB"),
        ("coherence_loss.tif", {"cmap": "magma", "vmin": 0, "vmax": 1}, ""),
        ("change.tif", {"cmap": colours, "vmin": -0.5, "vmax": 3.5}, ""),
    ]
    for place, (axes, (name, scale, unit)) in enumerate(zip(row, panels, strict=True)):
        values, spacing_m, _ = raster(results / name)
        mesh = draw(axes, values, spacing_m, name, left=not place, **scale)
        bar = figure.colorbar(mesh, ax=axes, location="bottom")
        bar.set_label(unit)
        if name == "change.tif":
            bar.set_ticks(range(4), labels=["none", "brighter", "darker", "coherent"], fontsize=7)
    return figure


def stack(folder: Path) -> Made:
    flights = [f"f{number:02d}" for number in range(1, 6)]
    apertura("simulate", "campaign", "--preset", "revisit")
    edit_config(folder / "campaign", lambda config: config.update(processing={"autofocus": "off"}))
    apertura("run", "campaign", "--until", "stack")
    results, last = folder / "campaign/results/stack", flights[-1]
    with rasterio.open(results / last / "slc.tif") as image, rasterio.open(results / flights[0] / "slc.tif") as first:
        product, spacing_m = image.read(1) * first.read(1).conj(), image.res[0]
    figure, four = figure_of(2, 2, 5.2, sharex=True, sharey=True)
    moved = np.angle(box_sum(product, 15)).astype(float)
    cyclic: Mapping[str, Any] = {"cmap": "twilight_shifted", "vmin": -1.5, "vmax": 1.5}
    grey: Mapping[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 1}
    panels = [
        (raster(results / last / "residual_phase.tif")[0], "residual_phase.tif", {"cmap": "twilight_shifted"}, "rad"),
        (moved, f"phase of {last} minus {flights[0]}", cyclic, "rad"),
        (raster(results / last / "coherence.tif")[0], "coherence.tif", grey, ""),
        (raster(results / last / "expected_coherence.tif")[0], "expected_coherence.tif", grey, ""),
    ]
    for place, (axes, (values, title, scale, unit)) in enumerate(zip(four.flat, panels, strict=True)):
        mesh = draw(axes, values, spacing_m, title, left=place % 2 == 0, **scale)
        axes.set_xlabel("east, m" if place > 1 else "")
        figure.colorbar(mesh, ax=axes).set_label(unit)
    return figure


def time_series(folder: Path) -> Made | None:
    """Run dolphin on a stack; without dolphin, the picture is kept."""
    from test_58_time_series import displacements, place, run_dolphin, stacked, trues_mm

    if not place("dolphin").exists():
        return None
    stacked(folder / "campaign", slope_mm=3.0)
    apertura("export", "stack", "campaign", "--out", "series")
    run_dolphin(folder / "series")
    moved_mm, spacing_m, areas = displacements(folder / "series")
    figure, (left, right) = figure_of(1, 2, 2.8)
    mesh = draw(left, moved_mm[-1], spacing_m, "after 4 flights", cmap="RdBu", vmin=-15, vmax=15)
    figure.colorbar(mesh, ax=left).set_label("mm, towards the sensor")
    for name, mask in areas.items():
        median = [np.nanmedian(one[mask]) for one in moved_mm]
        deviation = [np.nanstd(one[mask]) for one in moved_mm]
        right.errorbar(range(5), median, deviation, fmt="o", capsize=3, label=name)
        right.plot(range(5), trues_mm(3.0)[name], "k--", lw=0.8)
    right.set(xlabel="flight", ylabel="displacement, mm", xticks=range(5), xticklabels=[f"f0{n}" for n in range(1, 6)])
    right.plot([], "k--", lw=0.8, label="simulated")
    right.legend(frameon=False, fontsize="small", loc="upper left")
    return figure


def verify(folder: Path) -> Made:
    from spoilt import flip

    from apertura.campaign.store import read_manifest
    from apertura.views.verify.chain import verify as verified

    product = "results/f01/fused/coherent_db.tif"
    shutil.copytree(demo(), folder / "campaign", symlinks=True)
    campaign = folder / "campaign"
    flip(campaign / "raw/f01/uav2.sigmf-data")
    states = {link.name: link.state for link in verified(campaign / product).links}
    begin = "results/f01/fused/export.manifest.json"
    arrows, depths, waiting = [(product, begin)], {product: 0}, [begin]
    while waiting:
        name = waiting.pop(0)
        depths[name] = 1 + max(depths[to] for to, of in arrows if of == name)
        if name.endswith(".manifest.json"):
            sources = [
                source for source in read_manifest(campaign / name)["sources"] if not source.startswith("config")
            ]
            arrows += [(name, source) for source in sources]
            waiting += sources
    columns = {depth: [name for name, at in depths.items() if at == depth] for depth in set(depths.values())}
    places = {
        name: (-depth, -(number + 0.5) / len(names))
        for depth, names in columns.items()
        for number, name in enumerate(names)
    }
    figure, axes = figure_of(1, 1, 4.6)
    for to, of in dict.fromkeys(arrows):
        axes.annotate("", places[to], places[of], arrowprops={"arrowstyle": "-", "color": "0.75", "linewidth": 0.6})
    for name, place in places.items():
        colour = "#f3c2ab" if states[name] != "same" else "white"
        words = name.removeprefix("results/").removesuffix(".manifest.json").replace("/", "/\n")
        box = {"boxstyle": "round", "facecolor": colour, "edgecolor": "0.4"}
        axes.text(*place, words, fontsize=6, ha="center", va="center", bbox=box)
    axes.set(xlim=(-max(columns) - 0.5, 0.5), ylim=(-1, 0))
    axes.set_axis_off()
    return figure


def xarray(folder: Path) -> Made:
    from test_48_cube import two_days

    two_days(folder / "campaign")
    cube = walked("xarray")["cube"]
    figure, grid = figure_of(cube.sizes["flight"], cube.sizes["pair"], 4.8, sharex=True, sharey=True)
    spacing_m = float(cube.x[1] - cube.x[0])
    for (row, column), axes in np.ndenumerate(grid):
        image = cube.isel(flight=row, pair=column)
        words = f"{image.flight.item()}, {image.pair.item()}"
        mesh = draw(axes, below_peak(image.image.values), spacing_m, words, left=column == 0, **DB)
        axes.set_xlabel("" if row == 0 else "east, m")
        if image.image.isnull().all():
            axes.text(0.5, 0.5, "no coverage: NaN", transform=axes.transAxes, ha="center")
    figure.colorbar(mesh, ax=grid, extend="min").set_label("power re peak of the image, dB")
    return figure


def your_own_recording(folder: Path) -> Made:
    from test_60_your_own_recording import plain_files

    plain_files(folder)
    walked("your_own_recording")
    return Path("my_campaign/results/f01/uav1-uav2/quicklook.png")


# ---- Examples -------------------------------------------------------------------------------------------------------


def imaged(folder: Path, pair: str) -> Made:
    """Run the campaign of a folder; return the quicklook of a pair."""
    apertura("run", folder / "campaign")
    return folder / "campaign/results" / pair / "quicklook.png"


def ci(folder: Path) -> Made:
    shutil.copytree(ROOT / ".test", folder / "campaign")
    return imaged(folder, "f01/fused")


def sample(folder: Path) -> Made:
    copy_writable(SHARED / "campaign-sample", folder / "campaign")
    return imaged(folder, "f01/fused")


def rail_pass(folder: Path) -> Made:
    """Run the example with the line of its README that excludes the pulses while the radar was stationary."""
    root, data = Path(shutil.copytree(ROOT / "examples/rail_pass", folder / "campaign")), SHARED / "bwsi_rail_passA"
    (root / "raw/passA").mkdir(parents=True)
    shutil.copyfile(data / "July23_03.out", root / "raw/passA/radar.out")
    shutil.copyfile(data / "Rail SAR 2.csv", root / "raw/passA/radar.track.csv")
    lines = (root / "README.md").read_text(encoding="utf-8").split("\n    flight\tpair\tstart\tend\n    ")[1]
    (root / "config/segments.tsv").write_text(f"flight\tpair\tstart\tend\n{lines.splitlines()[0]}\n", encoding="utf-8")
    return imaged(folder, "passA/radar-radar")


def uav_flight(folder: Path) -> Made:
    root = Path(shutil.copytree(ROOT / "examples/uav_flight", folder / "campaign"))
    (root / "raw/f01").mkdir(parents=True)
    for name in ("radar.out", "radar.track.csv"):
        shutil.copyfile(SHARED / "bwsi_uav_flight" / name, root / "raw/f01" / name)
    return imaged(folder, "f01/radar-radar")


def gotcha(folder: Path) -> Made:
    root = Path(shutil.copytree(ROOT / "examples/gotcha", folder / "campaign"))
    (root / "raw/pass1").mkdir(parents=True)
    for path in (SHARED / "gotcha_afrl").glob("*.mat"):
        shutil.copyfile(path, root / f"raw/pass1/aircraft.{path.name}")
    return imaged(folder, "pass1/aircraft-aircraft")


def px4_flight(folder: Path) -> Made:
    replay = runpy.run_path(str(ROOT / "examples/px4_flight/replay.py"))["replay"]
    replay(SHARED / "px4_real_flight/esc_status_log.ulg", folder / "campaign")
    return imaged(folder, "f01/uav1-uav1")


# ---- The gallery ----------------------------------------------------------------------------------------------------

MAKERS: dict[str, Callable[[Path], Made | None]] = {
    made.__name__.rstrip("_"): made
    for made in (
        bench, calibrate_radiometry, calibration_flight, catalog, change, cluster, dem, design, fmcw, gis, gpu, inspect,
        interferometry, long_flights, map_, me_or_the_radar, notebook, refine_tracks, report, run, samples, stack,
        time_series, verify, xarray, your_own_recording, ci, sample, rail_pass, uav_flight, gotcha, px4_flight,
    )
}  # fmt: skip
"""Picture → function that generates it, called in a separate empty folder."""


def publish(made: Made, name: str) -> None:
    """Write a picture for the site: at most as wide as a page, small, and in full colour if the size limit permits."""
    if isinstance(made, Figure):
        made.savefig(Path("figure.png"))
        made = Path("figure.png")
    with Image.open(made) as opened:
        drawn = opened.convert("RGB")
    target = PICTURES / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    written = []
    for width, colours in [(WIDTHS[0], None), *product(WIDTHS, COLOURS)]:
        size = min(width, drawn.width), round(drawn.height * min(width, drawn.width) / drawn.width)
        small = drawn.resize(size, Image.Resampling.LANCZOS)
        if colours is not None:
            small = small.quantize(colours, method=Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE)
        small.save(buffer := BytesIO(), "PNG", optimize=True)
        written.append(buffer.getvalue())
        if len(written[-1]) <= (MOST_BYTES if colours is None else AIM_BYTES):
            break
    else:
        written.append(min(written, key=len))
    best = written[-1]
    if len(best) > MOST_BYTES:
        raise ValueError(f"{name}: {len(best)} bytes exceed the limit of {MOST_BYTES}")
    target.write_bytes(best)


def main() -> None:
    """Generate the named pictures, or all pictures."""
    for name in sys.argv[1:] or MAKERS:
        folder = empty_folder(name)
        with chdir(folder):
            made = MAKERS[name](folder)
            if made is not None:
                publish(made, name)
                print(name, (PICTURES / f"{name}.png").stat().st_size)


if __name__ == "__main__":
    main()
