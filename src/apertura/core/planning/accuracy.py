"""How exact arithmetic must be: well below what else is known to spoil the image, and no better."""

from collections.abc import Sequence

from apertura.core.planning.plan import Decision
from apertura.core.quality.budget import (
    ARITHMETIC_BELOW_DB,
    LEAST_ACCURACY_DB,
    MOST_ACCURACY_DB,
    BudgetLine,
    accuracy_for,
)


def decide_accuracy(lines: Sequence[BudgetLine]) -> Decision:
    """Return the numerical error to ask for, and the line of the error budget that it follows from.

    Examples
    --------
    >>> from apertura.core.quality.path_errors import Effect
    >>> decide_accuracy([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))]).reason
    'auto: 10 dB below positions (1 cm)'
    """
    value, stated = accuracy_for(lines), [line for line in lines if line.stated is not None]
    largest = min(stated, key=lambda line: line.effect.loss_db, default=None)
    if largest is None or value == MOST_ACCURACY_DB:
        return Decision("accuracy_db", value, "auto: nothing known spoils the image more, and better shows nowhere")
    cause = f"{largest.cause} ({largest.stated})"
    if value == LEAST_ACCURACY_DB:
        return Decision("accuracy_db", value, f"auto: {cause} spoil the image more, and worse would show")
    return Decision("accuracy_db", value, f"auto: {ARITHMETIC_BELOW_DB:g} dB below {cause}")
