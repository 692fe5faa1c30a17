"""Search for the tracks of maximum sharpness: gauge modes, optimisation, and starting points of the search."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Floats
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.methods.autofocus.inputs import Prior
from apertura.methods.autofocus.objective import Blocks, Contribution, PatchEcho, PatchImage, Sharpness, Tracks, phases
from apertura.methods.autofocus.patches import Patch

# ---- Gauge: track modes that shift the image without blurring it ----------------------------------------------------


LEAST_PHASE_RAD = 0.03
"""Radians rms over the aperture, per standard deviation of the log, below which a mode does not affect the focus."""

LEAST_SHIFT_M = 3e-4
"""Minimum shift of patches by a gauge mode, metres per standard deviation of the log."""

LEAST_INFORMATION = 10.0
"""Minimum information that the image provides on a mode that it alone determines, relative to that of the log (1)."""

_MODES = 32  # number of smooth motions evaluated at once
_PIECES = 5  # number of cubic pieces of a smooth mode within the illumination time of a patch


@dataclass(frozen=True, eq=False)
class Gauge:
    """Track modes that shift patches without blurring them.

    Attributes
    ----------
    modes
        (mode, unknown) float64, orthonormal, in the prior's unknowns.
    shift_m
        (mode, pair and patch, 2) float64, shift of the image of every patch east and north, metres per unit of a mode.
    blurs_rad2, shapes, smooth
        (other,) mean square phase error due to other orthonormal modes, largest last; (other, smooth) float64, these
        modes as sums of smooth motions; and the smooth motions.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 13 and 14.
    """

    modes: Floats
    shift_m: Floats
    blurs_rad2: Floats
    shapes: Floats
    smooth: "SmoothMotions"

    def project_out(self, unknowns: Floats) -> Floats:
        """Return unknowns, or a gradient, without the component along the modes."""
        return np.asarray(unknowns - self.modes.T @ (self.modes @ unknowns))

    @property
    def std_m(self) -> float:
        """Standard deviation of the image position due to errors of the logs, metres, rms over patches."""
        return float(np.sqrt((self.shift_m**2).sum(axis=(0, 2)).mean())) if len(self.modes) else 0.0

    @classmethod
    def none(cls, unknowns: int) -> "Gauge":
        """Return a gauge without modes."""
        return cls(
            np.zeros((0, unknowns)), np.zeros((0, 1, 2)), np.zeros(0), np.zeros((0, 0)), SmoothMotions([], unknowns)
        )

    def settled(self, unknowns: Floats, *, information: float) -> Floats:
        """Return (mode,) float64, the unknowns that the image alone determines.

        Parameters
        ----------
        unknowns
            Solved unknowns.
        information
            Information that the phases provide on a mode with a phase effect of 1 rad: twice the peak-to-background
            power ratios, summed over pairs and patches.
        """
        return np.asarray(self.shapes[self.blurs_rad2 * information > LEAST_INFORMATION] @ self.smooth.parts(unknowns))


def find_gauge(
    pairs: Sequence[Blocks],
    cached: Sequence[Sequence[Contribution]],
    prior: Prior,
    knots_s: Floats,
    axes: Floats,
) -> Gauge:
    """Find the gauge of the patches of all pairs; rows of `axes` are east, north, up.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 13 and 14.
    """
    smooth = SmoothMotions.of(pairs, cached, prior, knots_s)
    count = sum(len(patches) for patches in cached)
    # F and S of eq. 14 for smooth motions: mean blur² of eq. 13 as a quadratic form, and shifts of the patches.
    blur_form, shifts = np.zeros((len(smooth), len(smooth))), []
    for blocks, patches in zip(pairs, cached, strict=True):
        # Δρ of every block due to each smooth motion, `_MODES` motions at a time.
        paths = [np.empty((patch.blocks.stop - patch.blocks.start, len(smooth))) for patch in patches]
        for columns, unknowns in smooth.rows():
            tracks = prior.tracks(unknowns)
            moved = {node: blocks.average_of(tracks[node]) for node in dict.fromkeys(blocks.record.nodes)}
            for patch, path in zip(patches, paths, strict=True):
                path[:, columns] = longer_paths(patch, moved)
        for patch, path in zip(patches, paths, strict=True):
            blur, shift = effects_of_paths(patch, path, axes)
            blur_form += blur.T @ blur / count
            shifts.append(shift)
    shift = np.concatenate(shifts) / np.sqrt(count)
    # (F + ε²)⁻¹Sᵀ, and the eigenvalues σ_s²/ε² and eigenvectors v of S(F + ε²)⁻¹Sᵀ.
    conditional = np.linalg.solve(blur_form + LEAST_PHASE_RAD**2 * np.eye(len(blur_form)), shift.T)
    eigenvalues, eigenvectors = np.linalg.eigh(shift @ conditional)
    keep = eigenvalues * LEAST_PHASE_RAD**2 > LEAST_SHIFT_M**2
    # Modes (F + ε²)⁻¹Sᵀv with σ_s > 0.3 mm, orthonormalised, and their shifts of every patch.
    modes, _ = np.linalg.qr(conditional @ eigenvectors[:, keep])
    shift_by_mode = np.stack([patch_shift @ modes for patch_shift in shifts])
    # Eigenvectors of F are the motions sorted by blur, for the test of the configured log errors (eq. 17).
    blurs_rad2, shapes = np.linalg.eigh(blur_form)
    return Gauge(smooth.sums(modes.T), np.moveaxis(shift_by_mode, -1, 0), blurs_rad2, shapes.T, smooth)


@dataclass(frozen=True, eq=False)
class SmoothMotions:
    """Smooth motions of each node, including rotation and scaling of its track, orthonormal in the prior's unknowns.

    Attributes
    ----------
    of_nodes
        Index of a node's first unknown, and (mode, unknown of the node) float64; each mode displaces a single node.
    size
        Number of unknowns of all nodes.
    """

    of_nodes: Sequence[tuple[int, Floats]]
    size: int

    @classmethod
    def of(
        cls, pairs: Sequence[Blocks], cached: Sequence[Sequence[Contribution]], prior: Prior, knots_s: Floats
    ) -> "SmoothMotions":
        """Return the smooth motions that patches resolve within their illumination time."""
        from scipy.interpolate import BSpline

        lengths = [patch.blocks.stop - patch.blocks.start for patches in cached for patch in patches]
        length = max(4, int(np.median([count for count in lengths if count] or [len(knots_s)])) // _PIECES)
        # Cubic B-splines over pieces of `length` knots, (knot, spline).
        pieces = max(1, round(len(knots_s) / length))
        grid = np.linspace(knots_s[0], knots_s[-1], pieces + 1)
        step = grid[1] - grid[0]
        ends = np.concatenate([grid[0] - step * np.arange(3, 0, -1), grid, grid[-1] + step * np.arange(1, 4)])
        inside = np.clip(knots_s, grid[0], np.nextafter(grid[-1], grid[0]))
        splines = BSpline.design_matrix(inside, ends, 3).toarray()
        logged = _logged_places(pairs)
        of_nodes, first = [], 0
        for node, own in prior.nodes.items():
            # Splines and the logged shape along each axis, as unknowns of the prior, orthonormalised by an SVD.
            shape = logged[node] - logged[node].mean(axis=0)
            basis = np.concatenate([splines, shape / max(float(np.abs(shape).max()), 1e-9)], axis=1)
            motions = np.concatenate([own.adjoint(basis.T[:, :, None] * axis) for axis in np.eye(3)])
            of_nodes.append((first, *np.linalg.svd(motions, full_matrices=False)[1:]))
            first += own.size
        largest = max(float(size[0]) for _, size, _ in of_nodes)
        return cls([(start, modes[size > 1e-6 * largest]) for start, size, modes in of_nodes], first)

    def __len__(self) -> int:
        """Return the number of modes."""
        return sum(len(modes) for _, modes in self.of_nodes)

    def rows(self) -> Iterator[tuple[slice, Floats]]:
        """Yield slices of at most `_MODES` modes, and these modes as (mode, unknown) float64."""
        row = 0
        for first, modes in self.of_nodes:
            for begin in range(0, len(modes), _MODES):
                modes_slice = modes[begin : begin + _MODES]
                unknowns = np.zeros((len(modes_slice), self.size))
                unknowns[:, first : first + modes_slice.shape[1]] = modes_slice
                yield slice(row, row + len(modes_slice)), unknowns
                row += len(modes_slice)

    def parts(self, unknowns: Floats) -> Floats:
        """Return (mode,) float64, components of the unknowns along each mode."""
        components = [modes @ unknowns[first : first + modes.shape[1]] for first, modes in self.of_nodes]
        return np.concatenate([np.zeros(0), *components])

    def sums(self, coefficients: Floats) -> Floats:
        """Return (sum, unknown) float64, sums of the modes with (sum, mode) coefficients."""
        split = np.cumsum([len(modes) for _, modes in self.of_nodes])[:-1]
        of_nodes = zip(np.split(coefficients, split, axis=1), self.of_nodes, strict=True)
        return np.concatenate([of_node @ modes for of_node, (_, modes) in of_nodes], axis=1)


def _logged_places(pairs: Sequence[Blocks]) -> Mapping[str, Floats]:
    """Return node → (knot, 3) float64, logged positions."""
    places: dict[str, Floats] = {}
    for blocks in pairs:
        record = blocks.record
        middle = np.minimum((blocks.edges[:-1] + blocks.edges[1:]) // 2, len(record.time_s) - 1)
        for node, leg in zip(record.nodes, record.profiles.aperture.legs, strict=True):
            places.setdefault(node, leg[middle])
    return places


def effects(patch: Contribution, moved: Mapping[str, Floats], axes: Floats) -> tuple[Floats, Floats]:
    """Return the effects of modes on a patch: blur (row, mode), whose norm is in rad rms, and shift (2, mode), metres.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 13: a constant phase does not blur; over the band, however, the path change
    including its mean blurs the point unless a shift explains the change.
    """
    return effects_of_paths(patch, longer_paths(patch, moved), axes)


def longer_paths(patch: Contribution, moved: Mapping[str, Floats]) -> Floats:
    """Return (block, mode) float64, path changes in metres due to displacements of the nodes, (mode, block, 3) each."""
    grown = (np.einsum("bi,mbi->bm", slope, moved[node][:, patch.blocks]) for node, slope in patch.slopes.items())
    return np.asarray(sum(grown), np.float64)


def effects_of_paths(patch: Contribution, path: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Return blur and shift, as `effects`, for path changes (block, mode) in metres."""
    slope = np.asarray(sum(patch.slopes.values())) @ axes[:2].T
    weight = np.linalg.norm(patch.values, axis=0).astype(np.float64)
    weight = (weight / max(weight.sum(), 1e-300))[:, None]

    # Rows of eq. 13: k(Δρ − mean), then bΔρ, weighted by the blocks' amplitudes.
    def weighted(paths: Floats) -> Floats:
        centred = paths - (weight * paths).sum(axis=0)
        rows = [np.sqrt(weight) * phase for phase in (patch.wavenumber * centred, patch.band * paths)]
        return np.asarray(np.concatenate(rows), np.float64)

    # Least squares for a, the shift over ground; the residual is blur.
    by_shift, errors = (weighted(np.asarray(paths)) for paths in (slope, path))
    shift = np.linalg.pinv(by_shift) @ errors
    return errors - by_shift @ shift, shift


