"""Products that describe themselves: who, when, where, how, in which units and how accurately, from a GeoTIFF alone."""

import json
import re
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from folders import copy_writable, edit_config, state
from pyproj import Transformer

from apertura.campaign.folder import Campaign
from apertura.common.attribution import Attribution
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.stages import export, layers
from apertura.stages.cube import acdd_attributes
from apertura.stages.image_tags import acquisition_tags

CREATOR = {"name": "A. Nother", "orcid": "0000-0002-1825-0097", "affiliation": "An Institute"}
STATED = {
    "title": "Harbour in May",
    "creators": [CREATOR, {"name": "B. Other"}],
    "institution": "An Institute",
    "licence": "CC-BY-4.0",
    "platform": "hexacopter",
    "instrument": "L-band radar",
    "doi": "10.5281/zenodo.1",
}
WHO = {
    "APERTURA_TITLE": "Harbour in May",
    "APERTURA_CREATORS": "A. Nother (ORCID 0000-0002-1825-0097, An Institute); B. Other",
    "APERTURA_INSTITUTION": "An Institute",
    "APERTURA_LICENCE": "CC-BY-4.0",
    "APERTURA_PLATFORM": "hexacopter",
    "APERTURA_INSTRUMENT": "L-band radar",
    "APERTURA_DOI": "10.5281/zenodo.1",
    "APERTURA_CITATION": "A. Nother; B. Other (2025): Harbour in May. An Institute. https://doi.org/10.5281/zenodo.1",
    "TIFFTAG_ARTIST": "A. Nother; B. Other",
    "TIFFTAG_COPYRIGHT": "CC-BY-4.0",
}
IMAGES = ["f01/uav1-uav2/db.tif", "f01/uav1-uav1/slc.tif", "f01/fused/coherent_db.tif"]
LAYERS = ["f01/uav1-uav2/incidence.tif", "f01/uav1-uav1/mask.tif"]


@dataclass(frozen=True)
class Lone:
    """A GeoTIFF without its campaign, as a colleague receives it."""

    tags: dict
    description: str
    unit: str
    bounds: tuple
    crs: object

    @classmethod
    def of(cls, path, folder):
        (folder / "received.tif").write_bytes(path.read_bytes())
        with rasterio.open(folder / "received.tif") as raster:
            return cls(raster.tags(), raster.descriptions[0], raster.units[0], tuple(raster.bounds), raster.crs)


