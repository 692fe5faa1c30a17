"""`apertura verify`: check the hashes of each link in the provenance chain from a product to the raw samples."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from apertura import __version__
from apertura.campaign.config import CONFIG
from apertura.campaign.digests import Result
from apertura.campaign.folder import Campaign
from apertura.campaign.store import compare, compare_origin, read_manifest, sha256_present, states_origin
from apertura.campaign.store.manifest import Difference
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of, shown
from apertura.common.provenance import lock_sha256, sha256_file, software
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.catalog.crate import recorded_files
from apertura.formats.catalog.validation import stac_problems
from apertura.views.verify.products import (
    SUFFIX,
    TAGGED,
    Product,
    document,
    find_product,
    hashes,
    manifests,
    read_tags,
)
from apertura.workflow.lineage import on_demand, results_of

State = Literal["changed", "missing", "same"]

_ORDER: tuple[State, ...] = ("changed", "missing", "same")
_LONGEST = 300
_DIGITS = 12
_NAMED = 3
_VERSIONS_NAMED = 4
HASH = re.compile("[0-9a-f]{64}")
_NO_FILE = "is not a regular file"
_FILES = {"missing": "missing", "altered": "changed", "added": "is new"}
"""Result of the comparison of a file of a stage → text."""


@dataclass
class ChainLink:
    """One link of a provenance chain.

    Attributes
    ----------
    name
        A file or stage relative to the campaign folder; or "code of", "settings of" or "tags of" a file.
    state
        Result of the comparison with the recorded hash.
    reason
        Differences, each with the name of the file that contains the recorded hash.
    """

    name: str
    state: State = "same"
    reason: list[str] = field(default_factory=list)

    def add(self, state: State, reason: str) -> None:
        """Add a difference to the link; state "missing" takes precedence over "changed"."""
        self.state = "missing" if "missing" in (state, self.state) else state
        if reason not in self.reason:
            self.reason.append(reason)


class Links:
    """Links by name; each file is read only once.

    Parameters
    ----------
    root
        The campaign folder.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     links = Links(Path(folder))
    ...     links.compare({"raw/codes.npy": "4c"}, "results/f01/a-a/echo.manifest.json")
    >>> [(link.name, link.state, link.reason) for link in links]
    [('raw/codes.npy', 'missing', ['recorded in results/f01/a-a/echo.manifest.json'])]
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._links: dict[str, ChainLink] = {}
        self._digests: dict[str, str] = {}

    def __iter__(self) -> Iterator[ChainLink]:
        """Yield the links in the order in which they were compared."""
        yield from self._links.values()

    def of(self, name: str) -> ChainLink:
        """Return the link with a given name; create the link if necessary."""
        return self._links.setdefault(name, ChainLink(name))

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file in the campaign folder; '' if missing; an error message if not readable."""
        if name not in self._digests:
            try:
                self._digests[name] = sha256_present(ConfinedPath.at(self.root).named(name, where=self.root))
            except CampaignError as error:
                self._digests[name] = error.found
        return self._digests[name]

    def exists(self, name: str) -> bool:
        """Return True if a file exists and can be read."""
        return HASH.fullmatch(self.sha256(name)) is not None

    def compare(self, recorded: Mapping[str, str], by: str) -> None:
        """Compare files, named relative to the campaign folder, with the hashes recorded in `by`."""
        for name in recorded:
            self.of(name)
        self.add(compare(recorded, self.sha256), by)

    def add(self, differences: Iterable[Difference], by: str) -> None:
        """Add differences from the record in `by` to the links of the files and sources."""
        for difference in differences:
            link = self.of(difference.name)
            if difference.state == "missing":
                link.add("missing", f"recorded in {by}")
            elif HASH.fullmatch(difference.present):
                present, recorded = shortened(difference.present), shortened(difference.recorded)
                link.add("changed", f"sha256 {present}, recorded as {recorded} in {by}")
            else:
                link.add("changed", difference.present)

    def compare_stage(self, name: str, recorded: Mapping[str, str], by: str) -> None:
        """Compare all files in the folder of a stage, including chunks, with the hashes recorded in `by`."""
        link = self.of(name)
        try:
            folder = ConfinedPath.at(self.root).named(name, where=by)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if not folder.is_dir():
            link.add("missing", f"recorded in {by}")
            return
        present_files = {
            path.relative_to(folder).as_posix(): path
            for path in folder.rglob("*")
            if not path.is_dir(follow_symlinks=False)
        }

        def present(file: str) -> str:
            path = present_files.get(file)
            if path is None:
                return ""
            return _NO_FILE if path.is_symlink() or not path.is_file() else sha256_file(path)

        differing = [
            (file.name, file.present if file.present == _NO_FILE else _FILES[file.state])
            for file in compare(recorded, present, added=present_files)
        ]
        if differing:
            listed = ", ".join(f"{file} {state}" for file, state in differing[:_NAMED])
            more = f" and {len(differing) - _NAMED} more" if len(differing) > _NAMED else ""
            all_missing = all(state == "missing" for _, state in differing)
            link.add("missing" if all_missing else "changed", f"{listed}{more}, compared with {by}")


def shortened(digest: str | None) -> str:
    """Return the first digits of a hash for messages.

    Examples
    --------
    >>> shortened("4cb8c29484fe402b113a"), shortened(None)
    ('4cb8c29484fe…', 'absent')
    """
    return f"{digest[:_DIGITS]}…" if digest else "absent"


class Chain:
    """Provenance chain of one or several results.

    Parameters
    ----------
    root
        The campaign folder.

    Attributes
    ----------
    links
        Links in the order in which they were compared.
    notes
        Differences between recorded and installed software versions, one line per difference.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.links = Links(root)
        self.notes: list[str] = []
        self._inputs: dict[str, dict[str, str]] = {}
        self._leaves: set[str] = set()
        self._waiting: list[str] = []
        self._rows: dict[str, Result] = {}
        self._expected: list[str] = []
        try:
            campaign = Campaign.load(root)
            for _, result in results_of(campaign):
                self._rows[result.manifest] = result
            self._expected = [manifest for manifest in self._rows if not on_demand(campaign, manifest)]
            self._has_config = True
        except CampaignError as error:  # without a config, the hashes in the manifests can still be compared
            self._has_config = False
            state: State = "changed" if (root / CONFIG).is_file() else "missing"
            self.links.of("campaign").add(state, str(error).replace(f"{root}/", ""))

    def promised(self) -> list[str]:
        """Return the manifests that a finished campaign contains according to its config."""
        return self._expected

    def walk(self, manifests: Iterable[str] = ()) -> None:
        """Compare results with their manifests; then, recursively, compare all sources of these results and of tags."""
        for manifest in manifests:
            link = self.links.of(manifest)
            if self.links.exists(manifest):
                self._waiting.append(manifest)
            elif found := self.links.sha256(manifest):
                link.add("changed", found)
            else:
                link.add("missing", "no such file")
        walked = set[str]()
        while self._waiting:
            manifest = self._waiting.pop(0)
            if manifest not in walked:
                walked.add(manifest)
                self._result(manifest)
        if all(link.state == "same" for link in self.links if link.name.endswith(SUFFIX)):
            for name, inputs in self._inputs.items():  # only a complete provenance chain contains all inputs
                for role in [role for role, digest in inputs.items() if digest not in self._leaves]:
                    self.links.of(name).add("changed", f"APERTURA_INPUTS: the hash of {role} is not in the chain")

    def tagged(self, path: Path, name: str, sources: Mapping[str, str] | None = None) -> bool:
        """Compare the tags of a file with its sources; return False if the file has no tags.

        Parameters
        ----------
        path, name
            Path of the file, and its name in messages.
        sources
            Sources in the manifest that lists the file; None if no manifest lists the file, so that the chain starts at
            the tags.
        """
        link = f"tags of {name}"
        try:
            tags = read_tags(path)
            if not tags:
                return False
            stated, inputs = (hashes(tags, key, path) for key in ("SOURCES", "INPUTS"))
            spec, made_with = document(tags, "RUNSPEC", path), document(tags, "SOFTWARE", path)
        except CampaignError as error:
            self.links.of(link).add("changed", error.found)
            return True
        self._inputs[link] = inputs
        self.notes += [note for note in other_versions(tags, made_with, name) if note not in self.notes]
        self._runspec(self.links.of(link), spec, stated)
        if sources is None:
            self.links.compare(stated, f"APERTURA_SOURCES of {name}")
            self._follow(stated)
            return True
        for source in sorted({*stated, *sources}):
            if stated.get(source) != sources.get(source):
                in_tag, in_manifest = (shortened(hashes_of.get(source)) for hashes_of in (stated, sources))
                self.links.of(link).add(
                    "changed", f"APERTURA_SOURCES: {source} is {in_tag} in the tag, and {in_manifest} in the manifest"
                )
        return True

    def _follow(self, sources: Mapping[str, str]) -> None:
        """Queue the manifests among the sources of a result, and record the hashes of the sources that are inputs."""
        for name, digest in sources.items():
            if not name.startswith("results/"):
                self._leaves.add(digest)
            elif name.endswith(SUFFIX) and self.links.exists(name):
                self._waiting.append(name)

    def _result(self, manifest: str) -> None:
        """Compare files, sources, code and settings of a result with its manifest."""
        link, path = self.links.of(manifest), self.root / manifest
        try:
            recorded = read_manifest(path)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if path.read_text(encoding="utf-8") != json.dumps(recorded, indent=1, sort_keys=True) + "\n":
            link.add("changed", "not formatted as by the workflow")
        self._files(manifest, recorded["files"], recorded.get("sources", {}))
        if not states_origin(recorded):
            link.add("changed", "contains no sources, code or settings, like manifests of versions before 0.1.0")
            return
        self._origin(manifest, recorded)
        self._follow(recorded["sources"])

    def _files(self, manifest: str, files: Mapping[str, str], sources: Mapping[str, str]) -> None:
        """Compare the files of a result; a stage with all its chunks is a single link."""
        folder, stages = manifest.rpartition("/")[0], dict[str, dict[str, str]]()
        for file, digest in files.items():
            stage, in_stage, rest = file.partition(".zarr/")
            name = f"{folder}/{file}"
            if in_stage:
                stages.setdefault(f"{folder}/{stage}.zarr", {})[rest] = digest
                continue
            self.links.compare({name: digest}, manifest)
            if name.endswith(TAGGED) and self.links.exists(name):
                self.tagged(self.root / name, name, sources)
        for name, chunks in stages.items():
            self.links.compare_stage(name, chunks, manifest)

    def _origin(self, manifest: str, recorded: Mapping[str, Any]) -> None:
        """Compare the recorded sources, code and settings of a result with the current ones."""
        result, link = self._rows.get(manifest), self.links.of(manifest)
        if result is None:  # without a config, the formats and therefore the code of a result are unknown
            if self._has_config:
                link.add("changed", "not a result of the campaign as configured")
            self.links.compare(recorded["sources"], manifest)
            return
        parts = {part: self.links.of(f"{part} of {manifest}") for part in ("code", "settings")}
        for name in recorded["sources"]:
            self.links.of(name)
        for difference in compare_origin(recorded, result, self.links.sha256):
            if difference.part == "code":
                made_by, installed = shortened(difference.recorded), shortened(difference.present)
                parts["code"].add("changed", f"made by code {made_by}, but code {installed} is installed")
            elif difference.part == "settings":
                parts["settings"].add("changed", f"{CONFIG} or a table in its folder was changed after the run")
            elif difference.state == "added":
                link.add("changed", f"has the additional source {difference.name}")
            else:
                self.links.add([difference], manifest)

    def _runspec(self, link: ChainLink, stated: Mapping[str, Any], sources: Mapping[str, str]) -> None:
        """Compare the settings in the tags with the settings of the source images."""
        for source in sources:
            folder, _, stage = source.rpartition("/")
            if stage == "image.manifest.json":
                spec = _spec(ConfinedPath.at(self.root).named(f"{folder}/image.zarr/zarr.json", where=link.name))
                image = folder.removeprefix("results/")  # for several images, settings are stored by image name
                candidates = stated, stated.get(image), stated.get(image.rpartition("/")[2])
                # a calibrated layer has further settings in addition to those of the image
                is_stated = isinstance(spec, Mapping) and any(
                    isinstance(settings, Mapping) and {**settings, **spec} == settings for settings in candidates
                )
                if spec is not None and not is_stated:
                    link.add("changed", f"APERTURA_RUNSPEC: {folder}/image.zarr was made with other settings")


