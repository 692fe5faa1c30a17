"""Residual track between two flights from the phases of windows in both images, docs/theory/stack.md, eqs. 3 to 6."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Floats
from apertura.methods.autofocus.inputs import NodePrior, Prior, TrackErrors
from apertura.methods.interferometry.coherence import unbiased
from apertura.methods.interferometry.heights import least_coherence, phase_std

# ---- Phases of windows ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class WindowPhases:
    """Products of two images, summed over windows side by side.

    Attributes
    ----------
    phasor
        (window,) complex128, Σ I₂ I₁* over the window.
    row, column
        (window,) float64, centroid of |I₂ I₁*|, pixels.
    std_rad
        (window,) float64, standard deviation of the phase.
    """

    phasor: NDArray[np.complex128]
    row: Floats
    column: Floats
    std_rad: Floats

    @classmethod
    def of(
        cls,
        image: NDArray[np.complex64],
        reference: NDArray[np.complex64],
        used: NDArray[np.bool_],
        *,
        window: int,
        looks: float,
    ) -> "WindowPhases":
        """Sum the products over windows of `window` pixels; only windows of significant coherence are returned.

        Parameters
        ----------
        image, reference
            (y, x) complex64.
        used
            (y, x) bool; windows with less than half of their pixels are left out.
        window
            Pixels along a side.
        looks
            Independent samples of a whole window.

        Examples
        --------
        >>> generator = np.random.default_rng(0)
        >>> image = (generator.normal(size=(8, 8)) + 1j * generator.normal(size=(8, 8))).astype(np.complex64)
        >>> phases = WindowPhases.of(image * 1j, image, np.ones((8, 8), bool), window=4, looks=16.0)
        >>> np.angle(phases.phasor).round(3)
        array([1.571, 1.571, 1.571, 1.571])
        """
        valid = used & np.isfinite(image) & np.isfinite(reference)
        one, other = (np.where(valid, pixels, 0).astype(np.complex128) for pixels in (image, reference))
        product = one * other.conj()
        size = np.abs(product)
        rows, columns = np.indices(size.shape)

        def total(values: NDArray[Any]) -> NDArray[Any]:
            height, width = (side // window for side in size.shape)
            cut = values[: height * window, : width * window]
            return np.asarray(cut.reshape(height, window, width, window).sum(axis=(1, 3)).ravel())

        phasor, weight = total(product), total(size)
        power = total(np.abs(one) ** 2) * total(np.abs(other) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            magnitude = np.nan_to_num(np.abs(phasor) / np.sqrt(power)).astype(np.float32)
            row, column = (total(size * at) / weight for at in (rows, columns))
        if not looks > 1:
            keep = np.zeros(len(phasor), bool)
        else:
            keep = (magnitude > least_coherence(looks)) & (total(valid) > window**2 / 2)
        known = np.minimum(unbiased(magnitude[keep], looks), 0.9999) if keep.any() else magnitude[keep]
        std = phase_std(known.astype(np.float32), looks).astype(np.float64)
        return cls(phasor[keep], row[keep], column[keep], std)

    def __len__(self) -> int:
        return len(self.phasor)


# ---- Linear model: phase of a place for a residual track ------------------------------------------------------------

_FINER = 4  # interpolated samples of the aperture per sampled pulse
_MOST_KNOTS = 200
_KNOTS_PER_APERTURE = 4  # knots within the time that illuminates a place


@dataclass(frozen=True, eq=False)
class SeenAntenna:
    """Antenna at the pulses that form each of several places.

    Attributes
    ----------
    node
        Node that carries the antenna.
    position_m
        (place, pulse, 3) float64, metres in the frame of the places.
    time_s
        (place, pulse) float64, seconds from the first pulse of the flight.
    """

    node: str
    position_m: Floats
    time_s: Floats


@dataclass(frozen=True, eq=False)
class ResidualTracks:
    """Prior of the residual tracks of a flight's nodes, and their effect on the phase of places.

    Attributes
    ----------
    prior
        Prior of `apertura.methods.autofocus`, with unknowns of unit variance.
    knots_s
        (knot,) float64, times of the knots, seconds from the first pulse.
    wavenumber_rad_m
        Wavenumber at the band centre.
    """

    prior: Prior
    knots_s: Floats
    wavenumber_rad_m: float

    @classmethod
    def of(
        cls, errors: Mapping[str, TrackErrors], axes: Floats, antennas: Sequence[SeenAntenna], wavenumber_rad_m: float
    ) -> "ResidualTracks":
        """Return residual tracks with knots as dense as the images can resolve.

        Parameters
        ----------
        errors
            Node → errors of the difference between its logs of both flights.
        axes
            (3, 3) float64, unit vectors east, north and up.
        antennas
            Antennas at sampled places, from which the duration of the illumination follows.
        wavenumber_rad_m
            Wavenumber at the band centre.
        """
        first = min(float(antenna.time_s.min()) for antenna in antennas)
        last = max(float(antenna.time_s.max()) for antenna in antennas)
        lit_s = min(float(np.median(np.ptp(antenna.time_s, axis=1))) for antenna in antennas)
        step_s = max(lit_s / _KNOTS_PER_APERTURE, (last - first) / _MOST_KNOTS, 1e-6)
        count = max(3, int(np.ceil((last - first) / step_s)) + 1)
        knots_s = np.linspace(first, max(last, first + 1e-6), count)
        step_s = float(knots_s[1] - knots_s[0])
        nodes = {}
        for node, error in errors.items():
            # faster errors average out between knots; slow ones are offset, slope and half a period
            share = min(1.0, np.sqrt(error.correlation_s / step_s))
            std_m = (error.std_m[0] * share, error.std_m[1] * share, error.std_m[2] * share)
            slow_m = max(error.drift_std_m, *error.std_m)
            nodes[node] = NodePrior.of(TrackErrors(std_m, error.correlation_s, slow_m), knots_s, axes)
        return cls(Prior(nodes), knots_s, wavenumber_rad_m)

    def phase(self, places_m: Floats, antennas: Sequence[SeenAntenna]) -> Floats:
        """Return the phase of places per unknown, (place, unknown) float64 rad (eq. 4).

        Parameters
        ----------
        places_m
            (place, 3) float64, metres.
        antennas
            Antennas at the pulses that form each place: one for each leg of the path.
        """
        gradient = {node: np.zeros((len(places_m), len(self.knots_s), 3)) for node in self.prior.nodes}
        rows = np.arange(len(places_m))[:, None]
        for antenna in antennas:
            towards, time_s = self._towards(places_m, antenna)
            share = self.wavenumber_rad_m / time_s.shape[1]
            at = np.clip(np.searchsorted(self.knots_s, time_s) - 1, 0, len(self.knots_s) - 2)
            step_s = self.knots_s[at + 1] - self.knots_s[at]
            after = np.clip((time_s - self.knots_s[at]) / step_s, 0, 1)
            for knot, weight in ((at, 1 - after), (at + 1, after)):
                np.add.at(gradient[antenna.node], (rows, knot), share * weight[..., None] * towards)
        return self.prior.adjoint(gradient)

    def constant_phase(self, places_m: Floats, antennas: Sequence[SeenAntenna]) -> Floats:
        """Return the phase of places per constant displacement of all nodes, (place, 3) float64 rad per metre."""
        total = np.zeros((len(places_m), 3))
        for antenna in antennas:
            total += self.wavenumber_rad_m * self._towards(places_m, antenna)[0].mean(axis=1)
        return total

    def spread(self, places_m: Floats, antennas: Sequence[SeenAntenna], unknowns: Floats) -> Floats:
        """Return the variance of the phase over the aperture of places for residual tracks, (place, track) rad².

        `unknowns` is (track, unknown): the variation about the mean phase displaces and defocuses a place (eq. 7).
        """
        tracks = self.prior.tracks(unknowns)
        total: Floats | float = 0.0
        for antenna in antennas:
            towards, time_s = self._towards(places_m, antenna)
            moved = np.stack(
                [
                    np.stack([np.interp(time_s, self.knots_s, one[:, axis]) for axis in range(3)], axis=-1)
                    for one in tracks[antenna.node]
                ]
            )
            total = total + self.wavenumber_rad_m * np.einsum("pmi,tpmi->ptm", towards, moved)
        return np.asarray(np.var(total, axis=-1))

    def _towards(self, places_m: Floats, antenna: SeenAntenna) -> tuple[Floats, Floats]:
        """Return unit vectors from places to the antenna, and times, at interpolated pulses of the aperture."""
        pulses = antenna.time_s.shape[1]
        at = np.linspace(0, pulses - 1, _FINER * (pulses - 1) + 1)
        low = np.minimum(at.astype(np.int64), max(0, pulses - 2))
        high, share = np.minimum(low + 1, pulses - 1), at - low
        position = antenna.position_m[:, low] * (1 - share)[:, None] + antenna.position_m[:, high] * share[:, None]
        away = position - places_m[:, None]
        time_s = antenna.time_s[:, low] * (1 - share) + antenna.time_s[:, high] * share
        return away / np.linalg.norm(away, axis=-1, keepdims=True), time_s


# ---- Estimate: search for constants, then robust least squares ------------------------------------------------------

LEAST_WINDOWS = 12
"""Minimum number of coherent windows; fewer do not separate residual motion from motion of the terrain."""

_CUT = 4.0  # residuals of more than this many standard deviations have no weight (biweight)
_ROUNDS = 25
_MOST_CANDIDATES, _MOST_SEARCHED = 20_000, 2000  # displacements and windows of the search
_STEP_RAD = 0.8  # largest phase difference between candidates of the search, over the scene
_SCALES = (0.5, 30.0)  # limits of the scale of the prior: errors of logs are rarely half of those stated
_STABLE_WEIGHT = 0.25  # windows with a smaller weight are not stable


@dataclass(frozen=True, eq=False)
class ResidualMotion:
    """Estimated residual track between two flights.

    Attributes
    ----------
    constant_rad
        Phase that is equal at all places.
    unknowns
        (unknown,) float64, residual tracks in the unknowns of the prior.
    scale
        Scale of the prior for which the phases are most probable: 1 if the logs are as accurate as stated.
    parameters
        Number of parameters that the phases determine, without the constant.
    residual_rad
        (window,) float64, phase of each window minus the model.
    stable
        (window,) bool, windows that follow the model.
    """

    constant_rad: float
    unknowns: Floats
    scale: float
    parameters: float
    residual_rad: Floats
    stable: Bools

    @cached_property
    def std_rad(self) -> float:
        """Standard deviation of the residual phase over stable windows, including their phase noise."""
        return float(np.sqrt(np.mean(self.residual_rad[self.stable] ** 2))) if self.stable.any() else np.inf

    @property
    def stable_fraction(self) -> float:
        """Fraction of the coherent windows that follow the model."""
        return float(self.stable.mean()) if len(self.stable) else 0.0


def estimate_motion(phases: WindowPhases, design: Floats, constants: Floats, *, radius_m: float) -> ResidualMotion:
    """Estimate the residual motion between two flights from the phases of windows.

    Parameters
    ----------
    phases
        Phases of coherent windows.
    design, constants
        `ResidualTracks.phase` and `ResidualTracks.constant_phase` of the windows.
    radius_m
        Largest constant displacement of the search, metres.

    Raises
    ------
    ValueError
        If there are fewer than `LEAST_WINDOWS` windows.

    Notes
    -----
    Source: docs/theory/stack.md, eqs. 5 and 6.

    Examples
    --------
    The last of 40 windows moves by itself.

    >>> design = np.random.default_rng(0).normal(size=(40, 3))
    >>> phase = 0.5 + design @ [0.3, -0.2, 0.1] + np.append(np.zeros(39), 2.0)
    >>> motion = estimate_motion(WindowPhases(np.exp(1j * phase), *np.full((3, 40), 0.1)), design, design, radius_m=1.0)
    >>> round(motion.constant_rad, 1), motion.residual_rad[-1].round(1), int(motion.stable.sum())
    (0.5, np.float64(2.0), 39)
    """
    if len(phases) < LEAST_WINDOWS:
        raise ValueError(f"{len(phases)} coherent windows; at least {LEAST_WINDOWS} are required")
    phase, std = np.angle(phases.phasor), phases.std_rad
    model = _searched(phases, constants, radius_m)
    size, scale = design.shape[1], 1.0
    unknowns, columns = np.zeros(size), np.column_stack([np.ones(len(phase)), design])
    for round_number in range(_ROUNDS):
        # Residuals on the branch nearest to the model, their scatter, and weights (eq. 5).
        residual = np.angle(np.exp(1j * (phase - model)))
        scatter = max(1.0, 1.4826 * float(np.median(np.abs(residual) / std)))
        weight = np.maximum(1 - (residual / (_CUT * scatter * std)) ** 2, 0.0) ** 2 / (scatter * std) ** 2
        if round_number == 0:
            weight = 1 / (scatter * std) ** 2
        # Maximum of the posterior; the constant has no prior.
        normal = columns.T @ (weight[:, None] * columns)
        normal[1:, 1:] += np.eye(size) / scale**2
        solved = np.linalg.solve(normal, columns.T @ (weight * (model + residual)))
        before, model, unknowns = model, columns @ solved, solved[1:]
        covariance = np.linalg.inv(normal)[1:, 1:]
        # Scale of the prior, from the parameters that the phases determine (eq. 6).
        parameters = max(size - float(np.trace(covariance)) / scale**2, 1e-3)
        scale = float(np.clip(np.sqrt(unknowns @ unknowns / parameters), *_SCALES))
        if round_number > 3 and np.abs(model - before).max() < 1e-4:
            break
    residual = np.angle(np.exp(1j * (phase - model)))
    stable = weight * (scatter * std) ** 2 > _STABLE_WEIGHT
    constant = float(np.angle(np.exp(1j * solved[0])))
    return ResidualMotion(constant, unknowns, scale, parameters, residual, stable)


def _searched(phases: WindowPhases, constants: Floats, radius_m: float) -> Floats:
    """Return the phases of the constant displacement for which the windows agree best (eq. 5)."""
    weight = np.exp(1j * np.angle(phases.phasor)) / np.maximum(phases.std_rad, 0.05)
    centred = constants - np.average(constants, axis=0, weights=np.abs(weight))
    _, singular, directions = np.linalg.svd(centred / np.sqrt(len(centred)), full_matrices=False)
    steps = []
    for value in singular:
        # Displacements along this direction change the phases of the scene by `value` rad rms per metre.
        count = int(np.ceil(radius_m * value * np.sqrt(12) / _STEP_RAD))
        steps.append(np.linspace(-radius_m, radius_m, 2 * count + 1) if count else np.zeros(1))
    while np.prod([len(step) for step in steps]) > _MOST_CANDIDATES:
        longest = int(np.argmax([len(step) for step in steps]))
        middle, half = len(steps[longest]) // 2, len(steps[longest]) // 4
        steps[longest] = steps[longest][middle - half : middle + half + 1]
    candidates = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3) @ directions
    some = slice(None, None, max(1, len(centred) // _MOST_SEARCHED))
    blocks = np.array_split(candidates, len(candidates) // 1000 + 1)
    agreement = np.concatenate([np.abs(np.exp(-1j * block @ centred[some].T) @ weight[some]) for block in blocks])
    best = candidates[int(agreement.argmax())]
    level = float(np.angle((weight * np.exp(-1j * centred @ best)).sum()))
    return np.asarray(level + centred @ best)
