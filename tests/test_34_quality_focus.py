"""Focus of an image: bright points, path errors, error budget and agreement between pairs."""

from dataclasses import replace

import numpy as np
import pytest

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flag_table import FLAGS
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.focus_check import focus_flags
from apertura.core.quality.agreement import agreement
from apertura.core.quality.bright_points import BrightPoint, PointResponse, bright_points, common_shift
from apertura.core.quality.budget import (
    BudgetLine,
    NodeAttitude,
    NodePositions,
    accuracy_for,
    antenna_flags,
    antenna_line,
    attitude_lines,
    expected,
    height_line,
    is_counted,
    is_stated,
    position_lines,
    strictest_accuracy_db,
)
from apertura.core.quality.focus import (
    GEOMETRY_CONTRADICTED,
    PointFocus,
    band_focus,
    compare_parts,
    focus_with_flags,
    judge,
    judge_parts,
    point_focus,
)
from apertura.core.quality.path_errors import Effect, PointPaths

PULSES, WAVELENGTH_M = 600, 0.214


def moving_average_noise(generator, count, width):
    """Draw white noise filtered by a moving average, standard deviation 1."""
    return np.convolve(generator.standard_normal(count + width - 1), np.ones(width) / np.sqrt(width), "valid")


def complex_noise(generator, count):
    return (generator.standard_normal(count) + 1j * generator.standard_normal(count)) / np.sqrt(2)


def straight(length_m=30.0, *, separation_m=0.0):
    along = np.linspace(-length_m / 2, length_m / 2, PULSES)
    track = np.stack([along, np.full(PULSES, -12.0), np.full(PULSES, 8.0)], -1)
    baseline_m = np.array([separation_m, 0, 0])
    return PointPaths.of(
        Aperture(track - baseline_m / 2, track + baseline_m / 2),
        np.linspace(0, 30, PULSES),
        point_m=np.zeros(3),
        axes=np.eye(3),
        wavelength_m=WAVELENGTH_M,
    )


@pytest.mark.parametrize("noise_db", [-30.0, -10.0, -5.0])
@pytest.mark.parametrize("rms_rad", [0.0, 0.5, 1.0])
def test_peak_loss_is_measured_despite_noise_and_neighbours(noise_db, rms_rad):
    generator = np.random.default_rng(1)
    phase = rms_rad * moving_average_noise(generator, PULSES, 60)
    taper = np.linspace(0.6, 1.0, PULSES)
    contributions = taper * np.exp(1j * phase)
    along = np.fft.fft(contributions, 8 * PULSES)
    true_db = 20 * np.log10(np.abs(along).max() / taper.sum())
    neighbour = 0.2 * np.exp(2j * np.pi * 47.3 * np.arange(PULSES) / PULSES)
    focus = point_focus(contributions + neighbour + 10 ** (noise_db / 20) * complex_noise(generator, PULSES))
    hidden = 0.15 if focus.pulses > 1 else 0.05  # longer blocks hide more phase variation inside a block
    assert focus.loss_db == pytest.approx(true_db, abs=0.15 + hidden * abs(true_db))


def test_noise_and_speckle_are_no_evidence_of_focus():
    generator = np.random.default_rng(2)
    assert not any(point_focus(complex_noise(generator, 512)) for _ in range(200))
    scatterers = np.exp(2j * np.pi * np.outer(generator.uniform(-100, 100, 40), np.arange(512) / 512))
    assert point_focus((scatterers * complex_noise(generator, 40)[:, None]).sum(axis=0)) is None


def test_snr_of_a_point_follows_from_its_even_and_odd_pulses():
    generator = np.random.default_rng(3)
    focus = point_focus(1 + 0.1 * complex_noise(generator, 4096))
    assert focus.snr_db == pytest.approx(20 + 10 * np.log10(4096), abs=0.5)


@pytest.mark.parametrize(("cycles", "evidence"), [(0.4, True), (1.5, False), (6.5, False)])
def test_sidelobe_of_a_distant_echo_is_no_evidence_of_focus(cycles, evidence):
    """The contributions have constant amplitude and a phase ramp; they are in phase at another point."""
    assert (point_focus(np.exp(2j * np.pi * cycles * np.arange(400) / 400)) is not None) == evidence


def test_single_point_does_not_decide_the_verdict():
    generator = np.random.default_rng(4)
    sharp = point_focus(np.ones(200, complex))
    blurred = point_focus(np.exp(2j * moving_average_noise(generator, 200, 20)))
    assert judge([(1.0, sharp), (0.9, sharp), (0.3, blurred)]).verdict == "focused"
    assert judge([(1.0, blurred), (0.9, blurred), (0.3, sharp)]).verdict == "defocused"


