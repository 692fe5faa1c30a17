"""Stack of four flights over a slope that moves: files, residual phase, coherence, baselines, exclusion, bad config."""

import csv
import json

import numpy as np
import pytest
import rasterio
from folders import complaint, contents, copy_writable, edit_config
from test_40_graph import check

from apertura.campaign.config import Stack
from apertura.campaign.folder import Campaign
from apertura.formats.export import exports_in
from apertura.methods.interferometry.coherence import box_sum
from apertura.run.process import process
from apertura.simulation import Clutter, ImageGrid, PointTarget, TargetChange, simulate
from apertura.simulation.presets import revisit
from apertura.stages.stack import stack, stack_image
from apertura.views.summary import print_summary
from apertura.views.verify.chain import print_verified
from apertura.workflow.lineage import result_of

PAIR, WINDOW, HALF_M, SPACING_M = "uav1-uav1", 11, 5.0, 0.125
MM = 299_792_458 / (1.2e9 + 1.6e6 * 127.5) / (4 * np.pi) * 1e3
SLOPE = (1.5, 0.5, 4.5, 3.5)
FLIGHTS = ("f01", "f02", "f03", "f04")


def small_revisit(**choices):
    """Return four flights over 12 m × 12 m; the whole scene of the last flight is unrelated to the others."""
    from dataclasses import replace

    flown = revisit(flights=4, slope_mm=0.0, **choices)
    towards = np.array([0.0, -27.0, 25.0]) / np.hypot(27.0, 25.0)
    bounds = ((-6, -6, 6, 0.5), (-6, 3.5, 6, 6), (-6, 0.5, 1.5, 3.5), (4.5, 0.5, 6, 3.5))
    clutter = [Clutter(SLOPE, 1.0, 25.0), *(Clutter(tuple(map(float, edges)), 1.0, 25.0) for edges in bounds)]
    points = [PointTarget((-3.0, -3.0, 0.0), 6.0), PointTarget((3.5, -3.5, 0.0), 6.0)]
    other = Clutter((-6.0, -6.0, 6.0, 6.0), 1.0, 25.0)
    moved = {"f02": 0.001, "f03": 0.003}
    flights = []
    for flight in flown.flights:
        changes = [TargetChange(len(clutter) + len(points), factor=0.0)]
        if flight.name in moved:
            changes.append(TargetChange(0, shift_m=tuple(towards * moved[flight.name])))
        if flight.name == "f04":
            changes = [TargetChange(number, factor=0.0) for number in range(len(clutter) + len(points))]
        flights.append(replace(flight, changes=tuple(changes)))
    grid = ImageGrid("EPSG:32632", half_width_m=HALF_M, spacing_m=SPACING_M)
    return replace(flown, targets=(*clutter, *points, other), flights=tuple(flights), scene=grid)


def stacked(config):
    """Configure the stack."""
    config["processing"] = {"autofocus": "off"}
    config["stack"] = {"reference": "f01", "flights": list(FLIGHTS[1:]), "pair": PAIR, "window_px": WINDOW}


@pytest.fixture(scope="module")
def small(made_once):
    def made(root):
        simulate(root, small_revisit(pulses=60, error_m=0.004))
        edit_config(root, stacked)
        process(root)

    return made_once("stack", made)


def raster(root, flight, name):
    """Return a raster of a flight of the stack."""
    with rasterio.open(root / "results/stack" / flight / name) as opened:
        return opened.read(1)


def report_of(root, flight):
    """Return the report of a flight of the stack."""
    return json.loads((root / "results/stack" / flight / "stack.json").read_text())


def displacement_mm(root, flight):
    """Return displacements towards the antennas of windows on the slope, and on stable ground."""
    half = WINDOW // 2
    product = raster(root, flight, "slc.tif") * raster(root, "f01", "slc.tif").conj()
    moved = np.angle(box_sum(product, WINDOW))[half::WINDOW, half::WINDOW] * MM
    rows, columns = np.indices(product.shape)[:, half::WINDOW, half::WINDOW]
    east, north = (columns + 0.5) * SPACING_M - HALF_M, HALF_M - (rows + 0.5) * SPACING_M
    outside = np.max([SLOPE[0] - east, east - SLOPE[2], SLOPE[1] - north, north - SLOPE[3]], axis=0)
    return moved[outside < -0.7], moved[outside > 0.7]


@pytest.mark.slow
def test_stack_writes_its_files_and_is_verified(small, capsys):
    files = {export.file for export in exports_in("stack")} | {"stack.json", "stack_image.manifest.json"}
    changes = {export.file for export in exports_in("change")} | {"change.json", "change.manifest.json"}
    for flight in FLIGHTS:
        found = {path.name for path in (small / "results/stack" / flight).iterdir()}
        assert found == files | (changes if flight != "f01" else set())
    with rasterio.open(small / "results/stack/f02/slc.tif") as opened:
        tags = opened.tags()
        assert opened.dtypes == ("complex64",)
    assert tags["APERTURA_STACK_REFERENCE"] == "f01"
    assert "flat-earth and terrain phase are absent" in tags["APERTURA_PHASE"]
    assert raster(small, "f02", "phase_flattened.tif") == pytest.approx(np.angle(raster(small, "f02", "slc.tif")))
    print_verified(small, [small / "results/stack/f02/slc.tif"])
    assert "residual" not in capsys.readouterr().err


