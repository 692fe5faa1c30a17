"""Image quality predicted by `apertura design`, compared with simulated and processed campaigns of twelve plans.

`python benchmarks/design.py WORKFOLDER [--only NAME …] [--draws 8]`. The scene contains five points of 1 m²; each plan
is simulated as raw samples and processed by all steps. Noise is the mean power of an image without targets. If a plan
configures position_std_m, its logs have errors of this standard deviation, and the loss is the mean over draws and
points; if it configures an interferogram, the scene is clutter.
"""

import argparse
import contextlib
import io
import shutil
from pathlib import Path

import numpy as np
import rasterio
from rich.console import Console
from rich.table import Table

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.core.scene.angles import surface
from apertura.run.process import process
from apertura.simulation.targets import Clutter, Origin, PointTarget
from apertura.stages.pair import open_pair
from apertura.stages.radiometry import calibrated_pair
from apertura.stages.scene import open_scene
from apertura.tools.design import designed
from apertura.tools.design.expected_images import rehearse
from apertura.tools.design.flight_plan import FlightPlan

EAST, NORTH = 570661.0, 5363707.0
CRS = "EPSG:32632"
RECEIVER = {"full_scale_counts": 8192, "full_scale_dbm": 0.0, "gain_db": 30.0, "noise_figure_db": 6.0}
L_BAND = {
    "kind": "ofdm", "subcarriers": 512, "subcarrier_spacing_hz": 4e5, "symbol_s": 2.5e-6, "cyclic_prefix_s": 1e-6,
    "carrier_hz": 1.3e9, "sample_rate_hz": 2.56e8, "prf_hz": 20.0,
}  # fmt: skip
X_BAND = {
    "kind": "ofdm", "subcarriers": 1024, "subcarrier_spacing_hz": 5e4, "symbol_s": 2e-5, "cyclic_prefix_s": 2.6e-5,
    "carrier_hz": 9.6e9, "sample_rate_hz": 6.4e7, "prf_hz": 100.0,
}  # fmt: skip


def node(**more):
    gains = {"radar_tx_gain_dbi": 6.0, "radar_rx_gain_dbi": 6.0}
    return {"transmit_power_dbm": 10.0, "antennas": gains, "receiver": RECEIVER, "attitude": "log"} | more


def line(length=16.0, away=30.0, height=30.0, speed=1.0, heading=0.0, **more):
    """Return a track to the east, `away` metres south of the scene centre, rotated about this centre by `heading`."""
    angle = np.radians(heading)
    ends = np.array([[-length / 2, -away], [length / 2, -away]])
    ends = ends @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) + [EAST, NORTH]
    start, end = ends.round(3).tolist()
    return {"kind": "line", "start_m": start, "end_m": end, "height_m": height, "speed_m_s": speed} | more


def plan(tracks, *, half=8.0, spacing=0.1, waveform=L_BAND, nodes=("uav1",), more=None, flights=None, **scene_keys):
    edges = [EAST - half, NORTH - half, EAST + half, NORTH + half]
    one = {"transmitter": nodes[0], "receivers": list(nodes), "tracks": tracks, **(more or {})}
    return {
        "campaign": "rehearsal",
        "waveform": waveform,
        "nodes": {name: node() for name in nodes},
        "scene": {"crs": CRS, "bounds_m": edges, "spacing_m": spacing, "height_m": 500.0} | scene_keys,
        "processing": {"autofocus": "off"},
        "flights": flights or {"f01": one},
    }


def erring(document, std_m):
    for one in document["nodes"].values():
        one["position_std_m"] = std_m
    return document


def beamed(document, azimuth, elevation, widths):
    for one in document["nodes"].values():
        look = {"boresight_deg": [azimuth, elevation], "beamwidth_deg": widths}
        one["antennas"] = one["antennas"] | {"radar_tx": look, "radar_rx": look}
    return document


