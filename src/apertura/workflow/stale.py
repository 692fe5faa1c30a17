"""Results that another file, another setting or other code has overtaken, whatever the times of files say."""

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
"""Options with which snakemake reads a workflow and runs none of it."""

_RAW = "raw/"
_SOURCE = {"missing": "is gone", "altered": "has changed", "added": "is new to it"}


def stale_results(campaign: Campaign, *, paranoid: bool = False) -> dict[str, str]:
    """Return manifest → why its result has to be made again, of those that are there, each after those it depends on.

    The reason is empty where it only depends on one that is made again. A file of raw/ that is not there overtakes
    nothing: it may lie elsewhere, see `absent_files`.

    Parameters
    ----------
    campaign
        Settings and flights.
    paranoid
        Read every file, also where its state is that of a hash taken before.
    """
    stale: dict[str, str] = {}
    for name, result in results_of(campaign):
        path = campaign.root.named(result.manifest, where=campaign.root)
        if not path.is_file():
            if any((path.parent / file).is_file() for file in products_of(RESULTS[name])):
                stale[result.manifest] = "its manifest is gone, which said what its files were made from"
            continue
        try:
            reasons = list(_reasons(campaign.root, result, read_manifest(path), paranoid=paranoid))
        except CampaignError:
            reasons = ["its manifest is damaged"]
        if reasons or not stale.keys().isdisjoint(result.sources):
            stale[result.manifest] = "; ".join(reasons)
    return stale


def without_outdated(campaign: Campaign) -> Campaign:
    """Return a campaign whose plans are taken from its config and files: results that are out of date are not read."""
    return replace(campaign, outdated=frozenset(stale_results(campaign)))


def outdated_lines(campaign: Campaign) -> Iterator[str]:
    """Yield a line on the results that `without_outdated` has taken out of account."""
    if campaign.outdated:
        count = number_of(len(campaign.outdated), "result")
        yield f"{count} out of date ({min(campaign.outdated)}): planned from the config; `apertura run` updates them"


def absent_files(campaign: Campaign) -> list[str]:
    """Return the files of raw/ that results which are there were made from, and that are not there themselves."""
    made = (result for _, result in results_of(campaign) if (campaign.root / result.manifest).is_file())
    sources = dict.fromkeys(name for result in made for name in result.sources if name.startswith(_RAW))
    return [name for name in sources if not (campaign.root / name).is_file()]


def wanted_files(campaign: Campaign, stale: Collection[str]) -> dict[str, str]:
    """Return file of raw/ that is not there and that a run would read → manifest of the first result it is read for.

    `stale` holds the manifests of `stale_results`.
    """
    wanted = dict[str, str]()
    for name, where, result in places_of(campaign):
        made = (campaign.root / result.manifest).is_file() and result.manifest not in stale
        if not made and not on_demand(campaign, result.manifest):
            for source in files_read(campaign, name, *where):
                if source.startswith(_RAW) and not (campaign.root / source).is_file():
                    wanted.setdefault(source, result.manifest)
    return wanted


def absent_lines(campaign: Campaign) -> Iterator[str]:
    """Yield a line where raw/ lies elsewhere, and one where files of it are missing and not compared with results."""
    if campaign.settings.raw_root:
        yield f"recordings are read from {shown(campaign.settings.raw_root, 400)} (raw_root in the config)"
    if absent := absent_files(campaign):
        more = f" and {len(absent) - 1} more" if len(absent) > 1 else ""
        yield f"not there, so results are not compared with it: {shown(absent[0])}{more}"


def any_is_missing(campaign: Campaign) -> bool:
    """Test whether a result is missing that is not made on demand."""
    made = (result.manifest for _, result in results_of(campaign) if not on_demand(campaign, result.manifest))
    return not all((campaign.root / manifest).is_file() for manifest in made)


