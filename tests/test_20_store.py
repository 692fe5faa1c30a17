"""Store of stages: a stage is complete or absent, and any difference from the written data is detected."""

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


def test_saved_stage_is_read_back_unchanged(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    back = open_stage(tmp_path / "track.zarr", "track")
    xr.testing.assert_identical(back.load(), track())
    assert back.time.dtype == "datetime64[ns]"


def test_changed_file_is_reported_with_the_manifest_to_delete(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    chunk = next(path for path in (tmp_path / "track.zarr" / "position" / "c").rglob("*") if path.is_file())
    chunk.write_bytes(b"x")
    with pytest.raises(CampaignError, match=r"position/.*track\.manifest\.json and run the workflow again"):
        open_stage(tmp_path / "track.zarr", "track").load()


def test_changed_document_is_rejected(tmp_path):
    """A document is read only if its hash equals the hash in its manifest, even if the document is still valid."""
    path = tmp_path / "scene.json"
    save_document(path, {"height_m": 1.0})
    assert open_document(path) == {"height_m": 1.0}
    path.write_text(path.read_text().replace("1.0", "2.0"))
    with pytest.raises(CampaignError, match="file differs from the manifest"):
        open_document(path)


def test_swapped_chunk_is_rejected_when_read(tmp_path):
    """The checksum of the chunk is valid, but the manifest has another hash; chunks that are not read are unchecked."""
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


def test_stored_array_does_not_depend_on_its_blocks(tmp_path, monkeypatch):
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
    assert len(trees[0]) == 2 + 6  # two rows per chunk


def test_rows_of_zeros_take_no_space(tmp_path):
    values = np.zeros((4096, 1024), np.complex64)
    values[1500] = 1
    stage = xr.Dataset({"profile": (("pulse", "range"), np.broadcast_to(np.complex64(0), values.shape))})
    write_blocks(tmp_path / "x.wip", stage, "profile", [values])
    assert [path.name for path in (tmp_path / "x.wip/profile/c").iterdir()] == ["1"]
    np.testing.assert_array_equal(zarr.open_array(tmp_path / "x.wip", path="profile")[:], values)


@pytest.mark.parametrize("rows", [10, 12])
def test_blocks_that_do_not_fill_the_array_are_rejected(tmp_path, rows):
    stage = xr.Dataset({"profile": (("pulse", "range"), np.broadcast_to(0.0, (11, 4)))})
    with pytest.raises(ValueError, match="of profile were supplied; the array has 11 rows"):
        write_blocks(tmp_path / "x.wip", stage, "profile", [np.zeros((rows, 4))])


def test_folder_without_manifest_is_unfinished(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    manifest_of(tmp_path / "track.zarr").unlink()
    with pytest.raises(CampaignError, match="missing or unfinished"):
        open_stage(tmp_path / "track.zarr", "track")


def test_stage_of_another_version_is_one_message(tmp_path):
    save_stage(track().drop_vars("attitude"), tmp_path / "track.zarr")
    with pytest.raises(
        CampaignError, match=r"written by another version of apertura: .*attitude.*Run the workflow again"
    ):
        open_stage(tmp_path / "track.zarr", "track")


def test_equal_stages_have_equal_manifests(tmp_path):
    for name in ("a", "b"):
        save_stage(track(), tmp_path / name / "track.zarr")
    first, second = ((tmp_path / name / "track.manifest.json").read_bytes() for name in ("a", "b"))
    assert first == second


def test_contract_error_lists_every_fault():
    invalid = track().drop_vars("time").assign(position=(("axis", "epoch"), np.zeros((3, 2), np.float32)))
    with pytest.raises(ContractError, match=r"no variable 'time'.*position has dims.*position is float32"):
        check(invalid, "track")


def test_every_variable_of_a_stage_has_a_meaning():
    meanings = {name: [variable.meaning for variable in stage.variables.values()] for name, stage in STAGES.items()}
    assert min(map(len, meanings.values())) >= 1
    assert [name for name, texts in meanings.items() if not all(text.strip() for text in texts)] == []


def empty_image(code="0"):
    dataset = xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), (64, 48)))},
        attrs={"frame": "local", "pair": "a-a", "flags": {}, "quality": {}},
    )
    return stamp(dataset, "image", runspec={}, inputs={}, code_sha256=code)


WINDOWS = [(slice(r, r + 32), slice(c, min(c + 32, 48))) for r in (0, 32) for c in (0, 32)]


def test_finished_tiles_are_kept_and_other_work_is_discarded(tmp_path):
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS
        zarr.open_array(Path(wip) / "image", mode="r+")[WINDOWS[1]] = 0
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == [WINDOWS[0], *WINDOWS[2:]]
        assert resume(wip, empty_image(code="1"), "image", WINDOWS) == WINDOWS


