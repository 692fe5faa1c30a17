"""`apertura diff`: exactly the differences between two products are reported, per section."""

import json

import numpy as np
import pytest
from folders import complaint, copy_writable, edit_config
from rasterio import Affine

from apertura.campaign.folder import Campaign
from apertura.formats.export.cog import write_power, write_slc
from apertura.stages import export, profile
from apertura.views.verify.diff import Tally, differences, first_difference, print_differences
from apertura.views.verify.products import flat

GEOREFERENCE = {"transform": Affine(0.5, 0, 500000, 0, -0.5, 5400000), "crs": "EPSG:32632"}
PAIR = "results/f01/uav1-uav2"


@pytest.fixture
def root(finished_tiny, tmp_path):
    return copy_writable(finished_tiny.root, tmp_path / "finished")


@pytest.fixture
def scene():
    noise = np.random.default_rng(0).standard_normal((2, 40, 30)).astype("f4")
    return (noise[0] + 1j * noise[1]).astype("c8")


def differing(first, second):
    """Return the lines of the sections that differ."""
    return {section: lines for section, lines in differences(first, second).items() if lines}


@pytest.mark.quick("slc.tif", "image.json", "mask.tif", "image.zarr")
@pytest.mark.parametrize("name", ["slc.tif", "quicklook.png", "image.json", "mask.tif", "image.zarr"])
def test_product_and_its_copy_are_the_same(finished_tiny, root, name, capsys):
    assert print_differences(finished_tiny.root / PAIR / name, root / PAIR / name) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 1
    assert all(line.endswith("same") for line in lines)


def test_statistics_over_blocks_equal_those_of_whole_arrays():
    generator = np.random.default_rng(1)
    a, b = generator.standard_normal((2, 1000)) * 1e-3 + 1e4
    tally = Tally.of((a[at : at + 100], b[at : at + 100]) for at in range(0, 1000, 100))
    np.testing.assert_allclose([tally.largest, tally.rms], [np.abs(a - b).max(), np.sqrt(np.mean((a - b) ** 2))])
    np.testing.assert_allclose(tally.alike, np.corrcoef(a, b)[0, 1], atol=1e-6)
    z, w = a + 1j * b - 1e4, b - 1j * a
    tally = Tally.of((z[at : at + 300], w[at : at + 300]) for at in range(0, 1000, 300))
    np.testing.assert_allclose(tally.alike, abs(np.vdot(z, w)) / np.sqrt(np.vdot(z, z) * np.vdot(w, w)).real)


def test_difference_is_printed_in_db_re_peak(tmp_path, scene):
    scene[3, 4] = 100
    write_slc(tmp_path / "a.tif", scene, tags={}, **GEOREFERENCE)
    write_power(tmp_path / "a_power.tif", scene, tags={}, **GEOREFERENCE)
    scene[9, 9] += 0.1  # 60 dB below the peak
    write_slc(tmp_path / "b.tif", scene, tags={}, **GEOREFERENCE)
    (line,) = differing(tmp_path / "a.tif", tmp_path / "b.tif")["pixels"]
    assert line.startswith("1 of 1200 values differ: maximum -60.0 dB re peak, rms -90.8 dB re peak; coherence 1.0000")
    scene[9, 9], scene[3, 4] = scene[9, 9] - 0.1, np.sqrt(1e4 - 1)
    write_power(tmp_path / "b_power.tif", scene, tags={}, **GEOREFERENCE)
    lines = differing(tmp_path / "a_power.tif", tmp_path / "b_power.tif")["pixels"]
    assert any("maximum -40.0 dB re peak" in line for line in lines)


def test_pixels_finite_in_one_product_only_are_counted(tmp_path, scene):
    write_slc(tmp_path / "a.tif", scene, tags={}, **GEOREFERENCE)
    scene[:2, :5] = np.nan
    write_slc(tmp_path / "b.tif", scene, tags={}, **GEOREFERENCE)
    assert differing(tmp_path / "a.tif", tmp_path / "b.tif")["pixels"] == [
        "10 values are finite only in the first product, 0 only in the second"
    ]


def test_overlap_of_two_grids_is_compared(tmp_path, scene):
    write_slc(tmp_path / "a.tif", scene, tags={}, **GEOREFERENCE)
    part = Affine(0.5, 0, 500002.5, 0, -0.5, 5399998)
    write_slc(tmp_path / "b.tif", scene[4:, 5:25], tags={}, transform=part, crs="EPSG:32632")
    sections = differing(tmp_path / "a.tif", tmp_path / "b.tif")
    assert sections["pixels"] == ["compared in the overlap of the grids, 20 × 36 pixels"]
    assert [line.split(":")[0] for line in sections["geometry"]] == ["size", "transform"]
    assert differing(tmp_path / "b.tif", tmp_path / "a.tif")["pixels"] == sections["pixels"]


@pytest.mark.parametrize(
    ("transform", "crs", "message"),
    [
        (
            Affine(0.5, 0, 500000.2, 0, -0.5, 5400000),
            "EPSG:32632",
            "CRS or pixel spacing differ, or the grid offset is not an integer",
        ),
        (
            Affine(0.25, 0, 500000, 0, -0.25, 5400000),
            "EPSG:32632",
            "CRS or pixel spacing differ, or the grid offset is not an integer",
        ),
        (GEOREFERENCE["transform"], "EPSG:32633", "CRS or pixel spacing differ, or the grid offset is not an integer"),
        (Affine(0.5, 0, 500100, 0, -0.5, 5400000), "EPSG:32632", "do not overlap"),
    ],
)
def test_incompatible_grids_are_not_compared(tmp_path, scene, transform, crs, message):
    write_slc(tmp_path / "a.tif", scene, tags={}, **GEOREFERENCE)
    write_slc(tmp_path / "b.tif", scene, tags={}, transform=transform, crs=crs)
    (line,) = differing(tmp_path / "a.tif", tmp_path / "b.tif")["pixels"]
    assert line.startswith("not compared")
    assert message in line


