"""Scans of a PulsON radar: recorded echoes are read back, damaged scans are dropped or rejected."""

import numpy as np
import pytest
from folders import complaint
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.formats.phase_histories.pulson import BAND_HZ, MESSAGE, SAMPLE_RATE_HZ, read_pulson

TOTAL, START_PS = 800, 10_000
MESSAGES = -(-TOTAL // 350)


def echo_of(path_m):
    """Return the real samples of a delayed pulse that fills the band."""
    delay_s = path_m / SPEED_OF_LIGHT_M_S - START_PS * 1e-12
    frequency = np.arange(TOTAL // 2 + 1) * SAMPLE_RATE_HZ / TOTAL
    inside = (frequency >= BAND_HZ[0]) & (frequency <= BAND_HZ[1])
    return np.fft.irfft(inside * np.exp(-2j * np.pi * frequency * delay_s), TOTAL) * 1e7


def recorded(paths_m):
    messages = np.zeros((len(paths_m), MESSAGES), MESSAGE)
    messages["type"], messages["source"], messages["step_bins"], messages["kind"] = 0xF201, 1, 32, 1
    messages["start_ps"] = START_PS
    messages["stop_ps"] = START_PS + round(TOTAL / SAMPLE_RATE_HZ * 1e12)
    messages["total"], messages["messages"], messages["antenna"] = TOTAL, MESSAGES, 2
    messages["index"] = np.arange(MESSAGES)
    messages["id"] = np.arange(len(paths_m))[:, None]
    messages["time_ms"] = 1_000_000 + 20 * np.arange(len(paths_m))[:, None]
    scans = np.zeros((len(paths_m), MESSAGES * 350))
    scans[:, :TOTAL] = [echo_of(path_m) for path_m in paths_m]
    messages["scan"] = scans.reshape(len(paths_m), MESSAGES, 350).round()
    return bytes(32) + messages.tobytes()


def written(path, content):
    path.write_bytes(content)
    return read_pulson([path], pair="a-a")


def test_phase_of_a_scan_follows_its_path(tmp_path):
    paths_m = np.array([8.0, 8.1, 9.3])
    history = written(tmp_path / "a.out", recorded(paths_m))
    delay_s = paths_m[:, None] / SPEED_OF_LIGHT_M_S - history.reference_delay.values[:, None]
    expected = np.exp(-2j * np.pi * history.frequency.values * delay_s)
    np.testing.assert_allclose(history.transfer / abs(history.transfer), expected, atol=1e-4)
    assert np.diff(history.time.values).astype(int).tolist() == [20_000_000] * 2
    assert history.attrs["flags"] == {}


def test_incomplete_scan_is_dropped_and_counted(tmp_path):
    whole = recorded(8 + 0.1 * np.arange(6))
    size = MESSAGE.itemsize
    cut = written(tmp_path / "a.out", whole[:-size])
    assert cut.sizes["pulse"] == 5
    assert cut.attrs["flags"]["scans_incomplete"] == "1 of 6 scans"
    lacking = written(tmp_path / "b.out", whole[: 32 + 4 * size] + whole[32 + 5 * size :])
    assert lacking.sizes["pulse"] == 5


@pytest.mark.parametrize("content", [b"", bytes(32), b"a log of something else " * 200, bytes(5000)])
def test_other_file_is_rejected(tmp_path, content):
    assert "MRM_SCAN_INFO" in complaint(lambda: written(tmp_path / "a.out", content))


@tried(60, derandomize=False)
@given(at=st.integers(0, 32 + 6 * MESSAGES * MESSAGE.itemsize - 1), bit=st.integers(0, 7), last=st.integers(40, 20_000))
def test_flipped_bits_and_truncation_change_no_scan_time(tmp_path_factory, at, bit, last):
    paths_m = 8 + 0.1 * np.arange(6)
    content = bytearray(recorded(paths_m))
    content[at] ^= 1 << bit
    path = tmp_path_factory.mktemp("scans") / "a.out"
    try:
        history = written(path, bytes(content[:last]))
    except CampaignError:
        return
    sent = 1_000_000 + 20 * np.arange(6)
    millisecond = np.timedelta64(1, "ms")
    assert set(((history.time.values - np.datetime64(0, "s")) // millisecond).tolist()) <= set(sent.tolist())


@pytest.mark.parametrize("lost", [1, 7, MESSAGE.itemsize - 5, MESSAGE.itemsize - 1])
def test_truncated_last_scan_is_counted_once(tmp_path, lost):
    whole, size = recorded(8 + 0.1 * np.arange(6)), MESSAGE.itemsize
    for messages in range(MESSAGES):
        cut = written(tmp_path / "a.out", whole[: len(whole) - messages * size - lost])
        assert cut.sizes["pulse"] == 5
        assert cut.attrs["flags"]["scans_incomplete"] == "1 of 6 scans"
    assert written(tmp_path / "a.out", whole + bytes([0xF2, 0x02, 0])).attrs["flags"] == {}
