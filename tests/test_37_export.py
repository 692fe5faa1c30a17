"""Rasters and quicklooks: georeference, complete files and correct overviews."""

import hashlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil
import zarr
from rasterio import Affine

from apertura.common.errors import CampaignError, ContractError
from apertura.common.flag_table import FLAGS
from apertura.core.geometry.geodesy import local_crs
from apertura.formats.export import exports_in
from apertura.formats.export.cog import MAGNITUDE, POWER, SLC, write_cog, write_power, write_slc
from apertura.formats.export.db import write_db
from apertura.formats.export.interferogram import write_phase
from apertura.formats.export.layers import LAYOVER, LOOKS, MASK, OUTSIDE, SHADOW, write_line_of_sight, write_mask
from apertura.formats.export.map_layout import DPI, LEFT, TOP, MapLayout
from apertura.formats.export.quicklook import below_peak, shrink, write_quicklook
from apertura.formats.export.writing import READ

ROOT = Path(__file__).parents[1]
UTM = {"crs": "EPSG:32632", "transform": Affine(0.1, 0, 691523.4, 0, -0.1, 5333000.1)}
TAGS = {
    "APERTURA_RUNSPEC": '{"processing":{"window":"hann"}}',
    "APERTURA_INPUTS": '{"raw":"' + 64 * "0" + '"}',
    "APERTURA_CODE_SHA256": 64 * "a",
    "APERTURA_VERSION": "0.1.0",
    "APERTURA_ERROR_DB": "-61.2",
}
IMAGES = {export.file: export.write for export in exports_in("pair") if not export.file.endswith(".qml")}
LAYERS = {export.file: export.write for export in exports_in("layers") if export.file.endswith(".tif")}
RASTERS = {name: write for name, write in IMAGES.items() if name.endswith(".tif")}


def speckle(*shape: int) -> np.ndarray:
    rng = np.random.default_rng(37)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)


def overviews(path: Path) -> list[np.ndarray]:
    with rasterio.open(path) as raster:
        count = len(raster.overviews(1))
    levels = []
    for level in range(count):
        with rasterio.open(path, OVERVIEW_LEVEL=level) as raster:
            levels.append(raster.read(1))
    return levels


@pytest.mark.parametrize("name", RASTERS)
def test_raster_has_the_grid_georeference_and_its_provenance_tags(tmp_path, name):
    RASTERS[name](tmp_path / name, speckle(30, 50), **UTM, tags=TAGS, title="f01 · uav1–uav2")
    with rasterio.open(tmp_path / name) as raster:
        assert np.allclose(raster.bounds, (691523.4, 5332997.1, 691528.4, 5333000.1), rtol=0, atol=1e-6)
        assert raster.transform == UTM["transform"]
        assert raster.crs.to_epsg() == 32632
        assert np.isnan(raster.nodata)
        tags = raster.tags()
    assert {tag: tags[tag] for tag in TAGS} == TAGS
    assert tags["TIFFTAG_IMAGEDESCRIPTION"] == "f01 · uav1–uav2"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_rasters_contain_the_image_its_power_and_its_decibels(tmp_path):
    image = speckle(600, 40)
    rasters = {}
    for name, write in RASTERS.items():
        write(tmp_path / name, image, **UTM, tags={})
        with rasterio.open(tmp_path / name) as raster:
            rasters[name] = raster.read(1)
    assert rasters["slc.tif"].dtype == np.complex64
    assert np.array_equal(rasters["slc.tif"], image)
    assert np.allclose(rasters["power.tif"], np.abs(image.astype(complex)) ** 2, rtol=1e-6)
    assert np.allclose(rasters["db.tif"], 20 * np.log10(np.abs(image.astype(complex))), rtol=0, atol=1e-5)


def test_local_crs_reads_back_unchanged(tmp_path):
    crs = local_crs("gotcha pass 1")
    write_slc(tmp_path / "slc.tif", speckle(5, 5), crs=crs, transform=Affine(0.2, 0, -50, 0, -0.2, 50), tags={})
    with rasterio.open(tmp_path / "slc.tif") as raster:
        assert raster.crs == rasterio.crs.CRS.from_wkt(crs)
        written = raster.crs.to_wkt()
    assert written.startswith('LOCAL_CS["gotcha pass 1",UNIT["metre",1')
    assert written.endswith('AXIS["Easting",EAST],AXIS["Northing",NORTH]]')


