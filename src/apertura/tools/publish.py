"""`apertura publish`: copy the results of a campaign to an object store; only what has changed, catalogs last.

The target mirrors the campaign folder: ``<url>/results/…``, and ``<url>/raw/…`` if requested, so that relative links
remain valid. The object `RECORD` lists the published files with their hashes. It is reduced to the files that remain
unchanged before the first upload, and completed at the end; after an interruption it therefore lists no file whose
content is uncertain.
"""

import hashlib
import json
import posixpath
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest, remake_from
from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError, number_of, shown
from apertura.common.progress import progress
from apertura.common.provenance import sha256_file
from apertura.formats.catalog import CATALOG
from apertura.formats.catalog.stac import media_type
from apertura.workflow.lineage import on_demand, places_of, products_of
from apertura.workflow.rules import RESULTS
from apertura.workflow.stale import stale_results

RECORD = "results/published.json"
"""Object that lists the published files: path relative to the URL → SHA-256."""

_LISTED = 20
_AT_ONCE = 16
"""Number of uploads at a time: the time of a small upload is mostly latency."""
_SHEETS = "results/stac/"
_LARGEST_RECORD = 1 << 30


@dataclass(frozen=True)
class Publication:
    """Changes of a target that make it equal to the results of a campaign.

    Attributes
    ----------
    uploads, deletions
        Paths relative to the URL: new or changed files in the order of upload, and published files that no longer
        exist.
    unchanged
        Number of published files that remain as they are.
    size
        Bytes to be uploaded.
    """

    uploads: list[str]
    deletions: list[str]
    unchanged: int
    size: int

    @property
    def lines(self) -> Iterator[str]:
        """Lines of text on the changes."""
        yield (
            f"{number_of(len(self.uploads), 'file')} to upload ({self.size / 1e6:.1f} MB), {len(self.deletions)} to "
            f"delete, {self.unchanged} unchanged"
        )
        for verb, names in (("upload", self.uploads), ("delete", self.deletions)):
            yield from (f"{verb} {shown(name, 300)}" for name in names[:_LISTED])
            if len(names) > _LISTED:
                yield f"{verb} {len(names) - _LISTED} more"


def publish(
    campaign: Campaign, url: str, *, href: str = "", every: bool = False, raw: bool = False, dry_run: bool = False
) -> Publication:
    """Copy the results of a campaign to a target of fsspec; return the changes.

    Parameters
    ----------
    campaign
        Campaign whose results are up to date.
    url
        Target, such as ``s3://bucket/prefix``. Credentials are those of the environment.
    href
        Address under which readers find the target, for the self link of the STAC catalog; empty for `url`.
    every
        Also publish intermediate results, which the RO-Crate lists.
    raw
        Also publish the recordings and logs.
    dry_run
        Only compare.

    Raises
    ------
    CampaignError
        If the results are not up to date, or the target cannot be read or written.

    Examples
    --------
    >>> from apertura.simulation import preset, simulate
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = simulate(f"{folder}/campaign", preset("demo", pulses=4), seed=1)
    ...     publish(Campaign.load(path), "memory://bucket/demo")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: ...: no finished result; expected finished results. Run the workflow first.
    """
    target = _Target.of(url, campaign)
    recorded = _recorded(campaign, every=every, raw=raw)
    contents = _Contents(campaign, recorded, (href or url).rstrip("/"))
    hashes = {name: contents.sha256(name) for name in recorded}
    published = target.record()
    uploads = sorted((name for name in hashes if published.get(name) != hashes[name]), key=_order)
    deletions = sorted(published.keys() - hashes.keys())
    size = sum(contents.size(name) for name in uploads)
    changes = Publication(uploads, deletions, len(hashes) - len(uploads), size)
    if dry_run or not (uploads or deletions):
        return changes
    certain = {name: digest for name, digest in published.items() if name not in {*uploads}}
    target.write(RECORD, _document(certain))

    def upload(name: str) -> None:
        contents.upload(name, target)
        certain[name] = hashes[name]

    with ThreadPoolExecutor(_AT_ONCE) as workers, progress("files", len(uploads)) as done:
        try:
            for rank in sorted({_order(name)[0] for name in uploads}):  # a catalog after the files to which it refers
                for _ in workers.map(upload, [name for name in uploads if _order(name)[0] == rank]):
                    done(1)
            for _ in workers.map(target.delete, deletions):
                pass
        except BaseException:
            workers.shutdown(cancel_futures=True)
            with suppress(CampaignError):
                target.write(RECORD, _document(certain))
            raise
    target.write(RECORD, _document(hashes))
    return changes


