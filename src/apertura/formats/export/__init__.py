"""Files for other programs: one module per format, one row per file.

A row states the file's name, its source raster and the function that writes it. Rows drive the rules of the workflow,
the steps and the tests; nothing else names a product. To add one, write a function such as
`apertura.formats.export.cog.write_power` and add its row to `EXPORTS`; or, from another package, register an `Export`
as entry point of group ``apertura.exports``. Importing this module imports no format.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any

from apertura.common.lazy import Lazy, module_of, name_of
from apertura.common.provenance import canonical_json
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
}
"""Raster that a file may be written from → kind of folder the file lies in.

Those of radiometry lie beside layers where a pair is calibrated: complex, of the power that they are named after; those
of multilook, where they are asked for: mean power of squares of pixels, real, on a coarser grid; ``multilook_noise`` is
the mean power of the noise in those of the echoes, where it is subtracted.
``image`` is a pair's, complex; ``coherent`` the complex and ``noncoherent`` the power sum of a flight's pairs, as a
complex amplitude without phase, ``magnitude`` the sum of their magnitudes; layers explain a pair's image, real, and
lie beside it; those of an interferogram are of two images, ``panels`` all of them by name.
"""


@dataclass(frozen=True)
class Export:
    """A product: one row of the table.

    Attributes
    ----------
    file
        Its name in the folder of the pair or of the fused images.
    source
        A key of `SOURCES`.
    write
        Writes the file, as ``write(path, raster, transform=…, crs=…, tags=…, title=…)``; see
        `apertura.formats.export.cog.write_slc`.
    pictured
        Whether the workflow's report shows it.
    opened
        What the summary says beside its name, how to open it; empty: the summary does not name it.
    mosaicked
        Whether the rasters of all flights are mosaicked: GDAL cannot mosaic complex ones.
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
        """True if it is the style in which QGIS shows the raster of its name."""
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
        opened="with the quality of the image",
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
        opened="with the quality of the image",
    ),
    Export("noncoherent_power.tif", "noncoherent", _WRITERS.cog.write_power),
    Export("noncoherent_power.qml", "noncoherent", _WRITERS.style.write_linear_style),
    Export(
        "noncoherent_db.tif",
        "noncoherent",
        _WRITERS.db.write_db,
        opened="in a GIS, the incoherent sum",
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
        opened="in a GIS, with its deviation beside it",
    ),
    Export("height.qml", "height", _WRITERS.style.write_layer_style),
    Export("height_std.tif", "height_std", _WRITERS.interferogram.write_height_std),
    Export("height_std.qml", "height_std", _WRITERS.style.write_layer_style),
    Export("quicklook.png", "panels", _WRITERS.interferogram.write_panels, pictured=True),
    *_ADDED,
)
"""Every product of a pair or of a flight's sums, in the order in which they are written."""

_OPTIONAL = ("radiometry", "multilook", "multilook_fused")  # kinds of which those rows are written that are asked for

PHASE_HISTORY = "phase_history.cphd"
"""Transfer functions of a pair; as large as its echo, and so written for those who ask for it."""

COVERAGE = ("coverage.png", "coverage.geojson")
"""What shows the whole campaign."""

MOSAICS = "mosaic"
"""Folder of the rasters of all flights."""

LOOK = "look"
"""Folder of what `apertura look` shows, laid out like the results."""

MAP = "map/map.json"
"""What `apertura map` shows of all of them in a browser."""


def exports_in(folder: str) -> Iterator[Export]:
    """Yield the rows of a kind: ``pair``, ``fused``, ``layers`` or ``interferogram``.

    Examples
    --------
    >>> [export.file for export in exports_in("layers")][:4]
    ['incidence.tif', 'incidence.qml', 'bistatic_angle.tif', 'bistatic_angle.qml']
    """
    return (export for export in EXPORTS if SOURCES[export.source] == folder)


def added_exports(folder: str) -> list[Export]:
    """Return the rows of a kind that other packages add."""
    return [export for export in _ADDED if SOURCES[export.source] == folder]


def product(source: str, function: str) -> Export:
    """Return the row of the file that a function writes from a source.

    Examples
    --------
    >>> product("coherent", "write_slc").file
    'coherent_slc.tif'
    """
    return next(row for row in EXPORTS if row.source == source and name_of(row.write) == function)


