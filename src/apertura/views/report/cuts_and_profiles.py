"""Figures of an image: phase of the brightest target, cuts through this target, and error budget."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.container import Container
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from apertura.core.quality.budget import is_counted, is_stated
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import CUT_REACH_M, cut_through, find_peak, line_through
from apertura.core.scene.grid import SceneGrid
from apertura.views.report.sheet import BLUE, GREEN, GREY, ORANGE, RED, column_of, over, sheet, thinned

_COLOURS = (ORANGE, BLUE, GREEN)


def sidelink_error_rad(
    phase_rad: NDArray[np.float64], length_m: NDArray[np.float64], *, wavenumber_rad_m: float
) -> NDArray[np.float64]:
    """Estimate the phase error due to clocks and triggers in each pulse from the sidelink.

    Parameters
    ----------
    phase_rad
        (pulse,) float64, sidelink phase at mid-band, radians.
    length_m
        (pulse,) float64, sidelink length from the logs, metres.
    wavenumber_rad_m
        2π f_mid/c, radians per metre.

    Returns
    -------
    ndarray
        (pulse,) float64, radians, not wrapped.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Errors removed by the sidelink".

    Examples
    --------
    >>> sidelink_error_rad(np.array([0.3 - 4.0]), np.array([2.0]), wavenumber_rad_m=2.0).round(6)
    array([0.3])
    """
    return phase_rad + wavenumber_rad_m * length_m


def steadiness(phasors: NDArray[np.complex128]) -> tuple[float, float]:
    """Return the phase scatter of a target (rms deviation from the mean, rad) and coherence |Σz|/Σ|z|; NaN if no echo.

    Parameters
    ----------
    phasors
        (pulse,) complex, contribution of each pulse at the target.

    Examples
    --------
    >>> steadiness(np.array([1, 1, 1], complex)), round(steadiness(np.exp(1j * np.array([-0.1, 0.1])))[0], 3)
    ((0.0, 1.0), 0.1)
    """
    size = np.abs(phasors)
    if not size.sum() > 0:
        return float("nan"), float("nan")
    mean = phasors.sum()
    deviation = np.angle(phasors * np.conj(mean)) if abs(mean) > 0 else np.angle(phasors)
    return float(np.sqrt((size * deviation**2).sum() / size.sum())), float(abs(mean) / size.sum())


def draw_phase(
    path: Path,
    time_s: NDArray[np.float64],
    phasors: Mapping[str, NDArray[np.complex128]],
    *,
    title: str,
    tags: Mapping[str, str],
    counted: bool = False,
) -> None:
    """Plot the phase of a target in each pulse, one panel for each stage of correction, as a PNG.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    time_s
        (pulse,) float64, seconds since the first pulse.
    phasors
        Stage of correction → (pulse,) complex, contribution of each pulse at the target.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    counted
        True if `time_s` counts pulses, because the recording has no times.
    """
    drawn_pulses = thinned(len(time_s))
    with sheet(path, 0.6 + 1.55 * len(phasors), title=title, tags=tags) as figure:
        drawn = column_of(figure, len(phasors))
        for axes, colour, (name, values) in zip(drawn, _COLOURS, phasors.items(), strict=False):
            rms, coherence = steadiness(values)
            phase = np.angle(values[drawn_pulses] * np.conj(values.sum() or 1))
            axes.plot(time_s[drawn_pulses], phase, ".", color=colour, markersize=2)
            axes.axhline(0, color=GREY, linewidth=0.6)
            axes.set(
                title=f"{name}: {rms:.2f} rad rms, coherence {100 * coherence:.0f} %",
                ylabel="phase, rad",
                ylim=(-1.05 * np.pi, 1.05 * np.pi),
                yticks=[-np.pi, 0, np.pi],
                yticklabels=["−π", "0", "π"],
            )
            axes.margins(x=0)
        drawn[-1].set_xlabel(over(counted=counted))


_LOWEST_DB = -40.0


@dataclass(frozen=True, eq=False)
class DrawnCut:
    """A cut through a peak, with its width and sidelobe ratios.

    Attributes
    ----------
    name
        Name of the direction of the cut.
    along_m
        (sample,) float64, metres from the peak.
    power
        (sample,) float64, linear, with the peak at the centre.
    width_m, pslr_db, islr_db
        −3 dB width, peak and integrated sidelobe ratio; NaN if the cut is too short to measure them.
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


