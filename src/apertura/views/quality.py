"""Contents of image.json as values, table rows and sentences, for summary, report page and map."""

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

VERDICTS = ("image", "verdict", "peak loss", "expected loss", "numerical error", "pulses", "flags")
DECISIONS = ("decision", "value", "reason")
BUDGET = ("cause", "size", "peak loss", "displacement", "phase")
FLAGGED = ("flag", "images", "measurement", "meaning", "advice")
PAYLOAD = ("node", "sent", "recorded", "intact", "SNR, dB", "EVM, dB", "SER", "FER", "bit/s")
"""Table headers."""


@dataclass(frozen=True)
class ImageValues:
    """Values of an image report; None or empty if the report does not contain them.

    Attributes
    ----------
    verdict, reason
        Focus verdict, and the reason for the verdict.
    loss_db, expected_db
        Peak loss measured at bright points, and peak loss predicted by the error budget, dB, 0 or less.
    worst_cause
        Cause with the largest predicted peak loss, among the causes of stated or assumed size.
    not_stated
        Causes in the error budget whose size is neither stated nor assumed.
    place_m, place_cause
        Expected displacement of points, metres, and the cause with the largest contribution.
    error_db
        Upper bound of the numerical error, dB.
    used, recorded
        Numbers of pulses used in the image, and of pulses recorded.
    coherence, excluded
        Coherence of the pairs of a sum, and number of pairs excluded from the sum.
    flags
        Flag → measurement.
    """

    verdict: str
    reason: str
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
    excluded: int
    flags: Mapping[str, str]

    @classmethod
    def of(cls, report: Report) -> "ImageValues":
        """Return the values in the contents of an image.json."""
        focus, pulses, coherence, fusion = (report.get(key) or {} for key in ("focus", "pulses", "coherence", "fusion"))
        budget = report.get("budget", ())
        counted = [line for line in budget if is_counted(line)]
        most_lossy = min(counted, key=lambda line: line["loss_db"], default=None)
        most_shifting = max(counted, key=lambda line: line["shift_m"] or 0.0, default=None)
        used = pulses.get("used")
        return cls(
            str(focus.get("verdict", "")),
            str(focus.get("reason", "")),
            focus.get("loss_db"),
            focus.get("expected_db"),
            most_lossy["cause"] if most_lossy else "",
            tuple(line["cause"] for line in budget if not is_counted(line)),
            focus.get("expected_shift_m") or 0.0,
            f"{most_shifting['cause']} ({most_shifting['stated']})" if most_shifting else "",
            float(report["numerical_error_db"]),
            used,
            (used or 0) + (pulses.get("dropped") or 0),
            coherence.get("mean"),
            len(fusion.get("excluded", ())),
            report["flags"],
        )


def read_report(campaign: Campaign, flight: str, image: str) -> dict[str, Any]:
    """Read image.json of a pair or of the sums of a flight, with printable flags.

    Raises
    ------
    CampaignError
        If the file is missing, was modified, or lacks a value that all views require.
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
    """Return the table row of an image, with the columns `VERDICTS`.

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
    """Format a loss as a positive number of dB; empty for None.

    Examples
    --------
    >>> decibels(-0.02, 1), decibels(None, 2)
    ('0.0 dB', '')
    """
    return "" if loss_db is None else f"{abs(loss_db):.{digits}f} dB"


def sentences(name: str, report: Report) -> Iterator[str]:
    """Yield sentences on an image for a results section: focus, numerical error, agreement with other images.

    Parameters
    ----------
    name
        Name of the image.
    report
        Contents of the image's image.json.

    Examples
    --------
    >>> next(sentences("f01 a-b", {"focus": {"verdict": "focused", "reason": "the peak loss is below 0.2 dB"}}))
    'f01 a-b: focused; the peak loss is below 0.2 dB.'
    """
    focus = report.get("focus") or {}
    if focus:
        yield f"{name}: {focus.get('verdict', 'not judged')}; {focus.get('reason', 'no reason stated')}."
    yield certificate(report)
    agreement = report.get("agreement")
    if agreement and report.get("reference") != report.get("pair"):
        shift_m = float((agreement["shift_east_m"] ** 2 + agreement["shift_north_m"] ** 2) ** 0.5)
        yield (
            f"Comparison with {report['reference']} at {agreement['points']:.0f} {agreement['by']}: displacement "
            f"{100 * shift_m:.1f} cm, phase difference "
            f"{_signed(agreement['phase_rad'], 3)} ± {agreement['phase_std_rad']:.3f} rad."
        )
    coherence = report.get("coherence") or {}
    if coherence.get("mean") is not None:
        yield f"Coherence of the pairs: {coherence['mean']:.3f} (for random phases: {coherence['chance']:.2f})."
    if gain := report.get("gain"):
        over_db, noise_db = gain["over_best_pair_db"], gain["allowed_db"]
        sidelobes = " The additional reduction is caused by sidelobes of the pairs, which cancel in the sum."
        yield (
            f"The background between targets, relative to the peak, is {abs(over_db):.1f} dB "
            f"{'lower' if over_db >= 0 else 'higher'} than in {gain['best_pair']}, the best pair. Averaging of "
            f"uncorrelated noise accounts for up to {noise_db:.1f} dB.{sidelobes * (over_db > noise_db)}"
        )
        yield _cut_sentence(report["brightest"])


