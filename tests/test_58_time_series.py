"""Stacks handed to dolphin and MintPy: displacement time series, their signs, and the point layer for QGIS.

Programs run in environments of their own: APERTURA_DOLPHIN and APERTURA_MINTPY name the interpreters, by default
build/dolphin/bin/python and build/mintpy/bin/python (docs/howto/time_series.md). Tests are skipped without them.
"""

import json
import os
import subprocess
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
import rasterio
import yaml
from folders import ROOT, edit_config
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.run.driver import run_workflow
from apertura.simulation import simulate
from apertura.simulation.presets import demo, revisit
from apertura.tools.export_stack import DATE_FORMAT, dolphin_config, write_stack
from apertura.tools.time_series import DolphinResult, write_time_series

PINNED = {"dolphin": "0.42.9", "mintpy": "1.6.4"}
WAVELENGTH_M, SPACING_M, STRIDE, SHAPE = 0.031, 0.25, 3, (240, 300)
UTM = {"crs": "EPSG:32632", "transform": from_origin(500000, 5300000, SPACING_M, SPACING_M)}
MOVES_M = {"stable": 0.0, "slow": 1e-3, "fast": 3e-3}
"""Ground → motion towards the sensor from flight to flight."""


def place(program):
    """Return the path of the interpreter in which a program may be installed."""
    return Path(os.environ.get(f"APERTURA_{program.upper()}", ROOT / f"build/{program}/bin/python"))


def interpreter(program):
    """Return the interpreter in which a program of the pinned version is installed; skip without it."""
    path = place(program)
    if not path.exists():
        pytest.skip(f"{program} is not installed: APERTURA_{program.upper()} or build/{program}")
    asked = f"from importlib.metadata import version; print(version('{program}'))"
    found = subprocess.run([path, "-c", asked], check=True, capture_output=True, text=True).stdout.strip()
    if found != PINNED[program]:
        pytest.skip(f"{program} {found} is installed, the tests are written for {PINNED[program]}")
    return path


def run_dolphin(folder):
    command = [interpreter("dolphin").parent / "dolphin", "run", "dolphin_config.yaml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def run_mintpy(folder):
    """Run the steps of smallbaselineApp that the how-to names; return the displacements, (time, y, x) metres."""
    program = [interpreter("mintpy").parent / "mintpy", "smallbaselineApp", "mintpy.cfg"]
    for steps in (["--start", "modify_network", "--end", "reference_point"], ["--start", "invert_network"]):
        subprocess.run([*program, *steps], cwd=folder / "mintpy", check=True, capture_output=True)
    with h5py.File(folder / "mintpy/timeseries.h5") as file:
        return file["timeseries"][:]


def times(hours):
    return [(datetime(2026, 5, 1, 9) + timedelta(hours=hours * number)).strftime(DATE_FORMAT) for number in range(5)]


def grounds(shape, spacing_m):
    """Return masks of the stable ground and of two slopes, without their edges."""
    y, x = np.mgrid[: shape[0], : shape[1]] * spacing_m
    inside = (y > 22) & (y < 38)
    parts = {"slow": inside & (x > 12) & (x < 28), "fast": inside & (x > 47) & (x < 63)}
    around = (y > 17) & (y < 43) & (((x > 7) & (x < 33)) | ((x > 42) & (x < 68)))
    return parts | {"stable": ~around}


def write_raster(path, values, **place):
    values = values if values.ndim == 3 else values[None]
    path.parent.mkdir(parents=True, exist_ok=True)
    layout = {"driver": "GTiff", "dtype": values.dtype, "count": len(values), "nodata": np.nan} | UTM | place
    if values.dtype == np.uint8:
        layout["nodata"] = 255
    with rasterio.open(path, "w", height=values.shape[1], width=values.shape[2], **layout) as raster:
        raster.write(values)


def write_handoff(folder, *, hours, reference_point=(2, 45)):
    """Write geometry, mask and description of a stack as `apertura export stack` does; return its times."""
    sight = np.broadcast_to(np.float32([0.6, 0.0, 0.8])[:, None, None], (3, *SHAPE))  # the sensor is in the east
    write_raster(folder / "geometry/line_of_sight_enu.tif", sight)
    write_raster(folder / "geometry/slant_range_distance.tif", np.full((2, *SHAPE), 100, np.float32))
    write_raster(folder / "geometry/height.tif", np.full(SHAPE, 20, np.float32))
    write_raster(folder / "mask.tif", np.ones(SHAPE, np.uint8))
    names = times(hours)
    flights = [
        {
            "flight": f"f{number:02d}",
            "time": name,
            "perpendicular_baseline_m": 0.5 * number,
            "temporal_baseline_days": number * hours / 24,
        }
        for number, name in enumerate(names)
    ]
    row, column = ((at + 0.5) * STRIDE * SPACING_M for at in reference_point)
    handoff = {"wavelength_m": WAVELENGTH_M, "heading_deg": 0.0, "flights": flights}
    handoff["reference_point_m"] = [500000 + column, 5300000 - row]
    (folder / "handoff.json").write_text(json.dumps(handoff))
    return names


def write_images(folder, names):
    """Write images of terrain with coherence 0.96, whose slopes move towards the sensor: φ = 4π/λ d (layers.md, 1c)."""
    rng = np.random.default_rng(1)

    def speckle():
        values = rng.normal(size=(2, *SHAPE))
        values = np.stack([gaussian_filter(part, 1.2) for part in values])
        return (values[0] + 1j * values[1]) / values.std()

    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] * SPACING_M
    common, inside = speckle(), (y > 20) & (y < 40)
    moves = 1e-3 * (inside & (x > 10) & (x < 30)) + 3e-3 * (inside & (x > 45) & (x < 65))
    for number, name in enumerate(names):
        image = (0.98 * common + 0.2 * speckle()) * np.exp(4j * np.pi / WAVELENGTH_M * moves * number)
        write_raster(folder / f"slc/{name}.slc.tif", image.astype(np.complex64))
    images = [f"slc/{name}.slc.tif" for name in names]
    options = {"window_px": 15, "stride": STRIDE, "phase_std_rad": 0.05, "reference_point": (2, 45)}
    config = dolphin_config(images, WAVELENGTH_M, **options)
    (folder / "dolphin_config.yaml").write_text(yaml.safe_dump(config))


