"""Product of a path and its contents: tags of a GeoTIFF or PNG, a stage, a report."""

import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apertura.campaign.config import CONFIG
from apertura.campaign.store import manifest_of, open_stage, read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import STAGES
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError, shown
from apertura.common.provenance import canonical_json, sha256_file
from apertura.common.raster import opened_raster

SUFFIX = ".manifest.json"

_EXPECTED = "a file or stage that the workflow wrote, a manifest, or a campaign folder"


@dataclass(frozen=True)
class Product:
    """The product that a path means.

    Attributes
    ----------
    root
        The campaign folder.
    manifest
        Of the result it belongs to, relative to `root`; empty: no manifest lists it.
    file
        The file, stage or manifest itself, wherever it lies; None: the whole campaign.
    """

    root: ConfinedPath
    manifest: str = ""
    file: Path | None = None


def find_product(path: Path, campaign: Path | None = None) -> Product:
    """Return the product that a path means.

    Parameters
    ----------
    path
        Absolute: a file, a stage or a manifest below results/, or a campaign folder.
    campaign
        Where a file that lies elsewhere was made.

    Raises
    ------
    CampaignError
        If it is not there, or belongs to no campaign.
    """
    if path.is_dir() and ((path / CONFIG).is_file() or (path / "results").is_dir()):
        return Product(ConfinedPath.at(path))
    path = as_product(path)
    results = next((folder for folder in path.parents if folder.name == "results"), None)
    if campaign is not None and not path.is_relative_to(campaign / "results") and path.is_file():
        listed = _listing(campaign / "results", path, sha256=sha256_file(path))
        return Product(ConfinedPath.at(campaign), listed, path)
    found = "" if results is None else _manifest(results, path)
    product = Product(ConfinedPath.at(path.parent if results is None else results.parent), found, path)
    known = (product.root / product.manifest).is_file()
    if not path.exists() and not known:
        remedy = "Correct the path." if results is None else "Correct the path, or run the workflow (`apertura run`)."
        raise CampaignError("no such file or folder", path, _EXPECTED, remedy)
    if not known and not (product.root / CONFIG).is_file():
        remedy = "Name the folder of its campaign with --campaign."
        raise CampaignError("lies in no campaign: its chain cannot be walked", path, "a file below results/", remedy)
    if path.is_dir() and not product.manifest:
        raise CampaignError("a folder that is no result", path, _EXPECTED, "Name one of its files.")
    return product


def as_product(path: Path) -> Path:
    """Return a path that a user typed, confined to the campaign in whose results it lies, if any."""
    root = next((folder.parent for folder in path.parents if folder.name == "results"), None)
    return path if root is None else ConfinedPath.at(root) / path.relative_to(root)


def _manifest(results: Path, path: Path) -> str:
    """Return the manifest of the result that a path below a folder of results belongs to; empty if none lists it."""
    stage = next((folder for folder in (path, *path.parents) if folder.suffix == ".zarr"), None)
    manifest = path if path.name.endswith(SUFFIX) else None if stage is None else manifest_of(stage)
    return _listing(results, path) if manifest is None else manifest.relative_to(results.parent).as_posix()


def _listing(results: Path, path: Path, *, sha256: str = "") -> str:
    """Return the manifest that lists a file, relative to the campaign; empty if none does.

    A file elsewhere is recognised by its hash, unless it was edited.
    """
    for manifest in manifests(results):
        with suppress(CampaignError):  # a damaged manifest lists nothing
            files = read_manifest(manifest)["files"]
            listed = sha256 in files.values() if sha256 else any(manifest.parent / name == path for name in files)
            if listed:
                return manifest.relative_to(results.parent).as_posix()
    return ""


def manifests(results: Path) -> Iterator[ConfinedPath]:
    """Yield every manifest below a folder of results, in order of their names; links are not followed."""
    for folder, _, files in ConfinedPath.at(results).walk():
        if not any(".zarr" in part for part in folder.relative_to(results).parts):
            yield from (folder / name for name in files if name.endswith(SUFFIX))


