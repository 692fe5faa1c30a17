"""`apertura verify`: from a product back to the raw samples, each link compared with its recorded hashes."""

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
_FILES = {"missing": "missing", "altered": "changed", "added": "is new"}
"""State of a file of a stage → words."""


@dataclass
class ChainLink:
    """One link of a chain.

    Attributes
    ----------
    name
        A file or stage relative to the campaign folder; or code, settings or tags, and of which.
    state
        Against what was recorded.
    why
        What differs, and which file records what it should be.
    """

    name: str
    state: State = "same"
    why: list[str] = field(default_factory=list)

    def add(self, state: State, why: str) -> None:
        """Note what is wrong with it; a second note adds to the first."""
        self.state = "missing" if "missing" in (state, self.state) else state
        if why not in self.why:
            self.why.append(why)


class Links:
    """Links by name, each file read once.

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
    >>> [(link.name, link.state, link.why) for link in links]
    [('raw/codes.npy', 'missing', ['recorded by results/f01/a-a/echo.manifest.json'])]
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._links: dict[str, ChainLink] = {}
        self._digests: dict[str, str] = {}

    def __iter__(self) -> Iterator[ChainLink]:
        """Yield the links in the order in which they were compared."""
        yield from self._links.values()

    def of(self, name: str) -> ChainLink:
        """Return the link of that name."""
        return self._links.setdefault(name, ChainLink(name))

    def sha256(self, name: str) -> str:
        """Return the sha256 of a file, relative to the campaign folder; empty: not there; words: why it is not read."""
        if name not in self._digests:
            try:
                self._digests[name] = sha256_present(ConfinedPath.at(self.root).named(name, where=self.root))
            except CampaignError as error:
                self._digests[name] = error.found
        return self._digests[name]

    def exists(self, name: str) -> bool:
        """Test whether a file is there and was read."""
        return HASH.fullmatch(self.sha256(name)) is not None

    def compare(self, recorded: Mapping[str, str], by: str) -> None:
        """Compare files, relative to the campaign folder, with the hashes that `by` has recorded."""
        for name in recorded:
            self.of(name)
        self.add(compare(recorded, self.sha256), by)

    def add(self, differences: Iterable[Difference], by: str) -> None:
        """Note at the links of files and sources what differs from the record `by`."""
        for one in differences:
            if one.state == "missing":
                self.of(one.name).add("missing", f"recorded by {by}")
            elif HASH.fullmatch(one.present):
                self.of(one.name).add("changed", f"{shortened(one.present)}, was {shortened(one.recorded)} for {by}")
            else:
                self.of(one.name).add("changed", one.present)

    def compare_stage(self, name: str, recorded: Mapping[str, str], by: str) -> None:
        """Compare all files of a stage's folder, chunks among them, with their hashes; as `compare`."""
        link = self.of(name)
        try:
            folder = ConfinedPath.at(self.root).named(name, where=by)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if not folder.is_dir():
            link.add("missing", f"recorded by {by}")
            return
        there = {
            path.relative_to(folder).as_posix(): path
            for path in folder.rglob("*")
            if not path.is_dir(follow_symlinks=False)
        }

        def present(file: str) -> str:
            path = there.get(file)
            if path is None:
                return ""
            return "is no file" if path.is_symlink() or not path.is_file() else sha256_file(path)

        wrong = [
            (one.name, one.present if one.present == "is no file" else _FILES[one.state])
            for one in compare(recorded, present, added=there)
        ]
        if wrong:
            named = ", ".join(f"{file} {what}" for file, what in wrong[:_NAMED])
            more = f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else ""
            gone = all(what == "missing" for _, what in wrong)
            link.add("missing" if gone else "changed", f"{named}{more}, by {by}")


def shortened(digest: str | None) -> str:
    """Return the first digits of a hash, for people.

    Examples
    --------
    >>> shortened("4cb8c29484fe402b113a"), shortened(None)
    ('4cb8c29484fe…', 'absent')
    """
    return f"{digest[:_DIGITS]}…" if digest else "absent"