# ---- Search for the sharpest tracks within the errors of the logs ---------------------------------------------------


ITERATIONS = 20
"""Steps of L-BFGS-B before contributions are recomputed."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Pairs, patches and prior of one refinement.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    echoes
        Pair → patch → summed echoes.
    knots_s
        (knot,) float64, times of the corrections.
    prior
        Prior of the nodes.
    gauge
        Modes along which the tracks remain those of the logs.
    """

    pairs: Sequence[Blocks]
    echoes: Sequence[Sequence[PatchEcho]]
    knots_s: Floats
    prior: Prior
    gauge: Gauge

    def correction(self, unknowns: Floats) -> TrackCorrection:
        """Return the track corrections for given unknowns."""
        return TrackCorrection(self.knots_s, self.prior.tracks(unknowns))

    def state(self, unknowns: Floats) -> "State":
        """Return the state of the tracks for given unknowns, with the block contributions to the patches."""
        return replace(self.at(self.prior.tracks(unknowns)), unknowns=unknowns)

    def at(self, tracks: Tracks) -> "State":
        """Return the state of given tracks, without unknowns."""
        cached = []
        for blocks, echoes in zip(self.pairs, self.echoes, strict=True):
            moved = blocks.moves(tracks)
            cached.append([blocks.contribution(echo, moved) for echo in echoes])
        return State(np.zeros(0), tracks, cached)

    @property
    def patches(self) -> list[Patch]:
        """Patches of the scene."""
        return [echo.patch for echo in self.echoes[0]]

    def of(self, patches: Sequence[int]) -> "Problem":
        """Return the problem restricted to the numbered patches."""
        return replace(self, echoes=[[echoes[number] for number in patches] for echoes in self.echoes])

    def sharper(self, state: "State", used: Bools, *, stages: int = 1) -> "State":
        """Return the tracks of maximum sharpness of the used patches, searched from `state`."""
        for _ in range(stages):
            sharpness = Sharpness(self.pairs, state.cached, state.tracks, state.statistics, used)
            state = self.state(minimise(sharpness, self.prior, self.gauge, state.unknowns))
        return state

    def value(self, state: "State", used: Bools, weights: Sequence[Sequence[PatchImage]]) -> float:
        """Return the objective of a state, with the weights and energies of another state."""
        value, _ = Sharpness(self.pairs, state.cached, state.tracks, weights, used)(state.tracks)
        return value + 0.5 * float(state.unknowns @ state.unknowns)


