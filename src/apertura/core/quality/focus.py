"""Focus of an image, measured without truth: by contributions of pulses and by subapertures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import number_of
from apertura.common.units import decibels
from apertura.core.quality.measures import coherence_factor, weighted_median

# ---- Subapertures: noise, drift and entropy

_RANDOM_DRAWS = 8  # of random phases, averaged


@dataclass(frozen=True)
class SubApertures:
    """Measures of some patches of an image, medians over the patches; NaN where there is none.

    Attributes
    ----------
    snr_db
        SNR of a pixel, by images of even and of odd pulses.
    drift_m, drift_std_m
        RMS of the shifts of the patch between subapertures, and its uncertainty.
    entropy, entropy_random_phase
        Shannon entropy of the patch, nats, and that of the same parts added with random phases: where both are equal
        the phases of the subapertures do not focus the patch.
    """

    snr_db: float
    drift_m: float
    drift_std_m: float
    entropy: float
    entropy_random_phase: float


def compare_parts(parts: NDArray[np.complex64], *, spacing_m: float, generator: np.random.Generator) -> SubApertures:
    """Return the measures of subaperture images.

    Parameters
    ----------
    parts
        (patch, 2, part, y, x) complex64: patches by even and by odd pulses of each part; their sum is the image.
    spacing_m
        Between places.
    generator
        Draws the random phases.

    Notes
    -----
    Source: docs/theory/focus.md, "Parts of the aperture".

    Examples
    --------
    >>> y, x = np.mgrid[:32, :32]
    >>> lobe = lambda shift: np.sinc((x - 16 - shift) / 9) * np.sinc((y - 16) / 3)
    >>> still = np.array([[[lobe(0) for _ in range(8)]] * 2], np.complex64)
    >>> moving = np.array([[[lobe(0.5 * part) for part in range(8)]] * 2], np.complex64)
    >>> generator = np.random.default_rng(1)
    >>> [round(compare_parts(one, spacing_m=0.1, generator=generator).drift_m, 2) for one in (still, moving)]
    [0.0, 0.11]
    """
    if not len(parts):
        return SubApertures(*(float("nan"),) * 5)
    full = parts.sum(axis=(1, 2))
    drifts = np.array([_drift_px(patch.sum(axis=0)) for patch in parts]) * spacing_m
    common = np.median(drifts, axis=0)
    spread = 1.4826 * np.median(np.abs(drifts - common), axis=0)
    return SubApertures(
        snr_db=float(np.median([_snr_of_halves_db(*patch.sum(axis=1)) for patch in parts])),
        drift_m=float(np.sqrt((common**2).sum(axis=-1).mean())),
        drift_std_m=float(np.sqrt((spread**2).sum(axis=-1).mean() / len(parts))),
        entropy=float(np.median([_entropy(patch) for patch in full])),
        entropy_random_phase=float(np.median([_entropy_by_chance(patch.sum(axis=0), generator) for patch in parts])),
    )


def _snr_of_halves_db(even: NDArray[np.complex64], odd: NDArray[np.complex64]) -> float:
    """Return signal against noise of the sum of two images that share the signal alone."""
    signal = max(float((even * odd.conj()).real.sum()), 0.0)
    noise = float((np.abs(even - odd) ** 2).sum()) / 2
    return decibels(max(2 * signal, 1e-30) / max(noise, 1e-30))


def _drift_px(parts: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return (part, 2) shifts of the patch in each part against the mean over all parts, pixels down and right."""
    power = np.abs(parts).astype(np.float64) ** 2
    power /= np.maximum(power.sum(axis=(-2, -1), keepdims=True), 1e-30)
    mean = np.fft.rfft2(power.mean(axis=0) - power.mean())
    shifts = np.array([_peak(np.fft.irfft2(np.fft.rfft2(one) * mean.conj(), one.shape)) for one in power])
    return np.asarray(shifts - shifts.mean(axis=0))


