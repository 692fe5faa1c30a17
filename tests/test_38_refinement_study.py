"""Study of track refinement: loss against track error with and without refinement, and figures."""

from dataclasses import replace

import numpy as np
import pytest
from apertura_research import commands, sweep
from apertura_research.autofocus import charts, outcomes
from apertura_research.autofocus.cases import CELL_M2, SCENES, case
from apertura_research.autofocus.outcomes import (
    ACCEPTED,
    FLAGGED,
    KINDS,
    REFUSED,
    SEEDS,
    SIGMAS_CM,
    TOO_FEW,
    UNCORRECTED,
    VERDICTS,
    AutofocusRow,
    case_of,
    judge,
    outcome_of,
    refine_case,
    run_case,
    verdict_of,
)
from scenes import compiled
from typer.testing import CliRunner

from apertura.common.errors import CampaignError
from apertura.common.tables import read_table, write_table
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.methods.autofocus.inputs import Refinement

pytestmark = pytest.mark.slow  # research code

QUARTER_OF_A_CELL_CM = 100 * np.sqrt(CELL_M2) / 4


def row(sigma_cm, verdict, *, scene="five", seed=1, product_db=0.2):
    return AutofocusRow(scene, sigma_cm, seed, 2.0 * sigma_cm, product_db, 0.2, verdict, "", "reason")


def refinement(accepted, *flags, correction=UNCORRECTED):
    return Refinement(correction, {}, accepted, "because", flags=dict.fromkeys(flags, "text"))


def test_verdict_is_one_of_four():
    verdicts = [
        verdict_of(refinement(True)),
        verdict_of(refinement(True, "position_error_understated")),
        verdict_of(refinement(False, "refinement_rejected", "cycle_slip_suspected")),
        verdict_of(refinement(False, "refinement_no_bright_point")),
    ]
    assert verdicts == [ACCEPTED, FLAGGED, REFUSED, TOO_FEW] == list(VERDICTS)


def test_studied_scenes_are_cases_and_sizes_start_at_zero():
    assert set(KINDS) <= set(SCENES)
    assert SIGMAS_CM == (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)
    assert len(SEEDS) > 1


@compiled
def test_refused_refinement_keeps_the_loss_of_the_logs():
    simulated = case_of("five", 1.0, 1)
    refused, accepted = (
        outcome_of(simulated, refinement(accept, "f", correction=simulated.truth)) for accept in (False, True)
    )
    assert refused.loss_db == accepted.loss_db > 0.8
    assert (refused.product_loss_db, refused.estimate_loss_db) == (refused.loss_db, 0.0)
    assert (accepted.product_loss_db, accepted.estimate_loss_db) == (0.0, 0.0)
    assert (accepted.scene, accepted.sigma_cm, accepted.seed, accepted.flags) == ("five", 1.0, 1, "f")


@compiled
def test_exact_logs_are_refined_with_a_stated_error_and_have_no_loss(monkeypatch):
    stated = []

    def record_stated(records, grid, terrain, errors):
        stated.extend(error.std_m for error in errors.values())
        return refinement(False, "refinement_rejected")

    monkeypatch.setattr(outcomes, "refine", record_stated)
    exact, erroneous = (run_case("five", (sigma_cm, 1))[0] for sigma_cm in (0.0, 2.0))
    assert stated == [(0.005,) * 3] * 2 + [(0.02,) * 3] * 2
    assert (exact.loss_db, exact.product_loss_db, exact.verdict) == (0.0, 0.0, REFUSED)
    assert erroneous.loss_db > 3


@compiled
def test_refinement_of_speckle_does_not_increase_the_loss():
    (outcome,) = run_case("dense", (2.0, 1))
    assert outcome.loss_db > 3
    assert outcome.product_loss_db <= outcome.loss_db


@compiled
@pytest.mark.parametrize("scene", ["five", "forty"])
def test_refinement_with_points_leaves_little_loss_of_2_cm(scene):
    rows = [run_case(scene, (2.0, seed))[0] for seed in (1, 2)]
    assert all(outcome.loss_db > 3 for outcome in rows)
    assert np.mean([outcome.product_loss_db for outcome in rows]) < 0.5


@compiled
@pytest.mark.parametrize("sigma_m", [0.02, 0.04])
def test_refinement_in_clutter_makes_no_case_worse(sigma_m):
    for seed in (1, 2):
        simulated = case("thirty", "short", "joint", sigma_m, 10.0, seed)
        result = refine_case(simulated)
        before, after = judge(simulated), judge(simulated, result.correction)
        assert not result.accepted or after.target_shift_cm <= before.target_shift_cm + QUARTER_OF_A_CELL_CM
        assert not result.accepted or after.target_loss_db >= before.target_loss_db


def marks(axes, label):
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return line.get_xydata()


def test_chart_distinguishes_the_verdicts(monkeypatch, tmp_path):
    rows = [row(1.0, ACCEPTED), row(2.0, FLAGGED), row(3.0, REFUSED, product_db=6.0), row(5.0, TOO_FEW, product_db=10)]
    rows += [replace(row_of_five, scene="dense", verdict=TOO_FEW) for row_of_five in rows]
    figures = []
    monkeypatch.setattr(sweep, "save_png", lambda figure, _: figures.append(figure))
    charts.draw_losses("losses", rows, tmp_path / "losses.png")
    five, dense = figures[0].axes
    marked = [marks(five, label).tolist() for label in (*VERDICTS, "refused estimate")]
    assert marked == [[[1.0, 0.2]], [[2.0, 0.2]], [[3.0, 6.0]], [[5.0, 10.0]], [[3.0, 0.2]]]
    assert marks(dense, TOO_FEW)[:, 0].tolist() == [1.0, 2.0, 3.0, 5.0]
    assert "2 of 4 accepted, 0 of these worse" in five.get_title()
    assert "0 of 4 accepted" in dense.get_title()