def _document(hashes: Mapping[str, str]) -> bytes:
    return json.dumps({"files": hashes}, indent=0, sort_keys=True).encode()


def _order(name: str) -> tuple[int, str]:
    """Return the sort key of uploads: files before the documents that refer to them, and each catalog after its items.

    The metadata of an array follow its chunks, and the consolidated metadata of a stage those of its arrays.
    """
    depth, pair = name.count("/"), "-" in posixpath.basename(name)
    if name == f"{_SHEETS}{CATALOG}":
        return 7, name
    if name.startswith(_SHEETS):  # sums refer to their pairs, the collection to its items
        return (6 if depth == 2 else 4 if pair else 5), name
    if name.endswith(".zarr/zarr.json"):
        return 2, name
    if name.endswith((".vrt", "zarr.json")):
        return 1, name
    return (3 if depth == 1 or name.endswith((".manifest.json", "map.json")) else 0), name


# ---- Files of the campaign -------------------------------------------------------------------------------------------


def _recorded(campaign: Campaign, *, every: bool, raw: bool) -> dict[str, str]:
    """Return the files to be published, relative to the campaign folder, with the hashes in the manifests."""
    files, recordings = dict[str, str](), dict[str, str]()
    stale = stale_results(campaign)
    for name, _, result in places_of(campaign):
        rule, manifest = RESULTS[name], campaign.root.named(result.manifest, where=campaign.root)
        if on_demand(campaign, result.manifest) and not (every and manifest.is_file()):
            continue
        if result.manifest in stale or not manifest.is_file():
            reason = stale.get(result.manifest) or "depends on a result that is out of date"
            found = f"out of date ({reason})" if manifest.is_file() else "no finished result"
            raise CampaignError(found, manifest, "finished results", "Run the workflow first.")
        document = read_manifest(manifest)
        with undamaged(manifest, expected="a manifest of the workflow", remedy=remake_from(manifest)):
            recordings |= {path: digest for path, digest in document["sources"].items() if path.startswith("raw/")}
        if every or products_of(rule) or rule.styles or name == "cube":
            folder = posixpath.dirname(result.manifest)
            files |= {f"{folder}/{path}": digest for path, digest in document["files"].items()}
            files[result.manifest] = sha256_file(manifest)
    return files | (recordings if raw else {})


@dataclass(frozen=True)
class _Contents:
    """Contents of the files to be published; documents of the STAC catalog refer to published files only."""

    campaign: Campaign
    recorded: Mapping[str, str]
    href: str
    _sheets: dict[str, bytes] = field(default_factory=dict)

    def sha256(self, name: str) -> str:
        """Return the hash of a file as it is published."""
        return hashlib.sha256(self._sheet(name)).hexdigest() if self._is_sheet(name) else self.recorded[name]

    def size(self, name: str) -> int:
        """Return the size of a file as it is published, bytes."""
        return len(self._sheet(name)) if self._is_sheet(name) else self._path(name).stat().st_size

    def upload(self, name: str, target: "_Target") -> None:
        """Upload a file after comparing it with its hash in the manifest; no link is followed."""
        if self._is_sheet(name):
            target.write(name, self._sheet(name))
            return
        self._check(name)
        with self._path(name).on_disk() as path:
            target.put(name, path)

    def _is_sheet(self, name: str) -> bool:
        return name.startswith(_SHEETS) and name.endswith(".json")

    def _path(self, name: str) -> Any:
        return self.campaign.root.named(name, where=self.campaign.root)

    def _check(self, name: str) -> None:
        path = self._path(name)
        if not path.is_file() or sha256_file(path) != self.recorded[name]:
            found = "the file has changed since it was written" if path.is_file() else "no such file"
            raise CampaignError(found, path, "the file listed in its manifest", "Run the workflow again.")

    def _sheet(self, name: str) -> bytes:
        """Return a document of the catalog without links to unpublished files; the root has an absolute self link."""
        if name not in self._sheets:
            self._check(name)
            path = self._path(name)
            with undamaged(path, expected="the catalog that step stac writes", remedy="Run the workflow again."):
                document = json.loads(path.read_bytes())
                links = [link for link in document["links"] if self._is_published(name, str(link["href"]))]
                if name == f"{_SHEETS}{CATALOG}":
                    links.append({"rel": "self", "href": f"{self.href}/{name}", "type": "application/json"})
                document["links"] = links
            self._sheets[name] = (json.dumps(document, indent=1, sort_keys=True) + "\n").encode()
        return self._sheets[name]

    def _is_published(self, name: str, href: str) -> bool:
        relative = not urlsplit(href).scheme
        return (
            not relative or posixpath.normpath(posixpath.join(posixpath.dirname(name), unquote(href))) in self.recorded
        )


