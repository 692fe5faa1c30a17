"""Which job of the workflow makes a result: its rule, and the command that a person can paste."""

from collections.abc import Sequence
from typing import NamedTuple

_OTHERWISE = {
    "raw": ("ingest", "ingest"),
    "track": ("ingest", "ingest"),
    "refined_track": ("refine", "refine"),
    "assessment": ("assess", "assess"),
    "calibration": ("calibrate", "calibrate"),
    "fused": ("export_fused", "export"),
}
"""Result → rule and step, where they are not called as the result is."""


class RuleRun(NamedTuple):
    """A rule, what it runs on, and its command."""

    rule: str
    where: tuple[str, ...]
    command: str


def job_of(result: str, manifest: str) -> RuleRun:
    """Return the job that makes a result.

    Parameters
    ----------
    result
        A key of `apertura.lineage.RESULTS`.
    manifest
        Its manifest, relative to the campaign folder.

    Examples
    --------
    >>> job_of("raw", "results/f01/uav1/raw.manifest.json")
    RuleRun(rule='ingest', where=('f01', 'uav1'), command='apertura step ingest f01 uav1')
    """
    rule, step = _OTHERWISE.get(result, (result, result.replace("_", "-")))
    where: Sequence[str] = manifest.split("/")[1:-1]
    return RuleRun(rule, tuple(where), " ".join(["apertura step", step, *where]))
