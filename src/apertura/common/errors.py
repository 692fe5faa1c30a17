"""Errors that a user can correct, and messages for errors of the machine, such as a full or failing disk."""

import errno
import logging
import os
import shutil
from functools import lru_cache
from pathlib import Path

_LOG = logging.getLogger(__name__)
_REMEDIES = {
    errno.ENOSPC: "Free disk space",
    errno.EDQUOT: "Free disk space, or request a larger quota,",
    errno.EFBIG: "Raise the file size limit (ulimit -f), or write to another file system",
    errno.EROFS: "Copy the campaign to a writable file system",
    errno.EACCES: "Make the file readable and its folder writable",
    errno.EPERM: "Make the file readable and its folder writable",
    errno.EIO: "Check the disk (dmesg)",
    errno.ESTALE: "Remount the network file system",
    errno.ETIMEDOUT: "Remount the network file system",
    errno.EMFILE: "Raise the limit on open files (ulimit -n)",
    errno.ENFILE: "Close other programs",
    errno.ENOMEM: "Give the job more memory",
    errno.ENOENT: "Check the path (an output path must be in a writable folder)",
    errno.EEXIST: "Move the existing file or folder, or use another path,",
    errno.ENOTDIR: "Move the file that occupies the path of a folder",
    errno.EISDIR: "Move the folder that occupies the path of a file",
    errno.ENOTEMPTY: "Move the contents of that folder",
    errno.ENAMETOOLONG: "Give flights and nodes shorter names",
    errno.EPIPE: "The process that reads the output has exited",
}
"""Error number of the operating system → remedy."""

_LONGEST = {"where": 400, "found": 1000, "expected": 1000, "remedy": 400}
"""Maximum characters in each part of a message; text from untrusted files may be of any length."""


def shown(text: object, longest: int = 80) -> str:
    r"""Format a text for display on a terminal: one line, control characters escaped, truncated to a maximum length.

    Parameters
    ----------
    text
        Text or object from any source, trusted or not.
    longest
        Maximum number of characters before the ellipsis.

    Examples
    --------
    >>> print(shown("red \x1b[31m"), shown("a" * 100, longest=5))
    red \x1b[31m aaaaa…
    """
    line = str(text)
    whole = len(line) <= longest
    line = line[:longest]
    if not line.isprintable():
        line = "".join(
            character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
            for character in line
        )
    return line if whole and len(line) <= longest else line[:longest] + "…"


@lru_cache(maxsize=1000)
def print_remark(where: str, remark: str) -> None:
    """Log a remark about a file once per process, because a command may read the same file for several checks.

    Parameters
    ----------
    where
        The file.
    remark
        One line; it may quote an untrusted file.
    """
    _LOG.warning("%s: %s", shown(where, 300), shown(remark, 500))


def number_of(count: int, what: str) -> str:
    """Format a count with its noun in the singular or plural.

    Examples
    --------
    >>> number_of(1, "bright point"), number_of(3, "pulse")
    ('1 bright point', '3 pulses')
    """
    return f"{count} {what}{'' if count == 1 else 's'}"


def quoted(value: object, longest: int = 80) -> str:
    """Format a value from a file as its Python representation: text in quotation marks, truncated to a maximum length.

    Examples
    --------
    >>> quoted("fast"), quoted(1e308), quoted([0] * 99, longest=4)
    ("'fast'", '1e+308', '[0, 0, …')
    """
    try:
        text = repr(value[:longest] + "…" if isinstance(value, str) and len(value) > longest else value)
    except ValueError:  # Python does not convert an integer of thousands of digits
        text = f"a {type(value).__name__} too long to show"
    return shown(text, longest + 3)


class CampaignError(ValueError):
    """Error in the campaign folder that the user has to correct.

    The message, which may quote an untrusted file, is a single line of bounded length without control characters.

    Parameters
    ----------
    found
        The fault, with the value found.
    where
        File, and key, line or pulse within the file.
    expected
        Description of a valid value.
    remedy
        Corrective action, in one sentence.

    Attributes
    ----------
    found, where, expected, remedy
        The parameters, formatted for display.

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
    """Violation of a stage's contract: an internal error of the product, not of the campaign."""


def explained(error: BaseException) -> str | None:
    """Format an error of the machine (disk, memory, open files, closed output) as one message with a remedy.

    Parameters
    ----------
    error
        Exception that stopped the process.

    Returns
    -------
    str or None
        Message with path, free disk space and remedy; None for any other error, which is an internal error.

    Examples
    --------
    >>> explained(OSError(errno.EIO, "Input/output error", "raw/f01/a.sigmf-data"))
    'raw/f01/a.sigmf-data: Input/output error (EIO). Check the disk (dmesg) and run again: the run resumes.'
    >>> explained(ZeroDivisionError()) is None
    True
    """
    again = "and run again: the run resumes."
    if isinstance(error, MemoryError):
        what = str(error) or "allocation failed"
        return f"out of memory: {what}. Give the job more memory, fewer --threads or a smaller tile_px, {again}"
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
"""Error numbers that indicate an internal error, which the user cannot correct, unless the error names a file."""


def _error_number(error: BaseException) -> int | None:
    """Return the errno of an exception; for a GDAL error, the errno of the system message that the error quotes."""
    if isinstance(error, OSError) and error.errno is not None:
        known = error.errno in _REMEDIES and (error.filename is not None or error.errno not in _OF_PLACE)
        return error.errno if known else None
    if isinstance(error, OSError) or type(error).__module__.startswith("rasterio"):
        text = f"{error} {error.__cause__ or error.__context__ or ''}"
        return next((number for number in _REMEDIES.keys() - _OF_PLACE if os.strerror(number) in text), None)
    return None


def _free(path: Path) -> str:
    path = Path(path.absolute())
    existing_folder = next(folder for folder in (path, *path.parents) if folder.exists())
    return f"{shutil.disk_usage(existing_folder).free / 1e6:.1f} MB free on the file system"