@dataclass(frozen=True, eq=False)
class State:
    """Track corrections, and the patches imaged along the corrected tracks.

    Attributes
    ----------
    unknowns
        (unknown,) float64, unknowns of the prior.
    tracks
        Node → (knot, 3) float64, corrections in metres.
    cached
        Pair → patch → block contributions.
    """

    unknowns: Floats
    tracks: Tracks
    cached: Sequence[Sequence[Contribution]]

    @cached_property
    def images(self) -> list[list[NDArray[np.complex64]]]:
        """Pair → patch → image (pixel,) complex64."""
        return [[patch.values.sum(axis=1) for patch in patches] for patches in self.cached]

    @cached_property
    def statistics(self) -> list[list[PatchImage]]:
        """Pair → patch → energy, contrast and peak ratio."""
        statistics = []
        for images in self.images:
            brightest = max((float(np.abs(image).max()) ** 2 for image in images), default=0.0)
            statistics.append([PatchImage.of(image, brightest) for image in images])
        return statistics

    def of(self, patches: Sequence[int]) -> "State":
        """Return the state restricted to the numbered patches."""
        return replace(self, cached=[[cached[number] for number in patches] for cached in self.cached])


def minimise(
    value: Callable[[Tracks], tuple[float, dict[str, Floats]]],
    prior: Prior,
    gauge: Gauge,
    start: Floats,
    *,
    iterations: int = ITERATIONS,
) -> Floats:
    """Minimise a function of the tracks plus half the sum of squared unknowns at fixed gauge; return the unknowns."""
    from scipy.optimize import minimize  # slow to import

    fixed = gauge.modes.T @ (gauge.modes @ start)

    def objective(unknowns: Floats) -> tuple[float, Floats]:
        free = gauge.project_out(unknowns) + fixed
        objective_value, by_tracks = value(prior.tracks(free))
        return objective_value + 0.5 * float(unknowns @ unknowns), gauge.project_out(
            prior.adjoint(by_tracks)
        ) + unknowns

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20}
    result = minimize(objective, gauge.project_out(start), jac=True, method="L-BFGS-B", options=options)
    return np.asarray(gauge.project_out(result.x) + fixed)


