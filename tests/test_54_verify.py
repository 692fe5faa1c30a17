"""`apertura verify`: exactly the changes between a product and the raw samples are reported."""

import shutil
import subprocess
import sys

import pytest
from folders import copy_writable, edit_config
from PIL import Image, PngImagePlugin
from spoilt import DB, EXPORT, IMAGE, RAW, edited, flip, retag, tag, wrong

from apertura.common.code_imports import PACKAGE
from apertura.common.provenance import canonical_json, sha256_file
from apertura.views.verify.chain import verify


@pytest.fixture
def root(finished_tiny, tmp_path):
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


def test_links_of_an_unchanged_product_are_the_same(root):
    chain = verify(root / DB)
    names = {link.name for link in chain.links}
    assert {DB, EXPORT, IMAGE, RAW, "raw/codes.npy", f"tags of {DB}", f"code of {EXPORT}"} <= names
    assert f"settings of {EXPORT}" in names
    assert {link.state for link in chain.links} == {"same"}
    assert chain.notes == []


@pytest.mark.quick(
    "raw/f01/uav2.sigmf-data",
    "results/f01/uav1-uav2/profile.manifest.json",
    "results/scene.json",
    "results/f01/uav1-uav2/db.tif",
)
@pytest.mark.parametrize(
    "changed",
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
def test_changed_byte_is_reported_at_its_link(root, changed):
    flip(root / changed)
    states = wrong(root)
    assert states[changed] == "changed"
    affected = {changed, changed.replace(".manifest.json", ".zarr"), f"code of {changed}", f"settings of {changed}"}
    assert states.keys() <= affected | {f"tags of {changed}"}


@pytest.mark.quick("image/c/0/0")
@pytest.mark.parametrize("file", ["image/c/0/0", "image/zarr.json", "x/c/0"])
def test_changed_byte_of_a_stage_is_reported_at_the_stage(root, file):
    flip(root / IMAGE / file)
    assert wrong(root) == {IMAGE: "changed"}
    assert file in "".join(next(link for link in verify(root / DB).links if link.name == IMAGE).reason)


@pytest.mark.slow
def test_any_changed_byte_of_the_last_manifest_is_reported(root):
    """No other file contains the hash of this manifest; its content is compared with the files that it lists."""
    whole = (root / EXPORT).read_bytes()
    for at in range(0, len(whole), 97):
        flip(root / EXPORT, at)
        assert wrong(root, EXPORT), whole[at - 20 : at + 20]
        (root / EXPORT).write_bytes(whole)
    assert wrong(root, EXPORT) == {}


@pytest.mark.quick("INPUTS-*", "RUNSPEC-*")
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("SOURCES", lambda tags: tags | {"results/scene.manifest.json": "0" * 64}),
        ("SOURCES", lambda _: {}),
        ("INPUTS", lambda tags: tags | {RAW: "0" * 64}),
        ("RUNSPEC", lambda tags: tags | {"window": "none"}),
    ],
)
def test_edited_tag_with_updated_file_hash_is_reported(root, name, change):
    retag(root / DB, **{name: canonical_json(change(tag(root / DB, name)))})
    edited(root / EXPORT, lambda document: document["files"].update({"db.tif": sha256_file(root / DB)}))
    assert wrong(root) == {f"tags of {DB}": "changed"}


def test_edited_tags_of_a_png_are_reported(root):
    path = root / DB.replace("db.tif", "quicklook.png")
    with Image.open(path) as picture:
        texts = PngImagePlugin.PngInfo()
        for name, text in picture.text.items():
            texts.add_text(name, text if name != "APERTURA_SOURCES" else "{}")
        picture.save(path, pnginfo=texts)
    states = wrong(root, path.relative_to(root))
    assert states == {f"{where}results/f01/uav1-uav2/quicklook.png": "changed" for where in ("", "tags of ")}


def test_changed_settings_are_reported_at_affected_results(root):
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


@pytest.mark.slow
def test_changed_code_is_reported_at_affected_results(root, tmp_path):
    copied = shutil.copytree(PACKAGE, tmp_path / "src" / "apertura", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Snakefile", "requirements"):
        (tmp_path / name).symlink_to(PACKAGE.parents[1] / name)

    def verified():
        command = [sys.executable, "-P", "-c", VERIFY, str(copied.parent), "verify", "-q", str(root / DB)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stderr == ""
        return done.returncode, [line.split(":")[0] for line in done.stdout.splitlines()]

    assert verified() == (0, [])
    source = copied / "formats" / "export" / "cog.py"
    source.write_text(source.read_text() + "EDITED = 1\n")
    layers = EXPORT.replace("export.manifest", "layers.manifest")
    assert verified() == (1, [f"changed  code of {result}" for result in (EXPORT, layers)])


@pytest.mark.quick("raw*")
@pytest.mark.parametrize("missing", [RAW, DB, EXPORT, "results/f01/uav1/raw.manifest.json", "results/scene.json"])
def test_deleted_file_is_reported_as_missing(root, missing):
    (root / missing).unlink()
    assert wrong(root)[missing] == "missing" if missing != EXPORT else wrong(root)[DB] == "changed"
    assert wrong(root, "")[missing] == "missing"


@pytest.mark.slow
def test_incomplete_results_are_reported_per_link(root):
    before = wrong(root, "")  # results of steps that were not run
    assert set(before.values()) <= {"missing"}
    shutil.rmtree(root / IMAGE)
    shutil.rmtree(root / "results/f01/fused")
    removed = {IMAGE: "missing", "results/f01/fused/export.manifest.json": "missing"}
    assert wrong(root, "") == before | removed


def test_additional_file_in_a_stage_is_reported(root):
    (root / IMAGE / "image/c/9").mkdir()
    (root / IMAGE / "image/c/9/9").write_bytes(b"more")
    assert wrong(root) == {IMAGE: "changed"}


@pytest.mark.slow
def test_verifying_writes_nothing(root):
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    for path in root.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    assert verify(root).links
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
