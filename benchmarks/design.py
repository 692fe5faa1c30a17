"""Predicted by `apertura design`, and measured after the same plan was sampled and processed: twelve plans.

`python benchmarks/design.py WORKFOLDER [--only NAME …] [--draws 8]`. Five points of 1 m² stand in the scene;
each plan is simulated to raw samples and goes through the steps. Noise is the mean power of an image without targets.
Of plans that state position_std_m, logs err by as much, and the loss is the mean over draws and points; of one that
names an interferogram, the scene is clutter.
"""

import argparse
import contextlib
import io
import shutil
from pathlib import Path

import numpy as np
import rasterio
from judging.run import image_steps
from rich.console import Console
from rich.table import Table

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.core.scene.angles import surface
from apertura.simulation.targets import Clutter, Origin, PointTarget
from apertura.stages import interferogram, layers
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
    """Fly east, the scene's middle on the left, `away` metres north of the track; turned about it by `heading`."""
    turn = np.radians(heading)
    ends = np.array([[-length / 2, -away], [length / 2, -away]])
    ends = ends @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) + [EAST, NORTH]
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
    """Write a DEM of a gentle hill of 6 m, where the points stand, and a mound beside it that throws a shadow."""
    path = folder / "dem.tif"
    x, y = np.meshgrid(np.arange(-60.5, 60.5, 1.0), np.arange(60.5, -60.5, -1.0))
    heights = 500.0 + 6.0 * np.exp(-(x**2 + (y - 2.0) ** 2) / (2 * 15.0**2))
    heights += 5.0 * np.exp(-((x - 9.5) ** 2 + (y + 8.0) ** 2) / (2 * 1.3**2))
    transform = rasterio.Affine(1, 0, EAST - 61.0, 0, -1, NORTH + 61.0)
    form = {"driver": "GTiff", "count": 1, "dtype": "float64", "crs": CRS, "transform": transform}
    with rasterio.open(path, "w", height=heights.shape[0], width=heights.shape[1], **form) as raster:
        raster.write(heights, 1)
    return path


