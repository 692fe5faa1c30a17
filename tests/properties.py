"""Number of examples per property: 25 in `make test`, all if `EXAMPLES` is `all`, as in the slow suite."""

import os

from hypothesis import settings

QUICK = 25


def tried(examples: int, *, derandomize: bool = True) -> settings:
    """Return settings with a number of examples; examples are the same in each run by default."""
    if os.environ.get("EXAMPLES") != "all":
        examples = min(examples, QUICK)
    return settings(max_examples=examples, deadline=None, derandomize=derandomize)
