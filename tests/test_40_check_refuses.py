"""What a run would refuse, `check` refuses before it, of the same functions and in the same words."""

import numpy as np
import pytest
import rasterio
from folders import edit_config, edit_meta, edit_track, run_steps, state
from rasterio.transform import from_origin

from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import map_from_frame
from apertura.stages.node_log import read_log


def processing(**keys):
    return lambda root: state(root, "processing", **keys)


def antenna(boresight_deg, width_deg=20.0, **more):
    """Give the transmitter's antenna a beam; more keys of the processing."""
    beam = {"beamwidth_deg": [width_deg, width_deg], "boresight_deg": boresight_deg}

    def change(root):
        edit_config(root, lambda document: document["nodes"]["uav1"].update(antennas={"radar_tx": beam}))
        edit_config(root, lambda document: document["nodes"]["uav1"].update(attitude="course"))
        state(root, "processing", **more)

    return change


def metadata(node, **keys):
    named = {key.replace("_", ":", 1): value for key, value in keys.items()}
    return lambda root: edit_meta(root, node, lambda meta: meta["global"].update(named))


def wider(root):
    """Make the scene reach beyond what is recorded."""
    west, south, east, north = Campaign.load(root).settings.scene.bounds_m
    state(root, "scene", bounds_m=[west - 100, south - 100, east + 100, north + 100], spacing_m=1.0)


def a_few_in_the_ground(root):
    """Raise the ground to where a tenth of the pulses are below it."""
    track = read_log(Campaign.load(root), "f01", "uav1")
    heights = map_from_frame("EPSG:32632", track.position.values)[:, 2]
    flown = heights[(track.time.values > np.datetime64("2025-05-14T09:30:00"))]
    state(root, "scene", height_m=float(np.quantile(flown[:40], 0.1)))


def codes(root):
    np.save(root / "raw/codes.npy", np.load(root / "raw/codes.npy")[:-1])


def segment(root):
    line = "f01\tuav1-uav1\t2025-05-14T10:30:00\t2025-05-14T10:31:00\n"
    (root / "config/segments.tsv").write_text("flight\tpair\tstart\tend\n" + line)


def tag_twice(meta):
    meta["captures"][5]["core:datetime"] = meta["captures"][3]["core:datetime"]


def dem_beside_the_track(root):
    """A DEM about the scene alone, which automatic bounds do not begin at."""
    west, _, _, north = Campaign.load(root).settings.scene.bounds_m
    place = from_origin(west + 400, north + 400, 1.0, 1.0)
    kind = {"width": 20, "height": 20, "count": 1, "dtype": "float64", "crs": "EPSG:32632"}
    with rasterio.open(root / "dem.tif", "w", "GTiff", transform=place, **kind) as raster:
        raster.write(np.full((20, 20), 600.0), 1)
    state(root, "scene", dem="dem.tif", dem_datum="ellipsoid", bounds_m="auto", spacing_m="auto")


SPOILT = {
    "wide scene": (wider, "echoes of the scene arrive after the cyclic prefix"),
    "in the ground": (a_few_in_the_ground, "is in or below the ground of the scene, worst at pulse"),
    "beam to the other side": (antenna([-90.0, 0.0]), "no pulse illuminates the scene"),
    "beam to the sky": (antenna([90.0, 80.0]), "no pulse illuminates the scene"),
    "sums of pulses under a beam": (antenna([90.0, 0.0], 120.0, presum=4), "presum is 4, and the antennas have beams"),
    "sums of many pulses": (processing(presum=64), "presum is 64"),
    "a DEM that is none": (processing(terrain="dem"), "terrain is dem"),
    "an engine that is not here": (processing(engine="cuda"), "engine cuda cannot run here"),
    "an angle of one pulse": (
        processing(integration={"degrees": 0.001}),
        "at most 2 pulses illuminate a pixel inside",
    ),
    "another's scheduler": (processing(scheduler="tcp://127.0.0.1:9999"), "DASK_SCHEDULER_ADDRESS is not set"),
    "a log with a hole": (
        lambda root: edit_track(root, "uav1", lambda lines: [*lines[:4], *lines[-3:]]),
        "no pulse has a valid position",
    ),
    "codes too few": (codes, "complex64 of shape (1023,)"),
    "no sidelink": (metadata("uav2", apertura_channels=["radar", "spare"]), "a channel named 'sidelink'"),
    "another rate": (metadata("uav2", core_sample_rate=1e9), "recorded with sample_rate_hz"),
    "no pulse in a segment": (segment, "no pulse of flight f01, pair uav1-uav1 within"),
    "a tag twice": (lambda root: edit_meta(root, "uav2", tag_twice), "not after the one before"),
    "a DEM beside the track": (dem_beside_the_track, "below the track, which scene.bounds_m: auto requires"),
}


@pytest.mark.quick("a log with a hole")
@pytest.mark.parametrize("name", list(SPOILT))
def test_what_a_run_refuses_is_refused_before_it_in_the_same_words(tiny, name, monkeypatch):
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    spoil, words = SPOILT[name]
    spoil(tiny)
    before = [(one.found, one.expected, one.remedy) for one in problems(tiny)]
    assert any(words in " ".join(one) for one in before), before
    with pytest.raises(CampaignError) as caught:
        run_steps(tiny, exports=False)
    if name not in {"no pulse in a segment", "a DEM beside the track"}:  # whose numbers are of the pulses that are left
        assert (caught.value.found, caught.value.expected, caught.value.remedy) in before


@pytest.mark.parametrize("change", [antenna([90.0, 0.0], 120.0), processing(presum=1, engine="native")])
def test_what_a_run_takes_is_not_refused(tiny, change):
    change(tiny)
    assert problems(tiny) == []
