"""Contents of image.json as values, rows of tables and sentences: for summary, page and map."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.common.documents import undamaged
from apertura.common.errors import shown
from apertura.common.flag_table import FLAGS
from apertura.core.quality.budget import is_counted
from apertura.stages.agreement import report_of

REPORT = "image.json"

Report = Mapping[str, Any]
Cells = tuple[str, ...]

VERDICTS = ("image", "verdict", "peak lost", "expected", "numerical error", "pulses", "flags")
DECISIONS = ("decision", "choice", "why")
BUDGET = ("cause", "stated", "peak lost", "targets shifted", "phase")
FLAGGED = ("flag", "images", "measured", "meaning", "advice")
"""Headings of the tables."""


@dataclass(frozen=True)
class ImageValues:
    """Values of an image report; None and empty where they are not stated.

    Attributes
    ----------
    verdict, why
        Of its focus, and the reason.
    loss_db, expected_db
        Power lost from the peak, as bright points show it and as the error budget expects it, dB, 0 or less.
    worst_cause
        Of the causes stated, the one that the budget expects to cost most.
    not_stated
        Causes of the budget whose size is neither stated nor assumed.
    place_m, place_cause
        Deviation of the places of points that the budget expects, metres, and the cause that moves them most.
    error_db
        Bound of the numerical error, dB.
    used, recorded
        Pulses that make the image, and all.
    coherence, left_out
        Of a sum: how much of full coherence its pairs add up with, and how many of them it leaves out.
    flags
        Name → what was measured.
    """

    verdict: str
    why: str
    loss_db: float | None
    expected_db: float | None
    worst_cause: str
    not_stated: tuple[str, ...]
    place_m: float
    place_cause: str
    error_db: float
    used: int | None
    recorded: int
    coherence: float | None
    left_out: int
    flags: Mapping[str, str]

    @classmethod
    def of(cls, report: Report) -> "ImageValues":
        """Return the values in an image.json."""
        focus, pulses, coherence, fusion = (report.get(key) or {} for key in ("focus", "pulses", "coherence", "fusion"))
        budget = report.get("budget", ())
        worst = min((line for line in budget if is_counted(line)), key=lambda line: line["loss_db"], default=None)
        far = max((line for line in budget if is_counted(line)), key=lambda line: line["shift_m"] or 0.0, default=None)
        used = pulses.get("used")
        return cls(
            str(focus.get("verdict", "")),
            str(focus.get("why", "")),
            focus.get("loss_db"),
            focus.get("expected_db"),
            worst["cause"] if worst else "",
            tuple(line["cause"] for line in budget if not is_counted(line)),
            focus.get("expected_shift_m") or 0.0,
            f"{far['cause']}, {far['stated']}" if far else "",
            float(report["numerical_error_db"]),
            used,
            (used or 0) + (pulses.get("dropped") or 0),
            coherence.get("mean"),
            len(fusion.get("left_out", ())),
            report["flags"],
        )


def read_report(campaign: Campaign, flight: str, image: str) -> dict[str, Any]:
    """Return image.json of a pair or of the sums of a flight, with flags that can be printed.

    Raises
    ------
    CampaignError
        If it is not there, not as it was written, or lacks what every view shows.
    """
    report = report_of(campaign, flight, image)
    with undamaged(
        campaign.result(flight, image, REPORT), expected="the report of an image", remedy="Run the workflow again."
    ):
        report = {**report, "flags": printable(report["flags"])}
        ImageValues.of(report)
    return report


def printable(flags: Mapping[str, str]) -> dict[str, str]:
    """Return flags without control characters and of bounded length."""
    return {shown(flag): shown(line, 2000) for flag, line in flags.items()}


def verdict_row(name: str, report: Report) -> Cells:
    """Return the row of an image among all, under `VERDICTS`.

    Examples
    --------
    >>> focus = {"verdict": "focused", "loss_db": -0.02}
    >>> verdict_row("f01 a-b", {"focus": focus, "flags": {}, "numerical_error_db": -67.8})
    ('f01 a-b', 'focused', '0.02 dB', '', 'below −67.8 dB', '', 'none')
    """
    values = ImageValues.of(report)
    return (
        name,
        values.verdict,
        decibels(values.loss_db, 2),
        decibels(values.expected_db, 2),
        f"below {_signed(values.error_db, 1)} dB",
        "" if values.used is None else f"{values.used} of {values.recorded}",
        ", ".join(values.flags) or "none",
    )


def decibels(loss_db: float | None, digits: int) -> str:
    """Return a loss as people write it; nothing where there is none.

    Examples
    --------
    >>> decibels(-0.02, 1), decibels(None, 2)
    ('0.0 dB', '')
    """
    return "" if loss_db is None else f"{abs(loss_db):.{digits}f} dB"


def sentences(name: str, report: Report) -> Iterator[str]:
    """Yield sentences for a results section on an image: focus, certificate, agreement.

    Parameters
    ----------
    name
        Of the image.
    report
        Its image.json.
    """
    focus = report.get("focus") or {}
    if focus:
        yield f"{name}: {focus.get('verdict', 'not judged')}; {focus.get('why', 'no reason stated')}."
    yield certificate(report)
    agreement = report.get("agreement")
    if agreement and report.get("reference") != report.get("pair"):
        shift_m = float((agreement["shift_east_m"] ** 2 + agreement["shift_north_m"] ** 2) ** 0.5)
        yield (
            f"Against {report['reference']}, {agreement['points']:.0f} {agreement['by']} lie "
            f"{100 * shift_m:.1f} cm apart and "
            f"{_signed(agreement['phase_rad'], 3)} ± {agreement['phase_std_rad']:.3f} rad out of phase."
        )
    coherence = report.get("coherence") or {}
    if coherence.get("mean") is not None:
        yield f"The pairs add up with {coherence['mean']:.3f} of full coherence ({coherence['chance']:.2f} by chance)."
    if gain := report.get("gain"):
        over_db, noise_db = gain["over_best_pair_db"], gain["allowed_db"]
        beyond = " More is gained where the pairs' sidelobes, seen from different places, cancel." * (
            over_db > noise_db
        )
        yield (
            f"Between the targets it is {abs(over_db):.1f} dB {'lower' if over_db >= 0 else 'higher'} against the peak "
            f"than {gain['best_pair']}, its best pair; noise that pairs do not share allows {noise_db:.1f} dB.{beyond}"
        )
        yield _cut_sentence(report["brightest"])


def _cut_sentence(brightest: Mapping[str, Any]) -> str:
    """Return widths and sidelobes of a target, where its cuts hold them."""
    parts = []
    for name, words in (("cross_range", "along the flight"), ("ground_range", "across it")):
        width, pslr = brightest.get(f"{name}_width_m"), brightest.get(f"{name}_pslr_db")
        if width is not None:
            lobe = "" if pslr is None else f", its highest sidelobe {_signed(pslr, 1)} dB"
            parts.append(f"{100 * width:.1f} cm wide {words}{lobe}")
    return f"Its brightest target is {' and '.join(parts) or 'wider than its cuts'}."


def certificate(report: Report) -> str:
    """Return the certificate of an image's arithmetic, in a sentence.

    Examples
    --------
    >>> certificate({"numerical_error_db": -67.8, "numerical_error_confidence": 0.95, "certified_pixels": 272})
    'Its numerical error lies below −67.8 dB (95 % sure), measured at 272 pixels against a double sum in float64.'
    """
    pixels = report.get("certified_pixels")
    where = f"measured at {pixels} pixels against a double sum in float64" if pixels else "that of its worst pair"
    sure = f"{100 * report['numerical_error_confidence']:.0f} % sure"
    return f"Its numerical error lies below {_signed(report['numerical_error_db'], 1)} dB ({sure}), {where}."


def decision_rows(report: Report) -> list[Cells]:
    """Return the planner's decisions, under `DECISIONS`.

    Examples
    --------
    >>> decision_rows({"models": {"presum": "1: the scene is wide"}})
    [('presum', '1', 'the scene is wide')]
    """
    rows: list[Cells] = []
    for name, line in (report.get("models") or {}).items():
        choice, _, why = str(line).partition(": ")
        rows.append((name.replace("_", " "), choice if why else "", why or choice))
    return rows


def shared_rows(reports: Mapping[str, Report]) -> list[Cells]:
    """Return the decisions of several images, each once, with the images that it was made for.

    Examples
    --------
    >>> shared_rows({"a-a": {"models": {"degree": "1: cheap"}}, "a-b": {"models": {"degree": "1: cheap"}}})
    [('a-a, a-b', 'degree', '1', 'cheap')]
    """
    made: dict[Cells, list[str]] = {}
    for name, report in reports.items():
        for row in decision_rows(report):
            made.setdefault(row, []).append(name)
    return [(", ".join(names), *row) for row, names in sorted(made.items())]


def budget_rows(lines: Sequence[Report]) -> list[Cells]:
    """Return the rows of an error budget, under `BUDGET`; in brackets what is assumed and not stated.

    Examples
    --------
    >>> budget_rows([{"cause": "heights", "stated": "not stated; 1 m would do this", "loss_db": -0.02, "shift_m": 0.4,
    ...               "phase_rad": None}])
    [('heights', 'not stated; 1 m would do this', '(0.02 dB)', '(0.4 m)', '')]
    """
    rows: list[Cells] = []
    for line in lines:
        bracket = "{}" if is_counted(line) else "({})"
        sizes = (
            "" if line[name] is None else bracket.format(_size_text(abs(line[name]), unit))
            for name, unit in (("loss_db", "dB"), ("shift_m", "m"), ("phase_rad", "rad"))
        )
        rows.append((line["cause"], line["stated"], *sizes))
    return rows


@dataclass(frozen=True)
class RaisedFlag:
    """A flag that some images carry.

    Attributes
    ----------
    name
        Of the flag.
    measured
        What was measured → the images of which.
    meaning, advice
        From the table of flags; empty for a flag that another version has raised.
    """

    name: str
    measured: Mapping[str, Sequence[str]]
    meaning: str
    advice: str


def raised_flags(reports: Mapping[str, Report], *, quotes: bool = True) -> list[RaisedFlag]:
    """Return each flag once.

    Parameters
    ----------
    reports
        Name of an image → its image.json, that of sums after those of their pairs.
    quotes
        With the lines in which sums only quote their pairs.
    """
    raised: dict[str, dict[str, list[str]]] = {}
    for image, report in reports.items():
        for flag, line in report["flags"].items():
            images = raised.setdefault(flag, {})
            if quotes or not image.endswith(FUSED) or not any(known in line for known in images):
                images.setdefault(line, []).append(image)
    return [RaisedFlag(flag, lines, *_explained(flag)) for flag, lines in raised.items()]


def flag_rows(reports: Mapping[str, Report]) -> list[Cells]:
    """Return each flag once, under `FLAGGED`.

    Parameters
    ----------
    reports
        Name of an image → its image.json.

    Examples
    --------
    >>> flag_rows({"a-a": {"flags": {"saturated_radar": "3 of 5"}}, "a-b": {"flags": {"new": "?"}}})[1]
    ('new', 'a-b', '?', '', '')
    """
    return [
        (
            flag.name,
            ", ".join(dict.fromkeys(image for images in flag.measured.values() for image in images)),
            "; ".join(flag.measured),
            flag.meaning,
            flag.advice,
        )
        for flag in raised_flags(reports)
    ]


def explained_flags(flags: Mapping[str, str]) -> dict[str, str]:
    """Return flag → sentences: the measured value, its meaning and the advice.

    Examples
    --------
    >>> explained_flags({"new": "3 of 5."})
    {'new': '3 of 5.'}
    """
    explained = {}
    for flag, line in flags.items():
        meaning, advice = _explained(flag)
        words = [line.rstrip("."), *([meaning, f"advice: {advice}"] if meaning else [])]
        explained[flag] = " ".join(f"{sentence}." for sentence in words)
    return explained


def _explained(flag: str) -> tuple[str, str]:
    known = FLAGS.get(flag)  # an image of another version may carry one that is unknown here
    return (known.meaning, known.advice) if known else ("", "")


def _size_text(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}" if value >= 1e-4 else f"< 0.0001 {unit}" if value else f"0 {unit}"


def _signed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")
