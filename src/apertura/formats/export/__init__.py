"""Table of export products for other programs: one module per format, one row per file.

A row contains the name of a file, its source raster and the function that writes the file. Workflow rules, steps and
tests are derived from these rows. To add a product, write a function such as `apertura.formats.export.cog.write_power`
and add a row to `EXPORTS`; or, from another package, register an `Export` as an entry point of the group
``apertura.exports``. Importing this module does not import the modules of the formats.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any

from apertura.common.lazy import Lazy, module_of, name_of
from apertura.common.provenance import canonical_json
from apertura.formats.catalog import DOCUMENTS
from apertura.formats.export.radiometry import CROSS_SECTIONS, TAG

SOURCES: Mapping[str, str] = {
    "image": "pair",
    "coherent": "fused",
    "noncoherent": "fused",
    "magnitude": "fused",
    "incidence": "layers",
    "bistatic_angle": "layers",
    "mask": "layers",
    "looks": "layers",
    "nesz": "layers",
    "sigma0": "radiometry",
    "gamma0": "radiometry",
    "beta0": "radiometry",
    "scattering_area": "radiometry",
    "gamma_sigma_ratio": "radiometry",
    "ellipsoidal_incidence": "radiometry",
    "multilook": "multilook",
    "multilook_sigma0": "multilook",
    "multilook_gamma0": "multilook",
    "multilook_beta0": "multilook",
    "multilook_noise": "multilook",
    "multilook_coherent": "multilook_fused",
    "multilook_noncoherent": "multilook_fused",
    "phase": "interferogram",
    "coherence": "interferogram",
    "unwrapped": "interferogram",
    "height": "interferogram",
    "height_std": "interferogram",
    "panels": "interferogram",
    "stack_image": "stack",
    "flattened_phase": "stack",
    "residual_phase": "stack",
    "stack_coherence": "stack",
    "expected_coherence": "stack",
    "line_of_sight": "stack",
    "slant_range": "stack",
    "amplitude_ratio": "change",
    "coherence_loss": "change",
    "change": "change",
    "change_regions": "change",
    "change_panels": "change",
}
"""Source raster of a file → kind of folder that contains the file.

