"""Errors that a user can cause, and those of a full, read-only or broken machine."""

import errno
import logging
import os
import shutil
from functools import lru_cache
from pathlib import Path

_LOG = logging.getLogger(__name__)
_REMEDIES = {
    errno.ENOSPC: "Make room there",
    errno.EDQUOT: "Make room there, or ask for a larger quota",
    errno.EFBIG: "Raise the limit of a file's size (ulimit -f), or write to another file system",
    errno.EROFS: "Copy the campaign to where it may be written",
    errno.EACCES: "Make it readable and its folder writable",
    errno.EPERM: "Make it readable and its folder writable",
    errno.EIO: "Check the disk (dmesg)",
    errno.ESTALE: "Mount its server again",
    errno.ETIMEDOUT: "Mount its server again",
    errno.EMFILE: "Raise the limit of open files (ulimit -n)",
    errno.ENFILE: "Close other programs",
    errno.ENOMEM: "Give the job more memory",
    errno.ENOENT: "Check the path; to write, name a folder that can be written to,",
    errno.EEXIST: "Move away what stands there, or name another place,",
    errno.ENOTDIR: "Move away what stands where a folder should be",
    errno.EISDIR: "Move away the folder that stands where a file should be",
    errno.ENOTEMPTY: "Move away what stands there",
    errno.ENAMETOOLONG: "Give flights and nodes shorter names",
    errno.EPIPE: "The reader of the output has gone",
}
"""Error number of the system → remedy."""

_LONGEST = {"where": 400, "found": 1000, "expected": 1000, "remedy": 400}
"""Characters of each part of a message; text of untrusted files may be of any length."""


def shown(text: object, longest: int = 80) -> str:
    r"""Return a text as a terminal may show it: one line, control characters as escapes, cut where it is too long.

    Parameters
    ----------
    text
        Of whatever origin; not printed as it stands.
    longest
        Characters that are kept.

    Examples
    --------
    >>> print(shown("red \x1b[31m"), shown("a" * 100, longest=5))
    red \x1b[31m aaaaa…
    """
    line = str(text)
    whole = len(line) <= longest
    line = line[:longest]
    if not line.isprintable():
        line = "".join(one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in line)
    return line if whole and len(line) <= longest else line[:longest] + "…"


@lru_cache(maxsize=1000)
def print_remark(where: str, remark: str) -> None:
    """Print how a file was read, once in a process: commands may read a file for each of their checks.

    Parameters
    ----------
    where
        The file.
    remark
        One line; also what an untrusted file holds.
    """
    _LOG.warning("%s: %s", shown(where, 300), shown(remark, 500))


def number_of(count: int, what: str) -> str:
    """Return a count of something in words.

    Examples
    --------
    >>> number_of(1, "bright point"), number_of(3, "pulse")
    ('1 bright point', '3 pulses')
    """
    return f"{count} {what}{'' if count == 1 else 's'}"


def quoted(value: object, longest: int = 80) -> str:
    """Return a value that was read as Python writes it, in quotation marks if it is text, and no longer than that.

    Examples
    --------
    >>> quoted("fast"), quoted(1e308), quoted([0] * 99, longest=4)
    ("'fast'", '1e+308', '[0, 0, …')
    """
    try:
        text = repr(value[:longest] + "…" if isinstance(value, str) and len(value) > longest else value)
    except ValueError:  # an integer of thousands of digits
        text = f"a {type(value).__name__} too long to show"
    return shown(text, longest + 3)


class CampaignError(ValueError):
    """Something in the campaign folder is wrong and a person has to change it.

    It may quote an untrusted file: it is one line without control characters, of bounded length.

    Parameters
    ----------
    found
        What is there, with its value.
    where
        File, and key, line or pulse within it.
    expected
        What would have been right.
    remedy
        What to do about it, in one sentence.

    Attributes
    ----------
    found, where, expected, remedy
        The same, as shown.

    Examples
    --------
    >>> print(CampaignError("spacing_m is -1", where="config/config.yaml: scene",
    ...                     expected="a positive number", remedy="Give metres per pixel."))
    config/config.yaml: scene: spacing_m is -1; expected a positive number. Give metres per pixel.
    """

    def __init__(self, found: str, where: object, expected: str, remedy: str) -> None:
        self.found = shown(found, _LONGEST["found"])
        self.where = shown(getattr(where, "location", where), _LONGEST["where"])
        self.expected = shown(expected, _LONGEST["expected"])
        self.remedy = shown(remedy, _LONGEST["remedy"])
        super().__init__(f"{self.where}: {self.found}; expected {self.expected}. {self.remedy}")

    def __reduce__(self) -> tuple[type["CampaignError"], tuple[str, str, str, str]]:
        return type(self), (self.found, self.where, self.expected, self.remedy)


class ContractError(TypeError):
    """A stage does not hold what its contract promises: a bug of the product, not of the campaign."""


def explained(error: BaseException) -> str | None:
    """Return one message for an error of the machine: disk full, read-only, broken; memory, files or reader gone.

    Parameters
    ----------
    error
        Whatever ended the work.

    Returns
    -------
    str or None
        Message with path, free space and remedy; None for any other error, a defect of the product.

    Examples
    --------
    >>> explained(OSError(errno.EIO, "Input/output error", "raw/f01/a.sigmf-data"))
    'raw/f01/a.sigmf-data: Input/output error (EIO). Check the disk (dmesg) and run again: it goes on where it was.'
    >>> explained(ZeroDivisionError()) is None
    True
    """
    again = "and run again: it goes on where it was."
    if isinstance(error, MemoryError):
        what = str(error) or "no more memory"
        return f"out of memory: {what}. Give the job more memory, or fewer --threads or a smaller tile_px, {again}"
    number = _error_number(error)
    if number is None:
        return None
    where = getattr(error, "filename", None)
    what = f"{os.strerror(number)} ({errno.errorcode[number]})"
    if number == errno.EPIPE:
        return f"{where or 'output'}: {what}. {_REMEDIES[number]}."
    free = f", {_free(Path(os.fsdecode(where)))}" if where and number in _OF_SPACE else ""
    return f"{os.fsdecode(where) if where else 'output'}: {what}{free}. {_REMEDIES[number]} {again}"


_OF_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_OF_PLACE = {errno.ENOENT, errno.EEXIST}
"""Without the name of a file they are defects: a person can do nothing about them."""


def _error_number(error: BaseException) -> int | None:
    """Return the system's number of an error; GDAL's errors only quote its words."""
    if isinstance(error, OSError) and error.errno is not None:
        known = error.errno in _REMEDIES and (error.filename is not None or error.errno not in _OF_PLACE)
        return error.errno if known else None
    if isinstance(error, OSError) or type(error).__module__.startswith("rasterio"):
        text = f"{error} {error.__cause__ or error.__context__ or ''}"
        return next((number for number in _REMEDIES.keys() - _OF_PLACE if os.strerror(number) in text), None)
    return None


def _free(path: Path) -> str:
    path = Path(path.absolute())
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    return f"{shutil.disk_usage(there).free / 1e6:.1f} MB free there"
