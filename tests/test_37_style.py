"""Default QGIS styles: decibels from the noise floor to the peak, and classes with their names."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from apertura.common.errors import ContractError
from apertura.common.provenance import canonical_json
from apertura.formats.export.db import write_db
from apertura.formats.export.layers import CLASSES, OUTSIDE, write_incidence, write_looks, write_mask
from apertura.formats.export.mosaic import write_mosaic
from apertura.formats.export.radiometry import ECHO, TAG, of_sums
from apertura.formats.export.style import write_db_style, write_layer_style, write_mask_style

GRID = {"crs": "EPSG:32632", "transform": Affine(0.1, 0, 691523.4, 0, -0.1, 5333000.1)}
IMAGE = np.full((30, 40), 1j, np.complex64)


def ends_of(path):
    return [float(ET.parse(path).find(f".//{name}").text) for name in ("minValue", "maxValue")]


@pytest.mark.parametrize(("floor_db", "black"), [(-49.05, -17.05), (0.0, 31.0)])
def test_decibels_are_black_at_the_noise_floor_and_white_at_the_peak(tmp_path, floor_db, black):
    radiometry = ECHO.measured(10**1.6, floor_db)
    write_db(tmp_path / "db.tif", IMAGE, **GRID, tags={TAG: canonical_json(radiometry.report)})
    write_db_style(tmp_path / "db.qml")
    assert ends_of(tmp_path / "db.qml") == [black, 32.0]


def test_style_of_an_image_without_levels_is_refused(tmp_path):
    write_db(tmp_path / "db.tif", IMAGE, **GRID, tags={})
    with pytest.raises(ContractError, match="no peak and noise floor"):
        write_db_style(tmp_path / "db.qml")
    assert not (tmp_path / "db.qml").exists()


def test_every_class_of_the_mask_has_its_name_and_colour_in_style_and_file(tmp_path):
    write_mask(tmp_path / "mask.tif", np.zeros((30, 40), np.uint8), **GRID, tags={})
    write_mask_style(tmp_path / "mask.qml")
    entries = {int(entry.get("value")): entry for entry in ET.parse(tmp_path / "mask.qml").iter("paletteEntry")}
    assert {value: entry.get("label") for value, entry in entries.items()} == {
        0: "valid",
        1: "shadow",
        2: "layover",
        3: "shadow and layover",
        255: "outside, no data",
    }
    assert [value for value, entry in entries.items() if entry.get("alpha") == "0"] == [0, OUTSIDE]
    with rasterio.open(tmp_path / "mask.tif") as raster:
        colours = raster.colormap(1)
    for value, (_, colour) in CLASSES.items():
        assert entries[value].get("color") == "#{:02x}{:02x}{:02x}".format(*colour)
        if value != OUTSIDE:  # GDAL chooses the colour of nodata
            assert colours[value][:3] == colour


@pytest.mark.parametrize(
    ("values", "ends"), [((18.2, 77.4), (18, 78)), ((30, 30), (30, 31)), ((np.nan, np.nan), (0, 1))]
)
def test_layer_is_coloured_from_its_smallest_to_its_largest_value(tmp_path, values, ends):
    angle = np.full((30, 40), np.nan, np.float32)
    angle[0, :2] = values
    write_incidence(tmp_path / "incidence.tif", angle, **GRID, tags={})
    write_layer_style(tmp_path / "incidence.qml")
    items = list(ET.parse(tmp_path / "incidence.qml").iter("item"))
    assert (float(items[0].get("value")), float(items[-1].get("value"))) == ends
    assert items[-1].get("label") == f"{ends[1]} deg"


@pytest.mark.slow
def test_nodata_is_ignored_in_the_colours_of_a_file_and_of_a_mosaic(tmp_path):
    looks = np.zeros((2050, 2100), np.float32)
    looks[3:1000, 5:900], looks[1003:2000, 1001:2003] = 4, 25
    for name, part in (("above", np.s_[:1001]), ("below", np.s_[1001:])):
        layer = np.zeros_like(looks)
        layer[part] = looks[part]
        write_looks(tmp_path / f"{name}.tif", layer, **GRID, tags={})
    write_looks(tmp_path / "looks.tif", looks, **GRID, tags={})
    write_mosaic(tmp_path / "both.vrt", [tmp_path / "above.tif", tmp_path / "below.tif"])
    for name in ("looks.qml", "both.qml"):
        write_layer_style(tmp_path / name)
        items = list(ET.parse(tmp_path / name).iter("item"))
        assert (float(items[0].get("value")), float(items[-1].get("value"))) == (4, 25)


def test_radiometry_of_sums_lists_divisors_and_pairs():
    radiometry = of_sums({"a-a": 4.0, "a-b": 2.0, "a-c": 1.0}, {"a-a": 0.0, "a-b": 0.7})
    assert radiometry["coherent"].amplitude == "coherent mean of 2 peak-normalised images"
    assert radiometry["coherent"].divided_by == {"a-a": 4.0, "a-b": 2.0}
    assert radiometry["coherent"].phases_removed_rad == {"a-a": 0.0, "a-b": 0.7}
    assert radiometry["noncoherent"].power == "mean power of 3 peak-normalised images"
    assert radiometry["noncoherent"].divided_by == {"a-a": 4.0, "a-b": 2.0, "a-c": 1.0}
    assert not radiometry["noncoherent"].phases_removed_rad
