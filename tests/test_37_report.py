"""Plots and text of the report: content, escaping of untrusted text, and reproducibility."""

import io
from pathlib import Path

import numpy as np
import pytest
from docutils.core import publish_parts
from matplotlib.figure import Figure
from matplotlib.image import imread

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.views.report.cuts_and_profiles import (
    DrawnCut,
    Measured,
    draw_budget,
    draw_cuts,
    draw_phase,
    sidelink_error_rad,
    steadiness,
)
from apertura.views.report.geometry_and_pulses import (
    FlownGeometry,
    PulseRecord,
    Waterfall,
    draw_geometry,
    draw_pulses,
    draw_waterfall,
)
from apertura.views.report.page import Heading, Paragraph, Picture, Table, page, rst_table, rst_text
from apertura.views.report.pictures import draw_panels

HOSTILE = """`a <javascript:alert(1)>`_ |b| *c* {{ 7 * 7 }} <script>alert("1")</script> $\\frac{x$ ../../etc &amp; it's
.. raw:: html

   <img src=x onerror=alert(1)>
"""
TAGS = {"APERTURA_VERSION": "0", "hostile": HOSTILE}
SHARED = {"title": "flight f01, a-b", "tags": TAGS}
TIME_S = np.arange(200) / 20.0


def geometry(path):
    track = np.stack([691500 + TIME_S, np.full(200, 5333000.0), 650 + np.sin(TIME_S)], -1)
    receiver = track + [3.0, 2.0, 1.0]
    scene = 691500.0, 5333010.0, 691520.0, 5333030.0
    ring = np.array([[691501.0, 5333012.0], [691515, 5333012], [691515, 5333028], [691501.0, 5333012.0]])
    target = np.array([691510.0, 5333020.0, 620.0])
    tracks = {"transmitter": track, "receiver": receiver}
    draw_geometry(path, FlownGeometry(TIME_S, tracks, scene, 620.0, target, [ring], "WGS 84 / UTM zone 32N"), **SHARED)


def pulses(path):
    kept = np.arange(200) % 17 != 0
    snr = np.where(np.arange(200) == 5, np.nan, 20 + np.sin(TIME_S))[kept]
    reasons = {"unpaired": 9, "sidelink_lost": 2, "time_tag_outlier": 1}
    draw_pulses(path, PulseRecord(TIME_S, kept, reasons, TIME_S[kept], snr, snr), **SHARED)


def phase(path):
    noise = np.random.default_rng(1).normal(size=200)
    phasors = {"before": np.exp(9j * noise), "after": np.exp(0.1j * noise), "refined": np.ones(200, complex)}
    draw_phase(path, TIME_S, phasors, **SHARED)


def cuts(path):
    along = np.linspace(-1.5, 1.5, 601)
    cut = DrawnCut("cross-range", along, np.sinc(along / 0.2) ** 2, 0.177, -13.3, -10.0)
    draw_cuts(path, [cut, DrawnCut("ground range", along, np.ones(601), np.nan, np.nan, np.nan)], **SHARED)


def waterfall(path):
    profiles = Waterfall(np.linspace(100, 120, 200), 0.4, 60)
    profiles.add(0, np.ones((200, 60), np.complex64))
    draw_waterfall(path, profiles, TIME_S, np.linspace(110, 130, 200), **SHARED)


def panels(path):
    power = np.outer(np.hanning(60), np.hanning(90)) ** 8
    powers = {
        "uav1-uav1": power,
        "uav1-uav2": power,
        "coherent sum": power,
        "noncoherent sum": np.full((60, 90), np.nan),
    }
    draw_panels(path, powers, size_m=(9.0, 6.0), target_m=(4.5, 3.0), **SHARED)


def budget(path):
    lines = [
        {"cause": "positions", "stated": "1 cm", "loss_db": -0.2, "shift_m": 0.01, "phase_rad": 0.1},
        {
            "cause": "between epochs",
            "stated": "not configured; effect computed for 1 m",
            "loss_db": -3.0,
            "shift_m": 5.0,
            "phase_rad": None,
        },
        {"cause": "clock", "stated": "0", "loss_db": 0.0, "shift_m": 0.0, "phase_rad": 0.0},
    ]
    draw_budget(path, lines, Measured(-0.3, 0.1, -0.2), **SHARED)


DRAWN = (geometry, pulses, phase, cuts, waterfall, panels, budget)


@pytest.mark.slow
@pytest.mark.parametrize("draw", DRAWN, ids=lambda draw: draw.__name__)
def test_plot_has_page_width_clips_nothing_and_is_reproducible(draw, tmp_path):
    draw(tmp_path / "first.png")
    draw(tmp_path / "second.png")
    data = (tmp_path / "first.png").read_bytes()
    assert data == (tmp_path / "second.png").read_bytes()
    drawn = imread(io.BytesIO(data), format="png")[..., :3]
    assert drawn.shape[1] / 220 == pytest.approx(6.7, abs=0.01)  # inches between the margins of A4
    edge = np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]])
    assert (edge == 1).all()  # clipped content would change the colour of the edge
    assert (drawn < 0.5).any()


