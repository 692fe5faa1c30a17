"""Selection of pairs for the coherent sum: the largest set of consistent pairs."""

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
GEOMETRY = {
    "spacing_m": SPACING_M,
    "cell_m": CELL_PX * SPACING_M,
    "spectrum": np.eye(2) / (12 * (CELL_PX * SPACING_M) ** 2),
}
TARGETS = ((45.0, 50.0, 1.0), (70.4, 140.2, 0.8), (140.7, 60.3, 0.7), (150.2, 145.6, 0.9))


def band_mask(carrier):
    """Return a mask of the spectrum, 1 in a band of one resolution cell about a carrier."""
    near = [np.abs((np.fft.fftfreq(SIDE) - middle + 0.5) % 1 - 0.5) < 0.5 / CELL_PX for middle in carrier]
    return np.multiply.outer(*near).astype(float)


def simulated_pair(number, *, phase_rad=0.0, shift_px=(0.0, 0.0), code=True, carrier=None, clutter=0.08, draw=0):
    """Simulate image and bright points of pair `number`: four targets in clutter, in a separate band."""
    generator = np.random.default_rng((draw, number))
    carrier = carrier or (0.1 + 0.05 * number, 0.3 - 0.04 * number)
    row, column = np.mgrid[:SIDE, :SIDE]
    image = np.zeros((SIDE, SIDE), np.complex128)
    for down, right, amplitude in TARGETS if code else ():
        offset = row - down - shift_px[0], column - right - shift_px[1]
        phase = 2 * pi * (carrier[0] * offset[0] + carrier[1] * offset[1]) + phase_rad
        image += amplitude * np.sinc(offset[0] / CELL_PX) * np.sinc(offset[1] / CELL_PX) * np.exp(1j * phase)
    white = generator.normal(size=(2, SIDE, SIDE))
    speckle = np.fft.ifft2(np.fft.fft2(white[0] + 1j * white[1]) * band_mask(carrier))
    image = image + clutter * speckle / np.sqrt((np.abs(speckle) ** 2).mean())
    points = [
        point
        for point in bright_points(
            image, [WHOLE], cell_px=8, shown=near(GEOMETRY["spectrum"], SPACING_M, CELL_PX * SPACING_M)
        )
        if point.background < 0.06
    ]
    return image, [replace(point, carrier=carrier) for point in points]


def fusion_of(images, *, align=False):
    """Return the fusion chosen for pairs, given (raster, points) of each."""
    between, hidden = {}, set()
    for first, second in combinations(images, 2):
        rasters, points = zip(images[first], images[second], strict=True)
        between[first, second] = agreement(rasters, points, **GEOMETRY) or agreement_of_ground(
            rasters, [WHOLE], **GEOMETRY
        )
        for pair, other in ((first, second), (second, first)):
            near = [has_point(images[other][0], round(p.row), round(p.column), reach=4) for p in images[pair][1]]
            if between[first, second] is None and near and not any(near):
                hidden.add((pair, other))
    return choose_fusion({pair: RANK[pair] for pair in images}, between, hidden=hidden, align=align)


ERRORS = {
    "phase": ({"phase_rad": pi / 2}, {"phase_rad": pi}),
    "place": ({"shift_px": (1.6, 0.0)}, {"shift_px": (0.0, -2.0)}),
    "code": ({"code": False}, {"code": False}),
}
CORRECT = {pair: simulated_pair(number) for number, pair in enumerate(PAIRS)}
ONE_OR_TWO = [*combinations(PAIRS, 1), *combinations(PAIRS, 2)]


@pytest.mark.quick("a-c-*", "a-b+a-e-phase", "a-a+a-f-place", "a-d+a-e-code")
@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("wrong", ONE_OR_TWO, ids="+".join)
def test_one_or_two_wrong_pairs_of_six_are_excluded_from_the_sum(error, wrong):
    erroneous = {
        pair: simulated_pair(PAIRS.index(pair), **changes) for pair, changes in zip(wrong, ERRORS[error], strict=False)
    }
    fusion = fusion_of(CORRECT | erroneous)
    assert set(fusion.agreeing) == set(PAIRS) - set(wrong)
    assert set(fusion.excluded) == set(wrong)
    assert set(fusion.phases_rad) == set(fusion.agreeing)
    assert fusion.ties == ()
    assert fusion.unmeasured == {}
    assert set(fusion.apart) == (set() if error == "code" else set(wrong))


