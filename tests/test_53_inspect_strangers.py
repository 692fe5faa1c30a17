"""`apertura inspect` with untrusted files: broken content, hostile names and unsupported file types."""

import json
import operator
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from folders import SHARED, copy_writable

from apertura.common.errors import CampaignError
from apertura.formats.names import PHASE_HISTORIES, RECORDERS, TRACKS, HistoryFormat, LogFormat, log_suffixes
from apertura.views.inspect.path import inspect_path, look

APERTURA = Path(sys.executable).parent / "apertura"
F01 = SHARED / "campaign-sample/raw/f01"

EVERY_SUFFIX = sorted(
    {f".{suffix}" for suffix in log_suffixes()}
    | {suffix for row in RECORDERS for suffix in row}
    | {row.suffix for row in PHASE_HISTORIES.values()}
    | {".tif", ".npy", ".jpg", ""}
)


def run(*words, **options):
    return subprocess.run([APERTURA, "inspect", *words], capture_output=True, check=False, timeout=120, **options)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("suffix", EVERY_SUFFIX)
@pytest.mark.parametrize(
    "content", [b"", b"\x00\xff\x1b[31m" * 700, b"$,%\n1,2\n{[(" * 300], ids=["empty", "bytes", "text"]
)
def test_broken_file_of_any_suffix_is_reported_with_a_reason(tmp_path, suffix, content):
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(content)
    report = look(path)
    assert report.problem is not None
    assert report.problem.remedy
    assert "reader failed" not in report.problem.found
    json.dumps(report.as_json(), allow_nan=False)


def test_exception_of_a_reader_is_reported_without_traceback(shared, monkeypatch):
    monkeypatch.setitem(TRACKS, "csv", LogFormat((".csv",), operator.truediv))
    report = look(F01 / "uav1.track.csv")
    assert report.problem.found.startswith("the reader failed: TypeError")


def test_samples_without_own_description_require_a_campaign(tmp_path, monkeypatch):
    monkeypatch.setitem(
        PHASE_HISTORIES, "beat", HistoryFormat(".beat", operator.truediv, described=True, waveform="fmcw")
    )
    (tmp_path / "a.beat").write_bytes(b"x")
    assert "waveform.format: beat" in look(tmp_path / "a.beat").problem.expected


@pytest.mark.parametrize("setting", ["height=3", "time_system", "time_system=tai", "base=1,2", "height_offset_m=x"])
def test_invalid_setting_is_one_message(shared, setting):
    with pytest.raises(CampaignError, match="--set"):
        look(F01 / "uav1.track.csv", [setting])


@pytest.mark.slow
def test_hostile_names_are_printed_escaped(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")
    names = [b"new\nline\x1b[31m.csv", b"[red]x[bold].pos", b"\xff\xfe.npy", b"n" * 250 + b".out", b"a\tb"]
    for name in names:
        (tmp_path / os.fsdecode(name)).write_bytes(b"\x1b]0;title\x07" * 99)
    reported = {}
    for name in (*names, b""):
        assert inspect_path(tmp_path / os.fsdecode(name)) == (2 if name else 0)
        reported[name] = capsys.readouterr().out.encode()  # fails if the output is not UTF-8
        assert not re.search(rb"[\x00-\x09\x0b-\x1f\x7f]", reported[name])
    assert b"[red]x[bold].pos" in reported[names[1]]
    assert b"[red]x[bold].pos" in reported[b""]
    done = run("--json", tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")
    assert sorted(os.fsencode(Path(part["path"]).name) for part in json.loads(done.stdout)["parts"]) == sorted(names)


def test_hostile_name_in_the_facts_is_escaped(shared, tmp_path, capsys):
    for suffix in (".sigmf-meta", ".sigmf-data"):
        (tmp_path / f"a\x1b[31m{suffix}").write_bytes((F01 / f"uav1{suffix}").read_bytes())
    assert inspect_path(tmp_path / "a\x1b[31m.sigmf-data") == 0
    assert "\x1b" not in capsys.readouterr().out


@pytest.mark.slow
def test_path_that_is_no_regular_file_is_one_line(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for name in ("pipe.csv", "nowhere", "x" * 300):
        with pytest.raises(CampaignError):
            look(tmp_path / name)
    done = run(tmp_path / "pipe.csv")
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (2, b"", 1)


def test_preview_never_overwrites_other_files(shared, tmp_path):
    folder = copy_writable(F01, tmp_path / "f01")
    (folder / "notes.png").write_text("mine")
    for name in ("uav1.track.csv", "uav2.track.pos", "notes.png"):
        before = (folder / name).read_bytes()
        with pytest.raises(CampaignError, match="--plot"):
            inspect_path(folder / "uav1.track.csv", plot=folder / name)
        assert (folder / name).read_bytes() == before


def test_empty_zarr_folder_contains_no_group(tmp_path):
    (tmp_path / "e.zarr").mkdir()
    report = look(tmp_path / "e.zarr")
    assert "no zarr group" in report.problem.found
    assert "defect" not in report.problem.remedy


def test_missing_time_system_is_reported_with_the_option(tmp_path):
    (tmp_path / "a.track.csv").write_text("time,latitude_deg,longitude_deg,height_m\n2025-05-14T09:30:00,48,9,600\n")
    assert "--set time_system=utc|gpst" in look(tmp_path / "a.track.csv").missing[0]
    (tmp_path / "b.track.csv").write_text("time_s,latitude_deg,longitude_deg,height_m\n1,48,9,600\n2,48,9,600\n")
    assert "--set start_utc=YYYY-MM-DDTHH:MM:SS" in look(tmp_path / "b.track.csv").missing[0]
