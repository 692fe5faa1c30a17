"""Damaged logs (cut, reordered, flipped bits): epochs are lost or the log is rejected; others are unchanged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.errors import CampaignError
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from tests.attack import logs

TIMES, PLACES = logs.circle()
PLAIN = [f"{time}Z,{a:.9f},{b:.9f},{h:.6f}" for time, (a, b, h) in zip(TIMES, PLACES, strict=True)]
LOGS = {
    "csv": ("a.track.csv", "\n".join(["time_utc,latitude_deg,longitude_deg,height_m", *PLAIN]) + "\n", {}),
    "rtklib": ("a.track.pos", logs.solution(TIMES, PLACES, "latitude(deg) longitude(deg) height(m)"), {}),
    "nmea": ("a.track.nmea", logs.nmea(TIMES, PLACES), {}),
    "airdata": ("a.track.csv", logs.airdata(TIMES, PLACES), {"height_offset_m": 48.0}),
    "optitrack": (
        "a.track.csv",
        logs.capture(np.arange(12) / 360, logs.poses()),
        {"start_utc": "2025-05-14", "body": "Radar"},
    ),
}
HEADING = {"csv": 1, "rtklib": 2, "nmea": 0, "airdata": 1, "optitrack": 7}
SHIFT = {"airdata": np.timedelta64(150, "ms")}
"""Tolerated time offset, since the fraction of a second is estimated from all epochs."""

PROPERTY = tried(60)


def read(folder, kind, data):
    """Return the track of a damaged log, or None if the log is rejected."""
    name, _, options = LOGS[kind]
    (folder / name).write_bytes(data)
    try:
        return read_track(folder / name, node="a", options=LogOptions(**options))
    except CampaignError:
        return None


def changed_epochs(track, whole, kind):
    """Return the number of epochs that differ from all epochs of the undamaged log in position or time."""
    if track is None:
        return 0
    nearest = np.abs(track.position.values[:, None] - whole.position.values).max(axis=2).argmin(axis=1)
    off = np.abs(track.position.values - whole.position.values[nearest]).max(axis=1) > 1e-9
    late = np.abs(track.time.values - whole.time.values[nearest]) > SHIFT.get(kind, np.timedelta64(0, "ns"))
    return int((off | late).sum())


@pytest.mark.quick("csv", "rtklib")
@pytest.mark.parametrize("kind", LOGS)
@PROPERTY
@given(data=st.data())
def test_truncated_log_ends_earlier_or_is_rejected(tmp_path_factory, kind, data):
    folder, text = tmp_path_factory.mktemp("log"), LOGS[kind][1].encode()
    whole = read(folder, kind, text)
    # half of the positions lie within the last lines, where numbers are cut
    place = data.draw(st.one_of(st.integers(0, len(text) - 1), st.integers(len(text) - 300, len(text) - 1)))
    track = read(folder, kind, text[:place])
    assert changed_epochs(track, whole, kind) == 0
    assert track is None or track.sizes["epoch"] <= whole.sizes["epoch"]


@pytest.mark.quick("rtklib")
@pytest.mark.parametrize("kind", LOGS)
@PROPERTY
@given(data=st.data())
def test_log_with_swapped_lines_is_rejected_or_unchanged(tmp_path_factory, kind, data):
    folder, text = tmp_path_factory.mktemp("log"), LOGS[kind][1]
    whole = read(folder, kind, text.encode())
    lines = text.split("\n")[:-1]
    first, second = (data.draw(st.integers(HEADING[kind], len(lines) - 1)) for _ in range(2))
    lines[first], lines[second] = lines[second], lines[first]
    assert changed_epochs(read(folder, kind, ("\n".join(lines) + "\n").encode()), whole, kind) == 0


@pytest.mark.quick("rtklib")
@pytest.mark.parametrize("kind", LOGS)
@PROPERTY
@given(data=st.data())
def test_log_with_a_missing_piece_is_rejected_or_lacks_epochs(tmp_path_factory, kind, data):
    """The remainders of a cut line may form one plausible line; the other epochs remain unchanged."""
    folder, text = tmp_path_factory.mktemp("log"), LOGS[kind][1].encode()
    whole = read(folder, kind, text)
    place = data.draw(st.integers(text.index(b"\n") + 1, len(text) - 1))
    length = data.draw(st.integers(1, 150))
    track = read(folder, kind, text[:place] + text[place + length :])
    assert changed_epochs(track, whole, kind) <= (0 if kind == "nmea" else 1)


@pytest.mark.quick("rtklib", "optitrack")
@pytest.mark.parametrize("kind", LOGS)
@PROPERTY
@given(data=st.data())
def test_flipped_bit_changes_at_most_one_epoch(tmp_path_factory, kind, data):
    """Without a checksum, a changed digit gives a valid position; `check_track` detects the outliers among these."""
    folder, text = tmp_path_factory.mktemp("log"), bytearray(LOGS[kind][1].encode())
    whole = read(folder, kind, bytes(text))
    place = data.draw(st.integers(0, len(text) - 1))
    text[place] ^= 1 << data.draw(st.integers(0, 7))
    assert changed_epochs(read(folder, kind, bytes(text)), whole, kind) <= (0 if kind == "nmea" else 1)


@pytest.mark.parametrize("kind", LOGS)
def test_repeated_line_is_rejected_or_dropped(tmp_path, kind):
    lines = LOGS[kind][1].split("\n")
    doubled = "\n".join([*lines[:-2], lines[-2], *lines[-2:]])
    track, whole = (read(tmp_path, kind, text.encode()) for text in (doubled, LOGS[kind][1]))
    assert track is None or (track.sizes["epoch"] == whole.sizes["epoch"] and changed_epochs(track, whole, kind) == 0)


@pytest.mark.parametrize("kind", ["csv", "rtklib", "airdata", "optitrack"])
def test_unterminated_last_line_is_dropped_and_counted(tmp_path, kind):
    text = LOGS[kind][1].rstrip("\r\n")
    track, whole = (read(tmp_path, kind, data.encode()) for data in (text, LOGS[kind][1]))
    assert track.sizes["epoch"] == whole.sizes["epoch"] - 1
    assert track.dropped == {**whole.dropped, "truncated line": 1}
