"""Which pairs of a flight are added: the largest set that agrees, whichever of them are wrong."""

from dataclasses import replace
from itertools import combinations
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest

from apertura.core.combination import choose_fusion
from apertura.core.quality.agreement import Agreement, agreement, agreement_of_ground
from apertura.core.quality.bright_points import BrightPoint, bright_points, has_point, near
from apertura.stages.agreement import ComparedImage, shows_points_of

PAIRS = tuple(f"a-{name}" for name in "abcdef")
RANK = dict.fromkeys(PAIRS, (0.0,))
SIDE, CELL_PX, SPACING_M = 192, 4.0, 0.1
WHOLE = (slice(0, SIDE), slice(0, SIDE))
WHERE = {
    "spacing_m": SPACING_M,
    "cell_m": CELL_PX * SPACING_M,
    "spectrum": np.eye(2) / (12 * (CELL_PX * SPACING_M) ** 2),
}
TARGETS = ((45.0, 50.0, 1.0), (70.4, 140.2, 0.8), (140.7, 60.3, 0.7), (150.2, 145.6, 0.9))


def inside(carrier):
    """1 where a band a cell wide about a carrier has its frequencies."""
    near = [np.abs((np.fft.fftfreq(SIDE) - middle + 0.5) % 1 - 0.5) < 0.5 / CELL_PX for middle in carrier]
    return np.multiply.outer(*near).astype(float)


def seen(number, *, phase_rad=0.0, shift_px=(0.0, 0.0), code=True, carrier=None, clutter=0.08, draw=0):
    """What pair `number` shows of four targets among clutter, in a band of its own beside the others'."""
    generator = np.random.default_rng((draw, number))
    carrier = carrier or (0.1 + 0.05 * number, 0.3 - 0.04 * number)
    row, column = np.mgrid[:SIDE, :SIDE]
    image = np.zeros((SIDE, SIDE), np.complex128)
    for down, right, amplitude in TARGETS if code else ():
        here = row - down - shift_px[0], column - right - shift_px[1]
        turn = 2 * pi * (carrier[0] * here[0] + carrier[1] * here[1]) + phase_rad
        image += amplitude * np.sinc(here[0] / CELL_PX) * np.sinc(here[1] / CELL_PX) * np.exp(1j * turn)
    white = generator.normal(size=(2, SIDE, SIDE))
    speckle = np.fft.ifft2(np.fft.fft2(white[0] + 1j * white[1]) * inside(carrier))
    image = image + clutter * speckle / np.sqrt((np.abs(speckle) ** 2).mean())
    points = [
        point
        for point in bright_points(
            image, [WHOLE], cell_px=8, shown=near(WHERE["spectrum"], SPACING_M, CELL_PX * SPACING_M)
        )
        if point.background < 0.06
    ]
    return image, [replace(point, carrier=carrier) for point in points]


def chosen(images, *, align=False):
    """The sum of the pairs that images of (raster, points) are of."""
    between, hidden = {}, set()
    for first, second in combinations(images, 2):
        rasters, points = zip(images[first], images[second], strict=True)
        between[first, second] = agreement(rasters, points, **WHERE) or agreement_of_ground(rasters, [WHOLE], **WHERE)
        for one, other in ((first, second), (second, first)):
            near = [has_point(images[other][0], round(p.row), round(p.column), reach=4) for p in images[one][1]]
            if between[first, second] is None and near and not any(near):
                hidden.add((one, other))
    return choose_fusion({pair: RANK[pair] for pair in images}, between, hidden=hidden, align=align)


WRONG = {
    "phase": ({"phase_rad": pi / 2}, {"phase_rad": pi}),
    "place": ({"shift_px": (1.6, 0.0)}, {"shift_px": (0.0, -2.0)}),
    "code": ({"code": False}, {"code": False}),
}
RIGHT = {pair: seen(number) for number, pair in enumerate(PAIRS)}
TWENTY_ONE = [*combinations(PAIRS, 1), *combinations(PAIRS, 2)]


