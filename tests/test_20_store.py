"""A stage is complete or absent, and says so when it is not what was written."""

import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from apertura.campaign.store import (
    finish,
    manifest_of,
    mark_rewritten,
    open_array,
    open_document,
    open_stage,
    progress,
    resume,
    save_document,
    save_stage,
    sharing,
    write_blocks,
    writing,
)
from apertura.campaign.store.chunks import StageStore
from apertura.campaign.store.manifest import check_stage
from apertura.common.contracts import STAGES, check
from apertura.common.errors import CampaignError, ContractError
from apertura.common.provenance import sha256_tree
from apertura.stages.tags import stamp

NOTHING = {"runspec": {}, "inputs": {}, "code_sha256": "0"}


def track():
    dataset = xr.Dataset(
        {
            "time": ("epoch", np.array(["2025-01-01", "2025-01-02"], "datetime64[ns]")),
            "position": (("epoch", "axis"), np.zeros((2, 3))),
            "attitude": (("epoch", "axis"), np.full((2, 3), np.nan)),
        },
        attrs={"node": "a", "frame": "ecef", "dropped": {}},
    )
    return stamp(dataset, "track", **NOTHING)


def test_a_stage_comes_back_as_it_was_saved(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    back = open_stage(tmp_path / "track.zarr", "track")
    xr.testing.assert_identical(back.load(), track())
    assert back.time.dtype == "datetime64[ns]"


def test_a_changed_file_is_named_with_the_manifest_to_delete(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    chunk = next(path for path in (tmp_path / "track.zarr" / "position" / "c").rglob("*") if path.is_file())
    chunk.write_bytes(b"x")
    with pytest.raises(CampaignError, match=r"position/.*track\.manifest\.json and run the workflow again"):
        open_stage(tmp_path / "track.zarr", "track").load()


def test_a_document_that_is_not_as_it_was_written_is_refused(tmp_path):
    """Also where it is still a document: its hash is what its manifest says, or it is not read."""
    path = tmp_path / "scene.json"
    save_document(path, {"height_m": 1.0})
    assert open_document(path) == {"height_m": 1.0}
    path.write_text(path.read_text().replace("1.0", "2.0"))
    with pytest.raises(CampaignError, match="file differs from the manifest"):
        open_document(path)


def test_a_chunk_in_the_place_of_another_is_refused_when_it_is_read(tmp_path):
    """It is whole by its own sum; the manifest knows better. What is not read is not looked at."""
    values = np.arange(40.0).reshape(10, 4).astype(np.complex64)
    stage = xr.Dataset({"transfer": (("pulse", "subcarrier"), np.broadcast_to(np.complex64(0), values.shape))})
    for name in ("a", "b"):
        with writing(tmp_path / name / "echo.zarr") as wip:
            write_blocks(wip, stage, "transfer", [values[:7] + (name == "b"), values[7:]])
            finish(wip, tmp_path / name / "echo.zarr")
    place = "echo.zarr/transfer/c/0/0"
    (tmp_path / "a" / place).write_bytes((tmp_path / "b" / place).read_bytes())
    sums = check_stage(tmp_path / "a" / "echo.zarr")
    with pytest.raises(CampaignError, match=r"transfer/c/0/0: the file is damaged"):
        zarr.open_array(StageStore(tmp_path / "a" / "echo.zarr", read_only=True, sha256=sums), path="transfer")[:]
    np.testing.assert_array_equal(zarr.open_array(tmp_path / "b" / "echo.zarr", path="transfer")[:7], values[:7] + 1)


def test_an_array_is_the_same_on_the_disk_however_its_blocks_are_cut(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "_CHUNK_BYTES", 3 * 4 * 8)
    monkeypatch.setattr(progress, "_FEWEST_ROWS", 1)
    values = np.random.default_rng(1).normal(size=(11, 4))
    stage = xr.Dataset({"profile": (("pulse", "range"), np.broadcast_to(0.0, values.shape))})
    trees = []
    for cut in ([11], [1] * 11, [5, 6]):
        write_blocks(tmp_path / "x.wip", stage, "profile", np.split(values, np.cumsum(cut)[:-1]))
        np.testing.assert_array_equal(zarr.open_array(tmp_path / "x.wip", path="profile")[:], values)
        trees.append(sha256_tree(tmp_path / "x.wip"))
    assert trees[0] == trees[1] == trees[2]
    assert len(trees[0]) == 2 + 6  # two rows a chunk


def test_rows_of_zeros_take_no_space_and_read_as_zeros(tmp_path):
    values = np.zeros((4096, 1024), np.complex64)
    values[1500] = 1
    stage = xr.Dataset({"profile": (("pulse", "range"), np.broadcast_to(np.complex64(0), values.shape))})
    write_blocks(tmp_path / "x.wip", stage, "profile", [values])
    assert [path.name for path in (tmp_path / "x.wip/profile/c").iterdir()] == ["1"]
    np.testing.assert_array_equal(zarr.open_array(tmp_path / "x.wip", path="profile")[:], values)


@pytest.mark.parametrize("rows", [10, 12])
def test_blocks_that_are_not_the_whole_array_are_no_stage(tmp_path, rows):
    stage = xr.Dataset({"profile": (("pulse", "range"), np.broadcast_to(0.0, (11, 4)))})
    with pytest.raises(ValueError, match="of profile: must be 11"):
        write_blocks(tmp_path / "x.wip", stage, "profile", [np.zeros((rows, 4))])


def test_a_folder_without_a_manifest_is_not_finished(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    manifest_of(tmp_path / "track.zarr").unlink()
    with pytest.raises(CampaignError, match="missing or unfinished"):
        open_stage(tmp_path / "track.zarr", "track")


def test_a_stage_of_another_version_is_one_message(tmp_path):
    save_stage(track().drop_vars("attitude"), tmp_path / "track.zarr")
    with pytest.raises(
        CampaignError, match=r"written by another version of apertura: .*attitude.*Run the workflow again"
    ):
        open_stage(tmp_path / "track.zarr", "track")


def test_the_same_stage_gives_the_same_manifest(tmp_path):
    for name in ("a", "b"):
        save_stage(track(), tmp_path / name / "track.zarr")
    first, second = ((tmp_path / name / "track.manifest.json").read_bytes() for name in ("a", "b"))
    assert first == second


def test_a_broken_contract_lists_everything_that_is_wrong():
    wrong = track().drop_vars("time").assign(position=(("axis", "epoch"), np.zeros((3, 2), np.float32)))
    with pytest.raises(ContractError, match=r"no variable 'time'.*position has dims.*position is float32"):
        check(wrong, "track")


def test_every_stage_says_what_each_variable_means():
    meanings = {name: [one.meaning for one in stage.variables.values()] for name, stage in STAGES.items()}
    assert min(map(len, meanings.values())) >= 1
    assert [name for name, told in meanings.items() if not all(one.strip() for one in told)] == []


def empty_image(code="0"):
    dataset = xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), (64, 48)))},
        attrs={"frame": "local", "pair": "a-a", "flags": {}, "quality": {}},
    )
    return stamp(dataset, "image", runspec={}, inputs={}, code_sha256=code)


