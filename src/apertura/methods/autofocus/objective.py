"""Sharpness of patches as a function of the tracks: pulse blocks, their contributions, value and gradient."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.backprojection.contributions import block_contributions
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.methods.autofocus.inputs import PairRecord
from apertura.methods.autofocus.patches import Patch

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# ---- Blocks of pulses and their contributions to the patches --------------------------------------------------------

Tracks = Mapping[str, Floats]

_PULSES = 4096  # pulses read at once
_MARGIN = 10  # range samples beyond a patch, for interpolation and for displaced tracks


@dataclass(frozen=True, eq=False)
class PatchEcho:
    """Echoes of a patch, summed over the pulses of each illuminating block of a pair with focus on the patch centre.

    Attributes
    ----------
    patch
        The patch.
    blocks
        Illuminating blocks of the pair.
    profiles
        Range profiles about the patch: one virtual pulse per block, at the mean position of the block's pulses.
    """

    patch: Patch
    blocks: slice
    profiles: Profiles

    @property
    def values(self) -> int:
        """Number of complex values of the contributions."""
        return len(self.patch.pixels_m) * len(self.profiles)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Pulse blocks of one pair, one block per knot of the corrections.

    Attributes
    ----------
    record
        Record of the pair.
    edges
        (knot + 1,) int64, first pulse of each block, and the number of pulses.
    average
        (block, knot) sparse float64, operator from values at knots to means over block pulses, linear between knots.
    aperture
        Mean logged phase centres of each block.
    sidelink_m
        (block, 3) float64, mean of `PairRecord.sidelink_m`; None if the pair has none.
    """

    record: PairRecord
    edges: NDArray[np.int64]
    average: "csr_array"
    aperture: Aperture
    sidelink_m: Floats | None

    @classmethod
    def of(cls, record: PairRecord, knots_s: Floats) -> "Blocks":
        """Return the blocks of a pair, centred on equally spaced knots."""
        from scipy.sparse import csr_array  # slow to import

        count, step_s, pulses = len(knots_s), float(knots_s[1] - knots_s[0]), len(record.time_s)
        # Mean over the pulses of each block, (block, pulse).
        edges = np.searchsorted(record.time_s, np.append(knots_s - step_s / 2, np.inf))
        edges[0] = 0
        block = np.repeat(np.arange(count), np.diff(edges))
        share = 1 / np.diff(edges)[block]
        mean = csr_array((share, (block, np.arange(pulses))), shape=(count, pulses))
        # Linear interpolation of knots at the pulses, (pulse, knot).
        position = np.clip((record.time_s - knots_s[0]) / step_s, 0, count - 1)
        left = np.minimum(position.astype(np.int64), count - 2)
        rows = np.tile(np.arange(pulses), 2)
        between = csr_array(
            (np.concatenate([1 - (position - left), position - left]), (rows, np.concatenate([left, left + 1]))),
            shape=(pulses, count),
        )
        aperture = Aperture(*(mean @ leg for leg in record.profiles.aperture.legs))
        sidelink_m = None if record.sidelink_m is None else mean @ record.sidelink_m
        return cls(record, edges, mean @ between, aperture, sidelink_m)

    def average_of(self, tracks: Floats) -> Floats:
        """Return (mode, block, 3) float64, the mean of (mode, knot, 3) tracks over the pulses of each block."""
        modes, knots, _ = tracks.shape
        flat = np.moveaxis(tracks, 1, 0).reshape(knots, -1)
        return np.moveaxis((self.average @ flat).reshape(knots, modes, 3), 0, 1)

    def moves(self, tracks: Tracks) -> Tracks:
        """Return node → (block, 3) float64, mean displacement of the pair's nodes in each block, metres."""
        return {node: np.asarray(self.average @ tracks[node]) for node in dict.fromkeys(self.record.nodes)}

    def echoes(self, patches: Sequence[Patch]) -> list[PatchEcho]:
        """Return the summed echoes of each patch; every pulse is read once.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 9: within a patch, path differences between the pulses of a block are
        approximated by those at the patch centre.
        """
        profiles, edges = self.record.profiles, self.edges
        beams = self.record.beams and self.record.beams.on_profiles
        starts = [self._offsets(patch) for patch in patches]
        sums = [np.zeros((len(offsets), len(edges) - 1), np.complex64) for offsets in starts]
        first = 0
        # S_b(δ) of eq. 9, in groups of whole blocks with up to `_PULSES` pulses.
        while first < len(edges) - 1:
            last = max(first + 1, int(np.searchsorted(edges, edges[first] + _PULSES, side="right")) - 1)
            last = min(last, len(edges) - 1)
            pulses = slice(int(edges[first]), int(edges[last]))
            if pulses.stop > pulses.start:
                part = profiles[pulses]
                part = replace(part, samples=np.asarray(part.samples))
                for patch, offsets, total in zip(patches, starts, sums, strict=True):
                    weights = None
                    if beams is not None:
                        weights = beams[pulses].weight(part.aperture, patch.place_m[None])[:, 0]
                    inside = edges[first : last + 1] - edges[first]
                    total[:, first:last] = _towards(part, patch.place_m, offsets, inside, weights)
            first = last
        return [self._echo(*arguments) for arguments in zip(patches, starts, sums, strict=True)]

    def _offsets(self, patch: Patch) -> Floats:
        """Return (sample,) float64, path offsets that cover a patch about its centre, metres of total path."""
        pulses = self.record.profiles.aperture.sample(64)
        aperture, step_m = self.record.profiles.aperture[pulses], self.record.profiles.step_m
        corners = patch.pixels_m[:: max(1, len(patch.pixels_m) - 1)]
        corners = np.concatenate(
            [corners, 2 * patch.place_m - corners, patch.pixels_m[:: max(1, len(patch.pixels_m) // 8)]]
        )
        reach = float(np.abs(aperture.path(corners) - aperture.path(patch.place_m[None])).max())
        half = int(np.ceil(reach / step_m)) + _MARGIN
        return np.asarray(np.arange(-half, half + 1) * step_m, np.float64)

    def _echo(self, patch: Patch, offsets: Floats, sums: NDArray[np.complex64]) -> PatchEcho:
        illuminating = np.flatnonzero(np.abs(sums).any(axis=0))
        blocks = slice(int(illuminating[0]), int(illuminating[-1]) + 1) if illuminating.size else slice(0, 1)
        whole, aperture = self.record.profiles, self.aperture[blocks]
        middle = aperture.path(patch.place_m)
        referred = sums[:, blocks].T * np.exp(-1j * whole.wavenumber_rad_m * (middle[:, None] + offsets))
        return PatchEcho(
            patch,
            blocks,
            replace(whole, samples=referred.astype(np.complex64), start_m=middle + offsets[0], aperture=aperture),
        )

    def contribution(self, echo: PatchEcho, moved: Tracks) -> "Contribution":
        """Return the contribution of each block to the pixels of a patch, with the nodes displaced by `moved`."""
        tx, rx = self.record.nodes
        # Corrected antennas; echo delays grow by the change of the sidelink path (eq. 3).
        moves = [moved[node][echo.blocks] for node in (tx, rx)]
        logged = echo.profiles.aperture
        aperture = Aperture(logged.tx_m + moves[0], logged.rx_m + moves[1])
        extra_path_m, along = np.zeros(len(aperture)), np.zeros((len(aperture), 3))
        if self.sidelink_m is not None:
            between = self.sidelink_m[echo.blocks]
            corrected = between + moves[0] - moves[1]
            length = np.linalg.norm(corrected, axis=1)
            extra_path_m = length - np.linalg.norm(between, axis=1)
            along = corrected / np.maximum(length, 1e-9)[:, None]
        # Slopes ∂ρ/∂m of eq. 2: unit vectors from the patch to the antennas, and ∓s for the sidelink.
        away = [leg - echo.patch.place_m for leg in aperture.legs]
        unit = [vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-9) for vector in away]
        slopes = {tx: unit[0] + unit[1]} if tx == rx else {tx: unit[0] - along, rx: unit[1] + along}
        # B_b(x) of eq. 9 at the pixels.
        profiles = echo.profiles.moved(aperture, extra_path_m)
        profiles = replace(profiles, samples=np.asarray(profiles.samples))
        values = block_contributions(profiles, echo.patch.pixels_m, edges=np.arange(len(profiles) + 1))
        wavenumber, band = (
            2 * np.pi * frequency / profiles.wave_speed_m_s
            for frequency in (profiles.centre_frequency_hz, profiles.bandwidth_hz / np.sqrt(12))
        )
        return Contribution(values, echo.blocks, slopes, wavenumber, band)


@dataclass(frozen=True, eq=False)
class Contribution:
    """Contributions of the illuminating blocks of a pair to the pixels of a patch.

    Attributes
    ----------
    values
        (pixel, block) complex64.
    blocks
        Illuminating blocks of the pair.
    slopes
        Node → (block, 3) float64, gradient of the path to the patch with respect to the node's position (eq. 2).
    wavenumber
        2πf_mid/c, rad/m.
    band
        2πσ_f/c with the standard deviation σ_f of a flat band, rad/m.
    """

    values: NDArray[np.complex64]
    blocks: slice
    slopes: Mapping[str, Floats]
    wavenumber: float
    band: float


def _towards(
    profiles: Profiles, place_m: Floats, offsets: Floats, edges: NDArray[np.int64], weights: Floats | None
) -> NDArray[np.complex64]:
    """Return Σ s(R + δ)·exp(jk(R + δ)) over the pulses of each block, (offset, block), with R the path to a point.

    R + δ is realised as the path from antennas at -R/2 on a line to points at δ/2 on the same line.
    """
    on_line = np.zeros((len(profiles), 3))
    on_line[:, 0] = -profiles.aperture.path(place_m) / 2
    places = np.zeros((len(offsets), 3))
    places[:, 0] = offsets / 2
    at = replace(profiles, aperture=Aperture(on_line, on_line))
    return block_contributions(at, places, edges=edges, weights=weights)


# ---- Sharpness as a function of the tracks, from cached contributions -----------------------------------------------

MOST_WEIGHT = 1e4  # largest weight of a patch, which limits the influence of one bright point (eq. 11)
_WEIGHT_OF_RATIO = 3.0  # weight of a patch per peak-to-background power ratio (eq. 11)
_SIDELOBES = 1e-3
"""Relative power of a point's sidelobes outside its patch, for an unweighted aperture and any tracks."""


@dataclass(frozen=True, eq=False)
class PatchImage:
    """Statistics of one pair's image of a patch.

    Attributes
    ----------
    energy
        Σ|I|² at the time of caching.
    contrast
        Σ|I|⁴/(Σ|I|²)².
    ratio
        Peak-to-background power ratio; the background is speckle, median/ln 2, or the sidelobes of brighter points.
    """

    energy: float
    contrast: float
    ratio: float

    @classmethod
    def of(cls, image: NDArray[np.complex64], brightest: float = 0.0) -> "PatchImage":
        """Return the statistics of an image (pixel,); `brightest` is the largest pixel power of all patches."""
        power = np.abs(image).astype(np.float64) ** 2
        energy = max(float(power.sum()), 1e-150)  # squared below: must not underflow for pulses without echoes
        background = max(float(np.median(power)) / np.log(2), _SIDELOBES * brightest, 1e-300)
        return cls(energy, float((power**2).sum()) / energy**2, float(power.max()) / background)

    @property
    def weight(self) -> float:
        """Weight of the patch's sharpness by its peak-to-background ratio (eq. 11)."""
        return min(_WEIGHT_OF_RATIO * self.ratio, MOST_WEIGHT)


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Objective -½ Σ w·log(Σ|I|⁴/S²) over pairs and patches.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    cached
        Pair → patch → block contributions.
    reference
        Node → (knot, 3) float64, metres: track corrections of the cached contributions.
    statistics
        Pair → patch → image statistics at the time of caching.
    used
        (patch,) bool, True for patches in the objective.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 11 and 12.
    """

    pairs: Sequence[Blocks]
    cached: Sequence[Sequence[Contribution]]
    reference: Tracks
    statistics: Sequence[Sequence[PatchImage]]
    used: NDArray[np.bool_]

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        """Return the value and its derivatives with respect to the corrections, node → (knot, 3)."""
        total = 0.0
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, patches, statistics in zip(self.pairs, self.cached, self.statistics, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            slopes = {node: np.zeros_like(move) for node, move in moved.items()}
            for patch, image, is_used in zip(patches, statistics, self.used, strict=True):
                if is_used:
                    value, by_phase = _patch(patch, image, moved)
                    total += value
                    for node, slope in patch.slopes.items():
                        slopes[node][patch.blocks] += patch.wavenumber * by_phase[:, None] * slope
            for node, slope in slopes.items():
                gradient[node] += blocks.average.T @ slope
        return total, gradient


def phases(patch: Contribution, moved: Tracks) -> Floats:
    """Return (block,) float64, phase change of the contributions due to displacements of the nodes, rad."""
    path = np.zeros(patch.blocks.stop - patch.blocks.start)
    for node, slope in patch.slopes.items():
        path += np.einsum("bi,bi->b", slope, moved[node][patch.blocks])
    return patch.wavenumber * path


def _patch(patch: Contribution, cached: PatchImage, moved: Tracks) -> tuple[float, Floats]:
    """Return the objective of a patch and its derivative with respect to the phase of each block."""
    rotation = np.exp(1j * phases(patch, moved)).astype(np.complex64)
    image = patch.values @ rotation  # I = B e^{jθ}
    power = (image.real**2 + image.imag**2).astype(np.float64)
    fourth = float((power**2).sum())
    if not fourth:
        return 0.0, np.zeros(len(rotation))
    # G and ∂J/∂θ of eq. 12; J of eq. 11, with the cached S².
    by_image = (-cached.weight * power / fourth * image).astype(np.complex64)
    by_phase = -2 * (rotation * (by_image.conj() @ patch.values)).imag
    return -0.5 * cached.weight * float(np.log(fourth / cached.energy**2)), by_phase.astype(np.float64)
