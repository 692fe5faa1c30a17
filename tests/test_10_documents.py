"""Whatever stands in a YAML or JSON file, it is read within limits or refused in one short message."""

import pickle
import time
import tracemalloc

import pytest
from folders import complaint

from apertura.campaign.config import read_settings
from apertura.campaign.config.template import config_template
from apertura.common.confined import ConfinedPath
from apertura.common.documents import DEEPEST, LARGEST_YAML, read_json, read_yaml, undamaged
from apertura.common.errors import CampaignError, quoted, shown

BOMB = "a0: &a0 [x, y]\n" + "".join(f"a{n + 1}: &a{n + 1} [{', '.join([f'*a{n}'] * 9)}]\n" for n in range(20))


def read(tmp_path, text):
    path = tmp_path / "x.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_yaml(path, expected="YAML", remedy="Write it.")


def refused(tmp_path, text):
    return complaint(lambda: read(tmp_path, text))


# What is allowed


def test_plain_values_are_read_as_they_are_written(tmp_path):
    text = "a: 1\nb: [1.5, null, true, 2025-05-14]\nc: &c {d: text}\ne: *c\nf: {<<: *c, g: 1}\n"
    document = read(tmp_path, text)
    assert document["b"][:3] == [1.5, None, True]
    assert document["e"] == {"d": "text"}
    assert document["f"] == {"d": "text", "g": 1}
    assert read(tmp_path, "") is None


def test_a_byte_order_mark_and_the_line_ends_of_windows_change_nothing(tmp_path):
    windows = b"\xef\xbb\xbf" + config_template().replace("\n", "\r\n").encode()
    for name, text in (("plain.yaml", config_template().encode()), ("windows.yaml", windows)):
        (tmp_path / name).write_bytes(text)
    assert read_settings(tmp_path / "windows.yaml") == read_settings(tmp_path / "plain.yaml")


# What is not


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOMB, "line 6, column 30: more than 100000 values"),
        ("[" * 200_000, f"line 1, column {DEEPEST + 1}: nested more than {DEEPEST} levels deep"),
        ("- " * 200_000, "nested more than"),
        ("a: &a [*a]", "no complete node before it"),
        ("a: *b", "alias 'b'"),
        ("x: " + "9" * 5000, "an integer of 5000 digits"),
        ("a: !!python/object/apply:os.system [touch x]", "instead of a plain value"),
        ("a: !!timestamp never", "not readable as YAML"),
        ("a: 2025-02-30", "not readable as YAML"),
        ("a: [1\nb: 2", "line 2, column 2"),
        (b"a: \xff", "byte 0xff in line 1 is not UTF-8"),
        ("x" * (LARGEST_YAML + 1), f"at most {LARGEST_YAML} bytes"),
    ],
)
def test_a_document_beyond_the_limits_is_refused_at_once_and_in_few_words(tmp_path, text, expected):
    read(tmp_path, "warm: up")
    tracemalloc.start()
    begun = time.perf_counter()
    message = refused(tmp_path, text)
    assert time.perf_counter() - begun < 1.0
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert expected in message
    assert len(message) < 400


def test_a_bomb_of_aliases_is_refused_in_milliseconds(tmp_path):
    read(tmp_path, "warm: up")
    begun = time.perf_counter()
    refused(tmp_path, BOMB)
    assert time.perf_counter() - begun < 0.1


def test_a_key_that_stands_twice_is_named_with_its_line(tmp_path):
    assert "line 3, column 3: repeated key 'a'" in refused(tmp_path, "x:\n  a: 1\n  a: 2\n")
    message = refused(tmp_path, config_template() + "campaign: again\n")
    assert "repeated key 'campaign'" in message


