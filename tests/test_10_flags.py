"""One table explains every flag: none that is not in it can be raised, and each is raised where it says."""

import pickle
import re
from pathlib import Path

import pytest

from apertura.common.flag_table import FLAGS
from apertura.common.flags import Flags
from website.pages import PAGES

ROOT = Path(__file__).parents[1]
SOURCES = {path.relative_to(ROOT / "src/apertura").as_posix(): path for path in ROOT.glob("src/apertura/*/**/*.py")}


def test_a_flag_that_is_no_row_of_the_table_cannot_be_raised():
    """However it is set: no product holds a flag that nobody explains."""
    flags = Flags(dict.fromkeys(FLAGS, "measured"))
    for raise_it in (
        lambda: Flags({"clipped": "3 %"}),
        lambda: Flags.merged({"clipped": "3 %"}),
        lambda: flags.__setitem__("clipped", "3 %"),
    ):
        with pytest.raises(KeyError, match=r"clipped .*FLAGS"):
            raise_it()
    assert flags == dict.fromkeys(FLAGS, "measured")


def test_every_flag_has_measured_quantity_meaning_and_advice():
    for flag in FLAGS.values():
        for text in (flag.measured, flag.meaning, flag.advice, flag.raised):
            assert text.strip()
            assert not set(text) & set("|`\n")


def test_every_flag_is_named_in_the_file_that_is_said_to_raise_it():
    lacking = [
        f"{file} has no {name}"
        for name, flag in FLAGS.items()
        for file in flag.raised.split(", ")
        if not re.search(rf'"{name}"|"{name.rpartition("_")[0]}_\{{', SOURCES[file].read_text(encoding="utf-8"))
    ]
    assert lacking == []


def test_the_page_from_symptom_to_remedy_names_flags_that_exist_and_those_that_say_an_image_is_wrong():
    page = (ROOT / "docs/howto/me_or_the_radar.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| ") and "`" in line]
    named = {flag for row in rows for flag in re.findall(r"`(\w+)`", row[1])}
    assert all(re.findall(r"`\w+`", row[1]) and row[2].strip(" |") for row in rows)
    assert named <= set(FLAGS)
    from apertura.stages.assess import _LOOKS_WRONG

    assert {*_LOOKS_WRONG, "attitude_suspect", "outside_swath", "accuracy_not_met", "wrong_code"} <= named


def test_pages_that_come_from_the_code_are_as_they_would_be_written_now():
    other = [name for name, page in PAGES.items() if (ROOT / name).read_text(encoding="utf-8") != page()]
    assert other == [], "run: make pages"


def test_two_parts_that_raise_one_flag_both_have_their_say():
    """The union of dicts keeps the last line and loses the other without a word."""
    merged = Flags.merged(
        {"saturated_radar": "tx: 3 %"}, {"fix_quality_low": "9 pulses"}, {"saturated_radar": "rx: 40 %"}
    )
    assert merged == {"saturated_radar": "tx: 3 %; rx: 40 %", "fix_quality_low": "9 pulses"}
    assert Flags.merged(merged, {"saturated_radar": "rx: 40 %"}) == merged
    assert Flags.merged({"defocused": "2 dB"}, {"defocused": "2 dB; most likely time tags"}) == {
        "defocused": "2 dB; most likely time tags"
    }


def test_lines_that_begin_alike_are_both_kept_and_a_line_of_two_clauses_is_kept_once():
    one, ten = {"fix_quality_low": "3 of 90 pulses of uav1"}, {"fix_quality_low": "3 of 90 pulses of uav10"}
    assert Flags.merged(one, ten)["fix_quality_low"] == "3 of 90 pulses of uav1; 3 of 90 pulses of uav10"
    assert Flags.merged(ten, one)["fix_quality_low"] == "3 of 90 pulses of uav10; 3 of 90 pulses of uav1"
    shared = {"fix_quality_low": "3 of 90 pulses; a float solution"}
    assert Flags.merged(shared, shared, shared) == shared
    longer = {"fix_quality_low": "3 of 90 pulses of uav10; at the end"}
    assert Flags.merged(Flags.merged(one, ten), longer)["fix_quality_low"] == (
        "3 of 90 pulses of uav1; 3 of 90 pulses of uav10; at the end"
    )
    assert pickle.loads(pickle.dumps(Flags.merged(one, ten))) == Flags.merged(one, ten)


def test_flags_are_brought_together_in_one_way_alone():
    other = re.compile(r"""\*\*[\w.()]*\bflags\b|\bflags["\]]* \|=? |\| [\w.]*\bflags\b|\bflags["\]]*\.update\(""")
    sources = [path for path in (ROOT / "src/apertura").rglob("*.py") if path.name != "flags.py"]
    assert len(sources) > 100
    assert [path.name for path in sources if other.search(path.read_text(encoding="utf-8"))] == []
