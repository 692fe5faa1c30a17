"""`apertura diff` and `apertura reproduce`: compare two products, or a product with its recomputation."""

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of, shown
from apertura.common.processes import holder
from apertura.common.raster import opened_raster
from apertura.formats.export.writing import blocks_of
from apertura.run.driver import run_workflow
from apertura.views.verify.chain import HASH, shortened
from apertura.views.verify.products import EXPECTED, REMEDY, SECTIONS, as_product, find_product, picture, sections_of
from apertura.workflow.lineage import on_demand, results_of, with_inputs

Pixels = NDArray[Any]

_LINES = 20
_VALUE = 60
_READ_BYTES = 1 << 20


@dataclass
class Tally:
    """Statistics of the differences between two arrays, accumulated block by block.

    Attributes
    ----------
    compared
        Number of values that are finite in both arrays.
    only
        Numbers of values that are finite in the first array only and in the second array only.
    differing
        Number of values that differ, including values that are finite in only one array.
    largest, square
        Largest magnitude of the differences, and sum of their squared magnitudes.
    peak
        Largest magnitude in both arrays.
    phased
        True if values are complex.

    Examples
    --------
    >>> tally = Tally.of([(np.array([1.0, 2.0, np.nan]), np.array([1.0, 2.5, 0.0]))])
    >>> tally.compared, tally.only, tally.differing, tally.largest, tally.rms
    (2, (0, 1), 2, 0.5, 0.3535533905932738)
    """

    compared: int = 0
    only: tuple[int, int] = (0, 0)
    differing: int = 0
    largest: float = 0.0
    square: float = 0.0
    peak: float = 0.0
    phased: bool = False
    _about: float = 0.0
    _sums: Any = None

    @classmethod
    def of(cls, blocks: Iterable[tuple[Pixels, Pixels]]) -> "Tally":
        """Return the statistics of pairs of real or complex blocks; the blocks of a pair have equal shape."""
        tally = cls()
        for first, second in blocks:
            tally.add(np.asarray(first), np.asarray(second))
        return tally

    def add(self, first: Pixels, second: Pixels) -> None:
        """Add a block of either array."""
        valid = np.isfinite(first), np.isfinite(second)
        lacking = int((valid[0] & ~valid[1]).sum()), int((valid[1] & ~valid[0]).sum())
        self.only = self.only[0] + lacking[0], self.only[1] + lacking[1]
        self.phased = np.iscomplexobj(first) or np.iscomplexobj(second)
        wide = np.complex128 if self.phased else np.float64
        a, b = (values[valid[0] & valid[1]].astype(wide) for values in (first, second))
        difference = np.abs(a - b)
        self.differing += int(np.count_nonzero(difference)) + sum(lacking)
        if not a.size:
            return
        self.compared += a.size
        self.largest = max(self.largest, float(difference.max()))
        self.square += float((difference**2).sum())
        self.peak = max(self.peak, float(np.abs(a).max()), float(np.abs(b).max()))
        if self._sums is None:  # sums relative to a real value, so that subtraction of the mean loses no digits
            self._sums, self._about = np.zeros(5, complex), 0.0 if self.phased else float(a[0])
        a, b = a - self._about, b - self._about
        self._sums += [a.sum(), b.sum(), np.vdot(a, a), np.vdot(b, b), np.vdot(b, a)]

    @property
    def rms(self) -> float:
        """RMS of the differences; 0 if no value is finite in both arrays."""
        return float(np.sqrt(self.square / self.compared)) if self.compared else 0.0

    @property
    def alike(self) -> float:
        """Coherence |Σ a b*| / √(Σ|a|² Σ|b|²) of complex values, or correlation of real values; NaN if undefined."""
        if self._sums is None:
            return float("nan")
        sum_a, sum_b, aa, bb, ab = self._sums
        if not self.phased:
            aa, bb, ab = (
                product - left * right / self.compared
                for product, left, right in ((aa, sum_a, sum_a), (bb, sum_b, sum_b), (ab, sum_a, sum_b))
            )
        scale = np.sqrt(max(aa.real, 0.0) * max(bb.real, 0.0))
        return float((abs(ab) if self.phased else ab.real) / scale) if scale > 0 else float("nan")


