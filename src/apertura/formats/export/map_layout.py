"""The layout of a quicklook: metric axes, scale bar, north arrow, colour bar and words around a picture."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, floor, log10
from textwrap import wrap
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator

DPI = 150
LONGER_SIDE = 6.4  # of the picture, inch
PICTURE_DOTS = floor(LONGER_SIDE * DPI)
LEFT, RIGHT, TOP, BOTTOM = 1.0, 1.4, 0.85, 1.6  # margins around the picture, inch
LEAST_WIDTH, LEAST_HEIGHT = 4.2, 1.6  # room kept for words and colour bar beside a narrow or flat picture, inch
PART_HEIGHT = 3.2  # and for a part of it that is drawn once more, inch
LETTER = 0.073  # of a colour bar's label, inch
LONGEST_FLAG = 24  # letters with the comma: so many the first of two lines may leave empty

Marker = tuple[float, float, str]


@dataclass(frozen=True)
class MapLayout:
    """A figure with a picture in true proportions; lengths on the figure in inches from the lower left corner.

    Attributes
    ----------
    figure, axes
        Of matplotlib; `axes` are in metres of the scene.
    bounds
        West, south, east, north of the scene, metres.
    inch_per_m
        Scale of the picture.
    left
        Margin left of it.
    local
        Whether its axes are x and y of a frame of its own, where no direction is north.
    """

    figure: Figure
    axes: Axes
    bounds: tuple[float, float, float, float]
    inch_per_m: float
    left: float = LEFT
    local: bool = False

    @classmethod
    def for_bounds(
        cls,
        bounds: tuple[float, float, float, float],
        *,
        maps: int = 1,
        part: tuple[float, float, float, float] | None = None,
        local: bool = False,
    ) -> "MapLayout":
        """Return an empty layout on which the longer side of `bounds` is `LONGER_SIDE`, with room for `maps`.

        The last of them is of the bounds `part`, if these are given.
        """
        west, south, east, north = bounds
        scale = LONGER_SIDE / max(east - west, north - south)
        wide, high = (east - west) * scale, (north - south) * scale
        room = max(wide, LEAST_WIDTH), max(high, LEAST_HEIGHT if part is None else PART_HEIGHT)
        last = room[0] if part is None else (part[2] - part[0]) * _scale_in(room, part)
        width = maps * (LEFT + RIGHT) + (maps - 1) * room[0] + last
        height = BOTTOM + room[1] + TOP
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        bottom = height - TOP - high
        axes = figure.add_axes((LEFT / width, bottom / height, wide / width, high / height))
        return cls(figure, axes, bounds, scale, local=local)

    def beside(self, bounds: tuple[float, float, float, float] | None = None) -> "MapLayout":
        """Return the layout of the next map, right of this one: of the same place, or of a part as large as fits."""
        width, height = self.figure.get_size_inches()
        room = max((self.bounds[2] - self.bounds[0]) * self.inch_per_m, LEAST_WIDTH), height - TOP - BOTTOM
        left = self.left + room[0] + RIGHT + LEFT
        shown, scale = bounds or self.bounds, self.inch_per_m if bounds is None else _scale_in(room, bounds)
        wide, high = ((shown[2 + side] - shown[side]) * scale for side in (0, 1))
        place = (left / width, (height - TOP - high) / height, wide / width, high / height)
        return replace(self, axes=self.figure.add_axes(place), left=left, bounds=shown, inch_per_m=scale)

    def draw_frame(self, crs_name: str) -> None:
        """Label the axes in metres from a round number, so that UTM coordinates stay readable."""
        west, south, east, north = self.bounds
        self.axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
        for name, axis, low, high in (
            ("x" if self.local else "Easting", self.axes.xaxis, west, east),
            ("y" if self.local else "Northing", self.axes.yaxis, south, north),
        ):
            origin = round_origin(low, high)
            length = (high - low) * self.inch_per_m
            axis.set_major_locator(MaxNLocator(max(1, floor(1.2 * length)), steps=[1, 2, 5, 10]))
            axis.set_major_formatter(FuncFormatter(partial(from_origin, origin)))
            separator = " " if length > 2.2 else "\n"
            axis.set_label_text(f"{name}{separator}− {number(origin)}, m" if origin else f"{name}, m")
        self._write(LEFT, 0.58, crs_name, size=8)

    def draw_colour_bar(self, picture: AxesImage, label: str, *, beyond: str = "both") -> Colorbar:
        """Draw the colour bar at the right of the picture; values lie `beyond` 'both' ends, 'min' or 'neither'."""
        width, height = self.figure.get_size_inches()
        wide, high = ((self.bounds[2 + side] - self.bounds[side]) * self.inch_per_m for side in (0, 1))
        high = max(high, LEAST_HEIGHT)
        place = ((self.left + wide + 0.15) / width, (height - TOP - high) / height, 0.16 / width, high / height)
        bar = self.figure.colorbar(picture, cax=self.figure.add_axes(place), extend=beyond)
        bar.set_label("\n".join(part for line in label.split("\n") for part in wrap(line, floor(high / LETTER))))
        return bar

    def draw_scale_and_north(self) -> None:
        """Draw a bar of a round length and, on a map, an arrow to grid north below the picture."""
        metres = round_length(2.0 / self.inch_per_m)
        length = metres * self.inch_per_m
        for part, colour in enumerate(("black", "white")):
            corner = LEFT + part * length / 2, 0.86
            bar = Rectangle(corner, length / 2, 0.06, facecolor=colour, edgecolor="black", linewidth=0.8)
            bar.set_transform(self.figure.dpi_scale_trans)
            self.figure.add_artist(bar)
        self._write(LEFT + length + 0.1, 0.85, f"{number(metres)} m", size=9)
        if self.local:
            return
        x = self.figure.get_size_inches()[0] - 0.4
        arrow = Polygon(
            [(x, 0.98), (x - 0.09, 0.62), (x, 0.7), (x + 0.09, 0.62)],
            facecolor="black",
            transform=self.figure.dpi_scale_trans,
        )
        self.figure.add_artist(arrow)
        self._write(x, 1.02, "N", size=10, weight="bold", ha="center")

    def draw_legend(self, lines: Sequence[Any], names: Sequence[str]) -> None:
        """Draw a legend below the picture, beside the scale bar."""
        width, height = self.figure.get_size_inches()
        self.figure.legend(
            lines, names, loc="center right", bbox_to_anchor=((width - 0.7) / width, 0.78 / height), ncols=3, fontsize=7
        )

    def draw_markers(self, markers: Iterable[Marker]) -> None:
        """Ring and label places of the scene."""
        outline = [withStroke(linewidth=2.5, foreground="black")]
        for x, y, label in markers:
            self.axes.plot(
                x, y, "o", markersize=13, markerfacecolor="none", markeredgecolor="white", path_effects=outline
            )
            self.axes.annotate(
                label, (x, y), (9, 5), textcoords="offset points", color="white", size=8, path_effects=outline
            )

    def write_words(self, title: str, subtitle: str, footer: str) -> None:
        """Write title and subtitle above the picture, on two lines where one is too short, and its provenance below."""
        width, height = self.figure.get_size_inches()
        room = (width - LEFT - 0.1) * 72 / 0.68  # points, over the width of a bold letter in units of its size
        self._write(LEFT, height - 0.4, title, size=min(13, room / max(1, len(title))), weight="bold")
        lines = wrap(subtitle, floor((width - LEFT - 0.1) * 72 / (0.6 * 9)))
        for line, down in zip(lines, (0.65, 0.8) if len(lines) < 2 else (0.6, 0.76), strict=False):
            self._write(LEFT, height - down, line, size=9)
        room = (width - LEFT - 0.1) * 72 / 0.64
        self._write(LEFT, 0.16, footer, size=min(7, room / max(1, len(footer))), color="0.3")

    def write_flags(self, flags: Sequence[str]) -> None:
        """Write the number and the names of an image's flags above the footer, on two lines where one is too short."""
        most = int((self.figure.get_size_inches()[0] - LEFT - 0.1) * 72 / (0.64 * 7))  # letters of a line
        lines = wrap(flag_words(flags, 2 * most - LONGEST_FLAG), most, max_lines=2)
        style = {"size": 7, "color": "firebrick" if flags else "0.3"}
        for line, height in zip(lines, (0.42, 0.3) if len(lines) > 1 else (0.3,), strict=True):
            self._write(LEFT, height, line, **style)

    def _write(self, x: float, y: float, words: str, **style: Any) -> None:
        self.figure.text(x, y, words, transform=self.figure.dpi_scale_trans, parse_math=False, **style)