def test_numbers_that_are_each_allowed_and_overflow_together_are_one_message(tmp_path):
    (tmp_path / "config.yaml").write_text(
        config_template()
        .replace("bounds_m: auto", "bounds_m: [-1.0e+308, -1.0e+308, 1.0e+308, 1.0e+308]")
        .replace("spacing_m: auto", "spacing_m: 1.0e-300")
    )
    assert "overflow or underflow" in complaint(lambda: read_settings(tmp_path / "config.yaml"))


@pytest.mark.parametrize("number", ["1.0e+16", "-1e300", "9" * 20])
def test_a_number_that_nothing_of_ours_reaches_is_named_by_its_key(tmp_path, number):
    (tmp_path / "config.yaml").write_text(config_template().replace("radar: 0.0", f"radar: {number}", 1))
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "nodes.uav1.path_offset_m.radar is " in message
    assert "numbers within ±1e+15" in message


def test_a_wrong_value_is_quoted_no_longer_than_a_line(tmp_path):
    (tmp_path / "config.yaml").write_text(config_template().replace("prf_hz: 100.0", f"prf_hz: {'long' * 9999}"))
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "longlong…" in message
    assert len(message) < 500


def test_a_thousand_wrong_keys_are_counted_and_not_listed(tmp_path):
    keys = "".join(f"wrong{number}: 1\n" for number in range(1000))
    (tmp_path / "config.yaml").write_text(config_template() + keys)
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "1000 in all" in message
    assert len(message) < 1500


# JSON


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", "[" * 100_000, '{"a": NaN}', '{"a": 1e999, "a"', "null", '{"n": ' + "9" * 5000 + "}", "\xff"],
)
def test_a_damaged_result_says_to_delete_it_and_to_run_again(tmp_path, text):
    path = tmp_path / "scene.json"
    path.write_text(text, encoding="latin-1")
    message = complaint(lambda: read_json(path, expected="a grid", remedy="Run."))
    assert message.startswith(str(path))
    assert "Delete it and run" in message or "UTF-8" in message


def test_whatever_goes_wrong_with_a_document_names_its_file(tmp_path):
    def taken(document):
        with undamaged(tmp_path, expected="numbers", remedy="Delete it."):
            return float(document["a"]) / document["b"]["c"]

    for document in ({}, {"a": "x"}, {"a": 1, "b": 1}, {"a": 1, "b": {"c": 0}}, {"a": []}):
        assert complaint(lambda document=document: taken(document)).startswith(f"{tmp_path}: damaged (")
    assert taken({"a": 1, "b": {"c": 2}}) == 0.5


# Messages


def test_what_a_file_holds_is_shown_and_not_sent_to_the_terminal():
    error = CampaignError("\x1b[2J\nred\u202e", "a\rb", "\x07", "\x00")
    assert str(error) == "a\\rb: \\x1b[2J\\nred\\u202e; expected \\x07. \\x00"
    assert str(error).isprintable()


def test_a_message_is_of_bounded_length_and_keeps_its_parts():
    error = CampaignError("\x1b" * 10**6, "w" * 10**6, "e" * 10**6, "r" * 10**6)
    assert len(str(error)) < 3000
    assert (error.where[:2], error.found[:4], error.expected[:2], error.remedy[:2]) == ("ww", "\\x1b", "ee", "rr")
    again = pickle.loads(pickle.dumps(CampaignError("found", "where", "expected", "remedy")))
    assert (str(again), again.where) == ("where: found; expected expected. remedy", "where")


def test_a_quoted_value_is_cut_where_it_is_long():
    assert quoted("x" * 100) == "'" + "x" * 80 + "…'"
    assert quoted(10**5000) == "a int too long to show"
    assert shown("\udcff") == "\\udcff"


# Names of files


@pytest.mark.parametrize("name", ["../x", "a/../../x", "/etc/passwd", "a\\b", "a\x00", "a\nb", "", " ", "a\u202eb"])
def test_a_name_that_leads_out_of_the_campaign_is_refused(tmp_path, name):
    assert "inside the campaign folder" in complaint(lambda: ConfinedPath.at(tmp_path).named(name, where="x"))
