"""`apertura reproduce`: a product is made again from the raw samples alone, elsewhere, and comes out byte for byte."""

import json
import shutil

import pytest
from folders import complaint, contents, copy_writable

from apertura.common.processes import hold
from apertura.run.driver import run_workflow
from apertura.views.verify.diff import print_reproduced
from apertura.views.verify.products import manifests

PAIR = "results/f01/uav1-uav2"
RUN = "apertura.views.verify.diff.run_workflow"


@pytest.fixture
def root(finished_tiny, tmp_path):
    """The tiny campaign with all its results, to be spoilt at will."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


@pytest.fixture
def again(finished_tiny, monkeypatch):
    """Instead of a run, the results of the session's run are copied; what was asked for is noted."""
    asked = []

    def copied(root, cores, *targets):
        asked.append((root, cores, targets))
        assert not (root / "results").exists()
        assert contents(root / "raw") == contents(finished_tiny.root / "raw")
        shutil.copytree(str(finished_tiny.results), str(root / "results"))
        return 0

    monkeypatch.setattr(RUN, copied)
    return asked


def made(root):
    """Every file that a manifest lists, and the manifests."""
    files = {}
    for manifest in manifests(root / "results"):
        for path in [manifest, *(manifest.parent / name for name in json.loads(manifest.read_text())["files"])]:
            files[path.relative_to(root).as_posix()] = path.read_bytes()
    return files


@pytest.mark.slow
def test_every_product_comes_out_byte_for_byte_elsewhere_and_by_another_number_of_cores(root, tmp_path, capsys):
    """The results there were made in one process by two threads; here the workflow makes them on one core."""
    before = contents(root)
    assert print_reproduced(root, cores=1, keep=tmp_path / "another folder") == 0
    same, kept = capsys.readouterr().out.splitlines()[-2:]
    assert same.startswith("same     ")
    assert same.endswith(f"and {len(list(manifests(root / 'results'))) - 1} more results")
    assert kept == f"recomputed in {tmp_path / 'another folder'}"
    assert contents(root) == before
    assert made(root).items() <= made(tmp_path / "another folder").items()


@pytest.mark.slow
def test_results_that_were_deleted_are_made_again_byte_for_byte(root):
    before = made(root)
    shutil.rmtree(root / "results")
    assert run_workflow(root, 2, show="errors") == 0
    assert before.items() <= made(root).items()


@pytest.mark.slow
def test_a_product_made_of_other_samples_is_not_the_same(root, capsys):
    """Only what the product stands on is made again."""
    path = root / "raw/f01/uav1.track.csv"
    text = path.read_text()
    path.write_text(text.replace(",620.", ",621.") if ",620." in text else text.replace("5,", "6,", 1))
    assert print_reproduced(root / "results/f01/uav1/track.zarr", cores=1) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("changed  results/f01/uav1/track.zarr/")
    assert any(line.split()[:2] == ["inputs", "raw/f01/uav1.track.csv:"] for line in told)
    assert told[-1].endswith("is results/f01/uav1/track.manifest.json")


@pytest.mark.slow
def test_only_what_the_product_needs_is_asked_for(root, again, capsys):
    assert print_reproduced(root / PAIR / "db.tif", cores=3) == 0
    ((folder, cores, targets),) = again
    assert (cores, targets) == (3, (f"{PAIR}/export.manifest.json",))
    assert not folder.exists()
    count = len(json.loads((root / PAIR / "export.manifest.json").read_text())["files"])
    assert capsys.readouterr().out == f"same     {count} files, byte for byte, of {PAIR}/export.manifest.json\n"
    assert print_reproduced(root, cores=1) == 0
    assert again[1][2] == ("all",)


@pytest.mark.quick("db.tif")
@pytest.mark.parametrize("name", ["db.tif", "image.json", "export.manifest.json"])
def test_a_file_that_was_edited_is_not_the_same(root, again, capsys, name):
    data = bytearray((root / PAIR / name).read_bytes())
    data[-2] ^= 1
    (root / PAIR / name).write_bytes(data)
    if name == "export.manifest.json":
        assert "damaged" in complaint(lambda: print_reproduced(root / PAIR / name, cores=1))
        return
    assert print_reproduced(root / PAIR / name, cores=1) == 1
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == f"changed  {PAIR}/{name}: first difference at byte {len(data) - 2}"
    assert "changed after it was made" in last


def test_a_stage_that_was_edited_is_told_with_its_chunk(root, again, capsys):
    chunk = root / PAIR / "image.zarr/image/c/0/0"
    chunk.write_bytes(chunk.read_bytes() + b"more")
    assert print_reproduced(root / PAIR / "image.zarr", cores=1) == 1
    assert capsys.readouterr().out.startswith(f"changed  {PAIR}/image.zarr/image/c/0/0: first difference at byte ")


def test_a_file_that_is_gone_is_told(root, again, capsys):
    (root / PAIR / "db.tif").unlink()
    assert print_reproduced(root / PAIR / "db.tif", cores=1) == 1
    assert f"missing  {PAIR}/db.tif: only in the recomputed results" in capsys.readouterr().out.splitlines()


def test_the_first_result_that_differs_is_named(root, again, capsys):
    path = root / "results/scene.manifest.json"
    path.write_text(path.read_text() + "\n")
    path = root / PAIR / "export.manifest.json"
    path.write_text(path.read_text() + "\n")
    assert print_reproduced(root / PAIR / "db.tif", cores=1) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[-1] == "the first result of the chain that differs is results/scene.manifest.json"


def test_a_run_that_fails_ends_with_its_status(root, monkeypatch, capsys):
    monkeypatch.setattr(RUN, lambda *_: 2)
    assert print_reproduced(root, cores=1) == 2
    assert capsys.readouterr().out == ""


def test_recordings_that_are_kept_are_copies(root, again, tmp_path):
    assert print_reproduced(root / PAIR / "db.tif", cores=1, keep=tmp_path / "kept") == 0
    raw = "raw/f01/uav1.sigmf-data"
    assert (tmp_path / "kept" / raw).stat().st_ino != (root / raw).stat().st_ino
    assert (tmp_path / "kept" / PAIR / "db.tif").is_file()


def test_nothing_is_overwritten(root, again, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    product = root / PAIR / "db.tif"
    assert "not empty" in complaint(lambda: print_reproduced(product, cores=1, keep=tmp_path / "full"))
    assert "outside the campaign" in complaint(lambda: print_reproduced(product, cores=1, keep=root / "again"))
    assert not (root / "again").exists()
    assert again == []


def test_what_cannot_be_made_again_is_one_message(root, again, tiny, tmp_path):
    (root / PAIR / "note.tif").write_bytes(b"")
    assert "not a result of the campaign as configured" in complaint(
        lambda: print_reproduced(root / PAIR / "note.tif", cores=1)
    )
    assert "no results" in complaint(lambda: print_reproduced(tiny, cores=1))
    with hold(root):
        assert "a run is in progress" in complaint(lambda: print_reproduced(root, cores=1))
    assert again == []
