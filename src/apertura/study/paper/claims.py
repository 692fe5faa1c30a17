"""A claim of the paper beside what this project computes of it, and how such rows are kept."""

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from apertura.atomic import replacement


@dataclass(frozen=True)
class Claim:
    """One row of claims.csv.

    Attributes
    ----------
    claim
        What is claimed, in words.
    claimed, computed
        Values in `unit`; `computed` may carry a spread.
    unit
        Of both.
    verdict
        Whether they agree, and a note where the paper contradicts itself.
    """

    claim: str
    claimed: str
    computed: str
    unit: str
    verdict: str


def compare(
    claim: str,
    claimed: float,
    computed: float,
    unit: str,
    *,
    within: float,
    digits: int = 4,
    note: str = "",
    relative: bool = True,
) -> Claim:
    """Return a row whose verdict says whether the two agree.

    Parameters
    ----------
    claim, claimed, computed, unit
        As in `Claim`.
    within
        Largest difference that still agrees: a share of `claimed`, or in `unit` if not `relative`.
    digits
        Significant digits of `computed`.
    note
        Appended to the verdict.

    Examples
    --------
    >>> compare("bandwidth", 409.6, 409.6, "MHz", within=1e-3).verdict
    'agrees'
    >>> compare("loss", -1.0, -1.7, "dB", within=0.5, relative=False, note="few draws").verdict
    'differs by -0.7 dB; few draws'
    """
    difference = computed - claimed
    if abs(difference) <= within * (abs(claimed) if relative else 1):
        verdict = "agrees"
    elif relative:
        verdict = f"differs by {100 * difference / abs(claimed):+.1f} %"
    else:
        verdict = f"differs by {difference:+.3g} {unit}"
    words = "; ".join(part for part in (verdict, note) if part)
    return Claim(claim, f"{claimed:.10g}", f"{computed:.{digits}g}", unit, words)


def write_claims(path: Path, claims: Iterable[Claim]) -> None:
    """Write rows as CSV; a file that is there is complete."""
    write_rows(path, [field.name for field in fields(Claim)], [asdict(claim) for claim in claims])


def read_claims(path: Path) -> list[Claim]:
    """Return the rows of a file of `write_claims`."""
    with path.open(encoding="utf-8", newline="") as lines:
        return [Claim(**row) for row in csv.DictReader(lines)]


def write_rows(path: Path, columns: list[str], rows: Iterable[dict[str, object]]) -> None:
    """Write a CSV file that is complete or absent."""
    with replacement(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