@pytest.mark.quick("a-c-*", "a-b+a-e-phase", "a-a+a-f-place", "a-d+a-e-code")
@pytest.mark.parametrize("what", WRONG)
@pytest.mark.parametrize("wrong", TWENTY_ONE, ids="+".join)
def test_whichever_one_or_two_of_six_pairs_are_wrong_the_others_add_up(what, wrong):
    spoiled = {pair: seen(PAIRS.index(pair), **how) for pair, how in zip(wrong, WRONG[what], strict=False)}
    told = chosen(RIGHT | spoiled)
    assert set(told.agreeing) == set(PAIRS) - set(wrong)
    assert set(told.left_out) == set(wrong)
    assert set(told.phases_rad) == set(told.agreeing)
    assert told.ties == ()
    assert told.unmeasured == {}
    assert set(told.apart) == (set() if what == "code" else set(wrong))


def test_of_four_pairs_two_in_phase_are_added_whichever_is_focused_best():
    """One a quarter of a turn off, one half a turn; the latter would win by its focus."""
    images = dict(
        zip(PAIRS[:4], (RIGHT["a-a"], RIGHT["a-b"], seen(2, phase_rad=pi / 2), seen(3, phase_rad=pi)), strict=True)
    )
    between = {
        (one, two): agreement(*zip(images[one], images[two], strict=True), **WHERE)
        for one, two in combinations(images, 2)
    }
    rank = {"a-a": (0.2,), "a-b": (0.3,), "a-c": (0.1,), "a-d": (0.0,)}
    told = choose_fusion(rank, between, align=False)
    assert told.agreeing == ("a-a", "a-b")
    assert told.reference == "a-a"
    assert told.ties == ()
    assert told.report["aligning_phase_rad"]["a-c"] == pytest.approx(-pi / 2, abs=0.15)
    assert abs(told.report["aligning_phase_rad"]["a-d"]) == pytest.approx(pi, abs=0.15)
    aligned = choose_fusion(rank, between, align=True)
    assert set(aligned.phases_rad) == set(rank)
    assert aligned.phases_rad["a-d"] == 0.0
    assert aligned.phases_rad["a-c"] - aligned.phases_rad["a-a"] == pytest.approx(pi / 2 - 2 * pi, abs=0.15) or (
        aligned.phases_rad["a-c"] - aligned.phases_rad["a-a"] == pytest.approx(pi / 2, abs=0.15)
    )


def test_as_many_on_one_side_as_on_the_other_is_told_as_a_tie():
    images = {pair: RIGHT[pair] for pair in PAIRS[:2]} | {
        PAIRS[number]: seen(number, phase_rad=2.0) for number in (2, 3)
    }
    told = chosen(images)
    assert told.agreeing == ("a-a", "a-b")
    assert told.ties == (("a-c", "a-d"),)
    two = chosen({pair: images[pair] for pair in ("a-a", "a-c")})
    assert (two.agreeing, two.ties) == (("a-a",), (("a-c",),))


def test_two_wrong_alike_do_not_outvote_four():
    told = chosen(RIGHT | {pair: seen(PAIRS.index(pair), phase_rad=pi) for pair in ("a-a", "a-b")})
    assert told.agreeing == PAIRS[2:]
    assert told.ties == ()


def difference(phase_rad, *, std_rad=0.05, shift_m=0.0, cycles=0.0):
    """What was measured between two pairs, in cells of 0.4 m."""
    units = shift_m / 0.22
    return Agreement("bright points", 4, shift_m, 0.0, 0.01, units, 0.045, cycles, 0.1, phase_rad, std_rad, 0.99)


def test_differences_that_contradict_each_other_around_a_circle_are_no_set():
    rank = dict.fromkeys("abc", (0.0,))
    closed = {("a", "b"): difference(0.3), ("b", "c"): difference(0.2), ("a", "c"): difference(0.5)}
    told = choose_fusion(rank, closed, align=False)
    assert (told.agreeing, told.freedom) == (("a", "b", "c"), 3)
    assert told.misfit == pytest.approx(0.0, abs=1e-9)
    broken = closed | {("a", "c"): difference(-0.3)}
    assert len(choose_fusion(rank, broken, align=True).agreeing) == 2