def test_tally_counts_accepted_and_harmful_refinements():
    rows = [row(1.0, ACCEPTED, product_db=2.5), row(2.0, REFUSED, product_db=9.0)]
    assert charts.tally(rows) == "1 of 2 accepted, 1 of these worse than the logs"


def test_sweep_and_chart_are_one_command_each(monkeypatch, tmp_path):
    one_case = replace(charts.STUDY, cases=lambda _: [None], run=lambda scene, _: [row(1.0, ACCEPTED, scene=scene)])
    monkeypatch.setattr(charts, "STUDY", one_case)
    monkeypatch.setattr(sweep, "code_sha256", lambda _: "0" * 64)
    for arguments in (*(["sweep", "autofocus", scene] for scene in KINDS), ["chart", "autofocus", "losses"]):
        run = CliRunner().invoke(commands.app, [*arguments, "--folder", str(tmp_path)])
        assert run.exit_code == 0, run.output
    rows = read_table(tmp_path / "losses.csv", AutofocusRow)
    assert [outcome.scene for outcome in rows] == list(KINDS)
    drawn_once = (tmp_path / "losses.png").read_bytes()
    write_table(tmp_path / "again.csv", rows)
    charts.draw_losses("losses", read_table(tmp_path / "again.csv", AutofocusRow), tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == drawn_once


@pytest.mark.parametrize("command", ["sweep autofocus", "autofocus-picture"])
def test_unknown_scene_is_refused_with_the_list_of_scenes(command):
    error = CliRunner().invoke(commands.app, [*command.split(), "x"]).exception
    assert isinstance(error, CampaignError)
    assert "texture" in str(error)


def linear_path_error(simulated, point_m):
    """Return the path error of the bistatic pair, docs/theory/autofocus.md, eq. 2: errors along u_t - s and u_r + s."""
    bistatic = simulated.records[1]
    to_tx, to_rx, sidelink = (
        leg / np.linalg.norm(leg, axis=1)[:, None]
        for leg in (*(phase - point_m for phase in bistatic.profiles.aperture.legs), bistatic.sidelink_m)
    )
    tx, rx = (simulated.truth.at(node, bistatic.time_s) for node in ("uav1", "uav2"))
    return ((to_tx - sidelink) * tx).sum(axis=1) + ((to_rx + sidelink) * rx).sum(axis=1)


@compiled
def test_figure_shows_three_images_on_one_scale_and_residual_errors(monkeypatch, tmp_path):
    simulated = case_of("five", 2.0, 1)
    half = TrackCorrection(
        simulated.truth.time_s, {node: 0.5 * error_m for node, error_m in simulated.truth.moved_m.items()}
    )
    figures = []
    monkeypatch.setattr(charts, "refine_case", lambda _: refinement(True, correction=half))
    monkeypatch.setattr(charts, "save_png", lambda figure, _: figures.append(figure))
    charts.draw_case("five", tmp_path / "five.png")
    images = [axes for axes in figures[0].axes if axes.images]
    assert [axes.get_title().split(",")[0] for axes in images] == ["logs", "refined tracks", "true tracks"] * 2
    assert {axes.images[0].get_clim() for axes in images} == {(-charts.DEPTH_DB, 0.0)}
    highest = [axes.images[0].get_array().max() for axes in images[:3]]
    assert highest[0] < highest[1] < highest[2] == pytest.approx(0, abs=1e-9)
    errors = [axes for axes in figures[0].axes if axes.get_title() in ("east", "north", "up")]
    for number, axes in enumerate(errors):
        log, residual = axes.lines[0].get_ydata(), axes.lines[1].get_ydata()
        np.testing.assert_allclose(log, 100 * simulated.truth.moved_m["uav1"][:, number])
        np.testing.assert_allclose(residual, log / 2, atol=1e-9)
    log, residual = (line.get_ydata() for line in figures[0].axes[9].lines[3:5])
    expected = 100 * linear_path_error(simulated, np.array([0.0, 15.0, 0.0]))
    assert np.std(log - (expected - expected.mean())) < 0.02 * np.std(log)
    assert np.std(residual - log / 2) < 0.02 * np.std(log)
    assert "accepted: because; no flag" in figures[0].get_suptitle()


@compiled
def test_figure_of_a_refused_refinement_shows_the_image_of_the_logs(monkeypatch, tmp_path):
    simulated = case_of("five", 2.0, 1)
    figures = []
    monkeypatch.setattr(
        charts, "refine_case", lambda _: refinement(False, "refinement_rejected", correction=simulated.truth)
    )
    monkeypatch.setattr(charts, "save_png", lambda figure, _: figures.append(figure))
    charts.draw_case("five", tmp_path / "five.png")
    logs, after, _ = [axes for axes in figures[0].axes if axes.images][:3]
    assert after.get_title().startswith("refused: logged tracks are used")
    assert (logs.images[0].get_array() == after.images[0].get_array()).all()
    assert "flags: refinement_rejected" in figures[0].get_suptitle()