WINDOWS = [(slice(r, r + 32), slice(c, min(c + 32, 48))) for r in (0, 32) for c in (0, 32)]


def test_finished_tiles_are_kept_and_other_work_is_thrown_away(tmp_path):
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS
        zarr.open_array(Path(wip) / "image", mode="r+")[WINDOWS[1]] = 0
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == [WINDOWS[0], *WINDOWS[2:]]
        assert resume(wip, empty_image(code="1"), "image", WINDOWS) == WINDOWS


def test_jobs_share_the_work_and_who_finishes_waits_for_them(tmp_path):
    folder, alone = tmp_path / "image.zarr", threading.Event()

    def finish_it():
        with writing(folder):
            alone.set()

    finisher = threading.Thread(target=finish_it)
    with sharing(folder, empty_image(), "image", WINDOWS) as (wip, first):
        zarr.open_array(Path(wip) / "image", mode="r+")[WINDOWS[0]] = 1
        with sharing(folder, empty_image(), "image", WINDOWS) as (_, second):
            finisher.start()
            assert not alone.wait(0.3)
    finisher.join(10)
    assert alone.is_set()
    assert (first, second) == (WINDOWS, WINDOWS[1:])


def test_other_work_that_came_between_is_not_written_into(tmp_path, monkeypatch):
    folder, real = tmp_path / "image.zarr", fcntl.flock

    def slow(lock, kind):
        if kind == fcntl.LOCK_SH:  # the lock is let go for a moment: another step begins other work
            resume(folder.with_name("image.zarr.wip"), empty_image(code="1"), "image", WINDOWS)
        real(lock, kind)

    monkeypatch.setattr(fcntl, "flock", slow)
    with sharing(folder, empty_image(), "image", WINDOWS) as (_, missing):
        assert missing == []