class Chain:
    """The links below some results.

    Parameters
    ----------
    root
        The campaign folder.

    Attributes
    ----------
    links
        In the order in which they were compared.
    notes
        Which versions differ from those installed, a line each.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.links = Links(root)
        self.notes: list[str] = []
        self._inputs: dict[str, dict[str, str]] = {}
        self._leaves: set[str] = set()
        self._waiting: list[str] = []
        self._rows: dict[str, Result] = {}
        self._asked: list[str] = []
        try:
            campaign = Campaign.load(root)
            for _, result in results_of(campaign):
                self._rows[result.manifest] = result
            self._asked = [manifest for manifest in self._rows if not on_demand(campaign, manifest)]
            self._promised = True
        except CampaignError as error:  # what its manifests say can be compared all the same
            self._promised = False
            state: State = "changed" if (root / CONFIG).is_file() else "missing"
            self.links.of("campaign").add(state, str(error).replace(f"{root}/", ""))

    def promised(self) -> list[str]:
        """Return the manifests that a finished campaign has by its config."""
        return self._asked

    def walk(self, manifests: Iterable[str] = ()) -> None:
        """Compare some results, and all that they and the tags compared before were made from."""
        for manifest in manifests:
            link = self.links.of(manifest)
            if self.links.exists(manifest):
                self._waiting.append(manifest)
            elif found := self.links.sha256(manifest):
                link.add("changed", found)
            else:
                link.add("missing", "not there")
        walked = set[str]()
        while self._waiting:
            manifest = self._waiting.pop(0)
            if manifest not in walked:
                walked.add(manifest)
                self._result(manifest)
        if all(link.state == "same" for link in self.links if link.name.endswith(SUFFIX)):
            for name, inputs in self._inputs.items():  # the whole chain is known: no input can be outside of it
                for role in [role for role, digest in inputs.items() if digest not in self._leaves]:
                    self.links.of(name).add("changed", f"APERTURA_INPUTS: {role} with that hash is not in its chain")

    def tagged(self, path: Path, name: str, sources: Mapping[str, str] | None = None) -> bool:
        """Compare the tags of a file; return whether it has any.

        Parameters
        ----------
        path, name
            Where it lies, and what it is called.
        sources
            What its manifest says it was made from; None: no manifest lists it, so that its tags alone begin the chain.
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
                now, was = (shortened(one.get(source)) for one in (stated, sources))
                self.links.of(link).add("changed", f"APERTURA_SOURCES: {source} is {now}, in its manifest {was}")
        return True

    def _follow(self, sources: Mapping[str, str]) -> None:
        """Go on to what a result was made from: manifests of other results, or files that nothing here has made."""
        for name, was in sources.items():
            if not name.startswith("results/"):
                self._leaves.add(was)
            elif name.endswith(SUFFIX) and self.links.exists(name):
                self._waiting.append(name)

    def _result(self, manifest: str) -> None:
        """Compare a result with its manifest, and its manifest with what it was made from."""
        link, path = self.links.of(manifest), self.root / manifest
        try:
            recorded = read_manifest(path)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if path.read_text(encoding="utf-8") != json.dumps(recorded, indent=1, sort_keys=True) + "\n":
            link.add("changed", "not as the workflow writes it")
        self._files(manifest, recorded["files"], recorded.get("sources", {}))
        if not states_origin(recorded):
            link.add("changed", "does not say what it was made from, as versions before 0.1.0 did not")
            return
        self._origin(manifest, recorded)
        self._follow(recorded["sources"])

    def _files(self, manifest: str, files: Mapping[str, str], sources: Mapping[str, str]) -> None:
        """Compare the files of a result: a stage is one link, with all of its chunks."""
        folder, stages = manifest.rpartition("/")[0], dict[str, dict[str, str]]()
        for file, was in files.items():
            stage, of_stage, rest = file.partition(".zarr/")
            name = f"{folder}/{file}"
            if of_stage:
                stages.setdefault(f"{folder}/{stage}.zarr", {})[rest] = was
                continue
            self.links.compare({name: was}, manifest)
            if name.endswith(TAGGED) and self.links.exists(name):
                self.tagged(self.root / name, name, sources)
        for name, chunks in stages.items():
            self.links.compare_stage(name, chunks, manifest)

    def _origin(self, manifest: str, recorded: Mapping[str, Any]) -> None:
        """Compare sources, code and settings of a result with those of now."""
        result, link = self._rows.get(manifest), self.links.of(manifest)
        if result is None:  # where the config cannot be read, the formats and so the code that it asks for are unknown
            if self._promised:
                link.add("changed", "the config promises no such result")
            self.links.compare(recorded["sources"], manifest)
            return
        parts = {part: self.links.of(f"{part} of {manifest}") for part in ("code", "settings")}
        for name in recorded["sources"]:
            self.links.of(name)
        for one in compare_origin(recorded, result, self.links.sha256):
            if one.part == "code":
                was, now = shortened(one.recorded), shortened(one.present)
                parts["code"].add("changed", f"{now} is installed, {was} made it")
            elif one.part == "settings":
                parts["settings"].add("changed", f"{CONFIG} or a table beside it says otherwise now")
            elif one.state == "added":
                link.add("changed", f"{one.name} is new to it")
            else:
                self.links.add([one], manifest)

    def _runspec(self, link: ChainLink, stated: Mapping[str, Any], sources: Mapping[str, str]) -> None:
        """Compare the settings in tags with those of the images they come from."""
        for source in sources:
            folder, _, stage = source.rpartition("/")
            if stage == "image.manifest.json":
                spec = _spec(ConfinedPath.at(self.root).named(f"{folder}/image.zarr/zarr.json", where=link.name))
                image = folder.removeprefix("results/")  # of several, each has its own under its name
                candidates = stated, stated.get(image), stated.get(image.rpartition("/")[2])
                # a calibrated layer states settings of its own beside those of the image
                is_stated = isinstance(spec, Mapping) and any(
                    isinstance(one, Mapping) and {**one, **spec} == one for one in candidates
                )
                if spec is not None and not is_stated:
                    link.add("changed", f"APERTURA_RUNSPEC: {folder}/image.zarr was made with other settings")