@pytest.mark.parametrize("name", [*IMAGES, *LAYERS])
def test_geotiff_alone_answers_when_where_and_how(finished_tiny, tmp_path, name):
    alone = Lone.of(finished_tiny.results / name, tmp_path)
    tags, pair = alone.tags, name.split("/")[1]
    pairs = ["uav1-uav1", "uav1-uav2"] if pair == "fused" else [pair]
    mode = {"fused": "multistatic", "uav1-uav1": "monostatic", "uav1-uav2": "bistatic"}[pair]
    # When, by which radar.
    start, end = tags["APERTURA_ACQUISITION_START"], tags["APERTURA_ACQUISITION_END"]
    assert "2025-05-14T09:30:00" <= start < end
    assert tags["TIFFTAG_DATETIME"] == "2025:05:14 09:30:00"
    waveform = finished_tiny.settings.waveform
    low_hz, band_hz = waveform.carrier_hz, waveform.widest_band_hz
    assert float(tags["APERTURA_BANDWIDTH_HZ"]) == pytest.approx(band_hz, rel=1e-3)
    assert float(tags["APERTURA_CENTRE_FREQUENCY_HZ"]) == pytest.approx(low_hz + band_hz / 2, rel=1e-3)
    wavelength_m = SPEED_OF_LIGHT_M_S / float(tags["APERTURA_CENTRE_FREQUENCY_HZ"])
    assert float(tags["APERTURA_WAVELENGTH_M"]) == pytest.approx(wavelength_m, rel=1e-5)
    assert (tags["APERTURA_FLIGHTS"], tags["APERTURA_PAIRS"].split(", ")) == ("f01", pairs)
    assert tags["APERTURA_MODE"] == mode
    # Where.
    west, south, east, north = alone.bounds
    outline = [tuple(map(float, point.split())) for point in tags["APERTURA_OUTLINE_WGS84"][10:-2].split(", ")]
    to_map = Transformer.from_crs("EPSG:4326", alone.crs, always_xy=True)
    corners = [(west, north), (west, south), (east, south), (east, north), (west, north)]
    np.testing.assert_allclose(np.transpose(to_map.transform(*zip(*outline, strict=True))), corners, atol=0.02)
    # Geometry: the track lies north-west of the scene, heading 40 degrees; the scene is on its right.
    assert tags["APERTURA_LOOK_SIDE"] in {"right", "right, assumed"}
    assert 100 < float(tags["APERTURA_LOOK_DIRECTION_DEG"]) < 160
    cosine = float(tags["APERTURA_HEIGHT_ABOVE_TERRAIN_M"]) / float(tags["APERTURA_RANGE_M"])
    assert float(tags["APERTURA_INCIDENCE_DEG"]) == pytest.approx(np.degrees(np.arccos(cosine)), abs=1.5)
    # Units, software.
    assert (tags["APERTURA_QUANTITY"], tags["APERTURA_UNIT"]) == (alone.description, alone.unit)
    assert re.fullmatch(r"apertura \d+\.\d+\.\d+", tags["TIFFTAG_SOFTWARE"])
    # Attribution that is not configured is absent, not guessed.
    assert not tags.keys() & (WHO.keys() | {"APERTURA_POLARISATION"})
    assert not [name for name, value in tags.items() if value in {"", "None", "unknown", "not stated"}]


@pytest.mark.parametrize("name", IMAGES)
def test_geotiff_alone_answers_how_accurate(finished_tiny, tmp_path, name):
    tags = Lone.of(finished_tiny.results / name, tmp_path).tags
    report = json.loads((finished_tiny.results / name).with_name("image.json").read_text())
    focus = report["focus"]
    assert float(tags["APERTURA_ERROR_DB"]) == report["numerical_error_db"]
    assert tags["APERTURA_FOCUS_VERDICT"] == focus["verdict"]
    uncertainty_m = float(tags["APERTURA_GEOLOCATION_UNCERTAINTY_M"])
    assert uncertainty_m == pytest.approx(focus["expected_shift_m"], rel=0.01)
    assert tags["APERTURA_REFERENCE"].startswith("0 dB: " if name.endswith("db.tif") else "1: ")
    assert tags["APERTURA_PROCESSING"].startswith("time-domain backprojection")


@pytest.mark.parametrize("name", IMAGES)
def test_angles_in_the_tags_are_those_of_the_layers(finished_tiny, tmp_path, name):
    tags, pair = Lone.of(finished_tiny.results / name, tmp_path).tags, name.split("/")[1]
    pairs = ["uav1-uav1", "uav1-uav2"] if pair == "fused" else [pair]
    for layer in ("incidence", "bistatic_angle"):
        angles = []
        for each in pairs:
            with rasterio.open(str(finished_tiny.results / "f01" / each / f"{layer}.tif")) as raster:
                angles.append(raster.read(1).ravel())
        angles, key = np.concatenate(angles).astype(float), f"APERTURA_{layer.upper()}"
        assert float(tags[f"{key}_MEAN_DEG"]) == pytest.approx(np.nanmean(angles), abs=0.006)
        limits = [float(value) for value in tags[f"{key}_RANGE_DEG"].split(" to ")]
        assert limits == pytest.approx([np.nanmin(angles), np.nanmax(angles)], abs=0.006)


