"""Tiles and pulse blocks: the image is the same for any division, and only the tables of one block are in memory."""

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
def test_image_from_pulse_blocks_equals_that_of_all_pulses(engine, form_options):
    """Blocks are added in complex64; the error is below -130 dB, far below the error of any table."""
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


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # raised by fork in a process with threads
def test_child_forked_after_image_formation_forms_the_image(toy):
    """A forked child has no Dask threads and must not wait for these; an alarm would end the child after 10 s."""
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0)
    image = image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=16)
    expected = image.compute(scheduler="threads")
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        os._exit(0 if np.array_equal(image.compute(scheduler="threads"), expected) else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_pulse_blocks_are_prepared_one_after_the_other(toy):
    """Tables of the next block are computed after all tiles of the previous block, so that one block is in memory."""
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0, pulse_blocks=3)
    toy_engine.CALLS.clear()
    image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=32).compute(scheduler="threads")
    tiles = len(list(drawn.grid.tiles(32)))
    assert tiles > 1
    assert (["prepare"] + ["form"] * tiles) * 3 == toy_engine.CALLS


@pytest.mark.parametrize("mode", ["lazy", "stored"])
def test_single_tile_prepares_every_block_and_forms_no_other_tile(toy, mode):
    drawn = draw(np.random.default_rng(2), pixels=40, pulses=64)
    setting = Setting("toy", {"refine": 1}, {}, -20.0, 1.0, pulse_blocks=3)
    image = image_array(drawn.profiles, setting, drawn.grid, FlatGround(0.0), side_px=32)
    whole = image.compute(scheduler="threads")
    toy_engine.CALLS.clear()
    window = (slice(0, 32), slice(32, 40))
    tile = np.zeros(drawn.grid.shape, np.complex64)
    if mode == "lazy":
        tile[window] = image[window].compute(scheduler="threads")
    else:
        compute_tiles(image, [window], tile, threads=2)
    assert toy_engine.CALLS == ["prepare", "form"] * 3
    np.testing.assert_array_equal(tile[window], whole[window])


def test_tiles_start_at_kernel_patches():
    assert PATCH_PX % KERNEL.patch_side == 0


@pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")
def test_image_of_several_regions_is_bit_identical_to_its_parts(isa):
    pixels = pixel_grid(280, 263, spacing_m=0.02)  # the kernel completes regions of 256 x 256 pixels in turn
    tables, points = native.prepare(fly(scatter(pixels), pulses=13).profiles(ecef(pixels))), ecef(pixels)
    whole = native.form(tables, points)
    parts = [[native.form(tables, points[y : y + 80, x : x + 144]) for x in (0, 144)] for y in range(0, 280, 80)]
    assert whole.all()
    np.testing.assert_array_equal(np.block(parts).view(np.uint32), whole.view(np.uint32))
