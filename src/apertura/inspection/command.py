"""`apertura inspect`: the report printed, as text or JSON, and its preview drawn."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from apertura.errors import CampaignError
from apertura.inspection.look import look
from apertura.inspection.report import Report, print_report


def inspect_path(path: Path, settings: Sequence[str] = (), *, plot: Path | None = None, as_json: bool = False) -> int:
    """Print what a file or folder is; return 0, or 2 where no reader reads it.

    Parameters
    ----------
    path
        Absolute.
    settings
        KEY=VALUE, keys of `apertura.ingest.log_options.LogOptions`.
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
    report = look(path, settings)
    drawn = plot is not None and report.picture is not None
    if plot is not None and report.picture is not None:
        _draw(report, plot)
    if plot is not None and not drawn:
        report = replace(report, missing=(*report.missing, "a preview: there is nothing to draw"))
    if as_json:
        print(json.dumps(report.as_json(), indent=1, allow_nan=False))
    else:
        print_report(report)
        if drawn:
            print(plot)
    return 2 if report.problem else 0


def _is_png(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(8) == b"\x89PNG\r\n\x1a\n"


def _draw(report: Report, plot: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from apertura.atomic import replacement

    figure = report.picture() if report.picture else None
    if figure is None:
        return
    FigureCanvasAgg(figure)
    with replacement(plot) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
