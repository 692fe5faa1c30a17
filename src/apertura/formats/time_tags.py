"""Time tags of a recording without header: a text file or .npy array with the time of each capture."""

import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.documents import read_text
from apertura.common.errors import CampaignError
from apertura.formats.npy import read_npy
from apertura.formats.times import utc_times

_LARGEST = 256_000_000
_HEAD_BYTES = 1024
_HEADER = re.compile(r"#?\s*(?:time|time_utc|time_s)\s*(?:,\s*frame\s*)?", re.ASCII)
_ISO = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|\+00:00)?"
_LINE = re.compile(rf"({_ISO}|\d{{9,10}}(?:\.\d+)?)(?:\s*,\s*(\d{{1,18}}))?", re.ASCII)
_EXPECTED = "a line per capture: time in UTC (ISO 8601 or seconds since 1970), optionally a comma and a frame number"


def are_time_tags(path: Path) -> bool:
    r"""Return True if a file starts with time tags.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "tags.txt"
    ...     _ = path.write_text("2025-05-14T09:30:00.05Z\n2025-05-14T09:30:00.10Z\n")
    ...     are_time_tags(path), read_time_tags(path)[0].astype(str).tolist()[1]
    (True, '2025-05-14T09:30:00.100000000')
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if path.suffix == ".npy":
        return b"'<M8[" in head
    lines = [line.strip() for line in head.decode("utf-8-sig", errors="replace").splitlines()[:2]]
    has_header = bool(lines) and _HEADER.fullmatch(lines[0]) is not None
    return any(_LINE.fullmatch(line) for line in lines[has_header : has_header + 1])


def read_time_tags(path: Path) -> tuple[Times, NDArray[np.int64] | None]:
    """Read the time of each capture, (capture,) datetime64[ns] in UTC, and the frame numbers, None if there are none.

    Raises
    ------
    CampaignError
        If a line is not a time with an optional frame number, or times do not increase.
    """
    remedy = "Correct the file of time tags."
    if path.suffix == ".npy":
        stored = read_npy(path, kinds="M", most=_LARGEST, expected="an array of datetime64", remedy=remedy)
        times, frames = stored.reshape(-1).astype("datetime64[ns]"), list[str | None]()
    else:
        text = read_text(path, expected=_EXPECTED, remedy=remedy, largest=_LARGEST)
        rows = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
        rows = rows[1:] if rows and _HEADER.fullmatch(rows[0][1]) else rows
        matches = [_LINE.fullmatch(line) for _, line in rows]
        if None in matches or not matches:
            number, line = rows[matches.index(None)] if matches else (1, "")
            raise CampaignError(f"{line[:80]!r}", f"{path}: line {number}", _EXPECTED, remedy)
        try:
            times = _parsed([match[1] for match in matches if match])
        except ValueError as error:
            raise CampaignError(str(error), path, _EXPECTED, remedy) from error
        frames = [match[2] for match in matches if match]
    backwards = np.flatnonzero(np.diff(times) <= np.timedelta64(0, "ns"))
    if backwards.size:
        at = int(backwards[0]) + 1
        found = f"tag {at}, {times[at]}, is not later than the previous tag, {times[at - 1]}"
        raise CampaignError(found, path, "increasing times", remedy)
    if None in frames or not frames:
        return times, None
    return times, np.array(frames, np.int64)


def _parsed(texts: list[str]) -> Times:
    if "-" in texts[0]:
        return utc_times([text.removesuffix("Z").removesuffix("+00:00") for text in texts])
    nanoseconds = [int((Decimal(text) * 1_000_000_000).to_integral_value()) for text in texts]
    return np.array(nanoseconds, np.int64).astype("datetime64[ns]")