# ---- Second start of the search: unwrapped phases of the brightest points -------------------------------------------

SMOOTHED = (2.0, 1.5, 1.0)
"""Standard deviation of the smoothing filter that precedes phase unwrapping, in blocks, one for each round."""


def prominent_point_start(problem: Problem, start: State, used: NDArray[np.bool_], axes: Floats) -> State:
    """Fit tracks to the unwrapped phases of the patches' brightest pixels by least squares with the prior.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Sharpness".
    """
    state = start
    for smoothed in SMOOTHED:
        histories = [[_History.of(patch, smoothed, axes) for patch in patches] for patches in state.cached]
        fit = _PhaseFit(problem.pairs, histories, state.tracks, used)
        state = problem.state(minimise(fit, problem.prior, problem.gauge, state.unknowns, iterations=40))
    return state


@dataclass(frozen=True, eq=False)
class _History:
    """Unwrapped phase of a patch's brightest pixel over blocks, and the subspace due to position and constant phase."""

    patch: Contribution
    phase: Floats
    weight: Floats
    known: Floats

    @classmethod
    def of(cls, patch: Contribution, smoothed: float, axes: Floats) -> "_History":
        from scipy.ndimage import gaussian_filter1d

        brightest = patch.values[int(np.abs(patch.values.sum(axis=1)).argmax())].astype(np.complex128)
        smooth = gaussian_filter1d(brightest.real, smoothed) + 1j * gaussian_filter1d(brightest.imag, smoothed)
        power = np.abs(smooth) ** 2
        weight = 1 / np.sqrt(0.5 + 0.5 * np.median(power) / (power + 1e-30))
        slope = np.asarray(sum(patch.slopes.values())) @ axes[:2].T
        columns = np.concatenate([np.ones((len(slope), 1)), slope], axis=1) * weight[:, None]
        return cls(patch, np.unwrap(np.angle(smooth)), weight, np.linalg.qr(columns)[0])


