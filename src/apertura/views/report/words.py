"""What images say of themselves, image.json, in sentences and rows of tables."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from apertura.common.flags import FLAGS
from apertura.views.report.budget import NOT_STATED

Report = Mapping[str, Any]
Row = tuple[str, ...]

ASKED = ("key", "value")
VERDICTS = ("image", "verdict", "peak lost", "expected", "numerical error", "pulses", "flags")
DECISIONS = ("decision", "choice", "why")
BUDGET = ("cause", "stated", "peak lost", "targets shifted", "phase")
FLAGGED = ("flag", "images", "what was measured", "what it means", "what to look at first")
"""Headings of the tables."""


def told(value: object) -> bool:
    """Return whether a setting says something: it is not 'auto', nothing, or empty."""
    return value not in ("auto", None, "", (), [], {})


def said(value: object) -> str:
    """Return a setting as people write it.

    Examples
    --------
    >>> said(1_204_800_000.0), said(3.125e-06), said({"align_phase": False}), said("hann")
    ('1204800000', '3.125e-06', 'align_phase: False', 'hann')
    """
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {said(one)}" for name, one in value.items())
    return str(value)


def verdict_row(name: str, report: Report) -> Row:
    """Return the row of an image among all.

    Examples
    --------
    >>> focus = {"verdict": "focused", "loss_db": -0.02}
    >>> verdict_row("f01 a-b", {"focus": focus, "flags": {}, "numerical_error_db": -67.8})
    ('f01 a-b', 'focused', '0.02 dB', '', 'below −67.8 dB', '', 'none')
    """
    focus, pulses = report.get("focus") or {}, report.get("pulses") or {}
    used = pulses.get("used")
    return (
        name,
        str(focus.get("verdict", "")),
        f"{abs(focus['loss_db']):.2f} dB" if "loss_db" in focus else "",
        f"{abs(focus['expected_db']):.2f} dB" if "expected_db" in focus else "",
        f"below {_signed(report['numerical_error_db'], 1)} dB",
        "" if used is None else f"{used} of {used + (pulses.get('dropped') or 0)}",
        ", ".join(report["flags"]) or "none",
    )


def sentences(name: str, report: Report) -> Iterator[str]:
    """Yield what a results section would say of an image: focus, certificate, agreement.

    Parameters
    ----------
    name
        Of the image.
    report
        Its image.json.
    """
    focus = report.get("focus") or {}
    if focus:
        yield f"{name}: {focus.get('verdict', 'not judged')}; {focus.get('why', 'nobody said why')}."
    yield certificate(report)
    agreement = report.get("agreement")
    if agreement and report.get("reference") != report.get("pair"):
        yield (
            f"Against {report['reference']}, {agreement['points']:.0f} bright points lie "
            f"{100 * _length(agreement):.1f} cm apart and "
            f"{_signed(agreement['phase_rad'], 3)} ± {agreement['phase_std_rad']:.3f} rad out of phase."
        )
    coherence = report.get("coherence") or {}
    if coherence.get("mean") is not None:
        yield f"The pairs add up with {coherence['mean']:.3f} of full coherence ({coherence['chance']:.2f} by chance)."


def _length(agreement: Mapping[str, float]) -> float:
    return float((agreement["shift_east_m"] ** 2 + agreement["shift_north_m"] ** 2) ** 0.5)


def certificate(report: Report) -> str:
    """Return what is certified of an image's arithmetic, in a sentence.

    Examples
    --------
    >>> certificate({"numerical_error_db": -67.8, "numerical_error_confidence": 0.95, "certified_pixels": 272})
    'Its numerical error lies below −67.8 dB (95 % sure), measured at 272 pixels against a double sum in float64.'
    """
    pixels = report.get("certified_pixels")
    where = f"measured at {pixels} pixels against a double sum in float64" if pixels else "that of its worst pair"
    sure = f"{100 * report['numerical_error_confidence']:.0f} % sure"
    return f"Its numerical error lies below {_signed(report['numerical_error_db'], 1)} dB ({sure}), {where}."


def decision_rows(report: Report) -> list[Row]:
    """Return the planner's decisions: what, which choice, why.

    Examples
    --------
    >>> decision_rows({"models": {"presum": "1: the scene is wide"}})
    [('presum', '1', 'the scene is wide')]
    """
    rows: list[Row] = []
    for name, line in (report.get("models") or {}).items():
        choice, _, why = str(line).partition(": ")
        rows.append((name.replace("_", " "), choice if why else "", why or choice))
    return rows


def shared_rows(reports: Mapping[str, Report]) -> list[Row]:
    """Return the decisions of several images, each once, with the images that it was made for.

    Examples
    --------
    >>> shared_rows({"a-a": {"models": {"degree": "1: cheap"}}, "a-b": {"models": {"degree": "1: cheap"}}})
    [('a-a, a-b', 'degree', '1', 'cheap')]
    """
    made: dict[Row, list[str]] = {}
    for name, report in reports.items():
        for row in decision_rows(report):
            made.setdefault(row, []).append(name)
    return [(", ".join(names), *row) for row, names in sorted(made.items())]


def budget_rows(lines: Sequence[Report]) -> list[Row]:
    """Return the rows of an error budget.

    Examples
    --------
    >>> budget_rows([{"cause": "heights", "stated": "not stated; 1 m would do this", "loss_db": -0.02, "shift_m": 0.4,
    ...               "phase_rad": None}])
    [('heights', 'not stated; 1 m would do this', '(0.02 dB)', '(0.4 m)', '')]
    """
    rows: list[Row] = []
    for line in lines:
        held = "({})" if line["stated"].startswith(NOT_STATED) else "{}"
        sizes = (
            "" if line[name] is None else held.format(_size(abs(line[name]), unit))
            for name, unit in (("loss_db", "dB"), ("shift_m", "m"), ("phase_rad", "rad"))
        )
        rows.append((line["cause"], line["stated"], *sizes))
    return rows


def flag_rows(reports: Mapping[str, Report]) -> list[Row]:
    """Return each flag once: which images carry it, what was measured, what it means and what to look at first.

    Parameters
    ----------
    reports
        Name of an image → its image.json.

    Examples
    --------
    >>> flag_rows({"a-a": {"flags": {"saturated_radar": "3 of 5"}}, "a-b": {"flags": {"new": "?"}}})[1]
    ('new', 'a-b', '?', '', '')
    """
    raised: dict[str, dict[str, list[str]]] = {}
    for name, report in reports.items():
        for flag, line in report["flags"].items():
            raised.setdefault(flag, {}).setdefault(line, []).append(name)
    rows: list[Row] = []
    for flag, lines in raised.items():
        known = FLAGS.get(flag)  # an image of another version may carry one that is unknown here
        images = ", ".join(dict.fromkeys(name for names in lines.values() for name in names))
        rows.append((flag, images, "; ".join(lines), *((known.means, known.look) if known else ("", ""))))
    return rows


def _size(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}" if value >= 1e-4 else f"< 0.0001 {unit}" if value else f"0 {unit}"


def _signed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")
