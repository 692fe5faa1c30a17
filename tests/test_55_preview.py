"""Preview of a flight (`apertura preview`): images of the pulses recorded so far, from incompletely written files."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from folders import ROOT, copy_writable, state

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.gate import EDGE_CELLS, RangeGate
from apertura.formats.recordings.sigmf import GrowingSigmf, open_sigmf
from apertura.run.process import process
from apertura.run.results import clean
from apertura.simulation import ImageGrid, preset
from apertura.stages import echo
from apertura.stages.scene import settled_scene
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import transmitted
from apertura.tools.preview import pair as preview_pair
from apertura.tools.preview.follow import Preview
from apertura.tools.preview.node import NodeSoFar
from apertura.views.webmap.server import served_look

sys.path.insert(0, str(ROOT / "benchmarks"))
import preview as replayed  # writers of incomplete files

APERTURA = Path(sys.executable).parent / "apertura"


def files_of(root):
    """Return the sha256 of all results except those of the preview."""
    files = (path for path in (root / "results").rglob("*") if path.is_file())
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.relative_to(root).parts[1] != "preview"
    }


def node_of(root, node, *, follow=True):
    campaign = Campaign.load(root)
    return NodeSoFar(campaign, "f01", node, transmitted(campaign, campaign.settings.waveform), follow=follow)


def in_blocks(root, pulses, monkeypatch):
    """Return the pairs of a campaign after its pulses were added in blocks."""
    monkeypatch.setattr(preview_pair, "AT_ONCE", pulses)
    preview = Preview(Campaign.load(root), follow=False)
    for node in preview.nodes.values():
        node.read()
    for pair in preview.pairs:
        while pair.add_next(ended=True) or pair.refine_next():
            pass
    return preview.pairs


def difference_db(image, exact):
    """Return the RMS difference of two images relative to that of the second, dB."""
    return 10 * np.log10(np.mean(np.abs(image - exact) ** 2) / np.mean(np.abs(exact) ** 2))


@pytest.mark.slow
def test_pixels_beyond_the_recorded_delays_have_no_data(finished_tiny, tmp_path, monkeypatch):
    """Blocks are gated at the end of the recorded delays, as the images of the run are."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    west, south, east, north = finished_tiny.settings.scene.bounds_m
    state(root, "scene", bounds_m=[west, south, east + 120, north + 120], spacing_m=0.5)
    state(root, "processing", integration="all")
    pair = in_blocks(root, 16, monkeypatch)[0]
    fine = pair.images[1]
    echo = PairEcho.opened(finished_tiny, "f01", pair.name).stage.load()
    step_m = SPEED_OF_LIGHT_M_S / float(np.ptp(echo.frequency.values) + np.diff(echo.frequency.values[:2])[0])
    gate = Beams(gate=RangeGate(echo.path_limit.values, EDGE_CELLS * step_m))
    height_m = finished_tiny.settings.scene.height_m
    options = {"terrain": height_m, "engine": "reference", "certified_pixels": 0, "judge": False}
    exact = ap.backproject(echo, fine.grid, beams=gate, **options).values
    recorded = exact != 0
    assert 0.1 < recorded.mean() < 0.9
    np.testing.assert_array_equal(fine.sums != 0, recorded)
    assert difference_db(fine.image[recorded], exact[recorded]) < -60
    assert f"{100 * (1 - recorded.mean()):.0f} % has no data" in fine.flags["scene_beyond_recording"]
    assert in_blocks(finished_tiny.root, 2048, monkeypatch)[0].images[1].flags == {}