def _scale_in(room: tuple[float, float], bounds: tuple[float, float, float, float]) -> float:
    """Return inches per metre at which bounds fill a room, inches wide and high."""
    return min(one / (bounds[2 + side] - bounds[side]) for side, one in enumerate(room))


def flag_words(flags: Sequence[str], most: int) -> str:
    """Return the number of flags and as many of their names as `most` letters hold, and how many are left out.

    Examples
    --------
    >>> flag_words([], 40), flag_words(["outside_beam"], 40)
    ('no flags', '1 flag: outside_beam')
    >>> flag_words(["sidelink_noisy", "azimuth_undersampled", "outside_beam"], 40)
    '3 flags: sidelink_noisy, and 2 more in image.json'
    """
    if not flags:
        return "no flags"
    words = f"{len(flags)} flag{'s' if len(flags) > 1 else ''}: "
    for number in range(len(flags), 0, -1):
        left = f", and {len(flags) - number} more in image.json" if number < len(flags) else ""
        line = f"{words}{', '.join(flags[:number])}{left}"
        if len(line) <= most:
            break
    return line


def round_origin(low_m: float, high_m: float) -> float:
    """Return a round number at or below `low_m` to count coordinates from; 0 where they are short as they are.

    Examples
    --------
    >>> round_origin(691523.4, 691583.4), round_origin(5333040.1, 5333100.1), round_origin(-60.0, 60.0)
    (691500.0, 5333000.0, 0.0)
    """
    if max(abs(low_m), abs(high_m)) < 10_000:
        return 0.0
    step = 10.0 ** ceil(log10(high_m - low_m))
    return floor(low_m / step) * step


def round_length(most_m: float) -> float:
    """Return the longest of 1, 2, 5 × a power of ten that is no longer than `most_m`.

    Examples
    --------
    >>> round_length(7.3), round_length(0.21), round_length(1.0)
    (5.0, 0.2, 1.0)
    """
    decade = 10.0 ** floor(log10(most_m))
    return float(max(digit * decade for digit in (1, 2, 5) if digit * decade <= most_m))


def from_origin(origin: float, value: float, _position: int | None) -> str:
    """Return the label of a tick that counts from an origin, as a formatter of matplotlib."""
    return number(value - origin)


def number(value: float) -> str:
    """Return a number with thin spaces between thousands and a true minus.

    Examples
    --------
    >>> number(-12345.5)
    '−12\u2009345.5'
    """
    return f"{round(value, 6) + 0.0:,.10g}".replace(",", "\u2009").replace("-", "−")