def drawn_cuts(raster: BlockRaster, brightest: Mapping[str, Any], grid: SceneGrid) -> list[DrawnCut]:
    """Return the cuts through the brightest target of a pair or a sum, given as `brightest` of its image.json."""
    east, north = brightest["cross_range_direction"]
    row, column = grid.pixel_of(brightest["x_m"], brightest["y_m"])
    peak, cuts = find_peak(raster, round(float(row)), round(float(column))), []
    for name, direction in (("cross-range", (east, north)), ("ground range", (north, -east))):
        line: dict[str, Any] = {"direction": direction, "spacing_m": grid.spacing_m, "reach_m": CUT_REACH_M}
        cut = cut_through(raster, peak, **line)
        cuts.append(DrawnCut(name, *line_through(raster, peak, **line), cut.width_m, cut.pslr_db, cut.islr_db))
    return cuts


def draw_cuts(path: Path, cuts: Sequence[DrawnCut], *, title: str, tags: Mapping[str, str]) -> None:
    """Plot cuts side by side on a common dB scale, as a PNG.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    cuts
        One or more cuts.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    """
    with sheet(path, 2.9, title=title, tags=tags) as figure:
        grid = GridSpec(1, len(cuts), figure=figure)
        for number, (cut, colour) in enumerate(zip(cuts, (BLUE, ORANGE), strict=False)):
            _draw_cut(figure.add_subplot(grid[number]), cut, colour)


def _draw_cut(axes: Axes, cut: DrawnCut, colour: str) -> None:
    axes.plot(cut.along_m, cut.decibels, color=colour, linewidth=1.2)
    axes.axhline(-3, color=GREY, linewidth=0.7, linestyle="--")
    if np.isfinite(cut.width_m):
        left, right = _crossings(cut)
        axes.plot([left, right], [-3, -3], color=RED, linewidth=2.2, solid_capstyle="butt")
    width = f"−3 dB width: {100 * cut.width_m:.1f} cm" if np.isfinite(cut.width_m) else "−3 dB width exceeds the cut"
    axes.set(
        title=f"{cut.name} — {width}",
        xlabel="distance from the peak, m",
        ylabel="power relative to the peak, dB",
        ylim=(_LOWEST_DB, 3),
        xlim=(cut.along_m[0], cut.along_m[-1]),
    )
    ratios = [
        f"{name} {value:.1f} dB".replace("-", "−")
        for name, value in (("PSLR", cut.pslr_db), ("ISLR", cut.islr_db))
        if np.isfinite(value)
    ]
    axes.text(0.98, 0.97, "\n".join(ratios), transform=axes.transAxes, ha="right", va="top", fontsize=7)


def _crossings(cut: DrawnCut) -> tuple[float, float]:
    """Return the half-power edges of the main lobe on both sides, metres from the peak."""
    middle, half = cut.power.size // 2, cut.power[cut.power.size // 2] / 2
    sides = []
    for side in (-1, 1):
        below = np.flatnonzero(cut.power[middle::side] < half)
        sides.append(float(cut.along_m[middle + side * int(below[0])]) if below.size else float(cut.along_m[middle]))
    return sides[0], sides[1]


_LEAST = {"loss_db": 1e-4, "shift_m": 1e-4, "phase_rad": 1e-4}
_LABELS = {"loss_db": "peak loss, dB", "shift_m": "displacement, m", "phase_rad": "image phase, rad"}
_STYLES: Mapping[bool, Any] = {
    True: {"color": BLUE, "label": "in the sum: the size is stated, measured or assumed"},
    False: {
        "facecolor": "white",
        "edgecolor": GREY,
        "hatch": "/////",
        "label": "not in the sum: the size is not configured",
    },
}


@dataclass(frozen=True)
class Measured:
    """Focus measured at the bright points of an image.

    Attributes
    ----------
    loss_db, std_db
        Peak loss of the bright points (negative) and its standard deviation; None if no point is bright enough.
    expected_db
        Peak loss predicted by the error budget; None if no cause has a known size.
    """

    loss_db: float | None = None
    std_db: float | None = None
    expected_db: float | None = None


