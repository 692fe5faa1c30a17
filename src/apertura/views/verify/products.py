"""Identify the product at a path and read its contents: tags of a file, attributes of a stage, or a report."""

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
    """Product identified by a path.

    Attributes
    ----------
    root
        The campaign folder.
    manifest
        Manifest of the result that contains the product, relative to `root`; empty if no manifest lists the product.
    file
        Path of the file, stage or manifest, which may be outside `root`; None for the whole campaign.
    """

    root: ConfinedPath
    manifest: str = ""
    file: Path | None = None


def find_product(path: Path, campaign: Path | None = None) -> Product:
    """Return the product at a path.

    Parameters
    ----------
    path
        Absolute path of a file, a stage or a manifest below results/, or of a campaign folder.
    campaign
        Campaign folder of a file that is stored elsewhere.

    Raises
    ------
    CampaignError
        If the path does not exist, or does not belong to a campaign.
    """
    if path.is_dir() and ((path / CONFIG).is_file() or (path / "results").is_dir()):
        return Product(ConfinedPath.at(path))
    path = as_product(path)
    results = next((folder for folder in path.parents if folder.name == "results"), None)
    if campaign is not None and not path.is_relative_to(campaign / "results") and path.is_file():
        listed = _listing(campaign / "results", path, sha256=sha256_file(path))
        return Product(ConfinedPath.at(campaign), listed, path)
    manifest = "" if results is None else _manifest(results, path)
    product = Product(ConfinedPath.at(path.parent if results is None else results.parent), manifest, path)
    is_listed = (product.root / product.manifest).is_file()
    if not path.exists() and not is_listed:
        remedy = "Correct the path." if results is None else "Correct the path, or run the workflow (`apertura run`)."
        raise CampaignError("no such file or folder", path, _EXPECTED, remedy)
    if not is_listed and not (product.root / CONFIG).is_file():
        remedy = "Specify the campaign folder with --campaign."
        found = "outside a campaign folder, so that the provenance chain cannot be followed"
        raise CampaignError(found, path, "a file below results/", remedy)
    if path.is_dir() and not product.manifest:
        raise CampaignError("a folder that is not a result", path, _EXPECTED, "Specify a file of the folder.")
    return product


def as_product(path: Path) -> Path:
    """Return a path typed by a user; a path below the results of a campaign is confined to that campaign."""
    root = next((folder.parent for folder in path.parents if folder.name == "results"), None)
    return path if root is None else ConfinedPath.at(root) / path.relative_to(root)


def _manifest(results: Path, path: Path) -> str:
    """Return the manifest of the result of a path below a results folder; empty if no manifest lists it."""
    stage = next((folder for folder in (path, *path.parents) if folder.suffix == ".zarr"), None)
    manifest = path if path.name.endswith(SUFFIX) else None if stage is None else manifest_of(stage)
    return _listing(results, path) if manifest is None else manifest.relative_to(results.parent).as_posix()


def _listing(results: Path, path: Path, *, sha256: str = "") -> str:
    """Return the manifest that lists a file, relative to the campaign; empty if no manifest does.

    With `sha256`, the file is identified by hash instead of path.
    """
    for manifest in manifests(results):
        with suppress(CampaignError):  # a damaged manifest lists nothing
            files = read_manifest(manifest)["files"]
            listed = sha256 in files.values() if sha256 else any(manifest.parent / name == path for name in files)
            if listed:
                return manifest.relative_to(results.parent).as_posix()
    return ""


def manifests(results: Path) -> Iterator[ConfinedPath]:
    """Yield every manifest below a results folder, sorted by name; symbolic links are not followed."""
    for folder, _, files in ConfinedPath.at(results).walk():
        if not any(".zarr" in part for part in folder.relative_to(results).parts):
            yield from (folder / name for name in files if name.endswith(SUFFIX))


TAGGED = (".tif", ".png")
"""Suffixes of files with tags of apertura."""

_TAGGED_AS = "an undamaged GeoTIFF or PNG of the workflow"
_COPY_AGAIN = "Copy the file again from its campaign, or run the workflow again."

_OURS = "APERTURA_"


def read_tags(path: Path) -> dict[str, str]:
    """Return the tags of apertura in a file; an empty mapping for file types without tags.

    Parameters
    ----------
    path
        The file; sidecar files are not read.

    Raises
    ------
    CampaignError
        If the file has the suffix of a GeoTIFF or PNG and is not readable in this format.
    """
    if path.suffix == ".tif":
        with opened_raster(path, expected=_TAGGED_AS, remedy=_COPY_AGAIN) as raster:
            return ours(raster.tags())
    return ours(dict(picture(path).info)) if path.suffix == ".png" else {}


def ours(tags: Mapping[Any, Any]) -> dict[str, str]:
    """Select the tags written by apertura.

    Examples
    --------
    >>> ours({"AREA_OR_POINT": "Area", "APERTURA_VERSION": "0.1.0"})
    {'APERTURA_VERSION': '0.1.0'}
    """
    return {str(name): str(text) for name, text in tags.items() if str(name).startswith(_OURS)}