@pytest.mark.parametrize(
    ("losses_db", "verdict"),
    [((-0.3, -0.5), "focused"), ((-0.6, -6.0), "inconclusive"), ((-4.0, -4.2), "defocused"), ((-1.0,), "inconclusive")],
)
def test_loss_interval_that_includes_1_db_gives_no_verdict(losses_db, verdict):
    assert judge([(1.0, PointFocus(loss_db, 0.01, 1, 30.0)) for loss_db in losses_db]).verdict == verdict


@pytest.mark.parametrize("flag", sorted(GEOMETRY_CONTRADICTED))
def test_flag_that_contradicts_the_geometry_prevents_verdict_focused(flag):
    focus = {"verdict": "focused", "reason": "3 bright points lost 0.02 dB", "loss_db": -0.02}
    assert flag in FLAGS
    assert focus_with_flags(focus, ["hover", flag])["verdict"] == "inconclusive"
    assert focus_with_flags(focus, ["hover", flag])["reason"].endswith(f"contradicted by {flag}")
    assert focus_with_flags(focus | {"verdict": "defocused"}, [flag])["verdict"] == "defocused"
    assert focus_with_flags(focus, ["hover", "track_gap"]) == focus


@pytest.mark.parametrize(("error_db", "verdict"), [(-10.0, "inconclusive"), (-40.0, "focused"), (None, "focused")])
def test_large_numerical_error_prevents_verdict_focused(error_db, verdict):
    focus = {"verdict": "focused", "reason": "3 bright points lost 0.02 dB"}
    assert focus_with_flags(focus, ["accuracy_not_met"], error_db=error_db)["verdict"] == verdict


