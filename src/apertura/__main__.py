"""Entry point of the command `apertura`: change out of the working directory before all other imports."""

import os
import sys
from pathlib import Path
from typing import NoReturn

from apertura.common.errors import CampaignError
from apertura.common.platforms import require_linux

_ENCODING, _BACKEND = "PYTHONIOENCODING", "MPLBACKEND"
_PROJ = ("PROJ_DATA", "PROJ_LIB")
"""Environment variables: folders of PROJ's tables, for pyproj and for GDAL."""


def _refuse(message: str) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def main() -> None:
    """Change out of the working directory, which may be untrusted, and run the command line."""
    try:
        require_linux("the command apertura")
    except CampaignError as error:
        _refuse(str(error))
    from apertura.common.processes import ALGEBRA_THREADS, leave_working_folder

    try:
        leave_working_folder()
    except OSError as error:
        _refuse(f"the working directory: {error.strerror}. Go to a folder that exists.")
    for name in _PROJ:
        folders = list(filter(None, os.environ.get(name, "").split(os.pathsep)))
        if folders and not any(Path(folder, "proj.db").is_file() for folder in folders):
            _refuse(f"environment variable {name}: no proj.db in {os.pathsep.join(folders)}. Unset it.")
    # Characters that the terminal cannot display are escaped, here and in every step, so that printing does not fail.
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    os.environ[_ENCODING] = f"{os.environ.get(_ENCODING, '').partition(':')[0]}:backslashreplace"
    os.environ[ALGEBRA_THREADS] = "1"
    os.environ[_BACKEND] = "agg"  # plots are files; a backend configured by the user may not be installed
    from apertura.cli import main as run

    run()


if __name__ == "__main__":
    main()
