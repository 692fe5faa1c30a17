"""Error atlas: predicted loss of each error source, its flags, and the count of alarms."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from apertura_research import commands
from apertura_research.error_atlas import outcomes
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.flight import PAIRS, flight
from apertura_research.error_atlas.outcomes import ErrorAtlasRow
from apertura_research.error_atlas.summary import STUDY, alarms, draw_cause, summary_of
from apertura_research.sweep import part_path
from typer.testing import CliRunner

from apertura.common.errors import CampaignError
from apertura.common.tables import read_table, write_table

pytestmark = pytest.mark.slow  # research code

CELL_M = 0.1


def outcome(size, draw=0, *, loss_db=0.0, shift_m=0.0, phase_rad=0.0, expected_loss_db=0.0, flags="", cause="height"):
    return ErrorAtlasRow(
        cause, "cm", size, draw, "a-a", loss_db, shift_m, phase_rad, 0.0, CELL_M, expected_loss_db, 0.0, 0.0, flags
    )  # fmt: skip


def swept_rows(monkeypatch, name, *sizes, draws=1):
    monkeypatch.setattr(outcomes, "CAUSES", {name: replace(CAUSES[name], sizes=sizes, draws=draws)})
    return list(STUDY.rows(name))


def test_track_noise_of_2_cm_is_flagged_and_negligible_noise_is_not(monkeypatch):
    small, large = swept_rows(monkeypatch, "track_noise", 1e-3, 2.0)
    assert small.flags == ""
    assert small.loss_db < 0.1
    assert "defocused" in large.flags
    assert large.loss_db > 2


def test_budget_predicts_the_loss_of_track_noise(monkeypatch):
    rows = swept_rows(monkeypatch, "track_noise", 1.0, 2.0, draws=8)
    for size in (1.0, 2.0):
        rows_of_size = [row for row in rows if row.size == size]
        expected, measured = (
            np.mean([getattr(row, name) for row in rows_of_size]) for name in ("expected_loss_db", "loss_db")
        )
        assert expected == pytest.approx(measured, rel=0.3)


def test_path_offset_of_a_pair_changes_its_phase_as_predicted(monkeypatch):
    small, large = swept_rows(monkeypatch, "calibration", 0.3, 6.0)
    assert small.phase_rad == pytest.approx(small.expected_phase_rad, abs=0.03)
    assert large.phase_rad == pytest.approx(large.expected_phase_rad, rel=0.1)
    assert (small.flags, "pairs_out_of_phase" in large.flags) == ("", True)


def test_refused_case_counts_as_neither_harmful_nor_harmless(monkeypatch):
    (row,) = swept_rows(monkeypatch, "presum", 64)
    assert row.flags == "refused"
    assert np.isnan(row.loss_db)
    summary = summary_of([row])
    assert (summary.wrong, summary.right) == (0, 0)


@pytest.mark.parametrize("name", sorted(CAUSES.keys() - {"track_noise_time"}))  # never negligible
def test_assumed_geometry_at_negligible_error_is_the_true_one(name):
    """Positions agree within 1 cm: logs have noise, and a time tag that is 1 ms late displaces a node by 1 mm."""
    cause = CAUSES[name]
    steps = np.diff(cause.sizes)
    assert (steps > 0).all() or (steps < 0).all()
    simulated = cause.flight()
    assumed = cause.assume(simulated, cause.sizes[0], np.random.default_rng(0))
    tolerance_m = 0.04 if name == "association" else 0.01  # one pulse interval corresponds to 3.3 cm of flight
    for pair in PAIRS:
        for leg, true in zip(assumed.apertures[pair].legs, simulated.truth.apertures[pair].legs, strict=True):
            assert np.abs(leg - true).max() < tolerance_m
    effects = [cause.expect(simulated, pair, cause.sizes[0]) for pair in PAIRS]
    assert min(effect.loss_db for effect in effects) > -0.1


def test_receiver_flies_ahead_of_the_transmitter():
    apertures = flight().apertures()
    assert np.abs(apertures["a-a"].tx_m - apertures["a-a"].rx_m).max() == 0
    ahead = (apertures["a-b"].rx_m - apertures["a-b"].tx_m).mean(axis=0)
    assert ahead == pytest.approx([4.7, 0, 0], abs=0.1)


SWEEP = [
    outcome(1.0, loss_db=0.01, expected_loss_db=0.01),
    outcome(1.0, 1, loss_db=0.01, expected_loss_db=0.01, flags="defocused"),
    outcome(10.0, loss_db=0.4, expected_loss_db=0.3),
    outcome(10.0, 1, loss_db=0.4, expected_loss_db=0.3),
    outcome(100.0, loss_db=3.0, expected_loss_db=1.5),
    outcome(100.0, 1, loss_db=5.0, expected_loss_db=2.5, flags="defocused pairs_displaced"),
    outcome(1000.0, shift_m=0.06, flags="pairs_displaced"),
    outcome(1000.0, 1, shift_m=0.06, flags="pairs_displaced"),
]


def test_summary_counts_missed_and_false_alarms():
    row = summary_of(SWEEP)
    assert row.size_at_1_db == pytest.approx(10 * 10 ** (0.6 / 3.6), rel=1e-3)
    assert row.expected_at_1_db == pytest.approx(10 * 10 ** (0.7 / 1.7), rel=1e-3)
    assert (row.size_of_harm, row.size_of_flag) == (100.0, 1000.0)
    assert (row.expected_over_measured, row.ratio_of) == (0.5, "loss")
    assert (row.wrong, row.missed) == (4, 0.25)  # more than 1 dB, or half a cell
    assert (row.right, row.false) == (2, 0.5)  # 0.4 dB counts as neither
    assert row.flags == "defocused pairs_displaced"


def test_alarms_of_a_flag_are_counted_over_its_causes():
    other = [outcome(1.0, loss_db=9.0, cause="prf"), outcome(2.0, cause="prf")]
    rows = {row.flag: row for row in alarms([*SWEEP, *other])}
    assert rows["defocused"].wrong == 4
    assert rows["defocused"].missed == 0.75
    assert rows["defocused"].unflagged == 0.25
    assert (rows["defocused"].right, rows["defocused"].false) == (3, pytest.approx(1 / 3, rel=1e-3))
    assert (rows["pairs_displaced"].missed, rows["pairs_displaced"].false) == (0.25, 0.0)


def test_plots_are_reproducible(tmp_path):
    for name in CAUSES:
        rows = [replace(row, cause=name) for row in SWEEP] + [outcome(2000.0, loss_db=np.nan, flags="refused")]
        write_table(part_path(tmp_path, name), rows, digits=6)
    for run in ("a", "b"):
        for path in STUDY.summary(tmp_path):
            path.rename(tmp_path / f"{run}_{path.name}")
    with (tmp_path / "a_summary.csv").open(encoding="utf-8") as table:
        assert [row["cause"] for row in csv.DictReader(table)] == list(CAUSES)
    rows = read_table(part_path(tmp_path, "arm"), ErrorAtlasRow)
    for run in ("a", "b"):
        draw_cause("arm", rows, tmp_path / f"{run}_arm.png")
    for name in ("summary.png", "flags.csv", "arm.png"):
        assert (tmp_path / f"a_{name}").read_bytes() == (tmp_path / f"b_{name}").read_bytes()


@pytest.mark.parametrize("command", ["sweep", "chart"])
def test_unknown_cause_is_refused_with_the_list_of_causes(command):
    error = CliRunner().invoke(commands.app, [command, "error_atlas", "x"]).exception
    assert isinstance(error, CampaignError)
    assert "track_noise" in str(error)