@pytest.mark.slow
@pytest.mark.parametrize("hours", [2, 24])
def test_displacement_towards_the_sensor_is_positive_in_dolphin_and_mintpy(tmp_path, hours):
    """Slopes move by 0, 1 and 3 mm a flight, more than a wrap in all: dolphin and MintPy find them within 1 mm.

    Every two hours: file names with times keep the flights of a day apart.
    """
    names = write_handoff(tmp_path, hours=hours)
    write_images(tmp_path, names)
    run_dolphin(tmp_path)
    found = {}
    for number, name in enumerate(names[1:], 1):
        with rasterio.open(tmp_path / f"dolphin/timeseries/{names[0]}_{name}.tif") as raster:
            displacement_m = raster.read(1)
        for ground, mask in grounds(displacement_m.shape, STRIDE * SPACING_M).items():
            error = displacement_m[mask] - MOVES_M[ground] * number
            assert abs(np.median(error)) < 0.5e-3, (name, ground)
            assert np.sqrt(np.mean(error**2)) < 1e-3, (name, ground)
        found[number] = displacement_m
    write_time_series(tmp_path)
    by_mintpy = run_mintpy(tmp_path)
    known = by_mintpy[4] != 0
    assert known.mean() > 0.9
    assert np.abs(by_mintpy[4] - found[4])[known].max() < 1e-4


# ---- Campaign of five flights: from raw samples to displacements ----------------------------------------------------


def stacked(root, *, slope_mm):
    """Simulate five flights past a slope that moves towards the antennas, and form their stack."""
    simulate(root, revisit(slope_mm=slope_mm), seed=1)
    edit_config(root, lambda config: config.update(processing={"autofocus": "off"}))
    assert run_workflow(root, 2, "--until", "stack") == 0


def displacements(folder):
    """Return displacements (time, y, x) in mm, the spacing in m, and masks of the slope and of stable ground."""
    result = DolphinResult.open(folder)
    moved_mm, transform = 1e3 * result.displacement_m, result.profile["transform"]
    rows, columns = np.mgrid[: moved_mm.shape[1], : moved_mm.shape[2]]
    east, north = transform.a * (columns + 0.5) - 11, 11 - transform.a * (rows + 0.5)  # scene of 22 m x 22 m
    areas = {
        "slope": (np.abs(east - 5) < 1.6) & (np.abs(north - 4) < 1.6),
        "stable ground": ((np.abs(east - 5) > 3.5) | (np.abs(north - 4) > 3.5)) & (north > -3),  # targets change south
    }
    return moved_mm, transform.a, areas


