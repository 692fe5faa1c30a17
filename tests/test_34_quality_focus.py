"""An image knows whether it is focused: bright points, path errors, the error budget, pairs against each other."""

from dataclasses import replace

import numpy as np
import pytest

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
    compare_parts,
    focus_with_flags,
    judge,
    judge_parts,
    point_focus,
)
from apertura.core.quality.path_errors import Effect, PointPaths

PULSES, WAVELENGTH_M = 600, 0.214


def moving_average_noise(generator, count, width):
    """White noise after a moving average, standard deviation 1."""
    return np.convolve(generator.standard_normal(count + width - 1), np.ones(width) / np.sqrt(width), "valid")


def complex_noise(generator, count):
    return (generator.standard_normal(count) + 1j * generator.standard_normal(count)) / np.sqrt(2)


def straight(length_m=30.0, *, apart_m=0.0):
    along = np.linspace(-length_m / 2, length_m / 2, PULSES)
    track = np.stack([along, np.full(PULSES, -12.0), np.full(PULSES, 8.0)], -1)
    ahead = np.array([apart_m, 0, 0])
    return PointPaths.of(
        Aperture(track - ahead / 2, track + ahead / 2),
        np.linspace(0, 30, PULSES),
        point_m=np.zeros(3),
        axes=np.eye(3),
        wavelength_m=WAVELENGTH_M,
    )


@pytest.mark.parametrize("noise_db", [-30.0, -10.0, -5.0])
@pytest.mark.parametrize("rms_rad", [0.0, 0.5, 1.0])
def test_a_phase_error_is_measured_whatever_noise_and_neighbours_add(noise_db, rms_rad):
    generator = np.random.default_rng(1)
    phase = rms_rad * moving_average_noise(generator, PULSES, 60)
    taper = np.linspace(0.6, 1.0, PULSES)
    contributions = taper * np.exp(1j * phase)
    along = np.fft.fft(contributions, 8 * PULSES)
    true_db = 20 * np.log10(np.abs(along).max() / taper.sum())
    neighbour = 0.2 * np.exp(2j * np.pi * 47.3 * np.arange(PULSES) / PULSES)
    focus = point_focus(contributions + neighbour + 10 ** (noise_db / 20) * complex_noise(generator, PULSES))
    hidden = 0.15 if focus.pulses > 1 else 0.05  # the longer the blocks, the more happens within one
    assert focus.loss_db == pytest.approx(true_db, abs=0.15 + hidden * abs(true_db))


def test_noise_and_speckle_are_no_evidence():
    generator = np.random.default_rng(2)
    assert not any(point_focus(complex_noise(generator, 512)) for _ in range(200))
    scatterers = np.exp(2j * np.pi * np.outer(generator.uniform(-100, 100, 40), np.arange(512) / 512))
    assert point_focus((scatterers * complex_noise(generator, 40)[:, None]).sum(axis=0)) is None


def test_the_snr_of_a_point_is_told_by_its_even_and_odd_pulses():
    generator = np.random.default_rng(3)
    focus = point_focus(1 + 0.1 * complex_noise(generator, 4096))
    assert focus.snr_db == pytest.approx(20 + 10 * np.log10(4096), abs=0.5)


@pytest.mark.parametrize(("cycles", "evidence"), [(0.4, True), (1.5, False), (6.5, False)])
def test_a_sidelobe_of_an_echo_elsewhere_is_no_evidence_of_focus(cycles, evidence):
    """Its contributions keep their amplitude and turn: they add up at another place, and not at this one."""
    assert (point_focus(np.exp(2j * np.pi * cycles * np.arange(400) / 400)) is not None) == evidence


def test_one_point_among_sidelobes_does_not_decide():
    generator = np.random.default_rng(4)
    sharp = point_focus(np.ones(200, complex))
    blurred = point_focus(np.exp(2j * moving_average_noise(generator, 200, 20)))
    assert judge([(1.0, sharp), (0.9, sharp), (0.3, blurred)]).verdict == "focused"
    assert judge([(1.0, blurred), (0.9, blurred), (0.3, sharp)]).verdict == "defocused"


