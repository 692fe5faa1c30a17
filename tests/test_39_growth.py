"""Growth benchmark: errors of its scenes against exact values, and extrapolation from a part of the tiles."""

import json

import latest
import numpy as np
import pytest
from growing import contestants, scene, table
from growing.contestants import EngineInput, SkippedError

from apertura.core.planning import plan


@pytest.fixture(scope="module")
def small():
    return scene.build(256, 128, "bistatic", "rough")


def test_engine_meets_its_accuracy_at_the_compared_pixels(small):
    engine_input = EngineInput(small)
    engine_input.compress()
    contestant = engine_input.planned("native" if "native" in contestants.ENGINES else "numba", -60.0, 60.0)
    contestant.go()
    assert contestant.error_db < -60
    row = contestant.row(engine_input.compressions[0])
    assert (row["size"], row["pulses"], row["aim_db"], row["scaled"], row["rounds"]) == (256, 128, -60.0, False, 1)
    assert row["seconds_from_echoes"] > row["seconds"] > row["seconds_shared"] > 0 < row["planning_seconds"]


@pytest.mark.slow
def test_images_of_pulse_blocks_sum_to_the_whole(small, monkeypatch):
    whole = EngineInput(small).planned("numba", -60.0, 60.0).run()[0]
    monkeypatch.setattr(plan, "BLOCK_BYTES", 1 << 16)
    np.testing.assert_allclose(
        EngineInput(small).planned("numba", -60.0, 60.0).run()[0], whole, atol=1e-5 * abs(whole).max()
    )


def test_error_is_measured_after_a_complex_gain(small):
    scaled = 3j * small.exact
    assert small.error_db(scaled.astype(np.complex64)) < -120
    erroneous = scaled + 0.03 * np.abs(small.exact).std() * np.where(np.arange(len(scaled)) % 2, 1, -1)
    ratio = np.linalg.norm(erroneous - scaled) / np.linalg.norm(scaled)
    assert small.error_db(erroneous) == pytest.approx(20 * np.log10(ratio), abs=0.2)


@pytest.mark.slow
def test_part_of_the_tiles_gives_the_same_pixels(monkeypatch):
    monkeypatch.setattr(scene, "TILE_PX", 128)
    monkeypatch.setattr(contestants, "TILE_PX", 128)
    tiled = scene.build(512, 16, "monostatic", "flat")
    halves, quarters = tiled.tiles(2), tiled.tiles(4)
    assert all(tile in halves for tile in quarters)
    assert [{tile[axis].start for tile in quarters} for axis in (0, 1)] == 2 * [{0, 128, 256, 384}]
    engine_input = EngineInput(tiled)
    whole, part = (engine_input.planned("numba", -60.0, limit_s) for limit_s in (1e3, 0.07))
    assert (whole.share, part.share) == (1.0, 0.25)
    np.testing.assert_array_equal(whole.run()[0], part.run()[0])
    with pytest.raises(SkippedError, match="smallest representative part takes"):
        engine_input.planned("numba", -60.0, 1e-4)


def test_clutter_fields_are_disjoint_and_inside_the_formed_tiles():
    part = scene.build(256, 32, "low", "smooth")
    count = np.zeros(part.grid.shape, int)
    for window in part.fields:
        count[window] += 1
    assert (count.max(), count.sum()) == (1, 16 * 64**2)
    inside = np.zeros(part.grid.shape, bool)
    for window in part.inner:
        inside[window] = True
    assert inside[*part.checks].all()


def test_unknown_engine_is_reported(small):
    with pytest.raises(SkippedError, match="this version has no engine warp"):
        EngineInput(small).planned("warp", -60.0, 1.0)


def test_growth_is_the_exponent_of_a_power_law():
    rows = [{"size": n, "seconds_from_echoes": 2e-9 * n**2.5} for n in (512, 1024, 4096)]
    power, offset = table.power_law(rows)
    assert (power, np.exp(offset)) == pytest.approx((2.5, 2e-9))
    assert table.power_law(rows[:2]) is None


def test_rows_of_other_benchmarks_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(latest, "LATEST", tmp_path / "latest.json")
    latest.replace_rows([{"name": "native"}], lambda _: True)
    latest.replace_rows([{"group": "growth", "size": 512}], lambda row: "group" in row)
    latest.replace_rows([{"group": "growth", "size": 1024}], lambda row: "group" in row)
    assert json.loads(latest.LATEST.read_text()) == [{"name": "native"}, {"group": "growth", "size": 1024}]