@pytest.mark.quick("slc.tif-*", "power.tif-shape0", "db.tif-shape1")
@pytest.mark.parametrize("shape", [(3, 5), (512, 512), (513, 40), (700, 1300)])
@pytest.mark.parametrize("name", RASTERS)
def test_every_raster_is_a_strictly_valid_cog(tmp_path, name, shape):
    cogeo = pytest.importorskip("rio_cogeo.cogeo", reason="rio-cogeo is a tool of the developers")
    RASTERS[name](tmp_path / name, speckle(*shape), **UTM, tags=TAGS)
    valid, errors, warnings = cogeo.cog_validate(tmp_path / name, strict=True)
    assert (valid, errors, warnings) == (True, [], [])
    with rasterio.open(tmp_path / name) as raster:
        assert raster.block_shapes == [(512, 512)]
        assert raster.overviews(1) == [factor for factor in (2, 4) if max(shape) > 256 * factor]


@pytest.mark.quick("MODE-255")
@pytest.mark.parametrize(
    "band",
    [POWER, SLC, MASK, LOOKS, write_phase.keywords["band"]],
    ids=lambda band: f"{band.overviews}-{band.nodata}",
)
def test_overviews_equal_those_of_gdal(tmp_path, band):
    """This also holds across block boundaries and next to undefined pixels."""
    rng, shape = np.random.default_rng(5), (READ + 256, 1040)
    image = {"complex64": speckle(*shape), "uint8": rng.integers(0, 4, shape, np.uint8)}.get(band.dtype)
    image = np.abs(speckle(*shape)) if image is None else image
    image[rng.random(shape) < 0.4] = band.nodata
    image[:70, 30:200] = band.nodata
    write_cog(tmp_path / "own.tif", image, band, **UTM, tags={})
    profile = {"driver": "GTiff", "count": 1, "dtype": band.dtype, "nodata": band.nodata, "tiled": True}
    with rasterio.open(tmp_path / "plain.tif", "w", height=shape[0], width=shape[1], **UTM, **profile) as raster:
        raster.write(image, 1)
    as_cog = {"driver": "COG", "blocksize": 512, "overview_resampling": band.overviews}
    rasterio.shutil.copy(tmp_path / "plain.tif", tmp_path / "gdal.tif", **as_cog)
    with rasterio.open(tmp_path / "own.tif") as raster:
        assert np.array_equal(raster.read(1), image, equal_nan=band.dtype != "uint8")
    own, gdal = overviews(tmp_path / "own.tif"), overviews(tmp_path / "gdal.tif")
    assert [level.shape for level in own] == [level.shape for level in gdal] == [(1152, 520), (576, 260), (288, 130)]
    for own_level, gdal_level in zip(own, gdal, strict=True):
        # GDAL propagates a complex NaN to the whole overview pixel.
        defined = ~np.isnan(gdal_level) if band is SLC else np.ones(gdal_level.shape, bool)
        assert defined.mean() > 0.1 or gdal_level.shape != own[0].shape
        tolerance = 1e-3 if band is SLC else 1e-6  # cancelling samples leave few digits of the phase
        assert np.allclose(
            np.abs(own_level[defined]), np.abs(gdal_level[defined]), rtol=1e-6, equal_nan=band.dtype != "uint8"
        )
        assert np.allclose(
            own_level[defined], gdal_level[defined], rtol=0, atol=tolerance, equal_nan=band.dtype != "uint8"
        )


def test_overview_of_an_odd_edge_averages_existing_pixels(tmp_path):
    image = np.full((601, 1027), 3, np.float32)
    image[:, -1] = 7
    write_cog(tmp_path / "x.tif", image, MAGNITUDE, **UTM, tags={})
    half, quarter = overviews(tmp_path / "x.tif")
    assert (half.shape, quarter.shape) == ((301, 514), (151, 257))
    assert (half[:, -1] == 7).all()
    assert (half[:, :-1] == 3).all()
    assert (quarter[:, -1] == 5).all()


