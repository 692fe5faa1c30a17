"""A result's code hash covers what its step runs: every module whose functions the step calls, and no more."""

import pkgutil
import shutil
import sys
import threading

import pytest

from apertura.campaign.folder import Campaign
from apertura.common.code_imports import PACKAGE, WITHOUT_EFFECT, import_closure
from apertura.common.provenance import code_sha256
from apertura.workflow.lineage import places_of, result_of
from apertura.workflow.rules import RESULTS

NOT_RUN = {"track", "report", "speed_accuracy", "whole"}
"""Made by the step of another result, by Snakemake itself, or by whole runs."""


def module_of(frame):
    return frame.f_globals.get("__name__") or ""


def called(step, *arguments):
    """Run a step; return the modules of apertura whose functions it called, in any thread."""
    modules = set()

    def note(frame, event, _):
        if event == "call" and module_of(frame) not in modules:
            callers = [module_of(frame)]
            while (frame := frame.f_back) is not None:
                callers.append(module_of(frame))
            if not any(name.startswith(WITHOUT_EFFECT) for name in callers):
                modules.add(callers[0])

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        step(*arguments)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return {name for name in modules if name.startswith("apertura.")}


@pytest.mark.slow
def test_every_module_that_a_step_calls_is_code_of_its_result(tiny):
    campaign = Campaign.load(tiny)
    missing = {}
    for name, where, result in places_of(campaign):
        if name not in NOT_RUN:
            known = set(import_closure(result.modules))
            if name == "raw":  # one step makes both
                known |= set(import_closure(result_of(campaign, "track", *where).modules))
            step = pkgutil.resolve_name(RESULTS[name].step.path)
            further = called(step, campaign, *where, *RESULTS[name].last_words) - known
            if further:
                missing[name, *where] = sorted(further)
    assert missing == {}


EVERY = frozenset(RESULTS)
FOCUSED = {"refined_track", "image", "assessment", "speed_accuracy", "whole"}
READ = FOCUSED | {"pictures", "raw", "track", "echo", "transfer", "profile", "layers", "tracks"}


CHANGES = [
    ("formats/tracks/px4_ulog.py", "code", set()),  # no log of the campaign is of that format
    ("formats/tracks/csv_track.py", "comment", set()),
    ("formats/tracks/csv_track.py", "code", READ - {"raw", "transfer"} | {"pictures_fused"}),
    ("formats/recordings/sigmf.py", "code", READ - {"track", "tracks"} | {"cphd", "pictures_fused"}),
    ("views/webmap/server.py", "code", set()),  # what a browser is shown, of results that are there
    ("common/flag_table.py", "code", set()),
    ("common/errors.py", "code", set()),
    ("campaign/config/nodes.py", "docstring", set()),
    ("core/echo/dechirp.py", "docstring", set()),
    ("formats/export/cog.py", "code", {"export", "fused", "layers", "mosaic", "pictures", "pictures_fused"}),
    ("workflow/rules.py", "code", set()),  # sources and settings are compared for themselves
    ("core/backprojection/engines/numba.py", "comment", set()),
    ("core/backprojection/engines/numba.py", "code", FOCUSED | {"pictures", "pictures_fused", "tracks"}),
    ("common/constants.py", "code", EVERY),
]
EDITS = {"code": "EDITED = 1\n", "comment": "# Edited.\n", "docstring": '"""Edited."""\n'}


@pytest.mark.slow
def test_a_change_makes_again_what_runs_it_and_nothing_else(tiny, tmp_path):
    copied = shutil.copytree(
        PACKAGE, tmp_path / "package", ignore=shutil.ignore_patterns("__pycache__", "*.so", "page")
    )
    modules = {(name, result.modules) for name, _, result in places_of(Campaign.load(tiny))}

    def hashes():
        return {(name, code_sha256(*run, package=copied)) for name, run in modules}

    before, found = hashes(), []
    for file, edit, _ in CHANGES:
        source = (copied / file).read_text()
        (copied / file).write_text(source + EDITS[edit])
        found.append((file, edit, {name for name, _ in hashes() - before}))
        (copied / file).write_text(source)
    assert found == [(file, edit, again & {name for name, _ in modules}) for file, edit, again in CHANGES]
