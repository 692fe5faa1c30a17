"""Fields of STAC's extensions, and where their schemas are known by."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

_BASE = "https://stac-extensions.github.io"

EXTENSIONS: Mapping[str, str] = {
    "file": f"{_BASE}/file/v2.1.0/schema.json",
    "processing": f"{_BASE}/processing/v1.2.0/schema.json",
    "proj": f"{_BASE}/projection/v2.0.0/schema.json",
    "raster": f"{_BASE}/raster/v1.1.0/schema.json",
    "sar": f"{_BASE}/sar/v1.3.0/schema.json",
}
"""Prefix of the fields → address of the schema, which is its name: nothing is fetched."""

_BANDS_GHZ = {
    "P": (0.25, 0.5),
    "L": (1.0, 2.0),
    "S": (2.0, 4.0),
    "C": (4.0, 8.0),
    "X": (8.0, 12.5),
    "Ku": (12.5, 18.0),
    "K": (18.0, 26.5),
    "Ka": (26.5, 40.0),
}
"""Frequency bands of the extension; it knows none between P and L, nor above Ka."""

_FIRST_CLOCK = datetime(1980, 1, 6, tzinfo=UTC)  # GPS time begins; nothing here was recorded before
_NO_CLOCK = "none: the recording carries no time of day, so times count pulses from 1970-01-01"


@dataclass(frozen=True)
class Acquisition:
    """When an image was recorded, and on which frequencies.

    Attributes
    ----------
    start, end
        UTC of the first and of the last pulse.
    centre_hz, bandwidth_hz
        Of the band that was received.
    """

    start: datetime
    end: datetime
    centre_hz: float
    bandwidth_hz: float

    @property
    def middle(self) -> datetime:
        """The instant half way."""
        return self.start + (self.end - self.start) / 2

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of the extension sar that follow; without the band where it has no letter."""
        ghz = self.centre_hz / 1e9
        band = next((name for name, (low, high) in _BANDS_GHZ.items() if low <= ghz < high), None)
        return {
            "sar:center_frequency": round(ghz, 9),
            "sar:bandwidth": round(self.bandwidth_hz / 1e9, 9),
            **({"sar:frequency_band": band} if band else {}),
            **({"apertura:clock": _NO_CLOCK} if self.start < _FIRST_CLOCK else {}),
        }

    @classmethod
    def together(cls, parts: Sequence["Acquisition"]) -> "Acquisition":
        """Return that of a sum: from the first pulse to the last, over all frequencies.

        Examples
        --------
        >>> day = [datetime(2025, 5, 14, hour, tzinfo=UTC) for hour in range(4)]
        >>> both = Acquisition.together([Acquisition(*day[:2], 1.3e9, 2e8), Acquisition(*day[1:3], 1.5e9, 2e8)])
        >>> both.end.hour, both.centre_hz, both.bandwidth_hz
        (2, 1400000000.0, 400000000.0)
        """
        low = min(part.centre_hz - part.bandwidth_hz / 2 for part in parts)
        high = max(part.centre_hz + part.bandwidth_hz / 2 for part in parts)
        ends = min(part.start for part in parts), max(part.end for part in parts)
        return cls(*ends, (low + high) / 2, high - low)


def projection(wkt: str, shape: tuple[int, int], transform: Sequence[float]) -> dict[str, Any]:
    """Return where the pixels of a north-up raster lie.

    Parameters
    ----------
    wkt
        Its CRS, as pyproj reads it.
    shape
        Rows, columns.
    transform
        The six numbers of an affine transform, row by row: column and row to easting and northing, metres.

    Examples
    --------
    >>> from pyproj import CRS
    >>> fields = projection(CRS("EPSG:32632").to_wkt(), (40, 60), (0.5, 0, 500000, 0, -0.5, 100))
    >>> fields["proj:code"], fields["proj:bbox"]
    ('EPSG:32632', [500000, 80.0, 500030.0, 100])
    """
    from pyproj import CRS

    crs = CRS.from_user_input(wkt)
    code = crs.to_authority(min_confidence=100)
    step_x, _, west, _, step_y, north = transform
    return {
        "proj:code": ":".join(code) if code else None,
        "proj:wkt2": crs.to_wkt(),
        "proj:shape": list(shape),
        "proj:transform": list(transform),
        "proj:bbox": [west, north + shape[0] * step_y, west + shape[1] * step_x, north],
    }