def settle_times(campaign: Campaign, stale: Collection[str]) -> None:
    """Give results that are not stale times that say so: not before what they were made from, and not after now.

    Snakemake makes again what is older than its input, also where a copy has lost the times, and refuses an input from
    the future, as a clock that was set back leaves it.
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
    benchmarks = (campaign.root / "results" / "benchmarks").rglob("*.tsv")  # Snakemake's oldest output may be one
    date(benchmarks, earliest_ns=newest_ns, latest_ns=now_ns)


def _newest_ns(root: ConfinedPath, names: Iterable[str]) -> int:
    return max((path.stat().st_mtime_ns for path in (root / name for name in names) if path.is_file()), default=0)


def make_again(campaign: Campaign, stale: Mapping[str, str], *, remove: bool) -> None:
    """Print the results that will be made again, and `remove` their manifests: without one a result is unfinished."""
    for line in stale_lines(stale):
        print(line, file=sys.stderr, flush=True)
    for manifest in reversed(list(stale)) if remove else ():  # dependent results first: a kill leaves no gap below
        for kept in _set_aside(campaign.root, manifest):
            print(f"what was edited by hand is kept as {kept}", file=sys.stderr, flush=True)
        (campaign.root / manifest).unlink(missing_ok=True)
    if stale and not remove:
        print("a dry run of snakemake alone does not count them: `apertura run CAMPAIGN -n` does", file=sys.stderr)


def _set_aside(root: ConfinedPath, manifest: str) -> Iterator[str]:
    """Put files of a result that were edited since out of the workflow's way; yield their new names."""
    path = root / manifest
    try:
        files = read_manifest(path)["files"]
    except CampaignError:  # their former hashes are unknown
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
    """Yield a line for each reason and the results it holds for, and one for those that only depend on them.

    Examples
    --------
    >>> list(stale_lines({"a.json": "its code has changed", "b.json": "its code has changed", "c.json": ""}))
    ['a.json and 1 more: stale, its code has changed', '1 result stands on that: stale, too']
    """
    holds_for: dict[str, list[str]] = {}
    for manifest, why in stale.items():
        holds_for.setdefault(why, []).append(manifest)
    standing = len(holds_for.pop("", ()))
    for why, manifests in holds_for.items():
        more = f" and {len(manifests) - 1} more" if len(manifests) > 1 else ""
        yield f"{manifests[0]}{more}: stale, {why}"
    if standing:
        yield f"{standing} results stand on that: stale, too" if standing > 1 else "1 result stands on that: stale, too"


def forms_results(arguments: Sequence[str]) -> bool:
    """Test whether a command line of snakemake runs jobs; inside the workflow nothing else states it.

    Examples
    --------
    >>> forms_results(["snakemake", "--cores", "2"]), forms_results(["snakemake", "-np"])
    (True, False)
    """
    return not any(re.fullmatch(_ONLY_LOOKS, argument) for argument in arguments[1:])


def damaged_results(campaign: Campaign) -> dict[str, str]:
    """Return manifest → what of a result is not as it was written, of those that are there; every byte is read."""
    damaged = {}
    for _, result in results_of(campaign):
        path = campaign.root.named(result.manifest, where=campaign.root)
        if path.is_file():
            try:
                files = damaged_files(path)
            except CampaignError:
                damaged[result.manifest] = "its manifest is damaged"
                continue
            if files:
                damaged[result.manifest] = f"{files[0]} is not as it was written" + (
                    f", nor are {len(files) - 1} others" if len(files) > 1 else ""
                )
    return damaged


def _reasons(root: ConfinedPath, result: Result, recorded: Mapping[str, Any], *, paranoid: bool) -> Iterator[str]:
    if not states_origin(recorded):
        yield "it does not say what it was made from"
        return
    folder = (root / result.manifest).parent

    def file(name: str) -> str:  # arrays are looked into where they are opened
        path = folder.named(name, where=root / result.manifest)
        if not path.is_file():
            return ""
        return str(recorded["files"][name]) if ".zarr/" in name else digest_of(root, path.relative_to(root).as_posix())

    def source(name: str) -> str:
        path = root.named(name, where=root / result.manifest)
        return digest_of(root, name, paranoid=paranoid) if path.is_file() else ""

    for difference in compare(recorded["files"], file):
        if difference.state == "missing":
            yield f"{difference.name} is gone"
            break
        yield f"{difference.name} is not as it was written"
    for difference in compare_origin(recorded, result, source):
        if difference.part == "source":
            elsewhere = difference.state == "missing" and difference.name.startswith(_RAW)
            if not elsewhere or difference.name not in result.sources:
                yield f"{difference.name} {_SOURCE[difference.state]}"
        else:
            yield {"settings": "its settings have changed", "code": "its code has changed"}[difference.part]
