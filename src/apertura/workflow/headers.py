"""What the rules in `workflow/` quote: input, output, log, benchmark, resources and parameters, by their rows."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from apertura.campaign.digests import Result
from apertura.campaign.folder import Campaign
from apertura.formats.export import exports_in
from apertura.workflow.lineage import products_of, result_of
from apertura.workflow.resources import Resources, RuleResources
from apertura.workflow.rules import RESULTS, RULES, Rule


@dataclass(frozen=True)
class Headers:
    """The headers of a campaign's rules, by the name of a rule."""

    campaign: Campaign

    @cached_property
    def _resources(self) -> Resources:
        return Resources(self.campaign)

    def __getitem__(self, rule: str) -> "Header":
        """Return the header of a rule."""
        resources = self._resources[rule]
        return Header(resources.demand, resources.of, RULES[rule])


@dataclass(frozen=True)
class Header(RuleResources):
    """The header of one rule; methods take the wildcards of a job, as Snakemake calls them."""

    rule: Rule

    @property
    def output(self) -> list[str]:
        """Files of its results, with wildcards in braces: all but pictures, which a report shows; manifests last."""
        named = [*self.rule.documents, *products_of(self.rule)]
        listed = [file for file in map(self._beside, named) if file not in self.pictured]
        return [*listed, *(f"results/{row.manifest}.manifest.json" for row in self._rows)]

    @property
    def pictured(self) -> list[str]:
        """Pictures, which a report shows."""
        exports = exports_in(self.rule.exports) if self.rule.exports else ()
        drawn = [file for file in self.rule.products if file.endswith(".png")]
        return [self._beside(file) for file in (*drawn, *(one.file for one in exports if one.pictured))]

    @property
    def log(self) -> str:
        """What its step says."""
        return f"results/logs/{self.rule.log}.log"

    @property
    def benchmark(self) -> str:
        """How long a job took, and how much memory."""
        return f"results/benchmarks/{self.rule.log}.tsv"

    def sources(self, wildcards: Any) -> list[str]:
        """Return what a job reads."""
        named = dict.fromkeys(source for result in self._results(wildcards) for source in result.sources)
        return [str((self.of.campaign.root / source).location) for source in named]

    def settings(self, wildcards: Any) -> dict[str, Any]:
        """Return what of the config matters to a job."""
        return {name: value for result in self._results(wildcards) for name, value in result.settings.items()}

    def code(self, wildcards: Any) -> list[str]:
        """Return the hashes of the code of a job."""
        return [result.code_sha256 for result in self._results(wildcards)]

    @property
    def _rows(self) -> list[Rule]:
        """The rows of what it makes, or of what it does a share of."""
        return [row for row in RESULTS.values() if row.name == self.rule.name] or [RESULTS[self.rule.result]]

    def _results(self, wildcards: Any) -> list[Result]:
        where = [getattr(wildcards, word) for word in self.rule.of.wildcards]
        return [result_of(self.of.campaign, row.result, *where) for row in self._rows]

    def _beside(self, file: str) -> str:
        return "/".join(filter(None, ("results", self.rule.folder, file)))