@pytest.mark.slow
def test_configured_attribution_is_written_to_image_and_layers(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    state(root, "metadata", **STATED)
    antennas = {"radar_tx_polarisation": "V", "radar_rx_polarisation": "V"}
    edit_config(root, lambda config: config["nodes"]["uav1"].update(antennas=antennas))
    campaign = Campaign.load(root)
    layers.layers(campaign, "f01", "uav1-uav1")
    export.export(campaign, "f01", "uav1-uav1")
    for name in ("db.tif", "incidence.tif"):
        tags = Lone.of(campaign.result("f01", "uav1-uav1", name), tmp_path).tags
        assert {key: tags.get(key) for key in WHO} == WHO
        assert tags["APERTURA_POLARISATION"] == "VV"


def tags_for(views, **stated):
    settings = SimpleNamespace(campaign="c", nodes={"a": None, "b": None}, metadata=Attribution(**stated))
    for node in settings.nodes:
        antennas = SimpleNamespace(radar_tx_polarisation=None, radar_rx_polarisation=None)
        settings.nodes[node] = SimpleNamespace(antennas=antennas)
    return acquisition_tags(SimpleNamespace(settings=settings), views)


VIEW = {
    "first_utc": "2025-05-14T09:30:00.000000000", "last_utc": "2025-05-14T09:30:20.000000000", "heading_deg": 0.0,
    "look_deg": 90.0, "range_m": 50.0, "height_m": 30.0, "incidence_deg": 53.0, "bistatic_angle_deg": 0.0,
    "look_vector_ecef": None, "side": "right", "side_observable": False, "centre_hz": 9.6e9, "band_hz": 6e8,
}  # fmt: skip


def test_cube_states_the_configured_attribution():
    settings = SimpleNamespace(campaign="c", metadata=Attribution(**STATED))
    grid = SceneGrid("local", 0.0, 4.0, 1.0, (4, 6))
    attributes = acdd_attributes(SimpleNamespace(settings=settings), [VIEW], grid)
    assert (
        attributes.items()
        >= {
            "title": "Harbour in May",
            "creator_name": "A. Nother, B. Other",
            "creator_url": "https://orcid.org/0000-0002-1825-0097",
            "creator_institution": "An Institute",
            "institution": "An Institute",
            "license": "CC-BY-4.0",
            "platform": "hexacopter",
            "instrument": "L-band radar",
            "id": "10.5281/zenodo.1",
            "references": WHO["APERTURA_CITATION"],
            "time_coverage_duration": "PT20.000000S",
        }.items()
    )
    assert not [name for name in attributes if name.startswith("geospatial")]  # a local frame has no position


def test_recording_without_a_clock_has_no_time_of_day():
    """Times of a recording without a clock are pulse numbers, in seconds since 1970."""
    counted = VIEW | {"first_utc": "1970-01-01T00:00:00.000000000", "last_utc": "1970-01-01T00:00:20.000000000"}
    tags = tags_for({("f01", "a-a"): counted}, creators=[{"name": "A. Nother"}])
    assert not tags.keys() & {"APERTURA_ACQUISITION_START", "APERTURA_ACQUISITION_END", "TIFFTAG_DATETIME"}
    assert tags["APERTURA_CITATION"] == "A. Nother: c."


def test_direction_of_a_sum_is_the_mean_direction_of_its_pairs():
    west_of_north, east_of_north = VIEW | {"look_deg": 350.0}, VIEW | {"look_deg": 20.0}
    tags = tags_for({("f01", "a-a"): west_of_north, ("f01", "a-b"): east_of_north})
    assert float(tags["APERTURA_LOOK_DIRECTION_DEG"]) == pytest.approx(5.0, abs=0.01)
    opposite = tags_for({("f01", "a-a"): VIEW, ("f02", "a-a"): VIEW | {"look_deg": 270.0}})
    assert "APERTURA_LOOK_DIRECTION_DEG" not in opposite
    assert (opposite["APERTURA_FLIGHTS"], opposite["APERTURA_MODE"]) == ("f01, f02", "monostatic")
    hovering = tags_for({("f01", "a-a"): VIEW | {"heading_deg": None}})
    assert "APERTURA_HEADING_DEG" not in hovering
