"""Quicklook of an image as PNG: power in dB on metric axes, north up, with provenance in the footer."""

import json
from collections.abc import Iterable, Mapping
from math import ceil
from pathlib import Path

import matplotlib.style
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from rasterio import Affine
from rasterio.transform import array_bounds

from apertura.common.atomic import replacement
from apertura.formats.export.cog import NorthUpRaster, placed, power
from apertura.formats.export.db import decibels
from apertura.formats.export.map_layout import DPI, PICTURE_DOTS, MapLayout, Marker
from apertura.formats.export.writing import READ


def write_quicklook(
    path: Path,
    image: NorthUpRaster,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
    subtitle: str = "",
    markers: Iterable[Marker] = (),
    dynamic_range_db: float = 40.0,
) -> None:
    """Plot power in dB relative to the peak as a PNG for viewing without a GIS.

    An image with more pixels than can be displayed is reduced by averaging power over groups of pixels, so that no
    target is lost by subsampling. The colour scale covers `dynamic_range_db` below the peak. If no more than three
    displayed pixels lie within 20 dB of the peak, the upper limit of the scale is the power of the fourth brightest
    displayed pixel, rounded up to 5 dB, so that an outlier does not darken the scene.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    image
        (y, x) complex64, north-up, NaN (white) where no image is formed; read block by block.
    transform, crs
        See `apertura.formats.export.cog.write_slc`.
    tags
        Provenance, name → text; stored in the file. Flags, version, numerical error and code hash are also printed in
        the footer.
    title, subtitle
        Flight and pair; summary of the most important information.
    markers
        (x, y, label) in metres of `crs`, drawn as rings.
    dynamic_range_db
        Range of the colour bar, dB.

    Raises
    ------
    ContractError, CampaignError
        See `apertura.formats.export.cog.write_slc`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "quicklook.png"
    ...     write_quicklook(path, np.eye(9, dtype="c8"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     path.read_bytes()[1:4]
    b'PNG'
    """
    placed(image, transform, crs)
    mean, factor = shrink(image, PICTURE_DOTS)
    decibel, top_db = below_peak(mean)
    rows, columns = (factor * size for size in mean.shape)  # the last groups may extend beyond the image
    north, west = transform.f, transform.c
    with matplotlib.style.context("default"):
        layout = MapLayout.for_bounds(
            array_bounds(*image.shape, transform), local=CRS.from_user_input(crs).is_engineering
        )
        picture = layout.axes.imshow(
            np.ma.masked_invalid(decibel),
            extent=(west, west + columns * transform.a, north + rows * transform.e, north),
            cmap="inferno",
            vmin=top_db - dynamic_range_db,
            vmax=top_db,
            interpolation="nearest",
        )
        layout.draw_frame(crs_name(crs))
        averaged = f"\nmean of {factor} × {factor} pixels" if factor > 1 else ""
        beyond = "both" if top_db else "min"  # no value exceeds the peak, 0 dB
        layout.draw_colour_bar(picture, f"power re peak, dB{averaged}", beyond=beyond)
        layout.draw_scale_and_north()
        layout.draw_markers(markers)
        if not np.isfinite(decibel).any():
            layout.axes.text(
                0.5, 0.5, "no power in any pixel", transform=layout.axes.transAxes, ha="center", va="center"
            )
        layout.write_words(title, subtitle, footer(tags))
        if "APERTURA_FLAGS" in tags:
            layout.write_flags(list(json.loads(tags["APERTURA_FLAGS"])))
        with replacement(path) as temporary:
            layout.figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def crs_name(crs: str) -> str:
    """Return the common name of a coordinate reference system.

    Examples
    --------
    >>> crs_name("EPSG:32632")
    'WGS 84 / UTM zone 32N'
    """
    parsed_crs = CRS.from_user_input(crs)
    return parsed_crs.name + (" (local frame, not georeferenced)" if parsed_crs.is_engineering else "")