``image`` is the complex image of a pair. ``coherent`` is the complex sum of a flight's pairs, and ``noncoherent`` their
power sum, stored as complex amplitude without phase. ``magnitude`` is the sum of the magnitudes of the pairs. Layers
are real rasters that describe the image of a pair, and are stored in the folder of that image. Rasters of radiometry
exist for calibrated pairs, in the same folder; their values are complex amplitudes whose power is the named
coefficient. With gamma0, they include the ratios of the areas to which the coefficients are normalised, and the
incidence angle from the vertical. Rasters of multilook exist if requested; their values are the mean power of square
blocks of pixels, on a coarser grid. ``multilook_noise`` is the mean noise power that is subtracted from the echo power.
Rasters of an interferogram are computed from two images; ``panels`` is a mapping from their names to these rasters.
``stack_image`` is the complex image of a flight of the stack without the residual phase; the other rasters of the stack
are that phase, the measured and the expected coherence with the reference flight, and the geometry at closest approach,
whose last axis contains components. Rasters of a change are computed from an image of the stack and the reference;
``change_regions`` are polygons, ``change_panels`` is a mapping from the names of the rasters to the rasters.
"""


@dataclass(frozen=True)
class Export:
    """Product: one row of the table.

    Attributes
    ----------
    file
        Name in the folder of the pair or of the fused images.
    source
        A key of `SOURCES`.
    write
        Function that writes the file, ``write(path, raster, transform=…, crs=…, tags=…, title=…)``; see
        `apertura.formats.export.cog.write_slc`.
    pictured
        True if the workflow report shows the file.
    opened
        Hint on opening the file, printed in the summary; empty: the file is not listed in the summary.
    mosaicked
        True if the rasters of all flights are mosaicked; GDAL cannot mosaic complex rasters.
    """

    file: str
    source: str
    write: Callable[..., None]
    pictured: bool = False
    mosaicked: bool = True
    opened: str = ""

    @property
    def module(self) -> str:
        """Dotted name of the module that writes the file."""
        return module_of(self.write)

    @property
    def style(self) -> bool:
        """True if the file is the QGIS style of the raster with the same name."""
        return self.module == "apertura.formats.export.style"


_WRITERS = Lazy("apertura.formats.export")

_ADDED: tuple[Export, ...] = tuple(point.load() for point in entry_points(group="apertura.exports"))

EXPORTS: tuple[Export, ...] = (
    Export("slc.tif", "image", _WRITERS.cog.write_slc, mosaicked=False),
    Export("power.tif", "image", _WRITERS.cog.write_power),
    Export("power.qml", "image", _WRITERS.style.write_linear_style),
    Export("db.tif", "image", _WRITERS.db.write_db, opened="in a GIS"),
    Export("db.qml", "image", _WRITERS.style.write_db_style),
    Export(
        "quicklook.png",
        "image",
        _WRITERS.quicklook.write_quicklook,
        pictured=True,
        opened="image with quality information",
    ),
    Export("coherent_slc.tif", "coherent", _WRITERS.cog.write_slc, mosaicked=False),
    Export("coherent_power.tif", "coherent", _WRITERS.cog.write_power),
    Export("coherent_power.qml", "coherent", _WRITERS.style.write_linear_style),
    Export("coherent_db.tif", "coherent", _WRITERS.db.write_db, opened="in a GIS"),
    Export("coherent_db.qml", "coherent", _WRITERS.style.write_db_style),
    Export(
        "quicklook.png",
        "coherent",
        _WRITERS.quicklook.write_quicklook,
        pictured=True,
        opened="image with quality information",
    ),
    Export("noncoherent_power.tif", "noncoherent", _WRITERS.cog.write_power),
    Export("noncoherent_power.qml", "noncoherent", _WRITERS.style.write_linear_style),
    Export(
        "noncoherent_db.tif",
        "noncoherent",
        _WRITERS.db.write_db,
        opened="in a GIS (noncoherent sum)",
    ),
    Export("noncoherent_db.qml", "noncoherent", _WRITERS.style.write_db_style),
    Export("noncoherent_magnitude.tif", "magnitude", _WRITERS.cog.write_magnitude),
    Export("noncoherent_magnitude.qml", "magnitude", _WRITERS.style.write_linear_style),
    Export("incidence.tif", "incidence", _WRITERS.layers.write_incidence),
    Export("incidence.qml", "incidence", _WRITERS.style.write_layer_style),
    Export("bistatic_angle.tif", "bistatic_angle", _WRITERS.layers.write_bistatic_angle),
    Export("bistatic_angle.qml", "bistatic_angle", _WRITERS.style.write_layer_style),
    Export("mask.tif", "mask", _WRITERS.layers.write_mask),
    Export("mask.qml", "mask", _WRITERS.style.write_mask_style),
    Export("looks.tif", "looks", _WRITERS.layers.write_looks),
    Export("looks.qml", "looks", _WRITERS.style.write_layer_style),
    Export("nesz.tif", "nesz", _WRITERS.layers.write_nesz),
    Export("nesz.qml", "nesz", _WRITERS.style.write_layer_style),
    Export("sigma0_db.tif", "sigma0", _WRITERS.db.write_db),
    Export("sigma0_db.qml", "sigma0", _WRITERS.style.write_backscatter_style),
    Export("gamma0_db.tif", "gamma0", _WRITERS.db.write_db),
    Export("gamma0_db.qml", "gamma0", _WRITERS.style.write_backscatter_style),
    Export("gamma0_power.tif", "gamma0", _WRITERS.cog.write_power),
    Export("gamma0_power.qml", "gamma0", _WRITERS.style.write_linear_style),
    Export("gamma0_slc.tif", "gamma0", _WRITERS.cog.write_slc, mosaicked=False),
    Export("scattering_area.tif", "scattering_area", _WRITERS.layers.write_scattering_area),
    Export("scattering_area.qml", "scattering_area", _WRITERS.style.write_layer_style),
    Export("gamma_sigma_ratio.tif", "gamma_sigma_ratio", _WRITERS.layers.write_gamma_sigma_ratio),
    Export("gamma_sigma_ratio.qml", "gamma_sigma_ratio", _WRITERS.style.write_layer_style),
    Export("ellipsoidal_incidence.tif", "ellipsoidal_incidence", _WRITERS.layers.write_ellipsoidal_incidence),
    Export("ellipsoidal_incidence.qml", "ellipsoidal_incidence", _WRITERS.style.write_layer_style),
    Export("beta0_db.tif", "beta0", _WRITERS.db.write_db),
    Export("beta0_db.qml", "beta0", _WRITERS.style.write_backscatter_style),
    *(
        Export(f"{source}{end}", source, write)
        for source in (source for source, kind in SOURCES.items() if kind.startswith("multilook"))
        for end, write in (
            ("_power.tif", _WRITERS.cog.write_mean_power),
            ("_power.qml", _WRITERS.style.write_linear_style),
            ("_db.tif", _WRITERS.db.write_mean_db),
            ("_db.qml", _WRITERS.style.write_backscatter_style),
        )
    ),
    Export("phase.tif", "phase", _WRITERS.interferogram.write_phase),
    Export("phase.qml", "phase", _WRITERS.style.write_layer_style),
    Export("coherence.tif", "coherence", _WRITERS.interferogram.write_coherence),
    Export("coherence.qml", "coherence", _WRITERS.style.write_layer_style),
    Export("unwrapped.tif", "unwrapped", _WRITERS.interferogram.write_unwrapped),
    Export("unwrapped.qml", "unwrapped", _WRITERS.style.write_layer_style),
    Export(
        "height.tif",
        "height",
        _WRITERS.interferogram.write_height,
        opened="in a GIS, with the standard deviation in height_std.tif",
    ),
    Export("height.qml", "height", _WRITERS.style.write_layer_style),
    Export("height_std.tif", "height_std", _WRITERS.interferogram.write_height_std),
    Export("height_std.qml", "height_std", _WRITERS.style.write_layer_style),
    Export("quicklook.png", "panels", _WRITERS.interferogram.write_panels, pictured=True),
    Export("slc.tif", "stack_image", _WRITERS.cog.write_slc, mosaicked=False),
    Export("phase_flattened.tif", "flattened_phase", _WRITERS.stack.write_flattened_phase),
    Export("phase_flattened.qml", "flattened_phase", _WRITERS.style.write_layer_style),
    Export("residual_phase.tif", "residual_phase", _WRITERS.stack.write_residual_phase),
    Export("residual_phase.qml", "residual_phase", _WRITERS.style.write_layer_style),
    Export("coherence.tif", "stack_coherence", _WRITERS.stack.write_stack_coherence),
    Export("coherence.qml", "stack_coherence", _WRITERS.style.write_layer_style),
    Export("expected_coherence.tif", "expected_coherence", _WRITERS.stack.write_expected_coherence),
    Export("expected_coherence.qml", "expected_coherence", _WRITERS.style.write_layer_style),
    Export("line_of_sight_enu.tif", "line_of_sight", _WRITERS.layers.write_line_of_sight, mosaicked=False),
    Export("slant_range_distance.tif", "slant_range", _WRITERS.layers.write_slant_range, mosaicked=False),
    Export("amplitude_ratio.tif", "amplitude_ratio", _WRITERS.change.write_amplitude_ratio),
    Export("amplitude_ratio.qml", "amplitude_ratio", _WRITERS.style.write_ratio_style),
    Export("coherence_loss.tif", "coherence_loss", _WRITERS.change.write_coherence_loss),
    Export("coherence_loss.qml", "coherence_loss", _WRITERS.style.write_layer_style),
    Export("change.tif", "change", _WRITERS.change.write_change),
    Export("change.qml", "change", _WRITERS.style.write_change_style),
    Export("change_regions.gpkg", "change_regions", _WRITERS.change.write_regions, opened="changes, in a GIS"),
    Export("change.png", "change_panels", _WRITERS.change_picture.write_change_panels, pictured=True),
    *_ADDED,
)
"""All products of a pair or of a flight's sums, in the order in which they are written."""