def draw_budget(
    path: Path, lines: Sequence[Mapping[str, Any]], measured: Measured, *, title: str, tags: Mapping[str, str]
) -> None:
    """Plot the expected effect of each cause as a PNG; causes of unknown size are hatched and not in the sum.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    lines
        Lines of the budget in image.json: cause, stated, loss_db, shift_m, phase_rad; an effect is None if the cause
        does not have this effect.
    measured
        Measured focus at the bright points of the image.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    """
    with sheet(path, 1.5 + 0.21 * max(4, len(lines)), title=title, tags=tags) as figure:
        grid = GridSpec(1, 3, figure=figure, width_ratios=(1.4, 1, 1))
        for panel, measure in enumerate(_LABELS):
            axes = figure.add_subplot(grid[panel])
            _draw_causes(axes, lines, measure)
            axes.tick_params(labelleft=panel == 0)
            if measure == "loss_db":
                if measured.expected_db is not None:
                    expected = max(abs(measured.expected_db), _LEAST["loss_db"])
                    axes.axvline(expected, color=BLUE, linestyle=":", label="expected")
                if measured.loss_db is not None:
                    loss = max(abs(measured.loss_db), _LEAST["loss_db"])
                    axes.axvline(loss, color=RED, linewidth=1.4, label="measured at bright points")
                    if measured.std_db:
                        axes.axvspan(
                            max(loss - measured.std_db, _LEAST["loss_db"]),
                            loss + measured.std_db,
                            color=RED,
                            alpha=0.15,
                        )
        plotted, _ = figure.axes[0].get_legend_handles_labels()
        bars = [Patch(**style) for style in _STYLES.values()]  # both styles, even if this image uses only one style
        handles = [*(handle for handle in plotted if not isinstance(handle, Container)), *bars]
        figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)


_SHORT = 0.1  # smaller numbers are written as powers of ten, so that three labels fit below an axis
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _draw_causes(axes: Axes, lines: Sequence[Mapping[str, Any]], measure: str) -> None:
    least, rows = _LEAST[measure], np.arange(len(lines))
    sizes = [abs(line[measure]) if line[measure] is not None else 0.0 for line in lines]
    highest = max([10 * least, *sizes])
    for stated, style in _STYLES.items():
        styled = [row for row, line in enumerate(lines) if is_counted(line) == stated and sizes[row] > least]
        axes.barh(styled, [sizes[row] for row in styled], height=0.62, **style)
    for row, (size, line) in enumerate(zip(sizes, lines, strict=True)):
        if size <= least:
            label = "does not apply" if line[measure] is None else f"below {least:g}"
            axes.text(1.2 * least, row, label, va="center", fontsize=6, color=GREY)
    axes.set_yticks(rows, _names(lines))
    axes.set(xscale="log", xlim=(least, 2 * highest), ylim=(len(lines) - 0.4, -0.6), xlabel=_LABELS[measure])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _position: _power_of_ten(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(LogLocator(numticks=4))
    axes.grid(visible=False, axis="y")


def _names(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the cause of each line; causes that occur twice are distinguished by the origin of their size.

    Examples
    --------
    >>> _names([{"cause": "positions", "stated": "1 cm"},
    ...         {"cause": "positions", "stated": "not configured; assumed 2 cm"}])
    ['positions, stated', 'positions, not configured']
    """
    causes = [str(line["cause"]) for line in lines]
    origins = ["stated" if is_stated(line) else "not configured" for line in lines]
    return [
        f"{cause}, {origin}" if causes.count(cause) > 1 else cause
        for cause, origin in zip(causes, origins, strict=True)
    ]


def _power_of_ten(value: float) -> str:
    """Format the tick label of a decade.

    Examples
    --------
    >>> [_power_of_ten(value) for value in (1e-4, 0.01, 0.1, 10.0)]
    ['10⁻⁴', '10⁻²', '0.1', '10']
    """
    return f"{value:g}" if value >= _SHORT else f"10{str(round(np.log10(value))).translate(_RAISED)}"