@pytest.mark.parametrize(
    ("losses_db", "verdict"),
    [((-0.3, -0.5), "focused"), ((-0.6, -6.0), "cannot tell"), ((-4.0, -4.2), "defocused"), ((-1.0,), "cannot tell")],
)
def test_a_loss_whose_interval_reaches_one_decibel_is_no_verdict(losses_db, verdict):
    assert judge([(1.0, PointFocus(loss_db, 0.01, 1, 30.0)) for loss_db in losses_db]).verdict == verdict


@pytest.mark.parametrize("flag", sorted(GEOMETRY_CONTRADICTED))
def test_an_image_whose_geometry_a_flag_contradicts_is_not_called_focused(flag):
    focus = {"verdict": "focused", "why": "3 bright points lost 0.02 dB", "loss_db": -0.02}
    assert flag in FLAGS
    assert focus_with_flags(focus, ["hover", flag])["verdict"] == "cannot tell"
    assert focus_with_flags(focus, ["hover", flag])["why"].endswith(f"contradicted by {flag}")
    assert focus_with_flags(focus | {"verdict": "defocused"}, [flag])["verdict"] == "defocused"
    assert focus_with_flags(focus, ["hover", "track_gap"]) == focus


@pytest.mark.parametrize(("error_db", "verdict"), [(-10.0, "cannot tell"), (-40.0, "focused"), (None, "focused")])
def test_an_image_with_a_large_numerical_error_is_not_called_focused(error_db, verdict):
    focus = {"verdict": "focused", "why": "3 bright points lost 0.02 dB"}
    assert focus_with_flags(focus, ["accuracy_not_met"], error_db=error_db)["verdict"] == verdict


