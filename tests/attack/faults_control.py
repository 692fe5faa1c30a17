"""What makes calls fail: the library `faults.c`, and the page that says what shall happen and counts."""

import ctypes
import errno
import mmap
import os
import shutil
import subprocess
from pathlib import Path

COUNT, KILL, FAIL, FAIL_ON, SHORT = range(5)
"""At a call: nothing; SIGKILL; an error once; from then on; half of a write, and then no error."""

WRITE, RENAME, FSYNC, TRUNCATE, MKDIR, OPEN, UNLINK = (1 << bit for bit in range(7))
"""Kinds of calls."""

ALL = (1 << 7) - 1

ENVIRONMENT = "APERTURA_FAULTS"
"""Names the file of the page."""


class Page(ctypes.Structure):
    """As `struct page` in faults.c."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("armed", "action", "error", "kinds", "at", "count", "struck")),
        ("folder", ctypes.c_char * 4096),
    )


def compiler():
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def build(folder: Path) -> dict[str, str]:
    """Compile the library, make the page; return the environment of a process that has both."""
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
    """Let something happen at the `at`-th call (from 1) of some kinds below a folder."""
    page.action, page.at, page.error, page.kinds = action, at, error, kinds
    page.count = page.struck = 0
    page.folder = os.fsencode(folder.resolve())
    page.armed = 1


def disarm(page: Page) -> None:
    page.armed = 0
