"""Rule `ro_crate`: description of the whole run as an RO-Crate, results/ro-crate-metadata.json; the last step."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from apertura.campaign.digests import Result
from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest, record_files, remake, remake_from
from apertura.common.atomic import write_json, write_text
from apertura.common.documents import read_json, undamaged
from apertura.common.paths import shipped
from apertura.common.provenance import lock_sha256, sha256_text, software
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.catalog.crate import CrateJob, CrateRun, Listed, crate_document
from apertura.formats.catalog.stac import RECORDED
from apertura.workflow.lineage import on_demand, places_of, result_of
from apertura.workflow.rules import RESULTS, RULES


def ro_crate(campaign: Campaign) -> Sequence[Path]:
    """Write results/ro-crate-metadata.json, and a copy of the workflow next to it; return their paths."""
    lineage = result_of(campaign, "ro_crate").begin(campaign.root)
    folder = shipped() / "workflow"
    paths = [folder / "Snakefile", *sorted((folder / "rules").glob("*.smk"))]
    workflow = {f"workflow/{path.relative_to(folder).as_posix()}": path.read_text("utf-8") for path in paths}
    manifest = campaign.root / lineage.result.manifest
    manifest.unlink(missing_ok=True)
    for name, text in workflow.items():
        write_text(campaign.result(name), text)
    results = list(_results(campaign))
    read = {name: sha256 for one in reversed(results) for name, sha256 in one.recorded["sources"].items()}
    # Recordings: hashes at the time when they were read; config: hashes at present.
    hashes = {**read, **lineage.sources.digests}
    inputs = sorted(name for name in hashes if not name.startswith("results/"))
    catalog, expected = campaign.result("stac", CATALOG), "the catalogue that step stac writes"
    remedy = remake(campaign.result("stac"))
    document = read_json(catalog, expected=expected, remedy=remedy)
    with undamaged(catalog, expected=expected, remedy=remedy):
        recorded_until = str(document[RECORDED][1])
    run = CrateRun(
        campaign.settings.campaign,
        recorded_until,
        software(),
        lock_sha256(),
        list(_jobs(campaign, results, hashes)),
        [Listed(name, hashes[name], _size(campaign.root.named(name, where=campaign.root))) for name in inputs],
        [Listed(name, sha256_text(text), len(text.encode())) for name, text in workflow.items()],
        attribution=campaign.settings.metadata,
    )
    written = [campaign.result(name) for name in (CRATE, *workflow)]
    write_json(written[0], crate_document(run))
    record_files(manifest, written, lineage)
    return written


class _FinishedResult(NamedTuple):
    """Result of the campaign with its manifest."""

    name: str
    where: tuple[str, ...]
    result: Result
    recorded: Mapping[str, Any]


def _results(campaign: Campaign) -> Iterator[_FinishedResult]:
    """Yield every result that the crate describes."""
    for name, where, result in places_of(campaign):
        if name != "ro_crate" and not on_demand(campaign, result.manifest):
            path = campaign.root / result.manifest
            recorded, expected = read_manifest(path), "a manifest that states the sources of a result"
            with undamaged(path, expected=expected, remedy=remake_from(path)):
                hashes = {key: str(recorded[key]) for key in ("code", "settings")}
                sources = dict(recorded["sources"])
                yield _FinishedResult(name, where, result, {**recorded, **hashes, "sources": sources})


def _jobs(campaign: Campaign, results: Sequence[_FinishedResult], hashes: Mapping[str, str]) -> Iterator[CrateJob]:
    """Yield every job that wrote results; a job may write several results.

    Parameters
    ----------
    campaign
        Campaign with the files.
    results
        Finished results.
    hashes
        File of the campaign → SHA-256: of an input, when the input was first read; of a result, at present.
    """
    jobs = dict[tuple[str, tuple[str, ...]], list[_FinishedResult]]()
    for one in results:
        jobs.setdefault((RESULTS[one.name].name, one.where), []).append(one)
    for (rule, where), parts in jobs.items():
        doubts = [doubt for one in parts for doubt in _differences(one.recorded, one.result, hashes)]
        yield CrateJob(
            rule,
            where,
            RULES[rule].command_line(where),
            parts[0].recorded["code"],
            {name: value for one in parts for name, value in one.result.settings.items()},
            list(dict.fromkeys(source for one in parts for source in one.recorded["sources"])),
            [file for one in parts for file in _files(campaign, one, hashes)],
            list(dict.fromkeys(doubts)),
        )


def _differences(recorded: Mapping[str, Any], result: Result, hashes: Mapping[str, str]) -> Iterator[str]:
    """Yield the differences of a result's code, settings and sources from the current code, settings and sources."""
    if recorded["code"] != result.code_sha256:
        yield f"written by code that differs from the installed code of sha256 {result.code_sha256}"
    if recorded["settings"] != result.settings_sha256:
        yield f"written with other settings, of sha256 {recorded['settings']}"
    for name, sha256 in recorded["sources"].items():
        if hashes.get(name) != sha256:
            yield f"written from {name} of sha256 {sha256}, which has changed since"


def _files(campaign: Campaign, one: _FinishedResult, hashes: Mapping[str, str]) -> list[Listed]:
    """Return the files of a result, including its manifest."""
    manifest = one.result.manifest.removeprefix("results/")
    folder, where = manifest.rpartition("/")[0], campaign.root / one.result.manifest
    files = {f"{folder}/{name}" if folder else name: sha256 for name, sha256 in sorted(one.recorded["files"].items())}
    files[manifest] = hashes[one.result.manifest]
    return [Listed(name, sha256, _size(campaign.results.named(name, where=where))) for name, sha256 in files.items()]


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None
