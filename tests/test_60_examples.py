"""Campaigns of examples/ with measured data: alignment, image formation and target positions."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from folders import complaint

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.optitrack import read_optitrack
from apertura.run.process import process
from apertura.tools.align import align, write_clock
from apertura.views.score import score

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def rail_pass(shared, tmp_path):
    root = tmp_path / "rail_pass"
    shutil.copytree(EXAMPLES / "rail_pass", root)
    folder = root / "raw" / "passA"
    folder.mkdir(parents=True)
    shutil.copyfile(shared / "bwsi_rail_passA" / "July23_03.out", folder / "radar.out")
    shutil.copyfile(shared / "bwsi_rail_passA" / "Rail SAR 2.csv", folder / "radar.track.csv")
    return root


def reflector(root):
    options = LogOptions(body="Corner Reflector", start_utc="2023-07-23")
    track = read_optitrack(root / "raw/passA/radar.track.csv", node="radar", options=options)
    return np.median(track.position.values, axis=0)


def response(root, point):
    """Return position error (m), level above the image median (dB) and -3 dB widths (m) of the reflector."""
    image = abs(open_stage(Campaign.load(root).stage("image", "passA", "radar-radar"), "image").image)
    near = image.where((abs(image.x - point[0]) < 0.3) & (abs(image.y - point[1]) < 0.3), 0.0).values
    row, column = np.unravel_index(near.argmax(), near.shape)
    values, peak = image.values, near.max()
    off_m = float(np.hypot(image.x[column] - point[0], image.y[row] - point[1]))
    widths_m = [width(cut, at) * 0.02 for cut, at in ((values[row], column), (values[:, column], row))]
    return off_m, 20 * np.log10(peak / np.nanmedian(values)), widths_m


def width(cut, peak):
    """Return the width between the -3 dB points of a peak in samples."""
    threshold = cut[peak] / np.sqrt(2)
    left = peak - int((cut[peak::-1] < threshold).argmax())
    right = peak + int((cut[peak:] < threshold).argmax())
    inner = (
        (threshold - cut[left]) / (cut[left + 1] - cut[left]),
        (threshold - cut[right]) / (cut[right - 1] - cut[right]),
    )
    return right - left - sum(inner)


@pytest.mark.slow
def test_rail_pass_alignment_agrees_with_its_config(rail_pass):
    campaign = Campaign.load(rail_pass)
    alignment, stated = align(campaign, "passA", "radar", point=tuple(reflector(rail_pass)))
    assert not alignment.flags
    assert alignment.offset_s == pytest.approx(4.4535, abs=1e-3)
    assert float(stated["offset_s"]) == pytest.approx(campaign.clock("passA", "radar").offset_ns * 1e-9, abs=1e-3)
    assert stated["path_offset_m"] == pytest.approx(campaign.settings.nodes["radar"].path_offset_m.radar, abs=2e-3)


@pytest.mark.slow
def test_alignment_with_fixed_path_offset_estimates_the_clock(rail_pass):
    """This is the case of another pass of the same radar."""
    (rail_pass / "config/clocks.tsv").unlink()
    campaign = Campaign.load(rail_pass)
    alignment, stated = align(campaign, "passA", "radar", point=tuple(reflector(rail_pass)), search_m=0.0)
    write_clock(campaign, "passA", "radar", offset_s=stated["offset_s"], std_s=alignment.offset_width_s)
    written, expected_s = Campaign.load(rail_pass).clock("passA", "radar"), 1563913933.0905
    assert written.offset_ns * 1e-9 == pytest.approx(expected_s, abs=2e-3)
    assert written.std_s == pytest.approx(alignment.offset_width_s, abs=1e-6)
    assert stated["path_offset_m"] == 3.8194


@pytest.mark.slow
def test_reflector_of_the_rail_pass_is_imaged_at_its_position(rail_pass):
    assert problems(rail_pass) == []
    process(rail_pass, last="cube")
    off_m, above_db, (across_m, along_m) = response(rail_pass, reflector(rail_pass))
    assert off_m < 0.02
    assert above_db > 20
    assert across_m < 0.15
    assert along_m < 0.10


def test_drift_estimation_without_a_reflector_is_refused(rail_pass):
    message = complaint(lambda: align(Campaign.load(rail_pass), "passA", "radar", drift=True))
    assert "--point" in message


@pytest.mark.slow
def test_rail_pass_is_aligned_by_image_sharpness_within_10_cm(rail_pass):
    (rail_pass / "config/clocks.tsv").unlink()
    campaign = Campaign.load(rail_pass)
    alignment, stated = align(campaign, "passA", "radar", search_m=4.0)
    write_clock(campaign, "passA", "radar", offset_s=stated["offset_s"], std_s=alignment.offset_width_s)
    config = rail_pass / "config/config.yaml"
    config.write_text(config.read_text().replace("radar: 3.8194", f"radar: {stated['path_offset_m']:.4f}"))
    process(rail_pass, last="cube")
    assert response(rail_pass, reflector(rail_pass))[0] < 0.10


@pytest.mark.slow
def test_targets_of_a_real_px4_trajectory_are_within_a_centimetre(shared, tmp_path):
    runpy.run_path(str(EXAMPLES / "px4_flight" / "replay.py"))["replay"](
        shared / "px4_real_flight" / "esc_status_log.ulg", tmp_path / "replayed"
    )
    assert problems(tmp_path / "replayed") == []
    process(tmp_path / "replayed")
    findings = [row for row in score(Campaign.load(tmp_path / "replayed")) if row.image == "uav1-uav1"]
    assert len(findings) == 3
    assert max(row.error_m for row in findings) < 0.01


@pytest.mark.slow
def test_gotcha_example_has_no_problems(shared, tmp_path):
    root = tmp_path / "gotcha"
    shutil.copytree(EXAMPLES / "gotcha", root)
    folder = root / "raw" / "pass1"
    folder.mkdir(parents=True)
    for file in (shared / "gotcha_afrl").glob("*.mat"):
        shutil.copyfile(file, folder / f"aircraft.{file.name}")
    assert problems(root) == []
