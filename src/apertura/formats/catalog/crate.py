"""RO-Crate of a run, profile Provenance Run Crate 0.5: creation of the document, and reading of its hashes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from rocrate.model.entity import Entity
from rocrate.rocrate import ROCrate

from apertura.common.attribution import Attribution, Creator
from apertura.common.confined import ConfinedPath
from apertura.common.documents import DAMAGED, read_json, undamaged
from apertura.common.provenance import LARGEST_DOCUMENT, canonical_json, sha256_text
from apertura.formats.catalog import CRATE
from apertura.formats.catalog.stac import media_type

# ---- Content of a crate: jobs, files, software ----------------------------------------------------------------------


@dataclass(frozen=True)
class Listed:
    """File listed in a crate.

    Attributes
    ----------
    name
        Path relative to the results; for an input, relative to the campaign folder.
    sha256
        SHA-256 of the file, hex.
    size
        Size in bytes; None if the file no longer exists.
    """

    name: str
    sha256: str
    size: int | None


@dataclass(frozen=True)
class CrateJob:
    """Executed job of the workflow.

    Attributes
    ----------
    rule, where
        Rule of the workflow; flight and pair, or other wildcards.
    command
        Command line, ready to paste into a shell.
    code_sha256
        Hash of the executed code.
    settings
        Settings that affect the job.
    sources
        Names of the job's sources: results, identified by their manifests (``results/…``), and inputs.
    files
        Output files, manifests last.
    doubts
        Reasons why the result is out of date, one line each.
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
        """Identifier of the job."""
        return "/".join([self.rule, *self.where])


@dataclass(frozen=True)
class CrateRun:
    """Content of a crate: a run with its jobs and files.

    Attributes
    ----------
    campaign
        Name of the campaign, free text.
    recorded_until
        Time of the last recorded pulse, ISO 8601, UTC.
    software, lock_sha256
        Name → version of the software that wrote the crate; hash of the lock file.
    jobs
        Jobs in the order of their dependencies.
    inputs
        Input files in the campaign folder.
    workflow
        Files of the workflow, copied to the folder of the crate.
    attribution
        Section `metadata` of the config.
    """

    campaign: str
    recorded_until: str
    software: Mapping[str, str]
    lock_sha256: str
    jobs: Sequence[CrateJob]
    inputs: Sequence[Listed]
    workflow: Sequence[Listed]
    attribution: Attribution = field(default_factory=Attribution)


# ---- RO-Crate document, profile Provenance Run Crate 0.5 ------------------------------------------------------------
#
# The root of the crate is the folder of results. Recordings and config, which lie outside, are contextual entities with
# name and hash: a crate must not refer to files above its root, and results are shared without their recordings.

WORKFLOW = "workflow/Snakefile"
"""Path of the workflow in the crate; the rules of the workflow are in a subfolder."""

_CRATE_SPEC = "https://w3id.org/ro/crate/1.1"
_WORKFLOW_CRATE = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
_PROFILES = {
    "https://w3id.org/ro/wfrun/process/0.5": "Process Run Crate",
    "https://w3id.org/ro/wfrun/workflow/0.5": "Workflow Run Crate",
    "https://w3id.org/ro/wfrun/provenance/0.5": "Provenance Run Crate",
    _WORKFLOW_CRATE: "Workflow RO-Crate",
}
_TERMS = "https://w3id.org/ro/terms/workflow-run/context"
_COMPLETED = "http://schema.org/CompletedActionStatus"
_LICENCE = "#licence"
_RUN, _ORGANISED, _LOCK = "#run", "#organised", "#lock"