def trues_mm(slope_mm):
    """Return the simulated displacements of both areas."""
    return {"slope": slope_mm * np.arange(5), "stable ground": np.zeros(5)}


@pytest.mark.slow
def test_dolphin_measures_the_motion_of_a_simulated_slope(tmp_path):
    """Tracks 0.1 m apart, logs with errors of 1 cm: 3 mm a flight, relative to stable ground, within 2 mm."""
    interpreter("dolphin")
    stacked(tmp_path / "campaign", slope_mm=3.0)
    campaign = Campaign.load(tmp_path / "campaign")
    written = write_stack(campaign, tmp_path / "series")
    assert written[1].name == "20250515T093000.slc.tif"
    assert written[1].read_bytes() == Path(str(campaign.result("stack", "f02", "slc.tif"))).read_bytes()
    with rasterio.open(tmp_path / "series/mask.tif") as raster:
        assert set(np.unique(raster.read(1))) <= {0, 1}
        assert raster.read(1).mean() > 0.9
    handoff = json.loads((tmp_path / "series/handoff.json").read_text())
    assert handoff["wavelength_m"] == pytest.approx(299792458 / 1.404e9, rel=1e-3)
    assert [one["temporal_baseline_days"] for one in handoff["flights"]] == pytest.approx([0, 1, 2, 3, 4])
    east, north = np.subtract(handoff["reference_point_m"], (570661.25, 5363707.25))
    assert abs(east - 5) > 2.5 or abs(north - 4) > 2.5  # on stable ground
    run_dolphin(tmp_path / "series")
    moved_mm, _, areas = displacements(tmp_path / "series")
    median = {name: np.nanmedian(moved_mm[:, mask], axis=1) for name, mask in areas.items()}
    relative = median["slope"] - median["stable ground"]
    assert np.abs(relative - trues_mm(3.0)["slope"]).max() < 2.0
    assert np.nanstd(moved_mm[:, areas["stable ground"]], axis=1).max() < 2.0


def write_dolphin_result(folder, names, *, moves_mm, coherence):
    """Write rasters as dolphin does, of a displacement that grows from flight to flight."""
    place = {"transform": from_origin(500000, 5300000, STRIDE * SPACING_M, STRIDE * SPACING_M)}
    shape = moves_mm.shape
    for number, name in enumerate(names[1:], 1):
        since = (1e-3 * number * moves_mm).astype(np.float32)
        write_raster(folder / f"dolphin/timeseries/{names[0]}_{name}.tif", since, nodata=0.0, **place)
        pair = f"{names[number - 1]}_{name}"
        phase = (-4 * np.pi / WAVELENGTH_M * 1e-3 * moves_mm).astype(np.float32)
        write_raster(folder / f"dolphin/unwrapped/{pair}.unw.tif", phase, **place)
        write_raster(folder / f"dolphin/unwrapped/{pair}.unw.conncomp.tif", np.ones(shape, np.float32), **place)
        write_raster(folder / f"dolphin/interferograms/{pair}.int.cor.tif", np.full(shape, 0.9, "f4"), **place)
    last = f"temporal_coherence_{names[0]}_{names[-1]}.tif"
    write_raster(folder / f"dolphin/interferograms/{last}", coherence.astype(np.float32), **place)


