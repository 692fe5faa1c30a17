"""`apertura reproduce`: a product is recomputed from the raw samples in another folder and compared by bytes."""

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
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


@pytest.fixture
def fake_run(finished_tiny, monkeypatch):
    """Replace the run by a copy of finished results; return the list of its calls."""
    calls = []

    def copied(root, cores, *targets):
        calls.append((root, cores, targets))
        assert not (root / "results").exists()
        assert contents(root / "raw") == contents(finished_tiny.root / "raw")
        shutil.copytree(str(finished_tiny.results), str(root / "results"))
        return 0

    monkeypatch.setattr(RUN, copied)
    return calls


def result_files(root):
    """Return the contents of all manifests and of the files that they list."""
    files = {}
    for manifest in manifests(root / "results"):
        for path in [manifest, *(manifest.parent / name for name in json.loads(manifest.read_text())["files"])]:
            files[path.relative_to(root).as_posix()] = path.read_bytes()
    return files


@pytest.mark.slow
def test_products_are_reproduced_in_another_folder_with_other_cores(root, tmp_path, capsys):
    """The original results were computed by one process with two threads; the workflow recomputes them on one core."""
    before = contents(root)
    assert print_reproduced(root, cores=1, keep=tmp_path / "another folder") == 0
    same, kept = capsys.readouterr().out.splitlines()[-2:]
    assert same.startswith("same     ")
    assert same.endswith(f"and {len(list(manifests(root / 'results'))) - 1} more results, identical byte for byte")
    assert kept == f"recomputed in {tmp_path / 'another folder'}"
    assert contents(root) == before
    assert result_files(root).items() <= result_files(tmp_path / "another folder").items()


@pytest.mark.slow
def test_deleted_results_are_recomputed_with_identical_bytes(root):
    before = result_files(root)
    shutil.rmtree(root / "results")
    assert run_workflow(root, 2, show="errors") == 0
    assert before.items() <= result_files(root).items()


@pytest.mark.slow
def test_product_of_changed_inputs_differs(root, capsys):
    """Only the results on which the product depends are recomputed."""
    path = root / "raw/f01/uav1.track.csv"
    text = path.read_text()
    path.write_text(text.replace(",620.", ",621.") if ",620." in text else text.replace("5,", "6,", 1))
    assert print_reproduced(root / "results/f01/uav1/track.zarr", cores=1) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("changed  results/f01/uav1/track.zarr/")
    assert any(line.split()[:2] == ["inputs", "raw/f01/uav1.track.csv:"] for line in lines)
    assert lines[-1].endswith("is results/f01/uav1/track.manifest.json")


@pytest.mark.slow
def test_only_sources_of_the_product_are_requested(root, fake_run, capsys):
    assert print_reproduced(root / PAIR / "db.tif", cores=3) == 0
    ((folder, cores, targets),) = fake_run
    assert (cores, targets) == (3, (f"{PAIR}/export.manifest.json",))
    assert not folder.exists()
    count = len(json.loads((root / PAIR / "export.manifest.json").read_text())["files"])
    expected = f"same     {count} files of {PAIR}/export.manifest.json, identical byte for byte\n"
    assert capsys.readouterr().out == expected
    assert print_reproduced(root, cores=1) == 0
    assert fake_run[1][2] == ("all",)


@pytest.mark.quick("db.tif")
@pytest.mark.parametrize("name", ["db.tif", "image.json", "export.manifest.json"])
def test_edited_file_differs(root, fake_run, capsys, name):
    data = bytearray((root / PAIR / name).read_bytes())
    data[-2] ^= 1
    (root / PAIR / name).write_bytes(data)
    if name == "export.manifest.json":
        assert "damaged" in complaint(lambda: print_reproduced(root / PAIR / name, cores=1))
        return
    assert print_reproduced(root / PAIR / name, cores=1) == 1
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == f"changed  {PAIR}/{name}: first difference at byte {len(data) - 2}"
    assert "changed after the run" in last


def test_edited_chunk_of_a_stage_is_reported(root, fake_run, capsys):
    chunk = root / PAIR / "image.zarr/image/c/0/0"
    chunk.write_bytes(chunk.read_bytes() + b"more")
    assert print_reproduced(root / PAIR / "image.zarr", cores=1) == 1
    assert capsys.readouterr().out.startswith(f"changed  {PAIR}/image.zarr/image/c/0/0: first difference at byte ")


def test_missing_file_is_reported(root, fake_run, capsys):
    (root / PAIR / "db.tif").unlink()
    assert print_reproduced(root / PAIR / "db.tif", cores=1) == 1
    assert f"missing  {PAIR}/db.tif: only in the recomputed results" in capsys.readouterr().out.splitlines()


def test_first_result_that_differs_is_reported(root, fake_run, capsys):
    path = root / "results/scene.manifest.json"
    path.write_text(path.read_text() + "\n")
    path = root / PAIR / "export.manifest.json"
    path.write_text(path.read_text() + "\n")
    assert print_reproduced(root / PAIR / "db.tif", cores=1) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "the first result of the chain that differs is results/scene.manifest.json"


def test_failed_run_returns_its_status(root, monkeypatch, capsys):
    monkeypatch.setattr(RUN, lambda *_: 2)
    assert print_reproduced(root, cores=1) == 2
    assert capsys.readouterr().out == ""


def test_kept_recordings_are_copies(root, fake_run, tmp_path):
    assert print_reproduced(root / PAIR / "db.tif", cores=1, keep=tmp_path / "kept") == 0
    raw = "raw/f01/uav1.sigmf-data"
    assert (tmp_path / "kept" / raw).stat().st_ino != (root / raw).stat().st_ino
    assert (tmp_path / "kept" / PAIR / "db.tif").is_file()


def test_nothing_is_overwritten(root, fake_run, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    product = root / PAIR / "db.tif"
    assert "not empty" in complaint(lambda: print_reproduced(product, cores=1, keep=tmp_path / "full"))
    assert "outside the campaign" in complaint(lambda: print_reproduced(product, cores=1, keep=root / "recomputed"))
    assert not (root / "recomputed").exists()
    assert fake_run == []


def test_product_that_cannot_be_recomputed_is_one_message(root, fake_run, tiny, tmp_path):
    (root / PAIR / "note.tif").write_bytes(b"")
    assert "not a result of the campaign as configured" in complaint(
        lambda: print_reproduced(root / PAIR / "note.tif", cores=1)
    )
    assert "no results" in complaint(lambda: print_reproduced(tiny, cores=1))
    with hold(root):
        assert "a run is in progress" in complaint(lambda: print_reproduced(root, cores=1))
    assert fake_run == []
