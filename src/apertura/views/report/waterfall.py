"""Range profiles of a whole flight as one picture: power over time and total path."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from apertura.views.report.sheet import sheet

TIMES, PATHS = 560, 700
"""Cells of the picture at most, over time and over path."""

_RANGE_DB = 50.0


class Waterfall:
    """Mean power of range profiles in cells of time and path; profiles are added some at a time.

    Parameters
    ----------
    start_m
        (pulse,) float64, total path of sample 0, metres.
    step_m
        Between samples.
    samples
        Of a profile.

    Examples
    --------
    >>> falling = Waterfall(np.array([10.0, 10.5]), 0.5, 2)
    >>> falling.add(0, np.array([[1, 2], [3, 4]], np.complex64))
    >>> falling.mean.tolist(), falling.span_m
    ([[1.0, nan], [4.0, 9.0], [nan, 16.0]], (10.0, 11.5))
    """

    def __init__(self, start_m: NDArray[np.float64], step_m: float, samples: int) -> None:
        first = float(start_m.min())
        self._offset = (start_m - first) / step_m
        whole = int(np.ceil(self._offset.max() - 1e-9)) + samples
        self._together = -(-whole // PATHS)
        self._pulses = -(-len(start_m) // TIMES)
        shape = -(-whole // self._together), -(-len(start_m) // self._pulses)
        self._sum, self._count = np.zeros(shape), np.zeros(shape)
        self.span_m = first, first + shape[0] * self._together * step_m

    def add(self, first: int, profiles: NDArray[np.complex64]) -> None:
        """Add profiles, (pulse, sample) complex64, of the pulses from `first` on."""
        power = np.abs(profiles.astype(np.complex128)) ** 2
        size = self._sum.shape[0]
        for row, line in enumerate(power):
            at = self._offset[first + row] + np.arange(line.size)
            lower = np.floor(at + 1e-9).astype(np.int64)
            upper = np.clip(at - lower, 0, 1)  # its share of the next cell: profiles begin between cells
            for cells, share in ((lower, 1 - upper), (lower + 1, upper)):
                into = np.minimum(cells // self._together, size - 1)
                column = (first + row) // self._pulses
                self._sum[:, column] += np.bincount(into, share * line, minlength=size)
                self._count[:, column] += np.bincount(into, share, minlength=size)

    @property
    def mean(self) -> NDArray[np.float64]:
        """(path, time) float64 mean power, NaN where no profile reaches."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.nan)

    def times(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the edges of the cells of time, from those of all pulses, (cell + 1,) float64 seconds."""
        starts = time_s[:: self._pulses]
        last = time_s[-1] + (time_s[-1] - time_s[0]) / max(1, len(time_s) - 1)
        return np.append(starts, last if last > starts[-1] else starts[-1] + 1.0)


def draw_waterfall(
    path: Path,
    falling: Waterfall,
    time_s: NDArray[np.float64],
    target_path_m: NDArray[np.float64],
    *,
    title: str,
    tags: Mapping[str, str],
) -> None:
    """Draw a waterfall with the total path to the brightest target, as a PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    falling
        To which every profile was added.
    time_s, target_path_m
        (pulse,) float64, seconds from the first pulse, and metres.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    mean = falling.mean
    top = float(np.nanmax(mean)) if np.isfinite(mean).any() else 1.0
    decibel = 10 * np.log10(np.maximum(mean / (top or 1.0), 1e-12))
    with sheet(path, 3.6, title=title, tags=tags) as figure:
        axes = figure.add_subplot()
        edges = np.linspace(*falling.span_m, mean.shape[0] + 1)
        cells = np.ma.masked_invalid(decibel)
        drawn = axes.pcolormesh(
            falling.times(time_s), edges, cells, cmap="viridis", vmin=-_RANGE_DB, vmax=0, rasterized=True
        )
        some = np.linspace(0, len(time_s) - 1, min(len(time_s), 60)).round().astype(int)
        axes.plot(time_s[some], target_path_m[some], ":", color="white", linewidth=0.9, label="to the brightest target")
        axes.legend(loc="upper right", labelcolor="white", facecolor="0.25", framealpha=0.7)
        axes.set(title="range profiles", xlabel="time from the first pulse, s", ylabel="total path, m")
        axes.yaxis.set_major_locator(MaxNLocator(7))
        axes.grid(visible=False)
        figure.colorbar(drawn, ax=axes, extend="min", pad=0.02).set_label("power re strongest cell, dB")
