"""Echo of a pair as CPHD: consistency check of the standard, and the image after reading it back."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sarkit.verification
import yaml
from folders import edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.formats.export.cphd import CphdCollection, write_cphd
from apertura.formats.reading import read_phase_history
from apertura.run.process import process
from apertura.stages import cphd, echo, tracks
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import on_demand, results_of
from apertura.workflow.stale import stale_results

AT = np.array([48.0, 11.0, 600.0])


def failures(path):
    """Return errors and warnings of the consistency check by name."""
    with path.open("rb") as stream:
        checker = sarkit.verification.CphdConsistency.from_file(stream, thorough=True)
        checker.check()
    return {
        name: [part["details"] for part in failure["details"] if not part["passed"]]
        for name, failure in checker.failures().items()
    }


def reimported(campaign, flight, pair, target):
    """Process a new campaign whose input is the CPHD file of a pair, on the same grid, up to the image."""
    tx, rx = pair.split("-")
    file, scene = cphd.cphd(campaign, flight, pair), yaml.safe_load((campaign.root / "config/config.yaml").read_text())
    (target / "config").mkdir(parents=True)
    (target / "raw" / flight).mkdir(parents=True)
    shutil.copyfile(str(file), target / "raw" / flight / f"{rx}.cphd")
    config = {
        "campaign": "again",
        "waveform": {"kind": "phase_history", "format": "cphd"},
        "nodes": {node: {} for node in dict.fromkeys((tx, rx))},
        "scene": scene["scene"],
        "processing": {"autofocus": "off", "accuracy_db": -90.0},
    }
    (target / "config/config.yaml").write_text(yaml.safe_dump(config))
    (target / "config/flights.tsv").write_text(f"flight\tkind\ttransmitter\tnodes\n{flight}\timage\t{tx}\t{rx}\n")
    again = Campaign.load(target)
    echo.echo(again, flight, pair)
    process(again, first="scene", last="terrain")
    process(again, first="profile", last="image")
    return again


def image_of(campaign, flight, pair):
    return open_stage(campaign.stage("image", flight, pair), "image").image.values


def difference_db(first, second):
    return 20 * np.log10(np.abs(first - second).max() / np.abs(first).max())


@pytest.fixture(scope="module")
def gotcha(shared, tmp_path_factory):
    """Process two degrees of the Gotcha data at the accuracy of the comparison."""
    root = tmp_path_factory.mktemp("gotcha") / "campaign"
    (root / "config").mkdir(parents=True)
    (root / "raw/pass1").mkdir(parents=True)
    for number, file in enumerate(sorted((shared / "gotcha_afrl").glob("*.mat")), 1):
        shutil.copyfile(file, root / f"raw/pass1/radar.az{number:03d}.mat")
    (root / "config/config.yaml").write_text(
        "campaign: gotcha\nwaveform: {kind: phase_history, format: afrl_mat}\nnodes: {radar: {}}\n"
        "scene: {crs: local, bounds_m: [-40.0, 10.0, 0.0, 50.0], spacing_m: 0.2}\n"
        "processing: {autofocus: 'off', accuracy_db: -90.0}\n"
    )
    (root / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\npass1\timage\tradar\tradar\n")
    campaign = Campaign.load(root)
    echo.echo(campaign, "pass1", "radar-radar")
    process(campaign, first="scene", last="terrain")
    process(campaign, first="profile", last="image")
    return campaign


@pytest.mark.slow
def test_positions_of_phase_history_are_written_as_tracks_per_pulse(gotcha):
    written = {path.name for path in tracks.tracks(gotcha, "pass1")}
    assert written == {"radar.csv", "tracks.png"}  # no .pos file for a local frame
    with gotcha.result("pass1", "tracks", "radar.csv").open("rb") as file:
        read = pd.read_csv(file)
    echo = open_stage(gotcha.stage("echo", "pass1", "radar-radar"), "echo")
    np.testing.assert_allclose(read[["east_m", "north_m", "up_m"]], echo.tx_position.values, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_gotcha_image_through_cphd_differs_by_less_than_minus_80_db(gotcha, tmp_path):
    again = reimported(gotcha, "pass1", "radar-radar", tmp_path / "again")
    assert failures(Path(gotcha.result("pass1", "radar-radar", "phase_history.cphd"))) == {}
    original, reread = (image_of(campaign, "pass1", "radar-radar") for campaign in (gotcha, again))
    assert difference_db(original, reread) < -80
    echoes = [PairEcho.opened(campaign, "pass1", "radar-radar").stage for campaign in (gotcha, again)]
    assert echoes[1].attrs["frame"] == "local"
    np.testing.assert_allclose(echoes[1].tx_position.values, echoes[0].tx_position.values, atol=2e-9)
    np.testing.assert_array_equal(echoes[1].time.values, echoes[0].time.values)
    # Samples differ, because they are referred to the scene centre instead of the origin.
    assert np.abs(np.diff([stage.reference_delay.values for stage in echoes], axis=0)).min() > 1e-8


@pytest.fixture(scope="module")
def fine_tiny(_tiny, tmp_path_factory):
    """Process the pairs of the tiny campaign at the accuracy of the comparison."""
    from folders import copy_writable

    from apertura.run.process import process

    root = copy_writable(_tiny, tmp_path_factory.mktemp("tiny") / "campaign")
    edit_config(root, lambda config: config.update(processing={"autofocus": "off", "accuracy_db": -90.0}))
    campaign = Campaign.load(root)
    process(campaign, last="ingest")
    for pair in campaign.flight("f01").pairs:
        echo.echo(campaign, "f01", pair)
    process(campaign, first="scene", last="terrain")
    process(campaign, first="profile", last="image")
    return campaign


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_simulated_image_through_cphd_differs_by_less_than_minus_80_db(fine_tiny, tmp_path, pair):
    again = reimported(fine_tiny, "f01", pair, tmp_path / "again")
    assert failures(Path(fine_tiny.result("f01", pair, "phase_history.cphd"))) == {}
    assert difference_db(image_of(fine_tiny, "f01", pair), image_of(again, "f01", pair)) < -80
    original, reread = (PairEcho.opened(campaign, "f01", pair).stage for campaign in (fine_tiny, again))
    for name in ("time", "tx_position", "rx_position", "path_limit"):
        np.testing.assert_array_equal(original[name].values, reread[name].values, err_msg=name)


def collection(pulses=6, **changes):
    """Return the CPHD collection of a small monostatic flight at a position on Earth."""
    origin = ecef_from_geodetic(*AT)
    north, east, down = ned_axes(origin).T
    track = origin - 300.0 * down + 200.0 * east + 2.0 * np.arange(pulses)[:, None] * north
    limit_m = np.full(pulses, 5000.0)
    time = np.datetime64("2025-05-14T09:30:00.123456789", "ns") + np.arange(pulses) * np.timedelta64(10_000_001, "ns")
    frequency = 1.2e9 + 1e5 * np.arange(64)
    parts = {"time": time, "tx_m": track, "rx_m": track, "frequency_hz": frequency, "path_limit_m": limit_m}
    ground = {"point_m": origin, "origin_m": origin, "axes": np.stack([east, north, -down])}
    other_fields = {
        "area_m": (-5.0, -5.0, 5.0, 5.0),
        "spacing_m": 0.5,
        "parameters": {},
        "wave_speed_m_s": SPEED_OF_LIGHT_M_S,
    }
    return CphdCollection("c f01 a-a", "a-a", **(parts | ground | other_fields | changes))


def noise(count):
    rng = np.random.default_rng(count)
    return (rng.standard_normal((count, 64)) + 1j * rng.standard_normal((count, 64))).astype(np.complex64)


def test_cphd_written_in_blocks_reads_back_bit_identical(tmp_path):
    written, samples = collection(), noise(6)
    write_cphd(tmp_path / "a.cphd", written, (samples[part] for part in (slice(0, 1), slice(1, 5), slice(5, 6))))
    assert failures(tmp_path / "a.cphd") == {}
    echo = read_phase_history("cphd", [tmp_path / "a.cphd"], pair="a-a")
    np.testing.assert_array_equal(echo.transfer.values, samples)
    np.testing.assert_array_equal(echo.time.values, written.time)
    np.testing.assert_array_equal(echo.tx_position.values, written.tx_m)
    np.testing.assert_array_equal(echo.path_limit.values, written.path_limit_m)
    np.testing.assert_allclose(echo.reference_delay.values, written.reference_delay_s, rtol=1e-15)


def test_missing_pulses_are_refused_and_leave_no_file(tmp_path):
    with pytest.raises(ValueError, match="5 pulses, must be 6"):
        write_cphd(tmp_path / "a.cphd", collection(), [noise(5)])
    assert list(tmp_path.iterdir()) == []


def test_swath_ends_where_echoes_exceed_the_prefix(tmp_path):
    """Without a prefix, the swath is the unambiguous range of the frequency step, divided by 1.25."""
    first, last = collection(path_limit_m=np.full(6, np.inf)).swath_s
    assert last == -first == pytest.approx(0.5 / 1.25 / 1e5)
    limited = collection(path_limit_m=np.full(6, 900.0))
    assert limited.swath_s == pytest.approx((first, (900.0 / SPEED_OF_LIGHT_M_S - limited.reference_delay_s).min()))
    write_cphd(tmp_path / "a.cphd", limited, [noise(6)])
    assert failures(tmp_path / "a.cphd") == {}


@pytest.mark.slow
def test_cphd_is_produced_on_request_and_becomes_out_of_date(fine_tiny):
    cphd_results = [result for name, result in results_of(fine_tiny) if name == "cphd"]
    assert [on_demand(fine_tiny, result.manifest) for result in cphd_results] == [True, True]
    cphd.cphd(fine_tiny, "f01", "uav1-uav1")
    stage = PairEcho.opened(fine_tiny, "f01", "uav1-uav1").stage
    assert stage.sizes["pulse"] == 40
    assert stale_results(fine_tiny) == {}
    path = fine_tiny.result("f01", "uav1-uav1", "phase_history.cphd")
    path.write_bytes(path.read_bytes()[:-1])
    assert stale_results(fine_tiny) == {cphd_results[0].manifest: "phase_history.cphd has changed since it was written"}


def test_scene_in_another_frame_than_the_cphd_file_is_refused(tmp_path):
    (tmp_path / "config").mkdir()
    (tmp_path / "raw/f01").mkdir(parents=True)
    write_cphd(tmp_path / "raw/f01/a.cphd", collection(), [noise(6)])
    config = "campaign: c\nwaveform: {kind: phase_history, format: cphd}\nnodes: {a: {}}\n"
    scene = "scene: {crs: local, bounds_m: [-5, -5, 5, 5], spacing_m: 0.5}\n"
    (tmp_path / "config/config.yaml").write_text(config + scene)
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\ta\ta\n")
    messages = [str(problem) for problem in problems(tmp_path, without=["memory"])]
    assert len(messages) == 1
    assert "local for a phase history with positions in ECEF; expected an EPSG code, or auto" in messages[0]