def _peak(correlation: NDArray[np.float64]) -> list[float]:
    """Return the place of the maximum of a circular correlation, to a fraction of a pixel by parabolas."""
    best = np.unravel_index(int(correlation.argmax()), correlation.shape)
    place = []
    for axis, size in enumerate(correlation.shape):
        at = [np.take(correlation, (best[axis] + step) % size, axis)[best[1 - axis]] for step in (-1, 0, 1)]
        bend = at[0] - 2 * at[1] + at[2]
        fraction = 0.5 * (at[0] - at[2]) / bend if bend else 0.0
        place.append((best[axis] + fraction + size / 2) % size - size / 2)
    return place


def _entropy(patch: NDArray[np.complexfloating]) -> float:
    power = np.abs(patch).astype(np.float64).ravel() ** 2
    share = power[power > 0] / max(power.sum(), 1e-30)
    return float(-(share * np.log(share)).sum())


def _entropy_by_chance(parts: NDArray[np.complex64], generator: np.random.Generator) -> float:
    phases = np.exp(2j * np.pi * generator.random((_RANDOM_DRAWS, len(parts))))
    return float(np.mean([_entropy(np.tensordot(phasors, parts, 1)) for phasors in phases]))


# ---- Focus of isolated bright points, from contributions of pulses

LEAST_BLOCKS = 32
"""Blocks of pulses that a point must dominate each: enough to separate phase errors from noise."""

MOST_INTERFERENCE = 0.08
"""Log-amplitude variance of a point over the aperture, above which it does not dominate its cell."""

LEAST_PEAK_SHARE = 0.35
"""Amplitude at the point over the largest that a linear phase gives: less is a sidelobe of an echo elsewhere."""

DEFOCUSED_DB = -1.0
"""dB, loss of a peak beyond which an image is called defocused."""

Verdict = Literal["focused", "defocused", "cannot tell"]

MOST_ERROR_DB = -20.0
"""dB, numerical error against the peak above which, where less was requested, bright points may be artefacts."""

GEOMETRY_CONTRADICTED = frozenset(
    {
        "association_ambiguous",
        "association_suspect",
        "attitude_suspect",
        "code_unconfirmed",
        "cycle_slip_suspected",
        "echo_outside_scene",
        "flights_displaced",
        "loss_unexpected",
        "pair_unconfirmed",
        "pairs_displaced",
        "pairs_out_of_phase",
        "path_offsets_differ",
        "phase_unobservable",
        "platform_below_scene",
        "position_error_understated",
        "reference_point",
        "refinement_rejected",
        "time_tag_offset",
        "wrong_code",
    }
)
"""Flags that contradict the geometry, the clocks or the code that an image was formed with: no image that carries one
is called focused."""

_TREND = 5  # degree of the polynomial that models patterns, range and aspect in the log-amplitude
_PADDING = 8  # of the spectrum of blocks, whose maximum removes a linear phase
_SIGMAS = 5.0  # by which a drift must exceed a cell to be called defocused


@dataclass(frozen=True)
class PointFocus:
    """Focus of one point.

    Attributes
    ----------
    loss_db
        Peak power against that of the same contributions in phase, 0 or less, with the loss by noise and neighbours
        removed.
    interference
        Power of noise and neighbours over the point's: the log-amplitude variance.
    pulses
        Pulses of a block; phase errors faster than that are not measured.
    snr_db
        Of the point in the image, from its even and its odd pulses; NaN with fewer than four.
    coherence, coherence_noise_limit
        |Σ s|²/(M Σ|s|²) of the contributions of M pulses, and its value with their noise alone.
    """

    loss_db: float
    interference: float
    pulses: int
    snr_db: float
    coherence: float = 1.0
    coherence_noise_limit: float = 1.0