def export_modules(folder: str) -> list[str]:
    """Return the modules that write the files of a kind of folder: code whose change makes them again.

    Examples
    --------
    >>> export_modules("layers")
    ['apertura.formats.export.layers', 'apertura.formats.export.style']
    """
    return sorted({export.module for export in exports_in(folder)})


def mosaics(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return the rasters of all flights, relative to `MOSAICS` → what they are made of, relative to the results.

    Images of one pair, or the sums of a flight: others are taken from other places, or mean something else.

    Parameters
    ----------
    images
        Flight → its images, as `product_files`; the lowest flight first.
    coefficients
        Sources of kinds ``radiometry`` and ``multilook`` that are written.

    Examples
    --------
    >>> mosaics({"f01": ["a-b"], "f02": ["a-a", "a-b"]})["a-b/db.vrt"]
    ['f01/a-b/db.tif', 'f02/a-b/db.tif']
    """
    found: dict[str, list[str]] = {}
    for flight, folders in images.items():
        for folder in folders:
            for row in _written(folder, coefficients):
                if row.mosaicked and row.file.endswith(".tif"):
                    name = f"{folder}/{row.file.removesuffix('.tif')}.vrt"
                    found.setdefault(name, []).append(f"{flight}/{folder}/{row.file}")
    return found


def mosaic_files(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> Iterator[str]:
    """Yield the rasters of all flights and their styles, relative to the results; as `mosaics`."""
    styles = {row.file for row in EXPORTS if row.style}
    for name in mosaics(images, coefficients):
        style = f"{name.removesuffix('.vrt')}.qml"
        yield from (f"{MOSAICS}/{file}" for file in (name, style) if file == name or Path(file).name in styles)


def _written(image: str, coefficients: Sequence[str]) -> Iterator[Export]:
    """Yield the rows of the files in the folder of an image, of optional ones those of the coefficients written."""
    kinds = ("fused", "multilook_fused") if image == "fused" else ("pair", "layers", "radiometry", "multilook")
    rows = (row for kind in kinds for row in exports_in(kind))
    return (row for row in rows if SOURCES[row.source] not in _OPTIONAL or row.source in coefficients)


def product_files(images: Mapping[str, Sequence[str]], coefficients: Sequence[str] = ()) -> Iterator[str]:
    """Yield every file that a finished campaign offers its user, relative to the results.

    Parameters
    ----------
    images
        Flight → its images: pairs, and 'fused' where there are sums of them.
    coefficients
        As of `mosaics`.

    Examples
    --------
    >>> list(product_files({"f01": ["a-b"]}))[2:5]
    ['f01/a-b/slc.tif', 'f01/a-b/power.tif', 'f01/a-b/power.qml']
    """
    yield from COVERAGE
    for flight, folders in images.items():
        for folder in folders:
            files = [row.file for row in _written(folder, coefficients)]
            yield from (f"{flight}/{folder}/{file}" for file in (*files, "image.json"))
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
    """Write every file of a kind of folder; return their paths.

    Parameters
    ----------
    kind
        A value of `SOURCES`.
    folder
        Where they go.
    rasters, titles
        Source → (y, x) raster on the campaign's grid, and its title; of ``radiometry`` and ``multilook`` those
        that are asked for.
    tags
        Of every file, name → text.
    radiometry
        Source → `apertura.formats.export.radiometry.Radiometry.report`, of images.
    **shared
        ``transform`` and ``crs``, as `apertura.formats.export.cog.write_slc` takes them.
    """
    written = []
    for export in exports_in(kind):
        path, source = folder / export.file, export.source
        if kind in _OPTIONAL and source not in rasters:
            continue
        means = {TAG: canonical_json(radiometry[source])} if source in radiometry else {}
        export.write(path, rasters[source], title=titles[source], tags={**tags, **means}, **shared)
        written.append(path)
    return written


def remove_outdated(folder: Path, written: Collection[Path]) -> None:
    """Remove optional rasters and cross-sections that an earlier run wrote into a folder and this one did not."""
    rows = [row.file for kind in _OPTIONAL for row in exports_in(kind)]
    mosaicked = [f"{name.removesuffix('.tif')}.vrt" for name in rows if name.endswith(".tif")]
    for name in (*rows, *mosaicked, CROSS_SECTIONS):
        if folder / name not in written:
            (folder / name).unlink(missing_ok=True)
