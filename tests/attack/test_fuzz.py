"""Fuzzing: no input file causes a traceback, a hang, a crash or a message with control characters."""

import os
import signal
import time

import numpy as np
import pytest

from apertura.common.errors import CampaignError

from . import fuzz
from .parsers import PARSERS, Parser

INPUTS = 150


@pytest.mark.quick("track.csv", "sigmf-meta", "codes.npy")
@pytest.mark.parametrize("name", PARSERS)
def test_malformed_files_are_refused_or_read_without_harm(name):
    tally = fuzz.fuzz(name, INPUTS, seed=2)
    assert tally.harmful == []
    assert sum(tally.results.values()) == INPUTS
    assert tally.results["refused"] > INPUTS / 10
    assert tally.results["same"] + tally.results["different"] > 0
    assert tally.peak_mb < 2048


@pytest.mark.parametrize("name", sorted(path.name for path in fuzz.REGRESSIONS.iterdir()))
def test_regressions_are_harmless(name):
    files = [path.read_bytes() for path in sorted((fuzz.REGRESSIONS / name).iterdir())]
    tally = fuzz.read_all(name, len(files), files.__getitem__, seeds=PARSERS[name].seeds())
    assert tally.harmful == []


def test_equal_seeds_give_equal_files():
    first, again, other = (fuzz.inputs_of("track.csv", seed) for seed in (1, 1, 2))
    assert [first[number] for number in range(50)] == [again[number] for number in range(50)]
    assert [first[number] for number in range(50)] != [other[number] for number in range(50)]


def harmful(path):
    """Cause the kind of harm that the content of a file selects."""
    kind = path.read_bytes()
    if kind == b"r":
        raise CampaignError("found", path, "expected", "remedy")
    if kind == b"t":
        raise IndexError("a defect")
    if kind == b"c":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == b"h":
        time.sleep(60)
    if kind == b"m":
        return np.ones(1 << 31)
    return {"n": 1 if kind == b"s" else 2}


def test_fuzzer_detects_every_kind_of_harm(monkeypatch):
    """Crashes and hangs are attributed to their input, and the following inputs are read."""
    monkeypatch.setitem(PARSERS, "toy", Parser("toy.bin", lambda: [b"s"], harmful))
    monkeypatch.setattr(fuzz, "SECONDS", 0.5)
    files = [b"s", b"c", b"d", b"h", b"t", b"m", b"r", b"c"]
    tally = fuzz.read_all("toy", len(files), files.__getitem__, seeds=[b"s"])
    assert [(number, kind) for number, kind, _ in tally.harmful] == [
        (1, "crash"),
        (3, "hang"),
        (4, "traceback"),
        (5, "memory"),
        (7, "crash"),
    ]
    assert (tally.results["same"], tally.results["different"], tally.results["refused"]) == (1, 1, 1)
    assert tally.different == {"a number": 1}
    assert "| toy | 8 | 1 | 1 | 1 | 1 | 1 | 2 | 1 | 0 |" in fuzz.table([tally])


def test_message_with_control_codes_is_harmful(monkeypatch):
    class RawError(CampaignError):
        def __str__(self):
            return "\x1b[2J"

    def refuse(path):
        if path.read_bytes() != b"s":
            raise RawError("found", path, "expected", "remedy")

    monkeypatch.setitem(PARSERS, "toy", Parser("toy.bin", lambda: [b"s"], refuse))
    tally = fuzz.read_all("toy", 1, [b"x"].__getitem__, seeds=[b"s"])
    assert [kind for _, kind, _ in tally.harmful] == ["message"]
