"""Reading of YAML and JSON files: any content is read within limits or rejected with one short message."""

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


# Accepted


def test_plain_values_are_read_unchanged(tmp_path):
    text = "a: 1\nb: [1.5, null, true, 2025-05-14]\nc: &c {d: text}\ne: *c\nf: {<<: *c, g: 1}\n"
    document = read(tmp_path, text)
    assert document["b"][:3] == [1.5, None, True]
    assert document["e"] == {"d": "text"}
    assert document["f"] == {"d": "text", "g": 1}
    assert read(tmp_path, "") is None


def test_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    windows = b"\xef\xbb\xbf" + config_template().replace("\n", "\r\n").encode()
    for name, text in (("plain.yaml", config_template().encode()), ("windows.yaml", windows)):
        (tmp_path / name).write_bytes(text)
    assert read_settings(tmp_path / "windows.yaml") == read_settings(tmp_path / "plain.yaml")


# Rejected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOMB, "line 6, column 30: more than 100000 values"),
        ("[" * 200_000, f"line 1, column {DEEPEST + 1}: nested more than {DEEPEST} levels deep"),
        ("- " * 200_000, "nested more than"),
        ("a: &a [*a]", "does not refer to a complete preceding node"),
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
def test_document_beyond_the_limits_is_rejected_fast_and_briefly(tmp_path, text, expected):
    read(tmp_path, "warm: up")
    tracemalloc.start()
    start_s = time.perf_counter()
    message = refused(tmp_path, text)
    assert time.perf_counter() - start_s < 1.0
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert expected in message
    assert len(message) < 400


def test_alias_bomb_is_rejected_in_milliseconds(tmp_path):
    read(tmp_path, "warm: up")
    start_s = time.perf_counter()
    refused(tmp_path, BOMB)
    assert time.perf_counter() - start_s < 0.1


def test_repeated_key_is_reported_with_its_line(tmp_path):
    assert "line 3, column 3: repeated key 'a'" in refused(tmp_path, "x:\n  a: 1\n  a: 2\n")
    message = refused(tmp_path, config_template() + "campaign: again\n")
    assert "repeated key 'campaign'" in message


def test_overflow_of_valid_numbers_is_one_message(tmp_path):
    (tmp_path / "config.yaml").write_text(
        config_template()
        .replace("bounds_m: auto", "bounds_m: [-1.0e+308, -1.0e+308, 1.0e+308, 1.0e+308]")
        .replace("spacing_m: auto", "spacing_m: 1.0e-300")
    )
    assert "overflow or underflow" in complaint(lambda: read_settings(tmp_path / "config.yaml"))


@pytest.mark.parametrize("number", ["1.0e+16", "-1e300", "9" * 20])
def test_number_out_of_range_is_reported_with_its_key(tmp_path, number):
    (tmp_path / "config.yaml").write_text(config_template().replace("radar: 0.0", f"radar: {number}", 1))
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "nodes.uav1.path_offset_m.radar is " in message
    assert "numbers within ±1e+15" in message


def test_quote_of_a_wrong_value_is_shortened(tmp_path):
    (tmp_path / "config.yaml").write_text(config_template().replace("prf_hz: 100.0", f"prf_hz: {'long' * 9999}"))
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "longlong…" in message
    assert len(message) < 500


def test_thousand_wrong_keys_are_counted_instead_of_listed(tmp_path):
    keys = "".join(f"wrong{number}: 1\n" for number in range(1000))
    (tmp_path / "config.yaml").write_text(config_template() + keys)
    message = complaint(lambda: read_settings(tmp_path / "config.yaml"))
    assert "1000 in total" in message
    assert len(message) < 1500


# JSON


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", "[" * 100_000, '{"a": NaN}', '{"a": 1e999, "a"', "null", '{"n": ' + "9" * 5000 + "}", "\xff"],
)
def test_damaged_result_message_has_remedy(tmp_path, text):
    path = tmp_path / "scene.json"
    path.write_text(text, encoding="latin-1")
    message = complaint(lambda: read_json(path, expected="a grid", remedy="Run."))
    assert message.startswith(str(path))
    assert "Delete the file and run" in message or "UTF-8" in message


def test_any_error_in_a_document_names_its_file(tmp_path):
    def ratio_of(document):
        with undamaged(tmp_path, expected="numbers", remedy="Delete it."):
            return float(document["a"]) / document["b"]["c"]

    for document in ({}, {"a": "x"}, {"a": 1, "b": 1}, {"a": 1, "b": {"c": 0}}, {"a": []}):
        assert complaint(lambda document=document: ratio_of(document)).startswith(f"{tmp_path}: damaged (")
    assert ratio_of({"a": 1, "b": {"c": 2}}) == 0.5


# Messages


def test_control_characters_in_messages_are_escaped():
    error = CampaignError("\x1b[2J\nred\u202e", "a\rb", "\x07", "\x00")
    assert str(error) == "a\\rb: \\x1b[2J\\nred\\u202e; expected \\x07. \\x00"
    assert str(error).isprintable()


def test_message_length_is_bounded_in_each_part():
    error = CampaignError("\x1b" * 10**6, "w" * 10**6, "e" * 10**6, "r" * 10**6)
    assert len(str(error)) < 3000
    assert (error.where[:2], error.found[:4], error.expected[:2], error.remedy[:2]) == ("ww", "\\x1b", "ee", "rr")
    unpickled = pickle.loads(pickle.dumps(CampaignError("found", "where", "expected", "remedy")))
    assert (str(unpickled), unpickled.where) == ("where: found; expected expected. remedy", "where")


def test_long_quoted_value_is_shortened():
    assert quoted("x" * 100) == "'" + "x" * 80 + "…'"
    assert quoted(10**5000) == "a int too long to show"
    assert shown("\udcff") == "\\udcff"


# Names of files


@pytest.mark.parametrize("name", ["../x", "a/../../x", "/etc/passwd", "a\\b", "a\x00", "a\nb", "", " ", "a\u202eb"])
def test_name_that_leads_out_of_the_campaign_is_rejected(tmp_path, name):
    assert "inside the campaign folder" in complaint(lambda: ConfinedPath.at(tmp_path).named(name, where="x"))
