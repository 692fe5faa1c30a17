"""What sharpness does not see of the tracks and yet moves the image: held where the log has it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.blocks import Blocks, Contribution
from apertura.methods.autofocus.prior import Prior

Floats = NDArray[np.float64]

SEEN_RAD = 0.03
"""A mode that turns phases by less, rms over the aperture per standard deviation of the log, is not seen."""

LEAST_SHIFT_M = 3e-4
"""Modes that move patches by less are left to the solver."""

SURE = 10.0
"""A mode of which the image tells so many times as much as the log is settled by it."""

_PIECES = 5  # of the time for which a patch is seen, to a cubic piece of a smooth mode


@dataclass(frozen=True, eq=False)
class Gauge:
    """Modes of the tracks that move patches without blurring them.

    Attributes
    ----------
    modes
        (mode, unknown) float64, orthonormal, in the prior's unknowns.
    shift_m
        (mode, pair and patch, 2) float64, metres per unit of each: how the image of every patch moves east and north.
    blurs_rad2, blurring
        (other,) and (other, unknown) float64: mean square of the phase that orthonormal modes turn, largest last.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 13 and 14.
    """

    modes: Floats
    shift_m: Floats
    blurs_rad2: Floats
    blurring: Floats

    def held(self, unknowns: Floats) -> Floats:
        """Return unknowns, or a gradient, without their part along the modes."""
        return np.asarray(unknowns - self.modes.T @ (self.modes @ unknowns))

    @property
    def std_m(self) -> float:
        """How far the log alone leaves the image to be moved as a whole, metres: rms over patches."""
        return float(np.sqrt((self.shift_m**2).sum(axis=(0, 2)).mean())) if len(self.modes) else 0.0

    @classmethod
    def none(cls, unknowns: int) -> "Gauge":
        """Return the gauge that holds nothing."""
        return cls(np.zeros((0, unknowns)), np.zeros((0, 1, 2)), np.zeros(0), np.zeros((0, unknowns)))

    def settled(self, unknowns: Floats, *, known: float) -> Floats:
        """Return (mode,) float64, the unknowns that an image settles whatever the log says.

        Parameters
        ----------
        unknowns
            As solved.
        known
            What the phases tell of a mode that turns them by a radian: 2·power of points against their surroundings,
            summed over pairs and patches.
        """
        return np.asarray(self.blurring[self.blurs_rad2 * known > SURE] @ unknowns)


def find_gauge(
    pairs: Sequence[Blocks],
    cached: Sequence[Sequence[Contribution]],
    prior: Prior,
    knots_s: Floats,
    axes: Floats,
) -> Gauge:
    """Return the gauge of some patches as some pairs see them; axes are rows east, north, up."""
    unknowns = _smooth_unknowns(pairs, cached, prior, knots_s)
    blurs, shifts = [], []
    tracks = prior.tracks(unknowns)
    for blocks, patches in zip(pairs, cached, strict=True):
        moved = {node: blocks.average_of(tracks[node]) for node in dict.fromkeys(blocks.sighting.nodes)}
        for patch in patches:
            blur, shift = effects(patch, moved, axes)
            blurs.append(blur)
            shifts.append(shift)
    count = len(blurs)
    focus = np.sum([blur.T @ blur for blur in blurs], axis=0) / count
    shift = np.concatenate(shifts) / np.sqrt(count)
    spread = np.linalg.solve(focus + SEEN_RAD**2 * np.eye(len(focus)), shift.T)
    power, turn = np.linalg.eigh(shift @ spread)
    keep = power * SEEN_RAD**2 > LEAST_SHIFT_M**2
    inside, _ = np.linalg.qr(spread @ turn[:, keep])
    moves = np.stack([one @ inside for one in shifts])
    blurred, shapes = np.linalg.eigh(focus)
    return Gauge(inside.T @ unknowns, np.moveaxis(moves, -1, 0), blurred, shapes.T @ unknowns)


def _smooth_unknowns(
    pairs: Sequence[Blocks], cached: Sequence[Sequence[Contribution]], prior: Prior, knots_s: Floats
) -> Floats:
    """Return (mode, unknown) float64, orthonormal: smooth tracks, and those that turn and stretch each node's own."""
    from scipy.interpolate import BSpline

    seen = [patch.blocks.stop - patch.blocks.start for patches in cached for patch in patches]
    length = max(4, int(np.median([one for one in seen if one] or [len(knots_s)])) // _PIECES)
    number = max(1, round(len(knots_s) / length))
    grid = np.linspace(knots_s[0], knots_s[-1], number + 1)
    step = grid[1] - grid[0]
    ends = np.concatenate([grid[0] - step * np.arange(3, 0, -1), grid, grid[-1] + step * np.arange(1, 4)])
    inside = np.clip(knots_s, grid[0], np.nextafter(grid[-1], grid[0]))
    splines = BSpline.design_matrix(inside, ends, 3).toarray()
    flown = _flown(pairs)
    fields = []
    for node in prior.nodes:
        shape = flown[node] - flown[node].mean(axis=0)
        basis = np.concatenate([splines, shape / max(float(np.abs(shape).max()), 1e-9)], axis=1)
        for axis in np.eye(3):
            for one in basis.T:
                zero = {name: np.zeros((len(knots_s), 3)) for name in prior.nodes}
                fields.append(prior.adjoint({**zero, node: one[:, None] * axis}))
    left, size, _ = np.linalg.svd(np.stack(fields, axis=1), full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size[0]].T)


def _flown(pairs: Sequence[Blocks]) -> Mapping[str, Floats]:
    """Return node → (knot, 3) float64, where its log has it."""
    places: dict[str, Floats] = {}
    for blocks in pairs:
        sighting = blocks.sighting
        middle = np.minimum((blocks.edges[:-1] + blocks.edges[1:]) // 2, len(sighting.time_s) - 1)
        for node, leg in zip(sighting.nodes, sighting.profiles.aperture.legs, strict=True):
            places.setdefault(node, leg[middle])
    return places


def effects(patch: Contribution, moved: Mapping[str, Floats], axes: Floats) -> tuple[Floats, Floats]:
    """Return what modes do to a patch: blur (row, mode), rad rms in the whole, and shift (2, mode), metres.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 13: a constant phase does not blur, but over the band the path itself must be
    what a shift explains.
    """
    path = sum(np.einsum("bi,mbi->bm", slope, moved[node][:, patch.blocks]) for node, slope in patch.slopes.items())
    ground = np.asarray(sum(patch.slopes.values())) @ axes[:2].T
    weight = np.linalg.norm(patch.values, axis=0).astype(np.float64)
    weight = (weight / max(weight.sum(), 1e-300))[:, None]

    def told(paths: Floats) -> Floats:
        centred = paths - (weight * paths).sum(axis=0)
        parts = [np.sqrt(weight) * one for one in (patch.wavenumber * centred, patch.band * paths)]
        return np.asarray(np.concatenate(parts), np.float64)

    known, errors = (told(np.asarray(one)) for one in (ground, path))
    shift = np.linalg.pinv(known) @ errors
    return errors - known @ shift, shift
