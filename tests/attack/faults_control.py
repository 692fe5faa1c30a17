"""Control of fault injection: the library `faults.c` and the shared page with its settings and counters."""

import ctypes
import errno
import mmap
import os
import shutil
import subprocess
from pathlib import Path

COUNT, KILL, FAIL, FAIL_ON, SHORT = range(5)
"""Actions at a call: count only; SIGKILL; one error; errors from then on; a partial write without error."""

WRITE, RENAME, FSYNC, TRUNCATE, MKDIR, OPEN, UNLINK = (1 << bit for bit in range(7))
"""Kinds of calls."""

ALL = (1 << 7) - 1

ENVIRONMENT = "APERTURA_FAULTS"
"""Environment variable with the file name of the page."""


class Page(ctypes.Structure):
    """The structure `struct page` of faults.c."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("armed", "action", "error", "kinds", "at", "count", "struck")),
        ("folder", ctypes.c_char * 4096),
    )


def compiler():
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def build(folder: Path) -> dict[str, str]:
    """Compile the library and write the page; return the environment for processes that use both."""
    library, page = folder / "faults.so", folder / "page"
    source = Path(__file__).with_name("faults.c")
    subprocess.run([compiler(), "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl"], check=True)
    page.write_bytes(bytes(ctypes.sizeof(Page)))
    return {**os.environ, "LD_PRELOAD": str(library), ENVIRONMENT: str(page)}


def shared_page() -> Page:
    """Return the page of this process and its children."""
    with Path(os.environ[ENVIRONMENT]).open("r+b") as file:
        return Page.from_buffer(mmap.mmap(file.fileno(), ctypes.sizeof(Page)))


def arm(page: Page, folder: Path, action: int, *, at: int = 0, error: int = errno.EIO, kinds: int = ALL) -> None:
    """Arm an action for the `at`-th call (from 1) of the given kinds below a folder."""
    page.action, page.at, page.error, page.kinds = action, at, error, kinds
    page.count = page.struck = 0
    page.folder = os.fsencode(folder.resolve())
    page.armed = 1


def disarm(page: Page) -> None:
    page.armed = 0