def finished_image(folder):
    with writing(folder) as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        zarr.open_array(Path(wip) / "image", mode="r+")[:] = 1
        finish(wip, folder)


def test_a_sealed_stage_whose_record_snakemake_removed_is_not_computed_again(tmp_path):
    finished_image(tmp_path / "image.zarr")
    manifest_of(tmp_path / "image.zarr").unlink()
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == []


def test_a_damaged_stage_is_computed_again(tmp_path):
    finished_image(tmp_path / "image.zarr")
    (tmp_path / "image.zarr" / "image" / "c" / "0" / "0").write_bytes(b"x")
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS


def test_a_partial_chunk_of_a_killed_writer_does_not_stay(tmp_path):
    with writing(tmp_path / "image.zarr") as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        zarr.open_array(Path(wip) / "image", mode="r+")[:] = 1
        (wip / "image" / "c" / "0" / "0.123.partial").write_bytes(b"half")
        finish(wip, tmp_path / "image.zarr")
    files = json.loads(manifest_of(tmp_path / "image.zarr").read_text())["files"]
    assert not [name for name in files if name.endswith(".partial")]


def test_chunks_that_were_being_rewritten_are_begun_anew_and_so_are_those_of_a_finished_stage(tmp_path):
    """Tiles formed again for their error: a run that is killed meanwhile must come to the same certificate."""
    folder = tmp_path / "image.zarr"
    with writing(folder) as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        open_array(wip, "image")[:] = 1
        mark_rewritten(wip, "image", WINDOWS, WINDOWS[:1])
        mark_rewritten(wip, "image", WINDOWS, WINDOWS[1:2])
        open_array(wip, "image")[WINDOWS[0]] = 2
    with writing(folder) as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS[:2]
        open_array(wip, "image")[:] = 1
        mark_rewritten(wip, "image", WINDOWS, WINDOWS[2:3])
        finish(wip, folder)
    manifest_of(folder).unlink()
    with writing(folder) as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS[2:3]


def test_no_name_in_work_of_a_stranger_removes_anything_else(tmp_path):
    (tmp_path / "kept").write_text("")
    with writing(tmp_path / "image.zarr") as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        open_array(wip, "image")[:] = 1
        path = wip / "zarr.json"
        document = json.loads(path.read_text())
        document["attributes"]["rewritten_chunks"] = ["../kept", str(tmp_path / "kept"), "zarr.json"]
        path.write_text(json.dumps(document))
        assert resume(wip, empty_image(), "image", WINDOWS) == []
    assert (tmp_path / "kept").exists()