def test_different_setting_is_reported_with_its_effects(finished_tiny, root):
    edit_config(root, lambda document: document.setdefault("processing", {}).update({"window": "none"}))
    campaign = Campaign.load(root)
    profile.profile(campaign, "f01", "uav1-uav2")
    stage = f"{PAIR}/profile.zarr"
    sections = differing(finished_tiny.root / stage, root / stage)
    assert sections["settings"] == ["window: hann → none"]
    (line,) = (line for line in sections["values"] if line.startswith("profile: "))
    hann = np.hanning(1000)
    np.testing.assert_allclose(float(line.split()[-1]), hann.mean() / np.sqrt(np.mean(hann**2)), atol=0.03)
    measured, setting = (line for line in sections["report"] if not line.startswith("background."))
    assert (measured.split(":")[0], setting) == ("compression_error_db", "window: hann → none")
    assert sections.keys() == {"settings", "report", "values"}


def test_different_source_is_reported(finished_tiny, root):
    path = root / "results/f01/assessment.manifest.json"
    path.write_text(path.read_text() + "\n")
    export.export(Campaign.load(root), "f01", "uav1-uav2")
    (line,) = differing(finished_tiny.root / PAIR / "db.tif", root / PAIR / "db.tif")["stages"]
    assert line.startswith("results/f01/assessment.manifest.json: ")


def test_first_differing_byte_is_reported_without_other_differences(tmp_path, scene):
    write_slc(tmp_path / "a.tif", scene, tags={}, **GEOREFERENCE)
    (tmp_path / "b.tif").write_bytes((tmp_path / "a.tif").read_bytes() + b"more")
    size = (tmp_path / "a.tif").stat().st_size
    assert differing(tmp_path / "a.tif", tmp_path / "b.tif") == {"bytes": [f"first difference at byte {size}"]}
    (tmp_path / "a.cphd").write_bytes(b"0123456789")
    (tmp_path / "b.cphd").write_bytes(b"012345X789")
    assert differing(tmp_path / "a.cphd", tmp_path / "b.cphd") == {"bytes": ["first difference at byte 6"]}
    assert first_difference(tmp_path / "a.cphd", tmp_path / "a.cphd") is None


def test_reports_are_compared_per_key(tmp_path):
    (tmp_path / "a.json").write_text('{"flags": {}, "targets": [{"x_m": 1.0}, 2], "more": null}')
    (tmp_path / "b.json").write_text('{"flags": {"sag": "\x7f"}, "targets": [{"x_m": 1.5}, 2]}')
    assert differing(tmp_path / "a.json", tmp_path / "b.json")["report"] == [
        "flags: {} → absent",
        r"flags.sag: absent → \x7f",
        "more: null → absent",
        "targets.0.x_m: 1.0 → 1.5",
    ]


def test_deeply_nested_document_is_flattened():
    deep = {"a": 1}
    for _ in range(20_000):
        deep = {"a": deep}
    assert list(flat(deep).values()) == ["1"]


def test_products_that_cannot_be_compared_are_one_message(root, tmp_path):
    db = root / PAIR / "db.tif"
    assert "no such file" in complaint(lambda: differences(db, tmp_path / "none.tif"))
    assert "not of the same kind as db.tif" in complaint(lambda: differences(db, root / PAIR / "image.json"))
    assert "is not a stage" in complaint(lambda: differences(root, root / "results"))
    (tmp_path / "b.json").write_text("[")
    assert "damaged" in complaint(lambda: differences(tmp_path / "b.json", tmp_path / "b.json"))
    (tmp_path / "b.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "not readable as PNG" in complaint(lambda: differences(tmp_path / "b.png", tmp_path / "b.png"))


def test_printed_lines_are_bounded_and_printable(tmp_path, capsys):
    for name, text in (("a", "x"), ("b", "\x1b[2J" * 5000)):
        (tmp_path / f"{name}.json").write_text(json.dumps({f"key {i}\n": text for i in range(500)}))
    assert print_differences(tmp_path / "a.json", tmp_path / "b.json") == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 21
    assert lines[-1].endswith("and 480 more (--all prints them)")
    assert all(line.isprintable() and len(line) < 420 for line in lines)


@pytest.mark.slow
def test_large_raster_is_compared_in_blocks(tmp_path, monkeypatch):
    """Only one block of each raster is in memory at a time."""
    side = 2100
    write_power(tmp_path / "a.tif", np.ones((side, side), "c8"), tags={}, **GEOREFERENCE)
    shapes = []

    class Spied(Tally):
        def add(self, first, second):
            shapes.append(first.shape)
            super().add(first, second)

    monkeypatch.setattr("apertura.views.verify.diff.Tally", Spied)
    assert differing(tmp_path / "a.tif", tmp_path / "a.tif") == {}
    assert sum(rows * columns for rows, columns in shapes) == side**2
    assert max(shapes) <= (2048, 2048)