@pytest.mark.parametrize("std_cm", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("separation_m", [0.0, 4.7])
def test_predicted_loss_of_random_errors_equals_monte_carlo_mean(std_cm, separation_m):
    """The mean over 60 draws of both tracks, with the best peak within a few cells, agrees within 15 % in dB."""
    paths, generator = straight(separation_m=separation_m), np.random.default_rng(5)
    same = separation_m == 0
    slopes = paths.by_node(same=same, sidelink=not same)
    count, step = len(paths.time_s), 30 / (len(paths.time_s) - 1)
    losses = []
    for _ in range(60):
        error = np.zeros(count)
        for slope in slopes:
            drawn = np.stack([moving_average_noise(generator, count, round(1 / step)) for _ in range(3)], -1)
            error += (slope * 0.01 * std_cm * drawn).sum(axis=1)
        along = np.abs(np.fft.fft(np.exp(2j * np.pi / WAVELENGTH_M * error), 8 * count)) / count
        losses.append(20 * np.log10(np.r_[along[:24], along[-24:]].max()))
    nodes = [NodePositions((0.01 * std_cm,) * 3, 1.0, "test")] * len(slopes)
    predicted = position_lines(paths, nodes, sidelink=not same)[0].effect.loss_db
    assert predicted == pytest.approx(np.mean(losses), rel=0.15, abs=0.05)


def test_errors_along_the_sidelink_cancel_for_a_target_on_its_line():
    paths = straight(separation_m=4.7)
    far = PointPaths(paths.aperture, paths.time_s, np.array([500.0, -12.0, 8.0]), paths.axes, WAVELENGTH_M)
    by_tx, by_rx = far.by_node(same=False, sidelink=True)
    np.testing.assert_allclose(by_tx[:, 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(by_rx[:, 0], -2.0, atol=1e-3)


def test_height_error_displaces_a_point_with_little_loss():
    higher = straight().of_offset(-straight().gradient[:, 2], common=True)
    assert higher.shift_m == pytest.approx(8 / 12, rel=0.1)
    assert higher.loss_db > -0.5


def bent(radius_m=12.0, offset_m=6.0):
    """Return the paths of a circular flight about a centre displaced from the point, with varying elevation angle."""
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    track = np.stack([offset_m + radius_m * np.sin(angle), radius_m * np.cos(angle), np.full(300, 8.0)], -1)
    return replace(straight(), aperture=Aperture(track, track), time_s=np.linspace(0, 30, 300))


@pytest.mark.parametrize("separation_m", [0.0, 4.7])
def test_height_error_is_not_observable_on_a_straight_track(separation_m):
    """Path lengths from a line depend only on the distance from it, so that eq. 2a is exact, for one and two nodes."""
    paths = straight(separation_m=separation_m)
    line = height_line(paths, None)
    assert line.counts
    assert not is_stated(line.report)
    assert line.effect.loss_db == 0.0
    assert line.effect.shift_m == pytest.approx(3.0 * 8 / 12, rel=0.05)
    raised = np.array([[0.0, np.sqrt(12.0**2 + 8.0**2 - 6.5**2) - 12.0, 1.5]])  # same distance from the track
    assert np.abs(paths.aperture.path(raised) - paths.aperture.path(np.zeros((1, 3)))).max() < 1e-9


def test_height_error_on_a_curved_track_is_limited_by_its_loss():
    paths = bent()
    line = height_line(paths, None)
    assumed_m = float(line.report["stated"].split("assumed ")[1].split(" m")[0])
    assert assumed_m < 0.1
    losses_db = [paths.of_offset(-paths.gradient[:, 2] * h).loss_db for h in (assumed_m, 3 * assumed_m)]
    assert losses_db[0] == pytest.approx(-0.2, abs=0.03)
    assert losses_db[1] < -1.5
    assert line.effect.shift_m < 0.1


def test_assumed_height_error_grows_with_the_loss_of_other_causes():
    paths = bent()
    alone, with_others = (height_line(paths, None, expected_db=loss_db).effect.shift_m for loss_db in (0.0, -1.0))
    assert with_others / alone == pytest.approx(np.sqrt(1.2 / 0.2), rel=1e-3)


def test_configured_height_accuracy_is_used():
    paths = straight()
    line = height_line(paths, 0.3)
    assert line.stated == "0.3 m"
    assert line.effect.shift_m == pytest.approx(0.3 * 8 / 12, rel=0.05)


def test_constant_path_error_offsets_the_phase():
    paths = straight()
    effect = paths.of_offset(np.full(len(paths.time_s), 0.05))
    assert effect.phase_rad == pytest.approx(2 * np.pi * 0.05 / WAVELENGTH_M)


def test_unconfigured_position_accuracy_follows_from_the_receiver_solution():
    """The effect is that of a configured accuracy, except on automatic accuracy; a float solution has larger errors."""
    paths = straight()
    (fixed,) = position_lines(paths, [NodePositions(None, 1.0, receiver="fix")], sidelink=False)
    (configured,) = position_lines(paths, [NodePositions((0.01,) * 3, 1.0, "config")], sidelink=False)
    (floating,) = position_lines(paths, [NodePositions(None, 1.0, receiver="float")], sidelink=False)
    (unknown,) = position_lines(paths, [NodePositions(None)], sidelink=False)
    assert expected([fixed]) == expected([configured]) == configured.effect
    assert floating.effect.loss_db < 3 * fixed.effect.loss_db < -2
    assert expected([unknown]).loss_db == 0
    assert is_counted(fixed.report)
    assert not is_stated(fixed.report)
    assert not is_counted(unknown.report)
    assert accuracy_for([fixed]) == -60.0


def test_predicted_scatter_of_the_loss_equals_monte_carlo_scatter():
    """The scatter is the standard deviation of the loss over 200 draws with 5 mm per axis."""
    paths, generator = straight(), np.random.default_rng(8)
    (slope,), count, losses = paths.by_node(same=True, sidelink=False), len(paths.time_s), []
    gradient = paths.gradient[:, :2]
    for _ in range(200):
        drawn = np.stack([moving_average_noise(generator, count, round(count / 30)) for _ in range(3)], -1)
        error = (slope * 0.005 * drawn).sum(axis=1)
        residual = error - gradient @ np.linalg.pinv(gradient) @ error
        losses.append(20 * np.log10(abs(np.exp(2j * np.pi / WAVELENGTH_M * residual).mean())))
    effect = position_lines(paths, [NodePositions((0.005,) * 3)], sidelink=False)[0].effect
    assert effect.loss_std_db == pytest.approx(np.std(losses), rel=0.3)


@pytest.mark.parametrize(
    ("loss_db", "std_db", "expected", "raised"),
    [
        (-0.7, 0.05, Effect(-0.1, 0, 0, 0.05), True),  # significantly more than expected, but less than 1 dB
        (-0.7, 0.3, Effect(-0.1, 0, 0, 0.05), False),  # within three standard deviations of the measurement
        (-0.9, 0.05, Effect(-0.5, 0, 0, 0.2), False),  # within three standard deviations between flights
        (-0.15, 0.01, Effect(0.0, 0, 0, 0.0), False),  # below the measurable loss
    ],
)
def test_loss_beyond_expectation_is_flagged_also_below_1_db(loss_db, std_db, expected, raised):
    report = {"verdict": "focused", "reason": "points lost", "loss_db": loss_db, "std_db": std_db}
    assert ("loss_unexpected" in focus_flags(report, expected)) == raised
    bad = focus_flags(report | {"verdict": "defocused"}, expected)
    assert "defocused" in bad
    assert "loss_unexpected" not in bad


@pytest.mark.parametrize("changed", ["nothing", "sign", "one target moves"])
def test_points_with_unequal_focus_are_flagged(changed):
    """Five points over 24 m, phases referred to their centre: the opposite sign mirrors their positions (eq. 1″)."""
    frequency, pulses = 2.4e9 + 400e6 * (np.arange(128) / 128 - 0.5), 240
    antenna = np.stack([np.linspace(-6, 6, pulses), np.full(pulses, -40.0), np.full(pulses, 22.0)], -1)
    places = np.array([[0.0, 0, 0], [11.9, 12, 0], [9.1, -6, 0], [-8.4, -12, 0], [-11.2, 5.7, 0]])
    reference_s = 2 * np.linalg.norm(antenna, axis=1) / SPEED_OF_LIGHT_M_S
    noise = np.random.default_rng(1).normal(size=(pulses, 128, 2)) @ (0.1, 0.1j)
    transfer = noise.astype(np.complex64)
    for number, place in enumerate(places):
        moved_m = np.linspace(-1, 1, pulses) ** 2 * 0.04 if number == 3 and changed == "one target moves" else 0.0
        delay_s = 2 * (np.linalg.norm(antenna - place, axis=1) + moved_m) / SPEED_OF_LIGHT_M_S - reference_s
        transfer += np.exp(-2j * np.pi * np.outer(delay_s, frequency))
    transfer = transfer.conj() if changed == "sign" else transfer
    flown, weight = ap.Aperture(antenna, antenna), np.full(128, 1 / 128)
    history = ap.PhaseHistory(transfer, frequency, weight, reference_s, flown)
    image = ap.backproject(history, ap.SceneGrid("local", -18.0, 18.0, 0.12, (300, 300)))
    flags = ap.judge(image).flags
    assert ("focus_uneven" in flags) == (changed != "nothing")
    if changed == "one target moves":
        assert "1 of 5 bright points" in flags["focus_uneven"]
        assert "at (-8." in flags["focus_uneven"]


# Focus in range

BAND = np.linspace(-1, 1, 256)
HANN = np.hanning(258)[1:-1]


def at_its_peak(spectrum):
    """Remove the delay of the brightest peak, at which an image is evaluated."""
    response = np.fft.fft(spectrum * HANN, 32 * len(spectrum))
    return spectrum * np.exp(-2j * np.pi * np.abs(response).argmax() / len(response) * np.arange(len(spectrum)))


@pytest.mark.parametrize(("rate_error", "verdict"), [(0.0, "focused"), (0.015, "focused"), (-0.025, "defocused")])
def test_loss_by_a_wrong_chirp_rate_follows_from_its_quadratic_phase(rate_error, verdict):
    """The time-bandwidth product is 200, as for 200 MHz in 1 µs; the SNR per subcarrier is 20 dB."""
    phase_rad = np.pi * 200 * rate_error / 4
    noise = 0.1 * complex_noise(np.random.default_rng(1), 256)
    focus = band_focus(at_its_peak(np.exp(1j * phase_rad * BAND**2) + noise), HANN)
    assert focus.phase_rad == pytest.approx(phase_rad, abs=0.1)
    assert focus.loss_db == pytest.approx(-0.104 * phase_rad**2, abs=0.12)
    assert judge([(1.0, focus)]).verdict == verdict


@pytest.mark.parametrize(("phase_rad", "verdict"), [(2.0, "focused"), (9.0, "defocused")])
def test_cubic_phase_over_frequency_is_measured(phase_rad, verdict):
    spectrum = at_its_peak(np.exp(1j * phase_rad * BAND**3))
    true_db = 20 * np.log10(np.abs(np.fft.fft(spectrum * HANN, 8192)).max() / HANN.sum())
    focus = band_focus(spectrum, HANN)
    assert focus.loss_db == pytest.approx(true_db, abs=0.1)
    assert judge([(1.0, focus)]).verdict == verdict


def range_defocused(generator, spectrum_of, scenes):
    measured = [band_focus(at_its_peak(spectrum_of(generator)), HANN) for _ in range(scenes)]
    return sum(judge([(1.0, focus)]).verdict == "defocused" for focus in measured)


def two_points(generator):
    phase = generator.uniform(0, 2 * np.pi) + np.pi * generator.uniform(0.3, 8) * BAND
    return 1 + generator.uniform(0.2, 1) * np.exp(1j * phase)


def extended_target(generator):
    delays = generator.uniform(-0.5, 0.5, 40) * generator.uniform(1, 6)
    return complex_noise(generator, 40) @ np.exp(1j * np.pi * np.outer(delays, BAND))


@pytest.mark.parametrize(("spectrum_of", "most"), [(two_points, 0), (extended_target, 3)])
def test_neighbours_in_range_and_extended_targets_are_not_range_defocus(spectrum_of, most):
    """Neighbours change the amplitudes of a spectrum, phase errors do not."""
    assert range_defocused(np.random.default_rng(5), spectrum_of, 200) <= most


@pytest.mark.parametrize("noise", [0.1, 0.5, 2.0])
def test_noise_is_not_range_defocus(noise):
    assert not range_defocused(np.random.default_rng(6), lambda rng: 1 + noise * complex_noise(rng, 256), 200)
    assert not range_defocused(np.random.default_rng(7), lambda rng: complex_noise(rng, 256), 50)


def test_range_defocus_is_flagged_unless_phases_along_the_track_explain_the_loss():
    measured = {"verdict": "defocused", "loss_db": -1.5, "std_db": 0.1, "phase_rad": 3.9, "points": 2}
    report = {"verdict": "focused", "reason": "points lost", "loss_db": -0.02, "std_db": 0.02, "range": measured}
    line = focus_flags(report, Effect(0, 0, 0, 0))["range_defocused"]
    assert line.startswith("peak loss 1.5 ± 0.1 dB from phase errors over frequency, 2 bright points; quadratic phase")
    assert "range_defocused" not in focus_flags(report | {"verdict": "defocused"}, Effect(0, 0, 0, 0))
    assert not focus_flags(report | {"range": measured | {"verdict": "focused"}}, Effect(0, 0, 0, 0))


def test_unconfigured_terms_are_not_summed_and_do_not_set_the_accuracy():
    unconfigured = BudgetLine("heights", None, Effect(-3.0, 1.0, 0.0), "1 m")
    configured = BudgetLine("positions", "1 cm", Effect(-0.0001, 0.02, 0.1))
    assert expected([unconfigured, configured]) == configured.effect
    assert accuracy_for([unconfigured]) == -60.0
    assert accuracy_for([unconfigured, configured]) == pytest.approx(-56.4, abs=0.1)
    assert accuracy_for([BudgetLine("positions", "1 cm", Effect(-1.2, 0.1, 0.1))]) == -40.0


@pytest.mark.parametrize("loss_db", [0.0, -1e-7, -1e-4, -0.1, -3.0])
def test_echo_accuracy_suffices_for_every_automatic_image_accuracy(loss_db):
    """The clock correction is decided before the error budget that sets the automatic accuracy is available."""
    image_accuracy_db = accuracy_for([BudgetLine("positions", "stated", Effect(loss_db, 0.0, 0.0))])
    assert strictest_accuracy_db("auto") <= image_accuracy_db
    assert strictest_accuracy_db(-45.0) == -45.0


def lobes(points, *, phase_rad=0.0, carrier=1.1):
    y, x = np.mgrid[:256, :256]
    image = sum(np.sinc((y - row) / 4) * np.sinc((x - column) / 4) * amplitude for row, column, amplitude in points)
    return (image * np.exp(1j * (carrier * y + phase_rad))).astype(np.complex64)


def sinc_response(peak, others):
    """Return the magnitude of the response of a point of `lobes` at other pixels."""
    return np.abs(np.sinc((others - peak) / 4)).prod(axis=1)


POINTS = [(60.0, 70.0, 1.0), (150.3, 90.2, 0.8), (200.7, 190.1, 0.5)]
SHIFT_PX = (0.8, -0.6)
WIDE = np.diag([0.52, 0.52])  # square band with a width of 2.5 cycles per metre


@pytest.fixture
def two_images():
    displaced = [(row + SHIFT_PX[0], column + SHIFT_PX[1], amplitude) for row, column, amplitude in POINTS]
    images = lobes(POINTS), lobes(displaced, phase_rad=-1.2)
    whole = [(slice(0, 256), slice(0, 256))]
    points = [bright_points(image, whole, cell_px=8, shown=sinc_response) for image in images]
    return images, [found[:3] for found in points]


def test_bright_points_do_not_depend_on_windows_or_their_order():
    drawn = [*POINTS, (40.0, 200.0, 0.27), (220.0, 30.0, 0.24), (128.0, 16.0, 0.9)]  # last: on a window edge
    image = lobes(drawn)
    tiles = [
        (slice(row, row + 64), slice(column, column + 64)) for row in range(0, 256, 64) for column in range(0, 256, 64)
    ]
    found = [bright_points(image, windows, cell_px=8, shown=sinc_response) for windows in (tiles, tiles[::-1])]
    assert found[0] == found[1]
    whole = bright_points(image, [(slice(0, 256), slice(0, 256))], cell_px=8, shown=sinc_response)
    assert [(p.row, p.column) for p in found[0]] == [(p.row, p.column) for p in whole]
    assert sorted(round(p.amplitude, 2) for p in whole) == [0.27, 0.5, 0.8, 0.9, 1.0]  # 0.24 is 12.4 dB below the first


@pytest.mark.parametrize("rotations", range(4))
def test_skirt_of_a_point_does_not_hide_a_weaker_maximum_next_to_it(rotations):
    image = np.zeros((64, 64), np.complex64)
    image[20, 31:33], image[20, 36] = (1.0, 0.9), 0.5  # squares of 8 pixels start at 24 and 32
    image = np.rot90(image, rotations)
    found = bright_points(
        image, [(slice(0, 64), slice(0, 64))], cell_px=8, shown=lambda _, others: np.zeros(len(others))
    )
    assert len(found) == 2


def test_displacement_between_images_is_accurate_to_a_tenth_of_a_cell(two_images):
    images, points = two_images
    result = agreement(images, points, spacing_m=0.1, cell_m=0.4, spectrum=WIDE)
    assert result.points == 3
    assert (result.shift_east_m, result.shift_north_m) == pytest.approx((-0.06, -0.08), abs=0.004)
    assert result.phase_rad == pytest.approx(-1.2, abs=0.05)
    assert result.coherence > 0.99
    assert result.shifted
    assert result.out_of_phase


def test_image_agrees_with_itself(two_images):
    images, points = two_images
    result = agreement((images[0],) * 2, (points[0],) * 2, spacing_m=0.1, cell_m=0.4, spectrum=WIDE)
    assert result.shift_m == 0
    assert result.phase_rad == pytest.approx(0, abs=1e-12)
    assert not result.shifted
    assert not result.out_of_phase


def test_images_without_a_common_point_give_no_agreement(two_images):
    images, points = two_images
    far = [BrightPoint(points[0][0].row + 150, points[0][0].column + 150, 1.0)]
    assert agreement(images, (points[0][:1], far), spacing_m=0.1, cell_m=0.4, spectrum=WIDE) is None
    assert agreement(images, (points[0], []), spacing_m=0.1, cell_m=0.4, spectrum=WIDE) is None


def test_single_common_point_counts_only_if_brightest_in_both_or_alone(two_images):
    images, points = two_images
    geometry = {"spacing_m": 0.1, "cell_m": 0.4, "spectrum": WIDE}
    brightest = (points[0][:1], points[1])
    assert agreement(images, brightest, **geometry).points == 1
    second = (points[0][1:2], points[1])
    assert agreement(images, (points[0][:2], points[1][1:]), **geometry) is None
    assert agreement(images, second, **geometry) is None
    assert agreement(images, (points[0][:1], points[1][:1]), **(geometry | {"cell_m": 0.05})) is None
    alone = agreement(images, (points[0][1:2], points[1][1:2]), **geometry, alone=True)
    assert alone.points == 1


def test_common_shift_matches_the_largest_brightness():
    generator = np.random.default_rng(6)
    first = [(*generator.uniform(0, 50, 2), 1.0) for _ in range(6)]
    second = [(x + 2.5, y - 1.5, amplitude) for x, y, amplitude in first] + [(*generator.uniform(0, 50, 2), 0.4)]
    shift, matches = common_shift(first, second, reach=4.0, gate=0.3)
    assert shift == pytest.approx((2.5, -1.5))
    assert matches == [(number, number) for number in range(6)]


def coarse_range(pulses=512):
    """Return the response of a straight track at 100 m: resolution 1.3 m across and 6 m along the line of sight."""
    track = np.stack([np.linspace(-5, 5, pulses), np.full(pulses, -100.0), np.full(pulses, 0.0)], -1)
    along_m = 0.1 * np.arange(-600, 600)
    return PointResponse(Aperture(track, track), np.sinc(along_m / 12), 0.1, 0.26)


def test_point_response_follows_from_aperture_and_band():
    """Along range, the response is that of the band; across, it is sin(x)/x beyond the smearing tolerance."""
    response = coarse_range()
    behind = np.column_stack([np.zeros(50), np.linspace(0.5, 25, 50), np.zeros(50)])
    np.testing.assert_allclose(response.at(np.zeros(3), behind), np.abs(np.sinc(behind[:, 1] / 6)), atol=5e-3)
    cells = np.array([6.5, 7.5, 9.5])
    aside = np.column_stack([1.3 * cells, np.zeros(3), np.zeros(3)])
    np.testing.assert_allclose(response.at(np.zeros(3), aside), 1 / (np.pi * cells), rtol=0.12)


@pytest.mark.parametrize("cells", [1.5, 3.5, 5.5])
def test_smeared_main_lobe_is_not_a_separate_point(cells):
    aside = np.array([[1.3 * cells, 0.0, 0.0]])
    assert coarse_range().at(np.zeros(3), aside) == pytest.approx(1.0, abs=0.01)


def test_undersampled_response_has_no_false_lobes():
    """Sampling of 512 of 8192 pulses would alias the phase of far points and repeat the peak at 100 cells."""
    sampled, complete = coarse_range(512), coarse_range(8192)
    aside = np.column_stack([np.linspace(60, 1500, 400), np.zeros(400), np.zeros(400)])
    for response in (sampled, complete):
        assert response.at(np.zeros(3), aside).max() < 0.02


def test_drift_between_subapertures_is_detected():
    generator = np.random.default_rng(7)
    y, x = np.mgrid[:64, :64]

    def patches(step_px):
        """Compare four patches, each with a point that is displaced between subapertures."""
        subapertures = np.zeros((4, 2, 8, 64, 64), np.complex64)
        for patch, (row, column) in enumerate(generator.uniform(28, 36, (4, 2))):
            for index in range(8):
                lobe = np.sinc((x - column - step_px * index) / 12) * np.sinc((y - row) / 3)
                subapertures[patch, :, index] = lobe + 0.01 * complex_noise(generator, (2, 64, 64))
        return compare_parts(subapertures, spacing_m=0.1, generator=generator)

    still, moving = patches(0.0), patches(2.0)
    assert still.drift_m < 0.02
    assert moving.drift_m == pytest.approx(0.2 * np.sqrt((8**2 - 1) / 12), rel=0.15)
    assert judge_parts(still, cell_m=0.3).verdict == "inconclusive"
    assert judge_parts(moving, cell_m=0.3).verdict == "defocused"
    assert still.snr_db > 10


@pytest.mark.parametrize("carrier_cycles", [0.3, 0.7, 2.3, -1.6])
def test_phase_between_pixels_needs_the_unaliased_carrier(carrier_cycles):
    """Two images of a point between pixels, with differently aliased carriers, are in phase at this point."""
    y, x = np.mgrid[:64, :64]
    row, column = 31.4, 30.2
    envelope = np.sinc((y - row) / 4) * np.sinc((x - column) / 4)
    images = [
        (envelope * np.exp(2j * np.pi * cycles * (y - row))).astype(np.complex64) for cycles in (0.1, carrier_cycles)
    ]
    points = [[BrightPoint(row, column, 1.0, carrier=(cycles, 0.0))] for cycles in (0.1, carrier_cycles)]
    geometry = {"spacing_m": 0.1, "cell_m": 0.4, "spectrum": WIDE, "alone": True}
    assert agreement(tuple(images), tuple(points), **geometry).phase_rad == pytest.approx(0.0, abs=0.02)
    aliased = [[BrightPoint(row, column, 1.0)]] * 2
    if abs(carrier_cycles) > 0.5:
        assert abs(agreement(tuple(images), tuple(aliased), **geometry).phase_rad) > 0.3


ARM_M = (0.3, 0.0, -0.1)  # forward and above the logged point


def flying_east(**accuracies):
    """Return a node heading east: columns forward, right (south) and down, in east, north, up."""
    axes = np.broadcast_to(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]).T, (200, 3, 3))
    settings = {"std_deg": (2.0, 2.0), "correlation_s": 1e9, "arm_std_m": 1e-9, **accuracies}
    return NodeAttitude(axes, (ARM_M, ARM_M, (0.0, 0.0, 0.0)), "log", **settings)


def test_constant_attitude_error_displaces_points_by_the_lever_arm_error():
    """Errors of 2° of each angle displace the image like the displaced track, without defocusing."""
    paths = straight()
    attitude, _ = attitude_lines(paths, [flying_east()], sidelink=False)
    (slope,), squares = paths.by_node(same=True, sidelink=False), 0.0
    for axis in np.eye(3):
        antenna_error_m = np.cross(np.radians(2.0) * axis, np.array([ARM_M[0], -ARM_M[1], -ARM_M[2]]))
        squares += paths.of_offset(slope @ antenna_error_m).shift_m ** 2
    assert attitude.effect.shift_m == pytest.approx(np.sqrt(squares), rel=1e-6)
    assert attitude.effect.shift_m == pytest.approx(0.3 * np.radians(2.0), rel=0.5)
    assert attitude.effect.loss_db > -0.01


def test_loss_of_random_attitude_errors_equals_monte_carlo_mean():
    """The mean is that of the loss in dB over 100 draws of three angles; correlation time 1 s, lever arm 0.4 m."""
    paths, generator = straight(), np.random.default_rng(3)
    node = replace(flying_east(std_deg=(2.0, 3.0), correlation_s=1.0), arms_m=((0.4, 0.0, 0.0),) * 2 + ((0.0,) * 3,))
    attitude, _ = attitude_lines(paths, [node], sidelink=False)
    (slope,), count, losses = paths.by_node(same=True, sidelink=False), len(paths.time_s), []
    gradient = paths.gradient[:, :2]
    for _ in range(100):
        angles = [moving_average_noise(generator, count, round(count / 30)) for _ in range(3)]
        rotation_rad = np.stack(angles, -1) * np.radians([2.0, 2.0, 3.0])
        error = (slope * np.cross(rotation_rad, [0.4, 0.0, 0.0])).sum(axis=1)
        residual = error - gradient @ np.linalg.pinv(gradient) @ error
        losses.append(20 * np.log10(abs(np.exp(2j * np.pi / WAVELENGTH_M * residual).mean())))
    assert -6 < attitude.effect.loss_db < -2
    assert attitude.effect.loss_db == pytest.approx(np.mean(losses), rel=0.15)


def test_unconfigured_attitude_accuracy_follows_from_the_attitude_source():
    """Without a lever arm, there is no such term; the course is less accurate than a logged attitude."""
    paths, bare = straight(), replace(flying_east(), arms_m=((0.0, 0.0, 0.0),) * 3)
    assert attitude_lines(paths, [bare], sidelink=False) == []
    logged = replace(flying_east(), std_deg=None, arm_std_m=None)
    attitude, arms = attitude_lines(paths, [logged], sidelink=False)
    by_course, _ = attitude_lines(paths, [replace(logged, source="course")], sidelink=False)
    assert [is_counted(line.report) and not is_stated(line.report) for line in (attitude, arms)] == [True, True]
    assert by_course.effect.shift_m > 3 * attitude.effect.shift_m
    # Two antennas, each with half of the two-way path.
    assert arms.effect.shift_m == pytest.approx(0.01 * np.sqrt(2), rel=0.3)
    assert arms.effect.loss_db > -0.01


def test_attitude_error_changes_the_sidelink_path_through_its_lever_arm():
    """Only the sidelink antenna has a lever arm, which is perpendicular to the line between the nodes."""
    paths = straight(separation_m=4.7)
    node = replace(flying_east(), arms_m=((0.0,) * 3, (0.0,) * 3, (0.0, 0.5, 0.0)), std_deg=(1e-6, 2.0))
    (attitude, _) = attitude_lines(paths, [node, None], sidelink=True)
    path_error_m = 0.5 * np.radians(2.0)  # a heading error rotates an arm on the right into the line between the nodes
    assert attitude.effect.phase_rad == pytest.approx(2 * np.pi / WAVELENGTH_M * path_error_m, rel=1e-3)
    assert attitude_lines(paths, [node, None], sidelink=False)[0].effect.phase_rad == 0


def cut_towards(paths):
    """Return the azimuth of the point from each phase centre of a side-looking antenna on a straight track, rad."""
    away = paths.point_m - paths.aperture.tx_m
    return np.arctan2(away[:, 0], np.hypot(away[:, 1], away[:, 2]))


def test_antenna_phase_linear_in_direction_displaces_points():
    """A phase centre 3 cm ahead along the track displaces the point by 3 cm without loss."""
    paths = straight()
    phase = 2 * 2 * np.pi / WAVELENGTH_M * 0.03 * np.sin(cut_towards(paths))  # transmit and receive path
    line = antenna_line(paths, phase, np.ones(len(phase)))
    assert line.effect.shift_m == pytest.approx(0.03, rel=1e-3)
    assert line.effect.loss_db > -1e-6
    assert antenna_flags([line]) == {}


@pytest.mark.parametrize(("centre_m", "flagged"), [(0.004, False), (0.03, True)])
def test_angle_dependent_phase_centre_defocuses_as_predicted(centre_m, flagged):
    """The phase centre is displaced by `centre_m` at the beam edges (±30°); the loss is that of the best peak."""
    paths = straight()
    angle = cut_towards(paths)
    in_beam = np.abs(angle) < np.radians(30)
    phase = 2 * 2 * np.pi / WAVELENGTH_M * centre_m * (np.degrees(angle) / 30) ** 2
    line = antenna_line(paths, phase, np.where(in_beam, 1.0, 0.05))
    count = int(in_beam.sum())
    best = np.abs(np.fft.fft(np.exp(1j * phase[in_beam]), 8 * count)).max() / count
    assert line.effect.loss_db == pytest.approx(20 * np.log10(best), abs=0.05)
    assert ("antenna_phase" in antenna_flags([line])) is flagged
    assert "1 rad" not in line.stated if flagged else f"{phase[in_beam].max():.2g} rad" in line.stated