def hill(folder: Path) -> Path:
    """Write a DEM of a smooth hill of 6 m below the points, and a mound next to it that casts a shadow."""
    path = folder / "dem.tif"
    x, y = np.meshgrid(np.arange(-60.5, 60.5, 1.0), np.arange(60.5, -60.5, -1.0))
    heights = 500.0 + 6.0 * np.exp(-(x**2 + (y - 2.0) ** 2) / (2 * 15.0**2))
    heights += 5.0 * np.exp(-((x - 9.5) ** 2 + (y + 8.0) ** 2) / (2 * 1.3**2))
    transform = rasterio.Affine(1, 0, EAST - 61.0, 0, -1, NORTH + 61.0)
    form = {"driver": "GTiff", "count": 1, "dtype": "float64", "crs": CRS, "transform": transform}
    with rasterio.open(path, "w", height=heights.shape[0], width=heights.shape[1], **form) as raster:
        raster.write(heights, 1)
    return path


def two_flights(baseline_m):
    nodes = {"transmitter": "uav1", "receivers": ["uav1"]}
    flights = {
        "f01": {**nodes, "tracks": {"uav1": line()}},
        "f02": {**nodes, "tracks": {"uav1": line(height=30.0 + baseline_m)}},
    }
    return plan({}, flights=flights) | {"interferometry": {"pairs": {"two": ["f01/uav1-uav1", "f02/uav1-uav1"]}}}


SWARM = ("uav1", "uav2", "uav3", "uav4", "uav5")
AROUND = {"kind": "circle", "centre_m": [EAST, NORTH], "radius_m": 25.0, "height_m": 25.0, "speed_m_s": 2.0}
TWO = ("uav1", "uav2")


def formed(shape, spacing_m):
    return {"formation": {"shape": shape, "leader": "uav1", "spacing_m": spacing_m}}


HILL = {"height_datum": "ellipsoid", "dem": "dem.tif", "dem_datum": "ellipsoid"}
QUARTER = {"start_deg": 135.0, "turn_deg": 90.0}
FAR = line(length=60.0, away=2100.0, height=2100.0, speed=15.0)
STRONG = {"transmit_power_dbm": 50.0, "antennas": {"radar_tx_gain_dbi": 30.0, "radar_rx_gain_dbi": 30.0}}
ASIDE = plan({"uav1": line(length=30.0, away=22.0, height=20.0)})
PLANS = {
    "line": plan({"uav1": line()}),
    "circle": plan({"uav1": AROUND}, half=3.0, spacing=0.05, waveform=L_BAND | {"prf_hz": 12.0}),
    "arc of a quarter": plan({"uav1": AROUND | QUARTER}, half=4.0, spacing=0.05),
    "racetrack": plan({"uav1": line(kind="racetrack", legs=2, spacing_m=2.0, length=12.0)}),
    "tandem": plan({"uav1": line()}, nodes=TWO, more=formed("column", 6.0)),
    "five nodes": plan({"uav1": line(length=8.0)}, nodes=SWARM, more=formed("vee", 4.0), half=6.0),
    "hill": plan({"uav1": line(away=40.0, height=18.0)}, half=12.0, spacing=0.2, **HILL),
    "X band at 3 km": plan({"uav1": FAR}, half=40.0, spacing=0.5, waveform=X_BAND)
    | {"nodes": {"uav1": node(**STRONG)}},
    "L band at 30 m, beams": beamed(ASIDE, -90.0, -42.0, [30.0, 30.0]),
    "positions of 1 cm": erring(plan({"uav1": line(length=24.0)}), 0.01),
    "bistatic, positions of 1 cm": erring(plan({"uav1": line(length=24.0)}, nodes=TWO, more=formed("row", 5.0)), 0.01),
    "two heights": two_flights(0.5),
}


LAYERS = ("resolution_fine", "resolution", "nesz", "point_snr")


