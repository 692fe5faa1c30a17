"""Interferogram of two flights over a ramp: height map, files, tags, flags and invalid configs."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import xarray as xr
from folders import complaint, contents, copy_writable, edit_config

from apertura.campaign.config import Interferometry
from apertura.campaign.folder import Campaign
from apertura.core.quality.budget import NodePositions
from apertura.formats.catalog.validation import stac_problems
from apertura.formats.export import exports_in
from apertura.run.process import process
from apertura.simulation import (
    CampaignSpecification,
    Clutter,
    ImageGrid,
    Impairments,
    Origin,
    PointTarget,
    SimulatedFlight,
    SimulatedNode,
    Straight,
    WaveformSpecification,
    simulate,
)
from apertura.stages import interferogram as step
from apertura.stages.interferogram import interferogram
from apertura.stages.tags import copied_inputs
from apertura.views.summary import print_summary
from apertura.views.verify.chain import print_verified
from apertura.views.webmap.server import served
from apertura.workflow.lineage import result_of

SLOPE = (0.03, 0.06)
MARKS = ((-3.0, -2.5), (3.0, 3.0))
NAME = "two_tracks"
FILES = {export.file for export in exports_in("interferogram")} | {"interferogram.json"}


def two_flights(*, half_width_m, density_per_m2, pulses=60, rise_m=1.0):
    """Return a specification: two passes over a ramp at two heights; the config states flat terrain and two points."""
    step_m, velocity = 12.0 / pulses, (120.0 / pulses, 0.0, 0.0)
    edge = half_width_m + 1.5

    def flight(name, up_m, start):
        track = Straight((-step_m / 2 * (pulses - 1), -25.0, up_m), velocity)
        return SimulatedFlight(name, "uav1", {"uav1": track}, pulses, start_utc=start)

    marks = tuple(PointTarget((e, n, SLOPE[0] * e + SLOPE[1] * n), 12.0) for e, n in MARKS)
    return CampaignSpecification(
        "ramp",
        Origin(48.0, 9.0, 500.0),
        WaveformSpecification(256, 1.2e9, 1.6e6, 0.625e-6, 0.5e-6, 512e6, 10.0),
        (Clutter((-edge, -edge, edge, edge), 1.0, density_per_m2, slope=SLOPE), *marks),
        {"uav1": SimulatedNode(impairments=Impairments(radar_snr_db=30.0))},
        (flight("f01", 25.0, "2025-05-14T09:30:00"), flight("f02", 25.0 + rise_m, "2025-05-14T10:30:00")),
        ImageGrid("EPSG:32632", half_width_m=half_width_m, spacing_m=0.125),
    )


def run_ramp(folder, **choices):
    """Run a campaign with one configured interferogram and return its folder."""
    root = simulate(folder / "ramp", two_flights(**choices))
    truth = json.loads((root / "truth.json").read_text())["targets"]
    points = [
        {"name": f"mark {number}", "position_m": [target["x"], target["y"], target["height_m"]], "std_m": 0.02}
        for number, target in enumerate(truth)
    ]

    def configure(config):
        config["scene"]["reference_points"] = points
        config["processing"] = {"autofocus": "off"}
        config["interferometry"] = {"pairs": {NAME: ["f01/uav1-uav1", "f02/uav1-uav1"]}}

    edit_config(root, configure)
    process(root)
    return root


def read(root, name):
    with rasterio.open(root / "results/interferometry" / NAME / f"{name}.tif") as raster:
        return raster.read(1), raster.transform, raster.tags(), raster.units[0]


def ramp_at(root, transform, shape):
    """Return the heights of the ramp at the map pixels, from its two marks."""
    first, second = json.loads((root / "truth.json").read_text())["targets"]
    scale = (second["x"] - first["x"]) / (MARKS[1][0] - MARKS[0][0])  # scale of the projection
    column, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = transform.c + transform.a * column, transform.f + transform.e * row
    return first["height_m"] + (SLOPE[0] * (x - first["x"]) + SLOPE[1] * (y - first["y"])) / scale


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return run_ramp(tmp_path_factory.mktemp("small"), half_width_m=5.0, density_per_m2=8)


@pytest.mark.slow
def test_every_product_is_written_with_its_tags(small):
    folder = small / "results/interferometry" / NAME
    assert {path.name for path in folder.iterdir()} == FILES | {"interferogram.manifest.json"}
    report = json.loads((folder / "interferogram.json").read_text())
    assert report["images"] == ["f01/uav1-uav1", "f02/uav1-uav1"]
    assert report["level"]["points"] == ["mark 0", "mark 1"]
    for name, unit in (
        ("phase", "rad"),
        ("coherence", "1"),
        ("unwrapped", "rad"),
        ("height", "m"),
        ("height_std", "m"),
    ):
        _, transform, tags, raster_unit = read(small, name)
        assert raster_unit == unit
        assert transform.a == 0.125
        assert tags["APERTURA_LEVEL"].startswith("heights relative to mark 0 and mark 1")
        assert json.loads(tags["APERTURA_FLAGS"]) == report["flags"]
        spec = json.loads(tags["APERTURA_RUNSPEC"])
        assert spec["images"] == report["images"]
        assert set(spec) >= {"f01/uav1-uav1", "f02/uav1-uav1"}
    assert (folder / "quicklook.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_lineage_of_an_interferogram_includes_both_images(small):
    sources = result_of(Campaign.load(small), "interferogram", NAME).sources
    for flight in ("f01", "f02"):
        for stage in ("echo", "profile", "image", "layers"):
            assert f"results/{flight}/uav1-uav1/{stage}.manifest.json" in sources
    manifest = json.loads((small / "results/interferometry" / NAME / "interferogram.manifest.json").read_text())
    assert set(manifest["sources"]) == set(sources)


@pytest.mark.slow
def test_interferogram_is_on_the_map_and_in_the_catalogue(small):
    entry = json.loads((small / "results/map/map.json").read_text())["images"][-1]
    assert (entry["flight"], entry["image"], entry["verdict"]) == ("interferometry", NAME, "interferogram")
    styles = {layer["file"]: (layer["kind"], layer["low"], layer["high"]) for layer in entry["layers"]}
    assert styles["phase.tif"] == ("phase", -np.pi, np.pi)
    assert styles["coherence.tif"] == ("measure", 0.0, 1.0)
    assert set(styles) == {name for name in FILES if name.endswith(".tif")}
    with served(Campaign.load(small)) as server:
        assert {f"interferometry/{NAME}/{file}" for file in styles} <= server.files().keys()
    assert stac_problems(small / "results/stac") == []
    item = json.loads((small / f"results/stac/images/interferometry/{NAME}.json").read_text())
    assert item["assets"]["unwrapped"]["roles"] == ["data", "unwrapped_phase"]
    assert item["properties"]["insar:temporal_baseline"] == pytest.approx(1 / 24, abs=1e-5)
    baseline_m = np.sqrt(0.5)  # a metre higher, at an incidence of 45 degrees
    assert item["properties"]["insar:perpendicular_baseline"] == pytest.approx(baseline_m, rel=0.03)
    ambiguity_m = 0.2142 * np.hypot(25, 25) * np.sin(np.pi / 4) / (2 * baseline_m)
    assert item["properties"]["insar:height_of_ambiguity"] == pytest.approx(ambiguity_m, rel=0.05)
    links = {link["rel"]: link["href"] for link in item["links"]}
    assert links["reference"] == "../f01/uav1-uav1.json"
    assert links["secondary"] == "../f02/uav1-uav1.json"


@pytest.mark.slow
def test_interferogram_is_verified(small, capsys):
    assert print_verified(small, quiet=True) == 0, capsys.readouterr().out


@pytest.mark.slow
def test_heights_of_sparse_clutter_agree_with_the_ramp(small):
    height, transform, *_ = read(small, "height")
    error_m, std = height - ramp_at(small, transform, height.shape), read(small, "height_std")[0]
    valid = np.isfinite(error_m)
    assert valid.mean() > 0.5
    assert abs(np.median(error_m[valid])) < 0.03
    assert np.mean(abs(error_m[valid]) < 3 * std[valid]) > 0.97


@pytest.mark.slow
def test_summary_lists_heights_and_flags_of_an_interferogram(small, tmp_path, capsys):
    root = copy_writable(small, tmp_path / "unlevelled")
    print_summary(Campaign.load(root))
    message = capsys.readouterr().out
    assert "interferogram two_tracks: coherence 0.9" in message
    assert "height.tif" in message
    edit_config(root, lambda config: config["scene"].update(reference_points=[]))
    interferogram(Campaign.load(root), NAME)
    print_summary(Campaign.load(root))
    message = capsys.readouterr().out
    assert "height_relative" in message
    assert "interferogram two_tracks: no point of known height is visible" in message


def with_positions(small, folder, monkeypatch, positions):
    """Recompute the interferogram with other position accuracies of its node; return height deviation and report."""
    root, opened = copy_writable(small, folder), step.open_pair
    with monkeypatch.context() as patched:
        patched.setattr(
            step, "open_pair", lambda *where, **echo: replace(opened(*where, **echo), positions=(positions,))
        )
        interferogram(Campaign.load(root), NAME)
    report = json.loads((root / "results/interferometry" / NAME / "interferogram.json").read_text())
    return np.nanmedian(read(root, "height_std")[0]), report


@pytest.mark.slow
def test_drift_widens_the_deviation_and_unknown_track_errors_are_named(small, tmp_path, monkeypatch):
    logged, report = with_positions(small, tmp_path / "logged", monkeypatch, NodePositions((0.01,) * 3, 2.0))
    assert report["track_std_m"] == {"f01/uav1": 0.01, "f02/uav1": 0.01}
    drifting = NodePositions((0.01,) * 3, 2.0, drift_m=0.03)
    drifted, report = with_positions(small, tmp_path / "drifting", monkeypatch, drifting)
    assert report["track_std_m"]["f01/uav1"] == pytest.approx(np.hypot(0.01, 0.03), abs=1e-4)
    assert drifted > 1.5 * logged
    unknown, report = with_positions(small, tmp_path / "unknown", monkeypatch, NodePositions(None))
    assert report["track_std_m"] == {"f01/uav1": None, "f02/uav1": None}
    assert "unknown track errors of f01/uav1 and f02/uav1 are not included" in report["says"]
    assert unknown < logged


@pytest.mark.slow
def test_interferogram_is_reproduced_byte_for_byte(small, tmp_path):
    again = copy_writable(small, tmp_path / "elsewhere")
    before = contents(again / "results/interferometry")
    interferogram(Campaign.load(again), NAME)
    assert contents(again / "results/interferometry") == before


@pytest.mark.slow
def test_edited_mask_is_refused(small, tmp_path):
    root = copy_writable(small, tmp_path / "edited")
    mask = root / "results/f02/uav1-uav1/mask.tif"
    mask.write_bytes(mask.read_bytes()[:-1] + b"x")
    message = complaint(lambda: interferogram(Campaign.load(root), NAME))
    assert "mask.tif: the file has changed since it was written" in message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ({NAME: ["f01/uav1-uav1", "f03/uav1-uav1"]}, "interferometry.pairs.two_tracks: no image 'f03/uav1-uav1'"),
        ({NAME: ["f01/uav1-uav1", "f01/uav1-uav1"]}, "named twice"),
        ({NAME: ["f01/uav1-uav1"]}, "interferometry.pairs.two_tracks"),
        ({NAME: ["f01/uav1-uav1", "../f02/uav1-uav1"]}, "is not flight/transmitter-receiver"),
        ({"../../up": ["f01/uav1-uav1", "f02/uav1-uav1"]}, "only letters, digits"),
        ({"a;rm -rf x": ["f01/uav1-uav1", "f02/uav1-uav1"]}, "only letters, digits"),
    ],
)
def test_invalid_interferogram_is_refused_by_its_key(small, tmp_path, pairs, expected):
    (tmp_path / "config").mkdir()
    for name in ("config.yaml", "flights.tsv"):
        (tmp_path / "config" / name).write_bytes((small / "config" / name).read_bytes())
    edit_config(tmp_path, lambda config: config["interferometry"].update(pairs=pairs))
    message = complaint(lambda: Campaign.load(tmp_path))
    assert "interferometry" in message
    assert expected in message


@pytest.mark.slow
def test_even_window_and_unknown_interferogram_are_refused(small):
    with pytest.raises(ValueError, match="must be odd"):
        Interferometry(window_px=8)
    message = complaint(lambda: interferogram(Campaign.load(small), "three_tracks"))
    assert "no interferogram 'three_tracks'" in message
    assert "two_tracks" in message


@pytest.mark.slow
def test_height_errors_of_a_ramp_agree_with_their_deviation(tmp_path):
    root = run_ramp(tmp_path, half_width_m=7.0, density_per_m2=25, pulses=100)
    height, transform, *_ = read(root, "height")
    error_m = (height - ramp_at(root, transform, height.shape))[12:-12, 12:-12]
    std = read(root, "height_std")[0][12:-12, 12:-12]
    valid = np.isfinite(error_m)
    assert valid.mean() > 0.85
    independent = valid.sum() / 15**2
    assert abs(error_m[valid].mean()) < 3 * np.median(std[valid]) / np.sqrt(independent)
    assert 0.5 < np.sqrt(np.mean((error_m[valid] / std[valid]) ** 2)) < 1.2
    assert np.ptp(ramp_at(root, transform, height.shape)) > 1.0
    report = json.loads((root / "results/interferometry" / NAME / "interferogram.json").read_text())
    assert report["flags"] == {}


def test_files_of_two_flights_are_copies_if_their_contents_are_equal():
    first, second = (
        xr.Dataset(attrs={"inputs": {"raw/codes.npy": "c", f"raw/{flight}/a.npy": "1", f"raw/{flight}/b.csv": flight}})
        for flight in ("f01", "f02")
    )
    assert copied_inputs(first, second) == {
        "inputs_copied": "files with the same content: raw/f01/a.npy = raw/f02/a.npy"
    }
    assert copied_inputs(first, first) == {}
    own = xr.Dataset(attrs={"inputs": {"raw/f01/uav2.npy": "1"}})  # two nodes may have equal time tags
    assert copied_inputs(first, own) == {}


@pytest.mark.slow
def test_copy_of_a_flight_is_flagged(tiny):
    shutil.copytree(tiny / "raw/f01", tiny / "raw/f02")
    table = tiny / "config/flights.tsv"
    head, row = table.read_text().splitlines()[:2]
    table.write_text("\n".join([head, row, row.replace("f01", "f02", 1)]) + "\n")
    pair = ["f01/uav1-uav1", "f02/uav1-uav1"]
    edit_config(tiny, lambda document: document.update(interferometry={"pairs": {"copy": pair}}))
    process(tiny, last="layers")
    process(tiny, first="interferogram", last="interferogram")
    report = json.loads((tiny / "results/interferometry/copy/interferogram.json").read_text())
    assert "raw/f01/uav1.sigmf-data = raw/f02/uav1.sigmf-data" in report["flags"]["inputs_copied"]


@pytest.mark.slow
def test_baseline_beyond_the_critical_one_is_flagged(tmp_path):
    root = run_ramp(tmp_path, half_width_m=5.0, density_per_m2=10, rise_m=30.0)
    report = json.loads((root / "results/interferometry" / NAME / "interferogram.json").read_text())
    assert "the spectra of the two images do not overlap" in report["flags"]["interferogram_decorrelated"]
    assert np.isfinite(read(root, "height")[0]).mean() < 0.01