def crate_document(run: CrateRun) -> dict[str, Any]:
    """Build the metadata document of a run; identical runs give identical documents.

    Examples
    --------
    >>> image = Listed("f01/a-b/db.tif", "0" * 64, 10)
    >>> job = CrateJob("export", ["f01", "a-b"], "apertura step export f01 a-b", "1" * 64, {}, [], [image])
    >>> rules = [Listed(WORKFLOW, "2" * 64, 10)]
    >>> versions = {"apertura": "1", "snakemake": "9"}
    >>> run = CrateRun("tandem", "2025-05-14T09:30:00Z", versions, "3" * 64, [job], [], rules)
    >>> entities = {entity["@id"]: entity for entity in crate_document(run)["@graph"]}
    >>> entities["#job/export/f01/a-b"]["result"], entities["f01/a-b/db.tif"]["sha256"][:4]
    ({'@id': 'f01/a-b/db.tif'}, '0000')
    """
    crate = ROCrate(version="1.1")
    crate.metadata.extra_contexts.append(_TERMS)
    crate.metadata["conformsTo"] = [{"@id": uri} for uri in (_CRATE_SPEC, _WORKFLOW_CRATE)]
    tops, data = _data(run)
    entities = [*_software(run), *_steps(run), *_jobs(run), *data, *map(_input, run.inputs)]
    unique = {entity["@id"]: entity for entity in entities}
    actions = [entity for entity in entities if str(entity["@type"]).endswith("Action")]
    for name, value in _root(run, tops, actions).items():
        crate.root_dataset[name] = value
    crate.add(*(Entity(crate, entity.pop("@id"), properties=entity) for entity in unique.values()))
    document: dict[str, Any] = crate.metadata.generate()
    return document


def input_id(name: str) -> str:
    """Return the identifier of an input in the crate.

    Examples
    --------
    >>> input_id("raw/f 01/a.csv")
    '#input/raw/f%2001/a.csv'
    """
    return f"#input/{quote(name)}"


