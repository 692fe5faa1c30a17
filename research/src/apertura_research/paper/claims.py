"""Row of the claims table: the printed value, the computed value, the verdict, and its reference."""

from dataclasses import dataclass, replace
from math import isinf

AGREES, DISAGREES, EXPLAINED, UNTESTABLE = "agrees", "disagrees", "explained", "not testable"
VERDICTS = (AGREES, DISAGREES, EXPLAINED, UNTESTABLE)
"""`explained`: the value differs for a reason stated in the note, or agrees by construction; `not testable`: the
note states the missing information."""

PAPER, MODEL, OWN = "paper", "model", "own limit"
"""References of a verdict: a number or statement of the source paper; another model; a limit set by this project."""


@dataclass(frozen=True)
class Claim:
    """One row of claims.csv.

    Attributes
    ----------
    paper
        Number printed in the source paper, digit by digit; empty if the paper prints no number.
    independent_model
        Value of a model that shares no code with this project, or of a closed form; empty if there is none.
    about
        Reference of the verdict: `PAPER`, `MODEL` or `OWN`.
    verdict
        One of `VERDICTS`.
    note
        Size and reason of a difference, inputs of the computation, and contradictions in the paper.
    """

    claim: str
    paper: str
    independent_model: str
    computed: str
    unit: str
    about: str
    verdict: str
    note: str


def compare(
    claim: str,
    computed: float,
    unit: str,
    *,
    paper: str = "",
    independent_model: float | None = None,
    within: float | None = None,
    relative: bool = True,
    style: str = ".4g",
    reason: str = "",
    note: str = "",
) -> Claim:
    """Return a row whose verdict compares the computed value with the paper or, without a printed value, with a model.

    Parameters
    ----------
    claim, computed, unit, paper, independent_model, note
        Columns of `Claim`; at least one of `paper`, as printed, and `independent_model`.
    within
        Largest difference that still agrees: a fraction of the expected value, or in `unit` if not `relative`; None:
        values that round to the printed digits agree.
    style
        Format of `computed`.
    reason
        Known reason of a difference; empty: a difference is a disagreement.

    Raises
    ------
    ValueError
        If there is no value to compare with.

    Examples
    --------
    >>> compare("duty cycle", 0.15625, "%", paper="0.156").verdict
    'agrees'
    >>> row = compare("loss", -1.7, "dB", independent_model=-1.0, within=0.5, relative=False, note="few draws")
    >>> row.paper, row.independent_model, row.about, row.verdict, row.note
    ('', '-1', 'model', 'disagrees', 'differs by -0.7 dB; few draws')
    >>> compare("width", 57.35, "cm", paper="58", within=0.05).note
    'differs by -1.1 %, tolerance ±5 %'
    """
    if not paper and independent_model is None:
        raise ValueError(f"{claim}: no value of the paper or of a model to compare with")
    expected = float(paper or independent_model or 0.0)
    difference = computed - expected
    allowed = half_digit(paper) if within is None else within * (abs(expected) if relative else 1)
    modelled, shown = "" if independent_model is None else f"{independent_model:.4g}", f"{computed:{style}}"
    about = PAPER if paper else MODEL
    by = f"{100 * difference / abs(expected):+.1f} %" if relative else f"{difference:+.3g} {unit}"
    if abs(difference) <= allowed * (1 + 1e-9):
        share = f"{100 * within:g} %" if within and relative else f"{allowed:.2g} {unit}"
        tolerance = "" if within is None or isinf(within) else f"differs by {by}, tolerance ±{share}"
        return Claim(claim, paper, modelled, shown, unit, about, AGREES, _join(tolerance, note))
    verdict = EXPLAINED if reason else DISAGREES
    return Claim(claim, paper, modelled, shown, unit, about, verdict, _join(f"differs by {by}", reason, note))


def half_digit(printed: str) -> float:
    """Return half a unit in the last printed digit: the largest difference of a number that rounds to it.

    Examples
    --------
    >>> half_digit("0.156"), half_digit("58")
    (0.0005, 0.5)
    """
    return 0.5 * 10.0 ** -len(printed.partition(".")[2])


def require(
    claim: str,
    computed: float,
    unit: str,
    *,
    limit: str,
    met: bool,
    words: str = "",
    style: str = ".4g",
    reason: str = "",
    note: str,
) -> Claim:
    """Return a row that compares a computed value with a limit set by this project.

    Parameters
    ----------
    claim, computed, unit, style, reason, note
        See `compare`.
    limit, met
        The requirement as text, and True if `computed` meets it.
    words
        Statement of the paper that the limit quantifies; the verdict then refers to this statement.

    Examples
    --------
    >>> row = require("loss", 0.004, "dB", limit="below 0.01 dB", met=True, note="worst of five")
    >>> row.about, row.verdict, row.note
    ('own limit', 'agrees', 'required: below 0.01 dB; worst of five')
    >>> row = require("loss", 4.0, "dB", limit="below 1 dB", met=False, words="may be ignored", note="")
    >>> row.about, row.verdict, row.note
    ('paper', 'disagrees', 'the paper: may be ignored; interpreted as: below 1 dB')
    """
    verdict = AGREES if met else EXPLAINED if reason else DISAGREES
    requirement = (f"the paper: {words}", f"interpreted as: {limit}") if words else (f"required: {limit}",)
    about = PAPER if words else OWN
    return Claim(claim, "", "", f"{computed:{style}}", unit, about, verdict, _join(*requirement, reason, note))


def fitted_to(row: Claim) -> Claim:
    """Mark an agreeing row as explained if its parameters were fitted to the printed value: no confirmation.

    Examples
    --------
    >>> fitted_to(compare("width", 11.0, "cm", paper="11", note="fitted position")).note
    'agrees by construction; fitted position'
    """
    if row.verdict != AGREES:
        return row
    return replace(row, verdict=EXPLAINED, note=_join("agrees by construction", row.note))


def _join(*parts: str) -> str:
    return "; ".join(filter(None, parts))
