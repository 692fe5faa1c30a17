"""Markers of every kind in a campaign folder: executing or opening one of them is detected.

A marker that is executed creates a file with its name. Opening a marker that is only read (a matplotlibrc, a sidecar
file of GDAL, a file outside the folder) is reported by the kernel (inotify, IN_OPEN).
"""

import ctypes
import os
import pickle
import struct
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

from .link_recording import read_now

_IN_OPEN, _IN_NONBLOCK = 0x20, 0o4000
_EVENT = struct.Struct("iIII")
_LIBC = ctypes.CDLL(None, use_errno=True)

SNAKEMAKES_OWN = ".snakemake/pip-deployments"
"""Folder in the working directory that Snakemake adds to the module search path."""

PROFILES = ("default", "slurm", "own", "none")
SETTINGS = {
    ".numba_config.yaml": "[",  # reading it raises an error
    "matplotlibrc": "backend: nosuch\n\x00",
    "setup.cfg": "[tool:pytest]\naddopts = --nosuch\n",
    "tox.ini": "[pytest]\naddopts = --nosuch\n",
    "pyproject.toml": "[tool.pytest.ini_options]\naddopts = '--nosuch'\n",
    "dask.yaml": "scheduler: nosuch\n",
    "zarr.yaml": "array: {order: F}\n",
    "gdalrc": "[configoptions]\nGDAL_DRIVER_PATH=.\n",
    "proj.ini": "network = on\n",
    ".pdbrc": "!import os\n",
    ".condarc": "channels: [nosuch]\n",
    ".netrc": "default login a password b\n",
    ".git/config": "[core]\nfsmonitor = touch ran\n",
}
PROGRAMS = (
    "snakemake",
    "python",
    "python3",
    "bash",
    "sh",
    "git",
    "conda",
    "mamba",
    "sacct",
    "sinfo",
    "make",
)
SIDECARS = (".aux.xml", ".ovr", ".msk", ".vrt", ".rrd", ".prj", ".imd")
PAGE = ("map/index.html", "map/app.js", "map/app.css", "map/shell.html", "map/shell.js")


@dataclass(frozen=True)
class Planted:
    """A campaign folder with markers.

    Attributes
    ----------
    root
        Campaign folder.
    outside
        Folder next to the campaign, in which no file may be opened.
    ran
        Folder in which executed markers create files.
    watched
        Files in the campaign that may not be opened.
    """

    root: Path
    outside: Path
    ran: Path
    watched: tuple[Path, ...]

    def code(self, name: str) -> str:
        """Return Python code that records its execution."""
        return f"import os; os.close(os.open({str(self.ran / name.replace('/', '.'))!r}, os.O_CREAT))"

    def shell(self, name: str) -> str:
        """Return a shell command that records its execution."""
        return f"touch {self.ran / name.replace('/', '.')}"

    @contextmanager
    def fires(self) -> Iterator[list[str]]:
        """Yield a list of fired markers, which is filled when the block ends."""
        fired: list[str] = []
        before = set(self.ran.iterdir())
        with opened([*self.watched, self.outside, *self.outside.rglob("*")]) as opened_paths:
            yield fired
        fired += sorted(f"ran {path.name}" for path in set(self.ran.iterdir()) - before)
        fired += sorted(f"opened {path.relative_to(self.root.parent)}" for path in opened_paths)


class Code:
    """Object that executes Python code when it is unpickled."""

    def __init__(self, code: str) -> None:
        self.code = code

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, (self.code,)