def rows_of(shape: tuple[int, ...], itemsize: int, *, block_bytes: int = 1 << 24) -> Iterator[slice]:
    """Yield slices of rows of an array; each slice has at most `block_bytes`, or is a single row.

    Examples
    --------
    >>> list(rows_of((5, 1000), 8, block_bytes=16_000))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    step = max(1, block_bytes // max(1, itemsize * int(np.prod(shape[1:], dtype=int))))
    for first in range(0, shape[0], step):
        yield slice(first, min(first + step, shape[0]))


def differences(first: Path, second: Path) -> dict[str, list[str]]:
    """Return section → differences between two products, one line per difference; empty for sections that agree.

    Parameters
    ----------
    first, second
        Rasters, PNG images, stages or other files, both of the same kind, from the same or from different campaigns.

    Raises
    ------
    CampaignError
        If a product is missing or not readable, or if the products are of different kinds.
    """
    first, second = as_product(first), as_product(second)
    for path in (first, second):
        if not path.exists():
            raise CampaignError("no such file or folder", path, EXPECTED, "Correct the path.")
    if first.is_dir() != second.is_dir() or first.suffix != second.suffix:
        found = f"not of the same kind as {first.name}"
        raise CampaignError(found, second, "two products of the same kind", REMEDY)
    sections = sections_of(first), sections_of(second)
    lines: dict[str, list[str]] = {}
    for section in (name for name in SECTIONS if name in sections[0]):
        left, right = (entries.get(section, {}) for entries in sections)
        if bool(left) != bool(right):
            lines[section] = [f"{len(left)} entries → absent" if left else f"absent → {len(right)} entries"]
            continue
        keys = [key for key in sorted({*left, *right}) if left.get(key) != right.get(key)]
        lines[section] = [f"{key}: {_cut(left.get(key))} → {_cut(right.get(key))}" for key in keys]
    if first.is_dir():
        return lines | {"values": list(_stages(first, second))}
    if first.suffix == ".tif":
        lines["pixels"] = list(_rasters(first, second))
    elif first.suffix == ".png":
        images = [np.asarray(picture(path)).astype(np.float32) for path in (first, second)]
        tally = Tally.of([(images[0], images[1])]) if images[0].shape == images[1].shape else None
        lines["pixels"] = list(difference_lines(tally, unit="of 255")) if tally else []  # section geometry lists sizes
    if not any(lines.values()):
        offset = first_difference(first, second)
        lines["bytes"] = [] if offset is None else [f"first difference at byte {offset}"]
    return lines


def _cut(text: str | None) -> str:
    if text is None:
        return "absent"
    return shown(shortened(text) if HASH.fullmatch(text) else text, _VALUE)


def first_difference(first: Path, second: Path) -> int | None:
    """Return the offset of the first byte in which two files differ; None if the files are identical.

    Examples
    --------
    >>> first_difference(Path(__file__), Path(__file__)) is None
    True
    """
    offset = 0
    with first.open("rb") as left_stream, second.open("rb") as right_stream:
        while True:
            left, right = left_stream.read(_READ_BYTES), right_stream.read(_READ_BYTES)
            if left != right:
                pairs = zip(left, right, strict=False)
                return offset + next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(left), len(right)))
            if not left:
                return None
            offset += len(left)


def _rasters(*paths: Path) -> Iterator[str]:
    """Yield lines on the differences between the pixels of two rasters in the overlap of their grids."""
    with ExitStack() as stack:
        first, second = (stack.enter_context(opened_raster(path, expected=EXPECTED, remedy=REMEDY)) for path in paths)
        shift = _shift(first, second)
        if shift is None:
            yield "not compared: CRS or pixel spacing differ, or the grid offset is not an integer number of pixels"
            return
        down, right = shift
        rows = range(max(0, down), min(first.height, second.height + down))
        columns = range(max(0, right), min(first.width, second.width + right))
        if not rows or not columns:
            yield "not compared: the grids do not overlap"
            return
        if (len(rows), len(columns)) != first.shape or first.shape != second.shape:
            yield f"compared in the overlap of the grids, {len(columns)} × {len(rows)} pixels"
        tally = Tally.of(_blocks(first, second, (rows[0], columns[0]), shift, (len(rows), len(columns))))
        yield from difference_lines(tally, unit=first.units[0] or "1", power="power" in (first.descriptions[0] or ""))


def _shift(first: Any, second: Any) -> tuple[int, int] | None:
    """Return the origin of the second raster as row and column of the first; None if the grids are not aligned."""
    a, b = first.transform, second.transform
    if first.crs != second.crs or not np.allclose(a[:2] + a[3:5], b[:2] + b[3:5], rtol=1e-9, atol=0):
        return None
    if a.b or a.d or not a.a or not a.e:
        return None
    right, down = (b.c - a.c) / a.a, (b.f - a.f) / a.e
    if not max(abs(right - round(right)), abs(down - round(down))) < 1e-3:
        return None
    return round(down), round(right)


def _blocks(
    first: Any, second: Any, begin: tuple[int, int], shift: tuple[int, int], shape: tuple[int, int]
) -> Iterator[tuple[Pixels, Pixels]]:
    """Yield the overlap of two rasters in blocks."""
    from rasterio.windows import Window

    for rows, columns in blocks_of(shape):
        top, left = rows.start + begin[0], columns.start + begin[1]
        size = columns.stop - columns.start, rows.stop - rows.start
        window, shifted = Window(left, top, *size), Window(left - shift[1], top - shift[0], *size)
        yield first.read(1, window=window), second.read(1, window=shifted)


def _stages(*folders: Path) -> Iterator[str]:
    """Yield lines on the differences between the arrays of two stages, each with the array name as prefix."""
    first, second = (open_stage(folder, folder.stem) for folder in folders)
    for name in first.variables:
        if (
            name not in second.variables
            or first[name].shape != second[name].shape
            or first[name].dtype.kind not in "fciubM"
        ):
            continue  # reported in section geometry
        tally = Tally.of(_rows(first[name], second[name]))
        yield from (
            f"{name}: {line}" for line in difference_lines(tally, unit=str(first[name].attrs.get("units", "1")))
        )


def _rows(first: Any, second: Any) -> Iterator[tuple[Pixels, Pixels]]:
    if not first.ndim:
        yield tuple(np.atleast_1d(_numbers(array.values)) for array in (first, second))  # type: ignore[misc]
        return
    for rows in rows_of(first.shape, first.dtype.itemsize):
        yield _numbers(first[rows].values), _numbers(second[rows].values)


def _numbers(values: Pixels) -> Pixels:
    """Return values as numbers; times are converted to seconds."""
    return values.astype("M8[ns]").astype(np.int64) / 1e9 if values.dtype.kind == "M" else values


def difference_lines(tally: Tally, *, unit: str = "1", power: bool = False) -> Iterator[str]:
    """Describe the differences between two arrays in up to two lines; no line if the arrays are identical.

    Parameters
    ----------
    tally
        Statistics of the differences.
    unit
        Unit of the values; if the unit is "1", differences are stated in dB relative to the peak.
    power
        True if values are powers, False for amplitudes.

    Examples
    --------
    >>> list(difference_lines(Tally.of([(np.array([1.0, 2.0]), np.array([1.0, 2.002]))])))
    ['1 of 2 values differ: maximum -60.0 dB re peak, rms -63.0 dB re peak; correlation 1.000000']
    """
    if not tally.differing:
        return
    if tally.compared and tally.largest:
        statistics = np.array([tally.largest, tally.rms])
        if unit == "1":
            levels_db = (10 if power else 20) * np.log10(statistics / tally.peak)
            largest, rms = (f"{level:.1f} dB re peak" for level in levels_db)
        else:
            largest, rms = (f"{value:.3g} {unit}" for value in statistics)
        measure = "coherence" if tally.phased else "correlation"
        count = tally.compared + sum(tally.only)
        yield f"{tally.differing} of {count} values differ: maximum {largest}, rms {rms}; {measure} {tally.alike:.6f}"
    if any(tally.only):
        yield f"{tally.only[0]} values are finite only in the first product, {tally.only[1]} only in the second"


def print_differences(first: Path, second: Path, *, whole: bool = False) -> int:
    """Print the differences between two products, one line per difference; return 0 without differences, else 1."""
    sections = differences(first, second)
    for section, lines in sections.items():
        most = len(lines) if whole else _LINES
        for line in lines[:most] or ["same"]:
            print(shown(f"{section:<9}{line}", 400))
        if len(lines) > most:
            print(f"{section:<9}and {len(lines) - most} more (--all prints them)")
    return 1 if any(sections.values()) else 0


_MOST_LINES = 8
_LONGEST = 400


def print_reproduced(path: Path, *, cores: int, keep: Path | None = None) -> int:
    """Recompute a product in another folder and print the differences; the campaign folder is only read.

    Parameters
    ----------
    path
        Absolute path of a file, a stage or a manifest below results/, or of a campaign folder.
    cores
        Number of cores to use.
    keep
        A new folder for the recomputed results, which is kept; None for a temporary folder.

    Returns
    -------
    int
        0 if all bytes are identical, otherwise 1; the exit status of the workflow if the workflow fails.

    Raises
    ------
    CampaignError
        If the path is not a product of the campaign as configured, or if a run of the campaign is in progress.
    """
    product = find_product(path)
    campaign, whole = Campaign.load(product.root), product.file is None
    running = holder(product.root)
    if running is not None:
        found, remedy = f"a run is in progress: {running}", "Wait until the run finishes."
        raise CampaignError(found, product.root, "a campaign without a run in progress", remedy)
    known = [result.manifest for _, result in results_of(campaign)]
    if not whole and product.manifest not in known:
        expected = f"one of the {len(known)} results of the campaign"
        remedy = "Choose a result listed by `apertura list`."
        raise CampaignError("not a result of the campaign as configured", path, expected, remedy)
    requested = [manifest for manifest in known if (product.root / manifest).is_file()] if whole else [product.manifest]
    if not requested:
        raise CampaignError("no results", product.root, "a processed campaign", "Run the workflow: `apertura run`.")
    on_request = [manifest for manifest in requested if on_demand(campaign, manifest)]
    with _scratch(campaign, keep) as again:
        status = run_workflow(again, cores, *(["all", *on_request] if whole else requested))
        if status:
            return status
        lines = _outcome(product.root, again, requested, known)
    for line in lines:
        print(shown(line, _LONGEST))
    if keep is not None:
        print(shown(f"recomputed in {keep}", _LONGEST))
    return 0 if lines[0].startswith("same") else 1


def _outcome(root: Path, again: Path, requested: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return lines on the differences of the requested results and the first differing result, or on the agreement."""
    lines = [line for manifest in requested for line in compared(root, again, manifest)]
    if not lines:
        count, more = sum(len(_files(root, manifest)) for manifest in requested), len(requested) - 1
        others = f" and {more} more results" if more else ""
        return [f"same     {number_of(count, 'file')} of {requested[0]}{others}, identical byte for byte"]
    first = next((manifest for manifest in known if _differs(root, again, manifest)), None)
    if first is None:
        return [*lines, "the manifests agree: a file was changed after the run, see `apertura verify`"]
    return [*lines, f"the first result of the chain that differs is {first}"]


