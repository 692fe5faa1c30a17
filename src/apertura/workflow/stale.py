"""Detection of out-of-date results, for which a source, a setting or the code has changed.

Current hashes are compared with those in the manifests of results. File times are ignored.
"""

import re
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from apertura.campaign.digests import Result, digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import compare, compare_origin, damaged_files, read_manifest, states_origin
from apertura.common.atomic import date
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of, shown
from apertura.workflow.lineage import files_read, on_demand, places_of, products_of, results_of
from apertura.workflow.rules import RESULTS

_ONLY_LOOKS = (
    r"-[a-zA-Z]*[nlSD][a-zA-Z]*|--(dry-?run|lint|list.*|lt|lc|lp|summary|detailed-summary|dag|d3dag|rulegraph|filegraph|"
    r"report.*|unlock|cleanup.*|containerize|export-cwl|archive|compilation|print-compilation|delete-.*|help|version)"
)
"""Options with which Snakemake reads a workflow without running it."""

_RAW = "raw/"
_SOURCE = {"missing": "is missing", "altered": "has changed", "added": "is a new source"}


def stale_results(campaign: Campaign, *, paranoid: bool = False) -> dict[str, str]:
    """Return manifest → reason for each existing result that is out of date, in the order of dependencies.

    The reason is empty for a result that is only out of date because it depends on another out-of-date result. A
    missing file of raw/ is not a reason, because recordings may be stored elsewhere (see `absent_files`).

    Parameters
    ----------
    campaign
        Campaign with settings and flights.
    paranoid
        Compute the hashes of all files, including those whose size and times agree with those of a cached hash.
    """
    stale: dict[str, str] = {}
    for name, result in results_of(campaign):
        path = campaign.root.named(result.manifest, where=campaign.root)
        if not path.is_file():
            if any((path.parent / file).is_file() for file in products_of(RESULTS[name])):
                stale[result.manifest] = "the manifest, which contains the lineage, is missing"
            continue
        try:
            reasons = list(_reasons(campaign.root, result, read_manifest(path), paranoid=paranoid))
        except CampaignError:
            reasons = ["the manifest is damaged"]
        if reasons or not stale.keys().isdisjoint(result.sources):
            stale[result.manifest] = "; ".join(reasons)
    return stale


def outdated_places(campaign: Campaign, name: str) -> list[tuple[str, ...]]:
    """Return the wildcard values of the jobs of a result whose results are missing or out of date."""
    stale = stale_results(campaign)
    return [
        where
        for result_name, where, result in places_of(campaign)
        if result_name == name and (result.manifest in stale or not (campaign.root / result.manifest).is_file())
    ]


def without_outdated(campaign: Campaign) -> Campaign:
    """Return the campaign with its out-of-date results marked, so that plans are based on config and files instead."""
    return replace(campaign, outdated=frozenset(stale_results(campaign)))


def outdated_lines(campaign: Campaign) -> Iterator[str]:
    """Yield a line on the results marked by `without_outdated`."""
    if campaign.outdated:
        count = number_of(len(campaign.outdated), "result")
        yield (
            f"{count} out of date ({min(campaign.outdated)}): the plan is based on the config; `apertura run` updates "
            "the results"
        )


def absent_files(campaign: Campaign) -> list[str]:
    """Return the missing files of raw/ that are sources of existing results."""
    existing = (result for _, result in results_of(campaign) if (campaign.root / result.manifest).is_file())
    sources = dict.fromkeys(name for result in existing for name in result.sources if name.startswith(_RAW))
    return [name for name in sources if not (campaign.root / name).is_file()]


def wanted_files(campaign: Campaign, stale: Collection[str]) -> dict[str, str]:
    """Return missing file of raw/ that a run needs → manifest of the first result that needs the file.

    `stale` contains the manifests returned by `stale_results`.
    """
    missing = dict[str, str]()
    for name, where, result in places_of(campaign):
        is_current = (campaign.root / result.manifest).is_file() and result.manifest not in stale
        if not is_current and not on_demand(campaign, result.manifest):
            for source in files_read(campaign, name, *where):
                if source.startswith(_RAW) and not (campaign.root / source).is_file():
                    missing.setdefault(source, result.manifest)
    return missing


def absent_lines(campaign: Campaign) -> Iterator[str]:
    """Yield a line if raw/ is stored elsewhere, and a line if files of raw/ are missing and therefore not compared."""
    if campaign.settings.raw_root:
        yield f"recordings are read from {shown(campaign.settings.raw_root, 400)} (raw_root in the config)"
    if absent := absent_files(campaign):
        more = f" and {len(absent) - 1} more" if len(absent) > 1 else ""
        yield f"recordings are missing and not compared with results: {shown(absent[0])}{more}"


def any_is_missing(campaign: Campaign) -> bool:
    """Return True if a result that every run writes is missing."""
    expected = (result.manifest for _, result in results_of(campaign) if not on_demand(campaign, result.manifest))
    return not all((campaign.root / manifest).is_file() for manifest in expected)