def test_a_second_writer_waits_for_the_first(tmp_path):
    holder = "from apertura.campaign.store import writing\nfrom pathlib import Path\nimport sys, time\n"
    holder += "with writing(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(1.5)\n"
    with subprocess.Popen(
        [sys.executable, "-c", holder, str(tmp_path / "image.zarr")], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        began = time.monotonic()
        with writing(tmp_path / "image.zarr"):
            waited = time.monotonic() - began
    assert waited > 0.5


def half_done(folder):
    """Work in progress that holds all tiles but the last; what it holds is 1."""
    with writing(folder) as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        target = open_array(wip, "image")
        for window in WINDOWS[:-1]:
            target[window] = 1
    return wip


def flipped(content):
    return content[:20] + bytes([content[20] ^ 1]) + content[21:]


DAMAGE = {
    "truncated": lambda content: content[:-7],
    "empty": lambda _: b"",
    "zeroed": lambda content: bytes(len(content)),
    "flipped": flipped,
    "another file": lambda _: b'{"zarr_format": 3}',
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize("shared", [False, True], ids=["one job", "many jobs"])
def test_a_damaged_tile_in_work_in_progress_is_formed_again_with_a_notice(tmp_path, caplog, damage, shared):
    tile = half_done(tmp_path / "image.zarr") / "image" / "c" / "0" / "1"
    tile.write_bytes(damage(tile.read_bytes()))
    if shared:
        with sharing(tmp_path / "image.zarr", empty_image(), "image", WINDOWS) as (_, missing):
            assert missing == [WINDOWS[1], WINDOWS[3]]
    else:
        with writing(tmp_path / "image.zarr") as wip:
            assert resume(wip, empty_image(), "image", WINDOWS) == [WINDOWS[1], WINDOWS[3]]
    assert [record.getMessage().split(" is damaged")[0] for record in caplog.records] == [str(tile)]
    assert "recomputing it" in caplog.text


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff\xfe", b"[]", b'{"attributes": 1}', b"[" * 100_000],
    ids=["empty", "cut", "no text", "a list", "other attributes", "very deep"],
)
def test_work_in_progress_that_cannot_say_what_it_is_is_begun_anew_with_a_notice(tmp_path, caplog, content):
    wip = half_done(tmp_path / "image.zarr")
    (wip / "zarr.json").write_bytes(content)
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS
    assert "recomputing from the start" in caplog.text


def test_damaged_metadata_of_an_array_is_written_again_and_its_tiles_are_kept(tmp_path, caplog):
    wip = half_done(tmp_path / "image.zarr")
    metadata = wip / "image" / "zarr.json"
    content = metadata.read_bytes()
    metadata.write_bytes(content.replace(b"complex64", b"complex32"))
    (wip / "image" / "c" / "7").mkdir()
    (wip / "image" / "c" / "7" / "7").write_bytes(b"no chunk of it")
    with sharing(tmp_path / "image.zarr", empty_image(), "image", WINDOWS) as (_, missing):
        assert missing == WINDOWS[3:]
    assert metadata.read_bytes() == content
    assert not (wip / "image" / "c" / "7" / "7").exists()
    assert "image/zarr.json is damaged" in caplog.text


def test_undamaged_work_is_resumed_without_a_word(tmp_path, caplog):
    half_done(tmp_path / "image.zarr")
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS[3:]
    assert caplog.records == []


def test_a_tile_reaches_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    with writing(tmp_path / "image.zarr") as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        tile, synchronised = wip / "image" / "c" / "0" / "0", []
        monkeypatch.setattr(os, "fsync", lambda _: synchronised.append(tile.exists()))
        open_array(wip, "image")[WINDOWS[0]] = 1
        assert synchronised == [False]
        assert tile.is_file()


def test_every_chunk_of_every_array_carries_a_sum(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    finished_image(tmp_path / "image.zarr")
    arrays = [json.loads(path.read_text()) for path in tmp_path.glob("*.zarr/*/zarr.json")]
    assert len(arrays) == 4
    assert {array["codecs"][-1]["name"] for array in arrays} == {"crc32c"}


def test_a_chunk_damaged_after_its_stage_was_opened_is_one_message_with_the_manifest_to_delete(tmp_path):
    finished_image(tmp_path / "image.zarr")
    opened = open_stage(tmp_path / "image.zarr", "image")
    chunk = tmp_path / "image.zarr" / "image" / "c" / "1" / "1"
    chunk.write_bytes(flipped(chunk.read_bytes()))
    assert opened.image[0, 0].item() == 1
    with pytest.raises(
        CampaignError, match=r"image/c/1/1: the file is damaged.*Delete .*image\.manifest\.json and run"
    ) as caught:
        opened.image.load()
    assert str(caught.value).count(str(tmp_path)) == 2


def test_a_chunk_that_is_gone_after_its_stage_was_opened_is_no_empty_one(tmp_path):
    """zarr fills a chunk that is not there with the fill value, as of pixels that were never formed: NaN."""
    finished_image(tmp_path / "image.zarr")
    opened = open_stage(tmp_path / "image.zarr", "image")
    (tmp_path / "image.zarr" / "image" / "c" / "1" / "1").unlink()
    assert opened.image[0, 0].item() == 1
    with pytest.raises(
        CampaignError, match=r"image/c/1/1: the file is damaged.*Delete .*image\.manifest\.json and run"
    ):
        opened.image.load()
