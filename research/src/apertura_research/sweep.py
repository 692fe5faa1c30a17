"""Framework of the sweeps: cases are computed into tables, and tables are drawn as charts and a summary.

A study is divided into parts, each a separate job, and a part into cases. Every file that exists is complete; finished
cases of a killed job are kept next to it, under the hash of the code that computed them.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any, Generic, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.common.arrays import Floats
from apertura.common.provenance import code_sha256
from apertura.common.tables import read_table, write_table
from apertura.tools.chart.pareto import save_png

Row = TypeVar("Row")


@dataclass(frozen=True)
class Study(Generic[Row]):
    """Study: its cases, their computation, and its charts.

    Attributes
    ----------
    row
        Dataclass of a table row, with fields of str, int and float.
    charts
        Chart → parts whose rows it shows.
    cases
        Part → its cases, in order.
    run
        Part and one case of the part → rows; parts depend on the code of the module of this function.
    draw
        Draws a chart: its name, its rows and the path of the PNG.
    summaries
        Names of the files that `summarise` writes.
    summarise
        Writes the summary: rows of all parts, and the folder.
    digits
        Significant digits in the tables of parts; None: all.
    """

    row: type[Row]
    charts: Mapping[str, tuple[str, ...]]
    cases: Callable[[str], Sequence[Any]]
    run: Callable[[str, Any], Iterable[Row]]
    draw: Callable[[str, Sequence[Row], Path], None]
    summaries: tuple[str, ...] = ()
    summarise: Callable[[Sequence[Row], Path], None] = lambda rows, folder: None  # noqa: ARG005
    digits: int | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        """All parts, in the order of the charts."""
        return tuple(dict.fromkeys(part for parts in self.charts.values() for part in parts))

    def rows(self, part: str) -> Iterator[Row]:
        """Compute the rows of a part, case by case, without files."""
        for case in self.cases(part):
            yield from self.run(part, case)

    def compute(self, part: str, folder: Path) -> Path:
        """Write parts/PART.csv; cases that a killed run finished with the same code are not recomputed."""
        path = part_path(folder, part)
        finished = path.with_name(f".{part}.{code_sha256(self.run.__module__)[:12]}")
        rows: list[Row] = []
        for number, case in enumerate(self.cases(part)):
            done = finished / f"{number}.csv"
            if not done.is_file():
                write_table(done, self.run(part, case))
            rows += read_table(done, self.row)
        write_table(path, rows, digits=self.digits)
        for kept in path.parent.glob(f".{part}.*"):
            rmtree(kept)
        return path

    def read(self, folder: Path, parts: Sequence[str]) -> list[Row]:
        """Read the rows of parts from their files.

        Raises
        ------
        CampaignError
            If a file is missing.
        """
        return [row for part in parts for row in read_table(part_path(folder, part), self.row)]

    def chart(self, name: str, folder: Path) -> Path:
        """Merge the parts of a chart, NAME.csv, and draw the chart, NAME.png."""
        rows = self.read(folder, self.charts[name])
        write_table(folder / f"{name}.csv", rows)
        self.draw(name, rows, folder / f"{name}.png")
        return folder / f"{name}.png"

    def summary(self, folder: Path) -> list[Path]:
        """Write the summary tables and plot of all parts, and return their paths."""
        self.summarise(self.read(folder, self.parts), folder)
        return [folder / name for name in self.summaries]


def part_path(folder: Path, part: str) -> Path:
    """Return the path of the table of a part."""
    return folder / "parts" / f"{part}.csv"


def crossing(sizes: Floats, losses_db: Floats, level_db: float, *, logarithmic: bool) -> float:
    """Return the interpolated size at which the loss first exceeds a level; NaN if it does not.

    Parameters
    ----------
    sizes, losses_db
        (size,) float64, from negligible to destructive; sizes may increase or decrease.
    level_db
        Level of the loss.
    logarithmic
        True: interpolate in the logarithm of the size.

    Examples
    --------
    >>> crossing(np.array([1.0, 10.0, 100.0]), np.array([0.0, 0.5, 1.5]), 1.0, logarithmic=True)
    31.6...
    >>> crossing(np.array([30.0, 0.0]), np.array([0.1, 0.2]), 1.0, logarithmic=False)
    nan
    """
    above = np.flatnonzero(losses_db >= level_db)
    if not above.size:
        return float("nan")
    i = int(above[0])
    if i == 0:
        return float(sizes[0])
    between = np.log(sizes[i - 1 : i + 1]) if logarithmic else sizes[i - 1 : i + 1]
    at = np.interp(level_db, losses_db[i - 1 : i + 1], between)
    return float(np.exp(at) if logarithmic else at)


def with_unit(title: str, unit: str) -> str:
    """Return the label of an axis; unit 1 is omitted.

    Examples
    --------
    >>> with_unit("Fraction of triggers missed", "1"), with_unit("Height", "cm")
    ('Fraction of triggers missed', 'Height, cm')
    """
    return title if unit == "1" else f"{title}, {unit}"


@contextmanager
def panels(path: Path, size: tuple[float, float], shape: tuple[int, int], **options: Any) -> Iterator[list[Axes]]:
    """Provide the panels of a chart, row by row; then add the legend of the first panel below and write the PNG.

    Parameters
    ----------
    path
        Path of the PNG.
    size
        Width and height, inches.
    shape
        Rows and columns.
    **options
        title, legend_columns (4 by default), and the options of `Figure.subplots`.
    """
    title, columns = options.pop("title"), options.pop("legend_columns", 4)
    figure = Figure(figsize=size, layout="constrained")
    every = list(figure.subplots(*shape, squeeze=False, **options).flat)
    yield every
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns, fontsize=9)
    figure.suptitle(title, fontsize=11)
    save_png(figure, path)


def order_sizes(axes: Axes, sizes: Sequence[float] | Floats, *, logarithmic: bool) -> None:
    """Direct the axis of sizes from negligible to destructive."""
    if logarithmic:
        axes.set_xscale("log")
    if sizes[0] > sizes[-1]:
        axes.invert_xaxis()


def draw_table(
    path: Path,
    cells: Sequence[Sequence[str]],
    goodness: Sequence[Sequence[float]],
    names: tuple[Sequence[str], Sequence[str]],
    *,
    title: str,
    scale: str = "",
) -> None:
    """Draw a table with cells coloured from bad (0) to good (1).

    Parameters
    ----------
    path
        Path of the PNG.
    cells, goodness
        Text and rating of the cells, row by row; ratings 0…1, or NaN for no colour.
    names
        Names of the rows, and of the columns.
    title
        Title above the table.
    scale
        Label of the colour scale; empty: no scale is drawn.
    """
    rows, columns = names
    figure = Figure(figsize=(14, 0.42 * len(rows) + 2.2), layout="constrained")
    axes = figure.subplots()
    picture = axes.imshow(goodness, cmap="RdYlGn", vmin=0, vmax=1, aspect="auto", alpha=0.7)
    for row, texts in enumerate(cells):
        for column, text in enumerate(texts):
            axes.text(column, row, text, ha="center", va="center", fontsize=9)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(labeltop=True, labelbottom=False, length=0)
    axes.set_title(title, fontsize=10, pad=14)
    if scale:
        figure.colorbar(picture, ax=axes, label=scale, pad=0.01, fraction=0.03)
    save_png(figure, path)
