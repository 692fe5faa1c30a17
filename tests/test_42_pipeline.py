"""The pipeline in one process: image positions, resolution, phases and reproducibility from independent recordings."""

import json

import numpy as np
import pytest
import rasterio
from folders import copy_writable

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.backprojection.engines import load_engine, reference
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.echo.compression import compress, range_step, window_weights
from apertura.core.echo.sidelink import METHODS
from apertura.core.geometry.aperture import Aperture
from apertura.core.quality.measures import numerical_error_db
from apertura.core.quality.point_targets import BandLimitedPatch, find_peak
from apertura.run.process import process
from apertura.stages import echo
from apertura.stages.scene import open_scene
from apertura.stages.transfer import PairEcho
from apertura.views.score import score


def random_pixels(shape, count, seed):
    return np.random.default_rng(seed).integers(0, shape, (count, 2)).T


def findings(campaign, image):
    return [finding for finding in score(campaign) if finding.image == image]


def test_only_the_selected_steps_are_run(tiny):
    process(tiny, last="ingest")
    assert {path.name for path in (tiny / "results/f01").rglob("*.zarr")} == {"raw.zarr", "track.zarr"}
    process(tiny, first="echo", last="scene")
    assert not (tiny / "results/f01/uav1-uav1/profile.zarr").exists()
    with pytest.raises(ValueError, match="'imaeg' is not a step of the workflow: ingest, bench, echo"):
        process(tiny, last="imaeg")


@pytest.mark.parametrize("image", ["uav1-uav1", "uav1-uav2", "fused"])
def test_targets_of_the_sample_focus_within_3_cm(finished_sample, image):
    targets = findings(finished_sample, image)
    assert len(targets) == 4
    assert max(finding.error_m for finding in targets) < 0.03


def test_coherent_fusion_is_narrower_than_either_pair(finished_sample):
    widths = {
        image: np.mean([finding.cross_range_m for finding in findings(finished_sample, image)])
        for image in ("uav1-uav1", "uav1-uav2", "fused")
    }
    assert widths["uav1-uav1"] == pytest.approx(0.34, abs=0.02)
    assert widths["uav1-uav2"] == pytest.approx(0.34, abs=0.02)
    assert widths["fused"] == pytest.approx(0.22, abs=0.02)


def test_mono_and_bistatic_phases_agree_at_the_targets(finished_sample):
    """Equal phases are required by the coherent sum; the generating model of the sample agrees within 0.06 rad."""
    cube = open_stage(finished_sample.stage("cube"), "cube").image.values[0]
    grid = open_scene(finished_sample).grid
    truth = json.loads((finished_sample.root / "truth.json").read_text())["targets"]
    assert len(truth) == 4
    for target in truth:
        row, column = map(float, grid.pixel_of(target["x"], target["y"]))
        mono, bistatic = (BandLimitedPatch(image, round(row), round(column)).at(row, column) for image in cube)
        assert abs(np.angle(mono * np.conj(bistatic))) < 0.1


@pytest.mark.slow
def test_bistatic_image_requires_the_sidelink(finished_sample, monkeypatch, tmp_path):
    """Without sidelink correction, and at equal RMS of the phase histories, the peak is lower by at least 15 dB."""
    pair = ("f01", "uav1-uav2")
    scene = open_scene(finished_sample)
    grid, ground = scene.grid, scene.terrain
    with_division = PairEcho.opened(finished_sample, *pair).stage.load()
    monkeypatch.setitem(METHODS, "divide", lambda radar, *_: radar)
    copy = Campaign.load(copy_writable(finished_sample.root, tmp_path / "campaign"))
    echo.echo(copy, *pair)
    uncorrected = PairEcho.opened(copy, *pair).stage.load()
    peaks = []
    for dataset in (with_division, uncorrected):
        transfer = dataset.transfer.values / np.sqrt((np.abs(dataset.transfer.values) ** 2).mean())
        places = dataset.tx_position.values, dataset.rx_position.values
        frequency = dataset.frequency.values
        start = np.linalg.norm(places[0] - ground.positions(grid)[0, 0], axis=-1) * 2 - 40
        profiles = Profiles(
            compress(
                transfer,
                frequency,
                weight=window_weights("hann", 1024),
                reference_delay_s=np.zeros(len(transfer)),
                start_m=start,
                count=400,
            ),
            start,
            range_step(frequency, oversampling=2)[0],
            frequency[512],
            2.0,
            Aperture(*places),
        )
        engine = load_engine("numba")
        peaks.append(np.abs(engine.form(engine.prepare(profiles), ground.positions(grid))).max())
    assert 20 * np.log10(peaks[0] / peaks[1]) > 15


