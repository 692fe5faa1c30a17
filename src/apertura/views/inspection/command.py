"""`apertura inspect`: the report printed, as text or JSON, and its preview drawn."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from apertura.common.errors import CampaignError, shown
from apertura.views.inspection.look import look
from apertura.views.inspection.report import print_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def inspect_path(
    path: Path,
    settings: Sequence[str] = (),
    *,
    name: Path | None = None,
    plot: Path | None = None,
    as_json: bool = False,
) -> int:
    """Print what a file or folder is; return 0, or 2 where no reader reads it.

    Parameters
    ----------
    path
        Absolute.
    name
        What people call it; None: its path.
    settings
        KEY=VALUE, keys of `apertura.formats.tracks.log_options.LogOptions`.
    plot
        Draw a preview into this .png file.
    as_json
        Print JSON.

    Raises
    ------
    CampaignError
        If the path is not there, a setting is none, or the preview would not be a .png file of its own.
    """
    if plot is not None and (plot.suffix.lower() != ".png" or plot == path or (plot.exists() and not _is_png(plot))):
        found = "a file that is no picture" if plot.exists() else "another suffix than .png"
        raise CampaignError(found, f"--plot {plot}", "the name of a new .png file", "Choose another name.")
    logging.getLogger("apertura.formats.reading").addHandler(
        logging.NullHandler()
    )  # remarks of readers are in the report
    report = look(path, settings)
    drawn = None if plot is None or report.picture is None else _drawn(report.picture(), plot)
    if as_json:
        print(json.dumps(report.as_json() | {"plot": drawn and str(drawn)}, indent=1, allow_nan=False))
    else:
        print_report(report, name if report.path == path else None)
        if plot is not None:
            print(shown(drawn, 400) if drawn else "nothing to draw")
    return 2 if report.problem else 0


def _is_png(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(8) == b"\x89PNG\r\n\x1a\n"


def _drawn(figure: "Figure", plot: Path) -> Path:
    """Write a picture; return its path."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from apertura.common.atomic import replacement

    FigureCanvasAgg(figure)
    with replacement(plot) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
    return plot
