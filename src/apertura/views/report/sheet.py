"""Figures at the text width of an A4 page: style, colours, axis labels and reproducible PNG output."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from numpy.typing import NDArray

from apertura.common.atomic import replacement

WIDTH = 6.7
"""Figure width in inches: width of an A4 page minus margins of 2 cm."""

DPI = 220
MOST_DOTS = 4000
"""Maximum number of points drawn for a series; more points would overlap."""

BLUE, ORANGE, GREEN, RED, SKY, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#666666"
"""Colours that readers with colour vision deficiency can distinguish (Okabe and Ito)."""

_STYLE: Any = {
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.fontsize": 7,
    "legend.framealpha": 0.9,
    "text.parse_math": False,
}


def over(*, counted: bool, first: str = "first pulse") -> str:
    """Return the label of a time axis: seconds, or pulses if the recording contains no times.

    Examples
    --------
    >>> over(counted=False), over(counted=True)
    ('time since the first pulse, s', 'pulses since the first pulse (no times recorded)')
    """
    return f"pulses since the {first} (no times recorded)" if counted else f"time since the {first}, s"


@contextmanager
def sheet(path: Path, height: float, *, title: str, tags: Mapping[str, str]) -> Iterator[Figure]:
    """Yield an empty figure that is saved as PNG when the context exits.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    height
        Height in inches.
    title
        Title, stored in the file.
    tags
        Provenance, name → text, stored in the file.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with sheet(Path(folder) / "one.png", 2.0, title="a line", tags={}) as figure:
    ...         _ = figure.add_subplot().plot([0, 1])
    ...     (Path(folder) / "one.png").read_bytes()[1:4]
    b'PNG'
    """
    with matplotlib.style.context("default"), matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with replacement(path) as temporary:
            figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def column_of(figure: Figure, rows: int) -> list[Axes]:
    """Add vertically stacked axes with a shared horizontal axis; only the lowest axes have horizontal tick labels."""
    grid = GridSpec(rows, 1, figure=figure)
    first = figure.add_subplot(grid[0])
    drawn = [first, *(figure.add_subplot(grid[row], sharex=first) for row in range(1, rows))]
    for axes in drawn[:-1]:
        axes.tick_params(labelbottom=False)
    return drawn


def thinned(count: int, most: int = MOST_DOTS) -> NDArray[np.int64]:
    """Return evenly spaced indices of the points of a series to be drawn, (point,) int64.

    Examples
    --------
    >>> thinned(3).tolist(), thinned(9, 3).tolist()
    ([0, 1, 2], [0, 4, 8])
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
