"""Sharpness of the patches as a function of the tracks: blocks of pulses, contributions, value and gradient."""

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

_PULSES = 4096  # read at once
_MARGIN = 10  # samples beyond a patch, for the interpolation and for tracks that move


@dataclass(frozen=True, eq=False)
class PatchEcho:
    """Echoes of a patch in the blocks of a pair that illuminate it, summed towards its middle.

    Attributes
    ----------
    patch
        Where.
    blocks
        Which of the pair's blocks.
    profiles
        Over those blocks: range profiles about the patch, as one pulse at the mean place of each block's would have
        them.
    """

    patch: Patch
    blocks: slice
    profiles: Profiles

    @property
    def values(self) -> int:
        """Number of complex values of its contributions."""
        return len(self.patch.pixels_m) * len(self.profiles)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The pulses of one pair, by the knots of the corrections.

    Attributes
    ----------
    record
        The pair.
    edges
        (knot + 1,) int64, first pulse of each block, and the number of pulses.
    average
        (block, knot) sparse float64: mean over the pulses of a block of what is linear between knots.
    aperture
        Mean phase centres of each block's pulses, as the logs have them.
    sidelink_m
        (block, 3) float64, mean of the pair's; None where it has none.
    """

    record: PairRecord
    edges: NDArray[np.int64]
    average: "csr_array"
    aperture: Aperture
    sidelink_m: Floats | None

    @classmethod
    def of(cls, record: PairRecord, knots_s: Floats) -> "Blocks":
        """Return the blocks of a pair about equally spaced knots."""
        from scipy.sparse import csr_array  # slow to import

        count, step_s, pulses = len(knots_s), float(knots_s[1] - knots_s[0]), len(record.time_s)
        # Mean over the pulses of each block, (block, pulse).
        edges = np.searchsorted(record.time_s, np.append(knots_s - step_s / 2, np.inf))
        edges[0] = 0
        block = np.repeat(np.arange(count), np.diff(edges))
        share = 1 / np.diff(edges)[block]
        mean = csr_array((share, (block, np.arange(pulses))), shape=(count, pulses))
        # Linear interpolation of knots at the pulses, (pulse, knot).
        place = np.clip((record.time_s - knots_s[0]) / step_s, 0, count - 1)
        left = np.minimum(place.astype(np.int64), count - 2)
        rows = np.tile(np.arange(pulses), 2)
        between = csr_array(
            (np.concatenate([1 - (place - left), place - left]), (rows, np.concatenate([left, left + 1]))),
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
        """Return node → (block, 3) float64, metres, of the nodes of the pair."""
        return {node: np.asarray(self.average @ tracks[node]) for node in dict.fromkeys(self.record.nodes)}

    def echoes(self, patches: Sequence[Patch]) -> list[PatchEcho]:
        """Return the summed echoes of each patch; every pulse is read once.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 9: about the middle of a patch paths of a block differ by what they do at
        the middle.
        """
        profiles, beams, edges = self.record.profiles, self.record.beams, self.edges
        starts = [self._offsets(patch) for patch in patches]
        sums = [np.zeros((len(offsets), len(edges) - 1), np.complex64) for offsets in starts]
        first = 0
        # S_b(δ) of eq. 9, for as many whole blocks at a time as have `_PULSES` pulses.
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
        return [self._echo(*one) for one in zip(patches, starts, sums, strict=True)]

    def _offsets(self, patch: Patch) -> Floats:
        """Return (sample,) float64, metres of total path about a patch's middle."""
        some = self.record.profiles.aperture.sample(64)
        aperture, step_m = self.record.profiles.aperture[some], self.record.profiles.step_m
        corners = patch.pixels_m[:: max(1, len(patch.pixels_m) - 1)]
        corners = np.concatenate(
            [corners, 2 * patch.place_m - corners, patch.pixels_m[:: max(1, len(patch.pixels_m) // 8)]]
        )
        reach = float(np.abs(aperture.path(corners) - aperture.path(patch.place_m[None])).max())
        half = int(np.ceil(reach / step_m)) + _MARGIN
        return np.asarray(np.arange(-half, half + 1) * step_m, np.float64)

    def _echo(self, patch: Patch, offsets: Floats, sums: NDArray[np.complex64]) -> PatchEcho:
        illuminating = np.flatnonzero(np.abs(sums).any(axis=0))  # blocks
        blocks = slice(int(illuminating[0]), int(illuminating[-1]) + 1) if illuminating.size else slice(0, 1)
        whole, aperture = self.record.profiles, self.aperture[blocks]
        middle = aperture.path(patch.place_m)
        turned = sums[:, blocks].T * np.exp(-1j * whole.wavenumber_rad_m * (middle[:, None] + offsets))
        return PatchEcho(
            patch,
            blocks,
            replace(whole, samples=turned.astype(np.complex64), start_m=middle + offsets[0], aperture=aperture),
        )

    def contribution(self, echo: PatchEcho, moved: Tracks) -> "Contribution":
        """Return the contribution of each block to the pixels of a patch where its nodes have moved by so much."""
        tx, rx = self.record.nodes
        # Antennas as corrected; by the sidelink path of eq. 3 echoes are delayed by as much as it has grown.
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
        # Slopes ∂ρ/∂m of eq. 2: unit vectors from the patch to the antennas, ∓s of the sidelink.
        away = [leg - echo.patch.place_m for leg in aperture.legs]
        unit = [one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-9) for one in away]
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
    """Contributions of the blocks of a pair that illuminate a patch.

    Attributes
    ----------
    values
        (pixel, block) complex64.
    blocks
        Which of the pair's blocks those are.
    slopes
        Node → (block, 3) float64, growth of the path at the patch per metre that the node moves (eq. 2).
    wavenumber
        2πf_mid/c.
    band
        The same of the band's standard deviation, taken as flat.
    """

    values: NDArray[np.complex64]
    blocks: slice
    slopes: Mapping[str, Floats]
    wavenumber: float
    band: float


def _towards(
    profiles: Profiles, place_m: Floats, offsets: Floats, edges: NDArray[np.int64], weights: Floats | None
) -> NDArray[np.complex64]:
    """Return Σ s(R + δ)·exp(jk(R + δ)) over the pulses of each block, (offset, block), R the path of a place.

    The path from antennas on a line at -R/2 to places at δ/2 on it is R + δ.
    """
    on_line = np.zeros((len(profiles), 3))
    on_line[:, 0] = -profiles.aperture.path(place_m) / 2
    places = np.zeros((len(offsets), 3))
    places[:, 0] = offsets / 2
    at = replace(profiles, aperture=Aperture(on_line, on_line))
    return block_contributions(at, places, edges=edges, weights=weights)


# ---- Sharpness as a function of the tracks, from cached contributions -----------------------------------------------

MOST_WEIGHT = 1e4  # of a patch: bounds the influence of one bright point (eq. 11)
_WEIGHT_OF_RATIO = 3.0  # weight of a patch over its ratio of peak power to surroundings (eq. 11)
_SIDELOBES = 1e-3
"""Power of a point's sidelobes beyond its own patch, of an aperture without weights, whatever its tracks."""


@dataclass(frozen=True, eq=False)
class PatchImage:
    """Statistics of one pair's image of a patch.

    Attributes
    ----------
    energy
        Σ|I|², which stays as it was when the contributions were cached.
    contrast
        Σ|I|⁴/(Σ|I|²)².
    ratio
        Peak power against that of what lies about it: speckle, median/ln 2, or sidelobes of brighter points.
    """

    energy: float
    contrast: float
    ratio: float

    @classmethod
    def of(cls, image: NDArray[np.complex64], brightest: float = 0.0) -> "PatchImage":
        """Return those of an image (pixel,); `brightest` is the power of the brightest pixel of all patches."""
        power = np.abs(image).astype(np.float64) ** 2
        energy = max(float(power.sum()), 1e-150)  # its square is more than nothing, also where pulses hold nothing
        about = max(float(np.median(power)) / np.log(2), _SIDELOBES * brightest, 1e-300)
        return cls(energy, float((power**2).sum()) / energy**2, float(power.max()) / about)

    @property
    def weight(self) -> float:
        """Weight of its sharpness, by how far its point stands out (eq. 11)."""
        return min(_WEIGHT_OF_RATIO * self.ratio, MOST_WEIGHT)


@dataclass(frozen=True, eq=False)
class Sharpness:
    """-½ Σ w·log(Σ|I|⁴/S²) over pairs and patches.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    cached
        Pair → patch → what its blocks add.
    reference
        Node → (knot, 3) float64, metres: corrections that the contributions were cached at.
    statistics
        Pair → patch → what it showed then.
    used
        (patch,) bool, patches that count.

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
        """Return the value and its derivatives by the corrections, node → (knot, 3)."""
        total = 0.0
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, patches, statistics in zip(self.pairs, self.cached, self.statistics, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            slopes = {node: np.zeros_like(move) for node, move in moved.items()}
            for patch, now, counts in zip(patches, statistics, self.used, strict=True):
                if counts:
                    value, by_phase = _patch(patch, now, moved)
                    total += value
                    for node, slope in patch.slopes.items():
                        slopes[node][patch.blocks] += patch.wavenumber * by_phase[:, None] * slope
            for node, slope in slopes.items():
                gradient[node] += blocks.average.T @ slope
        return total, gradient


def phases(patch: Contribution, moved: Tracks) -> Floats:
    """Return (block,) float64, rad by which contributions turn where the nodes of each block have moved."""
    path = np.zeros(patch.blocks.stop - patch.blocks.start)
    for node, slope in patch.slopes.items():
        path += np.einsum("bi,bi->b", slope, moved[node][patch.blocks])
    return patch.wavenumber * path


def _patch(patch: Contribution, now: PatchImage, moved: Tracks) -> tuple[float, Floats]:
    """Return the value of a patch and its derivative by the phase of each block."""
    turn = np.exp(1j * phases(patch, moved)).astype(np.complex64)
    image = patch.values @ turn  # I = B e^{jθ}
    power = (image.real**2 + image.imag**2).astype(np.float64)
    fourth = float((power**2).sum())
    if not fourth:
        return 0.0, np.zeros(len(turn))
    # G and ∂J/∂θ of eq. 12; J of eq. 11, with S² as cached.
    by_image = (-now.weight * power / fourth * image).astype(np.complex64)
    by_phase = -2 * (turn * (by_image.conj() @ patch.values)).imag
    return -0.5 * now.weight * float(np.log(fourth / now.energy**2)), by_phase.astype(np.float64)
