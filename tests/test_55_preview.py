"""Preview of a flight (`apertura preview`): images of the pulses so far, from files cut wherever a write may end."""

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
from folders import ROOT, copy_writable, ingest_all, settle_ground, state

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.errors import CampaignError
from apertura.core.echo.compression import window_weights
from apertura.formats.recordings.sigmf import GrowingSigmf, open_sigmf
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
import preview as replayed  # the writers of benchmarks/preview.py, which end files wherever a write may

APERTURA = Path(sys.executable).parent / "apertura"


def files_of(root):
    """Return the files of the results but those of the preview → sha256."""
    found = (path for path in (root / "results").rglob("*") if path.is_file())
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in found
        if path.relative_to(root).parts[1] != "preview"
    }


def node_of(root, node, *, follow=True):
    campaign = Campaign.load(root)
    return NodeSoFar(campaign, "f01", node, transmitted(campaign, campaign.settings.waveform), follow=follow)


def in_blocks(root, pulses, monkeypatch):
    """Return the pairs of a campaign whose pulses were added so many at a time."""
    monkeypatch.setattr(preview_pair, "AT_ONCE", pulses)
    preview = Preview(Campaign.load(root), follow=False)
    for node in preview.nodes.values():
        node.read()
    for pair in preview.pairs:
        while pair.add_next(ended=True) or pair.refine_next():
            pass
    return preview.pairs


def apart_db(image, exact):
    """Return the RMS difference of two images relative to that of the second, dB."""
    return 10 * np.log10(np.mean(np.abs(image - exact) ** 2) / np.mean(np.abs(exact) ** 2))


@pytest.mark.quick("16")
@pytest.mark.parametrize("pulses", [7, 16, 2048])
def test_an_image_added_in_blocks_is_that_of_all_pulses_at_once(finished_tiny, tmp_path, monkeypatch, pulses):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    state(root, "processing", integration="all")
    for pair in in_blocks(root, pulses, monkeypatch)[:1]:
        coarse, fine = pair.images
        echo = PairEcho.opened(finished_tiny, "f01", pair.name).stage.load()
        assert fine.pulses == coarse.pulses == len(echo.pulse)
        height_m = finished_tiny.settings.scene.height_m
        exact = ap.backproject(echo, fine.grid, terrain=height_m, engine="reference", certified_pixels=0, judge=False)
        assert apart_db(fine.image, exact.values) < -60
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
        assert apart_db(coarse.image, exact.values) < -30  # half of what is asked
        assert coarse.error_db < -30
        assert coarse.grid.spacing_m == 2 * fine.grid.spacing_m


@pytest.mark.slow
def test_a_secondary_in_blocks_shows_the_same_points_in_focus(finished_tiny, tmp_path, monkeypatch):
    pair = in_blocks(copy_writable(finished_tiny.root, tmp_path / "campaign"), 16, monkeypatch)[1]
    image = open_stage(finished_tiny.stage("image", "f01", pair.name), "image").image.values
    ours, theirs = np.abs(pair.images[1].image), np.abs(image)
    assert np.unravel_index(ours.argmax(), ours.shape) == np.unravel_index(theirs.argmax(), theirs.shape)
    assert apart_db(pair.images[1].image, image) < -20  # what the state of a sidelink is by 16 pulses, or by all


@pytest.mark.parametrize("shares", [(0.9, 0.3), (0.4, 0.9), (0.97, 0.5001), (1.0, 0.99)])
def test_a_recording_cut_anywhere_is_read_to_its_last_whole_pulse_and_on_from_there(tiny, tmp_path, shares):
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


def test_a_recording_that_grows_byte_by_byte_is_that_which_was_recorded(tiny, tmp_path):
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