def test_finishing_job_waits_for_jobs_that_share_the_work(tmp_path):
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


def test_shared_work_replaced_meanwhile_is_not_written(tmp_path, monkeypatch):
    folder, real = tmp_path / "image.zarr", fcntl.flock

    def slow(lock, kind):
        if kind == fcntl.LOCK_SH:  # the lock is released for a moment: another step starts other work
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


def test_complete_stage_without_manifest_is_not_recomputed(tmp_path):
    finished_image(tmp_path / "image.zarr")
    manifest_of(tmp_path / "image.zarr").unlink()
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == []


def test_damaged_stage_is_recomputed(tmp_path):
    finished_image(tmp_path / "image.zarr")
    (tmp_path / "image.zarr" / "image" / "c" / "0" / "0").write_bytes(b"x")
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS


def test_partial_chunk_of_a_killed_writer_is_removed(tmp_path):
    with writing(tmp_path / "image.zarr") as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        zarr.open_array(Path(wip) / "image", mode="r+")[:] = 1
        (wip / "image" / "c" / "0" / "0.123.partial").write_bytes(b"half")
        finish(wip, tmp_path / "image.zarr")
    files = json.loads(manifest_of(tmp_path / "image.zarr").read_text())["files"]
    assert not [name for name in files if name.endswith(".partial")]


def test_chunks_being_rewritten_are_recomputed_after_a_kill(tmp_path):
    """Tiles are recomputed to measure their error; a run killed at that time must reach the same certificate."""
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


def test_names_in_untrusted_work_remove_nothing_else(tmp_path):
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


def test_second_writer_waits_for_the_first(tmp_path):
    holder = "from apertura.campaign.store import writing\nfrom pathlib import Path\nimport sys, time\n"
    holder += "with writing(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(1.5)\n"
    with subprocess.Popen(
        [sys.executable, "-c", holder, str(tmp_path / "image.zarr")], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        start_s = time.monotonic()
        with writing(tmp_path / "image.zarr"):
            waited = time.monotonic() - start_s
    assert waited > 0.5


def half_done(folder):
    """Create work in progress with all tiles but the last, filled with 1."""
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
def test_damaged_tile_in_progress_is_recomputed_with_a_notice(tmp_path, caplog, damage, shared):
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
def test_unreadable_work_in_progress_is_restarted_with_a_notice(tmp_path, caplog, content):
    wip = half_done(tmp_path / "image.zarr")
    (wip / "zarr.json").write_bytes(content)
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS
    assert "recomputing from the start" in caplog.text


def test_damaged_array_metadata_is_rewritten_and_tiles_are_kept(tmp_path, caplog):
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


def test_undamaged_work_is_resumed_without_a_notice(tmp_path, caplog):
    half_done(tmp_path / "image.zarr")
    with writing(tmp_path / "image.zarr") as wip:
        assert resume(wip, empty_image(), "image", WINDOWS) == WINDOWS[3:]
    assert caplog.records == []


def test_tile_is_synced_before_renaming(tmp_path, monkeypatch):
    with writing(tmp_path / "image.zarr") as wip:
        resume(wip, empty_image(), "image", WINDOWS)
        tile, synchronised = wip / "image" / "c" / "0" / "0", []
        monkeypatch.setattr(os, "fsync", lambda _: synchronised.append(tile.exists()))
        open_array(wip, "image")[WINDOWS[0]] = 1
        assert synchronised == [False]
        assert tile.is_file()


def test_every_array_has_chunk_checksums(tmp_path):
    save_stage(track(), tmp_path / "track.zarr")
    finished_image(tmp_path / "image.zarr")
    arrays = [json.loads(path.read_text()) for path in tmp_path.glob("*.zarr/*/zarr.json")]
    assert len(arrays) == 4
    assert {array["codecs"][-1]["name"] for array in arrays} == {"crc32c"}


def test_chunk_damaged_after_opening_is_reported_with_the_manifest(tmp_path):
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


def test_chunk_deleted_after_opening_is_reported(tmp_path):
    """zarr reads an absent chunk as the fill value NaN, which is also the value of pixels that were not formed."""
    finished_image(tmp_path / "image.zarr")
    opened = open_stage(tmp_path / "image.zarr", "image")
    (tmp_path / "image.zarr" / "image" / "c" / "1" / "1").unlink()
    assert opened.image[0, 0].item() == 1
    with pytest.raises(
        CampaignError, match=r"image/c/1/1: the file is damaged.*Delete .*image\.manifest\.json and run"
    ):
        opened.image.load()
