"""The command `apertura`: out of the working folder first, everything else after that."""

import os
import sys

from apertura.isolation import leave_working_folder

_ENCODING = "PYTHONIOENCODING"


def main() -> None:
    """Leave the working folder, which may be a stranger's, and run the command line."""
    try:
        leave_working_folder()
    except OSError as error:
        print(f"error: the working folder: {error.strerror}. Go to a folder that exists.", file=sys.stderr)
        sys.exit(2)
    # What a terminal cannot show is escaped, here and in every step: names and signs of others are no reason to fail.
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    os.environ[_ENCODING] = f"{os.environ.get(_ENCODING, '').partition(':')[0]}:backslashreplace"
    from apertura.cli import main as run

    run()


if __name__ == "__main__":
    main()