def _cut_sentence(brightest: Mapping[str, Any]) -> str:
    """Return a sentence with the −3 dB widths and sidelobe ratios of a target, as far as its cuts contain them."""
    parts = []
    for name, direction in (("cross_range", "in cross-range"), ("ground_range", "in ground range")):
        width, pslr = brightest.get(f"{name}_width_m"), brightest.get(f"{name}_pslr_db")
        if width is not None:
            sidelobe = "" if pslr is None else f" (PSLR {_signed(pslr, 1)} dB)"
            parts.append(f"{100 * width:.1f} cm {direction}{sidelobe}")
    return f"−3 dB width of the brightest target: {', '.join(parts) or 'larger than the length of the cuts'}."


def certificate(report: Report) -> str:
    """Return a sentence with the certified bound of an image's numerical error.

    Examples
    --------
    >>> certificate({"numerical_error_db": -67.8, "numerical_error_confidence": 0.95, "certified_pixels": 272})
    'Numerical error below −67.8 dB (95 % confidence), relative to the exact sum in float64 at 272 pixels.'
    """
    pixels = report.get("certified_pixels")
    source = f"relative to the exact sum in float64 at {pixels} pixels" if pixels else "the bound of the worst pair"
    confidence = f"{100 * report['numerical_error_confidence']:.0f} % confidence"
    return f"Numerical error below {_signed(report['numerical_error_db'], 1)} dB ({confidence}), {source}."


def decision_rows(report: Report) -> list[Cells]:
    """Return table rows of the planner's decisions, with the columns `DECISIONS`.

    Examples
    --------
    >>> decision_rows({"models": {"presum": "1: the scene is wide"}})
    [('presum', '1', 'the scene is wide')]
    """
    rows: list[Cells] = []
    for name, line in (report.get("models") or {}).items():
        value, _, reason = str(line).partition(": ")
        rows.append((name.replace("_", " "), value if reason else "", reason or value))
    return rows


def shared_rows(reports: Mapping[str, Report]) -> list[Cells]:
    """Return table rows of the decisions of several images; each decision is listed once with the names of the images.

    Examples
    --------
    >>> shared_rows({"a-a": {"models": {"degree": "1: cheap"}}, "a-b": {"models": {"degree": "1: cheap"}}})
    [('a-a, a-b', 'degree', '1', 'cheap')]
    """
    names_of: dict[Cells, list[str]] = {}
    for name, report in reports.items():
        for row in decision_rows(report):
            names_of.setdefault(row, []).append(name)
    return [(", ".join(names), *row) for row, names in sorted(names_of.items())]


def budget_rows(lines: Sequence[Report]) -> list[Cells]:
    """Return table rows of an error budget, with the columns `BUDGET`; effects not in the sum are in brackets.

    Examples
    --------
    >>> budget_rows([{"cause": "heights", "stated": "not configured; effect computed for 1 m", "loss_db": -0.02,
    ...               "shift_m": 0.4, "phase_rad": None}])
    [('heights', 'not configured; effect computed for 1 m', '(0.02 dB)', '(0.4 m)', '')]
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
    """A flag that is raised for at least one image.

    Attributes
    ----------
    name
        Name of the flag.
    measured
        Measurement → names of the images for which the flag reports it.
    meaning, advice
        Meaning of the flag and advice; empty for a flag that this version of apertura does not define.
    """

    name: str
    measured: Mapping[str, Sequence[str]]
    meaning: str
    advice: str


def raised_flags(reports: Mapping[str, Report], *, quotes: bool = True) -> list[RaisedFlag]:
    """Return the raised flags without repetition.

    Parameters
    ----------
    reports
        Name of an image → contents of its image.json; sums follow their pairs.
    quotes
        Include measurements of sums that only repeat measurements of the pairs.
    """
    raised: dict[str, dict[str, list[str]]] = {}
    for image, report in reports.items():
        for flag, line in report["flags"].items():
            images = raised.setdefault(flag, {})
            if quotes or not image.endswith(FUSED) or not any(earlier in line for earlier in images):
                images.setdefault(line, []).append(image)
    return [RaisedFlag(flag, lines, *_explained(flag)) for flag, lines in raised.items()]


def flag_rows(reports: Mapping[str, Report]) -> list[Cells]:
    """Return table rows of the raised flags, with the columns `FLAGGED`.

    Parameters
    ----------
    reports
        Name of an image → contents of its image.json.

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


def payload_row(summary: Report) -> Cells:
    """Return the table row of a node in payload.json; NaN: no direct path was detected in any frame."""
    formats = {"sent": "d", "frames": "d", "intact": "d", "snr_db": ".1f", "evm_db": ".1f"}
    formats |= {"symbol_error_rate_expected": ".1e", "frame_error_rate": ".3g", "received_bit_s": ".0f"}
    values = {name: summary.get(name) for name in formats}
    cells = (format(float("nan") if values[name] is None else values[name], form) for name, form in formats.items())
    return summary["node"], *cells


def explained_flags(flags: Mapping[str, str]) -> dict[str, str]:
    """Return flag → sentences with measurement, meaning and advice.

    Examples
    --------
    >>> explained_flags({"new": "3 of 5."})
    {'new': '3 of 5.'}
    """
    explained = {}
    for flag, line in flags.items():
        meaning, advice = _explained(flag)
        sentences_of = [line.rstrip("."), *([meaning, f"Advice: {advice}"] if meaning else [])]
        explained[flag] = " ".join(f"{sentence}." for sentence in sentences_of)
    return explained


def _explained(flag: str) -> tuple[str, str]:
    definition = FLAGS.get(flag)  # an image made by another version may have a flag that this version does not define
    return (definition.meaning, definition.advice) if definition else ("", "")


def _size_text(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}" if value >= 1e-4 else f"< 0.0001 {unit}" if value else f"0 {unit}"


def _signed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")
