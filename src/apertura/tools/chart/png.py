"""Charts as PNG files."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from apertura.common.atomic import replacement


def save_png(figure: Figure, path: Path) -> None:
    """Write a PNG that is the same for the same figure."""
    FigureCanvasAgg(figure)
    with replacement(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