@contextmanager
def _scratch(campaign: Campaign, keep: Path | None) -> Iterator[Path]:
    """Yield a campaign folder with the same inputs and no results."""
    root = campaign.root
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="apertura-reproduce-") as folder:
            yield with_inputs(campaign, Path(folder, root.name), link=True)
        return
    if keep.is_relative_to(root) or keep.is_symlink() or (keep.exists() and not keep.is_dir()):
        found = "a path inside the campaign, a symbolic link, or not a folder"
        raise CampaignError(found, keep, "a new folder outside the campaign", "Specify another folder.")
    if keep.is_dir() and any(keep.iterdir()):
        raise CampaignError("not empty", keep, "a new folder", "Specify another folder; nothing was changed.")
    yield with_inputs(campaign, keep, link=False)


def compared(root: Path, again: Path, manifest: str) -> list[str]:
    """Return the differences between a result and its recomputation, one line per difference.

    Parameters
    ----------
    root, again
        Campaign folders of the result and of the recomputation.
    manifest
        Manifest of the result, relative to both folders.

    Raises
    ------
    CampaignError
        If a manifest is damaged, or names a file outside of its campaign.
    """
    lines = []
    listed = _files(root, manifest), _files(again, manifest)
    for name in [*sorted({*listed[0], *listed[1]}), manifest]:
        folder = "" if name == manifest else f"{manifest.rpartition('/')[0]}/"
        pair = [ConfinedPath.at(where).named(f"{folder}{name}", where=manifest) for where in (root, again)]
        if not all(path.is_file() for path in pair):
            origin = "campaign" if pair[0].is_file() else "recomputed results"
            lines.append(f"missing  {folder}{name}: only in the {origin}")
        elif (offset := first_difference(*pair)) is not None:
            lines.append(f"changed  {folder}{name}: first difference at byte {offset}")
            lines += _differences(*pair) if len(lines) == 1 else []
    return lines


def _differences(path: Path, again: Path) -> Iterator[str]:
    """Yield the output of `apertura diff` for a file and its recomputation."""
    stage = next((folder for folder in path.parents if folder.suffix == ".zarr"), None)
    if stage is not None:
        path, again = stage, again.parents[len(path.relative_to(stage).parts) - 1]
    with suppress(CampaignError):  # a damaged stage cannot be opened
        differing = [(section, line) for section, lines in differences(path, again).items() for line in lines]
        yield from (f"         {section:<9}{line}" for section, line in differing[:_MOST_LINES])
        if len(differing) > _MOST_LINES:
            yield f"         and {len(differing) - _MOST_LINES} more"


def _files(root: Path, manifest: str) -> Mapping[str, str]:
    path = root / manifest
    files: Mapping[str, str] = read_manifest(path)["files"] if path.is_file() else {}
    return files


def _differs(root: Path, again: Path, manifest: str) -> bool:
    pair = root / manifest, again / manifest
    return all(path.is_file() for path in pair) and first_difference(*pair) is not None
