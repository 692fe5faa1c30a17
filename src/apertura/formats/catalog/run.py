"""What a crate tells of a run: its jobs, their files, and what they ran on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Listed:
    """A file.

    Attributes
    ----------
    name
        Relative to the results; of an input, to the campaign folder.
    sha256
        Of its bytes, hex.
    size
        Bytes; None where it is not there any more.
    """

    name: str
    sha256: str
    size: int | None


@dataclass(frozen=True)
class Job:
    """One rule that ran, once.

    Attributes
    ----------
    rule, where
        Of the workflow; flight and pair, or whatever it ran on.
    command
        As a person would paste it.
    code_sha256
        Of the code that ran.
    settings
        What of the config mattered to it.
    sources
        Names of what it was made from: results by their manifests (``results/…``), and inputs.
    files
        What it made, manifests last.
    doubts
        Why it would not be made so today, a line each.
    """

    rule: str
    where: Sequence[str]
    command: str
    code_sha256: str
    settings: Mapping[str, Any]
    sources: Sequence[str]
    files: Sequence[Listed]
    doubts: Sequence[str] = ()

    @property
    def path(self) -> str:
        """Its name among the jobs."""
        return "/".join([self.rule, *self.where])


@dataclass(frozen=True)
class Run:
    """What a crate tells.

    Attributes
    ----------
    campaign
        Its name, free text.
    recorded_until
        ISO 8601, UTC.
    software, lock_sha256
        Name → version of what wrote the crate; hash of the lock.
    jobs
        In the order in which they can run.
    inputs
        What the campaign consists of, beside its results.
    workflow
        Files of the workflow, as they lie beside the crate.
    """

    campaign: str
    recorded_until: str
    software: Mapping[str, str]
    lock_sha256: str
    jobs: Sequence[Job]
    inputs: Sequence[Listed]
    workflow: Sequence[Listed]
