"""Association of the pulses of two nodes: pairs are correct, and ambiguous cases raise flags or errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.errors import CampaignError
from apertura.core.echo.association import EXPLAINED_M, associate, baseline_residual, detect_wrong_association

NS = 1_000_000_000


def fly(rng, pulses=400, interval_s=0.05, *, offset_s=0.0, jitter_s=0.0, drift_ppm=0.0, missed=0.0, tx_missed=0.0):
    """Return tags of transmitter and receiver, and the true pulse numbers of both."""
    truth = np.arange(pulses)
    tx = truth[(rng.random(pulses) >= tx_missed)]
    rx = truth[(rng.random(pulses) >= missed)]
    tags = [numbers * interval_s + rng.normal(0, jitter_s, numbers.size) for numbers in (tx, rx)]
    tags[1] = tags[1] * (1 + drift_ppm * 1e-6) + offset_s
    return (np.sort((t * NS).astype(np.int64)) + 1_747_000_000 * NS for t in tags), (tx, rx)


def share_right(pairs, numbers):
    return np.mean(numbers[0][pairs.tx_index] == numbers[1][pairs.rx_index])


@pytest.mark.parametrize("offset_s", [-0.019, -0.004, 0.0, 0.003, 0.019])
@pytest.mark.parametrize("jitter_s", [0.0, 0.003])
def test_missed_pulses_on_both_sides_keep_every_pair_correct(offset_s, jitter_s):
    rng = np.random.default_rng(1)
    (tx, rx), numbers = fly(rng, offset_s=offset_s, jitter_s=jitter_s, missed=0.2, tx_missed=0.1)
    pairs = associate(tx, rx, repetition_interval_s=0.05)
    common = np.intersect1d(*numbers).size
    assert share_right(pairs, numbers) == 1.0
    assert pairs.tx_index.size == common
    assert (pairs.tx_dropped, pairs.rx_dropped) == (tx.size - common, rx.size - common)
    assert pairs.offset_s == pytest.approx(offset_s, abs=0.0012)
    assert pairs.method == "time tags"
    assert pairs.flags == {}


@pytest.mark.parametrize("drift_ppm", [-100.0, 35.0, 100.0])
def test_drift_beyond_a_repetition_interval_is_followed(drift_ppm):
    (tx, rx), numbers = fly(
        np.random.default_rng(2),
        40_000,
        0.01,
        offset_s=0.002,
        jitter_s=0.0005,
        drift_ppm=drift_ppm,
        missed=0.1,
        tx_missed=0.05,
    )
    pairs = associate(tx, rx, repetition_interval_s=0.01)
    assert abs(drift_ppm) * 1e-6 * 400 > 0.01  # the drift exceeds an interval
    assert share_right(pairs, numbers) == 1.0
    assert pairs.drift_ppm == pytest.approx(drift_ppm, abs=2)


def test_long_gap_in_either_recording_is_bridged():
    (tx, rx), numbers = fly(np.random.default_rng(3), 1000, offset_s=0.01, jitter_s=0.002)
    keep_tx, keep_rx = np.r_[0:200, 420:1000], np.r_[0:500, 760:1000]
    pairs = associate(tx[keep_tx], rx[keep_rx], repetition_interval_s=0.05)
    assert share_right(pairs, (numbers[0][keep_tx], numbers[1][keep_rx])) == 1.0
    assert pairs.tx_index.size == 200 + 80 + 240


def test_late_receiver_is_paired_from_its_first_pulse():
    (tx, rx), _ = fly(np.random.default_rng(4), 300, offset_s=-0.015)
    pairs = associate(tx, rx[250:], repetition_interval_s=0.05)
    assert pairs.tx_index[0] == 250
    assert pairs.tx_index.size == 50


@pytest.mark.parametrize(("offset_s", "flagged"), [(0.0195, False), (0.0205, True), (-0.0195, False), (-0.0205, True)])
def test_offset_near_half_an_interval_is_flagged(offset_s, flagged):
    (tx, rx), _ = fly(np.random.default_rng(5), offset_s=offset_s)
    pairs = associate(tx, rx, repetition_interval_s=0.05)
    assert ("association_ambiguous" in pairs.flags) == flagged


@pytest.mark.parametrize(("jitter_s", "flagged"), [(0.0008, False), (0.0015, True)])
def test_jitter_too_large_for_the_interval_is_flagged(jitter_s, flagged):
    (tx, rx), numbers = fly(np.random.default_rng(6), interval_s=0.01, jitter_s=jitter_s, missed=0.05)
    pairs = associate(tx, rx, repetition_interval_s=0.01)
    assert ("time_tag_jitter" in pairs.flags) == flagged
    assert (share_right(pairs, numbers) == 1.0) or flagged


@pytest.mark.parametrize(("common", "flagged"), [(200, False), (199, True)])
def test_small_overlap_of_recordings_is_flagged(common, flagged):
    tx = np.arange(400) * (NS // 20)
    rx = tx + (400 - common) * (NS // 20)
    pairs = associate(tx, rx, repetition_interval_s=0.05)
    assert pairs.tx_index.size == common
    assert ("association_sparse" in pairs.flags) == flagged


def test_recordings_of_different_flights_are_rejected():
    (tx, rx), _ = fly(np.random.default_rng(8), 100)
    found = r"differ by \+18\.000 s and \+18\.000 s from.*half a repetition interval \(0\.025 s\)"
    with pytest.raises(CampaignError, match=found):
        associate(tx, rx + 18 * NS, repetition_interval_s=0.05)


def test_decreasing_time_tag_is_named():
    tags = np.arange(10) * NS
    with pytest.raises(CampaignError, match="pulse 4 of the receiver"):
        associate(tags, np.array([0, 1, 2, 3, 3, 5]) * NS, repetition_interval_s=1.0)


@pytest.mark.parametrize(("offset_s", "flagged"), [(0.019, False), (0.021, True), (-0.019, False), (-0.021, True)])
def test_large_tag_offset_is_flagged_with_the_distance_flown(offset_s, flagged):
    (tx, rx), _ = fly(np.random.default_rng(5), interval_s=0.1, offset_s=offset_s)
    flags = associate(tx, rx, repetition_interval_s=0.1, speed_m_s=12.0).flags
    assert ("time_tag_offset" in flags) == flagged
    assert not flagged or flags["time_tag_offset"].endswith("in this time, the transmitter moved by 0.25 m")


@pytest.mark.parametrize(("late_s", "excluded"), [(0.004, False), (0.006, True)])
def test_outlying_time_tag_is_flagged(late_s, excluded):
    (tx, rx), _ = fly(np.random.default_rng(5), jitter_s=0.0002)
    rx[70] += int(late_s * NS)
    pairs = associate(tx, rx, repetition_interval_s=0.05)
    assert np.flatnonzero(pairs.outlier).tolist() == [70] * excluded
    assert ("time_tag_outlier" in pairs.flags) == excluded


def test_uniform_jitter_has_no_outlier():
    (tx, rx), _ = fly(np.random.default_rng(5), jitter_s=0.005)
    assert not associate(tx, rx, repetition_interval_s=0.05).outlier.any()


@pytest.mark.parametrize(("early", "flagged"), [(20, False), (21, True)])
def test_unpaired_pulses_are_flagged_above_5_percent(early, flagged):
    (tx, rx), _ = fly(np.random.default_rng(5))
    assert ("pulses_unpaired" in associate(tx, rx[early:], repetition_interval_s=0.05).flags) == flagged
    assert associate(tx[early:], rx, repetition_interval_s=0.05).flags == {}  # all pulses of the transmitter are paired


def test_offset_of_integer_intervals_is_reported():
    (tx, rx), _ = fly(np.random.default_rng(5), pulses=130, jitter_s=0.001)
    shifted = associate(tx, rx + NS // 2, repetition_interval_s=0.05).flags["pulses_unpaired"]
    assert shifted.startswith("of 130 transmitted pulses, 10 are before and 0 after the recording of the receiver: ")
    assert "equally long, and their starts differ by +0.499 s" in shifted
    assert "equally" not in associate(tx, rx[10:], repetition_interval_s=0.05).flags["pulses_unpaired"]


@pytest.mark.parametrize("offset_s", [0.0, 0.06, 1.3])
def test_wrapping_frame_counters_override_tag_offsets(offset_s):
    (tx, rx), numbers = fly(np.random.default_rng(9), 1500, offset_s=offset_s, jitter_s=0.003, missed=0.2)
    frames = [(n + 40) % 64 for n in numbers]
    pairs = associate(tx, rx, repetition_interval_s=0.05, tx_frame=frames[0], rx_frame=frames[1])
    assert pairs.method == "frame counter"
    assert share_right(pairs, numbers) == 1.0
    assert pairs.tx_index.size == rx.size
    assert ("time_tag_offset" in pairs.flags) == (offset_s > 0.025)


def test_gap_of_several_counter_periods_is_bridged():
    (tx, rx), numbers = fly(np.random.default_rng(10), 2000, jitter_s=0.003)
    keep = np.r_[0:100, 1234:2000]
    pairs = associate(
        tx, rx[keep], repetition_interval_s=0.05, tx_frame=numbers[0] % 256, rx_frame=numbers[1][keep] % 256
    )
    assert share_right(pairs, (numbers[0], numbers[1][keep])) == 1.0
    assert pairs.tx_index.size == keep.size


def test_pulses_without_a_number_are_paired_by_time_tags():
    rng = np.random.default_rng(11)
    (tx, rx), numbers = fly(rng, 500, offset_s=0.02, jitter_s=0.002, missed=0.1)
    frame = np.where(rng.random(rx.size) < 0.3, -1, numbers[1])
    pairs = associate(tx, rx, repetition_interval_s=0.05, tx_frame=numbers[0], rx_frame=frame)
    assert pairs.method == "frame counter"
    assert pairs.rx_dropped == 0
    assert share_right(pairs, numbers) == 1.0


def test_misread_number_is_dropped_and_flagged():
    (tx, rx), numbers = fly(np.random.default_rng(12), 300)
    frame = numbers[1].copy()
    frame[150] = 42  # the number of a pulse seven seconds earlier
    frame[42] = -1
    pairs = associate(tx, rx, repetition_interval_s=0.05, tx_frame=numbers[0], rx_frame=frame, frame_modulus=1024)
    assert share_right(pairs, numbers) == 1.0
    assert pairs.flags["frame_counter_conflict"].startswith("1 pulse excluded")


def test_without_numbers_time_tags_decide():
    (tx, rx), numbers = fly(np.random.default_rng(13), 50)
    pairs = associate(tx, rx, repetition_interval_s=0.05, tx_frame=numbers[0], rx_frame=np.full(rx.size, -1))
    assert pairs.method == "time tags"


def sidelink_of_a_flight(rng, wrong_from, lag, jitter_m=0.03):
    """Return paths of a receiver that overtakes at 1 m/s, with a wrong association by `lag` from one pulse on."""
    time = np.arange(400) * 0.05
    distance = np.hypot(4.7, time - 10) + 0.2 * np.sin(time)
    associated = np.arange(400)
    associated[wrong_from:] = np.clip(associated[wrong_from:] + lag, 0, 399)
    return distance + 12.0 + rng.normal(0, jitter_m, 400), distance[associated]


@pytest.mark.parametrize(("lag", "detected"), [(0, False), (1, False), (20, True), (-20, True)])
def test_wrong_association_is_detected_in_the_sidelink(lag, detected):
    measured, predicted = sidelink_of_a_flight(np.random.default_rng(14), 130, lag)
    message = detect_wrong_association(baseline_residual(measured, predicted))
    assert (message is not None) == detected


def test_outliers_of_the_sidelink_are_no_wrong_association():
    measured, predicted = sidelink_of_a_flight(np.random.default_rng(15), 400, 0)
    measured[[77, 200]] += 9.0
    measured[300:320] = np.nan
    assert detect_wrong_association(baseline_residual(measured, predicted)) is None


@pytest.mark.slow
def test_correct_associations_with_jitter_raise_no_false_alarm():
    """Gaussian or uniform trigger jitter of 1 mm to 3 m, 30 to 800 pulses: at most one false alarm in 500 draws."""
    alarms = 0
    for seed in range(500):
        rng = np.random.default_rng(seed)
        time, jitter_m = np.arange(rng.integers(30, 800)) * 0.05, 10 ** rng.uniform(-3, 0.5)
        distance = np.hypot(4.7, rng.uniform(0.2, 2) * (time - time.mean())) + 0.2 * np.sin(time * rng.uniform(0.5, 2))
        jitter = rng.normal(0, jitter_m, time.size) if seed % 2 else rng.uniform(-jitter_m, jitter_m, time.size)
        residual = baseline_residual(distance + 12 + 1e-3 * time + jitter, distance)
        alarms += detect_wrong_association(residual) is not None
    assert alarms <= 1


@pytest.mark.parametrize(("size_m", "found"), [(0.8, False), (1.25, True)])
def test_slow_displacement_above_the_limit_is_found(size_m, found):
    """A jitter of 0.15 m hides displacements of 16 cm or more in medians of 15 pulses, but not in longer medians."""
    rng = np.random.default_rng(3)
    time = np.arange(1600) / 20
    displacement_m = size_m * EXPLAINED_M * np.cos(2 * np.pi * time / 40)
    residual = baseline_residual(5 + displacement_m + rng.normal(0, 0.005, time.size), np.full(time.size, 5.0))
    assert residual.jitter_m == pytest.approx(0.005, rel=0.1)
    assert (detect_wrong_association(residual) is not None) == found
    hidden = baseline_residual(5 + 4 * displacement_m + rng.normal(0, 0.15, time.size), np.full(time.size, 5.0))
    assert hidden.excess > 1
    assert hidden.noise_m < 0.03


def test_pulses_at_the_ends_are_counted_once():
    """An outlier in the last pulse of a flight is not reported as a displacement."""
    measured = 5 + np.random.default_rng(5).normal(0, 0.02, 60)
    measured[[0, -1]] += 1.0
    assert detect_wrong_association(baseline_residual(measured, np.full(60, 5.0))) is None


@tried(50)
@given(
    seed=st.integers(0, 2**32 - 1),
    offset=st.floats(-0.4, 0.4),
    reach=st.floats(0, 0.2),
    lost=st.tuples(st.floats(0, 0.4), st.floats(0, 0.4)),
    drift_ppm=st.floats(-100, 100),
)
def test_jitter_below_half_an_interval_keeps_pairs_correct(seed, offset, reach, lost, drift_ppm):
    """Time tags with a relative jitter of up to 0.4 of an interval, about an offset of up to 0.4 of an interval."""
    rng, interval_ns = np.random.default_rng(seed), 50_000_000
    numbers = [np.flatnonzero(rng.random(150) >= share) for share in lost]
    tags = [n * interval_ns + (rng.uniform(-reach, reach, n.size) * interval_ns).astype(np.int64) for n in numbers]
    tags[1] = tags[1] + (offset * interval_ns + tags[1] * drift_ppm * 1e-6).astype(np.int64)
    pairs = associate(*tags, repetition_interval_s=0.05)
    assert share_right(pairs, numbers) == 1.0
    assert pairs.tx_index.size == np.intersect1d(*numbers).size
