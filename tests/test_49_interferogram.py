"""Two flights over a ramp that the DEM lacks, simulated, and carried to a height map: files, tags, flags, refusals."""

import json

import numpy as np
import pytest
import rasterio
from folders import complaint, contents, copy_writable, edit_config, run_steps

from apertura.campaign.config import Interferometry
from apertura.campaign.folder import Campaign
from apertura.formats.export import exports_in
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
from apertura.stages.interferogram import interferogram
from apertura.views.summary import print_summary
from apertura.views.verify.chain import print_verified
from apertura.workflow.lineage import result_of

SLOPE = (0.03, 0.06)
MARKS = ((-3.0, -2.5), (3.0, 3.0))
NAME = "two_tracks"
FILES = {export.file for export in exports_in("interferogram")} | {"interferogram.json"}


def two_flights(*, half_width_m, density_per_m2, pulses=60, rise_m=1.0):
    """One node that flies past a ramp twice, the second time higher; the config knows flat ground and two points."""
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


def made(folder, **choices):
    """A finished campaign that asks for one interferogram."""
    root = simulate(folder / "ramp", two_flights(**choices))
    truth = json.loads((root / "truth.json").read_text())["targets"]
    points = [
        {"name": f"mark {at}", "position_m": [one["x"], one["y"], one["height_m"]], "std_m": 0.02}
        for at, one in enumerate(truth)
    ]

    def ask(config):
        config["scene"]["reference_points"] = points
        config["processing"] = {"autofocus": "off"}
        config["interferometry"] = {"pairs": {NAME: ["f01/uav1-uav1", "f02/uav1-uav1"]}}

    edit_config(root, ask)
    run_steps(root)
    return root


def read(root, name):
    with rasterio.open(root / "results/interferometry" / NAME / f"{name}.tif") as raster:
        return raster.read(1), raster.transform, raster.tags(), raster.units[0]


def ramp_at(root, transform, shape):
    """Heights of the ramp at the pixels of the map, by the marks on it."""
    first, second = json.loads((root / "truth.json").read_text())["targets"]
    scale = (second["x"] - first["x"]) / (MARKS[1][0] - MARKS[0][0])  # of the projection
    column, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = transform.c + transform.a * column, transform.f + transform.e * row
    return first["height_m"] + (SLOPE[0] * (x - first["x"]) + SLOPE[1] * (y - first["y"])) / scale


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return made(tmp_path_factory.mktemp("small"), half_width_m=5.0, density_per_m2=8)