def test_phases_that_are_taken_off_are_least_squares_over_all_that_was_measured():
    rank = {"a": (0.0,), "b": (1.0,), "c": (1.0,)}
    between = {
        ("a", "b"): difference(1.0, std_rad=0.2),
        ("b", "c"): difference(1.0, std_rad=0.02),
        ("a", "c"): difference(2.1, std_rad=0.02),
    }
    told = choose_fusion(rank, between, align=True)
    assert told.phases_rad["c"] == pytest.approx(2.1, abs=0.01)
    assert told.phases_rad["b"] == pytest.approx(1.1, abs=0.01)  # by way of c, ten times as certain


def test_a_pair_that_shares_nothing_is_added_and_named_unmeasured_unless_it_hides_what_it_should_show():
    rank = dict.fromkeys("abc", (0.0,))
    between = {("a", "b"): difference(0.1), ("a", "c"): None, ("b", "c"): None}
    told = choose_fusion(rank, between, align=False)
    assert told.agreeing == ("a", "b")
    assert told.phases_rad == {"a": 0.0, "b": 0.0, "c": 0.0}
    assert set(told.unmeasured) == {"c"}
    coarse = choose_fusion(rank, between, coarse="pixels of 0.2 m do not resolve cells of 0.1 m", align=False)
    assert coarse.unmeasured == {"c": "pixels of 0.2 m do not resolve cells of 0.1 m"}
    vague = choose_fusion(rank, between | {("a", "c"): difference(2.0, std_rad=0.7)}, align=False)
    assert "not certain enough" in vague.unmeasured["c"]
    hidden = choose_fusion(rank, between, hidden={("a", "c")}, align=False)
    assert "contains no bright points of a" in hidden.left_out["c"]
    assert hidden.unmeasured == {}


@pytest.mark.parametrize(
    ("shown", "points", "confirmed"), [(0, 1, False), (1, 1, True), (1, 5, True), (1, 8, False), (2, 8, True)]
)
def test_a_pair_is_confirmed_by_more_points_than_chance_shows(shown, points, confirmed):
    places = [BrightPoint(20.0 + 20 * number, 96.0, 1.0) for number in range(points)]
    image = np.ones((SIDE, SIDE), np.complex64)
    for one in places[:shown]:
        image[int(one.row), int(one.column)] = 5.0
    grid = SimpleNamespace(spacing_m=SPACING_M)
    first, second = (
        ComparedImage(image, places, WHERE["cell_m"], WHERE["spectrum"], {}, np.empty(0), grid) for _ in "ab"
    )
    assert shows_points_of(first, second, grid) is confirmed


def test_speckle_shows_a_point_at_two_places_of_a_thousand():
    generator, band = np.random.default_rng(1), inside((0.0, 0.0))
    found = []
    for _ in range(20):
        white = generator.normal(size=(2, SIDE, SIDE))
        speckle = np.fft.ifft2(np.fft.fft2(white[0] + 1j * white[1]) * band)
        places = [(row, column) for row in range(32, SIDE - 32, 11) for column in range(32, SIDE - 32, 11)]
        found += [has_point(speckle, *place, reach=round(CELL_PX)) for place in places]
    assert 0.0008 < np.mean(found) < 0.004


def test_more_pairs_than_every_set_can_be_tried_of_still_lose_the_wrong_one():
    rank = {f"p{number:02}": (0.0,) for number in range(14)}
    between = {two: difference(2.5 if "p03" in two else 0.0) for two in combinations(rank, 2)}
    told = choose_fusion(rank, between, align=False)
    assert "p03" in told.left_out
    assert len(told.agreeing) == 12


