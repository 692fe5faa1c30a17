"""Change detection: probabilities of unchanged terrain by Monte Carlo, points, regions, flags."""

import numpy as np
import pytest
from scipy import stats

from apertura.methods.change.detection import (
    BRIGHTER,
    CLASS_NAMES,
    DARKER,
    INCOHERENT,
    NO_DATA,
    UNCHANGED,
    change_flags,
    change_regions,
    detect_changes,
)
from apertura.methods.change.statistics import (
    CoherenceDistribution,
    matched_looks,
    ratio_probability,
    window_modes,
)

WINDOW = 9


def draw(generator, *shape):
    return generator.normal(size=shape) + 1j * generator.normal(size=shape)


def speckle(generator, size, coherence=0.95, half_band=0.25, rows=None):
    """Return two images of unchanged terrain with a Hann-shaped spectrum, half as wide as the sampling rate."""
    shape = (rows or size, size)
    weights = [
        np.where(np.abs(f) < half_band, np.cos(np.pi / 2 * f / half_band) ** 2, 0) for f in map(np.fft.fftfreq, shape)
    ]
    common, own = (np.fft.ifft2(np.fft.fft2(draw(generator, *shape)) * np.multiply.outer(*weights)) for _ in range(2))
    common, own = (plane / np.sqrt((np.abs(plane) ** 2).mean()) for plane in (common, own))
    second = coherence * common + np.sqrt(1 - coherence**2) * own
    return common.astype(np.complex64), second.astype(np.complex64)


def point(size, row, column, half_band=0.25):
    """Return the response of a point, peak 1."""
    spectrum = np.fft.fft2(np.where(np.indices((size, size)).sum(axis=0) == -1, 0, 0).astype(complex))
    f = np.fft.fftfreq(size)
    weight = np.where(np.abs(f) < half_band, np.cos(np.pi / 2 * f / half_band) ** 2, 0)
    spectrum = np.multiply.outer(weight * np.exp(-2j * np.pi * f * row), weight * np.exp(-2j * np.pi * f * column))
    response = np.fft.ifft2(spectrum)
    return response / np.abs(response).max()


def within_binomial(count, trials, rate, clustered=1.0):
    """Return True if a count lies within 4 standard deviations of its expectation; each event counts `clustered`."""
    return abs(count - trials * rate) < 4 * np.sqrt(trials * rate * clustered) + 1


@pytest.mark.parametrize("coherence", [0.0, 0.6, 0.95])
@pytest.mark.parametrize("looks", [4, 12])
def test_power_ratio_of_correlated_speckle_exceeds_its_threshold_at_the_rate(looks, coherence):
    generator, trials = np.random.default_rng(looks), 60_000
    first, own = draw(generator, trials, looks), draw(generator, trials, looks)
    second = coherence * first + np.sqrt(1 - coherence**2) * own
    log_ratio = np.log((np.abs(second) ** 2).sum(axis=1) / (np.abs(first) ** 2).sum(axis=1))
    probability = ratio_probability(log_ratio, np.full(trials, coherence), looks)
    for rate in (0.1, 1e-2, 1e-3):
        assert within_binomial((probability < rate).sum(), trials, rate)


@pytest.mark.parametrize("coherence", [0.0, 0.6, 0.95])
@pytest.mark.parametrize("looks", [4, 12])
def test_estimated_coherence_falls_below_its_threshold_at_the_rate(looks, coherence):
    generator, trials = np.random.default_rng(looks), 60_000
    first, own = draw(generator, trials, looks), draw(generator, trials, looks)
    second = coherence * first + np.sqrt(1 - coherence**2) * own
    powers = [(np.abs(image) ** 2).sum(axis=1) for image in (first, second)]
    estimate = np.abs((first * second.conj()).sum(axis=1)) / np.sqrt(powers[0] * powers[1])
    distribution = CoherenceDistribution(float(looks))
    probability = distribution.probability(estimate, np.full(trials, coherence))
    for rate in (0.1, 1e-2, 1e-3):
        assert within_binomial((probability < rate).sum(), trials, rate)
        assert within_binomial((estimate < distribution.quantile(rate, coherence)).sum(), trials, rate)


def test_coherence_distribution_is_a_mixture_of_beta_distributions():
    looks, coherence, estimate = 7.5, 0.8, 0.5
    order = np.arange(2000)
    mixture = stats.nbinom.pmf(order, looks, 1 - coherence**2) @ stats.beta.cdf(estimate**2, order + 1, looks - 1)
    found = CoherenceDistribution(looks).probability(np.array([estimate]), np.array([coherence]))[0]
    assert found == pytest.approx(mixture, rel=2e-3)


