"""Code hash of a result: the hash covers exactly the modules whose functions the step calls."""

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
"""Results written by the step of another result, by Snakemake itself, or by whole runs."""


def module_of(frame):
    return frame.f_globals.get("__name__") or ""


def called(step, *arguments):
    """Run a step and return the modules of apertura whose functions it called in any thread."""
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
def test_code_hash_covers_every_called_module(tiny):
    campaign = Campaign.load(tiny)
    missing = {}
    for name, where, result in places_of(campaign):
        if name not in NOT_RUN:
            covered = set(import_closure(result.modules))
            if name == "raw":  # the same step writes raw and track
                covered |= set(import_closure(result_of(campaign, "track", *where).modules))
            step = pkgutil.resolve_name(RESULTS[name].step.path)
            uncovered = called(step, campaign, *where, *RESULTS[name].last_words) - covered
            if uncovered:
                missing[name, *where] = sorted(uncovered)
    assert missing == {}


EVERY = frozenset(RESULTS)
FOCUSED = {"refined_track", "image", "assessment", "speed_accuracy", "whole"}
READ = FOCUSED | {"pictures", "raw", "track", "echo", "transfer", "profile", "layers", "tracks"}


CHANGES = [
    ("formats/tracks/px4_ulog.py", "code", set()),  # no log of the campaign has this format
    ("formats/tracks/csv_track.py", "comment", set()),
    ("formats/tracks/csv_track.py", "code", READ - {"raw", "transfer"} | {"pictures_fused"}),
    ("formats/recordings/sigmf.py", "code", READ - {"track", "tracks"} | {"cphd", "pictures_fused"}),
    ("views/webmap/server.py", "code", set()),  # serves finished results only
    ("common/flag_table.py", "code", set()),
    ("common/errors.py", "code", set()),
    ("campaign/config/nodes.py", "docstring", set()),
    ("core/echo/dechirp.py", "docstring", set()),
    ("formats/export/cog.py", "code", {"export", "fused", "layers", "mosaic", "pictures", "pictures_fused", "whole"}),
    ("workflow/rules.py", "code", set()),  # sources and settings are compared separately
    ("core/backprojection/engines/numba.py", "comment", set()),
    ("core/backprojection/engines/numba.py", "code", FOCUSED | {"pictures", "pictures_fused", "tracks"}),
    ("common/constants.py", "code", EVERY),
]
EDITS = {"code": "EDITED = 1\n", "comment": "# Edited.\n", "docstring": '"""Edited."""\n'}


@pytest.mark.slow
def test_code_change_outdates_only_the_results_that_run_it(tiny, tmp_path):
    copied = shutil.copytree(
        PACKAGE, tmp_path / "package", ignore=shutil.ignore_patterns("__pycache__", "*.so", "page")
    )
    modules = {(name, result.modules) for name, _, result in places_of(Campaign.load(tiny))}

    def hashes():
        return {(name, code_sha256(*run, package=copied)) for name, run in modules}

    before, changed = hashes(), []
    for file, edit, _ in CHANGES:
        source = (copied / file).read_text()
        (copied / file).write_text(source + EDITS[edit])
        changed.append((file, edit, {name for name, _ in hashes() - before}))
        (copied / file).write_text(source)
    assert changed == [(file, edit, expected & {name for name, _ in modules}) for file, edit, expected in CHANGES]
