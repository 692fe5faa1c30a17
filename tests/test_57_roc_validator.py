"""Validation of the RO-Crate of a finished campaign by roc-validator."""

import json
import subprocess

import pytest
from crate import validator
from folders import copy_writable

from apertura.formats.catalog import CRATE


@pytest.fixture
def finished(finished_tiny, tmp_path):
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "campaign")


def change_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.slow
def test_roc_validator_accepts_the_crate_and_reports_a_changed_file(finished):
    try:
        validator.make_environment()
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"roc-validator cannot be installed here: {str(getattr(error, 'stderr', error))[-300:]}")
    assert validator.issues(finished / "results") == []
    change_byte(finished / "results/f01/uav1-uav1/db.tif")
    (problem,) = validator.issues(finished / "results")
    assert problem.endswith("f01/uav1-uav1/db.tif: sha256 differs from that of the bytes")
    path = finished / "results" / CRATE
    document = json.loads(path.read_text())
    document["@graph"] = [one for one in document["@graph"] if one["@id"] != "workflow/Snakefile"]
    path.write_text(json.dumps(document))
    assert len(validator.issues(finished / "results")) > 1
