"""Layers of an image: incidence and bistatic angles, shadow and layover mask, number of pulses, noise level."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from rasterio import Affine

from apertura.formats.export.cog import Band, NorthUpRaster, only, write_cog
from apertura.formats.export.radiometry import TAG

SHADOW, LAYOVER, OUTSIDE = 1, 2, 255
"""Bits of the mask, and value of pixels without pulses; pixels with neither shadow nor layover are 0."""

CLASSES = {
    0: ("valid", (255, 255, 255)),
    SHADOW: ("shadow", (45, 55, 115)),
    LAYOVER: ("layover", (225, 120, 20)),
    SHADOW | LAYOVER: ("shadow and layover", (150, 20, 60)),
    OUTSIDE: ("outside, no data", (0, 0, 0)),
}
"""Value of the mask → meaning and colour."""

INCIDENCE = Band(
    "float32", np.nan, "deg", "incidence angle at closest approach, from the terrain normal", "AVERAGE", smooth=True
)
BISTATIC_ANGLE = Band(
    "float32", np.nan, "deg", "angle between transmitter and receiver at closest approach", "AVERAGE", smooth=True
)
ELLIPSOIDAL_INCIDENCE = replace(INCIDENCE, meaning="incidence angle at closest approach, from the vertical (WGS 84)")
MASK = Band(
    "uint8",
    OUTSIDE,
    "class",
    "0 valid, 1 shadow, 2 layover, 3 both, 255 outside",
    "MODE",
    {value: colour for value, (_, colour) in CLASSES.items()},
)
LOOKS = Band("float32", 0, "pulses", "effective number of pulses in the pixel", "AVERAGE", smooth=True)
NESZ = Band(
    "float32", np.nan, "dB", "noise-equivalent echo per pulse: relative, not calibrated", "AVERAGE", smooth=True
)

SCATTERING_AREA = Band(
    "float32", np.nan, "1", "scattering area relative to the slant-plane area: beta0 / gamma0", "AVERAGE", smooth=True
)
GAMMA_SIGMA_RATIO = Band(
    "float32", np.nan, "1", "area normal to the line of sight per ground area: sigma0 / gamma0", "AVERAGE", smooth=True
)

LINE_OF_SIGHT = Band(
    "float32",
    np.nan,
    "1",
    "component of line of sight unit vector (ground to sensor, bisector of transmitter and receiver)",
    "AVERAGE",
    smooth=True,
    components=("East", "North", "Vertical"),
)
"""Bands as in the static layers of OPERA DISP-S1; no data is NaN, because a component may be exactly 0."""

SLANT_RANGE = Band(
    "float32",
    np.nan,
    "m",
    "slant range at closest approach",
    "AVERAGE",
    smooth=True,
    components=("Transmitter", "Receiver"),
)

NESZ_ABSOLUTE = "noise-equivalent sigma0"
"""Meaning of `NESZ` of a calibrated pair."""


def write_incidence(
    path: Path, angle_deg: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the incidence angle, (y, x) float32 degrees, NaN outside. Otherwise as `cog.write_slc`."""
    write_cog(path, angle_deg, INCIDENCE, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


def write_ellipsoidal_incidence(
    path: Path, angle_deg: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the angle from the vertical, (y, x) float32 degrees, NaN outside. Otherwise as `cog.write_slc`."""
    band, check = ELLIPSOIDAL_INCIDENCE, only("float32")
    write_cog(path, angle_deg, band, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_bistatic_angle(
    path: Path, angle_deg: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the bistatic angle, (y, x) float32 degrees, NaN outside. Otherwise as `cog.write_slc`."""
    check = only("float32")
    write_cog(path, angle_deg, BISTATIC_ANGLE, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_mask(
    path: Path, bits: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the shadow and layover mask, (y, x) uint8 sums of `SHADOW` and `LAYOVER`, or `OUTSIDE`.

    Overviews contain the most frequent value, so that bits are never mixed. Otherwise as `cog.write_slc`.

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "mask.tif"
    ...     write_mask(path, np.ones((2, 3), "u1"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.descriptions[0], raster.read(1)[0, 0].item()
    ('0 valid, 1 shadow, 2 layover, 3 both, 255 outside', 1)
    """
    write_cog(path, bits, MASK, transform=transform, crs=crs, tags=tags, title=title, value=only("uint8"))


def write_looks(
    path: Path, looks: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the number of pulses in each pixel, (y, x) float32, nodata 0. Otherwise as `cog.write_slc`."""
    write_cog(path, looks, LOOKS, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


def write_nesz(
    path: Path, noise_db: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the noise-equivalent echo power, (y, x) float32 dB, NaN outside. Otherwise as `write_looks`.

    With the tag `apertura.formats.export.radiometry.TAG`, values are noise-equivalent σ⁰.
    """
    band = replace(NESZ, meaning=NESZ_ABSOLUTE) if TAG in tags else NESZ
    write_cog(path, noise_db, band, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


def write_scattering_area(
    path: Path, area: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the scattering area, by which β⁰ is divided to give γ⁰, (y, x) float32. Otherwise as `write_incidence`.

    Source: docs/theory/radiometry.md, eq. 6a.
    """
    check = only("float32")
    write_cog(path, area, SCATTERING_AREA, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_gamma_sigma_ratio(
    path: Path, ratio: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the factor that converts γ⁰ to σ⁰, (y, x) float32. Otherwise as `write_incidence`.

    Source: docs/theory/radiometry.md, eq. 6a.
    """
    check = only("float32")
    write_cog(path, ratio, GAMMA_SIGMA_RATIO, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_line_of_sight(
    path: Path, vector: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the line of sight, (y, x, 3) float32: east, north and up of a unit vector from the ground to the sensor.

    Source: docs/theory/layers.md, eq. 1b. Otherwise as `write_incidence`.
    """
    write_cog(path, vector, LINE_OF_SIGHT, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


def write_slant_range(
    path: Path, range_m: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the distances of transmitter and receiver, (y, x, 2) float32 metres. Otherwise as `write_incidence`."""
    write_cog(path, range_m, SLANT_RANGE, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))
