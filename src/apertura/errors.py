"""The errors a user can cause, and what each must say; and those of a machine that is full, closed or broken."""

import errno
import os
import shutil
from pathlib import Path

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
    errno.ENOTDIR: "Move away what stands where a folder should be",
    errno.EISDIR: "Move away the folder that stands where a file should be",
    errno.ENOTEMPTY: "Move away what stands there",
    errno.ENAMETOOLONG: "Give flights and nodes shorter names",
    errno.EPIPE: "Whoever read the output has gone",
}
"""Error number of the system → what a person can do about it."""


class CampaignError(ValueError):
    """Something in the campaign folder is wrong and a person has to change it.

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

    Examples
    --------
    >>> print(CampaignError("spacing_m is -1", where="config/config.yaml: scene",
    ...                     expected="a positive number", remedy="Give metres per pixel."))
    config/config.yaml: scene: spacing_m is -1; expected a positive number. Give metres per pixel.
    """

    def __init__(self, found: str, where: object, expected: str, remedy: str) -> None:
        super().__init__(f"{where}: {found}; expected {expected}. {remedy}")


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
        What it was, where, how much is free there and what to do; None for any other error, a defect of the product.

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


def _error_number(error: BaseException) -> int | None:
    """Return the system's number of an error; GDAL's errors only quote its words."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno if error.errno in _REMEDIES else None
    if isinstance(error, OSError) or type(error).__module__.startswith("rasterio"):
        told = f"{error} {error.__cause__ or error.__context__ or ''}"
        return next((number for number in _REMEDIES if os.strerror(number) in told), None)
    return None


def _free(path: Path) -> str:
    there = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    return f"{shutil.disk_usage(there).free / 1e6:.1f} MB free there"
