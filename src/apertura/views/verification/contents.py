"""What a product says of itself, in sections that can be told apart key by key: a raster, a picture, a stage, JSON."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apertura.common.contracts import STAGES
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.provenance import canonical_json
from apertura.common.raster import opened_raster
from apertura.pipeline.store import manifest_of, open_stage, read_manifest
from apertura.views.verification.tags import document, hashes, picture, read_tags

SECTIONS = ("geometry", "settings", "inputs", "stages", "code", "software", "flags", "report")
"""What is told apart, in this order."""

EXPECTED = "a raster, a picture, a stage or a JSON file that the workflow wrote"
REMEDY = "Name one file of a result, and the file to hold it against."

_KEPT_APART = ("RUNSPEC", "INPUTS", "SOURCES", "CODE_SHA256", "SOFTWARE", "FLAGS", "VERSION", "LOCK_SHA256")

Sections = dict[str, dict[str, str]]


def sections_of(path: Path) -> Sections:
    """Return section → key → value as text, of a product.

    Parameters
    ----------
    path
        A .tif, .png, .json or .geojson file, or the folder of a stage. Of others nothing is known but their bytes.

    Raises
    ------
    CampaignError
        If it is not readable, or is a folder of another kind.
    """
    if path.is_dir():
        return _stage(path)
    if path.suffix == ".tif":
        with opened_raster(path, expected=EXPECTED, remedy=REMEDY) as raster:
            geometry = {
                "crs": raster.crs.to_string() if raster.crs else "none",
                "transform": " ".join(f"{number:.12g}" for number in tuple(raster.transform)[:6]),
                "size": f"{raster.width} × {raster.height}",
                "bands": f"{raster.count} {raster.dtypes[0]}, nodata {raster.nodata}",
                "meaning": f"{raster.descriptions[0]}, unit {raster.units[0]}",
            }
        return {"geometry": geometry, **_tagged(path)}
    if path.suffix == ".png":
        return {"geometry": {"size": "{} × {}".format(*picture(path).size)}, **_tagged(path)}
    if path.suffix in {".json", ".geojson"}:
        return {"report": flat(read_json(path, expected=EXPECTED, remedy=REMEDY))}
    return {}


def _tagged(path: Path) -> Sections:
    """Return what the tags of a file say."""
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
    """Return what the JSON of a tag holds, or its text."""
    try:
        return json.loads(text) if text[:1] in {"{", "["} else text
    except (ValueError, RecursionError):
        return text


def _stage(folder: Path) -> Sections:
    """Return what a finished stage says of itself; its arrays are read apart."""
    if folder.suffix != ".zarr" or folder.stem not in STAGES:
        raise CampaignError("a folder that is no stage", folder, EXPECTED, REMEDY)
    stage = open_stage(folder, folder.stem)
    with undamaged(folder, expected="attributes of a stage", remedy="Delete its manifest and run the workflow again."):
        said = dict(stage.attrs)
        return {
            "geometry": {str(name): f"{one.dtype} {dict(one.sizes)}" for name, one in stage.variables.items()},
            "settings": flat(json.loads(said.pop("runspec", "{}"))),
            "inputs": flat(said.pop("inputs", {})),
            "stages": read_manifest(manifest_of(folder)).get("sources", {}),
            "code": {"sha256": str(said.pop("code_sha256", "none"))},
            "software": flat(said.pop("software", {})) | {"apertura": str(said.pop("apertura_version", "none"))},
            "flags": flat(said.pop("flags", {})),
            "report": flat(said),
        }


def flat(value: Mapping[str, Any]) -> dict[str, str]:
    """Return key.key… → text of each value that is no mapping and no list.

    Examples
    --------
    >>> flat({"waveform": {"carrier_hz": 1.2e9}, "nodes": ["uav1"], "flags": {}})
    {'waveform.carrier_hz': '1200000000.0', 'nodes.0': 'uav1', 'flags': '{}'}
    """
    found: dict[str, str] = {}
    waiting: list[tuple[str, Any]] = [("", value)]  # a stranger's document may be deeper than Python calls itself
    while waiting:
        key, one = waiting.pop()
        inner = one.items() if isinstance(one, Mapping) else enumerate(one) if isinstance(one, list) else ()
        if inner and one:
            waiting += [(f"{key}.{name}" if key else str(name), below) for name, below in reversed(list(inner))]
        elif key:
            found[key] = one if isinstance(one, str) else str(one) if hasattr(one, "dtype") else canonical_json(one)
    return found