def test_slc_overviews_keep_a_target_that_plain_averaging_cancels(tmp_path):
    y, x = np.mgrid[:700, :1300]
    magnitude = np.exp(-((x - 640.5) ** 2 + (y - 300.5) ** 2) / (2 * 3.0**2))
    image = (magnitude * np.exp(1j * np.radians(141) * x)).astype(np.complex64)
    write_slc(tmp_path / "slc.tif", image, **UTM, tags={})
    half = overviews(tmp_path / "slc.tif")[0]
    averaged_peak = np.abs(image.reshape(350, 2, 650, 2).mean(axis=(1, 3))).max()
    assert averaged_peak < 0.35 * magnitude.max()
    assert np.abs(half).max() > 0.95 * magnitude.max()
    assert np.unravel_index(np.argmax(np.abs(half)), half.shape) == (150, 320)


def test_db_overviews_contain_the_mean_power_of_speckle(tmp_path):
    image = speckle(700, 1300)
    write_db(tmp_path / "db.tif", image, **UTM, tags={})
    coarsest = overviews(tmp_path / "db.tif")[-1]
    power = np.abs(image[:, :1300].astype(complex)) ** 2
    exact = 10 * np.log10(power.reshape(175, 4, 325, 4).mean(axis=(1, 3)))
    assert coarsest.shape == exact.shape
    assert np.allclose(coarsest, exact, rtol=0, atol=1e-4)
    bias = np.mean(10 * np.log10(power)) - 10 * np.log10(power.mean())
    assert bias == pytest.approx(-10 * np.euler_gamma / np.log(10), abs=0.05)


def test_zero_pixels_are_nodata_in_db_but_count_in_the_mean(tmp_path):
    image = np.zeros((600, 600), np.complex64)
    image[::2, ::2] = 2
    image[:100] = np.nan
    write_db(tmp_path / "db.tif", image, **UTM, tags={})
    with rasterio.open(tmp_path / "db.tif") as raster:
        full = raster.read(1)
    assert np.array_equal(np.isnan(full), ~(np.abs(image) > 0))
    half = overviews(tmp_path / "db.tif")[0]
    assert np.isnan(half[:50]).all()
    assert np.allclose(half[50:], 0.0, atol=1e-6)


EXPORT_SCRIPT = """
import sys
from pathlib import Path
import numpy as np
from rasterio import Affine
from apertura.formats.export import exports_in
folder, image = Path(sys.argv[1]), np.load(sys.argv[2])
for export in exports_in("pair"):
    path, tags = folder / export.file, {"B": "2", "A": "1"}
    if path.suffix == ".qml":
        continue
    export.write(path, image, transform=Affine(0.1, 0, 691523.4, 0, -0.1, 5333000.1), crs="EPSG:32632", tags=tags)
"""


@pytest.mark.slow
def test_same_image_gives_same_bytes_in_any_process_and_from_any_array(tmp_path):
    image = speckle(600, 520)
    np.save(tmp_path / "image.npy", image)
    tiled = zarr.create_array(tmp_path / "image.zarr", shape=image.shape, chunks=(128, 200), dtype=image.dtype)
    tiled[:] = image
    (tmp_path / "other").mkdir()
    subprocess.run(
        [sys.executable, "-c", EXPORT_SCRIPT, tmp_path / "other", tmp_path / "image.npy"],
        check=True,
        env=os.environ | {"TZ": "Asia/Tokyo", "GDAL_NUM_THREADS": "2"},
    )
    for name, write in IMAGES.items():
        write(tmp_path / name, tiled, **UTM, tags={"A": "1", "B": "2"})
        own, other = (hashlib.sha256((folder / name).read_bytes()) for folder in (tmp_path, tmp_path / "other"))
        assert own.hexdigest() == other.hexdigest(), name