@pytest.mark.parametrize("hours", [6, 24])
def test_points_have_the_fields_that_insar_explorer_reads(tmp_path, hours):
    """Fields D<YYYYMMDD> in mm, one a day: of several flights a day the last; each flight has a field T<time>."""
    names = write_handoff(tmp_path, hours=hours)
    shape = tuple(size // STRIDE for size in SHAPE)
    coherence = np.ones(shape)
    coherence[:, :50] = 0.3
    write_dolphin_result(tmp_path, names, moves_mm=np.full(shape, 2.0), coherence=coherence)
    written = write_time_series(tmp_path)
    assert written[-1] == tmp_path / "displacement.geojson"
    points = json.loads(written[-1].read_text())["features"]
    assert len(points) == coherence[:, 50:].size
    fields = points[0]["properties"]
    assert fields["velocity"] == pytest.approx(2.0 / (hours / 24) * 365.25, abs=0.01)
    if hours == 24:
        assert [fields[f"D{name[:8]}"] for name in names] == [0, 2, 4, 6, 8]
        assert not any(name.startswith("T") for name in fields)
    else:  # 9, 15 and 21 h of the first day, 3 and 9 h of the second day
        assert (fields["D20260501"], fields["D20260502"]) == (4, 8)
        assert [fields[f"T{name}"] for name in names] == [0, 2, 4, 6, 8]
    longitude, latitude = points[0]["geometry"]["coordinates"]
    with rasterio.open(tmp_path / f"dolphin/timeseries/{names[0]}_{names[1]}.tif") as raster:
        expected = rasterio.warp.transform("EPSG:32632", "EPSG:4326", *([at] for at in raster.xy(0, 50)))
    assert (longitude, latitude) == pytest.approx((expected[0][0], expected[1][0]), abs=1e-8)


def test_inputs_of_mintpy_have_its_angles_and_units(tmp_path):
    """MintPy measures the azimuth of the line of sight counterclockwise from north, of a sensor in the east: -90°."""
    names = write_handoff(tmp_path, hours=24)
    shape = tuple(size // STRIDE for size in SHAPE)
    write_dolphin_result(tmp_path, names, moves_mm=np.full(shape, 2.0), coherence=np.ones(shape))
    write_time_series(tmp_path)
    with h5py.File(tmp_path / "mintpy/inputs/geometryGeo.h5") as file:
        assert np.allclose(file["azimuthAngle"], -90)
        assert np.allclose(file["incidenceAngle"], np.degrees(np.arccos(0.8)), atol=1e-4)
        assert np.allclose(file["slantRangeDistance"], 100)
        assert (file.attrs["UTM_ZONE"], file.attrs["X_STEP"], file.attrs["Y_STEP"]) == ("32N", "0.75", "-0.75")
        assert float(file.attrs["HEIGHT"]) == pytest.approx(20 + 100 * 0.8)
    with h5py.File(tmp_path / "mintpy/inputs/ifgramStack.h5") as file:
        assert [tuple(pair) for pair in file["date"][:].astype(str)] == list(pairwise(names))
        assert np.allclose(file["bperp"], 0.5)
        assert np.allclose(file["unwrapPhase"], -4 * np.pi / WAVELENGTH_M * 2e-3)
    assert "mintpy.reference.yx = 2,45" in (tmp_path / "mintpy/mintpy.cfg").read_text()


def test_campaign_without_a_stack_is_refused(tmp_path):
    simulate(tmp_path / "campaign", demo(pulses=4), seed=1)
    with pytest.raises(CampaignError, match=r"no stack is configured.*Add the section stack"):
        write_stack(Campaign.load(tmp_path / "campaign"), tmp_path / "series")
    assert not (tmp_path / "series").exists()


def test_folder_without_a_result_of_dolphin_is_refused(tmp_path):
    with pytest.raises(CampaignError, match=r"handoff\.json.*Run `apertura export stack` first"):
        write_time_series(tmp_path)
    for damaged in ("{}", '{"flights": [1, 2]}', '{"flights": []}'):
        (tmp_path / "handoff.json").write_text(damaged)
        with pytest.raises(CampaignError, match=r"no flights.*Run `apertura export stack` first"):
            write_time_series(tmp_path)
    write_handoff(tmp_path, hours=24)
    with pytest.raises(CampaignError, match=r"a result of dolphin.*dolphin run dolphin_config\.yaml"):
        write_time_series(tmp_path)


@pytest.mark.parametrize("flights", [3, 5, 20])
def test_persistent_scatterers_are_as_good_as_their_window(flights):
    """Of pixels with the deviation of the phase of a window, 1 % are selected by chance, with any number of flights.

    The amplitude dispersion of dolphin is the standard deviation of the amplitudes, divided by their mean.
    """
    options = {"window_px": 15, "stride": 3, "reference_point": (0, 0)}
    config = dolphin_config(flights * ["a.tif"], 0.25, phase_std_rad=0.1, **options)
    amplitudes = 1 + 0.1 * np.random.default_rng(1).normal(size=(200_000, flights))
    dispersion = amplitudes.std(axis=1) / amplitudes.mean(axis=1)
    selected = (dispersion < config["ps_options"]["amp_dispersion_threshold"]).mean()
    assert selected == pytest.approx(0.01, abs=0.002)
    assert config["phase_linking"]["half_window"] == {"x": 7, "y": 7}
    noisy = dolphin_config(flights * ["a.tif"], 0.25, phase_std_rad=3.0, **options)
    assert noisy["ps_options"]["amp_dispersion_threshold"] <= 0.25
