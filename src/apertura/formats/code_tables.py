"""Tables of transmitted code symbols in .npy files and Zarr arrays (version 3), read row by row."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.confined import ConfinedPath
from apertura.common.documents import other_codec, read_json
from apertura.common.errors import CampaignError, quoted, shown
from apertura.formats.npy import read_npy

if TYPE_CHECKING:
    import zarr

MOST_SYMBOLS = 1 << 24
"""Largest number of code symbols of a frame, and of a chunk of a Zarr array."""

_TESTED_SYMBOLS = 1 << 20  # number of code symbols up to which all rows are tested when a table is opened; else 16 rows


class CodeTable:
    """Table of code symbols in a file, of which only the requested rows are read.

    Attributes
    ----------
    path
        .npy file, mapped into memory, or folder of a Zarr array.
    shape
        Frames and subcarriers; a one-dimensional array is a table of one frame.

    Raises
    ------
    CampaignError
        If the file is missing or damaged, or is not an array of (subcarriers,) or (frames, subcarriers) complex
        numbers; on reading, if a symbol is zero or not finite.
    """

    def __init__(self, path: Path, subcarriers: int) -> None:
        self.path = path
        self._limits = {
            "expected": f"({subcarriers},) or (frames, {subcarriers}) complex64 without zeros, for config/config.yaml: "
            "waveform.subcarriers",
            "remedy": "Use the codes that were transmitted, or correct the waveform.",
        }
        if not (path.is_file() or path.is_dir()):
            raise CampaignError("no such file", path, self._limits["expected"], "Copy the file there.")
        if path.is_dir():
            self._array: Any = _opened(path, self._limits)
        else:
            self._array = read_npy(path, kinds="c", most=None, mapped=True, **self._limits)
        self.shape = (1, *self._array.shape)[-2:]
        if self._array.ndim not in {1, 2} or self.shape[1] != subcarriers or not self.shape[0]:
            raise self._refused("")
        tested = self.shape[0] if self.shape[0] * subcarriers <= _TESTED_SYMBOLS else 16
        self[np.unique(np.linspace(0, self.shape[0] - 1, tested).astype(np.int64))]

    def __getitem__(self, rows: NDArray[np.int64]) -> NDArray[np.complex64]:
        """Return the rows of the given numbers, (row, subcarrier) complex64."""
        if self._array.ndim == 1:
            stored = np.asarray(self._array[:])[None][rows]
        elif self.path.is_dir():
            with np.errstate(over="ignore"):
                stored = self._read(rows)
        else:
            stored = self._array[rows]
        with np.errstate(over="ignore", invalid="ignore"):  # infinite and NaN values are rejected below
            codes = stored.astype(np.complex64)
            weakest = np.abs(codes).min() if codes.size else 1.0
        if not (weakest > 0 and np.isfinite(codes.view(np.float32)).all()):
            zeros, others = int((codes == 0).sum()), int((~np.isfinite(codes)).sum())
            raise self._refused(f", of which {zeros} are zero and {others} not finite")
        return codes

    def _read(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        try:
            return np.asarray(self._array.oindex[rows, slice(None)])
        except Exception as error:  # a damaged chunk may raise any exception
            raise CampaignError(f"not readable ({shown(error, 200)})", self.path, **self._limits) from error

    def _refused(self, problem: str) -> CampaignError:
        shape = tuple(self._array.shape)
        return CampaignError(f"{self._array.dtype} of shape {shape}{problem}", self.path, **self._limits)


def _opened(folder: Path, limits: dict[str, str]) -> "zarr.Array[Any]":
    """Open a Zarr array of complex numbers without links, unsafe codecs and chunks of excessive size."""
    confined, found = ConfinedPath.at(folder), ""
    linked = [path for path in confined.rglob("*") if path.is_symlink()]
    if linked:
        raise CampaignError("a symbolic link, which is not followed", linked[0], **limits)
    codec = other_codec(read_json(confined / "zarr.json", expected=limits["expected"], remedy=limits["remedy"]))
    if codec is not None:
        raise CampaignError(f"codec {quoted(codec)}, which is not permitted", folder, **limits)
    import zarr  # slow to import
    from zarr.storage import LocalStore

    try:
        array = zarr.open_array(LocalStore(confined, read_only=True), mode="r", zarr_format=3)
    except Exception as error:  # damaged metadata may raise any exception
        raise CampaignError(f"not readable ({shown(error, 200)})", folder, **limits) from error
    if np.dtype(array.dtype).kind != "c":
        found = f"{array.dtype} of shape {array.shape}"
    elif int(np.prod(array.chunks)) > MOST_SYMBOLS:
        found = f"chunks of {array.chunks}, more than {MOST_SYMBOLS} values"
    if found:
        raise CampaignError(found, folder, **limits)
    return array