def _root(run: CrateRun, parts: Sequence[str], actions: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    stated = run.attribution
    description = (
        f"Images of the campaign {run.campaign}, with every processing step from its recordings to the images. "
        "Recordings and config are listed with their hashes; the files are in the parent folder. Actions have no "
        "times, and datePublished is the time of the last recorded pulse, so that the same recordings, settings and "
        "code always give the same crate. Versions are those of the installation that wrote the crate."
    )
    return {
        "name": stated.title or run.campaign,
        "description": description,
        "datePublished": run.recorded_until,
        "license": {"@id": _licence_id(run)},
        **({"alternateName": run.campaign} if stated.title else {}),
        **({"author": _refs(map(_person_id, stated.creators))} if stated.creators else {}),
        **({"publisher": {"@id": _organisation_id(stated.institution)}} if stated.institution else {}),
        **({"identifier": f"https://doi.org/{stated.doi}"} if stated.doi else {}),
        "conformsTo": _refs(_PROFILES),
        "hasPart": _refs(parts),
        "mainEntity": {"@id": WORKFLOW},
        "mentions": _refs(action["@id"] for action in actions),
    }


def _licence_id(run: CrateRun) -> str:
    licence = run.attribution.licence
    return f"https://spdx.org/licenses/{licence}" if licence else _LICENCE


def _person_id(creator: Creator) -> str:
    return f"https://orcid.org/{creator.orcid}" if creator.orcid else f"#person/{quote(creator.name)}"


def _organisation_id(name: str) -> str:
    return f"#organisation/{quote(name)}"


def _software(run: CrateRun) -> Iterator[dict[str, Any]]:
    for uri, name in _PROFILES.items():
        yield {"@id": uri, "@type": "CreativeWork", "name": name, "version": uri.rpartition("/")[2]}
    stated = run.attribution
    if stated.licence:
        yield {"@id": _licence_id(run), "@type": "CreativeWork", "name": stated.licence, "identifier": stated.licence}
    else:
        yield {
            "@id": _LICENCE,
            "@type": "CreativeWork",
            "name": "not stated",
            "description": "No licence is configured (metadata.licence); ask the owner of the recordings.",
        }
    for creator in stated.creators:
        member = {"affiliation": {"@id": _organisation_id(creator.affiliation)}} if creator.affiliation else {}
        yield {"@id": _person_id(creator), "@type": "Person", "name": creator.name, **member}
    for organisation in (stated.institution, *(creator.affiliation for creator in stated.creators)):
        if organisation:
            yield {"@id": _organisation_id(organisation), "@type": "Organization", "name": organisation}
    for name, version in run.software.items():
        yield {"@id": f"#software/{name}", "@type": "SoftwareApplication", "name": name, "version": version}
    yield {
        "@id": _LOCK,
        "@type": "PropertyValue",
        "name": "sha256 of requirements/all.txt",
        "value": run.lock_sha256,
        "description": "Lock file shipped with apertura: versions and hashes of the tested environment.",
    }
    yield {"@id": "#snakemake", "@type": "ComputerLanguage", "name": "Snakemake", "version": run.software["snakemake"]}


def _steps(run: CrateRun) -> Iterator[dict[str, Any]]:
    """Yield the workflow, its steps, and their tools: one tool for each rule and each version of its executed code."""
    tools: dict[str, dict[str, str]] = {}
    for job in run.jobs:
        tools.setdefault(job.rule, {})[_tool(job)] = job.code_sha256
    requirements = _refs(f"#software/{name}" for name in run.software)
    yield {
        "@id": WORKFLOW,
        "@type": ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
        "name": "apertura",
        "version": run.software["apertura"],
        "programmingLanguage": {"@id": "#snakemake"},
        "hasPart": _refs(tool for codes in tools.values() for tool in codes),
        "step": _refs(f"#step/{rule}" for rule in tools),
        "softwareRequirements": requirements,
        **_bytes(next(file for file in run.workflow if file.name == WORKFLOW)),
    }
    for position, (rule, codes) in enumerate(tools.items()):
        step = {"@id": f"#step/{rule}", "@type": "HowToStep", "name": f"rule {rule}", "position": str(position)}
        yield {**step, "workExample": _refs(codes)}
        for tool, code in codes.items():
            yield {
                "@id": tool,
                "@type": "SoftwareApplication",
                "name": f"apertura step {rule}",
                "version": run.software["apertura"],
                "identifier": f"sha256:{code}",
                "description": "The identifier is the hash of all code that this step can execute.",
                "softwareRequirements": requirements,
            }


def _jobs(run: CrateRun) -> Iterator[dict[str, Any]]:
    """Yield all actions, and the parameters shared by them."""
    manifests = [_id(file) for job in run.jobs for file in job.files if file.name.endswith(".manifest.json")]
    whole_run = {
        "name": f"apertura run on {run.campaign}",
        "description": "All rules of the workflow, from the recordings to the metadata of the images.",
        "instrument": {"@id": WORKFLOW},
        "object": _refs(input_id(file.name) for file in run.inputs),
        "result": _refs(manifests),
        "environment": {"@id": _LOCK},
        "actionStatus": _COMPLETED,
    }
    yield {"@id": _RUN, "@type": "CreateAction", **whole_run}
    yield {
        "@id": _ORGANISED,
        "@type": "OrganizeAction",
        "name": "Snakemake",
        "instrument": {"@id": "#software/snakemake"},
        "object": _refs(f"#control/{job.path}" for job in run.jobs),
        "result": {"@id": _RUN},
    }
    for job in run.jobs:
        parameters = [_parameter(name, value) for name, value in sorted(job.settings.items())]
        yield from parameters
        sources = [
            quote(name.removeprefix("results/")) if name.startswith("results/") else input_id(name)
            for name in job.sources
        ]
        yield {
            "@id": f"#job/{job.path}",
            "@type": "CreateAction",
            "name": job.command,
            "description": "; ".join(job.doubts) or "Up to date with the current code and settings.",
            "instrument": {"@id": _tool(job)},
            "object": _refs([*sources, *(parameter["@id"] for parameter in parameters)]),
            "result": _refs(_stage(file) or _id(file) for file in job.files),
            "environment": {"@id": _LOCK},
            "actionStatus": _COMPLETED,
        }
        yield {
            "@id": f"#control/{job.path}",
            "@type": "ControlAction",
            "name": f"rule {job.rule}",
            "instrument": {"@id": f"#step/{job.rule}"},
            "object": {"@id": f"#job/{job.path}"},
        }


def _data(run: CrateRun) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the identifiers of the entities in the crate's root, and the entities of all files and stages."""
    stages: dict[str, list[str]] = {}
    tops, entities = [], []
    for listed in [*run.workflow, *(file for job in run.jobs for file in job.files)]:
        stage = _stage(listed)
        if stage:
            stages.setdefault(stage, []).append(_id(listed))
        else:
            tops.append(_id(listed))
        if listed.name != WORKFLOW:
            entities.append({"@id": _id(listed), "@type": "File", "name": listed.name, **_bytes(listed)})
    for stage, files in stages.items():
        entities.append({"@id": stage, "@type": "Dataset", "name": unquote(stage), "hasPart": _refs(files)})
    return [*tops, *stages], entities


def _input(file: Listed) -> dict[str, Any]:
    entity = {"@id": input_id(file.name), "@type": "CreativeWork", "name": file.name}
    return {**entity, "description": "Input file, in the campaign folder (parent of the results).", **_bytes(file)}


def _bytes(file: Listed) -> dict[str, Any]:
    size = {} if file.size is None else {"contentSize": str(file.size)}
    return {"sha256": file.sha256, "encodingFormat": media_type(file.name).partition(";")[0], **size}


def _parameter(name: str, value: object) -> dict[str, Any]:
    text = value if isinstance(value, str) else canonical_json(value)
    return {
        "@id": f"#setting/{quote(name)}/{sha256_text(text)[:16]}",
        "@type": "PropertyValue",
        "name": name,
        "value": text,
    }


def _tool(job: CrateJob) -> str:
    return f"#tool/{job.rule}/{job.code_sha256[:16]}"


def _stage(file: Listed) -> str | None:
    """Return the identifier of the stage that contains a file; None if no stage contains it."""
    name, inner, _ = file.name.partition(".zarr/")
    return quote(f"{name}.zarr/") if inner else None


def _id(file: Listed) -> str:
    return quote(file.name)


def _refs(ids: Iterable[str]) -> dict[str, str] | list[dict[str, str]]:
    """Return references as a list, or a single reference without a list, as RO-Crate recommends."""
    references = [{"@id": identifier} for identifier in dict.fromkeys(ids)]
    return references[0] if len(references) == 1 else references


# ---- Files listed in a crate, with their recorded hashes ------------------------------------------------------------

_EXPECTED = "an RO-Crate written by the workflow"


@dataclass(frozen=True)
class CrateFile:
    """File listed in a crate with its hash.

    Attributes
    ----------
    path
        Path of the file, whether or not it exists.
    sha256
        Hash recorded in the crate, hex.
    """

    path: Path
    sha256: str


def recorded_files(root: Path, *, inputs: bool = True) -> dict[str, CrateFile]:
    """Return the files whose hashes are listed in a crate, by their names in the crate; the files are not opened.

    Parameters
    ----------
    root
        Folder of the crate: the results of a campaign.
    inputs
        True to include recordings and config, which are in the parent folder.

    Raises
    ------
    CampaignError
        If the crate is missing or damaged, or lists a file outside of these folders.

    Examples
    --------
    >>> recorded_files(Path("nowhere"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/ro-crate-metadata.json: no such file; expected an RO-Crate ...
    """
    crate = ConfinedPath.at(root).named(CRATE, where=root)
    document = read_json(crate, expected=_EXPECTED, remedy="Run the workflow first.", largest=LARGEST_DOCUMENT)
    with undamaged(crate, expected=_EXPECTED, remedy=DAMAGED):
        files = [_recorded(entity, root, crate) for entity in document["@graph"] if "sha256" in entity]
    return {name: file for name, file, is_input in files if inputs or not is_input}


def _recorded(entity: dict[str, Any], root: Path, crate: Path) -> tuple[str, CrateFile, bool]:
    """Return name and file of an entity, and True if it is an input outside of the crate's folder."""
    identifier, prefix = str(entity["@id"]), input_id("")
    is_input = identifier.startswith(prefix)
    name = unquote(identifier.removeprefix(prefix))
    path = ConfinedPath.at(root.parent if is_input else root).named(name, where=crate)
    return name, CrateFile(path, str(entity["sha256"])), is_input
