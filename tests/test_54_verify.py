"""`apertura verify`: whatever is touched between a product and the raw samples is named, and nothing else is."""

import functools
import json
import shutil
import subprocess
import sys

import pytest
import rasterio
from folders import complaint, copy_writable, edit_config
from PIL import Image, PngImagePlugin

from apertura.audit.verify import print_verified, verify
from apertura.provenance import PACKAGE, canonical_json, sha256_file
from apertura.steps.code import code_of

DB = "results/f01/uav1-uav2/db.tif"
EXPORT = "results/f01/uav1-uav2/export.manifest.json"
IMAGE = "results/f01/uav1-uav2/image.zarr"
RAW = "raw/f01/uav2.sigmf-data"
CODE_OF = functools.cache(code_of)


@pytest.fixture(autouse=True)
def code_is_hashed_once(monkeypatch):
    monkeypatch.setattr("apertura.audit.chain.code_of", CODE_OF)


@pytest.fixture
def root(finished_tiny, tmp_path):
    """The tiny campaign with all its results, to be spoilt at will."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


def flip(path, at=None):
    """Change one bit of one byte."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)


def wrong(root, product=DB):
    """Link → state, of those that are not the same."""
    return {link.name: link.state for link in verify(root / product).links if link.state != "same"}


def test_every_link_of_an_untouched_product_is_the_same(root):
    chain = verify(root / DB)
    names = {link.name for link in chain.links}
    assert {DB, EXPORT, IMAGE, RAW, "raw/codes.npy", f"tags of {DB}", f"code of {EXPORT}"} <= names
    assert f"settings of {EXPORT}" in names
    assert {link.state for link in chain.links} == {"same"}
    assert chain.notes == []


@pytest.mark.parametrize(
    "touched",
    [
        RAW,
        "raw/codes.npy",
        "raw/f01/uav1.track.csv",
        "results/f01/uav1/raw.manifest.json",
        "results/f01/uav1-uav2/profile.manifest.json",
        "results/scene.json",
        "results/f01/uav1-uav2/image.json",
        DB,
    ],
)
def test_one_byte_is_reported_at_its_link(root, touched):
    flip(root / touched)
    found = wrong(root)
    assert found[touched] == "changed"
    spoilt = {touched, touched.replace(".manifest.json", ".zarr"), f"code of {touched}", f"settings of {touched}"}
    assert found.keys() <= spoilt | {f"tags of {touched}"}


@pytest.mark.parametrize("file", ["image/c/0/0", "image/zarr.json", "x/c/0"])
def test_one_byte_of_a_stage_is_reported_at_the_stage(root, file):
    flip(root / IMAGE / file)
    assert wrong(root) == {IMAGE: "changed"}
    assert file in "".join(next(link for link in verify(root / DB).links if link.name == IMAGE).why)


