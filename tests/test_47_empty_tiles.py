"""Tiles outside all beams: not stored, and NaN in the cube and in the files of images and sums."""

import numpy as np
import pytest
import rasterio
from folders import copy_writable, edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import create, finish, open_array, open_stage, writing
from apertura.stages import cube, export

SIDE = 32
EMPTY = {"uav1-uav1": [(0, 0)], "uav1-uav2": [(0, 0), (1, 1)]}


def without_tiles(campaign, pair):
    """Rewrite the image of a pair without its tiles in EMPTY; return the complete image."""
    folder = campaign.stage("image", "f01", pair)
    image = open_stage(folder, "image").load()
    folder.remove()
    missing = np.broadcast_to(np.complex64(complex(np.nan, np.nan)), image.image.shape)
    with writing(folder) as wip:
        create(wip, image.assign(image=(("y", "x"), missing)), {"image": (SIDE, SIDE)})
        target = open_array(wip, "image")
        for row, column in np.ndindex(2, 2):
            window = tuple(slice(at * SIDE, (at + 1) * SIDE) for at in (row, column))
            if (row, column) not in EMPTY[pair]:
                target[window] = image.image.values[window]
        finish(wip, folder)
    return image.image.values


@pytest.fixture(scope="module")
def emptied(finished_tiny, tmp_path_factory):
    root = copy_writable(finished_tiny.root, tmp_path_factory.mktemp("emptied") / "campaign")
    edit_config(root, lambda document: document.update(processing={"tile_px": SIDE}))
    campaign = Campaign.load(root)
    complete = {pair: without_tiles(campaign, pair) for pair in EMPTY}
    cube.cube(campaign)
    export.export(campaign, "f01", "uav1-uav2")
    export.export_fused(campaign, "f01")
    return campaign, complete


def tiles_of(folder):
    return {
        tuple(map(int, path.parts[-2:])) for path in folder.rglob("*") if path.parts[-2].isdigit() and path.is_file()
    }


def test_empty_tile_is_not_stored_in_the_cube(emptied):
    campaign, _ = emptied
    folder = campaign.stage("cube")
    assert tiles_of(folder / "image" / "c" / "0" / "1") == {(0, 1), (1, 0)}
    assert tiles_of(folder / "coherent" / "c" / "0") == {(0, 1), (1, 0), (1, 1)}
    opened = open_stage(folder, "cube")
    assert np.isnan(opened.image.values[0, 1, SIDE:, SIDE:]).all()
    assert np.isnan(opened.noncoherent.values[0, :SIDE, :SIDE]).all()


def test_empty_tile_counts_as_zero_in_a_sum(emptied):
    campaign, complete = emptied
    opened = open_stage(campaign.stage("cube"), "cube")
    alone = (slice(SIDE, None), slice(SIDE, None))
    image = open_stage(campaign.stage("image", "f01", "uav1-uav1"), "image")
    mono = np.abs(complete["uav1-uav1"][alone]) / image.attrs["quality"]["brightest"]["amplitude"]
    np.testing.assert_allclose(opened.noncoherent.values[0][alone], mono**2 / 2, rtol=1e-5)
    assert np.isfinite(opened.coherent.values[0, :SIDE, SIDE:]).all()


@pytest.mark.parametrize("name", ["uav1-uav2/slc.tif", "uav1-uav2/db.tif", "fused/coherent_power.tif"])
def test_file_has_no_data_in_empty_tiles(emptied, name):
    campaign, _ = emptied
    with rasterio.open(str(campaign.results / "f01" / name)) as raster:
        pixels, valid = raster.read(1), raster.dataset_mask() > 0
    assert np.isnan(pixels[:SIDE, :SIDE]).all()
    assert not valid[:SIDE, :SIDE].any()
    assert np.isfinite(pixels[:SIDE, SIDE:]).all()
