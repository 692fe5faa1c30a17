"""What every result is made from: files, other results, settings, code. Rules, steps and checks ask here.

A result is what one rule writes. Its manifest, written last, names its files and what they were made from; another
file, setting or code makes it stale, whatever the times of files say. All of it follows from `apertura.workflow.rules`.
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
from apertura.workflow.rule_inputs import JobPlace, Scope, SettingSpec, SourceSpec, is_sampled, received
from apertura.workflow.rules import EVERY, RESULTS, Rule

_READS = "apertura.formats.reading"
"""Calls the readers of rows: a result whose step imports it may read what was recorded."""

_FOCUSES = frozenset(
    {
        "apertura.core.backprojection.tiles",
        "apertura.methods.autofocus.patches",
        "apertura.methods.alignment.on_ground",
    }
)
"""Call engines: a result whose step imports one of them may stand on pixels that any engine has formed."""

_KEPT = {"transfer": "echo"}
"""Result made on demand → word of `processing.keep` by which every run makes it."""

_INPUTS = ("config", "raw")
"""Folders of a campaign that are inputs with all that is in them."""


def result_of(campaign: Campaign, result: str, *where: str) -> Result:
    """Return a result of a campaign.

    Parameters
    ----------
    campaign
        Settings and flights.
    result
        A key of `apertura.workflow.rules.RESULTS`.
    *where
        What it is of: values of the wildcards of its row.

    Raises
    ------
    CampaignError
        If the campaign has none there, as sums of one pair.
    """
    rule = RESULTS[result]
    place = JobPlace(campaign, rule.of, where)
    if not rule.needed(place):
        raise CampaignError(
            f"no {result} of {' '.join(where) or 'this campaign'}",
            where=campaign.root,
            expected="a result that its flights and its config have",
            remedy="`apertura list` shows them.",
        )
    sources = tuple(dict.fromkeys(source for one in rule.sources for source in _read(place, one)))
    settings = {name: value for one in rule.settings for name, value in _stated(place, one).items()}
    return Result(_manifest(rule, where), sources, settings, modules_of(campaign, result, *where))


def results_of(campaign: Campaign) -> Iterator[tuple[str, Result]]:
    """Yield every result of a campaign with its name, each after those it is made from."""
    for result, _, made in places_of(campaign):
        yield result, made


def places_of(campaign: Campaign) -> Iterator[tuple[str, tuple[str, ...], Result]]:
    """Yield every result as `results_of` does, with what it is of, as `result_of` takes it."""
    for rule, where in _jobs(campaign):
        yield rule.result, where, result_of(campaign, rule.result, *where)


def on_demand(campaign: Campaign, manifest: str) -> bool:
    """Return whether a manifest is that of a result made when it is asked for, and not by every run."""
    rule = RESULTS.get(manifest.rpartition("/")[2].removesuffix(".manifest.json"))
    return rule is not None and _on_demand(campaign, rule)


def reads_kept(campaign: Campaign, flight: str, pair: str) -> bool:
    """Return whether a pair's transfer functions are read from stage `transfer`, and not formed from the recording.

    They are where the recording is gone, and the stage is of the echo that is there.
    """
    from apertura.campaign.store import read_manifest, sha256_present  # loads arrays: a run, too, waits for them

    manifest, echo = (campaign.root / campaign.manifest(stage, flight, pair) for stage in ("transfer", "echo"))
    if campaign.promised_files(flight, pair.split("-")[1])[-1].is_file() or not manifest.is_file():
        return False
    return bool(read_manifest(manifest)["sources"].get(campaign.relative(echo)) == sha256_present(echo))


def files_read(campaign: Campaign, result: str, *where: str) -> Iterator[str]:
    """Yield the sources of a result, and the recordings that its step forms transfer functions from."""
    rule = RESULTS[result]
    yield from result_of(campaign, result, *where).sources
    if rule.forms and is_sampled(campaign):
        for pair in JobPlace(campaign, rule.of, where).pairs:
            if not reads_kept(campaign, *pair):
                yield from received(JobPlace(campaign, Scope.PAIR, pair))


def places(campaign: Campaign, rule: Rule) -> list[tuple[str, ...]]:
    """Return what each job of a rule runs on, values of its wildcards; flights in the order of `KINDS`."""
    return [where for kind in KINDS for where in _places(campaign, rule, kind)]


def products_of(rule: Rule) -> list[str]:
    """Return the files beside the manifest of a rule that people open."""
    return [*rule.products, *(row.file for row in (exports_in(rule.exports) if rule.exports else ()))]


def _jobs(campaign: Campaign) -> Iterator[tuple[Rule, tuple[str, ...]]]:
    """Yield rule and place of every result: calibration flights first, which correct the echoes of others."""
    for kind in KINDS:
        for rule in RESULTS.values():
            yield from ((rule, where) for where in _places(campaign, rule, kind))


def _places(campaign: Campaign, rule: Rule, kind: str) -> list[tuple[str, ...]]:
    """Return the places of a rule that belong to flights of a kind; those of the campaign belong to its images."""
    return _needed(rule, campaign, _candidates(campaign, rule, kind)) if kind in rule.kinds else []


def _needed(rule: Rule, campaign: Campaign, places: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    return [where for where in places if rule.needed(JobPlace(campaign, rule.of, where))]


def _candidates(campaign: Campaign, rule: Rule, kind: str) -> list[tuple[str, ...]]:
    flights = [flight for flight in campaign.flights if flight.kind == kind]
    if rule.of in {Scope.CAMPAIGN, Scope.CHARTED}:
        return [()] if flights else []
    if rule.of is Scope.TWO:
        return [(name,) for name in campaign.settings.interferometry.pairs]
    if rule.of is Scope.FLIGHT:
        return [(flight.name,) for flight in flights]
    pairs = rule.of is Scope.PAIR
    return [(flight.name, one) for flight in flights for one in (flight.pairs if pairs else flight.participants)]


def _manifest(rule: Rule, where: Iterable[str]) -> str:
    name = rule.manifest.format(**dict(zip(rule.of.wildcards, where, strict=True)))
    return f"results/{name}.manifest.json"


def manifests_below(place: JobPlace, rule: Rule) -> list[str]:
    """Return the manifests of a rule's results that belong to what a job runs on, and that the campaign has."""
    return [_manifest(rule, where) for where in _needed(rule, place.campaign, place.below(rule.of))]