@pytest.mark.slow
@pytest.mark.parametrize("pulses", [7, 16, 2048])
def test_image_added_in_blocks_equals_that_of_all_pulses(finished_tiny, tmp_path, monkeypatch, pulses):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    state(root, "processing", integration="all")
    for pair in in_blocks(root, pulses, monkeypatch)[:1]:
        coarse, fine = pair.images
        echo = PairEcho.opened(finished_tiny, "f01", pair.name).stage.load()
        assert fine.pulses == coarse.pulses == len(echo.pulse)
        height_m = finished_tiny.settings.scene.height_m
        exact = ap.backproject(echo, fine.grid, terrain=height_m, engine="reference", certified_pixels=0, judge=False)
        assert difference_db(fine.image, exact.values) < -60
        assert fine.error_db < -60
        few = slice(len(echo.subcarrier) // 4, 3 * len(echo.subcarrier) // 4)
        half = ap.PhaseHistory(
            echo.transfer.values[:, few],
            echo.frequency.values[few],
            window_weights("hann", few.stop - few.start),
            echo.reference_delay.values,
            ap.Aperture(echo.tx_position.values, echo.rx_position.values),
            echo.attrs["wave_speed_m_s"],
        )
        exact = ap.backproject(half, coarse.grid, terrain=height_m, engine="reference", certified_pixels=0, judge=False)
        assert difference_db(coarse.image, exact.values) < -30  # half of the required accuracy in dB
        assert coarse.error_db < -30
        assert coarse.grid.spacing_m == 2 * fine.grid.spacing_m


@pytest.mark.slow
def test_bistatic_image_in_blocks_has_the_same_points_in_focus(finished_tiny, tmp_path, monkeypatch):
    pair = in_blocks(copy_writable(finished_tiny.root, tmp_path / "campaign"), 16, monkeypatch)[1]
    image = open_stage(finished_tiny.stage("image", "f01", pair.name), "image").image.values
    in_preview, in_run = np.abs(pair.images[1].image), np.abs(image)
    assert np.unravel_index(in_preview.argmax(), in_preview.shape) == np.unravel_index(in_run.argmax(), in_run.shape)
    assert difference_db(pair.images[1].image, image) < -20  # sidelink statistics of 16 pulses instead of all


@pytest.mark.parametrize("shares", [(0.9, 0.3), (0.4, 0.9), (0.97, 0.5001), (1.0, 0.99)])
def test_truncated_recording_is_read_to_its_last_complete_pulse(tiny, tmp_path, shares):
    files = [tiny / f"raw/f01/uav2.sigmf-{kind}" for kind in ("meta", "data")]
    whole, texts = open_sigmf(*files), [path.read_bytes() for path in files]
    growing = GrowingSigmf(tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data")
    assert growing.read() is None
    for path, text, share in zip(growing.files, texts, shares, strict=True):
        path.write_bytes(text[: int(share * len(text))])
    read = growing.read()
    count = len(read.captures.start)
    stated = growing.files[0].read_bytes().partition(b'"captures"')[2].count(b"}") - 2 * (shares[0] == 1)
    pulse_bytes = whole.samples.sample_bytes * whole.captures.length
    assert count == min(stated, growing.files[1].stat().st_size // pulse_bytes) > 1
    assert not growing.ended
    for name in ("start", "time", "frame"):
        np.testing.assert_array_equal(getattr(read.captures, name), getattr(whole.captures, name)[:count])
    for path, text in zip(growing.files, texts, strict=True):
        path.write_bytes(text)
    assert len(growing.read().captures.start) == len(whole.captures.start)
    assert growing.ended


def test_growing_recording_is_read_without_errors(tiny, tmp_path):
    meta, data = (tiny / f"raw/f01/uav2.sigmf-{kind}" for kind in ("meta", "data"))
    whole, text = open_sigmf(meta, data), b"\xef\xbb\xbf" + meta.read_bytes()
    (tmp_path / "a.sigmf-data").write_bytes(data.read_bytes())
    growing, counts = GrowingSigmf(tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data"), []
    for size in range(0, len(text) + 37, 37):
        growing.files[0].write_bytes(text[:size])
        read = growing.read()
        counts.append(0 if read is None else len(read.captures.start))
    assert counts == sorted(counts)
    assert len(set(counts)) > len(whole.captures.start) / 2
    for name in ("start", "time", "frame"):
        np.testing.assert_array_equal(getattr(read.captures, name), getattr(whole.captures, name))


def test_rewritten_metadata_are_read_again(tiny, tmp_path):
    meta, data = (tiny / f"raw/f01/uav1.sigmf-{kind}" for kind in ("meta", "data"))
    document, captures = json.loads(meta.read_text()), len(open_sigmf(meta, data).captures.start)
    (tmp_path / "a.sigmf-data").write_bytes(data.read_bytes())
    growing = GrowingSigmf(tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data")
    for count in (10, 25, captures):
        partial = {
            "global": {"core:extra": "x" * count, **document["global"]},
            "captures": document["captures"][:count],
        }
        growing.files[0].write_text(json.dumps(partial))
        assert len(growing.read().captures.start) == count
    growing.files[0].write_text("")  # at this moment truncated by its recorder
    assert len(growing.read().captures.start) == captures


@pytest.mark.parametrize("node", ["uav1", "uav2"])  # a CSV, and an RTKLIB solution
@pytest.mark.parametrize("cut", [1, 9, 40])
def test_truncated_log_is_read_to_its_last_complete_line(tiny, node, cut):
    whole = node_of(tiny, node)
    whole.read()
    (log,) = (tiny / "raw/f01").glob(f"{node}.track.*")
    log.write_bytes(log.read_bytes()[:-cut])
    read = node_of(tiny, node)
    read.read()
    assert read.waits == ""
    assert len(read.track.time) == len(whole.track.time) - 1
    assert read.known_until(ended=False) < read.known_until(ended=True) < whole.known_until(ended=True)


def test_pulses_beyond_the_log_wait_for_it(tiny):
    (log,) = (tiny / "raw/f01").glob("uav2.track.*")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[: len(lines) // 2]))
    preview = Preview(Campaign.load(tiny), follow=True)
    for node in preview.nodes.values():
        node.read()
    mono, other = preview.pairs
    reach = other.rx.known_until(ended=False)
    tx_index, rx_index = other.ready(ended=False)
    assert 0 < len(tx_index) < len(mono.ready(ended=False)[0])
    assert other.tx.time[tx_index].max() <= reach
    difference_s = (other.rx.time[rx_index] - other.tx.time[tx_index]) / np.timedelta64(1, "s")
    assert np.ptp(difference_s) < 5e-3  # the same pulses, by tags of two clocks


def other_flight(root, node="uav1"):
    """Overwrite the files of a node with half of a flight of another day, as by a restarted recorder."""
    meta, data = (root / f"raw/f01/{node}.sigmf-{kind}" for kind in ("meta", "data"))
    document = json.loads(meta.read_text())
    for capture in document["captures"]:
        capture["core:datetime"] = capture["core:datetime"].replace("T", "T", 1).replace("2025", "2024", 1)
    del document["captures"][len(document["captures"]) // 2 :]
    meta.write_text(json.dumps(document))
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])


def shorter(root):
    data = root / "raw/f01/uav1.sigmf-data"
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])


def other_samples(root):
    data = root / "raw/f01/uav1.sigmf-data"
    data.write_bytes(bytes(100) + data.read_bytes()[100:])


def other_last_samples(root):
    data = root / "raw/f01/uav1.sigmf-data"
    data.write_bytes(data.read_bytes()[:-100] + bytes(100))


def other_log(root):
    (log,) = (root / "raw/f01").glob("uav1.track.*")
    head, *lines = log.read_text().splitlines(keepends=True)
    log.write_text(head + "".join(lines[1:]))


@pytest.mark.slow
@pytest.mark.parametrize("change", [other_flight, shorter, other_samples, other_last_samples, other_log])
def test_restarted_recorder_restarts_its_images(tiny, change, capsys):
    preview = Preview(Campaign.load(tiny), follow=True)
    preview._read()
    for pair in preview.pairs:
        while pair.add_next(ended=False):
            pass
    preview.show(ended=False, elapsed_s=1.0)
    before = preview.pairs[0].counts
    assert before["added"] > 0
    change(tiny)
    preview._read()
    assert "are restarted from the new files" in capsys.readouterr().out
    assert [pair.counts["added"] for pair in preview.pairs] == [0, 0]  # uav1 transmits in both pairs
    assert preview._map._entries == {}
    assert not list((tiny / "results/preview").rglob("*.png"))
    preview._read()
    for pair in preview.pairs:
        while pair.add_next(ended=True):
            pass
        assert pair.counts["added"] <= pair.counts["recorded"]
    assert "restarted" not in capsys.readouterr().out
    assert (preview.pairs[0].counts["recorded"] < before["recorded"]) == (change in (other_flight, shorter))


def test_recorder_restarted_during_drawing_leaves_no_old_image(tiny, monkeypatch):
    preview = Preview(Campaign.load(tiny), follow=True)
    preview._read()
    preview.pairs[0].add_next(ended=True)
    monkeypatch.setattr(preview, "_draw", lambda *_: other_flight(tiny))
    status = preview.show_pair(preview.pairs[0])
    assert (status["image"], status["pulses"]["added"]) == (None, 0)
    preview._read()
    assert preview.pairs[0].shown is None


def test_temporarily_missing_file_does_not_end_a_preview(tiny):
    """A recorder removes and recreates its files between two reads and before a block is read."""
    data = tiny / "raw/f01/uav2.sigmf-data"
    preview, content = Preview(Campaign.load(tiny), follow=True), data.read_bytes()
    preview._read()
    data.unlink()
    assert not preview.pairs[1].add_next(ended=True) or preview.pairs[1].counts["added"] == 0
    assert "no such file" in preview.pairs[1].drop_reason.lower()
    preview._read()
    data.write_bytes(content[: len(content) // 2])
    preview._read()
    assert preview.pairs[1].taken == 0
    preview._read()
    while preview.pairs[1].add_next(ended=True):
        pass
    assert 0 < preview.pairs[1].counts["added"] <= preview.pairs[1].counts["recorded"]


def test_log_replaced_by_a_named_pipe_is_reported_once(tiny, capsys):
    preview = Preview(Campaign.load(tiny), follow=True)
    preview._read()
    capsys.readouterr()
    log = tiny / "raw/f01/uav1.track.csv"
    log.unlink()
    os.mkfifo(log)
    preview._read()
    preview._read()
    (line,) = capsys.readouterr().out.splitlines()
    assert "files of uav1 are not readable at present: " in line
    assert "uav1.track.csv: a named pipe" in line


def test_partially_rewritten_metadata_are_no_restart(tiny):
    meta = tiny / "raw/f01/uav1.sigmf-meta"
    document, node = json.loads(meta.read_text()), node_of(tiny, "uav1")
    node.read()
    count = len(node.time)
    text = json.dumps({"global": {"core:extra": "x" * 999, **document["global"]}, "captures": document["captures"]})
    for share in (0.5, 1.0):
        meta.write_text(text[: int(share * len(text))])
        node.read()
        assert (node.restart, len(node.time)) == ("", count)


@pytest.mark.slow
def test_idle_recording_is_finished_and_missing_data_reported(tiny, capsys):
    meta = tiny / "raw/f01/uav1.sigmf-meta"
    meta.write_text(meta.read_text().rstrip().rstrip("}"))
    (log,) = (tiny / "raw/f01").glob("uav2.track.*")
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    Preview(Campaign.load(tiny), follow=True, every_s=1.0, end_after_s=1.0).run()
    message = next(line for line in capsys.readouterr().out.splitlines() if "--end-after" in line)
    assert "no new data for 1 s" in message
    assert "the metadata of uav1 do not contain" in message
    assert "the log of uav2 ends before its last capture" in message


@pytest.mark.slow
def test_last_image_is_at_full_resolution(tiny):
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0, end_after_s=1.0)
    preview.run()
    statuses = json.loads((tiny / "results/preview/status.json").read_text())["pairs"]
    assert [status["share"] for status in statuses.values()] == [1, 1]


@pytest.mark.slow
def test_preview_waits_for_missing_files(tiny):
    for path in (tiny / "raw/f01").iterdir():
        path.unlink()
    earlier = tiny / "results/preview/map/map.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("{}")
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0)
    threading.Timer(2.0, preview.finish.set).start()
    preview.run()
    status = json.loads((tiny / "results/preview/status.json").read_text())["pairs"]["f01/uav1-uav1"]
    assert "no such file" in status["waits"] or "track" in status["waits"]
    assert status["image"] is None
    assert not earlier.exists()


def test_image_of_a_short_aperture_is_inconclusive(tiny, monkeypatch):
    monkeypatch.setattr(preview_pair, "AT_ONCE", 16)
    monkeypatch.setattr(preview_pair, "LEAST_PULSES", 8)
    preview = Preview(Campaign.load(tiny), follow=False)
    for node in preview.nodes.values():
        node.read()
    assert preview.pairs[0].add_next(ended=True)
    focus = preview.pairs[0].shown.judged()
    assert focus["verdict"] == "inconclusive"
    assert focus["reason"].startswith("aperture too short")


@pytest.mark.slow
def test_focus_is_judged_once_the_aperture_suffices(tmp_path, monkeypatch):
    plan = replace(preset("demo", pulses=100), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    preview = Preview(Campaign.load(ap.simulate(tmp_path / "campaign", plan, seed=7)), follow=False)
    preview.nodes["f01", "uav1"].read()
    monkeypatch.setattr(preview_pair, "AT_ONCE", 2)  # two pulses span no aperture
    assert preview.pairs[0].add_next(ended=True)
    monkeypatch.setattr(preview_pair, "AT_ONCE", 2048)
    while preview.pairs[0].add_next(ended=True) or preview.pairs[0].refine_next():
        pass
    focus = preview.pairs[0].judged()
    assert focus["verdict"] == "focused", focus
    assert focus["judged_by"].endswith("fine")


@pytest.mark.slow
def test_automatic_scene_equals_that_of_a_run(tiny, tmp_path):
    state(tiny, "scene", bounds_m="auto", spacing_m=0.5)
    other = Campaign.load(copy_writable(tiny, tmp_path / "other"))
    process(other, last="ingest")
    for pair in other.flight("f01").pairs:
        echo.echo(other, "f01", pair)
    process(other, first="scene", last="terrain")
    preview = Preview(Campaign.load(tiny), follow=False)
    preview.run()
    grids = {pair.images[1].grid for pair in preview.pairs}
    assert grids == {settled_scene(other).grid}


def test_recording_is_complete_only_with_a_complete_log(tiny):
    (log,) = (tiny / "raw/f01").glob("uav1.track.*")
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    node = node_of(tiny, "uav1")
    node.read()
    assert node.ended
    assert not node.complete
    log.write_bytes(whole)
    node.read()
    assert node.complete


@pytest.mark.slow
def test_delayed_pair_uses_every_second_pulse(tiny):
    preview = Preview(Campaign.load(tiny), follow=False)
    preview.decimated = 2
    preview.run()
    status = json.loads((tiny / "results/preview/status.json").read_text())
    assert status["one_pulse_in"] == 2
    counts = status["pairs"]["f01/uav1-uav1"]["pulses"]
    assert counts["added"] + counts["excluded"] == counts["recorded"]
    assert counts["added"] == counts["recorded"] // 2
    assert "1 pulse in 2 used" in (tiny / "results/preview/index.html").read_text()


@pytest.mark.slow
def test_used_pulses_are_weighted_for_skipped_ones(finished_tiny, tmp_path, monkeypatch):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (whole, _), preview = in_blocks(root, 20, monkeypatch), Preview(Campaign.load(root), follow=False)
    node, pair = preview.nodes["f01", "uav1"], preview.pairs[0]
    node.read()
    assert pair.add_next(ended=True, every=1)
    assert pair.add_next(ended=True, every=2)
    thinned, every = pair.images[0], whole.images[0]
    assert thinned.pulses == 20 + (every.pulses - 20) // 2
    gain = np.vdot(every.sums, thinned.sums) / np.vdot(every.sums, every.sums)
    assert abs(gain - 1) < 0.05  # 0.75 without the weight


def test_decimation_follows_the_delay(tiny, monkeypatch):
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0)
    delay = [20.0]
    monkeypatch.setattr(
        preview, "show_pair", lambda _: {"delay_s": delay[0], "image": None, "pulses": {"recorded": 0}, "waits": ""}
    )
    decimations = []
    for delay[0] in (20.0, 21.0, 20.5, 22.0, 0.5, 0.5):
        preview.busy_s = 900.0 * (delay[0] > 1)
        preview.show(ended=False, elapsed_s=1e3)
        decimations.append(preview.decimated)
    assert decimations == [1, 2, 2, 4, 2, 1]  # unchanged at first, during planning, and while catching up


@pytest.mark.slow
def test_map_of_a_preview_serves_only_the_last_images(tiny, capsys):
    """The preview waits for the first image, keeps two per pair, and resamples to the grid of the scene."""
    preview, waiting = Preview(Campaign.load(tiny), follow=True, every_s=2.0, end_after_s=1e6), threading.Event()

    def serve():
        with served_look(preview.campaign):
            waiting.set()

    serving = threading.Thread(target=serve)
    serving.start()
    assert not waiting.wait(0.5)
    assert "waiting for the first image" in capsys.readouterr().out
    for node in preview.nodes.values():
        node.read()
    assert all(pair.add_next(ended=True) for pair in preview.pairs)
    for number in range(4):
        preview.show(ended=number == 3, elapsed_s=1.0)
    assert waiting.wait(5.0)
    serving.join()
    folder = tiny / "results/preview"
    document = json.loads((folder / "map/map.json").read_text())
    assert document["again_s"] is None
    with served_look(preview.campaign) as server:
        listed = server.files()
        assert sorted(listed) == ["f01/uav1-uav1/db.1.tif", "f01/uav1-uav2/db.1.tif", "map/map.json"]
        assert all(server.sha256_of(name) == sha256 for name, sha256 in listed.items())
    assert sorted(path.name for path in (folder / "f01/uav1-uav1").iterdir()) == ["db.0.tif", "db.1.tif"]
    with rasterio.open(folder / "f01/uav1-uav1/db.1.tif") as raster:
        assert (*raster.shape, *raster.bounds) == (*document["grid"]["shape"], *document["grid"]["bounds_m"])
        level = raster.read(1)
    x, y = (document["places"][-2][name] for name in ("x_m", "y_m"))
    row, column = raster.index(x, y)
    assert np.nanmax(level[row - 2 : row + 3, column - 2 : column + 3]) == pytest.approx(np.nanmax(level), abs=0.5)


def test_preview_writes_only_to_its_own_folder(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    before = files_of(root)
    Preview(Campaign.load(root), follow=False).run()
    assert files_of(root) == before
    shown = {path.relative_to(root / "results/preview").as_posix() for path in (root / "results/preview").rglob("*.*")}
    images = {f"f01/uav1-uav{node}{end}" for node in (1, 2) for end in (".png", "/db.0.tif")}
    assert shown == {"index.html", "status.json", "map/map.json"} | images
    status = json.loads((root / "results/preview/status.json").read_text())["pairs"]["f01/uav1-uav1"]
    assert status["verdict"] in {"focused", "inconclusive"}
    assert status["share"] == 1


@pytest.mark.slow
def test_clean_removes_the_files_of_a_preview(tiny):
    campaign = Campaign.load(tiny)
    Preview(campaign, follow=False).run()
    (tiny / "results/preview/notes.txt").write_text("mine")
    clean(campaign, unfinished_only=False, agreed=True)
    assert [path.name for path in (tiny / "results/preview").rglob("*")] == ["notes.txt"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root: state(root, "scene", bounds_m="auto"), "scene.bounds_m"),
        (lambda root: next((root / "raw/f01").glob("uav1.track.*")).rename(root / "raw/f01/uav1.track.ulg"), "px4"),
    ],
)
def test_recording_that_cannot_be_followed_is_refused(tiny, change, message):
    change(tiny)
    with pytest.raises(CampaignError, match=message):
        Preview(Campaign.load(tiny), follow=True, every_s=1.0).run()


@pytest.mark.slow
def test_slow_drawing_does_not_end_a_recording(tiny, tmp_path, monkeypatch):
    root = tmp_path / "replayed"
    replayed.begin(tiny, root)
    preview = Preview(Campaign.load(root), follow=True, every_s=1.0, end_after_s=2.0)

    def slowly(_):
        time.sleep(2.5)
        for node in preview.nodes.values():
            node.read()
        return {"delay_s": None, "image": None, "pulses": {"recorded": 0}, "waits": ""}

    monkeypatch.setattr(preview, "show_pair", slowly)
    writing = threading.Thread(target=replayed.replay, args=(tiny, root, 0.2))
    writing.start()
    preview.run()
    writing.join()
    assert all(node.complete for node in preview.nodes.values())


@pytest.fixture(scope="session")
def run_without_preview(_tiny, made_once):
    """The tiny campaign run by `apertura run`; read only."""
    return made_once("without_preview", lambda root: replayed.run_without_look(_tiny, root, cores=2))


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["by its hash", "by Ctrl-C"])
def test_previewed_replay_gives_the_results_of_a_run(tiny, run_without_preview, tmp_path, ends):
    root = tmp_path / "replayed"
    replayed.begin(tiny, root)
    words = [APERTURA, "preview", root, "--follow", "--every", "1", "--end-after", "600", "--cores", "2"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert "shown in" in process.stdout.readline()
        replayed.replay(tiny, root, rate=0.25)
        if ends == "by Ctrl-C":
            time.sleep(0.1)
            process.send_signal(signal.SIGINT)
        printed = process.communicate(timeout=400)[0]
    assert process.returncode == 0, printed
    assert "s behind" in printed
    first, second = (replayed.hashes_of(folder / "results") for folder in (run_without_preview, root))
    assert "f01/fused/coherent_db.tif" in first
    assert first == second