def plant(root: Path, *, in_snakemakes_own: bool = False) -> Planted:
    """Place markers in a campaign folder, at all paths from which a tool may read code or settings.

    Parameters
    ----------
    root
        Campaign folder, unfinished or finished.
    in_snakemakes_own
        Also place markers in the folder of Snakemake, which `apertura check` reports.
    """
    outside, ran = root.parent / "outside", root.parent / "ran"
    for folder in (outside, ran):
        folder.mkdir(exist_ok=True)
    planted = Planted(root, outside, ran, ())
    _outside_files(planted)
    passive = {**_modules(planted, in_snakemakes_own=in_snakemakes_own), **_workflows(planted)}
    passive |= SETTINGS | {name: f"#!/bin/sh\n{planted.shell(name)}\n" for name in PROGRAMS}
    passive |= _sidecars(planted)
    if (root / "results").is_dir():
        passive |= {f"results/{name}": f"/* {name} */ location = 'https://evil.example/'" for name in PAGE}
    for name, content in {**passive, **_pickles(planted)}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        path.chmod(0o755)
    return Planted(root, outside, ran, tuple(root / name for name in passive))


def _outside_files(planted: Planted) -> None:
    """Write the files named in hostile texts: grids, lists of CRS, rasters and archives without valid content."""
    for name in ("init", "shift.gsb", "geoid.gtx", "raster.tif", "array.zarr", "archive.zip", "config.yaml", "log.csv"):
        (planted.outside / name).write_bytes(b"<9> +proj=utm +zone=32 +datum=WGS84 <>\n")


@cache
def _installed() -> frozenset[str]:
    """Return the names of the modules of all installed packages."""
    return frozenset(name for name in packages_distributions() if name.isidentifier())


def _modules(planted: Planted, *, in_snakemakes_own: bool) -> Mapping[str, str]:
    """Return modules for all names that Python or an installed package may import."""
    names = {
        *sys.stdlib_module_names,
        *_installed(),
        "apertura",
        "sitecustomize",
        "usercustomize",
        "yte",
        "cupy",
        "snaphu",
    }
    markers = {f"{name}.py": planted.code(f"{name}.py") + "\n" for name in names}
    markers |= {"apertura/__init__.py": planted.code("apertura") + "\n", "conftest.py": planted.code("conftest.py")}
    markers |= {
        "python.pth": planted.code("python.pth") + "\n",
        "distutils-precedence.pth": planted.code("precedence.pth"),
    }
    plugins = (
        "snakemake_executor_plugin_x",
        "snakemake_logger_plugin_x",
        "snakemake_storage_plugin_x",
        "usercustomize",
    )
    if in_snakemakes_own:
        markers |= {f"{SNAKEMAKES_OWN}/{name}.py": planted.code(f"own.{name}") for name in (*plugins, "sitecustomize")}
    return markers


def _workflows(planted: Planted) -> Mapping[str, str]:
    """Return profiles with code (YTE) at every name, and workflows."""

    def profile(name: str) -> str:
        return f"__use_yte__: true\n__definitions__:\n  - {planted.code(name)!r}\ncores: 1\n"

    folders = [*(f"profiles/{name}" for name in PROFILES), *PROFILES, "."]
    files = ("config.yaml", "config.v8+.yaml", "config.v9+.yaml", "profile.yaml", "profile.v9+.yaml")
    markers = {f"{folder}/{file}": profile(f"{folder}/{file}") for folder in folders for file in files}
    snakefiles = (
        "Snakefile",
        "workflow/Snakefile",
        "snakefile",
        "workflow/snakefile",
        "workflow/profiles/default/Snakefile",
    )
    return markers | {name: planted.code(name) + "\n" for name in snakefiles}


def _sidecars(planted: Planted) -> Mapping[str, str]:
    """Return sidecar files that GDAL reads with a raster; each names a file outside the campaign."""
    rasters = [path.relative_to(planted.root).as_posix() for path in planted.root.rglob("*.tif")]
    text = (
        f"<PAMDataset><SRS>LOCAL_CS[x]</SRS><VRTRasterBand><SourceFilename>{planted.outside / 'raster.tif'}"
        "</SourceFilename></VRTRasterBand></PAMDataset>"
    )
    markers = {f"{name}{suffix}": text for name in rasters for suffix in SIDECARS}
    return markers | {
        f"{name.removesuffix('.tif')}{suffix}": text for name in rasters for suffix in (".tfw", ".wld", ".tab")
    }