def every_result(place: JobPlace) -> list[str]:
    """Return the manifests of all results but those made on demand, and of those that describe all."""
    every = _jobs(place.campaign)
    return [_manifest(rule, where) for rule, where in every if not _describes_all(place.campaign, rule)]


def _read(place: JobPlace, source: SourceSpec) -> Iterable[str]:
    """Return what a source of a row names at a place."""
    if callable(source):
        return source(place)
    if source == EVERY:
        return every_result(place)
    return manifests_below(place, RESULTS[source])


def _on_demand(campaign: Campaign, rule: Rule) -> bool:
    return rule.on_demand and _KEPT.get(rule.result) not in campaign.settings.processing.keep


def _describes_all(campaign: Campaign, rule: Rule) -> bool:
    return _on_demand(campaign, rule) or EVERY in rule.sources


def _stated(place: JobPlace, setting: SettingSpec) -> dict[str, Any]:
    """Return what a setting of a row says at a place, by the last word of its key."""
    if callable(setting):
        return dict(setting(place))
    value: Any = place.campaign.values
    for word in setting.split("."):
        value = value[word]
    return {setting.rpartition(".")[2]: value}


def modules_of(campaign: Campaign, result: str, *where: str) -> tuple[str, ...]:
    """Return the modules whose import closure is the code that makes a result, as dotted names.

    Of readers those count that the files in raw/ name: another format's reader makes nothing again.

    Parameters
    ----------
    campaign, result, *where
        As `result_of`.
    """
    rule = RESULTS[result]
    step = (rule.module, *_written(rule, measured=bool(campaign.coefficients)))
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
    """Yield the modules that read what the nodes of a place have recorded, and their logs."""
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
    """Return the module that reads a log; of one that is not there, by its suffix, the module that has read it."""
    path, options = campaign.track_file(flight, node), campaign.settings.nodes[node].log.options
    manifest = campaign.root / campaign.manifest("track", flight, node)
    readers = [module_of(row.reader) for row in TRACKS.values() if path.suffix.lower() in row.suffixes]
    if path.is_file() or options.format in TRACKS or not readers or not manifest.is_file():
        return module_of(TRACKS[log_format(path, options)].reader)
    from apertura.campaign.store import read_manifest  # loads arrays

    code = read_manifest(manifest)["code"]
    return next((one for one in readers if code_sha256(RESULTS["track"].module, one) == code), readers[0])


def with_inputs(campaign: Campaign, target: Path, *, link: bool) -> Path:
    """Fill a folder with what a campaign's results are made from; return it.

    What stays is copied: who edits it later must not edit the recordings of the campaign.

    Parameters
    ----------
    campaign
        Of whose folder plain files are taken: those of config/ and raw/, and others that its configuration names.
    target
        The folder, made where it is missing.
    link
        Give recordings as hard links where that is possible.
    """
    sources = {source for _, result in results_of(campaign) for source in result.sources}
    named = [campaign.root / source for source in sources if source.partition("/")[0] not in {"results", *_INPUTS}]
    inputs = ["config", *([] if campaign.settings.raw_root else ["raw"])]  # the config names raw_root there, too
    for path in sorted({*named, *(path for folder in inputs for path in (campaign.root / folder).rglob("*"))}):
        if path.is_file(follow_symlinks=False):
            here = path.relative_to(campaign.root)
            (target / here).parent.mkdir(parents=True, exist_ok=True)
            path.copy_to(target / here, link=link and here.parts[0] == "raw")
    return target
