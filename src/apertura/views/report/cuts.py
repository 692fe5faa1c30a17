"""Cuts through the brightest target along both directions of the flight, with their −3 dB widths."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from numpy.typing import NDArray

from apertura.views.report.sheet import BLUE, GREY, ORANGE, RED, sheet

_DEEPEST_DB = -40.0


@dataclass(frozen=True, eq=False)
class DrawnCut:
    """A line through a peak and what was measured along it.

    Attributes
    ----------
    name
        Of its direction.
    along_m
        (sample,) float64, metres from the peak.
    power
        (sample,) float64, linear, the peak in the middle.
    width_m, pslr_db, islr_db
        −3 dB width, peak and integrated sidelobe ratio; NaN where the line does not hold them.
    """

    name: str
    along_m: NDArray[np.float64]
    power: NDArray[np.float64]
    width_m: float
    pslr_db: float
    islr_db: float

    @property
    def decibels(self) -> NDArray[np.float64]:
        """Power relative to the peak, (sample,) float64 dB."""
        return np.asarray(10 * np.log10(np.maximum(self.power / self.power[self.power.size // 2], 1e-12)))


def draw_cuts(path: Path, cuts: Sequence[DrawnCut], *, title: str, tags: Mapping[str, str]) -> None:
    """Draw cuts side by side on one scale of dB, as a PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    cuts
        At least one.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    with sheet(path, 2.9, title=title, tags=tags) as figure:
        grid = GridSpec(1, len(cuts), figure=figure)
        for number, (cut, colour) in enumerate(zip(cuts, (BLUE, ORANGE), strict=False)):
            _draw(figure.add_subplot(grid[number]), cut, colour)


def _draw(axes: Axes, cut: DrawnCut, colour: str) -> None:
    axes.plot(cut.along_m, cut.decibels, color=colour, linewidth=1.2)
    axes.axhline(-3, color=GREY, linewidth=0.7, linestyle="--")
    if np.isfinite(cut.width_m):
        left, right = _crossings(cut)
        axes.plot([left, right], [-3, -3], color=RED, linewidth=2.2, solid_capstyle="butt")
    width = f"−3 dB: {100 * cut.width_m:.1f} cm" if np.isfinite(cut.width_m) else "−3 dB: beyond the cut"
    axes.set(
        title=f"{cut.name} — {width}",
        xlabel="from the peak, m",
        ylabel="power re peak, dB",
        ylim=(_DEEPEST_DB, 3),
        xlim=(cut.along_m[0], cut.along_m[-1]),
    )
    told = [
        f"{name} {value:.1f} dB".replace("-", "−")
        for name, value in (("PSLR", cut.pslr_db), ("ISLR", cut.islr_db))
        if np.isfinite(value)
    ]
    axes.text(0.98, 0.97, "\n".join(told), transform=axes.transAxes, ha="right", va="top", fontsize=7)


def _crossings(cut: DrawnCut) -> tuple[float, float]:
    """Return where the main lobe has fallen to half its power on both sides, metres from the peak."""
    middle, half = cut.power.size // 2, cut.power[cut.power.size // 2] / 2
    sides = []
    for way in (-1, 1):
        below = np.flatnonzero(cut.power[middle::way] < half)
        sides.append(float(cut.along_m[middle + way * int(below[0])]) if below.size else float(cut.along_m[middle]))
    return sides[0], sides[1]
