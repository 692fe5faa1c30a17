"""Arrays in untrusted .npy files: the header is checked before anything is allocated."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.confined import on_disk
from apertura.common.errors import CampaignError, quoted, shown

_MAGIC = b"\x93NUMPY"


def read_npy(path: Path, *, kinds: str, most: int, expected: str, remedy: str) -> NDArray[Any]:
    """Return the array in a .npy file.

    Parameters
    ----------
    path
        The file.
    kinds
        Letters of the kinds of dtype that will do, such as 'c' or 'if'.
    most
        Values that it may hold.
    expected, remedy
        For the message.

    Raises
    ------
    CampaignError
        If it is no .npy file, is of another kind or larger, or ends early.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("not a .npy file")
        with on_disk(path) as file:
            mapped = np.load(file, mmap_mode="r", allow_pickle=False)
        found = None
        if mapped.dtype.kind not in kinds or mapped.dtype.names or mapped.size > most:
            found = f"{quoted(mapped.dtype.str, 20)[1:-1]} of shape {mapped.shape}"
        array = None if found else np.array(mapped)
    except Exception as error:  # numpy evaluates the header, which may be of any kind of nonsense
        found, array = f"not readable ({shown(error, 200)})", None
    if array is None:
        raise CampaignError(str(found), where=path, expected=expected, remedy=remedy)
    return array
