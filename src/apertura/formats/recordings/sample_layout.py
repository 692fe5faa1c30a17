"""How the samples of a recording lie in its file: which numbers, what stands between them, real ones at which IF."""

import re
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.formats.recordings.real_samples import Mixing

Samples = NDArray[np.int16 | np.float32]
"""(…, 2), I and Q: counts of up to 16 bits as int16, all others as float32."""

_DATATYPE = re.compile(r"([cr])(?:([iu]8)|([iu](?:16|32)|f(?:16|32|64))_([lb])e)", re.ASCII)

DATATYPES = "ci16_le: c or r (complex, real); i8, u8, or i16, u16, i32, u32, f16, f32, f64 with _le or _be"
"""What datatypes are read, for messages."""

_LARGEST = np.float64(1e15)  # of a float: sums of squares stay in float32


def _none() -> NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class SampleLayout:
    """How samples lie in a file.

    Attributes
    ----------
    datatype
        As SigMF names it.
    trailing_bytes
        At the end of the file that are no samples.
    segment_start, skipped_bytes
        (segment,) int64: first samples of what lies behind bytes that are no samples, ascending, and how many such
        bytes the file holds before each; none where there are no such bytes.
    mixing
        Of real samples; None: they are complex.

    Examples
    --------
    >>> SampleLayout("ri16_be").stored, SampleLayout("ri16_be").components
    (dtype('>i2'), 1)
    """

    datatype: str = "ci16_le"
    trailing_bytes: int = 0
    segment_start: NDArray[np.int64] = field(default_factory=_none)
    skipped_bytes: NDArray[np.int64] = field(default_factory=_none)
    mixing: Mixing | None = None

    @property
    def stored(self) -> np.dtype[Any]:
        """Of one number in the file; ValueError if the datatype is none of those that are read."""
        match = _DATATYPE.fullmatch(self.datatype)
        if match is None:
            raise ValueError(f"no datatype {self.datatype}")
        kind, order = match[2] or match[3], "<" if match[4] == "l" else ">"
        return np.dtype(f"{order if match[4] else '|'}{kind[0]}{int(kind[1:]) // 8}")

    @property
    def components(self) -> int:
        """Numbers per sample of a channel: I and Q, or one."""
        return 2 if self.datatype.startswith("c") else 1

    def numbers(self, data: NDArray[np.uint8]) -> Samples:
        """Return the bytes of a file as numbers, flat: int16 where that holds them, else float32.

        Unsigned counts lose half their range: 128 of u8 is zero. Those of 32 bits are rounded to 24.

        Raises
        ------
        ValueError
            If a float is not finite or beyond 1e15; its second argument is the index of the first.
        """
        stored = data.view(self.stored)
        if stored.dtype.kind == "u":
            stored = stored - np.float64(1 << 8 * stored.itemsize - 1)
        elif stored.dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # a NaN that signals
                good = np.abs(stored) <= _LARGEST  # false for NaN
            if not good.all():
                raise ValueError("not finite or beyond 1e15", int(np.argmin(good)))
        if self.stored.kind in "iu" and self.stored.itemsize <= 2:
            return stored.astype(np.int16, copy=False)
        return stored.astype(np.float32, copy=False)

    def kept(self) -> tuple[dict[str, Any], dict[str, xr.Variable]]:
        """Return attributes and variables of the `raw` stage that `of` makes a layout of again."""
        attributes = {
            "datatype": self.datatype,
            "trailing_bytes": self.trailing_bytes,
            "mixing": None if self.mixing is None else asdict(self.mixing),
        }
        segments = {"segment_start": self.segment_start, "segment_skipped": self.skipped_bytes}
        return attributes, {name: xr.Variable("segment", one) for name, one in segments.items() if one.size}

    @classmethod
    def of(cls, raw: xr.Dataset) -> "SampleLayout":
        """Return the layout of the file that a `raw` stage refers to."""
        start, skipped = (raw[name].values if name in raw else _none() for name in ("segment_start", "segment_skipped"))
        stated = raw.attrs["mixing"]
        mixing = None if stated is None else Mixing(**stated)
        return cls(raw.attrs["datatype"], raw.attrs["trailing_bytes"], start, skipped, mixing)
