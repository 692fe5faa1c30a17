"""`apertura publish`: what is uploaded, in which order, what survives an interruption, and how readers see it."""

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import fsspec
import pytest
from folders import apertura, complaint, copy_writable, finished

from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of
from apertura.tools import publish as publishing
from apertura.tools.publish import RECORD, publish

URL = "memory://bucket/area"


@pytest.fixture
def memory():
    """The object store in the memory of this process, empty."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    yield files
    files.store.clear()


@pytest.fixture
def writable(finished_tiny, tmp_path):
    return Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))


def objects(files, folder="/bucket/area"):
    return {name.removeprefix(f"{folder}/") for name in files.find(folder)}


def test_products_are_published_without_recordings_and_intermediate_results(finished_tiny, memory):
    changes = publish(finished_tiny, URL)
    names = objects(memory)
    assert names == {*changes.uploads, RECORD}
    for name in ("f01/uav1-uav1/slc.tif", "cube.zarr/zarr.json", "stac/catalog.json", "ro-crate-metadata.json"):
        assert f"results/{name}" in names
    assert not [name for name in names if name.startswith("raw") or "echo.zarr" in name or "raw.zarr" in name]
    assert memory.cat("/bucket/area/results/f01/uav1-uav1/slc.tif") == (
        finished_tiny.result("f01", "uav1-uav1", "slc.tif").read_bytes()
    )


@pytest.mark.slow
def test_recordings_are_published_on_request(finished_tiny, memory):
    publish(finished_tiny, URL, raw=True, every=True)
    names = objects(memory)
    assert {"raw/f01/uav1.sigmf-data", "results/f01/uav1-uav1/echo.zarr/zarr.json"} <= names
    crate = json.loads(memory.cat("/bucket/area/results/ro-crate-metadata.json"))
    files = {entity["@id"] for entity in crate["@graph"] if entity.get("@type") == "File" and "sha256" in entity}
    assert {name for name in files if "/" in name and not name.startswith(("..", "#"))} <= {
        name.removeprefix("results/") for name in names
    }


def test_only_changed_files_are_uploaded(writable, memory, monkeypatch):
    first = publish(writable, URL)
    again = publish(writable, URL)
    assert (again.uploads, again.deletions, again.unchanged) == ([], [], len(first.uploads))
    changed = writable.result("f01", "uav1-uav1", "db.tif")
    changed.write_bytes(changed.read_bytes() + b"\0")
    manifest = changed.with_name("export.manifest.json")
    document = json.loads(manifest.read_text())
    document["files"]["db.tif"] = publishing.sha256_file(changed)
    manifest.write_text(json.dumps(document))
    monkeypatch.setattr(publishing, "stale_results", lambda _: {})
    dry = publish(writable, URL, dry_run=True)
    assert publish(writable, URL) == dry
    assert dry.uploads == ["results/f01/uav1-uav1/db.tif", "results/f01/uav1-uav1/export.manifest.json"]


def test_dry_run_writes_nothing(finished_tiny, memory):
    changes = publish(finished_tiny, URL, dry_run=True)
    assert changes.uploads
    assert objects(memory) == set()
    assert next(changes.lines).startswith(f"{len(changes.uploads)} files to upload")


@pytest.mark.slow
def test_files_that_no_longer_exist_are_deleted_after_the_catalog_was_replaced(finished_tiny, memory, monkeypatch):
    publish(finished_tiny, URL)
    record = json.loads(memory.cat(f"/bucket/area/{RECORD}"))
    record["files"] |= {"results/f02/uav1-uav1/db.tif": "0", "results/stac/catalog.json": "0"}
    memory.pipe(f"/bucket/area/{RECORD}", json.dumps(record).encode())
    memory.pipe("/bucket/area/results/f02/uav1-uav1/db.tif", b"x")
    memory.pipe("/bucket/area/not_ours.txt", b"x")
    calls = []
    for name in ("write", "delete"):
        real = getattr(publishing._Target, name)
        monkeypatch.setattr(
            publishing._Target,
            name,
            lambda self, of, *rest, real=real, name=name: (calls.append((name, of)), real(self, of, *rest)),
        )
    changes = publish(finished_tiny, URL)
    assert changes.deletions == ["results/f02/uav1-uav1/db.tif"]
    assert calls[1:3] == [("write", "results/stac/catalog.json"), ("delete", "results/f02/uav1-uav1/db.tif")]
    assert "not_ours.txt" in objects(memory)
    assert "results/f02/uav1-uav1/db.tif" not in objects(memory)


def targets(document, name):
    """Return the objects to which the relative links and assets of a STAC document refer."""
    hrefs = [link["href"] for link in document["links"]] + [one["href"] for one in document.get("assets", {}).values()]
    return [os.path.normpath(f"{name.rpartition('/')[0]}/{href}") for href in hrefs if "://" not in href]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5, 0.97, 0.99])
def test_interrupted_upload_leaves_no_catalog_that_names_missing_objects(finished_tiny, memory, monkeypatch, share):
    """After any failing upload, published documents refer to published objects only, and the next run completes."""
    last = int(share * len(publish(finished_tiny, URL, dry_run=True).uploads))
    calls, real = [], {name: getattr(type(memory), name) for name in ("put_file", "pipe_file")}

    def limited(name):
        def call(self, *given, **options):
            calls.append(name)
            if last < len(calls) <= last + 20 and not any(str(one).endswith(RECORD) for one in given):
                raise ConnectionResetError("connection lost")
            return real[name](self, *given, **options)

        return call

    with monkeypatch.context() as patched:
        for name in real:
            patched.setattr(type(memory), name, limited(name))
        message = complaint(lambda: publish(finished_tiny, URL))
    assert "connection lost" in message
    assert "publish again" in message
    names = objects(memory)
    ahead = {"results/stac/collection.json", "results/stac/catalog.json"}  # root and parent of an item follow it
    for name in names:
        if name.startswith("results/stac/") and name.endswith(".json"):
            referred = {*targets(json.loads(memory.cat(f"/bucket/area/{name}")), name)}
            assert referred - (ahead if name not in ahead else set()) <= names
    changes = publish(finished_tiny, URL)
    recorded = json.loads(memory.cat(f"/bucket/area/{RECORD}"))["files"]
    assert objects(memory) == {*recorded, RECORD}
    assert changes.unchanged + len(changes.uploads) == len(recorded)
    if share > 0.5:
        assert changes.unchanged > len(changes.uploads)


def test_catalog_refers_to_published_objects_and_states_its_own_address(finished_tiny, memory):
    publish(finished_tiny, URL, href="https://example.org/area/")
    names = objects(memory)
    sheets = [name for name in names if name.startswith("results/stac/")]
    for name in sheets:
        document = json.loads(memory.cat(f"/bucket/area/{name}"))
        assert {*targets(document, name)} <= names
        selves = [link["href"] for link in document["links"] if link["rel"] == "self"]
        root = "https://example.org/area/results/stac/catalog.json"
        assert selves == ([root] if name.endswith("catalog.json") else [])
    assert len(sheets) > 4


def test_result_that_is_out_of_date_is_not_published(writable, memory):
    writable.result("f01", "uav1-uav1", "db.tif").write_bytes(b"x")
    assert "out of date" in complaint(lambda: publish(writable, URL))
    assert objects(memory) == set()


@pytest.mark.slow
def test_damaged_chunk_is_not_published(writable, memory):
    """A chunk is compared with the manifest when it is uploaded."""
    chunk = next(path for path in (writable.stage("cube") / "image/c").rglob("*") if path.is_file())
    chunk.write_bytes(b"x")
    assert "has changed since it was written" in complaint(lambda: publish(writable, URL))
    assert "results/stac/catalog.json" not in objects(memory)


def test_link_is_not_followed(writable, memory, tmp_path, monkeypatch):
    chunk = next(path for path in (writable.stage("cube") / "image/c").rglob("*") if path.is_file())
    secret = tmp_path / "secret"
    secret.write_bytes(chunk.read_bytes())
    chunk.unlink()
    Path(str(chunk)).symlink_to(secret)
    assert "out of date" in complaint(lambda: publish(writable, URL))
    monkeypatch.setattr(publishing, "stale_results", lambda _: {})
    assert "symbolic link" in complaint(lambda: publish(writable, URL))
    assert not any(memory.cat(name) == secret.read_bytes() for name in memory.find("/bucket"))


@pytest.mark.parametrize(
    "url",
    [
        "bucket/prefix",
        "s3://key:secret@bucket/prefix",
        "simplecache::s3://bucket/prefix",
        "s3://bucket/prefix?x=1",
    ],
)
def test_url_with_credentials_or_chains_is_rejected(finished_tiny, url):
    message = complaint(lambda: publish(finished_tiny, url))
    assert "scheme://bucket/prefix" in message
    assert "secret" not in message


def test_target_inside_the_campaign_is_rejected(finished_tiny):
    root = finished_tiny.root.real()
    assert "outside the campaign" in complaint(lambda: publish(finished_tiny, f"file://{root}/results/copy"))


def test_unknown_scheme_names_the_extra(finished_tiny, monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.setattr("fsspec.core.get_filesystem_class", lambda _: __import__("s3fs"))
    assert "apertura[publish]" in complaint(lambda: publish(finished_tiny, "s3://bucket/prefix"))


def test_record_cannot_name_objects_outside_the_prefix(finished_tiny, memory):
    memory.pipe("/bucket/other", b"x")
    memory.pipe(f"/bucket/area/{RECORD}", json.dumps({"files": {"../other": "0"}}).encode())
    assert "outside the prefix" in complaint(lambda: publish(finished_tiny, URL))
    assert memory.exists("/bucket/other")


@pytest.mark.slow
def test_folder_is_a_target(finished_tiny, tmp_path):
    publish(finished_tiny, f"file://{tmp_path}/published")
    copy = tmp_path / "published/results"
    assert (copy / "cube.manifest.json").read_bytes() == manifest_of(finished_tiny.stage("cube")).read_bytes()


# ---- S3 --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def s3():
    """Environment of a server of the S3 protocol in another process, with bucket `radar`."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    endpoint = f"http://127.0.0.1:{port}"
    keys = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], **quiet)
    try:
        for _ in range(600):
            try:
                urllib.request.urlopen(f"{endpoint}/moto-api/", timeout=1)
                break
            except OSError:
                time.sleep(0.1)
        urllib.request.urlopen(urllib.request.Request(f"{endpoint}/radar", method="PUT"))
        yield {**os.environ, **keys, "AWS_ENDPOINT_URL": endpoint}
    finally:
        server.kill()
        server.wait()