_OPTIONAL = ("radiometry", "multilook", "multilook_fused")  # kinds whose files are written only if requested

PHASE_HISTORY = "phase_history.cphd"
"""Product with the transfer functions of a pair; written only if requested, because it is as large as the echo."""

COVERAGE = ("coverage.png", "coverage.geojson")
"""Plot and GeoJSON file of the coverage of the whole campaign."""

MOSAICS = "mosaic"
"""Folder of the mosaics of all flights."""

PREVIEW = "preview"
"""Folder of the images of `apertura preview`, with the layout of the results."""

MAP = "map/map.json"
"""Description of the web map of `apertura map`."""


def exports_in(folder: str) -> Iterator[Export]:
    """Yield the rows of a kind: ``pair``, ``fused``, ``layers``, ``interferogram``, ``stack`` or ``change``.

    Examples
    --------
    >>> [export.file for export in exports_in("layers")][:4]
    ['incidence.tif', 'incidence.qml', 'bistatic_angle.tif', 'bistatic_angle.qml']
    """
    return (export for export in EXPORTS if SOURCES[export.source] == folder)


def added_exports(folder: str) -> list[Export]:
    """Return the rows of a kind that are registered by other packages."""
    return [export for export in _ADDED if SOURCES[export.source] == folder]


def product(source: str, function: str) -> Export:
    """Return the row of the file that a function writes from a source raster.

    Examples
    --------
    >>> product("coherent", "write_slc").file
    'coherent_slc.tif'
    """
    return next(row for row in EXPORTS if row.source == source and name_of(row.write) == function)