def test_a_path_a_whole_wavelength_off_is_told_from_its_place_although_the_phase_agrees():
    """The shift is a fifth of a cell: too little by three deviations beyond a tenth, and yet another cycle."""
    right, other_cycle = difference(0.0, shift_m=0.065, cycles=0.4), difference(0.0, shift_m=0.065, cycles=0.9)
    assert not right.shifted
    assert other_cycle.shifted
    assert not difference(0.0, shift_m=0.03, cycles=0.9).shifted  # less than a tenth of a cell harms nothing


@pytest.mark.slow
def test_the_phase_scatters_as_it_says_although_carriers_differ_and_clutter_moves_the_peaks():
    found = []
    for draw in range(20):
        both = [seen(number, carrier=(0.05 + 0.3 * number, 0.2), clutter=0.12, draw=draw) for number in (0, 1)]
        rasters, points = zip(*both, strict=True)
        first = [[min(some, key=lambda one: np.hypot(one.row - 45.0, one.column - 50.0))] for some in points]
        told = agreement(rasters, first, **WHERE, alone=True)  # of one point alone no scatter tells anything
        found.append(told.phase_rad / told.phase_std_rad)
    assert 0.6 < np.sqrt(np.mean(np.square(found))) < 1.4


@pytest.mark.parametrize(("apart", "measured"), [(0.0, True), (0.1, True), (0.15, True), (0.3, False)])
def test_ground_tells_the_phase_in_the_band_that_both_images_have_and_nothing_beyond(apart, measured):
    generator = np.random.default_rng(5)
    ground, noise = (np.fft.fft2(one[0] + 1j * one[1]) for one in generator.normal(size=(2, 2, SIDE, SIDE)))
    first = np.fft.ifft2(ground * inside((0.2, 0.1)))
    second = 1j * np.fft.ifft2((ground + 0.5 * noise) * inside((0.2 + apart, 0.1)))
    told = agreement_of_ground((first, second), [WHOLE], **WHERE)
    assert (told is not None) == measured
    if measured:
        assert told.by == "looks"
        assert told.phase_rad == pytest.approx(pi / 2, abs=3 * told.phase_std_rad)
        assert told.phase_std_rad < 0.1
        assert not told.shifted


def test_ground_of_another_scene_is_not_coherent():
    for draw in range(20):
        generator = np.random.default_rng(draw)
        some = generator.normal(size=(2, 2, SIDE, SIDE))
        images = [np.fft.ifft2(np.fft.fft2(one[0] + 1j * one[1]) * inside((0.2, 0.1))) for one in some]
        assert agreement_of_ground((images[0], images[1]), [WHOLE], **WHERE) is None


def scattered(generator, count, side_m, shift_m):
    """Points of two images, each shifted from the first to the second by an amount of its own, metres."""
    here = generator.uniform(0, side_m, (count, 2))
    first, second = ([BrightPoint(y / SPACING_M, x / SPACING_M, 1.0) for x, y in at] for at in (here, here + shift_m))
    return first, second


@pytest.mark.parametrize("apart_m", [0.0, 0.3, 0.6, 1.0, 1.5])
def test_points_that_are_shifted_by_different_amounts_are_compared_and_never_told_less(apart_m):
    """An error of height shifts points by angle: those of one side one way, those of the other another."""
    generator = np.random.default_rng(3)
    direction = generator.uniform(0.5, 1.5, (5, 2)) * [1.0, 0.3]
    image = np.ones((400, 400), np.complex64)
    found = agreement((image, image), scattered(generator, 5, 12.0, apart_m * direction), **WHERE)
    assert found is not None
    assert found.points >= 3
    assert found.shifted is (apart_m > 0)


def test_points_of_different_scenes_are_not_taken_for_shifted_ones():
    """By chance alone: at most a few of a thousand draws."""
    generator, image = np.random.default_rng(4), np.ones((400, 400), np.complex64)
    same = 0
    for _ in range(1000):
        first, _ = scattered(generator, generator.integers(3, 9), 12.0, np.zeros(2))
        second, _ = scattered(generator, generator.integers(3, 9), 12.0, np.zeros(2))
        found = agreement((image, image), (first, second), **WHERE)
        same += found is not None and found.spread
    assert same <= 3