def test_metadata_that_are_written_anew_are_read_anew(tiny, tmp_path):
    meta, data = (tiny / f"raw/f01/uav1.sigmf-{kind}" for kind in ("meta", "data"))
    document, captures = json.loads(meta.read_text()), len(open_sigmf(meta, data).captures.start)
    (tmp_path / "a.sigmf-data").write_bytes(data.read_bytes())
    growing = GrowingSigmf(tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data")
    for count in (10, 25, captures):
        some = {"global": {"core:extra": "x" * count, **document["global"]}, "captures": document["captures"][:count]}
        growing.files[0].write_text(json.dumps(some))
        assert len(growing.read().captures.start) == count
    growing.files[0].write_text("")  # its recorder has just truncated it
    assert len(growing.read().captures.start) == captures


@pytest.mark.parametrize("node", ["uav1", "uav2"])  # a CSV, and an RTKLIB solution
@pytest.mark.parametrize("cut", [1, 9, 40])
def test_a_log_cut_within_a_line_is_read_to_its_last_whole_line(tiny, node, cut):
    whole = node_of(tiny, node)
    whole.read()
    (log,) = (tiny / "raw/f01").glob(f"{node}.track.*")
    log.write_bytes(log.read_bytes()[:-cut])
    read = node_of(tiny, node)
    read.read()
    assert read.waits == ""
    assert len(read.track.time) == len(whole.track.time) - 1
    assert read.known_until(ended=False) < read.known_until(ended=True) < whole.known_until(ended=True)


def test_pulses_are_held_back_that_a_log_does_not_reach(tiny):
    (log,) = (tiny / "raw/f01").glob("uav2.track.*")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[: len(lines) // 2]))
    preview = Preview(Campaign.load(tiny), follow=True)
    for one in preview.nodes.values():
        one.read()
    mono, other = preview.pairs
    reach = other.rx.known_until(ended=False)
    tx_index, rx_index = other.ready(ended=False)
    assert 0 < len(tx_index) < len(mono.ready(ended=False)[0])
    assert other.tx.time[tx_index].max() <= reach
    apart_s = (other.rx.time[rx_index] - other.tx.time[tx_index]) / np.timedelta64(1, "s")
    assert np.ptp(apart_s) < 5e-3  # the same pulses, by tags of two clocks


def other_flight(root, node="uav1"):
    """Write half of a flight of another day over that of a node, as a recorder does that is started again."""
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


@pytest.mark.quick("other_flight", "other_log")
@pytest.mark.parametrize("change", [other_flight, shorter, other_samples, other_last_samples, other_log])
def test_a_recorder_that_is_started_again_under_the_same_name_is_shown_anew(tiny, change, capsys):
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
    assert [pair.counts["added"] for pair in preview.pairs] == [0, 0]  # both are sent by uav1
    assert preview._map._entries == {}
    assert not list((tiny / "results/preview").rglob("*.png"))
    preview._read()
    for pair in preview.pairs:
        while pair.add_next(ended=True):
            pass
        assert pair.counts["added"] <= pair.counts["recorded"]
    assert "restarted" not in capsys.readouterr().out
    assert (preview.pairs[0].counts["recorded"] < before["recorded"]) == (change in (other_flight, shorter))


def test_a_recorder_started_again_while_a_picture_is_drawn_leaves_none_of_the_flight_before(tiny, monkeypatch):
    preview = Preview(Campaign.load(tiny), follow=True)
    preview._read()
    preview.pairs[0].add_next(ended=True)
    monkeypatch.setattr(preview, "_draw", lambda *_: other_flight(tiny))
    told = preview.show_pair(preview.pairs[0])
    assert (told["image"], told["pulses"]["added"]) == (None, 0)
    preview._read()
    assert preview.pairs[0].shown is None


def test_a_file_that_is_away_for_a_moment_ends_no_look(tiny):
    """As a recorder leaves it that removes and creates its files: between two reads, and before a block is read."""
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


def test_a_log_that_becomes_a_named_pipe_is_reported_once(tiny, capsys):
    preview = Preview(Campaign.load(tiny), follow=True)
    preview._read()
    capsys.readouterr()
    log = tiny / "raw/f01/uav1.track.csv"
    log.unlink()
    os.mkfifo(log)
    preview._read()
    preview._read()
    (line,) = capsys.readouterr().out.splitlines()
    assert "uav1 is not readable at present: " in line
    assert "uav1.track.csv: a named pipe" in line


def test_metadata_that_are_half_written_anew_are_no_new_flight(tiny):
    meta = tiny / "raw/f01/uav1.sigmf-meta"
    document, node = json.loads(meta.read_text()), node_of(tiny, "uav1")
    node.read()
    count = len(node.time)
    text = json.dumps({"global": {"core:extra": "x" * 999, **document["global"]}, "captures": document["captures"]})
    for share in (0.5, 1.0):
        meta.write_text(text[: int(share * len(text))])
        node.read()
        assert (node.restart, len(node.time)) == ("", count)


def test_a_recording_that_rests_is_ended_and_what_it_lacks_is_said(tiny, capsys):
    meta = tiny / "raw/f01/uav1.sigmf-meta"
    meta.write_text(meta.read_text().rstrip().rstrip("}"))
    (log,) = (tiny / "raw/f01").glob("uav2.track.*")
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    Preview(Campaign.load(tiny), follow=True, every_s=1.0, end_after_s=1.0).run()
    told = next(line for line in capsys.readouterr().out.splitlines() if "--end-after" in line)
    assert "no new data for 1 s" in told
    assert "the metadata of uav1 do not contain" in told
    assert "the log of uav2 ends before its last capture" in told


@pytest.mark.slow
def test_the_last_picture_is_the_fine_one(tiny):
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0, end_after_s=1.0)
    preview.run()
    told = json.loads((tiny / "results/preview/status.json").read_text())["pairs"]
    assert [one["share"] for one in told.values()] == [1, 1]


def test_files_that_are_not_there_yet_are_waited_for(tiny):
    for path in (tiny / "raw/f01").iterdir():
        path.unlink()
    earlier = tiny / "results/preview/map/map.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("{}")
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0)
    threading.Timer(2.0, preview.finish.set).start()
    preview.run()
    told = json.loads((tiny / "results/preview/status.json").read_text())["pairs"]["f01/uav1-uav1"]
    assert "no such file" in told["waits"] or "track" in told["waits"]
    assert told["image"] is None
    assert not earlier.exists()


