"""Errors that stop a run are reported by `check` beforehand, by the same functions with the same messages."""

import numpy as np
import pytest
import rasterio
from folders import edit_config, edit_meta, edit_track, state
from rasterio.transform import from_origin

from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import map_from_frame
from apertura.run.process import process
from apertura.stages.node_log import read_log


def processing(**keys):
    return lambda root: state(root, "processing", **keys)


def antenna(boresight_deg, width_deg=20.0, **more):
    """Return a function that configures a beam of the transmitter's antenna and other processing keys."""
    beam = {"beamwidth_deg": [width_deg, width_deg], "boresight_deg": boresight_deg}

    def change(root):
        edit_config(root, lambda document: document["nodes"]["uav1"].update(antennas={"radar_tx": beam}))
        edit_config(root, lambda document: document["nodes"]["uav1"].update(attitude="course"))
        state(root, "processing", **more)

    return change


def metadata(node, **keys):
    named = {key.replace("_", ":", 1): value for key, value in keys.items()}
    return lambda root: edit_meta(root, node, lambda meta: meta["global"].update(named))


def distant_scene(root):
    """Move the scene beyond the recorded ranges, but within the bounds of check `distance`."""
    west, south, east, north = Campaign.load(root).settings.scene.bounds_m
    state(root, "scene", bounds_m=[west + 110.5, south, east + 110.5, north])


def raise_terrain(root):
    """Raise the terrain so that a tenth of the pulses are below it."""
    track = read_log(Campaign.load(root), "f01", "uav1")
    heights = map_from_frame("EPSG:32632", track.position.values)[:, 2]
    heights_in_flight = heights[(track.time.values > np.datetime64("2025-05-14T09:30:00"))]
    state(root, "scene", height_m=float(np.quantile(heights_in_flight[:40], 0.1)))


def codes(root):
    np.save(root / "raw/codes.npy", np.load(root / "raw/codes.npy")[:-1])


def segment(root):
    line = "f01\tuav1-uav1\t2025-05-14T10:30:00\t2025-05-14T10:31:00\n"
    (root / "config/segments.tsv").write_text("flight\tpair\tstart\tend\n" + line)


def tag_twice(meta):
    meta["captures"][5]["core:datetime"] = meta["captures"][3]["core:datetime"]


def dem_not_below_the_track(root):
    """Write a DEM that covers the scene but not the track; automatic bounds require both."""
    west, _, _, north = Campaign.load(root).settings.scene.bounds_m
    place = from_origin(west + 400, north + 400, 1.0, 1.0)
    kind = {"width": 20, "height": 20, "count": 1, "dtype": "float64", "crs": "EPSG:32632"}
    with rasterio.open(root / "dem.tif", "w", "GTiff", transform=place, **kind) as raster:
        raster.write(np.full((20, 20), 600.0), 1)
    state(root, "scene", dem="dem.tif", dem_datum="ellipsoid", bounds_m="auto", spacing_m="auto")


INVALID = {
    "distant scene": (distant_scene, "echoes of the scene arrive after the cyclic prefix"),
    "in the ground": (raise_terrain, "is at or below the terrain of the scene, worst at pulse"),
    "beam to the other side": (antenna([-90.0, 0.0]), "no pulse illuminates the scene"),
    "beam to the sky": (antenna([90.0, 80.0]), "no pulse illuminates the scene"),
    "sums of pulses under a beam": (antenna([90.0, 0.0], 120.0, presum=4), "presum factor 4 with antenna beams"),
    "sums of many pulses": (processing(presum=64), "presum factor 64"),
    "terrain without a DEM": (processing(terrain="dem"), "terrain model dem, but the scene has no DEM"),
    "an unavailable engine": (processing(engine="cuda"), "engine cuda is not available on this machine"),
    "an integration angle of one pulse": (
        processing(integration={"degrees": 0.001}),
        "at most 2 pulses illuminate a pixel inside",
    ),
    "a foreign scheduler": (processing(scheduler="tcp://127.0.0.1:9999"), "DASK_SCHEDULER_ADDRESS is not set"),
    "a log with a gap": (
        lambda root: edit_track(root, "uav1", lambda lines: [*lines[:4], *lines[-3:]]),
        "no pulse has a valid position",
    ),
    "too few codes": (codes, "complex64 of shape (1023,)"),
    "no sidelink": (metadata("uav2", apertura_channels=["radar", "spare"]), "a channel named 'sidelink'"),
    "another rate": (metadata("uav2", core_sample_rate=1e9), "recorded with sample_rate_hz"),
    "no pulse in a segment": (segment, "no pulse of flight f01, pair uav1-uav1 within"),
    "a duplicate tag": (lambda root: edit_meta(root, "uav2", tag_twice), "not after the previous capture"),
    "a DEM not below the track": (dem_not_below_the_track, "below the track, required for scene.bounds_m: auto"),
}


@pytest.mark.quick("a log with a gap")
@pytest.mark.parametrize("name", list(INVALID))
def test_check_reports_errors_of_a_run_with_the_same_message(tiny, name, monkeypatch):
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    invalidate, message = INVALID[name]
    invalidate(tiny)
    before = [(problem.found, problem.expected, problem.remedy) for problem in problems(tiny)]
    assert any(message in " ".join(parts) for parts in before), before
    with pytest.raises(CampaignError) as caught:
        process(tiny, last="cube")
    if name not in {"no pulse in a segment", "a DEM not below the track"}:  # a run counts only the remaining pulses
        assert (caught.value.found, caught.value.expected, caught.value.remedy) in before


@pytest.mark.parametrize("change", [antenna([90.0, 0.0], 120.0), processing(presum=1, engine="native")])
def test_valid_settings_are_not_refused(tiny, change):
    change(tiny)
    assert problems(tiny) == []
