"""From a product back to the raw samples: every link of the chain compared with what its manifests have recorded."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CONFIG
from apertura.pipeline.digests import Result
from apertura.pipeline.lineage import on_demand, results_of
from apertura.pipeline.store import read_manifest
from apertura.views.verification.links import Link, Links, State, shortened
from apertura.views.verification.tags import TAGGED, document, hashes, read_tags
from apertura.views.verification.versions import other_versions


class Chain:
    """The links below some results.

    Parameters
    ----------
    root
        The campaign folder.

    Attributes
    ----------
    links
        As they were met.
    notes
        Which versions differ from those of now, a line each.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.links = Links(root)
        self.notes: list[str] = []
        self._inputs: dict[str, dict[str, str]] = {}
        self._leaves: set[str] = set()
        self._waiting: list[str] = []
        self._rows: dict[str, Result] = {}
        try:
            for _, result in results_of(Campaign.load(root)):
                self._rows[result.manifest] = result
            self._promised = True
        except CampaignError as error:  # what its manifests say can be compared all the same
            self._promised = False
            state: State = "changed" if (root / CONFIG).is_file() else "missing"
            self.links.of("campaign").add(state, str(error).replace(f"{root}/", ""))

    def promised(self) -> list[str]:
        """Return the manifests that a finished campaign has by its config."""
        return [manifest for manifest in self._rows if not on_demand(manifest)]

    def walk(self, manifests: Iterable[str] = ()) -> None:
        """Compare some results, and all that these and tags looked at before stand on."""
        for manifest in manifests:
            self._source(manifest, "", "")
        walked = set[str]()
        while self._waiting:
            manifest = self._waiting.pop(0)
            if manifest not in walked:
                walked.add(manifest)
                self._result(manifest)
        if all(link.state == "same" for link in self.links if link.name.endswith(".manifest.json")):
            for name, told in self._inputs.items():  # the whole chain is known: no input can hide in what is not
                for role in [role for role, digest in told.items() if digest not in self._leaves]:
                    self.links.of(name).add("changed", f"APERTURA_INPUTS: {role} with that hash is not in its chain")

    def tagged(self, path: Path, name: str, sources: Mapping[str, str] | None = None) -> bool:
        """Compare the tags of a file; return whether it has any.

        Parameters
        ----------
        path, name
            Where it lies, and what it is called.
        sources
            What its manifest says it was made from; None: nothing lists it, so that its tags alone begin the chain.
        """
        link = f"tags of {name}"
        try:
            tags = read_tags(path)
            if not tags:
                return False
            told, inputs = (hashes(tags, key, path) for key in ("SOURCES", "INPUTS"))
            spec, software = document(tags, "RUNSPEC", path), document(tags, "SOFTWARE", path)
        except CampaignError as error:
            self.links.of(link).add("changed", error.found)
            return True
        self._inputs[link] = inputs
        self.notes += [note for note in other_versions(tags, software, name) if note not in self.notes]
        self._runspec(self.links.of(link), spec, told)
        for source in sorted({*told, *(sources or ())}):
            if sources is None:
                self._source(source, told[source], f"APERTURA_SOURCES of {name}")
            elif told.get(source) != sources.get(source):
                now, was = (shortened(one.get(source)) for one in (told, sources))
                self.links.of(link).add("changed", f"APERTURA_SOURCES: {source} is {now}, in its manifest {was}")
        return True

    def _source(self, name: str, was: str, by: str) -> None:
        there = self.links.compare(name, was, by)
        if not name.startswith("results/"):
            self._leaves.add(was)
        elif there and name.endswith(".manifest.json"):
            self._waiting.append(name)

    def _result(self, manifest: str) -> None:
        """Compare a result with its manifest, and its manifest with what it stands on."""
        link, path = self.links.of(manifest), self.root / manifest
        try:
            recorded = read_manifest(path)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if path.read_text(encoding="utf-8") != json.dumps(recorded, indent=1, sort_keys=True) + "\n":
            link.add("changed", "not as the workflow writes it")
        sources = recorded.get("sources", {})
        self._files(manifest, recorded["files"], sources)
        if not {"sources", "settings", "code"} <= recorded.keys():
            link.add("changed", "does not say what it was made from, as versions before 0.1.0 did not")
            return
        self._made_by(manifest, recorded)
        for source, was in sources.items():
            self._source(source, was, manifest)

    def _files(self, manifest: str, files: Mapping[str, str], sources: Mapping[str, str]) -> None:
        """Compare the files of a result: a stage is one link, with all of its chunks."""
        folder, stages = manifest.rpartition("/")[0], dict[str, dict[str, str]]()
        for file, was in files.items():
            stage, of_stage, rest = file.partition(".zarr/")
            name = f"{folder}/{file}"
            if of_stage:
                stages.setdefault(f"{folder}/{stage}.zarr", {})[rest] = was
            elif self.links.compare(name, was, manifest) and name.endswith(TAGGED):
                self.tagged(self.root / name, name, sources)
        for name, chunks in stages.items():
            self.links.compare_stage(name, chunks, manifest)

    def _made_by(self, manifest: str, recorded: Mapping[str, Any]) -> None:
        """Compare code and settings with those of now."""
        result = self._rows.get(manifest)
        if result is None:  # where the config cannot be read, nobody knows which formats and so which code it asks for
            if self._promised:
                self.links.of(manifest).add("changed", "the config promises no such result")
            return
        now, was, link = result.code_sha256, str(recorded["code"]), self.links.of(f"code of {manifest}")
        if was != now:
            link.add("changed", f"{shortened(now)} is installed, {shortened(was)} made it")
        settings = self.links.of(f"settings of {manifest}")
        if recorded["settings"] != result.settings_sha256:
            settings.add("changed", f"{CONFIG} or a table beside it says otherwise now")
        for source in sorted(set(result.sources) - recorded["sources"].keys()):
            self.links.of(manifest).add("changed", f"{source} is new to it")

    def _runspec(self, link: Link, told: Mapping[str, Any], sources: Mapping[str, str]) -> None:
        """Compare the settings in tags with those of the images they come from."""
        for source in sources:
            folder, _, stage = source.rpartition("/")
            if stage == "image.manifest.json":
                spec = _spec(inside(self.root, f"{folder}/image.zarr/zarr.json", where=link.name))
                image = folder.removeprefix("results/")  # of several, each has its own under its name
                if spec is not None and spec not in (told, told.get(image), told.get(image.rpartition("/")[2])):
                    link.add("changed", f"APERTURA_RUNSPEC: {folder}/image.zarr was made with other settings")


def _spec(path: Path) -> Any:
    """Return the settings that a stage says of itself; None where it says none: it has a link of its own."""
    try:
        return json.loads(json.loads(path.read_text(encoding="utf-8"))["attributes"]["runspec"])
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None


def _key(manifest: str) -> str:
    """Return the key of `RESULTS` that a manifest is most likely of.

    Examples
    --------
    >>> _key("results/f01/fused/export.manifest.json"), _key("results/f01/a-b/echo.manifest.json")
    ('fused', 'echo')
    """
    folder, _, name = manifest.rpartition("/")
    stem = name.removesuffix(".manifest.json")
    return "fused" if stem == "export" and folder.endswith("/fused") else stem