def figure_of(draw, path, monkeypatch):
    """Return the drawn figure without writing a file."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: figures.append(self) or Path(path).write_bytes(b""))
    draw(path)
    return figures[0]


def test_budget_legend_shows_each_kind_of_bar(monkeypatch, tmp_path):
    """The legend also shows a kind of bar that is absent from the first of the three panels."""
    stated = [{"cause": "positions", "stated": "1 cm", "loss_db": -0.2, "shift_m": 0.01, "phase_rad": 0.1}]
    (legend,) = figure_of(
        lambda path: draw_budget(path, stated, Measured(), **SHARED), tmp_path / "first.png", monkeypatch
    ).legends
    counted, left_out = legend.legend_handles
    assert (counted.get_hatch(), left_out.get_hatch()) == (None, "/////")
    assert counted.get_facecolor() != left_out.get_facecolor()


@pytest.mark.parametrize(
    ("counted", "labels"),
    [
        (True, ["pulses per 2 transmitted", "pulses since the first transmitted pulse (no times recorded)"]),
        (False, ["pulses per 2 s", "time since the first transmitted pulse, s"]),
    ],
)
def test_pulses_without_times_are_counted_instead_of_drawn_over_time(counted, labels, monkeypatch, tmp_path):
    index = np.arange(100.0)
    record = PulseRecord(index, index != 5, {"unpaired": 1}, index[index != 5], counted=counted)
    axes = figure_of(lambda path: draw_pulses(path, record, **SHARED), tmp_path / "first.png", monkeypatch).axes[0]
    assert axes.get_ylabel() == labels[0]
    assert axes.get_xlabel().startswith(labels[1])


def test_panels_of_a_local_frame_have_x_and_y_and_no_north_arrow(monkeypatch, tmp_path):
    power = {"a-a": np.eye(60)}

    def texts(local):
        scene = {"size_m": (9.0, 9.0), "target_m": (4.5, 3.0), "local": local, **SHARED}
        figure = figure_of(lambda path: draw_panels(path, power, **scene), tmp_path / f"{local}.png", monkeypatch)
        axes = figure.axes[0]
        return [axes.get_xlabel(), axes.get_ylabel(), *(text.get_text() for text in axes.texts)]

    assert texts(True) == ["x from the lower left corner, m", "y from the lower left corner, m", "2 m"]
    assert texts(False) == ["east from the lower left corner, m", "north from the lower left corner, m", "2 m", "", "N"]


def test_sidelink_correction_removes_clock_and_trigger_phase():
    generator, wavenumber = np.random.default_rng(3), 2 * np.pi * 1.3e9 / SPEED_OF_LIGHT_M_S
    phase_error, length_m = generator.uniform(-np.pi, np.pi, 500), 8 + generator.normal(size=500)
    sidelink = np.angle(np.exp(1j * (phase_error - wavenumber * length_m)))
    corrected = np.full(500, 2 - 1j)
    error = sidelink_error_rad(sidelink, length_m, wavenumber_rad_m=wavenumber)
    before = corrected * np.exp(1j * error)
    np.testing.assert_allclose(before, corrected * np.exp(1j * phase_error), atol=1e-9)
    assert steadiness(corrected) == pytest.approx((0.0, 1.0), abs=1e-6)
    assert steadiness(before)[0] > 1.5
    assert steadiness(before)[1] < 0.15


def test_waterfall_shows_a_path_at_its_length_for_any_profile_start():
    start = np.random.default_rng(5).uniform(50, 58, 90)
    profile_map = Waterfall(start, 0.5, 100)
    samples = (start[:, None] + 0.5 * np.arange(100) - 80.0) / 0.5  # samples from a path of 80 m
    for first in range(0, 90, 32):
        profile_map.add(first, np.sinc(samples[first : first + 32] / 2).astype(np.complex64))
    low, high = profile_map.span_m
    rows, columns = profile_map.mean.shape
    centres = low + (np.arange(rows) + 0.5) * (high - low) / rows
    brightest = centres[np.nanargmax(profile_map.mean, axis=0)]
    assert columns == 90
    assert np.abs(brightest - 80.0).max() < 0.8


def test_waterfall_of_a_long_flight_is_reduced_with_the_same_mean_power():
    start = np.full(3000, 10.0)
    profile_map = Waterfall(start, 0.1, 2000)
    for first in range(0, 3000, 500):
        profile_map.add(first, np.full((500, 2000), 3.0, np.complex64))
    assert profile_map.mean.shape == (667, 500)
    np.testing.assert_allclose(profile_map.mean[:-1], 9.0)


def test_untrusted_text_is_escaped_on_the_page():
    blocks = [Heading(1, HOSTILE), Paragraph(HOSTILE), Table(HOSTILE, [HOSTILE], [[HOSTILE]]), Picture(b"png", HOSTILE)]
    html = page(HOSTILE, blocks)
    assert html.count("<script") == html.count("onerror=alert(1)>") == 0
    assert html.count("<img") == html.count("<table>") == html.count("<h1>") == 1
    assert "default-src 'none'" in html
    assert 'alt="Figure 1. `a &lt;javascript' in html
    assert "&amp;amp; it&#39;s" in html


def test_untrusted_text_is_escaped_on_the_landing_page():
    text = f"{rst_text(HOSTILE)}\n\n{rst_table([HOSTILE], [[HOSTILE], ['']])}"
    body = publish_parts(text, writer="html")["body"]
    assert "<script" not in body
    assert "<img" not in body
    assert "<a " not in body
    assert "system-message" not in body
    assert body.count("{{ 7 * 7 }}") == 3
    assert body.count(".. raw:: html &lt;img src=x onerror=alert(1)&gt;") == 3