def export_modules(folder: str) -> list[str]:
    """List the modules that write the files of a kind of folder; if their code changes, the files are out of date.

    Examples
    --------
    >>> export_modules("layers")
    ['apertura.formats.export.layers', 'apertura.formats.export.style']
    """
    return sorted({export.module for export in exports_in(folder)})


def mosaics(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return the mosaics of all flights: path relative to `MOSAICS` → source rasters, relative to the results.

    Only images of the same pair, or the same sums of flights, are combined; other images differ in view geometry or
    meaning.

    Parameters
    ----------
    images
        Flight → its images, as in `product_files`; the bottom flight of the mosaic first.
    coefficients
        Sources of kinds ``radiometry`` and ``multilook`` that are written.

    Examples
    --------
    >>> mosaics({"f01": ["a-b"], "f02": ["a-a", "a-b"]})["a-b/db.vrt"]
    ['f01/a-b/db.tif', 'f02/a-b/db.tif']
    """
    sources: dict[str, list[str]] = {}
    for flight, folders in images.items():
        for folder in folders:
            for row in _written(folder, coefficients):
                if row.mosaicked and row.file.endswith(".tif"):
                    name = f"{folder}/{row.file.removesuffix('.tif')}.vrt"
                    sources.setdefault(name, []).append(f"{flight}/{folder}/{row.file}")
    return sources


def mosaic_files(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> Iterator[str]:
    """Yield the paths of the mosaics and their styles, relative to the results; for the parameters see `mosaics`."""
    styles = {row.file for row in EXPORTS if row.style}
    for name in mosaics(images, coefficients):
        style = f"{name.removesuffix('.vrt')}.qml"
        yield from (f"{MOSAICS}/{file}" for file in (name, style) if file == name or Path(file).name in styles)


def _written(image: str, coefficients: Sequence[str]) -> Iterator[Export]:
    """Yield the rows of the files in the folder of an image; for optional kinds, only the rows of `coefficients`."""
    kinds = ("fused", "multilook_fused") if image == "fused" else ("pair", "layers", "radiometry", "multilook")
    rows = (row for kind in kinds for row in exports_in(kind))
    return (row for row in rows if SOURCES[row.source] not in _OPTIONAL or row.source in coefficients)


def product_files(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> Iterator[str]:
    """Yield the paths of all products of a finished campaign, relative to the results.

    Parameters
    ----------
    images
        Flight → its images: pairs, and 'fused' if there are sums of pairs.
    coefficients
        See `mosaics`.

    Examples
    --------
    >>> list(product_files({"f01": ["a-b"]}))[2:5]
    ['f01/a-b/slc.tif', 'f01/a-b/power.tif', 'f01/a-b/power.qml']
    """
    yield from COVERAGE
    for flight, folders in images.items():
        for folder in folders:
            files = [row.file for row in _written(folder, coefficients)]
            yield from (f"{flight}/{folder}/{file}" for file in (*files, *DOCUMENTS))
    yield from mosaic_files(images, coefficients)
    yield MAP


def write_exports(
    kind: str,
    folder: Path,
    rasters: Mapping[str, Any],
    *,
    titles: Mapping[str, str],
    tags: Mapping[str, str],
    radiometry: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
    **shared: Any,
) -> list[Path]:
    """Write all files of a kind of folder; return their paths.

    Parameters
    ----------
    kind
        A value of `SOURCES`.
    folder
        Output folder.
    rasters, titles
        Source → (y, x) raster on the campaign's grid, and its title; for kinds ``radiometry`` and ``multilook``, only
        the requested sources.
    tags
        Tags of every file, name → text.
    radiometry
        Source → `apertura.formats.export.radiometry.Radiometry.report`, for images.
    **shared
        ``transform`` and ``crs``, see `apertura.formats.export.cog.write_slc`.
    """
    written = []
    for export in exports_in(kind):
        path, source = folder / export.file, export.source
        if kind in _OPTIONAL and source not in rasters:
            continue
        radiometry_tag = {TAG: canonical_json(radiometry[source])} if source in radiometry else {}
        export.write(path, rasters[source], title=titles[source], tags={**tags, **radiometry_tag}, **shared)
        written.append(path)
    return written


def remove_outdated(folder: Path, written: Collection[Path]) -> None:
    """Remove optional rasters and cross-sections from a folder if they are left from an earlier run."""
    rows = [row.file for kind in _OPTIONAL for row in exports_in(kind)]
    mosaicked = [f"{name.removesuffix('.tif')}.vrt" for name in rows if name.endswith(".tif")]
    for name in (*rows, *mosaicked, CROSS_SECTIONS):
        if folder / name not in written:
            (folder / name).unlink(missing_ok=True)
