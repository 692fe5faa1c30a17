"""How the direct kernel takes what a tree cannot: its setting, and tables that are made when they are needed."""

from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np

from apertura.core.focus.engines import native
from apertura.core.focus.engines.native_tables import Tables, design_table
from apertura.core.focus.inputs import Profiles


class Directly(NamedTuple):
    """How the direct kernel takes what a tree cannot."""

    oversampling: int
    tolerance_rad: float


_TOLERANCES_RAD = {-74: 1.5e-3, -80: 7e-4, -86: 3e-4, -92: 1.5e-4, -98: 1e-4}


@lru_cache
def directly(nodes_db: int, profile_oversampling: float, carrier_rad_per_sample: float) -> Directly:
    """Return how the direct kernel takes what trees of such nodes cannot: it errs less than they do.

    Examples
    --------
    >>> [directly(nodes_db, 2.0, 1.5).oversampling for nodes_db in (-50, -74, -98)]
    [4, 5, 12]
    """
    least: tuple[float, int] = (np.inf, 0)
    for oversampling in range(4, 33):  # more cells need not err less: the polynomial of the phase changes
        design = design_table(profile_oversampling, carrier_rad_per_sample, oversampling=float(oversampling), degree=2)
        least = min(least, (design.error_db(np.ones(64)), oversampling))
        if least[0] <= nodes_db + 5:
            break
    return Directly(least[1], _TOLERANCES_RAD.get(nodes_db, 1.5e-3))


class DirectTables:
    """Tables of the direct kernel, made when a tile first asks for them and shared by all."""

    def __init__(self, profiles: Profiles):
        self._profiles, self._lock, self._tables = profiles, Lock(), dict[int, Tables]()

    def __getitem__(self, oversampling: int) -> Tables:
        with self._lock:
            if oversampling not in self._tables:
                self._tables[oversampling] = native.prepare(self._profiles, oversampling=oversampling, degree=2)
            return self._tables[oversampling]