@dataclass(frozen=True, eq=False)
class _PhaseFit:
    """Half the sum of squared residual phases of the tracks, over pairs and patches."""

    pairs: Sequence[Blocks]
    histories: Sequence[Sequence[_History]]
    reference: Tracks
    used: NDArray[np.bool_]

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        total, gradient = 0.0, {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, histories in zip(self.pairs, self.histories, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            for history, is_used in zip(histories, self.used, strict=True):
                if not is_used:
                    continue
                patch = history.patch
                residual = history.weight * (phases(patch, moved) + history.phase)
                residual -= history.known @ (history.known.T @ residual)
                total += 0.5 * float(residual @ residual)
                for node, slope in patch.slopes.items():
                    by_block = np.zeros_like(moved[node])
                    by_block[patch.blocks] = patch.wavenumber * (history.weight * residual)[:, None] * slope
                    gradient[node] += blocks.average.T @ by_block
        return total, gradient


# ---- Start of the search after a cycle slip: delays of the points in subapertures -----------------------------------

_DELAY_STD_M = 0.03
"""Standard deviation of a point's delay in a subaperture, metres of total path; its weight against the prior."""


def unslipped_start(problem: Problem, state: State, shifts_m: Floats) -> State:
    """Fit tracks that equalise the range of points in all subapertures by least squares with the prior.

    Parameters
    ----------
    problem, state
        Solved problem and its state.
    shifts_m
        (pair, patch, part) float64, range shift of a point in a subaperture, metres of total path; NaN where the point
        is not visible.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16: delays are unambiguous. The residual path error is below λ/2.
    """
    fit = _DelayFit(problem.pairs, state.cached, state.tracks, shifts_m)
    return problem.state(minimise(fit, problem.prior, problem.gauge, state.unknowns, iterations=40))


@dataclass(frozen=True, eq=False)
class _DelayFit:
    """Half the sum of squared residual delays between subapertures, in standard deviations, over pairs and patches."""

    pairs: Sequence[Blocks]
    cached: Sequence[Sequence[Contribution]]
    reference: Tracks
    shifts_m: Floats

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        total, gradient = 0.0, {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, patches, by_patch in zip(self.pairs, self.cached, self.shifts_m, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            for patch, shift_m in zip(patches, by_patch, strict=True):
                measured = np.isfinite(shift_m)
                if measured.sum() < 2:
                    continue
                # Mean path change of each subaperture due to the tracks minus the measured shift, without their mean.
                path = phases(patch, moved) / patch.wavenumber
                ends = np.linspace(0, len(path), len(shift_m) + 1).astype(np.int64)
                size = np.diff(ends)
                part = np.repeat(np.arange(len(size)), size)
                residual = np.where(measured, np.add.reduceat(path, ends[:-1]) / size - np.nan_to_num(shift_m), 0.0)
                residual = np.where(measured, residual - residual.sum() / measured.sum(), 0.0) / _DELAY_STD_M
                total += 0.5 * float(residual @ residual)
                # Derivative: residual of a subaperture over the number of its blocks, along the slope of each node.
                for node, slope in patch.slopes.items():
                    by_block = np.zeros_like(moved[node])
                    by_block[patch.blocks] = (residual / size / _DELAY_STD_M)[part][:, None] * slope
                    gradient[node] += blocks.average.T @ by_block
        return total, gradient
