"""Lineage of each result: source files, other results, settings and code, for rules, steps and checks.

A result is the output of a single rule. Its manifest, which is written last, contains the files and their lineage. A
result is out of date if a source, a setting or the code has changed, independent of file times. The lineage follows
from `apertura.workflow.rules`.
"""

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from apertura.campaign.config import KINDS
from apertura.campaign.digests import Result
from apertura.campaign.folder import Campaign
from apertura.common.code_imports import import_closure
from apertura.common.errors import CampaignError
from apertura.common.lazy import module_of
from apertura.common.provenance import code_sha256
from apertura.core.backprojection.engines import ENGINES
from apertura.formats.export import EXPORTS, export_modules, exports_in
from apertura.formats.names import FINDERS, PHASE_HISTORIES, RECORDERS, TRACKS, log_format
from apertura.workflow.rule_inputs import JobScope, Scope, SettingSpec, SourceSpec, is_sampled, received
from apertura.workflow.rules import EVERY, RESULTS, Rule

_READS = "apertura.formats.reading"
"""Module that calls the readers of recordings and logs; a step that imports it depends on the code of the readers."""

_FOCUSES = frozenset(
    {
        "apertura.core.backprojection.tiles",
        "apertura.methods.autofocus.patches",
        "apertura.methods.alignment.on_ground",
    }
)
"""Modules that call engines; a step that imports one of these modules depends on the code of all engines."""

_PROCESSES = "apertura.run.process"
"""Module that runs the steps of `RESULTS`; a step that imports it depends on the code of all stages."""

_KEPT = {"transfer": "echo"}
"""Result that is written on demand → value of `processing.keep` with which every run writes the result."""

_INPUTS = ("config", "raw")
"""Folders of a campaign whose files are all inputs."""


def result_of(campaign: Campaign, result: str, *where: str) -> Result:
    """Return a result of a campaign.

    Parameters
    ----------
    campaign
        Campaign with settings and flights.
    result
        A key of `apertura.workflow.rules.RESULTS`.
    *where
        Values of the wildcards in the row of the result, such as flight and pair.

    Raises
    ------
    CampaignError
        If the result does not exist in the campaign, such as the sums of a flight with a single pair.
    """
    rule = RESULTS[result]
    scope = JobScope(campaign, rule.of, where)
    if not rule.needed(scope):
        raise CampaignError(
            f"no {result} of {' '.join(where) or 'this campaign'}",
            where=campaign.root,
            expected="a result that follows from the campaign's flights and config",
            remedy="Choose a result listed by `apertura list`.",
        )
    sources = tuple(dict.fromkeys(source for one in rule.sources for source in _read(scope, one)))
    settings = {name: value for one in rule.settings for name, value in _stated(scope, one).items()}
    return Result(_manifest(rule, where), sources, settings, modules_of(campaign, result, *where))


def results_of(campaign: Campaign) -> Iterator[tuple[str, Result]]:
    """Yield name and result for all results of a campaign; each result follows the results on which it depends."""
    for name, _, result in places_of(campaign):
        yield name, result


def places_of(campaign: Campaign) -> Iterator[tuple[str, tuple[str, ...], Result]]:
    """Yield name, wildcard values and result for all results, in the order of `results_of`."""
    for rule, where in _jobs(campaign):
        yield rule.result, where, result_of(campaign, rule.result, *where)


def on_demand(campaign: Campaign, manifest: str) -> bool:
    """Return True if a manifest belongs to a result that is only written on demand, not by every run."""
    rule = RESULTS.get(manifest.rpartition("/")[2].removesuffix(".manifest.json"))
    return rule is not None and _on_demand(campaign, rule)


def reads_kept(campaign: Campaign, flight: str, pair: str) -> bool:
    """Return True if the transfer functions of a pair are read from stage `transfer` instead of the recording.

    This is the case if the recording is missing and the stage was computed from the current stage `echo`.
    """
    from apertura.campaign.store import read_manifest, sha256_present  # loads zarr, which delays the start of a run

    manifest, echo = (campaign.root / campaign.manifest(stage, flight, pair) for stage in ("transfer", "echo"))
    if campaign.promised_files(flight, pair.split("-")[1])[-1].is_file() or not manifest.is_file():
        return False
    return bool(read_manifest(manifest)["sources"].get(campaign.relative(echo)) == sha256_present(echo))


