"""What a process does before it works for a stranger's folder: it leaves that folder, and so do all that it starts.

Python and libraries take modules and settings from the working folder (``yaml.py``, numba's ``.numba_config.yaml`` with
its cache of pickled code, ``matplotlibrc``). Commands are typed in campaign folders, and Snakemake starts every step in
one.
"""

import os
import re
import sys
from pathlib import Path

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable: Python then imports nothing from the working folder; ``python -m snakemake`` of a job, too."""

_SEARCHED = ("PATH", "PYTHONPATH")
_left: list[Path] = []


def leave_working_folder() -> None:
    """Make the package's own folder the working folder, and `isolate`; what was typed is then found by `given`.

    Raises
    ------
    FileNotFoundError
        If the working folder is gone.
    """
    _left[:] = [Path.cwd()]
    os.chdir(Path(__file__).parents[1])
    isolate()


def isolate() -> None:
    """See to it that nothing is imported or started from a working folder: not here, not by any process started here.

    Empty and relative entries of PATH, PYTHONPATH and ``sys.path`` mean whatever folder is the working one: Snakemake
    adds ``.snakemake/pip-deployments`` itself.

    Examples
    --------
    >>> isolate()
    >>> os.environ["PYTHONSAFEPATH"], all(Path(path).is_absolute() for path in sys.path)
    ('1', True)
    """
    os.environ[SAFE_PATH] = "1"
    for name in _SEARCHED:
        if name in os.environ:
            os.environ[name] = os.pathsep.join(filter(_is_absolute, os.environ[name].split(os.pathsep)))
    sys.path[:] = filter(_is_absolute, sys.path)


def _is_absolute(path: str) -> bool:
    return Path(path).is_absolute()


def given(path: Path) -> Path:
    """Return a path that a person typed as an absolute one: it counts from where the command was started.

    Examples
    --------
    >>> given(Path("campaign")) == Path.cwd() / "campaign"
    True
    """
    return started() / path


def started() -> Path:
    """Return the folder that the command was started in."""
    return _left[0] if _left else Path.cwd()


def as_typed(text: object) -> str:
    """Return a path, or a message with paths, as a person would type them where the command was started.

    Examples
    --------
    >>> as_typed(Path.cwd() / "campaign" / "results"), as_typed(f"{Path.cwd()}/a: no such file")
    ('campaign/results', 'a: no such file')
    """
    folder = str(started())
    return str(text) if folder == os.sep else re.sub(rf"(?<![\w./-]){re.escape(folder)}{os.sep}", "", str(text))