def settle_times(campaign: Campaign, stale: Collection[str]) -> None:
    """Set the file times of up-to-date results: not older than their sources, and not in the future.

    Snakemake recomputes results that are older than their inputs, even if the times were lost when copying the files.
    Snakemake also rejects inputs with times in the future, which occur after a clock was set back.
    """
    results, now_ns = [result for _, result in results_of(campaign)], time.time_ns()
    inputs = {source for result in results for source in result.sources if not source.startswith("results/")}
    newest_ns = _newest_ns(campaign.root, inputs)
    for result in results:
        newest_ns = max(newest_ns, _newest_ns(campaign.root, result.sources))
        path = campaign.root / result.manifest
        if result.manifest not in stale and path.is_file():
            files = [path.parent / file for file in read_manifest(path)["files"] if ".zarr/" not in file]
            date([path, *files], earliest_ns=newest_ns, latest_ns=now_ns)
    # Benchmark files are also outputs of the rules, and Snakemake compares the oldest output.
    benchmarks = (campaign.root / "results" / "benchmarks").rglob("*.tsv")
    date(benchmarks, earliest_ns=newest_ns, latest_ns=now_ns)


def _newest_ns(root: ConfinedPath, names: Iterable[str]) -> int:
    return max((path.stat().st_mtime_ns for path in (root / name for name in names) if path.is_file()), default=0)


def make_again(campaign: Campaign, stale: Mapping[str, str], *, remove: bool) -> None:
    """Print the results to be recomputed; with `remove`, delete their manifests, so that they count as unfinished."""
    for line in stale_lines(stale):
        print(line, file=sys.stderr, flush=True)
    # Start with dependent results, so that no finished result depends on an unfinished result after a kill.
    for manifest in reversed(list(stale)) if remove else ():
        for kept in _set_aside(campaign.root, manifest):
            print(f"a manually edited file is kept as {kept}", file=sys.stderr, flush=True)
        (campaign.root / manifest).unlink(missing_ok=True)
    if stale and not remove:
        print(
            "a dry run of snakemake does not include these results; use `apertura run CAMPAIGN -n` instead",
            file=sys.stderr,
        )


def _set_aside(root: ConfinedPath, manifest: str) -> Iterator[str]:
    """Rename manually edited files of a result, so that the workflow does not overwrite the edits; yield new names."""
    path = root / manifest
    try:
        files = read_manifest(path)["files"]
    except CampaignError:  # without a manifest, edits cannot be detected
        return
    for name, digest in files.items():
        file = path.parent.named(name, where=path)
        if ".zarr/" in name or not file.is_file() or digest_of(root, file.relative_to(root).as_posix()) == digest:
            continue
        free = (file.with_stem(f"{file.stem}.edited{f'-{number}' if number else ''}") for number in count())
        kept = next(other for other in free if not other.exists())
        file.rename(kept)
        yield kept.relative_to(root).as_posix()


def stale_lines(stale: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each reason, with the out-of-date results, and a line for dependent results.

    Examples
    --------
    >>> list(stale_lines({"a.json": "the code has changed", "b.json": "the code has changed", "c.json": ""}))
    ['a.json and 1 more: out of date, the code has changed', '1 dependent result also out of date']
    """
    by_reason: dict[str, list[str]] = {}
    for manifest, reason in stale.items():
        by_reason.setdefault(reason, []).append(manifest)
    dependent = len(by_reason.pop("", ()))
    for reason, manifests in by_reason.items():
        more = f" and {len(manifests) - 1} more" if len(manifests) > 1 else ""
        yield f"{manifests[0]}{more}: out of date, {reason}"
    if dependent:
        yield f"{number_of(dependent, 'dependent result')} also out of date"


def forms_results(arguments: Sequence[str]) -> bool:
    """Return True if a command line of Snakemake runs jobs; the workflow has no other means of detecting a dry run.

    Examples
    --------
    >>> forms_results(["snakemake", "--cores", "2"]), forms_results(["snakemake", "-np"])
    (True, False)
    """
    return not any(re.fullmatch(_ONLY_LOOKS, argument) for argument in arguments[1:])


def damaged_results(campaign: Campaign) -> dict[str, str]:
    """Return manifest → description of damage for each damaged result; all bytes of all existing results are read."""
    damaged = {}
    for _, result in results_of(campaign):
        path = campaign.root.named(result.manifest, where=campaign.root)
        if path.is_file():
            try:
                files = damaged_files(path)
            except CampaignError:
                damaged[result.manifest] = "the manifest is damaged"
                continue
            if files:
                others = f", and {len(files) - 1} more" if len(files) > 1 else ""
                damaged[result.manifest] = f"changed since the result was written: {files[0]}{others}"
    return damaged


def _reasons(root: ConfinedPath, result: Result, recorded: Mapping[str, Any], *, paranoid: bool) -> Iterator[str]:
    if not states_origin(recorded):
        yield "the manifest does not contain the lineage"
        return
    folder = (root / result.manifest).parent

    def file(name: str) -> str:  # chunks of arrays are verified when they are read
        path = folder.named(name, where=root / result.manifest)
        if not path.is_file():
            return ""
        return str(recorded["files"][name]) if ".zarr/" in name else digest_of(root, path.relative_to(root).as_posix())

    def source(name: str) -> str:
        path = root.named(name, where=root / result.manifest)
        return digest_of(root, name, paranoid=paranoid) if path.is_file() else ""

    for difference in compare(recorded["files"], file):
        if difference.state == "missing":
            yield f"{difference.name} is missing"
            break
        yield f"{difference.name} has changed since it was written"
    for difference in compare_origin(recorded, result, source):
        if difference.part == "source":
            elsewhere = difference.state == "missing" and difference.name.startswith(_RAW)
            if not elsewhere or difference.name not in result.sources:
                yield f"{difference.name} {_SOURCE[difference.state]}"
        else:
            yield {"settings": "the settings have changed", "code": "the code has changed"}[difference.part]
