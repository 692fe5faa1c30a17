"""docs/formats.md against the code: the page lists exactly the keys, columns, formats and kinds that are read."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from apertura.campaign.config import Flight, PulseWaveform, read_flights, read_segments
from apertura.campaign.config.flights import read_clocks
from apertura.common.errors import CampaignError
from apertura.common.leap_seconds import gps_ahead_s
from apertura.formats.beam_pattern import read_beam_pattern
from apertura.formats.names import PHASE_HISTORIES, TRACKS
from apertura.formats.reading import read_track
from apertura.formats.recordings.sample_file import EDGE, SETTLING, SampleLayout
from apertura.formats.recordings.sigmf import Capture, Global, SigmfCollection, SigmfFraming
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.track import FIXES

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs/formats.md").read_text(encoding="utf-8")


def table(after):
    """Return the rows of the first table after a text, as lists of cells."""
    part = TEXT[TEXT.index(after) :]
    block = re.search(r"^\|.*\n\|[-|]+\n((?:\|.*\n)+)", part, re.M)[1]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]


def names(after):
    """Return the names quoted in the first column."""
    return [name for row in table(after) for name in re.findall(r"`([^`]+)`", row[0])]


def required(after):
    return {name for row in table(after) if row[1] == "yes" for name in re.findall(r"`([^`]+)`", row[0])}


@pytest.mark.parametrize(
    ("model", "after"),
    [(Global, "Global object:"), (Capture, "Each of the captures:"), (SigmfCollection, "### Collections")],
)
def test_documented_sigmf_keys_match_those_read(model, after):
    read = {field.alias: field.is_required() for field in model.model_fields.values()}
    assert sorted(names(after)) == sorted(read)
    assert required(after) == {alias for alias, is_required in read.items() if is_required}


def test_every_framing_key_is_documented():
    assert names("A frame consists of preamble") == list(SigmfFraming.model_fields)


def test_documented_datatypes_match_those_read():
    documented = re.search(r"^Datatypes: .*?\. ", TEXT, re.M | re.S)[0]
    kinds = set(re.findall(r"`([iuf]\d+)`", documented))
    read = set()
    for kind in {f"{letter}{bits}" for letter in "iuf" for bits in (8, 16, 32, 64)}:
        for order in ("", "_le", "_be"):
            try:
                assert SampleLayout(f"c{kind}{order}").stored.itemsize * 8 == int(kind[1:])
            except ValueError:
                continue
            read.add(kind)
            assert (order == "") is (kind[1:] == "8")
    assert kinds == read
    assert f"{SETTLING} samples" in TEXT
    assert f"{100 * EDGE:g} % of the rate" in TEXT


def test_pulse_keys_are_documented_with_required_ones():
    shared = {"kind", "carrier_hz", "sample_rate_hz", "prf_hz"}
    own = {name: field.is_required() for name, field in PulseWaveform.model_fields.items() if name not in shared}
    assert names("## Pulse") == list(own)
    assert required("## Pulse") == {name for name, is_required in own.items() if is_required}


ROWS = {
    "flights.tsv": {"flight": "f01", "kind": "image", "transmitter": "a", "nodes": "a,b"},
    "segments.tsv": {"flight": "f01", "pair": "a-b", "start": "2025-05-14T09:30:00", "end": "2025-05-14T09:31:00"},
    "clocks.tsv": {"flight": "f01", "node": "a", "offset_s": "1", "drift_ppm": "", "std_s": ""},
}
READERS = {
    "flights.tsv": lambda path: read_flights(path, nodes=["a", "b"]),
    "segments.tsv": lambda path: read_segments(path, flights=[Flight("f01", "image", "a", ("a", "b"))]),
    "clocks.tsv": lambda path: read_clocks(path, flights=[Flight("f01", "image", "a", ("a", "b"))]),
}


@pytest.mark.parametrize("name", ROWS)
def test_config_tables_have_the_documented_columns(tmp_path, name):
    columns = names(f"`{name}`")
    assert set(columns) == set(ROWS[name])
    line = "\t".join(ROWS[name][column] for column in columns)
    (tmp_path / name).write_text("\t".join(columns) + f"\n{line}\n")
    assert len(list(READERS[name](tmp_path / name))) == 1


TIMES = {"time_utc": "2025-05-14T09:30:0{}", "time": "2025-05-14T09:30:0{}Z", "time_s": "{}"}
PLACES = {
    ("latitude_deg", "longitude_deg", "height_m"): ("48", "9", "60{}"),
    ("x_m", "y_m", "z_m"): ("4200000", "660000", "474000{}"),
    ("east_m", "north_m", "up_m"): ("1", "2", "{}"),
}


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("place", PLACES)
def test_csv_log_columns_are_documented_and_need_time_and_position(tmp_path, time, place):
    documented = names("The columns of a CSV log")
    assert set(documented) >= {*TIMES, *(name for group in PLACES for name in group)}
    optional = [name for name in documented if name not in TIMES and not any(name in group for group in PLACES)]
    cells = TIMES | dict(zip(place, PLACES[place], strict=True)) | dict.fromkeys(optional, "1.5") | {"quality": "fix"}

    def read(of):
        lines = [",".join(cells[name].format(epoch) for name in of) for epoch in range(3)]
        (tmp_path / "a.csv").write_text("\n".join([",".join(of), *lines]) + "\n")
        options = LogOptions(start_utc="2025-05-14T09:30:00" if time == "time_s" else None)
        return read_track(tmp_path / "a.csv", node="a", options=options)

    columns = [time, *place]
    track = read([*optional, *columns])
    assert {"position_std", "fix"} <= set(track)
    assert np.isfinite(track.attitude.values).all()
    read(columns)
    for missing in columns:
        with pytest.raises(CampaignError, match=missing if missing != time else "time_utc"):
            read([name for name in columns if name != missing])


@pytest.mark.parametrize(("formats", "section"), [(TRACKS, "## Flight logs"), (PHASE_HISTORIES, "## Phase history")])
def test_every_format_is_documented_with_its_suffixes(formats, section):
    rows = {re.findall(r"`(\w+)`", row[0])[0]: row[1] for row in table(section)}
    assert rows.keys() == formats.keys()
    for name, row in formats.items():
        assert set(re.findall(r"\.\w+", rows[name])) == set(row.suffixes if name in TRACKS else [row.suffix])


def test_every_kind_of_solution_is_documented_with_its_number():
    assert {re.findall(r"`(\w+)`", row[0])[0]: int(row[1]) for row in table("| kind of solution")} == FIXES


def test_documented_leap_seconds_and_pattern_columns_are_read(tmp_path):
    assert f"({gps_ahead_s(np.datetime64('2017-01-01', 'ns'))} since 2017)" in TEXT
    part = TEXT[TEXT.index("## Beams") :]
    columns = re.search(r"columns `(\w+)`.*?`(angle_deg)`.*?`(gain_db)`", part, re.S).groups()
    rows = [f"{cut},{angle},0" for cut in ("azimuth", "elevation") for angle in (-9, 0, 9)]
    (tmp_path / "horn.csv").write_text("\n".join([",".join(columns), *rows]) + "\n")
    read_beam_pattern(tmp_path / "horn.csv")


def leaves(value, key=""):
    """Yield the dotted keys of the values of a JSON document, with `[]` for the items of a list."""
    if isinstance(value, dict) and value:
        for name, each in value.items():
            yield from leaves(each, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for each in value:
            yield from leaves(each, f"{key}[]")
    else:
        yield key


def test_image_json_keys_match_the_documentation(finished_tiny):
    rows = re.findall(r"^\| (`[^|]*) \|", TEXT.partition("\n## image.json")[2], re.M)
    documented = {
        key: re.compile(re.sub(r"<\w+>", r"[^.]+", re.sub(r"([.\[\]])", r"\\\1", key)) + r"(\.[^.]+)?")  # or a map
        for key in re.findall(r"`([^`]+)`", " ".join(rows))
    }
    files = [finished_tiny.results / f"f01/{image}/image.json" for image in ("uav1-uav1", "uav1-uav2", "fused")]
    present = {key for path in files for key in leaves(json.loads(path.read_text(encoding="utf-8")))}
    assert {key for key in present if not any(pattern.fullmatch(key) for pattern in documented.values())} == set()
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    # keys that only other campaigns have
    absent = {key for key, pattern in documented.items() if not any(map(pattern.fullmatch, present))}
    written = {re.sub(r"\.<\w+>$", "", key).split(".")[-1] for key in absent}
    assert {name for name in written if not re.search(rf"\b{re.escape(name)}\b", code)} == set()
    assert len(absent) < len(documented) / 3
