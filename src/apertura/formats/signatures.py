"""Recognition of flight logs by their first bytes, for logs with any suffix."""

import re
from codecs import BOM_UTF8
from collections.abc import Mapping
from pathlib import Path

from apertura.common.atomic import naming

SIGNATURES: Mapping[str, bytes] = {
    "airdata": rb"time\(millisecond\)",
    "optitrack": rb"Format Version,1\.",
    "csv": rb"(?=[^\n]*\b(?:latitude_deg|x_m|east_m)\b)[^\n]*\btime(?:_utc|_s)?\b",
    "nmea": rb"\s*[$!][A-Z]{2}[A-Z0-9]*,",
    "px4": rb"ULog\x01\x12\x35",
    "ardupilot": rb"\xa3\x95\x80|FMT,",
    "rtklib": rb"% (?:program|\(| *GPST)",
}
"""Format, a key of `apertura.formats.names.TRACKS` → regular expression of the first bytes."""

_HEAD_BYTES = 8192


def log_by_content(path: Path) -> str | None:
    """Return the format of a log, a key of `SIGNATURES`, from its first bytes; None if no format matches.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "gps.dat"
    ...     _ = path.write_text("$GNGGA,093000.00,4825.3530,N,00957.3054,E,4,12,0.6,625.0,M,47.2,M,,*5A")
    ...     log_by_content(path)
    'nmea'
    """
    with naming(path), path.open("rb") as stream:
        first = stream.read(_HEAD_BYTES).removeprefix(BOM_UTF8)
    return next((name for name, signature in SIGNATURES.items() if re.match(signature, first)), None)
