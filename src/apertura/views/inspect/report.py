"""Report of a file or folder: named facts, printed as text or JSON."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apertura.common.errors import CampaignError, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_UNITS = {"hz": "Hz", "m": "m", "m_s": "m/s", "s": "s", "deg": "deg", "db": "dB", "utc": "UTC", "share": "share"}
"""Suffix in the name of a fact → unit."""

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""))
_LONGEST = 600


@dataclass(frozen=True)
class Report:
    """Kind and contents of a file or folder.

    Attributes
    ----------
    path
        The file or folder.
    kind
        Flight log, recording, phase history, elevation model, product of apertura, array, campaign folder, folder or
        unknown.
    format
        Format name; empty for a kind with a single format.
    facts
        Name, which ends in the unit → JSON value; a list of two numbers is a range.
    missing
        Data that are missing for image formation, one phrase per item.
    problem
        Reason for refusing the file; None if the file was read.
    parts
        Reports of the contents of a folder.
    columns
        Names of the facts of the parts that are printed as table columns.
    lines_of_parts
        Names of the facts of the parts that are too long for a table and are printed on separate lines.
    picture
        Function that draws a preview; None if no preview is available.
    """

    path: Path
    kind: str
    format: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    problem: CampaignError | None = None
    parts: tuple["Report", ...] = ()
    columns: tuple[str, ...] = ()
    lines_of_parts: tuple[str, ...] = ()
    picture: "Callable[[], Figure] | None" = None

    @property
    def title(self) -> str:
        """Kind and format as text."""
        return f"{self.kind} ({self.format})" if self.format else self.kind

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON values.

        Examples
        --------
        >>> Report(Path("a.csv"), "flight log", "csv", {"epochs": 2}).as_json()["facts"]
        {'epochs': 2}
        """
        problem = self.problem
        return {
            "path": str(self.path),
            "kind": self.kind,
            "format": self.format,
            "facts": dict(self.facts),
            "missing": list(self.missing),
            "problem": problem and {name: getattr(problem, name) for name in ("found", "where", "expected", "remedy")},
            "parts": [part.as_json() for part in self.parts],
        }

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield name and value of each fact as text, with units and without control characters."""
        for name, value in self.facts.items():
            yield worded(name, value)


def worded(name: str, value: object) -> tuple[str, str]:
    """Format a fact as text: name without unit, value with unit.

    Examples
    --------
    >>> worded("rate_hz", 1.25e6), worded("height_m", [1.0, 20.5]), worded("fix", {"fix": 3, "float": 1})
    (('rate', '1.25 MHz'), ('height', '1.00 to 20.50 m'), ('fix', 'fix 3, float 1'))
    """
    ends = next((end for end in sorted(_UNITS, key=len, reverse=True) if name.endswith(f"_{end}")), "")
    return name.removesuffix(f"_{ends}").replace("_", " "), shown(_words(value, _UNITS.get(ends, "")), _LONGEST)


def _words(value: object, unit: str) -> str:
    if isinstance(value, Mapping):
        return ", ".join(" ".join(worded(str(name), part)) for name, part in value.items()) or "none"
    if isinstance(value, list):
        return _listed(value, unit)
    if isinstance(value, float):
        return _number(value, unit)
    if value is None or isinstance(value, bool):
        return {None: "unknown", True: "yes", False: "no"}[value]
    return f"{value} {unit}" if unit and not isinstance(value, str) else str(value)


def _listed(values: list[Any], unit: str) -> str:
    words = [_words(value, unit) for value in values]
    if unit and len(values) == 2 and not isinstance(values[0], str):
        return f"{words[0].removesuffix(f' {unit}')} to {words[1]}"
    return ("; " if any(isinstance(value, Mapping) for value in values) else ", ").join(words) or "none"


def _number(value: float, unit: str) -> str:
    if unit == "Hz":
        scale, prefix = next(((scale, prefix) for scale, prefix in _PREFIXES if abs(value) >= scale), (1.0, ""))
        return f"{value / scale:.7g} {prefix}Hz"
    if unit == "share":
        return f"{100 * value:.4g} %"
    digits = {"deg": ".6f", "dB": ".1f", "m": ".2f" if abs(value) >= 1 else ".3g"}.get(unit, ".6g")
    return f"{value:{digits}} {unit}".rstrip()


def print_report(report: Report, name: Path | None = None) -> None:
    """Print a report as text; `name` is the path as typed by the user."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    console.print(Text.assemble((shown(name or report.path, 400), "bold"), f": {report.title}"))
    grid = Table.grid(padding=(0, 2, 0, 0))
    for fact, value in report.lines():
        grid.add_row(Text(f"  {fact}", style="dim"), Text(value))
    if report.facts:
        console.print(grid)
    if report.parts:
        console.print(_table(report))
    for part in report.parts:
        for fact, value in (worded(name, part.facts[name]) for name in report.lines_of_parts if name in part.facts):
            console.print(Text(f"  {shown(part.path.name)}, {part.title}, {fact}: {value}"))
    if report.problem:
        problem = report.problem
        sentence = f"{problem.found}; expected {problem.expected}. {problem.remedy}"
        console.print(Text.assemble(("refused: ", "red"), sentence))
    if report.missing:
        console.print(Text("missing for image formation:" if not report.problem else "remedies:", style="yellow"))
    for sentence in report.missing:
        console.print(Text(f"  - {shown(sentence, _LONGEST)}"))


def _table(report: Report) -> Any:
    """Return a table with a row for each part: name, kind, and a column for each fact in `columns`."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("", "kind", *(worded(name, None)[0] for name in report.columns)):
        table.add_column(heading, overflow="fold")  # wrap instead of truncating in a narrow terminal
    for part in report.parts:
        cells = [worded(name, part.facts[name])[1] if name in part.facts else "" for name in report.columns]
        title = f"{part.title}, refused: {part.problem.found}" if part.problem else part.title
        table.add_row(*(Text(shown(cell, 200)) for cell in (part.path.name, title, *cells)))
    return table