def test_two_pairs_in_phase_of_four_are_summed_whichever_is_focused_best():
    """The other pairs have phase offsets of 90° and 180°; the latter pair has the best focus."""
    images = dict(
        zip(
            PAIRS[:4],
            (CORRECT["a-a"], CORRECT["a-b"], simulated_pair(2, phase_rad=pi / 2), simulated_pair(3, phase_rad=pi)),
            strict=True,
        )
    )
    between = {
        (first, second): agreement(*zip(images[first], images[second], strict=True), **GEOMETRY)
        for first, second in combinations(images, 2)
    }
    rank = {"a-a": (0.2,), "a-b": (0.3,), "a-c": (0.1,), "a-d": (0.0,)}
    fusion = choose_fusion(rank, between, align=False)
    assert fusion.agreeing == ("a-a", "a-b")
    assert fusion.reference == "a-a"
    assert fusion.ties == ()
    assert fusion.report["aligning_phase_rad"]["a-c"] == pytest.approx(-pi / 2, abs=0.15)
    assert abs(fusion.report["aligning_phase_rad"]["a-d"]) == pytest.approx(pi, abs=0.15)
    aligned = choose_fusion(rank, between, align=True)
    assert set(aligned.phases_rad) == set(rank)
    assert aligned.phases_rad["a-d"] == 0.0
    assert aligned.phases_rad["a-c"] - aligned.phases_rad["a-a"] == pytest.approx(pi / 2 - 2 * pi, abs=0.15) or (
        aligned.phases_rad["a-c"] - aligned.phases_rad["a-a"] == pytest.approx(pi / 2, abs=0.15)
    )


def test_sets_of_equal_size_are_reported_as_a_tie():
    images = {pair: CORRECT[pair] for pair in PAIRS[:2]} | {
        PAIRS[number]: simulated_pair(number, phase_rad=2.0) for number in (2, 3)
    }
    fusion = fusion_of(images)
    assert fusion.agreeing == ("a-a", "a-b")
    assert fusion.ties == (("a-c", "a-d"),)
    fusion_of_two = fusion_of({pair: images[pair] for pair in ("a-a", "a-c")})
    assert (fusion_of_two.agreeing, fusion_of_two.ties) == (("a-a",), (("a-c",),))


def test_two_pairs_with_the_same_error_do_not_outvote_four():
    fusion = fusion_of(CORRECT | {pair: simulated_pair(PAIRS.index(pair), phase_rad=pi) for pair in ("a-a", "a-b")})
    assert fusion.agreeing == PAIRS[2:]
    assert fusion.ties == ()


def measured_agreement(phase_rad, *, std_rad=0.05, shift_m=0.0, cycles=0.0):
    """Return a measured agreement between two pairs with resolution cells of 0.4 m."""
    units = shift_m / 0.22
    return Agreement("bright points", 4, shift_m, 0.0, 0.01, units, 0.045, cycles, 0.1, phase_rad, std_rad, 0.99)


def test_phase_differences_that_do_not_close_are_rejected():
    rank = dict.fromkeys("abc", (0.0,))
    closed = {
        ("a", "b"): measured_agreement(0.3),
        ("b", "c"): measured_agreement(0.2),
        ("a", "c"): measured_agreement(0.5),
    }
    fusion = choose_fusion(rank, closed, align=False)
    assert (fusion.agreeing, fusion.freedom) == (("a", "b", "c"), 3)
    assert fusion.misfit == pytest.approx(0.0, abs=1e-9)
    open_triangle = closed | {("a", "c"): measured_agreement(-0.3)}
    assert len(choose_fusion(rank, open_triangle, align=True).agreeing) == 2