def _pickles(planted: Planted) -> Mapping[str, bytes]:
    """Return records of Snakemake that execute code when they are unpickled."""
    names = ("iocache/latest.pkl", "metadata/cmVzdWx0cw==", "auxiliary/code.pkl", "scripts/x.py", "incomplete/x")
    return {f".snakemake/{name}": pickle.dumps(Code(planted.code(f"pickle {name}"))) for name in names}


def hostile_texts(planted: Planted) -> Mapping[str, str]:
    """Return texts that a library may interpret, by library and interpretation."""
    outside = planted.outside
    shifted = f"+proj=utm +zone=32 +ellps=bessel +nadgrids={outside}/shift.gsb +units=m"
    return {
        "PROJ init": f"+init={outside}/init:9",
        "PROJ init, bare": f"init={outside}/init:9",
        "PROJ nadgrids": shifted,
        "PROJ CRS": f"{shifted} +type=crs",
        "PROJ geoidgrids": f"+proj=utm +zone=32 +datum=WGS84 +geoidgrids={outside}/geoid.gtx +units=m +type=crs",
        "PROJ pipeline": f"+proj=pipeline +step +proj=vgridshift +grids={outside}/geoid.gtx",
        "PROJ list of grids": f"egm96_15.gtx,{outside}/geoid.gtx",
        "a code of PROJ": "EPSG:32632+5773",
        "PROJ text": "+proj=utm +zone=32 +ellps=WGS84",
        "GDAL archive": f"/vsizip/{outside}/archive.zip/raster.tif",
        "GDAL network": "/vsicurl/http://127.0.0.1:9/raster.tif",
        "GDAL driver": f"GTIFF_RAW:{outside}/raster.tif",
        "GDAL directory": f"GTIFF_DIR:1:{outside}/raster.tif",
        "GDAL document": f"<VRTDataset><SourceFilename>{outside}/raster.tif</SourceFilename></VRTDataset>",
        "fsspec file": f"file://{outside}/array.zarr",
        "fsspec chain": f"simplecache::file://{outside}/array.zarr",
        "fsspec archive": f"zip://*::{outside}/archive.zip",
        "dask scheduler": "tcp://127.0.0.1:9",
        "dask function": "dask.multiprocessing.get",
        "absolute path": f"{outside}/config.yaml",
        "path up": "../outside/log.csv",
        "path through a link": "linked/log.csv",
        "shell": f"$({planted.shell('text')})`{planted.shell('text')}`; {planted.shell('text')}",
        "format": "{__import__('os').system('" + planted.shell("format") + "')}",
        "YAML tag": f"!!python/object/apply:os.system ['{planted.shell('tag')}']",
        "YTE": f"?__import__('os').system('{planted.shell('yte')}')",
    }


@contextmanager
def opened(paths: list[Path]) -> Iterator[set[Path]]:
    """Yield the set of files and folders that any process opens during the block; the set is filled at the end."""
    watching = _LIBC.inotify_init1(_IN_NONBLOCK)
    if watching < 0:
        raise OSError(ctypes.get_errno(), "inotify_init1")
    try:
        names = {}
        for path in dict.fromkeys(paths):
            number = _LIBC.inotify_add_watch(watching, os.fsencode(path), _IN_OPEN)
            if number < 0:
                raise OSError(ctypes.get_errno(), "inotify_add_watch", str(path))
            names[number] = path
        opened_paths: set[Path] = set()
        yield opened_paths
        while events := read_now(watching):
            at = 0
            while at < len(events):
                number, mask, _, length = _EVENT.unpack_from(events, at)
                name = events[at + _EVENT.size : at + _EVENT.size + length].rstrip(b"\0").decode()
                if mask & _IN_OPEN:
                    opened_paths.add(names[number] / name if name else names[number])
                at += _EVENT.size + length
    finally:
        os.close(watching)