@pytest.mark.slow
def test_reference_is_unchanged_and_other_flights_lose_the_residual_phase(small):
    with rasterio.open(small / "results/f01" / PAIR / "slc.tif") as opened:
        assert np.array_equal(raster(small, "f01", "slc.tif"), opened.read(1))
    assert not raster(small, "f01", "residual_phase.tif").any()
    with rasterio.open(small / "results/f02" / PAIR / "slc.tif") as opened:
        image = opened.read(1)
    removed = np.angle(image * raster(small, "f02", "slc.tif").conj())
    assert np.abs(np.exp(1j * removed) - np.exp(1j * raster(small, "f02", "residual_phase.tif"))).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("flight", "true_mm"), [("f02", 1.0), ("f03", 3.0)])
def test_displacement_of_a_slope_is_measured_and_stable_ground_stays(small, flight, true_mm):
    slope, stable = displacement_mm(small, flight)
    assert np.median(slope) == pytest.approx(true_mm, abs=1.0)
    assert np.median(np.abs(stable)) < 1.0
    report = report_of(small, flight)
    assert report["residual_phase_std_rad"] < 0.3
    assert report["used"]


@pytest.mark.slow
def test_coherence_of_the_stack_equals_the_expected_coherence(small):
    for flight in ("f02", "f03"):
        report = report_of(small, flight)
        assert report["coherence"] == pytest.approx(report["expected_coherence"], abs=0.03)
        assert "stack_decorrelated" not in report["flags"]


@pytest.mark.slow
def test_baselines_of_the_stack_are_those_of_the_tracks(small):
    rows = {row["flight"]: row for row in csv.DictReader((small / "results/stack/baselines.csv").open())}
    assert list(rows) == list(FLIGHTS)
    # tracks are 0.1 m apart across the line of sight, up to the errors of the logs
    assert abs(float(rows["f02"]["perpendicular_baseline_m"])) == pytest.approx(0.1, abs=0.012)
    assert float(rows["f03"]["perpendicular_baseline_m"]) == pytest.approx(0.0, abs=0.012)
    assert float(rows["f03"]["temporal_baseline_days"]) == pytest.approx(2.0)
    wavelength_m, range_m = MM * 4e-3 * np.pi, np.hypot(25.0, 25.0)
    expected_m = wavelength_m * range_m * np.sin(np.radians(45)) / (2 * 0.1)
    assert float(rows["f02"]["height_of_ambiguity_m"]) == pytest.approx(expected_m, rel=0.05)


@pytest.mark.slow
def test_unrelated_flight_is_left_out_and_named(small, capsys):
    report = report_of(small, "f04")
    assert not report["used"]
    assert list(report["flags"]) == ["stack_flight_excluded"]
    listed = json.loads((small / "results/stack/stack.json").read_text())
    assert listed["flights"] == list(FLIGHTS[:3])
    assert listed["excluded"] == {"f04": report["reason"]}
    change = json.loads((small / "results/stack/f04/change.json").read_text())
    assert change["says"].startswith("left out of the stack")
    assert not any(change["pixels"].values())
    print_summary(Campaign.load(small))
    message = " ".join(capsys.readouterr().out.split())
    assert f"stack f04: left out: {report['reason']}" in message
    assert "stack f02: perpendicular baseline" in message


@pytest.mark.slow
def test_stack_is_reproduced_byte_for_byte(small, tmp_path):
    again = copy_writable(small, tmp_path / "again")
    before = contents(again / "results/stack")
    campaign = Campaign.load(again)
    for flight in FLIGHTS:
        stack_image(campaign, flight)
    stack(campaign)
    assert contents(again / "results/stack") == before


@pytest.mark.slow
def test_rules_of_a_stack_match_lineage(small, tmp_path):
    root = copy_writable(small, tmp_path / "again")
    assert check(root) >= {"stack_image", "stack"}
    sources = result_of(Campaign.load(root), "stack_image", "f02").sources
    assert {f"results/{flight}/{PAIR}/image.manifest.json" for flight in ("f01", "f02")} <= set(sources)


@pytest.mark.parametrize(
    ("requested", "expected"),
    [
        ({"reference": "f01", "flights": ["f09"], "pair": PAIR}, "no image 'f09/uav1-uav1'"),
        ({"reference": "f01", "flights": ["f01"], "pair": PAIR}, "each flight may be named once"),
        ({"reference": "f01", "flights": [], "pair": PAIR}, "stack.flights"),
        ({"reference": "f01", "flights": ["f09"], "pair": PAIR, "window_px": 8}, "must be odd"),
        ({"reference": "stack", "flights": ["f01"], "pair": PAIR}, "reserved for files in the results folder"),
    ],
)
def test_invalid_stack_is_refused(tiny, requested, expected):
    edit_config(tiny, lambda config: config.update(stack=requested))
    assert expected in complaint(lambda: Campaign.load(tiny))


def test_campaign_without_a_stack_has_no_results_of_it(tiny):
    campaign = Campaign.load(tiny)
    assert campaign.settings.stack is None
    assert "no stack is configured" in complaint(lambda: stack(campaign))
    assert "none is configured" in complaint(lambda: result_of(campaign, "stack_image", "f01"))
    assert Stack(reference="a", flights=("b",), pair="c-c").all_flights == ("a", "b")
