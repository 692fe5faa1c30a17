"""A .npy file: what array it holds; code symbols are one of complex numbers."""

from pathlib import Path

import numpy as np

from apertura.formats.npy import read_npy
from apertura.views.inspection.report import Report

SUFFIX = ".npy"

_MOST = 1 << 28


def array_report(path: Path) -> Report:
    """Return what is told of a .npy file.

    Raises
    ------
    CampaignError
        If it is none, or holds no numbers.
    """
    expected = f"a .npy file of at most {_MOST} numbers"
    array = read_npy(path, kinds="biufc", most=_MOST, expected=expected, remedy="Save it again.")
    sizes = np.abs(array[np.isfinite(array)]) if array.size else np.zeros(0)
    facts = {
        "shape": [int(side) for side in array.shape],
        "type": str(array.dtype),
        "amplitude": [float(sizes.min()), float(sizes.max())] if sizes.size else None,
        "not_finite": int(array.size - sizes.size),
    }
    return Report(path, "code symbols" if array.ndim == 1 and array.dtype.kind == "c" else "array", "", facts)