def edited(path, change):
    """Write a JSON file as the workflow would, with something changed."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")


def test_any_byte_of_the_last_manifest_is_noticed(root):
    """Nothing has recorded its hash: what it says is compared with all that it speaks of, and how it is written."""
    whole = (root / EXPORT).read_bytes()
    for at in range(0, len(whole), 97):
        flip(root / EXPORT, at)
        assert wrong(root, EXPORT), whole[at - 20 : at + 20]
        (root / EXPORT).write_bytes(whole)
    assert wrong(root, EXPORT) == {}


def retag(path, **tags):
    with rasterio.Env(GDAL_PAM_ENABLED=False), rasterio.open(path, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        raster.update_tags(**{f"APERTURA_{name}": text for name, text in tags.items()})


def tag(path, name):
    with rasterio.open(path) as raster:
        return json.loads(raster.tags()[f"APERTURA_{name}"])


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("SOURCES", lambda told: told | {"results/scene.manifest.json": "0" * 64}),
        ("SOURCES", lambda _: {}),
        ("INPUTS", lambda told: told | {RAW: "0" * 64}),
        ("RUNSPEC", lambda told: told | {"window": "none"}),
    ],
)
def test_a_tag_edited_together_with_the_hash_of_its_file_is_reported(root, name, change):
    retag(root / DB, **{name: canonical_json(change(tag(root / DB, name)))})
    edited(root / EXPORT, lambda document: document["files"].update({"db.tif": sha256_file(root / DB)}))
    assert wrong(root) == {f"tags of {DB}": "changed"}


@pytest.mark.parametrize("text", ["{", "[1]", '{"a": 3}', "[" * 100_000, "\x1b[31m", "NaN"])
def test_a_tag_that_is_no_document_is_reported(root, capsys, text):
    retag(root / DB, SOURCES=text)
    assert print_verified(root / DB) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"changed  tags of {DB}: ") for line in lines)
    assert all(line.isprintable() and len(line) < 400 for line in lines)


def test_the_tags_of_a_picture_are_looked_at_too(root):
    path = root / DB.replace("db.tif", "quicklook.png")
    with Image.open(path) as picture:
        texts = PngImagePlugin.PngInfo()
        for name, text in picture.text.items():
            texts.add_text(name, text if name != "APERTURA_SOURCES" else "{}")
        picture.save(path, pnginfo=texts)
    found = wrong(root, path.relative_to(root))
    assert found == {f"{where}results/f01/uav1-uav2/quicklook.png": "changed" for where in ("", "tags of ")}


def test_settings_that_changed_are_reported_where_they_matter(root):
    edit_config(root, lambda document: document.setdefault("processing", {}).update({"window": "none"}))
    pairs = ("uav1-uav1", "uav1-uav2")
    assert wrong(root) == {f"settings of results/f01/{pair}/profile.manifest.json": "changed" for pair in pairs}


VERIFY = """
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in type(finder).__module__]
sys.path.insert(0, sys.argv.pop(1))
from apertura.cli import main
main()
"""


def test_code_that_changed_is_reported_where_it_ran(root, tmp_path):
    copied = shutil.copytree(PACKAGE, tmp_path / "src" / "apertura", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Snakefile", "requirements"):
        (tmp_path / name).symlink_to(PACKAGE.parents[1] / name)

    def verified():
        command = [sys.executable, "-P", "-c", VERIFY, str(copied.parent), "verify", "-q", str(root / DB)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stderr == ""
        return done.returncode, [line.split(":")[0] for line in done.stdout.splitlines()]

    assert verified() == (0, [])
    source = copied / "export" / "cog.py"
    flip(source, source.read_bytes().index(b"cloud-optimised"))
    assert verified() == (1, [f"changed  code of {EXPORT}"])


@pytest.mark.parametrize("gone", [RAW, DB, EXPORT, "results/f01/uav1/raw.manifest.json", "results/scene.json"])
def test_a_file_that_is_gone_is_missing(root, gone):
    (root / gone).unlink()
    assert wrong(root)[gone] == "missing" if gone != EXPORT else wrong(root)[DB] == "changed"
    assert wrong(root, "")[gone] == "missing"


def test_half_of_the_results_is_told_link_by_link(root):
    before = wrong(root, "")  # what these steps do not make
    assert set(before.values()) <= {"missing"}
    shutil.rmtree(root / IMAGE)
    shutil.rmtree(root / "results/f01/fused")
    gone = {IMAGE: "missing", "results/f01/fused/export.manifest.json": "missing"}
    assert wrong(root, "") == before | gone


def test_what_is_new_in_a_stage_is_reported(root):
    (root / IMAGE / "image/c/9").mkdir()
    (root / IMAGE / "image/c/9/9").write_bytes(b"more")
    assert wrong(root) == {IMAGE: "changed"}


def test_a_chunk_that_is_a_link_is_reported_and_not_followed(root, tmp_path):
    chunk = root / IMAGE / "image/c/0/0"
    shutil.copy(chunk, tmp_path / "elsewhere")
    chunk.unlink()
    chunk.symlink_to(tmp_path / "elsewhere")
    assert wrong(root) == {IMAGE: "changed"}


@pytest.mark.parametrize("name", ["../../../etc/passwd", "/etc/passwd", "a\x1b[31m", "x.zarr/../../../../etc/passwd"])
def test_a_manifest_that_leads_out_of_the_campaign_is_refused(root, capsys, name):
    edited(root / EXPORT, lambda document: document["files"].update({name: "0" * 64}))
    assert print_verified(root / EXPORT, quiet=True) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(("changed  ", "missing  "))
    assert line.isprintable()
    assert "root:" not in line


def test_sources_that_lead_in_a_circle_end(root):
    edited(root / EXPORT, lambda document: document["sources"].update({EXPORT: "0" * 64}))
    assert wrong(root)[EXPORT] == "changed"


def test_a_manifest_of_an_older_version_is_told(root):
    edited(root / EXPORT, lambda document: [document.pop(key) for key in ("sources", "settings", "code")])
    (link,) = [link for link in verify(root / DB).links if link.name == EXPORT]
    assert link.state == "changed"
    assert "versions before 0.1.0" in link.why[0]


def test_other_versions_are_noted_and_change_nothing(root, capsys):
    software = tag(root / DB, "SOFTWARE") | {"numpy": "1.0"}
    retag(root / DB, SOFTWARE=canonical_json(software), VERSION="0.0.9", LOCK_SHA256="0" * 64)
    edited(root / EXPORT, lambda document: document["files"].update({"db.tif": sha256_file(root / DB)}))
    assert print_verified(root / DB, quiet=True) == 0
    version, numpy, lock = capsys.readouterr().out.splitlines()
    assert version.startswith(f"made by apertura 0.0.9, such as {DB}; ")
    assert "numpy 1.0, here " in numpy
    assert lock == "made under another requirements/all.txt"


def test_a_config_that_is_wrong_hides_no_other_link(root):
    (root / "config/config.yaml").write_text("scene: [")
    flip(root / RAW)
    assert wrong(root) == {"campaign": "changed", RAW: "changed"}


def test_a_copy_elsewhere_tells_its_tags_and_is_known_again_in_its_campaign(root, tmp_path, capsys):
    copy = shutil.copy(root / DB, tmp_path / "copy.tif")
    assert "lies in no campaign" in complaint(lambda: print_verified(tmp_path / "copy.tif"))
    assert f"APERTURA_INPUTS {RAW} {sha256_file(root / RAW)}" in capsys.readouterr().out.splitlines()
    assert print_verified(tmp_path / "copy.tif", root) == 0
    assert f"copy.tif, a copy of a file of {EXPORT}" in capsys.readouterr().out
    retag(copy, ERROR_DB="-200")
    assert print_verified(tmp_path / "copy.tif", root, quiet=True) == 1
    assert capsys.readouterr().out.startswith("changed  copy.tif: no file of that campaign has its bytes")


def test_what_is_no_product_is_one_message(root, tmp_path):
    (tmp_path / "note.txt").write_text("")
    (tmp_path / "plain.tif").write_bytes(b"II*\0")
    assert "no such file" in complaint(lambda: print_verified(tmp_path / "nowhere.tif"))
    assert "lies in no campaign" in complaint(lambda: print_verified(tmp_path / "note.txt"))
    assert "not readable as GeoTIFF" in complaint(lambda: print_verified(tmp_path / "plain.tif"))
    assert "no manifest lists it" in complaint(lambda: print_verified(tmp_path / "note.txt", root))
    assert "is no result" in complaint(lambda: print_verified(root / "results/f01"))


def test_a_file_beside_the_products_with_a_hostile_name_is_shown_harmlessly(root, capsys):
    shutil.copy(root / DB, root / "results/f01/uav1-uav2/a\x1b]0;owned\x07.tif")
    assert print_verified(root / "results/f01/uav1-uav2/a\x1b]0;owned\x07.tif", quiet=True) == 1
    assert all(line.isprintable() for line in capsys.readouterr().out.splitlines())


def test_verifying_writes_nothing(root):
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    for path in root.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    assert verify(root).links
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