class BlockwiseImage:
    """Image computed on access, which records the largest block read."""

    dtype = np.dtype(np.complex64)

    def __init__(self, *shape):
        self.shape = shape
        self.largest = 0

    def __getitem__(self, key):
        rows, columns = (range(*part.indices(size)) for part, size in zip(key, self.shape, strict=True))
        self.largest = max(self.largest, len(rows) * len(columns))
        return (np.add.outer(np.array(rows) * 1j, columns) + 1).astype(np.complex64)


@pytest.mark.quick("power.tif")
@pytest.mark.parametrize("name", IMAGES)
def test_image_is_read_in_blocks(tmp_path, name):
    image = BlockwiseImage(READ + 300, READ + 500)
    IMAGES[name](tmp_path / name, image, **UTM, tags={})
    assert 0 < image.largest <= READ**2
    if name == "slc.tif":
        with rasterio.open(tmp_path / name) as raster:
            row, column = raster.height - 1, raster.width - 1
            corners = [raster.read(1)[pixel] for pixel in ((0, 0), (0, column), (row, 0), (row, column))]
        assert corners == [1, column + 1, 1 + row * 1j, column + 1 + row * 1j]


KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from rasterio import Affine
from apertura.formats.export import exports_in
class KillingImage:
    shape, reads = (2100, 2100), 0
    def __getitem__(self, key):
        self.reads += 1
        if self.reads > 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.ones((2100, 2100), np.complex64)[key]
path = Path(sys.argv[1])
export = next(export for export in exports_in("pair") if export.file == path.name)
export.write(path, KillingImage(), transform=Affine(1, 0, 0, 0, -1, 0), crs="EPSG:32632", tags={})
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slc.tif", "db.tif"])
def test_killed_writer_leaves_no_partial_file_and_the_next_one_cleans_up(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"previous run")
    killed = subprocess.run([sys.executable, "-c", KILLED, path], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"previous run"
    assert (tmp_path / f".{name}.wip").is_dir()
    IMAGES[name](path, speckle(8, 8), **UTM, tags={})
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.slow
def test_full_disk_raises_an_error_and_leaves_no_file(tmp_path):
    limited = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))
"""
    np.save(tmp_path / "image.npy", speckle(600, 600))
    arguments = [sys.executable, "-c", limited + EXPORT_SCRIPT, tmp_path, tmp_path / "image.npy"]
    assert subprocess.run(arguments, check=False, capture_output=True).returncode != 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["image.npy"]


def test_invalid_image_or_grid_is_refused_before_writing(tmp_path):
    path = tmp_path / "slc.tif"
    image, south_up = speckle(4, 4), Affine(1, 0, 0, 0, 1, 0)
    with pytest.raises(ContractError, match="not complex64"):
        write_power(path, image.real, **UTM, tags={})
    with pytest.raises(ContractError, match=r"not \(y, x\)"):
        write_slc(path, image[0], **UTM, tags={})
    with pytest.raises(ContractError, match="north-up"):
        write_slc(path, image, crs="EPSG:32632", transform=south_up, tags={})
    with pytest.raises(CampaignError, match=r"crs 'EPSG:99999'.*scene\.crs"):
        write_slc(path, image, crs="EPSG:99999", transform=UTM["transform"], tags={})
    assert not any(tmp_path.iterdir())


def test_layers_keep_angles_bits_and_nodata(tmp_path):
    angle = np.full((600, 600), 30, np.float32)
    angle[:10] = np.nan
    bits = np.full((600, 600), SHADOW, np.uint8)
    bits[300:, :300], bits[300:, 300:], bits[:10] = LAYOVER, SHADOW | LAYOVER, OUTSIDE
    for name, write in LAYERS.items():
        layer = {"mask.tif": bits, "looks.tif": np.nan_to_num(angle)}.get(name, angle)
        write(tmp_path / name, layer, **UTM, tags=TAGS)
        with rasterio.open(tmp_path / name) as raster:
            assert np.array_equal(raster.read(1), layer, equal_nan=name != "mask.tif")
            assert np.array_equal(raster.dataset_mask() == 0, np.arange(600)[:, None] + np.zeros(600) < 10)
            assert raster.units == ({"mask.tif": "class", "looks.tif": "pulses", "nesz.tif": "dB"}.get(name, "deg"),)
        assert np.array_equal(overviews(tmp_path / name)[0], layer[::2, ::2], equal_nan=name != "mask.tif")


def test_components_of_a_vector_are_bands(tmp_path):
    """The bands of the line of sight are those of OPERA's static layers: east, north, vertical, ground to sensor."""
    sight = np.stack([np.full((601, 600), value, np.float32) for value in (0.0, -0.6, 0.8)], -1)
    sight[:10] = np.nan
    path = tmp_path / "line_of_sight_enu.tif"
    write_line_of_sight(path, sight, **UTM, tags=TAGS)
    with rasterio.open(path) as raster:
        assert np.array_equal(np.moveaxis(raster.read(), 0, -1), sight, equal_nan=True)
        assert [name.split(" unit")[0] for name in raster.descriptions] == [
            f"{axis} component of line of sight" for axis in ("East", "North", "Vertical")
        ]
        assert "ground to sensor" in raster.descriptions[0]
        assert raster.read_masks(1)[10:].all()  # a component of exactly 0 is data
        halved = raster.read(out_shape=(3, 301, 300))
    assert np.array_equal(np.moveaxis(halved, 0, -1), sight[::2, ::2], equal_nan=True)
    with pytest.raises(ContractError, match=r"not \(y, x, component\)"):
        write_line_of_sight(path, sight[..., 0], **UTM, tags=TAGS)