def files_read(campaign: Campaign, result: str, *where: str) -> Iterator[str]:
    """Yield the sources of a result, and the recordings from which its step computes transfer functions."""
    rule = RESULTS[result]
    yield from result_of(campaign, result, *where).sources
    if rule.forms and is_sampled(campaign):
        for pair in JobScope(campaign, rule.of, where).pairs:
            if not reads_kept(campaign, *pair):
                yield from received(JobScope(campaign, Scope.PAIR, pair))


def places(campaign: Campaign, rule: Rule) -> list[tuple[str, ...]]:
    """Return the wildcard values of each job of a rule, with flights in the order of `KINDS`."""
    return [where for kind in KINDS for where in _places(campaign, rule, kind)]


def products_of(rule: Rule) -> list[str]:
    """Return the products of a rule that are intended for users, i.e. the files next to its manifest."""
    return [*rule.products, *(row.file for row in (exports_in(rule.exports) if rule.exports else ()))]


def _jobs(campaign: Campaign) -> Iterator[tuple[Rule, tuple[str, ...]]]:
    """Yield rule and wildcard values of all results; calibration flights precede the flights that depend on them."""
    for kind in KINDS:
        for rule in RESULTS.values():
            yield from ((rule, where) for where in _places(campaign, rule, kind))


def _places(campaign: Campaign, rule: Rule, kind: str) -> list[tuple[str, ...]]:
    """Return the wildcard values of a rule's jobs for flights of a kind; campaign-wide jobs belong to kind image."""
    return _needed(rule, campaign, _candidates(campaign, rule, kind)) if kind in rule.kinds else []