def points(opened, half):
    """Return easting, northing and height of five points on the terrain, none in the sidelobes of another point."""
    positions = []
    for east, north in ((0.0, 0.0), (0.6, 0.35), (-0.35, 0.6), (-0.6, -0.35), (0.35, -0.6)):
        pixel = opened.grid.pixel_of(EAST + east * half, NORTH + north * half)
        row, column = (round(float(one)) for one in pixel)
        x, y = opened.grid.map_at(row, column)
        positions.append((float(x), float(y), float(opened.terrain.heights_at(opened.grid, row, column))))
    return positions


def standing(opened, half):
    """Return these points as targets of 1 m², in east, north and up from the scene centre."""
    latitude, longitude, height = map(float, geodetic_from_ecef(opened.middle_m))
    origin = Origin(latitude, longitude, height)
    placed = [origin.enu(frame_from_map(CRS, *place)) for place in points(opened, half)]
    return [PointTarget(tuple(place.tolist()), 1.0) for place in placed]


def processed(root: Path) -> Campaign:
    campaign = Campaign.load(root)
    with contextlib.redirect_stdout(io.StringIO()):
        process(campaign, last="layers")
        process(campaign, first="interferogram", last="interferogram")
    return campaign


def measured(alone: list[Campaign], empty: Campaign, flight: str, pair: str, design):
    """Return predicted and measured values at the points: widths along both axes, NESZ and SNR; and the coverage.

    Each image contains a single point: on a hill, sidelobes of another point change its width by up to 8 %. Noise is
    the mean power of the same image of an empty scene.
    """
    campaign = alone[0]
    opened, planned = open_scene(campaign), design.images[f"{flight}/{pair}"]
    grid = opened.grid
    whole = slice(0, grid.shape[0]), slice(0, grid.shape[1])
    nothing, *images = (open_stage(one.stage("image", flight, pair), "image").image.values for one in (empty, *alone))
    calibration = calibrated_pair(campaign, open_pair(campaign, flight, pair), opened).calibration
    noise = float(np.nanmean(np.abs(nothing) ** 2 / calibration.pixel_noise(whole)))
    flat = campaign.settings.scene.dem is None
    normal = None if flat else surface(grid, opened.terrain, whole)[1]
    with np.errstate(invalid="ignore"):
        nesz = 10 * np.log10(noise * calibration.pixel_noise(whole) / calibration.power(whole, "sigma0", normal))
    with rasterio.open(str(campaign.result(flight, pair, "mask.tif"))) as raster:
        is_imaged = raster.read(1) == 0
    rows, half = [], grid.shape[0] * grid.spacing_m / 2
    for target, pixels in zip(points(opened, half), images, strict=True):
        row, column = (round(float(one)) for one in grid.pixel_of(*target[:2]))
        if not is_imaged[row, column]:
            continue
        peak = find_peak(pixels, row, column)
        azimuth = np.radians(planned.layers["orientation"][row, column])
        directions = (np.sin(azimuth), np.cos(azimuth)), (np.cos(azimuth), -np.sin(azimuth))
        cuts = [
            cut_through(pixels, peak, direction=direction, spacing_m=grid.spacing_m, reach_m=half / 2)
            for direction in directions
        ]
        place = opened.terrain.positions_at(grid, np.array([row]), np.array([column]))
        snr_db = 10 * np.log10(abs(peak.value) ** 2 / (noise * calibration.at(place)[1][0]))
        predicted = [planned.layers[name][row, column] for name in LAYERS]
        rows.append((predicted, [cuts[0].width_m, cuts[1].width_m, nesz[row, column], snr_db]))
    cover = 100 * np.array([(planned.layers["mask"] == 0).mean(), is_imaged.mean()])
    return np.array(rows), cover


def peaks_db(campaign: Campaign, flight: str, pair: str):
    opened = open_scene(campaign)
    pixels = open_stage(campaign.stage("image", flight, pair), "image").image.values
    half = opened.grid.shape[0] * opened.grid.spacing_m / 2
    at = [opened.grid.pixel_of(*place[:2]) for place in points(opened, half)]
    return np.array([20 * np.log10(abs(find_peak(pixels, *map(round, map(float, one))).value)) for one in at])