def two_flights(apart):
    one = {"transmitter": "uav1", "receivers": ["uav1"]}
    flights = {
        "f01": {**one, "tracks": {"uav1": line()}},
        "f02": {**one, "tracks": {"uav1": line(height=30.0 + apart)}},
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
    """Return easting, northing and height of five places on the ground, none in the sidelobes of another."""
    found = []
    for east, north in ((0.0, 0.0), (0.6, 0.35), (-0.35, 0.6), (-0.6, -0.35), (0.35, -0.6)):
        pixel = opened.grid.pixel_of(EAST + east * half, NORTH + north * half)
        row, column = (round(float(one)) for one in pixel)
        x, y = opened.grid.map_at(row, column)
        found.append((float(x), float(y), float(opened.terrain.heights_at(opened.grid, row, column))))
    return found


def standing(opened, half):
    """Return the same as targets of 1 m², east, north and up of the scene's middle."""
    latitude, longitude, height = map(float, geodetic_from_ecef(opened.middle_m))
    origin = Origin(latitude, longitude, height)
    placed = [origin.enu(frame_from_map(CRS, *place)) for place in points(opened, half)]
    return [PointTarget(tuple(place.tolist()), 1.0) for place in placed]


def processed(root: Path) -> Campaign:
    campaign = Campaign.load(root)
    with contextlib.redirect_stdout(io.StringIO()):
        for flight in campaign.image_flights:
            image_steps(campaign, flight)
            for pair in flight.pairs:
                layers.layers(campaign, flight.name, pair)
        for name in campaign.settings.interferometry.pairs:
            interferogram.interferogram(campaign, name)
    return campaign


def measured(alone: list[Campaign], empty: Campaign, flight: str, pair: str, design):
    """Return predicted and measured at the points: widths along both axes, NESZ, SNR; and coverage.

    Each point stands alone in its image: the sidelobe of another bends its width by up to 8 % on a hill. Noise is the
    mean power of the same image without anything in its scene.
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
        seen = raster.read(1) == 0
    rows, half = [], grid.shape[0] * grid.spacing_m / 2
    for target, pixels in zip(points(opened, half), images, strict=True):
        row, column = (round(float(one)) for one in grid.pixel_of(*target[:2]))
        if not seen[row, column]:
            continue
        peak = find_peak(pixels, row, column)
        azimuth = np.radians(planned.layers["orientation"][row, column])
        ways = (np.sin(azimuth), np.cos(azimuth)), (np.cos(azimuth), -np.sin(azimuth))
        cuts = [cut_through(pixels, peak, direction=way, spacing_m=grid.spacing_m, reach_m=half / 2) for way in ways]
        place = opened.terrain.positions_at(grid, np.array([row]), np.array([column]))
        snr_db = 10 * np.log10(abs(peak.value) ** 2 / (noise * calibration.at(place)[1][0]))
        predicted = [planned.layers[name][row, column] for name in LAYERS]
        rows.append((predicted, [cuts[0].width_m, cuts[1].width_m, nesz[row, column], snr_db]))
    cover = 100 * np.array([(planned.layers["mask"] == 0).mean(), seen.mean()])
    return np.array(rows), cover


def peaks_db(campaign: Campaign, flight: str, pair: str):
    opened = open_scene(campaign)
    pixels = open_stage(campaign.stage("image", flight, pair), "image").image.values
    half = opened.grid.shape[0] * opened.grid.spacing_m / 2
    at = [opened.grid.pixel_of(*place[:2]) for place in points(opened, half)]
    return np.array([20 * np.log10(abs(find_peak(pixels, *map(round, map(float, one))).value)) for one in at])


def compare(name: str, folder: Path, draws: int):
    """Yield rows: pair, quantity, predicted, measured, apart."""
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
            both = float(np.median(own["coherence"][inner])), float(np.nanmedian(values[inner]))
            yield two, "coherence", *both, f"{both[1] - both[0]:+.3f}"
        return
    targets = standing(design.opened.scene, half)
    alone = [processed(rehearse(design.opened, [one], folder / str(at))) for at, one in enumerate(targets)]
    campaign = processed(rehearse(design.opened, targets, folder / "right"))
    empty = processed(rehearse(design.opened, [PointTarget((0.0, 0.0, 0.0), 1e-9)], folder / "empty"))
    pairs = [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]
    for flight, pair in pairs:
        rows, cover = measured(alone, empty, flight, pair, design)
        for at, what in enumerate(("finer width, m", "coarser width, m", "NESZ, dB", "SNR, dB")):
            predicted, found = rows[:, 0, at], rows[:, 1, at]
            off = found - predicted if at > 1 else 100 * (found / predicted - 1)
            worst = off[np.nanargmax(np.abs(off))]
            unit = "dB" if at > 1 else "%"
            line = f"{np.nanmean(off):+.2f} {unit}, worst {worst:+.2f}"
            yield pair, what, np.median(predicted), np.nanmedian(found), line
        yield pair, "coverage, %", *cover, f"{cover[1] - cover[0]:+.2f} %"
    if planned.nodes["uav1"].position_std_m:
        lost = {pair: [] for _, pair in pairs}
        for seed in range(draws):
            wrong = processed(rehearse(design.opened, targets, folder / "draw", seed=seed + 2, erring=True))
            for flight, pair in pairs:
                lost[pair].append((peaks_db(campaign, flight, pair) - peaks_db(wrong, flight, pair)).mean())
            shutil.rmtree(folder / "draw")
        for flight, pair in pairs:
            predicted = float(np.median(design.images[f"{flight}/{pair}"].layers["loss"]))
            mean, std = float(np.mean(lost[pair])), float(np.std(lost[pair])) / draws**0.5
            line = f"{100 * (mean / predicted - 1):+.0f} %, ± {100 * std / predicted:.0f} %"
            yield pair, "loss, dB", predicted, mean, line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=list(PLANS), default=list(PLANS))
    parser.add_argument("--draws", type=int, default=8)
    asked = parser.parse_args()
    console = Console(width=150)
    for name in asked.only:
        table = Table(title=name, title_justify="left")
        for heading in ("pair", "quantity", "predicted", "measured", "apart"):
            table.add_column(heading)
        for pair, what, predicted, found, apart in compare(name, asked.folder / name.replace(" ", "_"), asked.draws):
            table.add_row(pair, what, f"{predicted:.4g}", f"{found:.4g}", apart)
        console.print(table)
        shutil.rmtree(asked.folder / name.replace(" ", "_"))


if __name__ == "__main__":
    main()
