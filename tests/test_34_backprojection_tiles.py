"""Tiles and blocks of pulses: the same image, however it is cut, and one block's tables at a time."""

import os
import signal

import numpy as np
import pytest
import toy_engine
from campaigns import draw
from scenes import ecef, fly, pixel_grid, scatter

from apertura.core.backprojection.engines import PATCH_PX, load_engine, native
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.engines.native_binding import KERNEL
from apertura.core.backprojection.tiles import compute_tiles, image_array
from apertura.core.quality.measures import numerical_error_db
from apertura.core.scene.terrain import FlatGround


@pytest.mark.parametrize(
    ("engine", "form_options"), [("native", {"accumulate": "complex128", "tolerance_rad": 1e-5}), ("numba", {})]
)
def test_an_image_from_blocks_of_pulses_is_that_of_all_pulses(engine, form_options):
    """Blocks are added in complex64: below -130 dB, far below what any table errs by."""
    if not load_engine(engine).available():
        pytest.skip("apertura was installed without a compiler")
    drawn = draw(np.random.default_rng(2), pixels=48, pulses=90)
    images = []
    for blocks in (1, 5):
        setting = Setting(engine, {"oversampling": 16}, form_options, -80.0, 1.0, pulse_blocks=blocks)
        image = image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=16)
        images.append(np.zeros(drawn.grid.shape, np.complex64))
        compute_tiles(image, list(drawn.grid.tiles(16)), images[-1], threads=2)
    assert numerical_error_db(images[1].ravel(), images[0].ravel().astype(np.complex128)) < -130


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of fork in a process with threads
def test_a_child_that_is_forked_after_an_image_forms_it_too(toy):
    """Dask's threads do not live on in a child, which would wait for them for ever: here for ten seconds."""
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0)
    image = image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=16)
    expected = image.compute(scheduler="threads")
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        os._exit(0 if np.array_equal(image.compute(scheduler="threads"), expected) else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_blocks_of_pulses_are_prepared_one_after_the_other(toy):
    """The next block's tables wait for every tile of the block before: one block's tables are held at a time."""
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0, pulse_blocks=3)
    toy_engine.CALLS.clear()
    image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=32).compute(scheduler="threads")
    tiles = len(list(drawn.grid.tiles(32)))
    assert tiles > 1
    assert (["prepare"] + ["form"] * tiles) * 3 == toy_engine.CALLS


@pytest.mark.parametrize("way", ["lazy", "stored"])
def test_a_tile_alone_prepares_every_block_and_forms_no_other_tile(toy, way):
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0, pulse_blocks=3)
    image = image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=32)
    whole = image.compute(scheduler="threads")
    toy_engine.CALLS.clear()
    window = (slice(0, 32), slice(32, 40))
    tile = np.zeros(drawn.grid.shape, np.complex64)
    if way == "lazy":
        tile[window] = image[window].compute(scheduler="threads")
    else:
        compute_tiles(image, [window], tile, threads=2)
    assert toy_engine.CALLS == ["prepare", "form"] * 3
    np.testing.assert_array_equal(tile[window], whole[window])


def test_tiles_begin_at_patches_of_the_kernel():
    assert PATCH_PX % KERNEL.patch_side == 0


@pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")
def test_an_image_of_several_regions_is_that_of_its_parts_to_the_bit(isa):
    pixels = pixel_grid(280, 263, spacing_m=0.02)  # the kernel finishes 256 x 256 pixels before it goes on
    tables, places = native.prepare(fly(scatter(pixels), pulses=13).profiles(ecef(pixels))), ecef(pixels)
    whole = native.form(tables, places)
    parts = [[native.form(tables, places[y : y + 80, x : x + 144]) for x in (0, 144)] for y in range(0, 280, 80)]
    assert whole.all()
    np.testing.assert_array_equal(np.block(parts).view(np.uint32), whole.view(np.uint32))