def _spec(path: Path) -> Any:
    """Return the settings in the metadata of a stage; None where it has none: it has a link of its own."""
    try:
        return json.loads(json.loads(path.read_text(encoding="utf-8"))["attributes"]["runspec"])
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None


def other_versions(tags: Mapping[str, str], made_with: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield the software of a file that is not installed here, a line each.

    Another version is no change of a product, and may be the reason of one.

    Parameters
    ----------
    tags
        Of the file.
    made_with
        Its tag ``APERTURA_SOFTWARE``.
    name
        What the file is called.

    Examples
    --------
    >>> list(other_versions({"APERTURA_VERSION": "0.0.9"}, {}, "db.tif"))
    ['made by apertura 0.0.9, such as db.tif; 0.1.0 is installed: its code is another']
    """
    version = tags.get("APERTURA_VERSION", "before 0.1.0")
    if version != __version__:
        yield f"made by apertura {version}, such as {name}; {__version__} is installed: its code is another"
    now = software() if made_with else {}
    others = sorted(one for one in {*made_with, *now} - {"apertura"} if made_with.get(one) != now.get(one))
    if others:
        named = ", ".join(
            f"{one} {made_with.get(one, 'none')}, here {now.get(one, 'none')}" for one in others[:_VERSIONS_NAMED]
        )
        more = f" and {len(others) - _VERSIONS_NAMED} more" if len(others) > _VERSIONS_NAMED else ""
        yield f"made with {named}{more}: bytes may differ where it is made again"
    if tags.get("APERTURA_LOCK_SHA256", lock_sha256()) != lock_sha256():
        yield "made under another requirements/all.txt"


def verify(path: Path, campaign: Path | None = None) -> Chain:
    """Compare a product, or all of a campaign, with what it says it was made from, down to the raw samples.

    Parameters
    ----------
    path
        Absolute: a file, a stage or a manifest below results/, or a campaign folder.
    campaign
        Where a file that lies elsewhere was made.

    Returns
    -------
    Chain
        Its links; every byte was read, and nothing written.

    Raises
    ------
    CampaignError
        If it is no product, or its campaign is not known.
    """
    product = find_product(path, campaign)
    chain = Chain(product.root)
    if product.file is None:
        there = [found.relative_to(product.root).as_posix() for found in manifests(product.root / "results")]
        chain.walk(dict.fromkeys([*chain.promised(), *there]))
        return chain
    _begin(chain, product, product.file)
    chain.walk([product.manifest] if product.manifest else [])
    return chain


def _begin(chain: Chain, product: Product, file: Path) -> None:
    """Begin a chain at a file: with its manifest where that lists it, else with its tags."""
    below = file.is_relative_to(product.root)
    name = file.relative_to(product.root).as_posix() if below else file.name
    if product.manifest:
        if not below:
            chain.links.of(f"{name}, a copy of a file of {product.manifest}")
        return
    if not chain.tagged(file, name):
        expected = "a file of a result, or one that carries tags"
        raise CampaignError("no manifest lists it", file, expected, "Name a file that the workflow wrote.")
    found = "no manifest lists it" if below else "no file of that campaign has its bytes"
    chain.links.of(name).add("changed", f"{found}; its tags say what it was made from")


def print_verified(path: Path, campaign: Path | None = None, *, quiet: bool = False) -> int:
    """Print a line for each link, what is wrong first; return 0, or 1 where a link is not the same.

    Parameters
    ----------
    path, campaign
        As `verify`.
    quiet
        Only what is not the same.

    Raises
    ------
    CampaignError
        As `verify`; what the tags of a file say is printed before.
    """
    try:
        chain = verify(path, campaign)
    except CampaignError:
        _print_tags(path)
        raise
    links = sorted(chain.links, key=lambda link: _ORDER.index(link.state))
    for link in links:
        if link.state != "same" or not quiet:
            why = f": {'; '.join(link.why)}" if link.why else ""
            print(f"{link.state:<8} {shown(link.name + why, _LONGEST)}")
    for note in chain.notes:
        print(shown(note, _LONGEST))
    counts = [(state, sum(link.state == state for link in links)) for state in reversed(_ORDER)]
    if not quiet:
        print(f"{number_of(len(links), 'link')}: {', '.join(f'{count} {state}' for state, count in counts if count)}")
    return 0 if all(link.state == "same" for link in links) else 1


def _print_tags(path: Path) -> None:
    """Print the tags of a file whose chain cannot be walked."""
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
    """Return file → 'changed' or 'missing', of those whose bytes are not what the crate says; every byte is read.

    Parameters
    ----------
    root
        The crate's folder, a campaign's results.
    inputs
        Recordings and config, too, which lie in the folder above.

    Raises
    ------
    CampaignError
        If there is no crate, it is damaged, or it names a file outside of these folders.
    """
    files = recorded_files(root, inputs=inputs)

    def present(name: str) -> str:
        path = files[name].path
        try:
            return sha256_file(path) if path.is_file() else ""
        except OSError as error:
            expected, remedy = "a file that can be read", "Let it be read, or copy it again."
            raise CampaignError(f"not readable ({error.strerror})", path, expected, remedy) from error

    differences = compare({name: file.sha256 for name, file in files.items()}, present)
    return {one.name: "missing" if one.state == "missing" else "changed" for one in differences}


def print_checked(folder: Path, *, quiet: bool = False) -> int:
    """Print which files are not what the crate says, and what is wrong with the catalog; return the exit code.

    Parameters
    ----------
    folder
        A campaign, or its results alone: recordings are compared where the campaign lies above them.
    quiet
        Only what is not the same.

    Returns
    -------
    int
        0: all as it was made; 1: not.

    Raises
    ------
    CampaignError
        If there is no crate, or it is damaged.
    """
    root = folder if (folder / CRATE).is_file() else folder / "results"
    if folder.is_file():
        raise CampaignError("a file", folder, "a campaign folder, or its results", "Name the folder.")
    above = (root.parent / "config").is_dir()
    lines = [f"{name}: {state}" for name, state in changed_files(root, inputs=above).items()]
    if (root / "stac" / CATALOG).is_file():
        lines += [f"stac/{problem}" for problem in stac_problems(root / "stac")]
    for line in lines[:_MOST]:
        print(shown(line, 500))
    if len(lines) > _MOST:
        print(f"and {len(lines) - _MOST} more")
    if not lines and not quiet:
        beside = "recordings and config, too" if above else "recordings and config are not here to be compared"
        print(f"every file as the crate says ({beside}), the catalog valid")
    return 1 if lines else 0
