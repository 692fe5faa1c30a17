"""What trees of all tiles share: profiles, and the filters that expand them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.engines.native_structs import TREE_DELAYS
from apertura.core.focus.engines.native_tables import BAND, TableDesign, Tables, design_table
from apertura.core.focus.engines.tree_direct import Directly, DirectTables, directly
from apertura.core.focus.engines.tree_surface import Surface
from apertura.core.focus.engines.tree_track import LEAF, leaf_roughness, leaves_of, stray, tracks
from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.aperture import Aperture

CELLS_AT_ONCE = 4
"""Cells per sample are a multiple of it: what a vector of AVX-512 holds."""

LEAST_PIXELS = 32**2
"""Of a tile: fewer go directly."""

LEAST_QUARTER_PX = 64
"""Side of the quarter of a tile: smaller ones are not worth a tree of their own."""

_SAMPLED = 64  # pulses at which a rough tile is looked at
_DELAY_DEGREE = 9


@dataclass(frozen=True, eq=False)
class Trees:
    """Pulses as trees read them.

    Attributes
    ----------
    profiles
        The pulses, contiguous.
    design
        Of the cells: which filters make them.
    stray_m
        (leaf,) float32, metres by which pulses of a leaf leave the parabola through its first, middle and last one.
    rough_m
        (leaf, 4) float32, metres by which they leave curves of growing degree, RMS.
    tracks_m
        (leaf, antenna, term, 3) float64, phase centres over each leaf as polynomials.
    first
        Number of the first pulse among those prepared.
    tables
        Of the direct kernel, for all pulses prepared.
    """

    profiles: Profiles
    design: TableDesign
    stray_m: NDArray[np.float32]
    rough_m: NDArray[np.float32]
    tracks_m: NDArray[np.float64]
    first: int
    tables: DirectTables

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.profiles)

    def __getitem__(self, pulses: slice) -> "Trees":
        """Return those of pulses from a multiple of a leaf on.

        Raises
        ------
        ValueError
            If they begin elsewhere, or are not in a row.
        """
        first, last, step = pulses.indices(len(self))
        if step != 1 or first % LEAF:
            raise ValueError(f"{pulses}: pulses of a tree are taken from a multiple of {LEAF} on, and in a row")
        leaves = slice(first // LEAF, -(-last // LEAF))
        return replace(
            self,
            profiles=self.profiles[first:last],
            stray_m=self.stray_m[leaves],
            rough_m=self.rough_m[leaves],
            tracks_m=self.tracks_m[leaves],
            first=self.first + first,
        )

    def chunks(self, size: int) -> Iterator[slice]:
        """Yield slices of `size` pulses; they end at the same pulses whichever tile takes them."""
        first = 0
        while first < len(self):
            last = min(len(self), first + size - (self.first + first) % size)
            yield slice(first, last)
            first = last

    def direct(self, nodes_db: int) -> Tables:
        """Return the direct kernel's tables for these pulses."""
        return self.tables[self.directly(nodes_db).oversampling][self.first : self.first + len(self)]

    def directly(self, nodes_db: int) -> Directly:
        """Return the direct kernel's setting beside trees of such nodes."""
        return directly(nodes_db, self.profiles.oversampling, self.wavenumber_rad_m * self.profiles.step_m)

    def roughness(self, surface: Surface) -> float:
        """Return the error that pixels off the surface of a tile make, as the function of that name."""
        aperture = self.profiles.aperture
        some = aperture[aperture.sample(_SAMPLED)]
        return roughness(some, surface, wavenumber_rad_m=self.wavenumber_rad_m, band_rad_m=self.band_rad_m)

    @property
    def middle(self) -> Aperture:
        """The middle pulse."""
        return self.profiles.aperture[len(self) // 2 : len(self) // 2 + 1]

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/c."""
        return 2 * np.pi * self.profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S

    @property
    def band_rad_m(self) -> float:
        """Half the band as a wavenumber, πB/c."""
        return float(np.pi / (self.profiles.step_m * self.profiles.oversampling))


def roughness(aperture: Aperture, surface: Surface, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
    """Return the mean squared error by pixels that do not lie on the surface of their tile, relative.

    Parameters
    ----------
    aperture
        Some of the pulses, evenly spread.
    surface
        Of the tile.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 9.
    """
    if not np.isfinite(surface.rough_m):
        return np.inf
    rate = aperture.path_gradient(surface.centre_m[None])[:, 0] @ surface.up
    against = rate[len(rate) // 2]  # the pulse of m, nearly: that of the whole flight, not of each chunk
    of_phase, of_delay = wavenumber_rad_m**2 * ((rate - against) ** 2).mean(), band_rad_m**2 / 3 * (rate**2).mean()
    return float(surface.rough_m**2 * (of_phase + of_delay))


def cells_per_sample(profile_oversampling: float, oversampling: float) -> int:
    """Return how many cells a sample is expanded to, for at least so many per resolution cell.

    Examples
    --------
    >>> cells_per_sample(2.0, 24), cells_per_sample(2.5, 24)
    (12, 12)
    """
    return CELLS_AT_ONCE * int(np.ceil(oversampling / profile_oversampling / CELLS_AT_ONCE - 1e-9))


def cells(profile_oversampling: float, carrier_rad_per_sample: float, oversampling: float, taps: int) -> TableDesign:
    """Return the filters that expand profiles to cells: straight lines in each, of so many taps."""
    count = cells_per_sample(profile_oversampling, oversampling)
    return design_table(
        profile_oversampling, carrier_rad_per_sample, oversampling=count * profile_oversampling, degree=1, taps=taps
    )


@lru_cache
def delay_filter(profile_oversampling: float) -> NDArray[np.float32]:
    """Return the filter that gives a profile between two samples, as polynomials of where between them.

    Returns
    -------
    ndarray
        (degree + 1, tap) float32, constant term first; of 0…1 from the sample before to the one behind. The first tap
        is that of the sample `tap / 2 - 1` before.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 7: least squares over the band.

    Examples
    --------
    >>> weights = 0.3 ** np.arange(10) @ delay_filter(2.0)
    >>> tone = np.exp(0.5j * np.pi * 0.9 * (np.arange(12) - 5))
    >>> bool(abs(weights @ tone - np.exp(0.5j * np.pi * 0.9 * 0.3)) < 1e-4)
    True
    """
    omega = np.pi / profile_oversampling * BAND
    basis = np.exp(1j * omega[:, None] * (np.arange(TREE_DELAYS) - TREE_DELAYS // 2 + 1))
    u = 0.5 - 0.5 * np.cos(np.pi * (np.arange(24) + 0.5) / 24)
    wanted = np.exp(1j * omega[:, None] * u)
    left, right = (np.concatenate([part.real, part.imag]) for part in (basis, wanted))
    taps = np.linalg.lstsq(left, right, rcond=1e-9)[0].T
    return np.ascontiguousarray(np.linalg.lstsq(np.vander(u, _DELAY_DEGREE + 1, increasing=True), taps)[0], np.float32)


def prepare(profiles: Profiles, *, oversampling: int = 24, taps: int = 8) -> Trees:
    """Return what trees of all tiles share; pulses are expanded to cells later, tile by tile.

    Parameters
    ----------
    profiles
        Band-limited profiles.
    oversampling
        Table cells per Nyquist cell c/B of total path, at least.
    taps
        Of the filters that make cells, 8 or 16.

    Raises
    ------
    ValueError
        If the profiles are oversampled less than 1.5 times or hold no pulse, or a position or start is not finite.

    Notes
    -----
    Source: docs/theory/tree.md, "Leaves"; the cells are those of docs/theory/engine.md, "Cells".
    """
    samples, start_m, places = profiles.for_tables()
    held = replace(profiles, samples=samples, start_m=start_m)
    legs = [leaves_of(leg) for leg in places]
    strayed, rough = stray(legs[0]) + stray(legs[1]), leaf_roughness(*legs)
    turn = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S * profiles.step_m
    found = cells(profiles.oversampling, turn, float(oversampling), taps)
    bent = np.stack([tracks(leg) for leg in legs], axis=1)
    return Trees(held, found, strayed.astype(np.float32), rough.astype(np.float32), bent, 0, DirectTables(held))