@pytest.mark.slow
def test_gotcha_trihedrals_focus_within_30_cm(shared, tmp_path):
    """Two degrees of the airborne circular X-band aperture are processed by the same steps in a local frame."""
    root = tmp_path / "gotcha"
    (root / "config").mkdir(parents=True)
    (root / "raw" / "pass1").mkdir(parents=True)
    for number, file in enumerate(sorted((shared / "gotcha_afrl").glob("*.mat")), 1):
        (root / "raw" / "pass1" / f"radar.az{number:03d}.mat").write_bytes(file.read_bytes())
    (root / "config" / "config.yaml").write_text(
        "campaign: gotcha\nwaveform: {kind: phase_history, format: afrl_mat}\nnodes: {radar: {}}\n"
        "scene: {crs: local, bounds_m: [-40.0, 10.0, 0.0, 50.0], spacing_m: 0.2}\n"
    )
    (root / "config" / "flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\npass1\timage\tradar\tradar\n")
    campaign = process(root)
    with rasterio.open(root / "results/pass1/radar-radar/slc.tif") as raster:
        image, crs = raster.read(1), raster.crs
    assert crs.to_wkt().startswith('LOCAL_CS["gotcha"')
    shown = json.loads((root / "results/map/map.json").read_text())
    assert shown["crs"] == {"name": "gotcha", "code": None, "local": True, "proj4": None, "control": []}
    assert shown["coverage_url"] is None
    for x, y in ((-15.61, 21.61), (-27.79, 38.82)):
        row, column = int((50.0 - y) / 0.2), int((x + 40.0) / 0.2)
        window = np.abs(image[row - 8 : row + 9, column - 8 : column + 9])
        down, right = np.unravel_index(window.argmax(), window.shape)
        peak = find_peak(image, row - 8 + down, column - 8 + right)
        place = open_scene(campaign).grid.map_at(peak.row, peak.column)
        assert np.hypot(place[0] - x, place[1] - y) < 0.3


@pytest.mark.parametrize("window", ["hann", "none"])
@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_table_engine_meets_its_error_bound(finished_sample, window, pair):
    dataset = PairEcho.opened(finished_sample, "f01", pair).stage
    scene = open_scene(finished_sample)
    grid, ground = scene.grid, scene.terrain
    frequency, weight = dataset.frequency.values, window_weights(window, 1024)
    places = dataset.tx_position.values, dataset.rx_position.values
    zeros = np.zeros(len(places[0]))
    spectra = PhaseHistory(dataset.transfer.values, frequency, weight, zeros, Aperture(*places))
    start = np.full(len(zeros), 5.0)
    samples = compress(spectra.transfer, frequency, weight=weight, reference_delay_s=zeros, start_m=start, count=500)
    profiles = Profiles(
        samples, start, range_step(frequency, oversampling=2)[0], frequency[512], 2.0, Aperture(*places)
    )
    pixels = ground.positions_at(grid, *random_pixels(grid.shape, 256, seed=3))
    engine = load_engine("numba")
    computed = engine.form(engine.prepare(profiles), pixels[None])[0]
    assert numerical_error_db(computed, reference.form(spectra, pixels)) < -50


def test_stated_numerical_error_is_confirmed(finished_tiny):
    """The error is recomputed at pixels other than those of the certificate."""
    pair = ("f01", "uav1-uav2")
    report = json.loads((finished_tiny.results / "f01" / "uav1-uav2" / "image.json").read_text())
    dataset = PairEcho.opened(finished_tiny, *pair).stage
    formed = open_stage(finished_tiny.stage("image", *pair), "image").image.values
    frequency, places = dataset.frequency.values, (dataset.tx_position.values, dataset.rx_position.values)
    sampled = dataset.transfer.values, frequency, window_weights("hann", 1024), np.zeros(len(places[0]))
    spectra = PhaseHistory(*sampled, Aperture(*places), dataset.attrs["wave_speed_m_s"])
    rows, columns = random_pixels(formed.shape, 200, seed=99)
    scene = open_scene(finished_tiny)
    exact = reference.form(spectra, scene.terrain.positions_at(scene.grid, rows, columns))
    measured = numerical_error_db(formed[rows, columns], exact)
    assert report["numerical_error_estimate_db"] == pytest.approx(measured, abs=3)


@pytest.mark.slow
def test_two_runs_write_identical_bytes(tiny, finished_tiny):
    process(tiny)
    products = sorted(
        path for path in finished_tiny.results.rglob("*") if path.suffix in {".tif", ".png", ".qml", ".vrt", ".geojson"}
    )
    assert len(products) >= 14
    for product in products:
        other = tiny / "results" / product.relative_to(finished_tiny.results)
        assert other.read_bytes() == product.read_bytes(), product.name
    manifests = sorted(finished_tiny.results.rglob("*.manifest.json"))
    assert len(manifests) == 25  # of two nodes, two pairs, the flight, its sums and the campaign
    for manifest in manifests:
        assert (tiny / "results" / manifest.relative_to(finished_tiny.results)).read_bytes() == manifest.read_bytes()


@pytest.mark.slow
def test_thread_count_does_not_change_the_image(tiny, finished_tiny):
    campaign = Campaign.load(tiny)
    process(tiny, last="cube")
    from apertura.stages import image

    image.image(campaign, "f01", "uav1-uav1", threads=6)
    one = open_stage(campaign.stage("image", "f01", "uav1-uav1"), "image").image.values
    two = open_stage(finished_tiny.stage("image", "f01", "uav1-uav1"), "image").image.values
    np.testing.assert_array_equal(one, two)
