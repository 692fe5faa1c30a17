"""roc-validator on the crate of a finished campaign, offline, and every file against its hash.

    python -m tests.crate CAMPAIGN

The validator has its own environment, ``build/roc``, installed by hash from ``requirements/roc.txt`` if it does not
exist. Prints the issues found and exits with status 1 if there are any.
"""

import sys
from pathlib import Path

from tests.crate.validator import issues, make_environment


def main() -> None:
    (campaign,) = sys.argv[1:] or sys.exit("no campaign folder given; usage: python -m tests.crate CAMPAIGN")
    make_environment()
    found = issues(Path(campaign) / "results")
    for line in found:
        print(line)
    if found:
        sys.exit(1)
    print("valid Provenance Run Crate, all files agree with their hashes")


if __name__ == "__main__":
    main()