def test_an_image_of_hardly_any_aperture_is_shown_but_not_judged(tiny, monkeypatch):
    monkeypatch.setattr(preview_pair, "AT_ONCE", 16)
    monkeypatch.setattr(preview_pair, "LEAST_PULSES", 8)
    preview = Preview(Campaign.load(tiny), follow=False)
    for node in preview.nodes.values():
        node.read()
    assert preview.pairs[0].add_next(ended=True)
    told = preview.pairs[0].shown.judged()
    assert told["verdict"] == "inconclusive"
    assert told["reason"].startswith("aperture too short")


def test_what_the_first_pulses_could_not_tell_later_ones_do(tmp_path, monkeypatch):
    plan = replace(preset("demo", pulses=100), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    preview = Preview(Campaign.load(ap.simulate(tmp_path / "campaign", plan, seed=7)), follow=False)
    preview.nodes["f01", "uav1"].read()
    monkeypatch.setattr(preview_pair, "AT_ONCE", 2)  # which span no aperture: what is planned for them says so
    assert preview.pairs[0].add_next(ended=True)
    monkeypatch.setattr(preview_pair, "AT_ONCE", 2048)
    while preview.pairs[0].add_next(ended=True) or preview.pairs[0].refine_next():
        pass
    told = preview.pairs[0].judged()
    assert told["verdict"] == "focused", told
    assert told["judged_by"].endswith("fine")


@pytest.mark.slow
def test_a_scene_left_to_auto_is_that_of_the_run(tiny, tmp_path):
    state(tiny, "scene", bounds_m="auto", spacing_m=0.5)
    other = Campaign.load(copy_writable(tiny, tmp_path / "other"))
    ingest_all(other)
    for pair in other.flight("f01").pairs:
        echo.echo(other, "f01", pair)
    settle_ground(other)
    preview = Preview(Campaign.load(tiny), follow=False)
    preview.run()
    grids = {pair.images[1].grid for pair in preview.pairs}
    assert grids == {settled_scene(other).grid}


def test_a_recording_has_ended_only_where_its_log_has(tiny):
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
def test_a_pair_that_falls_behind_takes_every_other_pulse_and_says_so(tiny):
    preview = Preview(Campaign.load(tiny), follow=False)
    preview.decimated = 2
    preview.run()
    told = json.loads((tiny / "results/preview/status.json").read_text())
    assert told["one_pulse_in"] == 2
    counts = told["pairs"]["f01/uav1-uav1"]["pulses"]
    assert counts["added"] + counts["left_out"] == counts["recorded"]
    assert counts["added"] == counts["recorded"] // 2
    assert "1 pulse in 2 used" in (tiny / "results/preview/index.html").read_text()


def test_pulses_stand_for_those_left_out_beside_them(finished_tiny, tmp_path, monkeypatch):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (whole, _), preview = in_blocks(root, 20, monkeypatch), Preview(Campaign.load(root), follow=False)
    node, pair = preview.nodes["f01", "uav1"], preview.pairs[0]
    node.read()
    assert pair.add_next(ended=True, every=1)
    assert pair.add_next(ended=True, every=2)
    thinned, every = pair.images[0], whole.images[0]
    assert thinned.pulses == 20 + (every.pulses - 20) // 2
    gain = np.vdot(every.sums, thinned.sums) / np.vdot(every.sums, every.sums)
    assert abs(gain - 1) < 0.05  # a half that counts half would make it 0.75


def test_a_delay_doubles_the_decimation_and_ease_halves_it(tiny, monkeypatch):
    preview = Preview(Campaign.load(tiny), follow=True, every_s=1.0)
    delay = [20.0]
    monkeypatch.setattr(
        preview, "show_pair", lambda _: {"delay_s": delay[0], "image": None, "pulses": {"recorded": 0}, "waits": ""}
    )
    told = []
    for delay[0] in (20.0, 21.0, 20.5, 22.0, 0.5, 0.5):
        preview.busy_s = 900.0 * (delay[0] > 1)
        preview.show(ended=False, elapsed_s=1e3)
        told.append(preview.decimated)
    assert told == [1, 2, 2, 4, 2, 1]  # not at first, when it still plans, nor while it catches up


@pytest.mark.slow
def test_a_map_of_a_look_serves_the_last_pictures_and_nothing_else(tiny, capsys):
    """It waits for the first; two of a pair stay, the image is on the scene's grid whatever it was formed on."""
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


def test_a_look_writes_beside_the_results_and_nowhere_else(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    before = files_of(root)
    Preview(Campaign.load(root), follow=False).run()
    assert files_of(root) == before
    shown = {path.relative_to(root / "results/preview").as_posix() for path in (root / "results/preview").rglob("*.*")}
    pictures = {f"f01/uav1-uav{node}{end}" for node in (1, 2) for end in (".png", "/db.0.tif")}
    assert shown == {"index.html", "status.json", "map/map.json"} | pictures
    told = json.loads((root / "results/preview/status.json").read_text())["pairs"]["f01/uav1-uav1"]
    assert told["verdict"] in {"focused", "inconclusive"}
    assert told["share"] == 1


@pytest.mark.slow
def test_what_a_look_wrote_goes_with_what_a_run_wrote(tiny):
    campaign = Campaign.load(tiny)
    Preview(campaign, follow=False).run()
    (tiny / "results/preview/notes.txt").write_text("mine")
    clean(campaign, unfinished_only=False, agreed=True)
    assert [path.name for path in (tiny / "results/preview").rglob("*")] == ["notes.txt"]


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda root: state(root, "scene", bounds_m="auto"), "scene.bounds_m"),
        (lambda root: next((root / "raw/f01").glob("uav1.track.*")).rename(root / "raw/f01/uav1.track.ulg"), "px4"),
    ],
)
def test_what_cannot_be_followed_is_refused_in_one_message(tiny, spoil, named):
    spoil(tiny)
    with pytest.raises(CampaignError, match=named):
        Preview(Campaign.load(tiny), follow=True, every_s=1.0).run()


@pytest.mark.slow
def test_a_picture_that_takes_longer_than_files_may_rest_does_not_end_them(tiny, tmp_path, monkeypatch):
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


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["by its hash", "by Ctrl-C"])
def test_a_replay_that_was_looked_at_ends_as_an_ordinary_run(tiny, tmp_path, ends):
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
        said = process.communicate(timeout=400)[0]
    assert process.returncode == 0, said
    assert "s behind" in said
    other = replayed.run_without_look(root, tmp_path / "other", cores=2)
    first, second = (replayed.hashes_of(one / "results") for one in (other, root))
    assert "f01/fused/coherent_db.tif" in first
    assert first == second