def test_matched_looks_give_the_rate_for_unequal_modes():
    generator, trials, rate = np.random.default_rng(1), 200_000, 1e-3
    modes = np.repeat([0.2, 0.01], [4, 20])
    sums = [generator.exponential(size=(trials, len(modes))) @ modes for _ in range(2)]
    log_ratio = np.log(sums[0] / sums[1])
    none = np.zeros(trials)
    matched = ratio_probability(log_ratio, none, matched_looks(modes, rate)) < rate
    assert within_binomial(matched.sum(), trials, rate)
    by_variance = ratio_probability(log_ratio, none, 1 / (modes**2).sum()) < rate
    assert by_variance.sum() < 0.6 * trials * rate


def test_modes_of_a_window_equal_the_spread_of_its_mean_power():
    image = speckle(np.random.default_rng(2), 720)[0]
    blocks = (np.abs(image) ** 2).reshape(80, WINDOW, 80, WINDOW).mean(axis=(1, 3))
    modes = window_modes(image, WINDOW)
    assert 1 / (modes**2).sum() == pytest.approx(blocks.mean() ** 2 / blocks.var(), rel=0.08)


def test_modes_do_not_depend_on_the_carrier():
    image = speckle(np.random.default_rng(8), 256)[0]
    along = np.arange(256)
    chirp = np.exp(1j * np.add.outer(2.3 * along, 1.1 * along + 0.01 * along**2))  # the carrier varies over the scene
    looks = [1 / (window_modes(one.astype(np.complex64), WINDOW) ** 2).sum() for one in (image, image * chirp)]
    assert looks[1] == pytest.approx(looks[0], rel=0.03)


@pytest.mark.parametrize("coherence", [0.0, 0.6, 0.95])
def test_scores_of_a_window_have_students_distribution_for_any_coherence(coherence):
    generator, trials, looks = np.random.default_rng(9), 60_000, 6
    first, own = draw(generator, trials, looks), draw(generator, trials, looks)
    second = coherence * first + np.sqrt(1 - coherence**2) * own
    powers = [(np.abs(image) ** 2).sum(axis=1) for image in (first, second)]
    crossed = (second * first.conj()).sum(axis=1) / np.sqrt(powers[0] * powers[1])
    noise = (1 - np.abs(crossed) ** 2) / (2 * looks - 2)
    for score in (np.sinh(np.log(powers[1] / powers[0]) / 2), crossed.imag):
        probability = 2 * stats.t.sf(np.abs(score) / np.sqrt(noise), 2 * looks - 2)
        for rate in (0.1, 1e-2, 1e-3):
            assert within_binomial((probability < rate).sum(), trials, rate)


@pytest.mark.slow
@pytest.mark.parametrize(("coherence", "expected"), [(0.5, 0.5), (0.95, 0.95), (0.8, 0.95)])
def test_pixels_of_unchanged_terrain_are_reported_at_the_rate(coherence, expected):
    rate, counts, pixels = 1e-3, np.zeros(2), 0
    for number in range(3):
        first, second = speckle(np.random.default_rng(number), 512, coherence)
        changes = detect_changes(first, 3 * second, np.full(first.shape, expected), window=WINDOW, rate=rate)
        changed = changes.classes[changes.classes != NO_DATA]
        counts += np.isin(changed, (BRIGHTER, DARKER)).sum(), (changed == INCOHERENT).sum()
        pixels += len(changed)
        assert changes.gain_db == pytest.approx(20 * np.log10(3), abs=0.1)
        assert changes.scene_ratio == pytest.approx(coherence / expected, abs=0.02)
    for count in counts:  # events last for about half a window along each axis
        assert within_binomial(count, pixels, rate / 2, clustered=(WINDOW / 2) ** 2)


@pytest.mark.slow
def test_decorrelated_terrain_without_change_of_amplitude_is_a_coherent_change():
    generator = np.random.default_rng(3)
    first, second = speckle(generator, 384)
    second[:, 192:] = speckle(generator, 384)[1][:, 192:]  # half of the scene
    changes = detect_changes(first, second, np.full(first.shape, 0.95), window=WINDOW, rate=1e-3)
    right = changes.classes[20:-20, 240:-20]
    assert (right == INCOHERENT).mean() > 0.95
    assert np.isin(right, (BRIGHTER, DARKER)).mean() < 3e-3
    assert np.isin(changes.classes[20:-20, 20:150], (BRIGHTER, DARKER, INCOHERENT)).mean() < 3e-3


