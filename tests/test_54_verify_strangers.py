"""`apertura verify` with untrusted, outdated and edited files: one line per link, and no side effects."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from folders import complaint, copy_writable
from spoilt import DB, EXPORT, IMAGE, RAW, edited, flip, retag, tag, wrong

from apertura.common.provenance import canonical_json, sha256_file
from apertura.views.verify.chain import print_verified, verify


@pytest.fixture
def root(finished_tiny, tmp_path):
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


@pytest.mark.quick("[[]1]", '{"a": 3}')
@pytest.mark.parametrize("text", ["{", "[1]", '{"a": 3}', "[" * 100_000, "\x1b[31m", "NaN"])
def test_malformed_tag_is_reported(root, capsys, text):
    retag(root / DB, SOURCES=text)
    assert print_verified(root / DB) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"changed  tags of {DB}: ") for line in lines)
    assert all(line.isprintable() and len(line) < 400 for line in lines)


def test_linked_chunk_is_reported_and_not_followed(root, tmp_path):
    chunk = root / IMAGE / "image/c/0/0"
    shutil.copy(chunk, tmp_path / "elsewhere")
    chunk.unlink()
    chunk.symlink_to(tmp_path / "elsewhere")
    assert wrong(root) == {IMAGE: "changed"}


@pytest.mark.quick("../../../etc/passwd", "x.zarr*")
@pytest.mark.parametrize("name", ["../../../etc/passwd", "/etc/passwd", "a\x1b[31m", "x.zarr/../../../../etc/passwd"])
def test_manifest_with_paths_outside_the_campaign_is_refused(root, capsys, name):
    edited(root / EXPORT, lambda document: document["files"].update({name: "0" * 64}))
    assert print_verified(root / EXPORT, quiet=True) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(("changed  ", "missing  "))
    assert line.isprintable()
    assert "root:" not in line


def test_circular_sources_terminate(root):
    edited(root / EXPORT, lambda document: document["sources"].update({EXPORT: "0" * 64}))
    assert wrong(root)[EXPORT] == "changed"


def test_manifest_of_an_older_version_is_reported(root):
    edited(root / EXPORT, lambda document: [document.pop(key) for key in ("sources", "settings", "code")])
    (link,) = [link for link in verify(root / DB).links if link.name == EXPORT]
    assert link.state == "changed"
    assert "versions before 0.1.0" in link.reason[0]


def test_other_software_versions_are_noted_without_failure(root, capsys):
    software = tag(root / DB, "SOFTWARE") | {"numpy": "1.0"}
    retag(root / DB, SOFTWARE=canonical_json(software), VERSION="0.0.9", LOCK_SHA256="0" * 64)
    edited(root / EXPORT, lambda document: document["files"].update({"db.tif": sha256_file(root / DB)}))
    assert print_verified(root / DB, quiet=True) == 0
    version, numpy, lock = capsys.readouterr().out.splitlines()
    assert version.startswith(f"apertura 0.0.9 made products such as {DB}, ")
    assert "numpy 1.0 (installed: " in numpy
    assert lock == "products were made with a different requirements/all.txt"


def test_invalid_config_does_not_hide_other_links(root):
    (root / "config/config.yaml").write_text("scene: [")
    flip(root / RAW)
    assert wrong(root) == {"campaign": "changed", RAW: "changed"}


def test_copy_outside_the_campaign_is_recognised(root, tmp_path, capsys):
    copy = shutil.copy(root / DB, tmp_path / "copy.tif")
    assert "outside a campaign folder" in complaint(lambda: print_verified(tmp_path / "copy.tif"))
    assert f"APERTURA_INPUTS {RAW} {sha256_file(root / RAW)}" in capsys.readouterr().out.splitlines()
    assert print_verified(tmp_path / "copy.tif", root) == 0
    assert f"copy.tif, a copy of a file of {EXPORT}" in capsys.readouterr().out
    retag(copy, ERROR_DB="-200")
    assert print_verified(tmp_path / "copy.tif", root, quiet=True) == 1
    assert capsys.readouterr().out.startswith("changed  copy.tif: not identical to any file of that campaign")


def test_file_that_is_no_product_is_one_message(root, tmp_path):
    (tmp_path / "note.txt").write_text("")
    (tmp_path / "plain.tif").write_bytes(b"II*\0")
    assert "no such file" in complaint(lambda: print_verified(tmp_path / "nowhere.tif"))
    assert "outside a campaign folder" in complaint(lambda: print_verified(tmp_path / "note.txt"))
    assert "not readable as GeoTIFF" in complaint(lambda: print_verified(tmp_path / "plain.tif"))
    assert "not listed in any manifest" in complaint(lambda: print_verified(tmp_path / "note.txt", root))
    assert "a folder that is not a result" in complaint(lambda: print_verified(root / "results/f01"))


def test_hostile_file_name_is_printed_escaped(root, capsys):
    shutil.copy(root / DB, root / "results/f01/uav1-uav2/a\x1b]0;owned\x07.tif")
    assert print_verified(root / "results/f01/uav1-uav2/a\x1b]0;owned\x07.tif", quiet=True) == 1
    assert all(line.isprintable() for line in capsys.readouterr().out.splitlines())


@pytest.mark.quick("words0")
@pytest.mark.parametrize("words", [("verify", "nowhere.tif"), ("diff", "nowhere.tif", "there.tif"), ("reproduce", ".")])
def test_missing_product_is_one_line_and_status_2(tmp_path, words):
    apertura = Path(sys.executable).parent / "apertura"
    done = subprocess.run([apertura, *words], text=True, capture_output=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
