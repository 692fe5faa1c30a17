"""Versions that tags name, against those of now: another one is no change of a product, and may be why it has one."""

from collections.abc import Iterator, Mapping
from typing import Any

from apertura import __version__
from apertura.common.provenance import lock_sha256, software

_NAMED = 4


def other_versions(tags: Mapping[str, str], made_with: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield what a file was made with that is not installed here, a line each.

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
        told = ", ".join(f"{one} {made_with.get(one, 'none')}, here {now.get(one, 'none')}" for one in others[:_NAMED])
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        yield f"made with {told}{more}: bytes may differ where it is made again"
    if tags.get("APERTURA_LOCK_SHA256", lock_sha256()) != lock_sha256():
        yield "made under another requirements/all.txt"