def test_aligning_phases_are_the_least_squares_solution():
    rank = {"a": (0.0,), "b": (1.0,), "c": (1.0,)}
    between = {
        ("a", "b"): measured_agreement(1.0, std_rad=0.2),
        ("b", "c"): measured_agreement(1.0, std_rad=0.02),
        ("a", "c"): measured_agreement(2.1, std_rad=0.02),
    }
    fusion = choose_fusion(rank, between, align=True)
    assert fusion.phases_rad["c"] == pytest.approx(2.1, abs=0.01)
    assert fusion.phases_rad["b"] == pytest.approx(1.1, abs=0.01)  # the path via c is ten times more accurate


def test_unmeasured_pair_is_summed_unless_it_lacks_points_of_others():
    rank = dict.fromkeys("abc", (0.0,))
    between = {("a", "b"): measured_agreement(0.1), ("a", "c"): None, ("b", "c"): None}
    fusion = choose_fusion(rank, between, align=False)
    assert fusion.agreeing == ("a", "b")
    assert fusion.phases_rad == {"a": 0.0, "b": 0.0, "c": 0.0}
    assert set(fusion.unmeasured) == {"c"}
    coarse = choose_fusion(rank, between, coarse="pixels of 0.2 m do not resolve cells of 0.1 m", align=False)
    assert coarse.unmeasured == {"c": "pixels of 0.2 m do not resolve cells of 0.1 m"}
    uncertain = choose_fusion(rank, between | {("a", "c"): measured_agreement(2.0, std_rad=0.7)}, align=False)
    assert "the standard deviation is too large" in uncertain.unmeasured["c"]
    hidden = choose_fusion(rank, between, hidden={("a", "c")}, align=False)
    assert "contains none of the bright points of a" in hidden.excluded["c"]
    assert hidden.unmeasured == {}


@pytest.mark.parametrize(
    ("shown", "points", "confirmed"), [(0, 1, False), (1, 1, True), (1, 5, True), (1, 8, False), (2, 8, True)]
)
def test_pair_is_confirmed_by_significantly_many_points(shown, points, confirmed):
    targets = [BrightPoint(20.0 + 20 * number, 96.0, 1.0) for number in range(points)]
    image = np.ones((SIDE, SIDE), np.complex64)
    for target in targets[:shown]:
        image[int(target.row), int(target.column)] = 5.0
    grid = SimpleNamespace(spacing_m=SPACING_M)
    first, second = (
        ComparedImage(image, targets, GEOMETRY["cell_m"], GEOMETRY["spectrum"], {}, np.empty(0), grid) for _ in "ab"
    )
    assert shows_points_of(first, second, grid) is confirmed


def test_false_alarm_rate_of_speckle_is_0_2_percent():
    generator, band = np.random.default_rng(1), band_mask((0.0, 0.0))
    detections = []
    for _ in range(20):
        white = generator.normal(size=(2, SIDE, SIDE))
        speckle = np.fft.ifft2(np.fft.fft2(white[0] + 1j * white[1]) * band)
        pixels = [(row, column) for row in range(32, SIDE - 32, 11) for column in range(32, SIDE - 32, 11)]
        detections += [has_point(speckle, *pixel, reach=round(CELL_PX)) for pixel in pixels]
    assert 0.0008 < np.mean(detections) < 0.004


def test_wrong_pair_is_excluded_from_many_pairs_without_exhaustive_search():
    rank = {f"p{number:02}": (0.0,) for number in range(14)}
    between = {pairs: measured_agreement(2.5 if "p03" in pairs else 0.0) for pairs in combinations(rank, 2)}
    fusion = choose_fusion(rank, between, align=False)
    assert "p03" in fusion.excluded
    assert len(fusion.agreeing) == 12


def test_path_error_of_one_wavelength_is_detected_by_the_displacement():
    """A displacement of 0.16 cells alone is not significant, but indicates a different carrier cycle."""
    same_cycle = measured_agreement(0.0, shift_m=0.065, cycles=0.4)
    other_cycle = measured_agreement(0.0, shift_m=0.065, cycles=0.9)
    assert not same_cycle.shifted
    assert other_cycle.shifted
    assert not measured_agreement(0.0, shift_m=0.03, cycles=0.9).shifted  # tolerated, below a tenth of a cell


