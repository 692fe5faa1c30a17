"""What results are made with: versions of what apertura stands on, and the lock they may have come from."""

import platform
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version

from apertura import __version__
from apertura.common.paths import shipped
from apertura.common.provenance import sha256_file

_NAME = re.compile(r"[\w.-]+")


def packages() -> dict[str, str]:
    """Return name → version of apertura, of Python and of each distribution that apertura requires, sorted by name.

    Nothing is imported to learn them. What only some installations have (`extra`) is not named: where jobs run does not
    change a result.

    Examples
    --------
    >>> found = packages()
    >>> {"apertura", "python", "numpy", "numba", "zarr"} <= found.keys(), "pytest" in found
    (True, False)
    """
    return dict(_packages())


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    found = {"apertura": __version__, "python": platform.python_version()}
    for requirement in requires("apertura") or ():
        if "extra ==" not in requirement and (name := _NAME.match(requirement)):
            try:
                found[name[0].lower()] = version(name[0])
            except PackageNotFoundError:  # such as a library that conda calls otherwise
                found[name[0].lower()] = "unknown"
    return tuple(sorted(found.items()))


def software() -> dict[str, str]:
    """Return `packages`, with the libraries behind rasterio and pyproj: GDAL and PROJ.

    Rasterio may bring a PROJ of its own; ``proj`` is that of pyproj, which places pixels.

    Examples
    --------
    >>> sorted(software().keys() - packages().keys())
    ['gdal', 'proj']
    """
    import pyproj
    import rasterio

    libraries = {"gdal": rasterio.__gdal_version__, "proj": pyproj.proj_version_str}
    return dict(sorted((packages() | libraries).items()))


def lock_sha256() -> str:
    """Return the sha256 of requirements/all.txt, which names each distribution of the tested environment and its hash.

    Examples
    --------
    >>> len(lock_sha256())
    64
    """
    return sha256_file(shipped() / "requirements" / "all.txt")
