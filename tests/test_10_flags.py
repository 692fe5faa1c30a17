"""Table of flags: only flags of the table can be raised, and each flag is raised in the file that the table states."""

import pickle
import re
from pathlib import Path

import pytest

from apertura.common.flag_table import FLAGS
from apertura.common.flags import Flags
from website.pages import PAGES

ROOT = Path(__file__).parents[1]
SOURCES = {path.relative_to(ROOT / "src/apertura").as_posix(): path for path in ROOT.glob("src/apertura/*/**/*.py")}


def test_flag_outside_the_table_cannot_be_raised():
    """The check applies to all ways of setting a flag, so that every flag in a product has an explanation."""
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


def test_every_flag_is_named_in_the_file_that_raises_it():
    lacking = [
        f"{file} has no {name}"
        for name, flag in FLAGS.items()
        for file in flag.raised.split(", ")
        if not re.search(rf'"{name}"|"{name.rpartition("_")[0]}_\{{', SOURCES[file].read_text(encoding="utf-8"))
    ]
    assert lacking == []


def test_symptom_page_names_existing_flags_and_all_of_wrong_images():
    page = (ROOT / "docs/howto/me_or_the_radar.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| ") and "`" in line]
    named = {flag for row in rows for flag in re.findall(r"`(\w+)`", row[1])}
    assert all(re.findall(r"`\w+`", row[1]) and row[2].strip(" |") for row in rows)
    assert named <= set(FLAGS)
    from apertura.stages.assess import _LOOKS_WRONG

    assert {*_LOOKS_WRONG, "attitude_suspect", "outside_swath", "accuracy_not_met", "wrong_code"} <= named


def test_generated_pages_are_up_to_date():
    other = [name for name, page in PAGES.items() if (ROOT / name).read_text(encoding="utf-8") != page()]
    assert other == [], "run: make pages"


def test_texts_of_a_flag_raised_twice_are_merged():
    """The union of two dicts would keep only the last text."""
    merged = Flags.merged(
        {"saturated_radar": "tx: 3 %"}, {"fix_quality_low": "9 pulses"}, {"saturated_radar": "rx: 40 %"}
    )
    assert merged == {"saturated_radar": "tx: 3 %; rx: 40 %", "fix_quality_low": "9 pulses"}
    assert Flags.merged(merged, {"saturated_radar": "rx: 40 %"}) == merged
    assert Flags.merged({"defocused": "2 dB"}, {"defocused": "2 dB; most likely time tags"}) == {
        "defocused": "2 dB; most likely time tags"
    }


def test_texts_with_common_prefix_are_kept_and_repeats_dropped():
    first, ten = {"fix_quality_low": "3 of 90 pulses of uav1"}, {"fix_quality_low": "3 of 90 pulses of uav10"}
    assert Flags.merged(first, ten)["fix_quality_low"] == "3 of 90 pulses of uav1; 3 of 90 pulses of uav10"
    assert Flags.merged(ten, first)["fix_quality_low"] == "3 of 90 pulses of uav10; 3 of 90 pulses of uav1"
    shared = {"fix_quality_low": "3 of 90 pulses; a float solution"}
    assert Flags.merged(shared, shared, shared) == shared
    longer = {"fix_quality_low": "3 of 90 pulses of uav10; at the end"}
    assert Flags.merged(Flags.merged(first, ten), longer)["fix_quality_low"] == (
        "3 of 90 pulses of uav1; 3 of 90 pulses of uav10; at the end"
    )
    assert pickle.loads(pickle.dumps(Flags.merged(first, ten))) == Flags.merged(first, ten)


def test_flags_are_merged_by_one_function_only():
    other = re.compile(r"""\*\*[\w.()]*\bflags\b|\bflags["\]]* \|=? |\| [\w.]*\bflags\b|\bflags["\]]*\.update\(""")
    sources = [path for path in (ROOT / "src/apertura").rglob("*.py") if path.name != "flags.py"]
    assert len(sources) > 100
    assert [path.name for path in sources if other.search(path.read_text(encoding="utf-8"))] == []
