"""Speed-accuracy chart: Pareto front, marked settings, measured errors, and a self-contained page."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
import toy_engine
import yaml
from folders import copy_writable, expected_plan, quality_of
from scenes import TARGET_GRID, plan, point_history

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.common.tables import write_table
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.terrain import FlatGround
from apertura.stages import image
from apertura.tools.chart.pareto import Point, draw_points, with_front
from apertura.tools.chart.speed_accuracy import LEAST_ROWS, Part, measure, speed_accuracy


@pytest.fixture(scope="module")
def charted(finished_tiny, tmp_path_factory):
    """Return the files and rows of a chart measured within one second."""
    root = copy_writable(finished_tiny.root, tmp_path_factory.mktemp("charted") / "campaign")
    paths = speed_accuracy(Campaign.load(root), "f01", "uav1-uav2", seconds=1.0)
    return paths, list(csv.DictReader(paths[0].read_text(encoding="utf-8").splitlines()))


def error_db(row):
    return float(row["error_db"] or "-inf")


def test_front_contains_settings_not_dominated_by_faster_ones(charted):
    rows = charted[1]
    seconds = [float(row["seconds"]) for row in rows]
    assert {row["on_front"] for row in rows} == {"True", "False"}
    assert seconds == sorted(seconds)
    for number, row in enumerate(rows):
        dominated = any(error_db(faster) <= error_db(row) for faster in rows[:number])
        assert (row["on_front"] == "True") == (not dominated)


def test_planned_setting_and_reference_are_always_measured(charted):
    rows = charted[1]
    planned = [row for row in rows if row["planned"] == "True"]
    assert len(planned) == 1
    plan = expected_plan(Campaign.load(charted[0][0].parents[2]), "f01", "uav1-uav2")
    assert float(planned[0]["error_db"]) <= plan.accuracy_db
    assert planned[0]["setting"] == plan.setting.line  # the setting of the image
    assert [row["engine"] for row in rows if row["error_db"] == ""] == ["reference"]  # not measured against itself


def test_measured_errors_are_no_worse_than_predicted(charted):
    """Predictions apply to white echoes, and bounds exceed actual errors; these echoes are from single targets."""
    for row in charted[1]:
        if row["engine"] != "reference":
            assert float(row["error_db"]) <= float(row["predicted_error_db"]) + 9


def test_page_contains_every_point_and_loads_nothing(charted):
    paths, rows = charted
    page = paths[2].read_text(encoding="utf-8")
    assert page.count('"setting": "') == len(rows)
    assert set(re.findall(r"https?://[^\"'<> ]+", page)) == {"http://www.w3.org/2000/svg"}
    assert paths[1].read_bytes().startswith(b"\x89PNG")


def test_point_as_accurate_as_a_faster_one_is_not_on_the_front(tmp_path):
    point = Point("native", "a", 1, 1.0, 1e9, -60.0, 1.0, -60.0, on_front=False, planned=False)
    points = [point, replace(point, seconds=2.0), replace(point, seconds=3.0, error_db=-60.1)]
    marked = with_front(points)
    assert [point.on_front for point in marked] == [True, False, True]
    write_table(tmp_path / "points.csv", marked)
    assert np.genfromtxt(tmp_path / "points.csv", delimiter=",", skip_header=1, usecols=3).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.slow
def test_toy_engine_is_configured_planned_charted_and_run(finished_tiny, tmp_path, toy):
    """An engine of one file and one table row has config options, a prediction in the plan, and a product report."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    config = root / "config" / "config.yaml"
    document = yaml.safe_load(config.read_text())
    processing = {"engine": "toy", "engine_options": {"toy": {"refine": 2}}, "accuracy_db": -20.0}
    config.write_text(yaml.safe_dump(document | {"processing": processing}))
    campaign = Campaign.load(root)
    assert expected_plan(campaign, "f01", "uav1-uav2").setting.line == "toy refine=2"
    image.image(campaign, "f01", "uav1-uav2")
    report = quality_of(campaign, "uav1-uav2")
    assert report["engine"] == "toy"
    assert report["numerical_error_db"] < -20
    paths = speed_accuracy(campaign, "f01", "uav1-uav2", seconds=5.0)
    assert {"toy refine=2"} <= {row["setting"] for row in csv.DictReader(paths[0].open(encoding="utf-8"))}
    document["processing"] = {"engine_options": {"toy": {"refined": 2}}}
    config.write_text(yaml.safe_dump(document))
    with pytest.raises(CampaignError, match=r"engine_options\.toy\.refined: .*options of toy: refine"):
        Campaign.load(root)


@pytest.fixture
def part():
    """Return a small image as a part to be measured."""
    history, pixels = point_history(24), TARGET_GRID.positions(0.0)
    indices = np.random.default_rng(1).integers(0, (LEAST_ROWS, 160), (50, 2))
    exact = reference.form(history, pixels[tuple(indices.T)])
    profiles = range_compress(history, TARGET_GRID, FlatGround(0.0))
    return Part(history, profiles, pixels, indices, np.full(50, 50 / (LEAST_ROWS * 160)), exact, 160 * 160, 0.1)


def measured_by_toy(part, seconds):
    reference_plan = plan(overrides={"engine": "numba", "presum": 1})
    points = measure(part, reference_plan, [Setting("toy", {"refine": 4}, {}, -38.0, seconds)], seconds=60.0)
    return next(point for point in points if point.engine == "toy")


@pytest.mark.quick("0.6-80")
@pytest.mark.parametrize(("seconds", "rows"), [(1e-6, 160), (0.6, 80), (1e6, LEAST_ROWS)])
def test_slow_engine_is_timed_on_fewer_rows(part, toy, monkeypatch, seconds, rows):
    shapes, form = set(), toy_engine.form

    def recorded(prepared, pixels, *, beams=None):
        shapes.add(pixels.shape)
        return form(prepared, pixels)

    monkeypatch.setattr(toy_engine, "form", recorded)
    assert measured_by_toy(part, seconds).error_db < -10  # the part contains mainly sidelobes
    assert shapes == {(rows, 160, 3)}


def test_engine_of_phase_histories_is_charted_on_them(part, toy, monkeypatch):
    inputs = []
    monkeypatch.setattr(toy_engine, "READS", "phase_history")
    monkeypatch.setattr(toy_engine, "prepare", lambda history, **_: inputs.append(history) or history)
    monkeypatch.setattr(toy_engine, "form", reference.form)
    assert measured_by_toy(part, 1e6).error_db < -130
    assert {type(history) for history in inputs} == {PhaseHistory}


@pytest.mark.parametrize(("exact_s", "shown"), [(10.0, True), (3600.0, False)])
def test_much_slower_double_sum_does_not_extend_the_axis(tmp_path, monkeypatch, exact_s, shown):
    drawn = []
    monkeypatch.setattr("apertura.tools.chart.pareto.save_png", lambda figure, _: drawn.append(figure))
    rest = {"presum": 1, "pixel_pulses_per_s": 1e9, "predicted_seconds": 1.0, "predicted_error_db": -60.0}
    settings = [
        Point("native", "a", seconds=s, error_db=-60 * s, on_front=False, planned=False, **rest) for s in (1, 5)
    ]
    exact = Point("reference", "b", seconds=exact_s, error_db=None, on_front=True, planned=False, **rest)
    draw_points([*settings, exact], tmp_path / "chart.png", title="one", accuracy_db=-60.0)
    (figure,) = drawn
    assert (figure.axes[0].get_xlim()[1] >= exact_s) == shown
    assert any("beyond the axis" in text.get_text() for text in figure.legends[0].get_texts()) != shown