def point_focus(contributions: NDArray[np.complex128]) -> PointFocus | None:
    """Return the focus of a point; None where none dominates its range cell over the whole aperture.

    Parameters
    ----------
    contributions
        (pulse,) complex128, contribution of each pulse at the point, in the order in which they were sent.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1. Phase errors do not change the amplitude of a contribution, noise and
    neighbours change phase and amplitude alike: the log-amplitude variance gives their part of the phase variance.
    Pulses are averaged in blocks, as long as it takes for the point to dominate them.

    Examples
    --------
    >>> phase = 0.8 * np.sin(np.arange(400) / 9)
    >>> focus = point_focus(np.exp(1j * phase))
    >>> round(focus.loss_db, 1), focus.pulses
    (-1.4, 1)
    >>> noise = np.random.default_rng(1).standard_normal((2, 400))
    >>> point_focus(noise[0] + 1j * noise[1]) is None
    True
    """
    pulses = 1
    # Blocks of 1, 2, 4 … pulses, until v of eq. 1 shows that the point dominates them.
    while len(contributions) // pulses >= LEAST_BLOCKS:
        count = len(contributions) // pulses
        blocks = contributions[: count * pulses].reshape(count, pulses).mean(axis=1)
        amplitude = np.abs(blocks)
        if amplitude.min() > 0:
            variance = log_amplitude_variance(np.log(amplitude))
            if variance <= MOST_INTERFERENCE:
                best = float(np.abs(np.fft.fft(blocks, _PADDING * count)).max())
                if abs(complex(blocks.sum())) < LEAST_PEAK_SHARE * best:
                    return None
                # Eq. 1: the spectrum's maximum over f, with the loss by noise and neighbours (v) taken out.
                loss = (best / amplitude.sum()) ** 2 * (1 + variance * (1 - 2.5 * variance) / 2) ** 2
                snr_db = _snr_db(contributions)
                allowed = 1 / (1 + len(contributions) * 10 ** (-snr_db / 10))
                loss_db = decibels(min(1.0, loss))
                return PointFocus(loss_db, variance, pulses, snr_db, coherence_factor(contributions), allowed)
        pulses *= 2
    return None


def log_amplitude_variance(log_amplitude: NDArray[np.float64]) -> float:
    """Return the variance of the log-amplitudes of blocks about their smooth trend: patterns, range and aspect."""
    along = np.linspace(-1, 1, len(log_amplitude))
    trend = np.polynomial.legendre.Legendre.fit(along, log_amplitude, _TREND)(along)
    return float(((log_amplitude - trend) ** 2).sum() / (len(along) - _TREND - 1))


def _snr_db(contributions: NDArray[np.complex128]) -> float:
    """Return the SNR of a pixel from neighbouring pulses, which differ by noise alone."""
    count = len(contributions) // 2
    if count < 2:
        return float("nan")
    even, odd = contributions[: 2 * count : 2], contributions[1 : 2 * count : 2]
    noise = float((np.abs(even - odd) ** 2).mean()) / 2 / (2 * count)
    power = abs(complex((even + odd).mean()) / 2) ** 2
    if not power:
        return float("-inf")
    return decibels(max(power - noise, 1e-3 * power) / max(noise, 1e-15 * power))


@dataclass(frozen=True)
class Focus:
    """Verdict of an image's bright points on its focus.

    Attributes
    ----------
    verdict
        focused, defocused, or cannot tell.
    loss_db, std_db
        Median over the points, weighted by amplitude, and its standard deviation; NaN without points.
    points
        How many were measured.
    why
        One line: reason for the verdict.
    """

    verdict: Verdict
    loss_db: float
    std_db: float
    points: int
    why: str


