"""One row of the claims table: what is expected, by whom, what this project computes, and the verdict."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """One row of claims.csv.

    Attributes
    ----------
    paper
        Value that the source paper prints; empty where it prints none.
    independent_model
        Value of a model that shares no code with this project, or of a closed form; empty where the paper's stands.
        Both are empty for requirements that this project sets itself.
    verdict
        How `computed` compares with what is given, and a note where the paper contradicts itself. It begins with
        "consistency check" where something was fitted to the expected value, so that agreeing proves little.
    """

    claim: str
    paper: str
    independent_model: str
    computed: str
    unit: str
    verdict: str


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
    agreement: str = "agrees",
    note: str = "",
) -> Claim:
    """Return a row whose verdict compares what is computed with the paper or, where it is silent, with a model.

    Parameters
    ----------
    claim, computed, unit, paper, independent_model
        Columns of `Claim`; one of the last two.
    within
        Largest difference that still agrees: a share of the expected value, or in `unit` if not `relative`.
    style
        Format of `computed`.
    agreement, note
        Verdict where the difference is small enough, and what is appended to any.

    Raises
    ------
    ValueError
        If neither or both expected values are given.

    Examples
    --------
    >>> compare("bandwidth", 409.6, "MHz", paper=409.6, within=1e-3).verdict
    'agrees'
    >>> row = compare("loss", -1.7, "dB", independent_model=-1.0, within=0.5, relative=False, note="few draws")
    >>> row.paper, row.independent_model, row.verdict
    ('', '-1', 'differs by -0.7 dB; few draws')
    """
    expected = [value for value in (paper, independent_model) if value is not None]
    if len(expected) != 1:
        raise ValueError(f"{claim}: {paper=}, {independent_model=}: exactly one of them is compared with")
    difference = computed - expected[0]
    if abs(difference) <= within * (abs(expected[0]) if relative else 1):
        verdict = agreement
    elif relative:
        verdict = f"differs by {100 * difference / abs(expected[0]):+.1f} %"
    else:
        verdict = f"differs by {difference:+.3g} {unit}"
    texts = ["" if value is None else f"{value:.10g}" for value in (paper, independent_model)]
    return Claim(claim, texts[0], texts[1], f"{computed:{style}}", unit, _join(verdict, note))


def require(claim: str, computed: float, unit: str, *, limit: str, met: bool, style: str = ".4g", note: str) -> Claim:
    """Return a row of something that neither the paper nor a model puts a number on, but this project does.

    Parameters
    ----------
    claim, computed, unit, style, note
        As for `compare`.
    limit, met
        What the project requires, in words, and whether `computed` meets it.

    Examples
    --------
    >>> require("loss", 0.004, "dB", limit="below 0.01 dB", met=True, note="worst of five").verdict
    "meets this project's requirement (below 0.01 dB); worst of five"
    """
    verdict = f"{'meets' if met else 'misses'} this project's requirement ({limit})"
    return Claim(claim, "", "", f"{computed:{style}}", unit, _join(verdict, note))


def _join(verdict: str, note: str) -> str:
    return f"{verdict}; {note}" if note else verdict
