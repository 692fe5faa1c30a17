"""Which job of the workflow makes a result: its rule, and the command that a person can paste."""

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


def job_of(result: str, where: tuple[str, ...]) -> RuleRun:
    """Return the job that makes a result.

    Parameters
    ----------
    result
        A key of `apertura.pipeline.lineage.RESULTS`.
    where
        What it is of, as `apertura.pipeline.lineage.result_of` takes it.

    Examples
    --------
    >>> job_of("raw", ("f01", "uav1"))
    RuleRun(rule='ingest', where=('f01', 'uav1'), command='apertura step ingest f01 uav1')
    """
    rule, step = _OTHERWISE.get(result, (result, result.replace("_", "-")))
    asked = (*where, "fused") if result == "fused" else where
    return RuleRun(rule, where, " ".join(["apertura step", step, *asked]))
