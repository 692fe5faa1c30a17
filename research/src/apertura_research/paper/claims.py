"""One row of the claims table: what is printed, what this project computes, and what the verdict is about."""

from dataclasses import dataclass, replace
from math import isinf

AGREES, DISAGREES, EXPLAINED, UNTESTABLE = "agrees", "disagrees", "explained", "not testable here"
VERDICTS = (AGREES, DISAGREES, EXPLAINED, UNTESTABLE)
"""`explained`: it differs from what is expected and the note says why, or agrees by construction; `not testable here`:
the note says what lacks."""

PAPER, MODEL, OWN = "paper", "model", "own limit"
"""What a verdict is about: a number or words of the source paper; another model; a limit that this project sets."""


@dataclass(frozen=True)
class Claim:
    """One row of claims.csv.

    Attributes
    ----------
    paper
        Number that the source paper prints for it, digit by digit; empty where it prints none.
    independent_model
        Value of a model that shares no code with this project, or of a closed form; empty where there is none.
    about
        What the verdict is about: `PAPER`, `MODEL` or `OWN`.
    verdict
        One of `VERDICTS`.
    note
        By how much it differs, why, from what it is computed, and where the paper contradicts itself.
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
    """Return a row whose verdict compares what is computed with the paper or, where it is silent, with a model.

    Parameters
    ----------
    claim, computed, unit, paper, independent_model, note
        Columns of `Claim`; at least one of `paper`, as printed, and `independent_model`.
    within
        Largest difference that still agrees: a share of the expected value, or in `unit` if not `relative`; None: what
        rounds to the digits that the paper prints agrees.
    style
        Format of `computed`.
    reason
        What explains a difference, if one is known; empty: a difference is a disagreement.

    Raises
    ------
    ValueError
        If there is nothing to compare with.

    Examples
    --------
    >>> compare("duty cycle", 0.15625, "%", paper="0.156").verdict
    'agrees'
    >>> row = compare("loss", -1.7, "dB", independent_model=-1.0, within=0.5, relative=False, note="few draws")
    >>> row.paper, row.independent_model, row.about, row.verdict, row.note
    ('', '-1', 'model', 'disagrees', 'differs by -0.7 dB; few draws')
    >>> compare("width", 57.35, "cm", paper="58", within=0.05).note
    'differs by -1.1 %, ±5 % allowed here'
    """
    if not paper and independent_model is None:
        raise ValueError(f"{claim}: neither a value of the paper nor of a model to compare with")
    expected = float(paper or independent_model or 0.0)
    difference = computed - expected
    allowed = half_digit(paper) if within is None else within * (abs(expected) if relative else 1)
    modelled, shown = "" if independent_model is None else f"{independent_model:.4g}", f"{computed:{style}}"
    about = PAPER if paper else MODEL
    by = f"{100 * difference / abs(expected):+.1f} %" if relative else f"{difference:+.3g} {unit}"
    if abs(difference) <= allowed * (1 + 1e-9):
        share = f"{100 * within:g} %" if within and relative else f"{allowed:.2g} {unit}"
        chosen = "" if within is None or isinf(within) else f"differs by {by}, ±{share} allowed here"
        return Claim(claim, paper, modelled, shown, unit, about, AGREES, _join(chosen, note))
    verdict = EXPLAINED if reason else DISAGREES
    return Claim(claim, paper, modelled, shown, unit, about, verdict, _join(f"differs by {by}", reason, note))


def half_digit(printed: str) -> float:
    """Return the largest distance of a number from a printed one to which it still rounds.

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
    """Return a row of something without a number, compared with a limit of this project's own.

    Parameters
    ----------
    claim, computed, unit, style, reason, note
        As for `compare`.
    limit, met
        What is required, in words, and whether `computed` meets it.
    words
        What the paper says, which the verdict is about then: the limit is how it is read here.

    Examples
    --------
    >>> row = require("loss", 0.004, "dB", limit="below 0.01 dB", met=True, note="worst of five")
    >>> row.about, row.verdict, row.note
    ('own limit', 'agrees', 'required here: below 0.01 dB; worst of five')
    >>> row = require("loss", 4.0, "dB", limit="below 1 dB", met=False, words="may be ignored", note="")
    >>> row.about, row.verdict, row.note
    ('paper', 'disagrees', 'the paper: may be ignored; read here as: below 1 dB')
    """
    verdict = AGREES if met else EXPLAINED if reason else DISAGREES
    said = (f"the paper: {words}", f"read here as: {limit}") if words else (f"required here: {limit}",)
    about = PAPER if words else OWN
    return Claim(claim, "", "", f"{computed:{style}}", unit, about, verdict, _join(*said, reason, note))


def fitted_to(row: Claim) -> Claim:
    """Return a row as explained where it agrees with what was chosen for it: that proves nothing.

    Examples
    --------
    >>> fitted_to(compare("width", 11.0, "cm", paper="11", note="place chosen for it")).note
    'agrees by construction; place chosen for it'
    """
    if row.verdict != AGREES:
        return row
    return replace(row, verdict=EXPLAINED, note=_join("agrees by construction", row.note))


def _join(*parts: str) -> str:
    return "; ".join(filter(None, parts))