def compare(name: str, folder: Path, draws: int):
    """Compare the predictions of a plan with its campaign; yield pair, quantity, predicted, measured, difference."""
    bounds = PLANS[name]["scene"]["bounds_m"]
    half = (bounds[2] - bounds[0]) / 2
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if "dem" in PLANS[name]["scene"]:
        hill(folder)
    planned = FlightPlan.model_validate(PLANS[name])
    design = designed(planned, folder)
    if design.interferograms:
        clutter = [Clutter((-half - 2, -half - 2, half + 2, half + 2), 10.0, 40.0)]
        campaign = processed(rehearse(design.opened, clutter, folder / "right"))
        for two, own in design.interferograms.items():
            with rasterio.open(str(campaign.result("interferometry", two, "coherence.tif"))) as raster:
                values = raster.read(1)
            inner = tuple(slice(size // 5, -size // 5) for size in values.shape)
            coherences = float(np.median(own["coherence"][inner])), float(np.nanmedian(values[inner]))
            yield two, "coherence", *coherences, f"{coherences[1] - coherences[0]:+.3f}"
        return
    targets = standing(design.opened.scene, half)
    alone = [processed(rehearse(design.opened, [one], folder / str(at))) for at, one in enumerate(targets)]
    campaign = processed(rehearse(design.opened, targets, folder / "right"))
    empty = processed(rehearse(design.opened, [PointTarget((0.0, 0.0, 0.0), 1e-9)], folder / "empty"))
    pairs = [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]
    for flight, pair in pairs:
        rows, cover = measured(alone, empty, flight, pair, design)
        for at, quantity in enumerate(("finer width, m", "coarser width, m", "NESZ, dB", "SNR, dB")):
            predicted, measured_values = rows[:, 0, at], rows[:, 1, at]
            difference = measured_values - predicted if at > 1 else 100 * (measured_values / predicted - 1)
            worst = difference[np.nanargmax(np.abs(difference))]
            unit = "dB" if at > 1 else "%"
            line = f"{np.nanmean(difference):+.2f} {unit}, worst {worst:+.2f}"
            yield pair, quantity, np.median(predicted), np.nanmedian(measured_values), line
        yield pair, "coverage, %", *cover, f"{cover[1] - cover[0]:+.2f} %"
    if planned.nodes["uav1"].position_std_m:
        losses_db = {pair: [] for _, pair in pairs}
        for seed in range(draws):
            wrong = processed(rehearse(design.opened, targets, folder / "draw", seed=seed + 2, erring=True))
            for flight, pair in pairs:
                losses_db[pair].append((peaks_db(campaign, flight, pair) - peaks_db(wrong, flight, pair)).mean())
            shutil.rmtree(folder / "draw")
        for flight, pair in pairs:
            predicted = float(np.median(design.images[f"{flight}/{pair}"].layers["loss"]))
            mean, std = float(np.mean(losses_db[pair])), float(np.std(losses_db[pair])) / draws**0.5
            line = f"{100 * (mean / predicted - 1):+.0f} %, ± {100 * std / predicted:.0f} %"
            yield pair, "loss, dB", predicted, mean, line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=list(PLANS), default=list(PLANS))
    parser.add_argument("--draws", type=int, default=8)
    options = parser.parse_args()
    console = Console(width=150)
    for name in options.only:
        table, folder = Table(title=name, title_justify="left"), options.folder / name.replace(" ", "_")
        for heading in ("pair", "quantity", "predicted", "measured", "difference"):
            table.add_column(heading)
        for pair, quantity, predicted, measured_value, difference in compare(name, folder, options.draws):
            table.add_row(pair, quantity, f"{predicted:.4g}", f"{measured_value:.4g}", difference)
        console.print(table)
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