# ---- Target ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Target:
    """Folder of a file system of fsspec."""

    url: str
    files: Any
    folder: str

    @classmethod
    def of(cls, url: str, campaign: Campaign) -> "_Target":
        """Open a target named by the user; the config of a campaign cannot name one."""
        parts, where = urlsplit(url), "apertura publish"
        expected = "scheme://bucket/prefix without credentials, such as s3://bucket/prefix"
        if not parts.scheme or "::" in url or "@" in parts.netloc or parts.query or parts.fragment:
            shown_url = parts._replace(netloc=parts.netloc.rpartition("@")[2], query="", fragment="").geturl()
            raise CampaignError(
                shown_url, where, expected, "Correct the URL; credentials are read from the environment."
            )
        options = {"auto_mkdir": True} if parts.scheme in {"file", "local"} else {}
        with _reported(url):
            from fsspec.core import url_to_fs

            files, folder = url_to_fs(url.rstrip("/"), **options)
        if options and Path(folder).resolve().is_relative_to(campaign.root.real()):
            raise CampaignError(url, where, "a target outside the campaign folder", "Choose another target.")
        return cls(url, files, str(folder))

    def record(self) -> dict[str, str]:
        """Return the published files with their hashes; empty if nothing is published."""
        with _reported(self.url):
            try:
                content = self.files.cat_file(f"{self.folder}/{RECORD}", end=_LARGEST_RECORD)
            except FileNotFoundError:
                return {}
        expected, remedy = f"a record of `apertura publish` ({RECORD})", "Choose another prefix, or delete the object."
        with undamaged(self.url, expected=expected, remedy=remedy):
            hashes = {str(name): str(digest) for name, digest in json.loads(content)["files"].items()}
            if any(name.startswith("/") or ".." in name.split("/") for name in hashes):
                raise ValueError("a name outside the prefix")
        return hashes

    def write(self, name: str, content: bytes) -> None:
        """Write an object."""
        with _reported(f"{self.url}/{name}"):
            self.files.pipe_file(f"{self.folder}/{name}", content, **self._type(name))

    def put(self, name: str, path: Path) -> None:
        """Write a file as an object."""
        with _reported(f"{self.url}/{name}"):
            self.files.put_file(str(path), f"{self.folder}/{name}", **self._type(name))

    def delete(self, name: str) -> None:
        """Delete an object if it exists."""
        with _reported(f"{self.url}/{name}"):
            try:
                self.files.rm_file(f"{self.folder}/{name}")
            except FileNotFoundError:
                return

    def _type(self, name: str) -> dict[str, str]:
        return {"ContentType": media_type(name)} if "s3" in self.files.protocol else {}


@contextmanager
def _reported(url: str) -> Iterator[None]:
    """Turn errors of a file system, of any library, into one message; the next run resumes after an interruption."""
    try:
        yield
    except ImportError as error:
        remedy = "Install it: `pip install 'apertura[publish]'`, or the package of fsspec for this scheme."
        raise CampaignError(str(error), url, "a file system for this scheme", remedy) from None
    except Exception as error:
        raise CampaignError(
            f"{type(error).__name__}: {error}",
            url,
            "an existing bucket or folder that the credentials in the environment may read and write",
            "Check credentials and endpoint (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL), and publish "
            "again: files that are complete are not uploaded again.",
        ) from error
