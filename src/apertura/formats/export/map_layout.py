"""Layout of a quicklook: metric axes, scale bar, north arrow, colour bar and text around an image."""

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
LONGER_SIDE = 6.4  # of the image, inch
PICTURE_DOTS = floor(LONGER_SIDE * DPI)
LEFT, RIGHT, TOP, BOTTOM = 1.0, 1.4, 0.85, 1.6  # margins around the image, inch
LEAST_WIDTH, LEAST_HEIGHT = 4.2, 1.6  # minimum space for text and colour bar of a narrow or flat image, inch
PART_HEIGHT = 3.2  # minimum height if a part of the map is plotted separately, inch
LETTER = 0.073  # width of a character in the label of a colour bar, inch
LONGEST_FLAG = 24  # characters of the longest flag name with comma; maximum unused space at the end of a line

Marker = tuple[float, float, str]


@dataclass(frozen=True)
class MapLayout:
    """Figure with an image true to scale; positions on the figure are in inches from the lower left corner.

    Attributes
    ----------
    figure, axes
        Matplotlib objects; `axes` are in metres of the scene.
    bounds
        West, south, east, north of the scene, metres.
    inch_per_m
        Scale of the image.
    left
        Position of the image's left edge, inch.
    local
        True if the axes are x and y of a local frame without a north direction.
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
        """Create an empty layout in which the longer side of `bounds` is `LONGER_SIDE`, with space for all maps.

        The last map covers the bounds `part`, if given.
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
        """Add a map to the right of this map, with the same bounds or with `bounds` at the largest scale."""
        width, height = self.figure.get_size_inches()
        room = max((self.bounds[2] - self.bounds[0]) * self.inch_per_m, LEAST_WIDTH), height - TOP - BOTTOM
        left = self.left + room[0] + RIGHT + LEFT
        new_bounds, scale = bounds or self.bounds, self.inch_per_m if bounds is None else _scale_in(room, bounds)
        wide, high = ((new_bounds[2 + side] - new_bounds[side]) * scale for side in (0, 1))
        rectangle = (left / width, (height - TOP - high) / height, wide / width, high / height)
        return replace(self, axes=self.figure.add_axes(rectangle), left=left, bounds=new_bounds, inch_per_m=scale)

    def draw_frame(self, crs_name: str) -> None:
        """Label the axes in metres from a round offset, so that UTM coordinates are readable."""
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
        """Draw the colour bar to the right of the image; `beyond` is Matplotlib's parameter `extend`."""
        width, height = self.figure.get_size_inches()
        wide, high = ((self.bounds[2 + side] - self.bounds[side]) * self.inch_per_m for side in (0, 1))
        high = max(high, LEAST_HEIGHT)
        rectangle = ((self.left + wide + 0.15) / width, (height - TOP - high) / height, 0.16 / width, high / height)
        bar = self.figure.colorbar(picture, cax=self.figure.add_axes(rectangle), extend=beyond)
        bar.set_label("\n".join(part for line in label.split("\n") for part in wrap(line, floor(high / LETTER))))
        return bar

    def draw_scale_and_north(self) -> None:
        """Draw a scale bar of a round length and, for a georeferenced map, a grid north arrow below the image."""
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
        """Draw a legend below the image, next to the scale bar."""
        width, height = self.figure.get_size_inches()
        self.figure.legend(
            lines, names, loc="center right", bbox_to_anchor=((width - 0.7) / width, 0.78 / height), ncols=3, fontsize=7
        )

    def draw_markers(self, markers: Iterable[Marker]) -> None:
        """Mark points of the scene with labelled rings."""
        outline = [withStroke(linewidth=2.5, foreground="black")]
        for x, y, label in markers:
            self.axes.plot(
                x, y, "o", markersize=13, markerfacecolor="none", markeredgecolor="white", path_effects=outline
            )
            self.axes.annotate(
                label, (x, y), (9, 5), textcoords="offset points", color="white", size=8, path_effects=outline
            )

    def write_words(self, title: str, subtitle: str, footer: str) -> None:
        """Write title and subtitle (up to two lines) above the image, and the provenance of the image below."""
        width, height = self.figure.get_size_inches()
        room = (width - LEFT - 0.1) * 72 / 0.68  # width in points over the relative width of a bold character
        self._write(LEFT, height - 0.4, title, size=min(13, room / max(1, len(title))), weight="bold")
        lines = wrap(subtitle, floor((width - LEFT - 0.1) * 72 / (0.6 * 9)))
        for line, down in zip(lines, (0.65, 0.8) if len(lines) < 2 else (0.6, 0.76), strict=False):
            self._write(LEFT, height - down, line, size=9)
        room = (width - LEFT - 0.1) * 72 / 0.64
        self._write(LEFT, 0.16, footer, size=min(7, room / max(1, len(footer))), color="0.3")

    def write_flags(self, flags: Sequence[str]) -> None:
        """Write the number and names of an image's flags above the footer, on up to two lines."""
        most = int((self.figure.get_size_inches()[0] - LEFT - 0.1) * 72 / (0.64 * 7))  # characters in a line
        lines = wrap(flag_words(flags, 2 * most - LONGEST_FLAG), most, max_lines=2)
        style = {"size": 7, "color": "firebrick" if flags else "0.3"}
        for line, height in zip(lines, (0.42, 0.3) if len(lines) > 1 else (0.3,), strict=True):
            self._write(LEFT, height, line, **style)

    def _write(self, x: float, y: float, text: str, **style: Any) -> None:
        self.figure.text(x, y, text, transform=self.figure.dpi_scale_trans, parse_math=False, **style)


def _scale_in(room: tuple[float, float], bounds: tuple[float, float, float, float]) -> float:
    """Return the scale, inches per metre, at which bounds fit into a given width and height in inches."""
    return min(length / (bounds[2 + side] - bounds[side]) for side, length in enumerate(room))


def flag_words(flags: Sequence[str], most: int) -> str:
    """Format the number and names of flags in at most `most` characters, with the number of omitted names.

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
        omitted = f", and {len(flags) - number} more in image.json" if number < len(flags) else ""
        line = f"{words}{', '.join(flags[:number])}{omitted}"
        if len(line) <= most:
            break
    return line


def round_origin(low_m: float, high_m: float) -> float:
    """Return a round offset of coordinates at or below `low_m`; 0 for coordinates that are short without an offset.

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
    """Return the largest of 1, 2, 5 × a power of ten that does not exceed `most_m`.

    Examples
    --------
    >>> round_length(7.3), round_length(0.21), round_length(1.0)
    (5.0, 0.2, 1.0)
    """
    decade = 10.0 ** floor(log10(most_m))
    return float(max(digit * decade for digit in (1, 2, 5) if digit * decade <= most_m))


def from_origin(origin: float, value: float, _position: int | None) -> str:
    """Return a Matplotlib formatter of tick labels relative to an origin."""
    return number(value - origin)


def number(value: float) -> str:
    """Format a number with thin spaces between thousands and a typographic minus sign.

    Examples
    --------
    >>> number(-12345.5)
    '−12\u2009345.5'
    """
    return f"{round(value, 6) + 0.0:,.10g}".replace(",", "\u2009").replace("-", "−")