def picture(path: Path) -> Any:
    """Read a PNG, including its pixels, as `PIL.Image.Image`; raises the same errors as `read_tags`."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # reject decompression bombs before decoding
            with path.open("rb") as stream, Image.open(stream, formats=["PNG"]) as opened:
                opened.load()  # text chunks may follow the pixels
                return opened
    except MemoryError:
        raise
    except Exception as error:  # a codec may raise any exception
        found = shown(str(error).replace(str(path), path.name), 200)
        raise CampaignError(f"not readable as PNG ({found})", path, _TAGGED_AS, _COPY_AGAIN) from error


def document(tags: Mapping[str, str], name: str, where: Path) -> dict[str, Any]:
    """Parse the JSON object in a tag; empty if the tag is missing.

    Parameters
    ----------
    tags
        Tags of the file.
    name
        Name of the tag without ``APERTURA_``.
    where
        Path of the file for error messages.

    Raises
    ------
    CampaignError
        If the text is not a JSON object.

    Examples
    --------
    >>> document({"APERTURA_SOURCES": '{"results/scene.manifest.json":"4c"}'}, "SOURCES", Path("db.tif"))
    {'results/scene.manifest.json': '4c'}
    """
    with undamaged(where, expected=f"an undamaged tag {_OURS}{name}", remedy=_COPY_AGAIN):
        value = json.loads(tags.get(f"{_OURS}{name}", "{}"))
        if not isinstance(value, dict):
            raise TypeError(f"tag {_OURS}{name} is not a JSON object")
        return value


def hashes(tags: Mapping[str, str], name: str, where: Path) -> dict[str, str]:
    """Return the hashes in a tag, name → hex; parameters and errors as in `document`."""
    digests = document(tags, name, where)
    with undamaged(where, expected="a hash for each name", remedy=_COPY_AGAIN):
        if not all(isinstance(text, str) for text in digests.values()):
            raise TypeError(f"tag {_OURS}{name} contains a hash that is not text")
    return digests


SECTIONS = ("geometry", "settings", "inputs", "stages", "code", "software", "flags", "report")
"""Sections of a product in the order of comparison."""

EXPECTED = "a raster, a PNG image, a stage or a JSON file that the workflow wrote"
REMEDY = "Specify a file of a result, and the file to be compared with it."

_IN_OTHER_SECTIONS = ("RUNSPEC", "INPUTS", "SOURCES", "CODE_SHA256", "SOFTWARE", "FLAGS", "VERSION", "LOCK_SHA256")

Sections = dict[str, dict[str, str]]


def sections_of(path: Path) -> Sections:
    """Return the sections of a product, section → key → value as text.

    Parameters
    ----------
    path
        A .tif, .png, .json or .geojson file, or the folder of a stage; other files have no sections.

    Raises
    ------
    CampaignError
        If the path is not readable, or is a folder other than a stage.
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
    """Return the sections stored in the tags of a file."""
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
        "report": flat({key.lower(): _value(text) for key, text in others.items() if key not in _IN_OTHER_SECTIONS}),
    }


def _value(text: str) -> Any:
    """Return the JSON value of a tag; the text of the tag if it is not JSON."""
    try:
        return json.loads(text) if text[:1] in {"{", "["} else text
    except (ValueError, RecursionError):
        return text


def _stage_sections(folder: Path) -> Sections:
    """Return the sections of a finished stage, read from its attributes; arrays are not read."""
    if folder.suffix != ".zarr" or folder.stem not in STAGES:
        raise CampaignError("a folder that is not a stage", folder, EXPECTED, REMEDY)
    stage = open_stage(folder, folder.stem)
    with undamaged(folder, expected="attributes of a stage", remedy="Delete its manifest and run the workflow again."):
        attributes = dict(stage.attrs)
        return {
            "geometry": {str(name): f"{array.dtype} {dict(array.sizes)}" for name, array in stage.variables.items()},
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
    """Flatten nested mappings and lists to a mapping of key.key… → text of the value.

    Examples
    --------
    >>> flat({"waveform": {"carrier_hz": 1.2e9}, "nodes": ["uav1"], "flags": {}})
    {'waveform.carrier_hz': '1200000000.0', 'nodes.0': 'uav1', 'flags': '{}'}
    """
    texts: dict[str, str] = {}
    stack: list[tuple[str, Any]] = [
        ("", value)
    ]  # no recursion, because an untrusted document may exceed Python's limit
    while stack:
        key, node = stack.pop()
        children = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
        if children and node:
            stack += [(f"{key}.{name}" if key else str(name), child) for name, child in reversed(list(children))]
        elif key:
            texts[key] = (
                node if isinstance(node, str) else str(node) if hasattr(node, "dtype") else canonical_json(node)
            )
    return texts