def judge(points: Sequence[tuple[float, PointFocus | None]]) -> Focus:
    """Return the joint verdict of bright points.

    Parameters
    ----------
    points
        Amplitude and focus of each.

    Examples
    --------
    >>> judge([(1.0, PointFocus(-3.0, 0.01, 1, 30.0)), (0.9, PointFocus(-3.2, 0.02, 1, 29.0))]).verdict
    'defocused'
    >>> judge([(1.0, None)]).verdict
    'cannot tell'
    """
    measured = [(amplitude, focus) for amplitude, focus in points if focus is not None]
    if not measured:
        return Focus("cannot tell", float("nan"), float("nan"), 0, "no bright point")
    losses = np.array([focus.loss_db for _, focus in measured])
    # Standard deviation of each loss by noise and neighbours.
    stds = np.array(
        [10 / float(np.log(10)) * focus.interference * float(np.sqrt(2 / LEAST_BLOCKS)) + 0.02 for _, focus in measured]
    )
    weights = np.array([amplitude for amplitude, _ in measured])
    loss = weighted_median(losses, weights)
    spread = 1.4826 * weighted_median(np.abs(losses - loss), weights)
    std = float(np.hypot(spread, np.median(stds)) / np.sqrt(len(measured)))
    verdict = verdict_of_loss(loss, std)
    line = f"{number_of(len(measured), 'bright point')} lost {abs(loss):.2f} ± {std:.2f} dB of the peak to phase errors"
    if verdict == "cannot tell":
        line += f": within two standard deviations, the loss may or may not exceed {-DEFOCUSED_DB:g} dB"
    return Focus(verdict, loss, std, len(measured), line)


def verdict_of_loss(loss_db: float, std_db: float) -> Verdict:
    """Return the verdict that a loss of the peak and its standard deviation allow, at two standard deviations.

    Examples
    --------
    >>> verdict_of_loss(-0.2, 0.1), verdict_of_loss(-2.0, 0.1), verdict_of_loss(-4.48, 2.85)
    ('focused', 'defocused', 'cannot tell')
    """
    if loss_db < DEFOCUSED_DB - 2 * std_db:
        return "defocused"
    return "focused" if loss_db > DEFOCUSED_DB + 2 * std_db else "cannot tell"


def focus_with_flags(
    focus: Mapping[str, Any], flags: Iterable[str], *, error_db: float | None = None
) -> dict[str, Any]:
    """Return the section `focus` of image.json with a verdict that no flag of the image contradicts.

    Parameters
    ----------
    focus
        With `verdict` and `why`, of the bright points alone.
    flags
        Names of the flags that the image carries.
    error_db
        Numerical error of the image against its peak, dB; None: not measured.

    Notes
    -----
    Source: docs/theory/focus.md, "Verdict".

    Examples
    --------
    >>> focus_with_flags({"verdict": "focused", "why": "3 bright points lost 0.02 dB"}, ["wrong_code"])["verdict"]
    'cannot tell'
    """
    against = sorted(GEOMETRY_CONTRADICTED.intersection(flags))
    if "accuracy_not_met" in flags and error_db is not None and error_db > MOST_ERROR_DB:
        against.append("accuracy_not_met")
    if focus["verdict"] != "focused" or not against:
        return dict(focus)
    return {**focus, "verdict": "cannot tell", "why": f"{focus['why']}; contradicted by {', '.join(against)}"}


def judge_parts(parts: SubApertures, *, cell_m: float) -> Focus:
    """Return the verdict of subaperture images where no bright point can be measured.

    Parameters
    ----------
    parts
        Of several patches.
    cell_m
        Resolution cell: parts that show a patch further apart cannot add up to a sharp image.

    Examples
    --------
    >>> judge_parts(SubApertures(20.0, 0.9, 0.05, 7.0, 7.1), cell_m=0.3).verdict
    'defocused'
    >>> judge_parts(SubApertures(20.0, 0.9, 0.5, 7.0, 7.1), cell_m=0.3).verdict
    'cannot tell'
    """
    nothing = float("nan"), float("nan"), 0
    line = "no bright point dominates its range cell"
    if parts.drift_m - _SIGMAS * parts.drift_std_m > cell_m and parts.drift_std_m > 0:
        drift = f"{parts.drift_m:.2f} ± {parts.drift_std_m:.2f} m"
        return Focus("defocused", *nothing, f"{line}, and parts of the aperture show the scene {drift} apart")
    if np.isfinite(parts.entropy):
        line += f"; entropy {parts.entropy:.2f}, with random phases {parts.entropy_random_phase:.2f}"
    return Focus("cannot tell", *nothing, line)
