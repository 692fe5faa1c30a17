"""What a file says of itself: the tags of a GeoTIFF or a PNG, which may be a stranger's."""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError, shown
from apertura.common.raster import opened_raster

TAGGED = (".tif", ".png")
"""Suffixes of files that carry tags."""

EXPECTED = "a GeoTIFF or PNG as the workflow writes it"
COPY_AGAIN = "Copy it again from its campaign, or run the workflow again."

_OURS = "APERTURA_"


def read_tags(path: Path) -> dict[str, str]:
    """Return the tags of ours that a file carries; none where it is of another kind.

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
        with opened_raster(path, expected=EXPECTED, remedy=COPY_AGAIN) as raster:
            return ours(raster.tags())
    return ours(_texts(path)) if path.suffix == ".png" else {}


def ours(tags: Mapping[Any, Any]) -> dict[str, str]:
    """Return the tags that apertura has written.

    Examples
    --------
    >>> ours({"AREA_OR_POINT": "Area", "APERTURA_VERSION": "0.1.0"})
    {'APERTURA_VERSION': '0.1.0'}
    """
    return {str(name): str(text) for name, text in tags.items() if str(name).startswith(_OURS)}


def _texts(path: Path) -> dict[Any, Any]:
    """Return the text chunks of a PNG."""
    return dict(picture(path).info)


def picture(path: Path) -> Any:
    """Return a PNG with its pixels, a `PIL.Image.Image`; raises as `read_tags`."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a picture of more pixels than any of ours, before it is unpacked
            with Image.open(path, formats=["PNG"]) as opened:
                opened.load()  # texts may follow the pixels
                return opened
    except MemoryError:
        raise
    except Exception as error:  # a codec may raise anything
        found = shown(str(error).replace(str(path), path.name), 200)
        raise CampaignError(f"not readable as PNG ({found})", path, EXPECTED, COPY_AGAIN) from error


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
    with undamaged(where, expected=f"tag {_OURS}{name} as the workflow writes it", remedy=COPY_AGAIN):
        found = json.loads(tags.get(f"{_OURS}{name}", "{}"))
        if not isinstance(found, dict):
            raise TypeError(f"tag {_OURS}{name} is no object of JSON")
        return found


def hashes(tags: Mapping[str, str], name: str, where: Path) -> dict[str, str]:
    """Return the hashes in a tag, name → hex; as `document`."""
    found = document(tags, name, where)
    with undamaged(where, expected="a hash for each name", remedy=COPY_AGAIN):
        if not all(isinstance(text, str) for text in found.values()):
            raise TypeError(f"tag {_OURS}{name} holds a hash that is no text")
    return found
