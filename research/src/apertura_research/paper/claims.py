"""One row of the claims table: what is expected, by whom, what this project computes, and the verdict."""

from dataclasses import dataclass

AGREES, DISAGREES, EXPLAINED, UNTESTABLE = "agrees", "disagrees", "explained", "not testable here"
VERDICTS = (AGREES, DISAGREES, EXPLAINED, UNTESTABLE)
"""`explained`: it differs from what is expected and the note says why; `not testable here`: it says what lacks."""


@dataclass(frozen=True)
class Claim:
    """One row of claims.csv.

    Attributes
    ----------
    paper
        Number that the source paper prints, as printed; empty where it prints none.
    independent_model
        Value of a model that shares no code with this project, or of a closed form; empty where there is none.
    verdict
        One of `VERDICTS`: how `computed` compares with the paper or, where that prints no number, with the model.
    note
        By how much it differs, why, from what it is computed, and where the paper contradicts itself.
    """

    claim: str
    paper: str
    independent_model: str
    computed: str
    unit: str
    verdict: str
    note: str


def compare(
    claim: str,
    computed: float,
    unit: str,
    *,
    paper: float | None = None,
    independent_model: float | None = None,
    within: float,
    relative: bool = True,
    style: str = ".4g",
    reason: str = "",
    note: str = "",
) -> Claim:
    """Return a row whose verdict compares what is computed with the paper or, where it is silent, with a model.

    Parameters
    ----------
    claim, computed, unit, paper, independent_model, note
        Columns of `Claim`; at least one of `paper` and `independent_model`.
    within
        Largest difference that still agrees: a share of the expected value, or in `unit` if not `relative`.
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
    >>> compare("bandwidth", 409.6, "MHz", paper=409.6, within=1e-3).verdict
    'agrees'
    >>> row = compare("loss", -1.7, "dB", independent_model=-1.0, within=0.5, relative=False, note="few draws")
    >>> row.paper, row.independent_model, row.verdict, row.note
    ('', '-1', 'disagrees', 'differs by -0.7 dB; few draws')
    """
    expected = independent_model if paper is None else paper
    if expected is None:
        raise ValueError(f"{claim}: neither a value of the paper nor of a model to compare with")
    difference = computed - expected
    printed, modelled = ("" if value is None else f"{value:.10g}" for value in (paper, independent_model))
    shown = f"{computed:{style}}"
    if abs(difference) <= within * (abs(expected) if relative else 1):
        return Claim(claim, printed, modelled, shown, unit, AGREES, note)
    by = f"{100 * difference / abs(expected):+.1f} %" if relative else f"{difference:+.3g} {unit}"
    verdict = EXPLAINED if reason else DISAGREES
    return Claim(claim, printed, modelled, shown, unit, verdict, _join(f"differs by {by}", reason, note))


def require(claim: str, computed: float, unit: str, *, limit: str, met: bool, style: str = ".4g", note: str) -> Claim:
    """Return a row of something stated without a number, compared with a limit of this project's own.

    Parameters
    ----------
    claim, computed, unit, style, note
        As for `compare`.
    limit, met
        What is required, in words, and whether `computed` meets it.

    Examples
    --------
    >>> row = require("loss", 0.004, "dB", limit="below 0.01 dB", met=True, note="worst of five")
    >>> row.verdict, row.note
    ('agrees', 'required here: below 0.01 dB; worst of five')
    """
    verdict = AGREES if met else DISAGREES
    return Claim(claim, "", "", f"{computed:{style}}", unit, verdict, _join(f"required here: {limit}", note))


def _join(*parts: str) -> str:
    return "; ".join(filter(None, parts))
