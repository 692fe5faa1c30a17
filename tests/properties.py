"""How many examples a property is tried on: 25 by `make test`, all where `EXAMPLES` is `all`, as in the slow suite."""

import os

from hypothesis import settings

QUICK = 25


def tried(examples: int, *, derandomize: bool = True) -> settings:
    """Settings of a property that is tried on so many examples; the same ones in each run, unless told otherwise."""
    if os.environ.get("EXAMPLES") != "all":
        examples = min(examples, QUICK)
    return settings(max_examples=examples, deadline=None, derandomize=derandomize)