def test_overviews_do_not_mix_shadow_and_layover(tmp_path):
    bits = np.full((600, 600), SHADOW, np.uint8)
    bits[301:] = SHADOW | LAYOVER
    write_mask(tmp_path / "mask.tif", bits, **UTM, tags={})
    assert LAYOVER not in overviews(tmp_path / "mask.tif")[0]
    with pytest.raises(ContractError, match="float64, not uint8"):
        write_mask(tmp_path / "mask.tif", bits.astype(float), **UTM, tags={})


@pytest.mark.parametrize("pixel", [(0, 0), (1, 2), (1999, 1499), (1024, 700)])
def test_shrinking_includes_every_pixel(pixel):
    image = np.zeros((2000, 1500), np.complex64)
    image[pixel] = 3j
    mean, factor = shrink(image, 960)
    assert factor == 3
    assert np.count_nonzero(mean) == 1
    pixels_in_group = (2 if pixel[0] >= 1998 else 3) * 3
    assert mean[pixel[0] // 3, pixel[1] // 3] == pytest.approx(9 / pixels_in_group)


def test_single_outlier_does_not_darken_the_quicklook():
    y, x = np.mgrid[:100, :100]
    target = np.sinc((x - 30) / 2.0) ** 2 * np.sinc((y - 40) / 2.0) ** 2
    assert below_peak(target)[1] == 0
    target[80, 80] = 1e5
    decibel, top = below_peak(target)
    assert top == -50
    assert decibel.max() == 0


def framed_dots(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Return the brightness of the pixels inside the frame, `LEFT` and `TOP` inches from the upper left corner."""
    with rasterio.open(path) as png:
        dots = png.read([1, 2, 3]).sum(axis=0)
    scale = 6.4 * DPI / max(shape)
    left, top = round(LEFT * DPI), round(TOP * DPI)
    return dots[top : top + round(shape[0] * scale), left : left + round(shape[1] * scale)]


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_quicklook_is_north_up_with_undefined_pixels_white(tmp_path):
    image = np.full((120, 160), 1e-4, np.complex64)
    image[20:24, 120:124] = 1
    image[80:, :40] = np.nan
    write_quicklook(tmp_path / "q.png", image, **UTM, tags=TAGS, title="f01", subtitle="uav1–uav2")
    dots = framed_dots(tmp_path / "q.png", image.shape)
    rows, columns = (np.add(np.indices(dots.shape), 0.5) * 160 / dots.shape[1]).astype(int)
    inside = (rows > 0) & (rows < 119) & (columns > 0) & (columns < 159)
    bright = (rows >= 21) & (rows < 23) & (columns >= 121) & (columns < 123)
    white = (rows > 81) & (columns < 38)
    dark = ((rows < 78) | (columns > 42)) & ~((rows >= 18) & (rows < 26) & (columns >= 118) & (columns < 126))
    assert dots[bright].min() > 550
    assert (dots[white & inside] == 765).all()
    assert dots[dark & inside].max() < 100


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_quicklook_of_an_image_without_power_contains_a_note(tmp_path):
    for image in (np.zeros((30, 40), np.complex64), np.full((30, 40), np.nan, np.complex64)):
        write_quicklook(tmp_path / "q.png", image, **UTM, tags={})
        dots = framed_dots(tmp_path / "q.png", image.shape)[5:-5, 5:-5]
        assert 0 < np.count_nonzero(dots < 300) < 0.02 * dots.size


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_quicklook_contains_its_provenance_tags(tmp_path):
    write_quicklook(
        tmp_path / "q.png", speckle(30, 40), **UTM, tags=TAGS, title="f01", markers=[(691525, 5332999, "T")]
    )
    with rasterio.open(tmp_path / "q.png") as png:
        assert TAGS.items() <= png.tags().items()


def texts_of(layout: MapLayout) -> list[str]:
    """Return the texts of a layout after checking that they lie inside the figure without overlap."""
    layout.figure.canvas.draw()
    boxes = [text.get_window_extent() for text in layout.figure.texts]
    assert all(box.x0 >= 0 and box.x1 <= layout.figure.bbox.x1 for box in boxes)
    assert not any(box.overlaps(previous) for number, box in enumerate(boxes) for previous in boxes[:number])
    return [text.get_text() for text in layout.figure.texts]


@pytest.mark.parametrize("size_m", [(40, 400), (400, 40)])
@pytest.mark.parametrize("count", [0, 1, 4, 9, 29])
def test_flags_are_counted_and_listed_as_space_permits(size_m, count):
    flags = list(FLAGS)[:count]
    assert len(flags) == count
    layout = MapLayout.for_bounds((0, 0, *size_m))
    layout.draw_frame("WGS 84 / UTM zone 32N")
    layout.draw_scale_and_north()
    layout.write_words("f01", "uav1-uav2", "apertura 0.1.0 · numerical error −61.2 dB · code aaaaaaaaaaaa")
    layout.write_flags(flags)
    text = " ".join(texts_of(layout)).replace("and ", "")
    assert ("no flags" if not count else f"{count} flag") in text
    unlisted = int(re.search(r"(\d+) more in image\.json", text)[1]) if "more in" in text else 0
    assert sum(f"{flag}," in f"{text}," for flag in flags) == count - unlisted
    assert unlisted == 0 or count > 4


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_quicklook_lists_the_flags_of_its_image(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(MapLayout, "write_flags", lambda _, flags: written.append(flags))
    for flags in ("{}", '{"sidelink_noisy":"SNR 3 dB","outside_beam":"12 %"}'):
        write_quicklook(tmp_path / "q.png", speckle(30, 40), **UTM, tags=TAGS | {"APERTURA_FLAGS": flags})
    write_quicklook(tmp_path / "q.png", speckle(30, 40), **UTM, tags=TAGS)  # an image without campaign
    assert written == [[], ["sidelink_noisy", "outside_beam"]]


def test_long_footer_ends_inside_the_figure():
    footer = (
        "apertura 0.1.0 · focus: focused (peak loss 0.0 dB) · geolocation uncertainty 1.5 m"
        " · numerical error below −77.31 dB · looks left, assumed · code 833b8269428b"
    )
    for bounds in ((0.0, 0.0, 7.0, 7.0), (0.0, 0.0, 2.0, 7.0)):
        layout = MapLayout.for_bounds(bounds)
        layout.write_words("flight", "", footer)
        layout.figure.canvas.draw()
        (drawn_footer,) = (text for text in layout.figure.texts if text.get_text() == footer)
        assert drawn_footer.get_window_extent().x1 <= layout.figure.bbox.x1
