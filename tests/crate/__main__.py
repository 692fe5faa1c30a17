"""roc-validator on the crate of a finished campaign, offline, and every file against its hash.

    python -m tests.crate CAMPAIGN

The validator has an environment of its own, ``build/roc``, installed by hash from ``requirements/roc.txt`` when it is
not there. Prints what is wrong, and ends with 1 if anything is.
"""

import sys
from pathlib import Path

from tests.crate.validator import issues, make_environment


def main() -> None:
    (campaign,) = sys.argv[1:] or sys.exit("which campaign? python -m tests.crate CAMPAIGN")
    make_environment()
    wrong = issues(Path(campaign) / "results")
    for line in wrong:
        print(line)
    if wrong:
        sys.exit(1)
    print("a valid Provenance Run Crate, every file as it was made")


if __name__ == "__main__":
    main()