_READ = """
import os, sys
import numpy as np, rasterio, xarray as xr
published = xr.open_zarr("s3://radar/area/results/cube.zarr")
here = xr.open_zarr(f"{sys.argv[1]}/results/cube.zarr")
xr.testing.assert_identical(published.load(), here.load())
host = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://")
with rasterio.Env(AWS_S3_ENDPOINT=host, AWS_HTTPS="NO", AWS_VIRTUAL_HOSTING="FALSE"):
    for name in ("f01/uav1-uav1/slc.tif", "mosaic/uav1-uav1/db.vrt"):
        own = rasterio.open(f"{sys.argv[1]}/results/{name}")
        with rasterio.open(f"/vsis3/radar/area/results/{name}") as remote:
            np.testing.assert_array_equal(remote.read(), own.read())
print("equal")
"""


@pytest.mark.slow
def test_published_campaign_is_read_from_another_process(finished_tiny, s3):
    """By xarray, and by GDAL through /vsis3/."""
    status, output = finished(apertura("publish", finished_tiny.root, "s3://radar/area", env=s3))
    assert status == 0, output
    process = subprocess.run(
        [sys.executable, "-c", _READ, str(finished_tiny.root)], env=s3, capture_output=True, text=True, check=False
    )
    assert process.stdout == "equal\n", process.stderr
    status, output = finished(apertura("publish", finished_tiny.root, "s3://radar/area", "-n", env=s3))
    assert output.startswith("0 files to upload")


@pytest.mark.slow
def test_missing_bucket_is_one_message(finished_tiny, s3):
    status, output = finished(apertura("publish", finished_tiny.root, "s3://nowhere/area", env=s3))
    assert status == 2
    assert output.startswith("error: s3://nowhere/area")
    assert "bucket does not exist" in output
    assert output.count("\n") == 1


@pytest.mark.slow
def test_missing_credentials_are_one_message(finished_tiny, s3, tmp_path):
    without = {name: value for name, value in s3.items() if not name.startswith("AWS_")}
    without |= {"AWS_ENDPOINT_URL": s3["AWS_ENDPOINT_URL"], "HOME": str(tmp_path), "AWS_EC2_METADATA_DISABLED": "true"}
    status, output = finished(apertura("publish", finished_tiny.root, "s3://radar/area", env=without))
    assert status == 2
    assert "redential" in output
    assert output.count("\n") == 1