def _spec(path: Path) -> Any:
    """Return the settings in the metadata of a stage; None if unreadable, which the link of the stage reports."""
    try:
        return json.loads(json.loads(path.read_text(encoding="utf-8"))["attributes"]["runspec"])
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None


def other_versions(tags: Mapping[str, str], made_with: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield a line for each difference between the software versions in the tags of a file and the installed versions.

    A different version is not a change of the product, but may explain a change.

    Parameters
    ----------
    tags
        Tags of the file.
    made_with
        Contents of the tag ``APERTURA_SOFTWARE``.
    name
        Name of the file in messages.

    Examples
    --------
    >>> list(other_versions({"APERTURA_VERSION": "0.0.9"}, {}, "db.tif"))
    ['apertura 0.0.9 made products such as db.tif, but 0.1.0 is installed: the code differs']
    """
    version = tags.get("APERTURA_VERSION", "before 0.1.0")
    if version != __version__:
        yield f"apertura {version} made products such as {name}, but {__version__} is installed: the code differs"
    installed = software() if made_with else {}
    packages = sorted(
        package
        for package in {*made_with, *installed} - {"apertura"}
        if made_with.get(package) != installed.get(package)
    )
    if packages:
        listed = ", ".join(
            f"{package} {made_with.get(package, 'absent')} (installed: {installed.get(package, 'absent')})"
            for package in packages[:_VERSIONS_NAMED]
        )
        more = f" and {len(packages) - _VERSIONS_NAMED} more" if len(packages) > _VERSIONS_NAMED else ""
        yield f"products were made with {listed}{more}: bytes may differ after recomputation"
    if tags.get("APERTURA_LOCK_SHA256", lock_sha256()) != lock_sha256():
        yield "products were made with a different requirements/all.txt"


def verify(path: Path, campaign: Path | None = None) -> Chain:
    """Compare a product, or all results of a campaign, and all their sources with the recorded hashes.

    Parameters
    ----------
    path
        Absolute path of a file, a stage or a manifest below results/, or of a campaign folder.
    campaign
        Campaign folder of a file that is stored elsewhere.

    Returns
    -------
    Chain
        The compared links. All bytes are read, and nothing is written.

    Raises
    ------
    CampaignError
        If the path is not a product, or the campaign of the product is unknown.
    """
    product = find_product(path, campaign)
    chain = Chain(product.root)
    if product.file is None:
        present = [manifest.relative_to(product.root).as_posix() for manifest in manifests(product.root / "results")]
        chain.walk(dict.fromkeys([*chain.promised(), *present]))
        return chain
    _start(chain, product, product.file)
    chain.walk([product.manifest] if product.manifest else [])
    return chain


def _start(chain: Chain, product: Product, file: Path) -> None:
    """Start a chain at a file: at the manifest that lists the file; if there is none, at the tags of the file."""
    below = file.is_relative_to(product.root)
    name = file.relative_to(product.root).as_posix() if below else file.name
    if product.manifest:
        if not below:
            chain.links.of(f"{name}, a copy of a file of {product.manifest}")
        return
    if not chain.tagged(file, name):
        expected = "a file that a manifest lists, or a file with tags of apertura"
        raise CampaignError("not listed in any manifest", file, expected, "Specify a file that the workflow wrote.")
    found = "not listed in any manifest" if below else "not identical to any file of that campaign"
    chain.links.of(name).add("changed", f"{found}; the sources are those in its tags")


def print_verified(path: Path, campaign: Path | None = None, *, quiet: bool = False) -> int:
    """Print a line for each link, differences first; return 0, or 1 if a link is changed or missing.

    Parameters
    ----------
    path, campaign
        See `verify`.
    quiet
        Print only changed and missing links.

    Raises
    ------
    CampaignError
        See `verify`; before the error is raised, the tags of the file are printed.
    """
    try:
        chain = verify(path, campaign)
    except CampaignError:
        _print_tags(path)
        raise
    links = sorted(chain.links, key=lambda link: _ORDER.index(link.state))
    for link in links:
        if link.state != "same" or not quiet:
            reason = f": {'; '.join(link.reason)}" if link.reason else ""
            print(f"{link.state:<8} {shown(link.name + reason, _LONGEST)}")
    for note in chain.notes:
        print(shown(note, _LONGEST))
    counts = [(state, sum(link.state == state for link in links)) for state in reversed(_ORDER)]
    if not quiet:
        print(f"{number_of(len(links), 'link')}: {', '.join(f'{count} {state}' for state, count in counts if count)}")
    return 0 if all(link.state == "same" for link in links) else 1


def _print_tags(path: Path) -> None:
    """Print the tags of a file whose chain cannot be followed."""
    if not path.is_file():
        return
    tags = read_tags(path)
    for name, text in sorted(tags.items()):
        if name in {"APERTURA_INPUTS", "APERTURA_SOURCES"}:
            for role, digest in document(tags, name.removeprefix("APERTURA_"), path).items():
                print(shown(f"{name} {role} {digest}", _LONGEST))
        else:
            print(shown(f"{name} {text}", _LONGEST))


_MOST = 20


def changed_files(root: Path, *, inputs: bool = True) -> dict[str, str]:
    """Return file → 'changed' or 'missing' for files that differ from the hashes in the RO-Crate.

    Parameters
    ----------
    root
        Folder of the crate, i.e. the results folder of a campaign.
    inputs
        Include recordings and config, which are in the parent folder.

    Raises
    ------
    CampaignError
        If the crate is missing or damaged, or names a file outside these folders.
    """
    files = recorded_files(root, inputs=inputs)

    def present(name: str) -> str:
        path = files[name].path
        try:
            return sha256_file(path) if path.is_file() else ""
        except OSError as error:
            expected, remedy = "a readable file", "Grant read permission, or copy the file again."
            raise CampaignError(f"not readable ({error.strerror})", path, expected, remedy) from error

    differences = compare({name: file.sha256 for name, file in files.items()}, present)
    return {file.name: "missing" if file.state == "missing" else "changed" for file in differences}


def print_checked(folder: Path, *, quiet: bool = False) -> int:
    """Print files that differ from the RO-Crate and errors of the STAC catalog; return the exit code.

    Parameters
    ----------
    folder
        A campaign folder, or its results folder; recordings are compared if the results are inside a campaign folder.
    quiet
        Print differences only.

    Returns
    -------
    int
        0 without differences, else 1.

    Raises
    ------
    CampaignError
        If the crate is missing or damaged.
    """
    root = folder if (folder / CRATE).is_file() else folder / "results"
    if folder.is_file():
        raise CampaignError("a file", folder, "a campaign folder, or its results folder", "Specify the folder.")
    in_campaign = (root.parent / "config").is_dir()
    lines = [f"{name}: {state}" for name, state in changed_files(root, inputs=in_campaign).items()]
    if (root / "stac" / CATALOG).is_file():
        lines += [f"stac/{problem}" for problem in stac_problems(root / "stac")]
    for line in lines[:_MOST]:
        print(shown(line, 500))
    if len(lines) > _MOST:
        print(f"and {len(lines) - _MOST} more")
    if not lines and not quiet:
        inputs = "included" if in_campaign else "not available for comparison"
        print(f"all files match the hashes in the crate (recordings and config {inputs}); the catalog is valid")
    return 1 if lines else 0