@pytest.mark.slow
def test_phase_scatters_with_the_reported_deviation():
    normalised = []
    for draw in range(20):
        images = [
            simulated_pair(number, carrier=(0.05 + 0.3 * number, 0.2), clutter=0.12, draw=draw) for number in (0, 1)
        ]
        rasters, points = zip(*images, strict=True)
        first = [
            [min(candidates, key=lambda point: np.hypot(point.row - 45.0, point.column - 50.0))]
            for candidates in points
        ]
        measured = agreement(rasters, first, **GEOMETRY, alone=True)  # a single point has no measurable scatter
        normalised.append(measured.phase_rad / measured.phase_std_rad)
    assert 0.6 < np.sqrt(np.mean(np.square(normalised))) < 1.4


@pytest.mark.parametrize(("separation", "measured"), [(0.0, True), (0.1, True), (0.15, True), (0.3, False)])
def test_clutter_gives_the_phase_if_the_bands_overlap(separation, measured):
    generator = np.random.default_rng(5)
    ground, noise = (np.fft.fft2(white[0] + 1j * white[1]) for white in generator.normal(size=(2, 2, SIDE, SIDE)))
    first = np.fft.ifft2(ground * band_mask((0.2, 0.1)))
    second = 1j * np.fft.ifft2((ground + 0.5 * noise) * band_mask((0.2 + separation, 0.1)))
    result = agreement_of_ground((first, second), [WHOLE], **GEOMETRY)
    assert (result is not None) == measured
    if measured:
        assert result.by == "looks"
        assert result.phase_rad == pytest.approx(pi / 2, abs=3 * result.phase_std_rad)
        assert result.phase_std_rad < 0.1
        assert not result.shifted


def test_clutter_of_different_scenes_is_not_coherent():
    for draw in range(20):
        generator = np.random.default_rng(draw)
        scenes = generator.normal(size=(2, 2, SIDE, SIDE))
        images = [np.fft.ifft2(np.fft.fft2(scene[0] + 1j * scene[1]) * band_mask((0.2, 0.1))) for scene in scenes]
        assert agreement_of_ground((images[0], images[1]), [WHOLE], **GEOMETRY) is None


def displaced_points(generator, count, side_m, shift_m):
    """Return the points of two images, each with a separate displacement in the second image, metres."""
    positions = generator.uniform(0, side_m, (count, 2))
    first, second = (
        [BrightPoint(y / SPACING_M, x / SPACING_M, 1.0) for x, y in image_positions]
        for image_positions in (positions, positions + shift_m)
    )
    return first, second


@pytest.mark.parametrize("displacement_m", [0.0, 0.3, 0.6, 1.0, 1.5])
def test_unequal_displacements_of_points_are_detected(displacement_m):
    """The displacement due to a height error depends on the look angle and is opposite on opposite sides."""
    generator = np.random.default_rng(3)
    direction = generator.uniform(0.5, 1.5, (5, 2)) * [1.0, 0.3]
    image = np.ones((400, 400), np.complex64)
    result = agreement((image, image), displaced_points(generator, 5, 12.0, displacement_m * direction), **GEOMETRY)
    assert result is not None
    assert result.points >= 3
    assert result.shifted is (displacement_m > 0)


@pytest.mark.slow
def test_points_of_different_scenes_are_not_matched():
    """At most three false matches occur in 1000 draws."""
    generator, image = np.random.default_rng(4), np.ones((400, 400), np.complex64)
    matches = 0
    for _ in range(1000):
        first, _ = displaced_points(generator, generator.integers(3, 9), 12.0, np.zeros(2))
        second, _ = displaced_points(generator, generator.integers(3, 9), 12.0, np.zeros(2))
        result = agreement((image, image), (first, second), **GEOMETRY)
        matches += result is not None and result.spread
    assert matches <= 3
