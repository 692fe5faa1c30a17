"""Reading of arrays in untrusted .npy files; the header is checked before memory is allocated."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.confined import on_disk
from apertura.common.errors import CampaignError, quoted, shown

_MAGIC = b"\x93NUMPY"


def read_npy(
    path: Path, *, kinds: str, most: int | None, expected: str, remedy: str, mapped: bool = False
) -> NDArray[Any]:
    """Read the array in a .npy file.

    Parameters
    ----------
    path
        The file.
    kinds
        Letters of the accepted dtype kinds, such as 'c' or 'if'.
    most
        Maximum number of values; None: no limit, for mapped arrays.
    expected, remedy
        Parts of the error message.
    mapped
        True to map the array into memory instead of reading it.

    Raises
    ------
    CampaignError
        If the file is not a .npy file, its dtype is not of an accepted kind, or it is too large or truncated.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("not a .npy file")
        with on_disk(path) as file:
            in_file = np.load(file, mmap_mode="r", allow_pickle=False)
        found = None
        if in_file.dtype.kind not in kinds or in_file.dtype.names or (most is not None and in_file.size > most):
            found = f"{quoted(in_file.dtype.str, 20)[1:-1]} of shape {in_file.shape}"
        array = None if found else in_file if mapped else np.array(in_file)
    except Exception as error:  # numpy evaluates the header; a malformed header may raise any exception
        found, array = f"not readable ({shown(error, 200)})", None
    if array is None:
        raise CampaignError(str(found), where=path, expected=expected, remedy=remedy)
    return array
