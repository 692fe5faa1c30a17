"""Inputs, resources and parameters of the rules in `workflow/`, computed from flights and settings of the campaign.

The rules in `workflow/` contain file names literally. `apertura.workflow.rules` defines the same graph for lineage and
for the detection of out-of-date results. A test compares both graphs.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from apertura.campaign.folder import Campaign
from apertura.formats.export import added_exports
from apertura.workflow.lineage import manifests_below, result_of
from apertura.workflow.resources import Resources
from apertura.workflow.rule_inputs import JobScope, Scope
from apertura.workflow.rules import RESULTS, RULES, Rule

FilesOfJob = Callable[[Any], list[str]]
"""Wildcards of a job → files, relative to the campaign folder."""


@dataclass(frozen=True)
class Job:
    """Resources and parameters of the jobs of a rule for Snakemake, as functions of the wildcards of a job."""

    threads: Callable[..., int]
    resources: Mapping[str, Callable[..., int]]
    params: Mapping[str, Callable[..., Any]]


@dataclass(frozen=True)
class Jobs:
    """Jobs of the rules for a campaign."""

    campaign: Campaign

    @cached_property
    def _resources(self) -> Resources:
        return Resources(self.campaign)

    def __getitem__(self, rule: str) -> Job:
        """Return resources and parameters (settings and code of the results) of the jobs of a rule."""
        resources, row = self._resources[rule], RULES[rule]
        rows = [other for other in RESULTS.values() if other.name == rule] or [RESULTS[row.result]]

        def results(wildcards: Any) -> list[Any]:
            where = [getattr(wildcards, word) for word in row.of.wildcards]
            return [result_of(self.campaign, row_of.result, *where) for row_of in rows]

        params = {
            "settings": lambda wildcards: {k: v for result in results(wildcards) for k, v in result.settings.items()},
            "code": lambda wildcards: [result.code_sha256 for result in results(wildcards)],
        }
        return Job(resources.threads, {"mem_mb": resources.mem_mb, "runtime": resources.runtime}, params)

    def each(self, manifest: str, of: Scope | None = None) -> FilesOfJob:
        """Return the input function for a manifest with wildcards: one manifest per node, pair or flight of the job.

        Results that do not exist in the campaign are omitted, such as the terrain of a campaign without a DEM.
        """
        row = next(row for row in RESULTS.values() if f"results/{row.manifest}.manifest.json" == manifest)
        return lambda wildcards: manifests_below(self._scope(wildcards, of), row)

    def files(self, source: Callable[[JobScope], Iterable[str]], of: Scope | None = None) -> FilesOfJob:
        """Return an input function for the files returned by a function of `apertura.workflow.rule_inputs`."""
        root = self.campaign.root
        return lambda wildcards: [str((root / name).location) for name in source(self._scope(wildcards, of))]

    def _scope(self, wildcards: Any, of: Scope | None) -> JobScope:
        """Return the scope of a job: of the given kind, or of the kind implied by the wildcards of the job."""
        named = {name for name in ("flight", "node", "pair", "two") if hasattr(wildcards, name)}
        of = of or next(of for of in Scope if set(of.wildcards) == named)
        return JobScope(self.campaign, of, tuple(getattr(wildcards, word) for word in of.wildcards))


def added_files(rule: str) -> list[str]:
    """Return the files that other packages add to a rule through entry points of group ``apertura.exports``."""
    row: Rule = RULES[rule]
    return [f"results/{row.folder}/{one.file}" for one in added_exports(row.exports)]
