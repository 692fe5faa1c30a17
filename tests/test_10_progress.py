"""Progress of a step: written to a file at most once a second; a failed write does not stop the step."""

import json

import numpy as np
import pytest

from apertura.common import progress as progress_module
from apertura.common.progress import progress, progress_path, reporting_to


@pytest.fixture
def clock(monkeypatch):
    """A clock that advances only when the test advances it."""
    now = [0.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    return now


def counted(path):
    report = json.loads(path.read_text())
    return report["done"], report["total"]


def test_progress_is_written_at_most_once_a_second_and_at_the_end(tmp_path, clock):
    path = tmp_path.joinpath(*progress_path(["image", "f01", "uav1-uav2"]))
    with reporting_to(path):
        with progress("tiles", 10) as done:
            assert counted(path) == (0, 10)
            done(3)
            assert counted(path) == (0, 10)
            clock[0] += 1.1
            done(2)
            assert counted(path) == (5, 10)
            done(5)
            assert counted(path) == (5, 10)
        assert counted(path) == (10, 10)
    assert not path.exists()


def test_work_outside_a_step_writes_no_progress(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with progress("tiles", 2) as done:
        done(2)
    assert not list(tmp_path.iterdir())


def test_unwritable_progress_folder_does_not_stop_the_step(tmp_path):
    (tmp_path / ".run").write_text("a file where a folder should be")
    with reporting_to(tmp_path.joinpath(*progress_path(["cube"]))), progress("images", 2) as done:
        done(2)


def test_failing_step_removes_its_progress(tmp_path):
    path = tmp_path.joinpath(*progress_path(["echo", "f01", "a-a"]))
    with pytest.raises(ZeroDivisionError), reporting_to(path), progress("pulses", 0) as done:
        done(1 // 0)
    assert not path.exists()


def test_progress_of_tiles_counts_their_parts(tmp_path, monkeypatch):
    """Parts are counted, not tiles, because a tile of a long flight is complete only with the last block of pulses."""
    from dask.array import ones

    from apertura.core.backprojection.tiles import compute_tiles

    monkeypatch.setattr("apertura.common.progress._BETWEEN_S", 0.0)
    reports, path, target = [], tmp_path / "image.json", np.zeros((4, 6), complex)

    class Watched:
        def __setitem__(self, window, block):
            reports.append(json.loads(path.read_text()))
            target[window] = block

    windows = [(slice(0, 2), slice(0, 2)), (slice(2, 4), slice(2, 4)), (slice(0, 2), slice(4, 6))]
    with reporting_to(path):
        compute_tiles(ones((4, 6), chunks=2), windows, Watched(), threads=1)
    assert {report["total"] for report in reports} == {6}  # each tile is formed and written
    assert 0 < reports[-1]["done"] < 6
    assert target.sum() == 12