def _needed(rule: Rule, campaign: Campaign, places: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    return [where for where in places if rule.needed(JobScope(campaign, rule.of, where))]


def _candidates(campaign: Campaign, rule: Rule, kind: str) -> list[tuple[str, ...]]:
    flights = [flight for flight in campaign.flights if flight.kind == kind]
    if rule.of in {Scope.CAMPAIGN, Scope.CHARTED}:
        return [()] if flights else []
    if rule.of is Scope.TWO:
        return [(name,) for name in campaign.settings.interferometry.pairs]
    if rule.of is Scope.STACKED:
        stack = campaign.settings.stack
        return [(name,) for name in stack.all_flights] if stack else []
    if rule.of is Scope.FLIGHT:
        return [(flight.name,) for flight in flights]
    pairs = rule.of is Scope.PAIR
    return [(flight.name, name) for flight in flights for name in (flight.pairs if pairs else flight.participants)]


def _manifest(rule: Rule, where: Iterable[str]) -> str:
    name = rule.manifest.format(**dict(zip(rule.of.wildcards, where, strict=True)))
    return f"results/{name}.manifest.json"


def manifests_below(scope: JobScope, rule: Rule) -> list[str]:
    """Return the manifests of a rule's results within the scope of a job, except results that the campaign lacks."""
    return [_manifest(rule, where) for where in _needed(rule, scope.campaign, scope.below(rule.of))]


def every_result(scope: JobScope) -> list[str]:
    """Return the manifests of all results except results written on demand and results that describe all results."""
    every = _jobs(scope.campaign)
    return [_manifest(rule, where) for rule, where in every if not _describes_all(scope.campaign, rule)]


def _read(scope: JobScope, source: SourceSpec) -> Iterable[str]:
    """Return the files and manifests of a source in a rule's row for a job."""
    if callable(source):
        return source(scope)
    if source == EVERY:
        return every_result(scope)
    return manifests_below(scope, RESULTS[source])


def _on_demand(campaign: Campaign, rule: Rule) -> bool:
    return rule.on_demand and _KEPT.get(rule.result) not in campaign.settings.processing.keep


def _describes_all(campaign: Campaign, rule: Rule) -> bool:
    return _on_demand(campaign, rule) or EVERY in rule.sources


def _stated(scope: JobScope, setting: SettingSpec) -> dict[str, Any]:
    """Return the values of a setting in a rule's row for a job: last part of the key → value."""
    if callable(setting):
        return dict(setting(scope))
    value: Any = scope.campaign.values
    for word in setting.split("."):
        value = value[word]
    return {setting.rpartition(".")[2]: value}


def modules_of(campaign: Campaign, result: str, *where: str) -> tuple[str, ...]:
    """Return the modules whose import closure is the code of a result, as dotted names.

    Only the readers for the formats of the files in raw/ are included.

    Parameters
    ----------
    campaign, result, *where
        See `result_of`.
    """
    rule = RESULTS[result]
    processed = _PROCESSES in _closure((rule.module,))
    rows = [rule, *(row for row in RESULTS.values() if processed and row.module.startswith("apertura.stages."))]
    measured = bool(campaign.coefficients)
    step = tuple(dict.fromkeys(name for row in rows for name in (row.module, *_written(row, measured=measured))))
    runs = _closure(step)
    engines = tuple(ENGINES.values()) if _FOCUSES & runs else ()
    readers = sorted(set(_readers(campaign, rule, where))) if _READS in runs else ()
    return (*step, *engines, *readers)


def _written(rule: Rule, *, measured: bool) -> tuple[str, ...]:
    styles = {row.module for row in EXPORTS if row.style} if rule.styles else set()
    exports = [*export_modules(rule.exports)] if rule.exports else []
    if measured:
        kinds = {"layers": ("radiometry", "multilook"), "fused": ("multilook_fused",)}
        more = (module for kind in kinds.get(rule.exports, ()) for module in export_modules(kind))
        exports += [module for module in dict.fromkeys(more) if module not in exports]
    return (*sorted(styles), *exports)


@cache
def _closure(modules: tuple[str, ...]) -> frozenset[str]:
    return frozenset(import_closure(modules))


def _readers(campaign: Campaign, rule: Rule, where: tuple[str, ...]) -> Iterator[str]:
    """Yield the modules that read the recordings and logs of a job's nodes."""
    stated = dict(zip(rule.of.wildcards, where, strict=True))
    flights = [campaign.flight(stated["flight"])] if "flight" in stated else campaign.flights
    named = {node for word in ("node", "pair") for node in stated.get(word, "").split("-")}
    for flight in flights:
        for node in named & {*flight.participants} or flight.participants:
            if not is_sampled(campaign):
                yield module_of(PHASE_HISTORIES[campaign.settings.waveform.format].reader)  # type: ignore[union-attr]
            elif "recordings" in rule.reads:
                first = campaign.promised_files(flight.name, node)[0].name
                rows = [row for row in RECORDERS if first.endswith(row[0])]
                yield from (module_of(table[row]) for table in (RECORDERS, FINDERS) for row in rows if row in table)
            if "logs" in rule.reads and campaign.logged(flight.name, node):
                yield _log_reader(campaign, flight.name, node)


def _log_reader(campaign: Campaign, flight: str, node: str) -> str:
    """Return the module that reads a log; for a missing log, the module of its suffix with which the log was read."""
    path, options = campaign.track_file(flight, node), campaign.settings.nodes[node].log.options
    manifest = campaign.root / campaign.manifest("track", flight, node)
    readers = [module_of(row.reader) for row in TRACKS.values() if path.suffix.lower() in row.suffixes]
    if path.is_file() or options.format in TRACKS or not readers or not manifest.is_file():
        return module_of(TRACKS[log_format(path, options)].reader)
    from apertura.campaign.store import read_manifest  # loads zarr

    code = read_manifest(manifest)["code"]
    return next((reader for reader in readers if code_sha256(RESULTS["track"].module, reader) == code), readers[0])


def with_inputs(campaign: Campaign, target: Path, *, link: bool) -> Path:
    """Copy the inputs of a campaign's results to a folder; return the folder.

    Parameters
    ----------
    campaign
        Campaign whose inputs are copied: config/, raw/, and other files named in the config.
    target
        Folder, which is created if it is missing.
    link
        Create hard links to recordings where possible. Without `link`, recordings are copied, so that later edits of
        the copy do not change the campaign.
    """
    sources = {source for _, result in results_of(campaign) for source in result.sources}
    named = [campaign.root / source for source in sources if source.partition("/")[0] not in {"results", *_INPUTS}]
    inputs = ["config", *([] if campaign.settings.raw_root else ["raw"])]  # raw_root is absolute: valid in the copy
    for path in sorted({*named, *(path for folder in inputs for path in (campaign.root / folder).rglob("*"))}):
        if path.is_file(follow_symlinks=False):
            relative = path.relative_to(campaign.root)
            (target / relative).parent.mkdir(parents=True, exist_ok=True)
            path.copy_to(target / relative, link=link and relative.parts[0] == "raw")
    return target