@pytest.mark.slow
def test_every_product_lies_there_with_its_tags(small):
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
        _, transform, tags, told = read(small, name)
        assert told == unit
        assert transform.a == 0.125
        assert tags["APERTURA_LEVEL"].startswith("heights relative to mark 0 and mark 1")
        assert json.loads(tags["APERTURA_FLAGS"]) == report["flags"]
        spec = json.loads(tags["APERTURA_RUNSPEC"])
        assert spec["images"] == report["images"]
        assert set(spec) >= {"f01/uav1-uav1", "f02/uav1-uav1"}
    assert (folder / "quicklook.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_its_lineage_names_both_images_and_all_that_their_geometry_is_from(small):
    sources = result_of(Campaign.load(small), "interferogram", NAME).sources
    for flight in ("f01", "f02"):
        for stage in ("echo", "profile", "image", "layers"):
            assert f"results/{flight}/uav1-uav1/{stage}.manifest.json" in sources
    manifest = json.loads((small / "results/interferometry" / NAME / "interferogram.manifest.json").read_text())
    assert set(manifest["sources"]) == set(sources)


@pytest.mark.slow
def test_verify_finds_every_link_as_it_was(small, capsys):
    assert print_verified(small, quiet=True) == 0, capsys.readouterr().out


@pytest.mark.slow
def test_heights_of_sparse_ground_lie_about_the_ramp(small):
    height, transform, *_ = read(small, "height")
    wrong, std = height - ramp_at(small, transform, height.shape), read(small, "height_std")[0]
    there = np.isfinite(wrong)
    assert there.mean() > 0.5
    assert abs(np.median(wrong[there])) < 0.03
    assert np.mean(abs(wrong[there]) < 3 * std[there]) > 0.97


@pytest.mark.slow
def test_the_summary_tells_heights_and_the_flags_of_an_interferogram(small, tmp_path, capsys):
    root = copy_writable(small, tmp_path / "unlevelled")
    print_summary(Campaign.load(root))
    told = capsys.readouterr().out
    assert "interferogram two_tracks: coherence 0.9" in told
    assert "height.tif" in told
    edit_config(root, lambda config: config["scene"].update(reference_points=[]))
    interferogram(Campaign.load(root), NAME)
    print_summary(Campaign.load(root))
    told = capsys.readouterr().out
    assert "height_relative" in told
    assert "interferometry two_tracks: no point of known height is visible" in told


@pytest.mark.slow
def test_the_same_images_give_the_same_bytes(small, tmp_path):
    again = copy_writable(small, tmp_path / "elsewhere")
    before = contents(again / "results/interferometry")
    interferogram(Campaign.load(again), NAME)
    assert contents(again / "results/interferometry") == before


@pytest.mark.slow
def test_a_mask_edited_by_hand_is_refused(small, tmp_path):
    root = copy_writable(small, tmp_path / "edited")
    mask = root / "results/f02/uav1-uav1/mask.tif"
    mask.write_bytes(mask.read_bytes()[:-1] + b"x")
    told = complaint(lambda: interferogram(Campaign.load(root), NAME))
    assert "mask.tif: the file has changed since it was written" in told


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
def test_an_interferogram_that_is_none_is_refused_by_its_key(small, tmp_path, pairs, expected):
    (tmp_path / "config").mkdir()
    for name in ("config.yaml", "flights.tsv"):
        (tmp_path / "config" / name).write_bytes((small / "config" / name).read_bytes())
    edit_config(tmp_path, lambda config: config["interferometry"].update(pairs=pairs))
    told = complaint(lambda: Campaign.load(tmp_path))
    assert "interferometry" in told
    assert expected in told


@pytest.mark.slow
def test_a_window_needs_a_middle_and_a_name_a_place(small):
    with pytest.raises(ValueError, match="must be odd"):
        Interferometry(window_px=8)
    told = complaint(lambda: interferogram(Campaign.load(small), "three_tracks"))
    assert "no interferogram 'three_tracks'" in told
    assert "two_tracks" in told


@pytest.mark.slow
def test_two_flights_over_a_ramp_give_its_heights_within_their_deviation(tmp_path):
    root = made(tmp_path, half_width_m=7.0, density_per_m2=25, pulses=100)
    height, transform, *_ = read(root, "height")
    wrong = (height - ramp_at(root, transform, height.shape))[12:-12, 12:-12]
    std = read(root, "height_std")[0][12:-12, 12:-12]
    there = np.isfinite(wrong)
    assert there.mean() > 0.85
    alone = there.sum() / 15**2
    assert abs(wrong[there].mean()) < 3 * np.median(std[there]) / np.sqrt(alone)
    assert 0.5 < np.sqrt(np.mean((wrong[there] / std[there]) ** 2)) < 1.2
    assert np.ptp(ramp_at(root, transform, height.shape)) > 1.0
    report = json.loads((root / "results/interferometry" / NAME / "interferogram.json").read_text())
    assert report["flags"] == {}


@pytest.mark.slow
def test_flights_beyond_the_critical_baseline_say_so(tmp_path):
    root = made(tmp_path, half_width_m=5.0, density_per_m2=10, rise_m=30.0)
    report = json.loads((root / "results/interferometry" / NAME / "interferogram.json").read_text())
    assert "the spectra of the two images do not overlap" in report["flags"]["interferogram_decorrelated"]
    assert np.isfinite(read(root, "height")[0]).mean() < 0.01