@pytest.mark.parametrize("std_cm", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("apart_m", [0.0, 4.7])
def test_the_loss_by_random_errors_is_what_draws_give(std_cm, apart_m):
    """Mean over 60 draws of both nodes' tracks, best peak within a few cells; within 15 % in dB."""
    paths, generator = straight(apart_m=apart_m), np.random.default_rng(5)
    same = apart_m == 0
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
    paths = straight(apart_m=4.7)
    far = PointPaths(paths.aperture, paths.time_s, np.array([500.0, -12.0, 8.0]), paths.axes, WAVELENGTH_M)
    by_tx, by_rx = far.by_node(same=False, sidelink=True)
    np.testing.assert_allclose(by_tx[:, 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(by_rx[:, 0], -2.0, atol=1e-3)


def test_a_raised_point_moves_and_hardly_blurs():
    higher = straight().of_offset(-straight().gradient[:, 2], common=True)
    assert higher.shift_m == pytest.approx(8 / 12, rel=0.1)
    assert higher.loss_db > -0.5


def bent(radius_m=12.0, aside_m=6.0):
    """A flight around a place beside the point, which it sees under other angles of elevation."""
    turn = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    track = np.stack([aside_m + radius_m * np.sin(turn), radius_m * np.cos(turn), np.full(300, 8.0)], -1)
    return replace(straight(), aperture=Aperture(track, track), time_s=np.linspace(0, 30, 300))


@pytest.mark.parametrize("apart_m", [0.0, 4.7])
def test_no_image_of_a_straight_flight_shows_a_wrong_height_and_the_budget_says_how_far_points_may_be_off(apart_m):
    """Paths of one line depend on the distance from it alone: eq. 2a, exactly, one and two nodes alike."""
    paths = straight(apart_m=apart_m)
    line = height_line(paths, None)
    assert line.counts
    assert not is_stated(line.report)
    assert line.effect.loss_db == 0.0
    assert line.effect.shift_m == pytest.approx(3.0 * 8 / 12, rel=0.05)
    raised = np.array([[0.0, np.sqrt(12.0**2 + 8.0**2 - 6.5**2) - 12.0, 1.5]])  # as far from the track
    assert np.abs(paths.aperture.path(raised) - paths.aperture.path(np.zeros((1, 3)))).max() < 1e-9


def test_a_bent_flight_shows_a_wrong_height_and_the_budget_assumes_no_more():
    paths = bent()
    line = height_line(paths, None)
    taken_m = float(line.report["stated"].split("assumed ")[1].split(" m")[0])
    assert taken_m < 0.1
    lost_db = [paths.of_offset(-paths.gradient[:, 2] * h).loss_db for h in (taken_m, 3 * taken_m)]
    assert lost_db[0] == pytest.approx(-0.2, abs=0.03)
    assert lost_db[1] < -1.5
    assert line.effect.shift_m < 0.1


def test_what_other_causes_may_cost_a_height_may_cost_unseen():
    paths = bent()
    alone, beside = (height_line(paths, None, expected_db=loss_db).effect.shift_m for loss_db in (0.0, -1.0))
    assert beside / alone == pytest.approx(np.sqrt(1.2 / 0.2), rel=1e-3)


def test_a_height_that_is_stated_counts_as_stated():
    paths = straight()
    stated = height_line(paths, 0.3)
    assert stated.stated == "0.3 m"
    assert stated.effect.shift_m == pytest.approx(0.3 * 8 / 12, rel=0.05)


def test_a_constant_path_error_turns_the_phase_between_pairs():
    paths = straight()
    effect = paths.of_offset(np.full(len(paths.time_s), 0.05))
    assert effect.phase_rad == pytest.approx(2 * np.pi * 0.05 / WAVELENGTH_M)


def test_unstated_positions_count_with_what_their_receiver_does():
    """As if somebody had stated it, but for the arithmetic; a float solution errs more and for longer."""
    paths = straight()
    (fixed,) = position_lines(paths, [NodePositions(None, 1.0, receiver="fix")], sidelink=False)
    (stated,) = position_lines(paths, [NodePositions((0.01,) * 3, 1.0, "config")], sidelink=False)
    (floating,) = position_lines(paths, [NodePositions(None, 1.0, receiver="float")], sidelink=False)
    (strange,) = position_lines(paths, [NodePositions(None)], sidelink=False)
    assert expected([fixed]) == expected([stated]) == stated.effect
    assert floating.effect.loss_db < 3 * fixed.effect.loss_db < -2
    assert expected([strange]).loss_db == 0
    assert is_counted(fixed.report)
    assert not is_stated(fixed.report)
    assert not is_counted(strange.report)
    assert accuracy_for([fixed]) == -60.0


def test_the_loss_by_random_errors_scatters_as_is_stated():
    """Standard deviation of the loss over 200 draws of 5 mm in each axis."""
    paths, generator = straight(), np.random.default_rng(8)
    (slope,), count, losses = paths.by_node(same=True, sidelink=False), len(paths.time_s), []
    ground = paths.gradient[:, :2]
    for _ in range(200):
        drawn = np.stack([moving_average_noise(generator, count, round(count / 30)) for _ in range(3)], -1)
        error = (slope * 0.005 * drawn).sum(axis=1)
        rest = error - ground @ np.linalg.pinv(ground) @ error
        losses.append(20 * np.log10(abs(np.exp(2j * np.pi / WAVELENGTH_M * rest).mean())))
    effect = position_lines(paths, [NodePositions((0.005,) * 3)], sidelink=False)[0].effect
    assert effect.loss_std_db == pytest.approx(np.std(losses), rel=0.3)


@pytest.mark.parametrize(
    ("loss_db", "std_db", "expected", "raised"),
    [
        (-0.7, 0.05, Effect(-0.1, 0, 0, 0.05), True),  # told to be worse than stated, though less than 1 dB
        (-0.7, 0.3, Effect(-0.1, 0, 0, 0.05), False),  # within three deviations of the measurement
        (-0.9, 0.05, Effect(-0.5, 0, 0, 0.2), False),  # within three deviations from flight to flight
        (-0.15, 0.01, Effect(0.0, 0, 0, 0.0), False),  # less than images tell
    ],
)
def test_a_loss_beyond_the_expected_one_is_a_flag_also_below_a_decibel(loss_db, std_db, expected, raised):
    report = {"verdict": "focused", "why": "points lost", "loss_db": loss_db, "std_db": std_db}
    assert ("loss_unexpected" in focus_flags(report, expected)) == raised
    bad = focus_flags(report | {"verdict": "defocused"}, expected)
    assert "defocused" in bad
    assert "loss_unexpected" not in bad


def test_what_nobody_stated_is_not_summed_and_does_not_set_the_arithmetic():
    silent = BudgetLine("heights", None, Effect(-3.0, 1.0, 0.0), "1 m")
    stated = BudgetLine("positions", "1 cm", Effect(-0.0001, 0.02, 0.1))
    assert expected([silent, stated]) == stated.effect
    assert accuracy_for([silent]) == -60.0
    assert accuracy_for([silent, stated]) == pytest.approx(-56.4, abs=0.1)
    assert accuracy_for([BudgetLine("positions", "1 cm", Effect(-1.2, 0.1, 0.1))]) == -40.0


@pytest.mark.parametrize("loss_db", [0.0, -1e-7, -1e-4, -0.1, -3.0])
def test_an_echo_serves_every_image_that_auto_may_ask_for(loss_db):
    """Its clock is corrected, or not, before the budget that auto follows from is known."""
    asked = accuracy_for([BudgetLine("positions", "stated", Effect(loss_db, 0.0, 0.0))])
    assert strictest_accuracy_db("auto") <= asked
    assert strictest_accuracy_db(-45.0) == -45.0


def lobes(places, *, turned=0.0, carrier=1.1):
    y, x = np.mgrid[:256, :256]
    image = sum(np.sinc((y - row) / 4) * np.sinc((x - column) / 4) * amplitude for row, column, amplitude in places)
    return (image * np.exp(1j * (carrier * y + turned))).astype(np.complex64)


def sinc_response(one, others):
    """What a point of `lobes` shows at other pixels."""
    return np.abs(np.sinc((others - one) / 4)).prod(axis=1)


PLACES = [(60.0, 70.0, 1.0), (150.3, 90.2, 0.8), (200.7, 190.1, 0.5)]
SHIFT_PX = (0.8, -0.6)
WIDE = np.diag([0.52, 0.52])  # a square band 2.5 cycles per metre wide


@pytest.fixture
def two_images():
    moved = [(row + SHIFT_PX[0], column + SHIFT_PX[1], amplitude) for row, column, amplitude in PLACES]
    images = lobes(PLACES), lobes(moved, turned=-1.2)
    whole = [(slice(0, 256), slice(0, 256))]
    points = [bright_points(image, whole, cell_px=8, shown=sinc_response) for image in images]
    return images, [some[:3] for some in points]


def test_bright_points_are_the_same_in_whichever_windows_and_order_an_image_is_read():
    places = [*PLACES, (40.0, 200.0, 0.27), (220.0, 30.0, 0.24), (128.0, 16.0, 0.9)]  # the last on an edge of windows
    image = lobes(places)
    tiles = [
        (slice(row, row + 64), slice(column, column + 64)) for row in range(0, 256, 64) for column in range(0, 256, 64)
    ]
    found = [bright_points(image, some, cell_px=8, shown=sinc_response) for some in (tiles, tiles[::-1])]
    assert found[0] == found[1]
    whole = bright_points(image, [(slice(0, 256), slice(0, 256))], cell_px=8, shown=sinc_response)
    assert [(p.row, p.column) for p in found[0]] == [(p.row, p.column) for p in whole]
    assert sorted(round(p.amplitude, 2) for p in whole) == [0.27, 0.5, 0.8, 0.9, 1.0]  # 0.24 is 12.4 dB below the first


@pytest.mark.parametrize("turned", range(4))
def test_the_skirt_of_a_point_hides_no_weaker_maximum_in_the_square_it_reaches_into(turned):
    image = np.zeros((64, 64), np.complex64)
    image[20, 31:33], image[20, 36] = (1.0, 0.9), 0.5  # squares of 8 pixels begin at 24 and 32
    image = np.rot90(image, turned)
    found = bright_points(
        image, [(slice(0, 64), slice(0, 64))], cell_px=8, shown=lambda _, others: np.zeros(len(others))
    )
    assert len(found) == 2


def test_place_and_phase_between_images_are_told_to_a_tenth_of_a_cell(two_images):
    images, points = two_images
    found = agreement(images, points, spacing_m=0.1, cell_m=0.4, spectrum=WIDE)
    assert found.points == 3
    assert (found.shift_east_m, found.shift_north_m) == pytest.approx((-0.06, -0.08), abs=0.004)
    assert found.phase_rad == pytest.approx(-1.2, abs=0.05)
    assert found.coherence > 0.99
    assert found.shifted
    assert found.out_of_phase


def test_an_image_agrees_with_itself(two_images):
    images, points = two_images
    found = agreement((images[0],) * 2, (points[0],) * 2, spacing_m=0.1, cell_m=0.4, spectrum=WIDE)
    assert found.shift_m == 0
    assert found.phase_rad == pytest.approx(0, abs=1e-12)
    assert not found.shifted
    assert not found.out_of_phase


def test_images_without_a_point_in_common_say_nothing(two_images):
    images, points = two_images
    far = [BrightPoint(points[0][0].row + 150, points[0][0].column + 150, 1.0)]
    assert agreement(images, (points[0][:1], far), spacing_m=0.1, cell_m=0.4, spectrum=WIDE) is None
    assert agreement(images, (points[0], []), spacing_m=0.1, cell_m=0.4, spectrum=WIDE) is None


def test_one_point_in_common_is_evidence_where_it_is_the_brightest_of_both_or_the_only_one(two_images):
    images, points = two_images
    where = {"spacing_m": 0.1, "cell_m": 0.4, "spectrum": WIDE}
    brightest = (points[0][:1], points[1])
    assert agreement(images, brightest, **where).points == 1
    second = (points[0][1:2], points[1])
    assert agreement(images, (points[0][:2], points[1][1:]), **where) is None
    assert agreement(images, second, **where) is None
    assert agreement(images, (points[0][:1], points[1][:1]), **(where | {"cell_m": 0.05})) is None
    alone = agreement(images, (points[0][1:2], points[1][1:2]), **where, alone=True)
    assert alone.points == 1


def test_the_shift_is_the_one_that_most_brightness_agrees_on():
    generator = np.random.default_rng(6)
    here = [(*generator.uniform(0, 50, 2), 1.0) for _ in range(6)]
    there = [(x + 2.5, y - 1.5, amplitude) for x, y, amplitude in here] + [(*generator.uniform(0, 50, 2), 0.4)]
    shift, met = common_shift(here, there, reach=4.0, gate=0.3)
    assert shift == pytest.approx((2.5, -1.5))
    assert met == [(number, number) for number in range(6)]


def coarse_range(pulses=512):
    """The response of a straight flight 100 m away: cells of 1.3 m across the line of sight and of 6 m along it."""
    track = np.stack([np.linspace(-5, 5, pulses), np.full(pulses, -100.0), np.full(pulses, 0.0)], -1)
    along_m = 0.1 * np.arange(-600, 600)
    return PointResponse(Aperture(track, track), np.sinc(along_m / 12), 0.1, 0.26)


def test_a_point_shows_at_another_place_what_aperture_and_band_give():
    """Along range the response of the band at twice the distance; aside sin(x)/x, once beyond what errors may smear."""
    response = coarse_range()
    behind = np.column_stack([np.zeros(50), np.linspace(0.5, 25, 50), np.zeros(50)])
    np.testing.assert_allclose(response.at(np.zeros(3), behind), np.abs(np.sinc(behind[:, 1] / 6)), atol=5e-3)
    cells = np.array([6.5, 7.5, 9.5])
    aside = np.column_stack([1.3 * cells, np.zeros(3), np.zeros(3)])
    np.testing.assert_allclose(response.at(np.zeros(3), aside), 1 / (np.pi * cells), rtol=0.12)


@pytest.mark.parametrize("cells", [1.5, 3.5, 5.5])
def test_what_phase_errors_may_smear_is_no_point_of_its_own(cells):
    aside = np.array([[1.3 * cells, 0.0, 0.0]])
    assert coarse_range().at(np.zeros(3), aside) == pytest.approx(1.0, abs=0.01)


def test_a_response_that_few_pulses_do_not_follow_has_no_false_lobes():
    """Sampled pulses would fold the phase of far places: 100 cells aside a sum over 512 of 8192 repeats the peak."""
    few, all_of_them = coarse_range(512), coarse_range(8192)
    aside = np.column_stack([np.linspace(60, 1500, 400), np.zeros(400), np.zeros(400)])
    for response in (few, all_of_them):
        assert response.at(np.zeros(3), aside).max() < 0.02


def test_parts_that_drift_apart_are_seen():
    generator = np.random.default_rng(7)
    y, x = np.mgrid[:64, :64]

    def patches(step_px):
        """Four patches, each with a point of its own, that moves from part to part."""
        found = np.zeros((4, 2, 8, 64, 64), np.complex64)
        for patch, (row, column) in enumerate(generator.uniform(28, 36, (4, 2))):
            for part in range(8):
                lobe = np.sinc((x - column - step_px * part) / 12) * np.sinc((y - row) / 3)
                found[patch, :, part] = lobe + 0.01 * complex_noise(generator, (2, 64, 64))
        return compare_parts(found, spacing_m=0.1, generator=generator)

    still, moving = patches(0.0), patches(2.0)
    assert still.drift_m < 0.02
    assert moving.drift_m == pytest.approx(0.2 * np.sqrt((8**2 - 1) / 12), rel=0.15)
    assert judge_parts(still, cell_m=0.3).verdict == "cannot tell"
    assert judge_parts(moving, cell_m=0.3).verdict == "defocused"
    assert still.snr_db > 10


@pytest.mark.parametrize("turns", [0.3, 0.7, 2.3, -1.6])
def test_the_phase_between_pixels_needs_the_carrier_that_the_pixels_fold(turns):
    """Two images of one point whose carriers fold to different places: in phase at the point, between the pixels."""
    y, x = np.mgrid[:64, :64]
    row, column = 31.4, 30.2
    envelope = np.sinc((y - row) / 4) * np.sinc((x - column) / 4)
    images = [(envelope * np.exp(2j * np.pi * cycles * (y - row))).astype(np.complex64) for cycles in (0.1, turns)]
    points = [[BrightPoint(row, column, 1.0, carrier=(cycles, 0.0))] for cycles in (0.1, turns)]
    where = {"spacing_m": 0.1, "cell_m": 0.4, "spectrum": WIDE, "alone": True}
    assert agreement(tuple(images), tuple(points), **where).phase_rad == pytest.approx(0.0, abs=0.02)
    folded = [[BrightPoint(row, column, 1.0)]] * 2
    if abs(turns) > 0.5:
        assert abs(agreement(tuple(images), tuple(folded), **where).phase_rad) > 0.3


ARM_M = (0.3, 0.0, -0.1)  # forward and above the logged point


def flying_east(**stated):
    """A node whose body looks east: columns forward, right (south) and down, in east, north, up."""
    axes = np.broadcast_to(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]).T, (200, 3, 3))
    known = {"std_deg": (2.0, 2.0), "correlation_s": 1e9, "arm_std_m": 1e-9, **stated}
    return NodeAttitude(axes, (ARM_M, ARM_M, (0.0, 0.0, 0.0)), "log", **known)


def test_a_constant_error_of_attitude_displaces_by_what_the_end_of_the_lever_arm_does():
    """2° of each angle on an arm: each moves the image as the track would be moved; nothing defocuses."""
    paths = straight()
    attitude, _ = attitude_lines(paths, [flying_east()], sidelink=False)
    (slope,), squares = paths.by_node(same=True, sidelink=False), 0.0
    for axis in np.eye(3):
        moved = np.cross(np.radians(2.0) * axis, np.array([ARM_M[0], -ARM_M[1], -ARM_M[2]]))
        squares += paths.of_offset(slope @ moved).shift_m ** 2
    assert attitude.effect.shift_m == pytest.approx(np.sqrt(squares), rel=1e-6)
    assert attitude.effect.shift_m == pytest.approx(0.3 * np.radians(2.0), rel=0.5)
    assert attitude.effect.loss_db > -0.01


def test_attitude_that_wanders_defocuses_as_drawn_angles_do():
    """Mean over 100 draws of three angles, white noise over a second, on an arm of 0.4 m; in dB."""
    paths, generator = straight(), np.random.default_rng(3)
    node = replace(flying_east(std_deg=(2.0, 3.0), correlation_s=1.0), arms_m=((0.4, 0.0, 0.0),) * 2 + ((0.0,) * 3,))
    attitude, _ = attitude_lines(paths, [node], sidelink=False)
    (slope,), count, losses = paths.by_node(same=True, sidelink=False), len(paths.time_s), []
    ground = paths.gradient[:, :2]
    for _ in range(100):
        angles = [moving_average_noise(generator, count, round(count / 30)) for _ in range(3)]
        turned = np.stack(angles, -1) * np.radians([2.0, 2.0, 3.0])
        error = (slope * np.cross(turned, [0.4, 0.0, 0.0])).sum(axis=1)
        rest = error - ground @ np.linalg.pinv(ground) @ error
        losses.append(20 * np.log10(abs(np.exp(2j * np.pi / WAVELENGTH_M * rest).mean())))
    assert -6 < attitude.effect.loss_db < -2
    assert attitude.effect.loss_db == pytest.approx(np.mean(losses), rel=0.15)


def test_no_lever_arm_no_line_and_what_is_unstated_counts_by_the_source_of_attitude():
    """A course knows less of the body than a log; a wrong arm of both legs moves the image about as much."""
    paths, bare = straight(), replace(flying_east(), arms_m=((0.0, 0.0, 0.0),) * 3)
    assert attitude_lines(paths, [bare], sidelink=False) == []
    logged = replace(flying_east(), std_deg=None, arm_std_m=None)
    attitude, arms = attitude_lines(paths, [logged], sidelink=False)
    by_course, _ = attitude_lines(paths, [replace(logged, source="course")], sidelink=False)
    assert [is_counted(line.report) and not is_stated(line.report) for line in (attitude, arms)] == [True, True]
    assert by_course.effect.shift_m > 3 * attitude.effect.shift_m
    assert arms.effect.shift_m == pytest.approx(0.01 * np.sqrt(2), rel=0.3)  # two antennas, half the path each
    assert arms.effect.loss_db > -0.01


def test_an_attitude_that_moves_the_sidelink_s_antenna_turns_its_length():
    """An arm of the sidelink's antenna alone, across the line between the nodes: the path between them changes."""
    paths = straight(apart_m=4.7)
    node = replace(flying_east(), arms_m=((0.0,) * 3, (0.0,) * 3, (0.0, 0.5, 0.0)), std_deg=(1e-6, 2.0))
    (attitude, _) = attitude_lines(paths, [node, None], sidelink=True)
    moved_m = 0.5 * np.radians(2.0)  # heading turns an arm to the right into the line of sight of both
    assert attitude.effect.phase_rad == pytest.approx(2 * np.pi / WAVELENGTH_M * moved_m, rel=1e-3)
    assert attitude_lines(paths, [node, None], sidelink=False)[0].effect.phase_rad == 0


def cut_towards(paths):
    """Azimuth of the point from each phase centre of a straight track, from an antenna that looks across it, rad."""
    away = paths.point_m - paths.aperture.tx_m
    return np.arctan2(away[:, 0], np.hypot(away[:, 1], away[:, 2]))


def test_a_phase_that_is_linear_in_direction_is_a_phase_centre_beside_the_antenna():
    """3 cm ahead along the track: the point lies 3 cm off, and is as sharp."""
    paths = straight()
    phase = 2 * 2 * np.pi / WAVELENGTH_M * 0.03 * np.sin(cut_towards(paths))  # both legs
    line = antenna_line(paths, phase, np.ones(len(phase)))
    assert line.effect.shift_m == pytest.approx(0.03, rel=1e-3)
    assert line.effect.loss_db > -1e-6
    assert antenna_flags([line]) == {}


@pytest.mark.parametrize(("centre_m", "flagged"), [(0.004, False), (0.03, True)])
def test_a_phase_centre_that_moves_with_the_angle_defocuses_as_its_phase_says(centre_m, flagged):
    """Within a beam of ±30°, the centre that far out at the edges; the loss is that of the best peak of the sum."""
    paths = straight()
    angle = cut_towards(paths)
    seen = np.abs(angle) < np.radians(30)
    phase = 2 * 2 * np.pi / WAVELENGTH_M * centre_m * (np.degrees(angle) / 30) ** 2
    line = antenna_line(paths, phase, np.where(seen, 1.0, 0.05))
    count = int(seen.sum())
    best = np.abs(np.fft.fft(np.exp(1j * phase[seen]), 8 * count)).max() / count
    assert line.effect.loss_db == pytest.approx(20 * np.log10(best), abs=0.05)
    assert ("antenna_phase" in antenna_flags([line])) is flagged
    assert "1 rad" not in line.stated if flagged else f"{phase[seen].max():.2g} rad" in line.stated