def test_point_is_compared_by_its_amplitude_and_phase():
    generator, size = np.random.default_rng(4), 128
    response = 60 * point(size, 64, 64)
    first, second = speckle(generator, size)

    def kind(factor, phase_std_rad=0.0):
        images = (first + response).astype(np.complex64), (second + factor * response).astype(np.complex64)
        changes = detect_changes(*images, np.full(first.shape, 0.95), window=WINDOW, rate=1e-4,
                                 phase_std_rad=phase_std_rad)  # fmt: skip
        return changes.classes[64, 64]

    assert kind(1.0) == UNCHANGED
    assert kind(1.1) == UNCHANGED  # 0.8 dB are within the accuracy of the gain
    assert kind(3.0) == BRIGHTER
    assert kind(0.0) == DARKER
    assert kind(np.exp(1j)) == INCOHERENT
    assert kind(np.exp(1j), phase_std_rad=1.0) == UNCHANGED


@pytest.mark.slow
def test_steady_points_cause_no_false_alarms_in_the_windows_beside():
    generator, size = np.random.default_rng(10), 256
    first, second = speckle(generator, size)
    response = sum(40 * point(size, row, column) for row in (50, 128, 210) for column in (45, 130, 205))
    # aspect angle and noise change each point slightly; its sidelobes change with it
    images = (first + response).astype(np.complex64), (second + 1.03 * np.exp(0.05j) * response).astype(np.complex64)
    changes = detect_changes(*images, np.full(first.shape, 0.95), window=WINDOW, rate=1e-3, phase_std_rad=0.1)
    changed = ~np.isin(changes.classes, (UNCHANGED, NO_DATA))
    assert changed.sum() < 3 * 1e-3 * changes.valid


def test_regions_list_what_appeared_and_vanished_with_confidence():
    generator, size = np.random.default_rng(5), 256
    first, second = speckle(generator, size)
    first = (first + 10 * point(size, 60, 60)).astype(np.complex64)
    second = (second + 10 * point(size, 180, 190)).astype(np.complex64)
    changes = detect_changes(first, second, np.full(first.shape, 0.95), window=WINDOW, rate=1e-5)
    regions, labels = change_regions(changes, window=WINDOW, least_pixels=WINDOW**2 / 2)
    kinds = {region.kind: (region.row, region.column) for region in regions}
    assert sorted(kinds) == ["brighter", "darker"]
    assert np.abs(np.array(kinds["darker"]) - 60).max() <= WINDOW // 2
    assert np.abs(np.array(kinds["brighter"]) - [180, 190]).max() <= WINDOW // 2
    for region in regions:
        assert region.confidence > 0.999
        assert (labels == region.number).sum() == region.pixels


@pytest.mark.slow
def test_expected_number_of_false_regions_is_an_upper_limit():
    expected = 2.0
    scenes, found = 12, 0
    for number in range(scenes):
        first, second = speckle(np.random.default_rng(number), 160, 0.9)
        changes = detect_changes(first, second, np.full(first.shape, 0.9), window=WINDOW, rate=1e-2)
        found += sum(region.expected_false < expected for region in change_regions(changes, window=WINDOW)[0])
    assert 0.1 * scenes * expected < found < scenes * expected + 3 * np.sqrt(scenes * expected)


@pytest.mark.slow
def test_windows_without_data_are_not_classified():
    first, second = speckle(np.random.default_rng(6), 96)
    second[:, 40] = np.nan
    changes = detect_changes(first, second, np.full(first.shape, 0.95), window=WINDOW, rate=1e-3)
    assert (changes.classes[:, 36:45] == NO_DATA).all()
    assert (changes.classes[:4] == NO_DATA).all()
    assert changes.classes[40, 30] == UNCHANGED
    assert np.isnan(changes.ratio_db[:, 40]).all()
    empty = detect_changes(first, np.full_like(first, np.nan), np.ones(first.shape), window=WINDOW, rate=1e-3)
    assert empty.valid == 0
    assert not change_flags(empty)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("window", "coherence", "expected", "flags"),
    [
        (WINDOW, 0.95, 0.95, []),
        (1, 0.95, 0.95, ["change_looks"]),
        (WINDOW, 0.3, 0.3, ["change_insensitive"]),
        (2 * WINDOW + 1, 0.8, 0.95, ["change_decorrelated"]),
    ],
)
def test_limits_are_flagged(window, coherence, expected, flags):
    first, second = speckle(np.random.default_rng(7), 192, coherence)
    changes = detect_changes(first, second, np.full(first.shape, expected), window=window, rate=1e-4)
    assert sorted(change_flags(changes)) == flags


def test_class_names_cover_all_classes_with_data():
    assert set(CLASS_NAMES) == {UNCHANGED, BRIGHTER, DARKER, INCOHERENT}