def footer(tags: Mapping[str, str]) -> str:
    """Format the footer of a plot: version, focus, numerical error and code hash, if present in the tags.

    Examples
    --------
    >>> footer({"APERTURA_VERSION": "1.0", "APERTURA_CODE_SHA256": "0123456789abcdef"})
    'apertura 1.0 · code 0123456789ab'
    """
    templates = (
        ("APERTURA_VERSION", "apertura {}"),
        ("APERTURA_ERROR_DB", "numerical error below {} dB"),
        ("APERTURA_LOOK_SIDE", "looks {}"),
        ("APERTURA_CODE_SHA256", "code {:.12}"),
    )
    parts = [template.format(tags[tag].replace("-", "−")) for tag, template in templates if tag in tags]
    return " · ".join([*parts[:1], *_focus_words(tags), *parts[1:]])


def _focus_words(tags: Mapping[str, str]) -> list[str]:
    """Format focus, measured peak loss, and geolocation uncertainty if it exceeds a resolution cell.

    Examples
    --------
    >>> focus = {"verdict": "focused", "loss_db": -0.04, "cell_m": 0.1, "expected_shift_m": 1.24}
    >>> _focus_words({"APERTURA_FOCUS": json.dumps(focus)})
    ['focus: focused (peak loss 0.0 dB)', 'geolocation uncertainty 1.2 m']
    """
    if "APERTURA_FOCUS" not in tags:
        return []
    focus = json.loads(tags["APERTURA_FOCUS"])
    loss = f" (peak loss {abs(focus['loss_db']):.1f} dB)" if "loss_db" in focus else ""
    shift_m = focus.get("expected_shift_m", 0.0)
    geolocation = [f"geolocation uncertainty {shift_m:.2g} m"] if shift_m > focus.get("cell_m", 0.0) else []
    return [f"focus: {focus['verdict']}{loss}", *geolocation]


def shrink(image: NorthUpRaster, most: int) -> tuple[NDArray[np.float64], int]:
    """Average the power of square groups of pixels, so that neither side has more than `most` groups.

    Parameters
    ----------
    image
        (y, x) complex64; NaN pixels are ignored.
    most
        Maximum number of groups along the longer side.

    Returns
    -------
    mean
        (rows, columns) float64 power, NaN where a group has no valid pixel.
    factor
        Pixels along a side of a group.

    Examples
    --------
    >>> shrink(np.array([[2, 0, 1], [0, 0, np.nan]], "c8"), 2)
    (array([[1., 1.]]), 2)
    """
    height, width = image.shape
    factor = ceil(max(height, width) / most)
    mean = np.full((ceil(height / factor), ceil(width / factor)), np.nan)
    step = max(1, READ // factor)  # pixel groups along a side of a block in memory
    for row in range(0, mean.shape[0], step):
        for column in range(0, mean.shape[1], step):
            groups = slice(row, row + step), slice(column, column + step)
            rows, columns = (slice(part.start * factor, part.stop * factor) for part in groups)
            mean[groups] = _mean_of_groups(power(np.asarray(image[rows, columns])), factor)
    return mean, factor


def _mean_of_groups(linear: NDArray[np.float32], factor: int) -> NDArray[np.float64]:
    missing = [(0, -size % factor) for size in linear.shape]
    padded = np.pad(linear.astype(np.float64), missing, constant_values=np.nan)
    groups = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    valid = np.isfinite(groups).sum(axis=(1, 3))
    return np.where(valid, np.nansum(groups, axis=(1, 3)) / np.maximum(valid, 1), np.nan)


def below_peak(mean: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Convert power to dB relative to its peak, and return it with the upper limit of the colour scale.

    Parameters
    ----------
    mean
        (rows, columns) float64 power, NaN where no image is formed.

    Returns
    -------
    decibel
        (rows, columns) float64 dB, NaN where power is not positive.
    top_db
        0, or a negative value if only outliers exceed it.

    Notes
    -----
    Source: docs/theory/export.md, "Colour range of a quicklook".

    Examples
    --------
    >>> below_peak(np.array([[1.0, 0.5], [0.25, 0.125]]))[1]
    0.0
    """
    decibel = decibels(mean)
    brightest = np.sort(decibel[np.isfinite(decibel)])[-4:]
    if not brightest.size:
        return decibel, 0.0
    decibel -= brightest[-1]
    fourth = float(brightest[0] - brightest[-1])  # a target covers several displayed pixels, an outlier possibly one
    return decibel, 0.0 if fourth > -20 else 5.0 * ceil(fourth / 5)