TAGGED = (".tif", ".png")
"""Suffixes of files that carry tags."""

_TAGGED_AS = "a GeoTIFF or PNG as the workflow writes it"
_COPY_AGAIN = "Copy it again from its campaign, or run the workflow again."

_OURS = "APERTURA_"


def read_tags(path: Path) -> dict[str, str]:
    """Return the tags of apertura that a file carries; none where it is of another kind.

    Parameters
    ----------
    path
        The file; nothing beside it is read.

    Raises
    ------
    CampaignError
        If it is named as a GeoTIFF or PNG and is none.
    """
    if path.suffix == ".tif":
        with opened_raster(path, expected=_TAGGED_AS, remedy=_COPY_AGAIN) as raster:
            return ours(raster.tags())
    return ours(dict(picture(path).info)) if path.suffix == ".png" else {}


def ours(tags: Mapping[Any, Any]) -> dict[str, str]:
    """Return the tags that apertura has written.

    Examples
    --------
    >>> ours({"AREA_OR_POINT": "Area", "APERTURA_VERSION": "0.1.0"})
    {'APERTURA_VERSION': '0.1.0'}
    """
    return {str(name): str(text) for name, text in tags.items() if str(name).startswith(_OURS)}


def picture(path: Path) -> Any:
    """Return a PNG with its pixels, a `PIL.Image.Image`; raises as `read_tags`."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a picture of more pixels than any of ours, before it is unpacked
            with path.open("rb") as stream, Image.open(stream, formats=["PNG"]) as opened:
                opened.load()  # texts may follow the pixels
                return opened
    except MemoryError:
        raise
    except Exception as error:  # a codec may raise anything
        found = shown(str(error).replace(str(path), path.name), 200)
        raise CampaignError(f"not readable as PNG ({found})", path, _TAGGED_AS, _COPY_AGAIN) from error


def document(tags: Mapping[str, str], name: str, where: Path) -> dict[str, Any]:
    """Return the object in a tag's JSON; empty where there is no such tag.

    Parameters
    ----------
    tags
        Of the file.
    name
        The tag, without ``APERTURA_``.
    where
        The file, for the message.

    Raises
    ------
    CampaignError
        If the text is no JSON object.

    Examples
    --------
    >>> document({"APERTURA_SOURCES": '{"results/scene.manifest.json":"4c"}'}, "SOURCES", Path("db.tif"))
    {'results/scene.manifest.json': '4c'}
    """
    with undamaged(where, expected=f"tag {_OURS}{name} as the workflow writes it", remedy=_COPY_AGAIN):
        found = json.loads(tags.get(f"{_OURS}{name}", "{}"))
        if not isinstance(found, dict):
            raise TypeError(f"tag {_OURS}{name} is no object of JSON")
        return found


def hashes(tags: Mapping[str, str], name: str, where: Path) -> dict[str, str]:
    """Return the hashes in a tag, name → hex; as `document`."""
    found = document(tags, name, where)
    with undamaged(where, expected="a hash for each name", remedy=_COPY_AGAIN):
        if not all(isinstance(text, str) for text in found.values()):
            raise TypeError(f"tag {_OURS}{name} holds a hash that is no text")
    return found


SECTIONS = ("geometry", "settings", "inputs", "stages", "code", "software", "flags", "report")
"""Compared sections, in this order."""

EXPECTED = "a raster, a picture, a stage or a JSON file that the workflow wrote"
REMEDY = "Name one file of a result, and the file to hold it against."

_KEPT_APART = ("RUNSPEC", "INPUTS", "SOURCES", "CODE_SHA256", "SOFTWARE", "FLAGS", "VERSION", "LOCK_SHA256")

Sections = dict[str, dict[str, str]]


def sections_of(path: Path) -> Sections:
    """Return section → key → value as text, of a product.

    Parameters
    ----------
    path
        A .tif, .png, .json or .geojson file, or the folder of a stage. Others have no sections.

    Raises
    ------
    CampaignError
        If it is not readable, or is a folder of another kind.
    """
    if path.is_dir():
        return _stage_sections(path)
    if path.suffix == ".tif":
        with opened_raster(path, expected=EXPECTED, remedy=REMEDY) as raster:
            geometry = {
                "crs": raster.crs.to_string() if raster.crs else "none",
                "transform": " ".join(f"{number:.12g}" for number in tuple(raster.transform)[:6]),
                "size": f"{raster.width} × {raster.height}",
                "bands": f"{raster.count} {raster.dtypes[0]}, nodata {raster.nodata}",
                "meaning": f"{raster.descriptions[0]}, unit {raster.units[0]}",
            }
        return {"geometry": geometry, **_tag_sections(path)}
    if path.suffix == ".png":
        return {"geometry": {"size": "{} × {}".format(*picture(path).size)}, **_tag_sections(path)}
    if path.suffix in {".json", ".geojson"}:
        return {"report": flat(read_json(path, expected=EXPECTED, remedy=REMEDY))}
    return {}


def _tag_sections(path: Path) -> Sections:
    """Return the sections of a file by its tags."""
    tags = read_tags(path)
    others = {name.removeprefix("APERTURA_"): text for name, text in tags.items()}
    return {
        "settings": flat(document(tags, "RUNSPEC", path)),
        "inputs": hashes(tags, "INPUTS", path),
        "stages": hashes(tags, "SOURCES", path),
        "code": {"sha256": tags.get("APERTURA_CODE_SHA256", "none")},
        "software": flat(document(tags, "SOFTWARE", path))
        | {name: others[key] for key, name in (("VERSION", "apertura"), ("LOCK_SHA256", "lock")) if key in others},
        "flags": flat(document(tags, "FLAGS", path)),
        "report": flat({key.lower(): _value(text) for key, text in others.items() if key not in _KEPT_APART}),
    }


def _value(text: str) -> Any:
    """Return the JSON value of a tag, or its text."""
    try:
        return json.loads(text) if text[:1] in {"{", "["} else text
    except (ValueError, RecursionError):
        return text


def _stage_sections(folder: Path) -> Sections:
    """Return the sections of a finished stage by its attributes; its arrays are compared elsewhere."""
    if folder.suffix != ".zarr" or folder.stem not in STAGES:
        raise CampaignError("a folder that is no stage", folder, EXPECTED, REMEDY)
    stage = open_stage(folder, folder.stem)
    with undamaged(folder, expected="attributes of a stage", remedy="Delete its manifest and run the workflow again."):
        attributes = dict(stage.attrs)
        return {
            "geometry": {str(name): f"{one.dtype} {dict(one.sizes)}" for name, one in stage.variables.items()},
            "settings": flat(json.loads(attributes.pop("runspec", "{}"))),
            "inputs": flat(attributes.pop("inputs", {})),
            "stages": read_manifest(manifest_of(folder)).get("sources", {}),
            "code": {"sha256": str(attributes.pop("code_sha256", "none"))},
            "software": flat(attributes.pop("software", {}))
            | {"apertura": str(attributes.pop("apertura_version", "none"))},
            "flags": flat(attributes.pop("flags", {})),
            "report": flat(attributes),
        }


def flat(value: Mapping[str, Any]) -> dict[str, str]:
    """Return key.key… → text of each value that is no mapping and no list.

    Examples
    --------
    >>> flat({"waveform": {"carrier_hz": 1.2e9}, "nodes": ["uav1"], "flags": {}})
    {'waveform.carrier_hz': '1200000000.0', 'nodes.0': 'uav1', 'flags': '{}'}
    """
    found: dict[str, str] = {}
    waiting: list[tuple[str, Any]] = [("", value)]  # an untrusted document may be deeper than Python's recursion
    while waiting:
        key, one = waiting.pop()
        inner = one.items() if isinstance(one, Mapping) else enumerate(one) if isinstance(one, list) else ()
        if inner and one:
            waiting += [(f"{key}.{name}" if key else str(name), below) for name, below in reversed(list(inner))]
        elif key:
            found[key] = one if isinstance(one, str) else str(one) if hasattr(one, "dtype") else canonical_json(one)
    return found
