"""The command `apertura`: out of the working folder first, everything else after that."""

import sys

from apertura.isolation import leave_working_folder


def main() -> None:
    """Leave the working folder, which may be a stranger's, and run the command line."""
    try:
        leave_working_folder()
    except OSError as error:
        sys.exit(f"error: the working folder: {error.strerror}. Go to a folder that exists.")
    from apertura.cli import main as run

    run()


if __name__ == "__main__":
    main()
