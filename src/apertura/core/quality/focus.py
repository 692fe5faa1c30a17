"""Assessment of focus without ground truth, from pulse contributions at bright points and from subapertures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import number_of
from apertura.common.units import decibels
from apertura.core.quality.measures import coherence_factor, weighted_median

# ---- Subapertures: noise, drift and entropy

_RANDOM_DRAWS = 8  # number of draws of random phases, over which the entropy is averaged


@dataclass(frozen=True)
class SubApertures:
    """Subaperture measures of patches of an image, medians over the patches; NaN without patches.

    Attributes
    ----------
    snr_db
        SNR of a pixel, from the images of the even and of the odd pulses.
    drift_m, drift_std_m
        RMS shift of the patch between subapertures, and its standard deviation.
    entropy, entropy_random_phase
        Shannon entropy of the patch, nats, and entropy of the sum of the same subapertures with random phases. If both
        values are equal, the patch is not focused.
    """

    snr_db: float
    drift_m: float
    drift_std_m: float
    entropy: float
    entropy_random_phase: float


def compare_parts(parts: NDArray[np.complex64], *, spacing_m: float, generator: np.random.Generator) -> SubApertures:
    """Measure SNR, drift and entropy of subaperture images.

    Parameters
    ----------
    parts
        (patch, 2, subaperture, y, x) complex64: patches from the even and the odd pulses of each subaperture; the sum
        over both and over the subapertures is the image.
    spacing_m
        Pixel spacing of the patches.
    generator
        Random generator of the phases.

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
    >>> [round(compare_parts(parts, spacing_m=0.1, generator=generator).drift_m, 2) for parts in (still, moving)]
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
    """Return the SNR of the sum of two images with the same signal and independent noise."""
    signal = max(float((even * odd.conj()).real.sum()), 0.0)
    noise = float((np.abs(even - odd) ** 2).sum()) / 2
    return decibels(max(2 * signal, 1e-30) / max(noise, 1e-30))


def _drift_px(parts: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return (subaperture, 2) shifts of a patch relative to the mean over subapertures, pixels down and right."""
    power = np.abs(parts).astype(np.float64) ** 2
    power /= np.maximum(power.sum(axis=(-2, -1), keepdims=True), 1e-30)
    mean = np.fft.rfft2(power.mean(axis=0) - power.mean())
    shifts = np.array([_peak(np.fft.irfft2(np.fft.rfft2(part) * mean.conj(), part.shape)) for part in power])
    return np.asarray(shifts - shifts.mean(axis=0))


def _peak(correlation: NDArray[np.float64]) -> list[float]:
    """Return the position of the maximum of a circular correlation, interpolated between pixels by parabolas."""
    best = np.unravel_index(int(correlation.argmax()), correlation.shape)
    position = []
    for axis, size in enumerate(correlation.shape):
        at = [np.take(correlation, (best[axis] + step) % size, axis)[best[1 - axis]] for step in (-1, 0, 1)]
        bend = at[0] - 2 * at[1] + at[2]
        fraction = 0.5 * (at[0] - at[2]) / bend if bend else 0.0
        position.append((best[axis] + fraction + size / 2) % size - size / 2)
    return position


def _entropy(patch: NDArray[np.complexfloating]) -> float:
    power = np.abs(patch).astype(np.float64).ravel() ** 2
    share = power[power > 0] / max(power.sum(), 1e-30)
    return float(-(share * np.log(share)).sum())


def _entropy_by_chance(parts: NDArray[np.complex64], generator: np.random.Generator) -> float:
    phases = np.exp(2j * np.pi * generator.random((_RANDOM_DRAWS, len(parts))))
    return float(np.mean([_entropy(np.tensordot(phasors, parts, 1)) for phasors in phases]))


# ---- Focus of isolated bright points, from pulse contributions

LEAST_BLOCKS = 32
"""Minimum number of pulse blocks, each dominated by the point, to separate phase errors from noise."""

MOST_INTERFERENCE = 0.08
"""Log-amplitude variance of a point over the aperture, above which the point does not dominate its resolution cell."""

LEAST_PEAK_SHARE = 0.35
"""Minimum ratio of the amplitude at a point to the largest amplitude obtained with any linear phase. A point with a
smaller ratio is a sidelobe of another echo."""

DEFOCUSED_DB = -1.0
"""Peak loss beyond which an image is defocused, dB."""

Verdict = Literal["focused", "defocused", "inconclusive"]

MOST_ERROR_DB = -20.0
"""Numerical error relative to the peak, dB. If the requested accuracy is not met and the error exceeds this level,
bright points may be artefacts."""

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
        "range_defocused",
        "reference_point",
        "refinement_rejected",
        "time_tag_offset",
        "wrong_code",
    }
)
"""Flags that report a contradiction in the geometry, the clocks or the transmitted code. An image with any of these
flags is not reported as focused."""

_TREND = 5  # degree of the polynomial that models patterns, range and aspect in the log-amplitude
_PADDING = 8  # zero-padding factor of the spectrum over blocks, whose maximum is independent of a linear phase
_SIGMAS = 5.0  # standard deviations by which a drift must exceed a resolution cell for the verdict defocused


@dataclass(frozen=True)
class PointFocus:
    """Focus of one point.

    Attributes
    ----------
    loss_db
        Peak power relative to the peak power of the same contributions in phase, dB, 0 or less. The loss caused by
        noise and neighbours is removed.
    interference
        Power of noise and neighbours relative to the power of the point: the log-amplitude variance.
    pulses
        Pulses per block; phase errors that vary within a block are not measured.
    snr_db
        SNR of the point in the image, from even and odd pulses; NaN with fewer than four pulses.
    coherence, coherence_noise_limit
        |Σ s|²/(M Σ|s|²) of the contributions s of M pulses, and its expected value if noise is the only disturbance.
    """

    loss_db: float
    interference: float
    pulses: int
    snr_db: float
    coherence: float = 1.0
    coherence_noise_limit: float = 1.0


def point_focus(contributions: NDArray[np.complex128]) -> PointFocus | None:
    """Measure the focus of a point; None if the point does not dominate its range cell over the whole aperture.

    Parameters
    ----------
    contributions
        (pulse,) complex128, contribution of each pulse at the point, in order of transmission.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1. Phase errors do not change the amplitude of a contribution. Noise and
    neighbours change phase and amplitude equally, so that the log-amplitude variance equals the phase variance caused
    by noise and neighbours. Pulses are averaged over the shortest blocks in which the point is dominant.

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
    found = _peak_loss(contributions, np.ones(len(contributions)), degree=_TREND, most=MOST_INTERFERENCE)
    if found is None:
        return None
    snr_db = _snr_db(contributions)
    allowed = 1 / (1 + len(contributions) * 10 ** (-snr_db / 10))
    coherence = coherence_factor(contributions)
    return PointFocus(found.loss_db, found.variance, found.size, snr_db, coherence, allowed)


class _PeakLoss(NamedTuple):
    """Peak loss of terms by their phases: loss, v of eq. 1, terms per block, and the blocks without linear phase."""

    loss_db: float
    variance: float
    size: int
    blocks: NDArray[np.complex128]


def _peak_loss(
    terms: NDArray[np.complex128], weight: NDArray[np.float64], *, degree: int, most: float
) -> _PeakLoss | None:
    """Compute eq. 1 (over pulses) or 1d (over frequency) for terms of a point; None if it does not dominate them."""
    size = 1
    # Blocks of 1, 2, 4 … terms, until v of eq. 1 is small enough for a dominant point.
    while len(terms) // size >= LEAST_BLOCKS:
        count = len(terms) // size
        blocks, weights = (values[: count * size].reshape(count, size).mean(axis=1) for values in (terms, weight))
        amplitude = np.abs(blocks)
        if amplitude.min() > 0:
            variance = log_amplitude_variance(np.log(amplitude), degree)
            if variance <= most:
                spectrum = np.fft.fft(blocks * weights, _PADDING * count)
                best = int(np.abs(spectrum).argmax())
                peak = float(np.abs(spectrum[best]))
                if np.abs(spectrum[0]) < LEAST_PEAK_SHARE * peak:
                    return None
                # Eq. 1 and 1d: maximum over f or over the delay, with the loss from noise and neighbours (v) removed.
                loss = (peak / (amplitude * weights).sum()) ** 2 * (1 + variance * (1 - 2.5 * variance) / 2) ** 2
                turned = blocks * np.exp(-2j * np.pi * best * np.arange(count) / len(spectrum))
                return _PeakLoss(decibels(min(1.0, loss)), variance, size, turned)
        size *= 2
    return None


def log_amplitude_variance(log_amplitude: NDArray[np.float64], degree: int = _TREND) -> float:
    """Return the log-amplitude variance of blocks about a smooth trend, which models patterns, range and aspect."""
    along = np.linspace(-1, 1, len(log_amplitude))
    trend = np.polynomial.legendre.Legendre.fit(along, log_amplitude, degree)(along)
    return float(((log_amplitude - trend) ** 2).sum() / (len(along) - degree - 1))


def _snr_db(contributions: NDArray[np.complex128]) -> float:
    """Return the SNR of a pixel from consecutive pulses, which differ only by noise."""
    count = len(contributions) // 2
    if count < 2:
        return float("nan")
    even, odd = contributions[: 2 * count : 2], contributions[1 : 2 * count : 2]
    noise = float((np.abs(even - odd) ** 2).mean()) / 2 / (2 * count)
    power = abs(complex((even + odd).mean()) / 2) ** 2
    if not power:
        return float("-inf")
    return decibels(max(power - noise, 1e-3 * power) / max(noise, 1e-15 * power))


# ---- Focus of bright points in range, from their spectra

_BAND_TREND = 2  # degree of the polynomial that models antennas and filters in the log-amplitude over frequency

_BAND_INTERFERENCE = 0.04
"""Log-amplitude variance of a point over frequency, above which neighbours in range may cause its phases: a phase error
does not change the amplitude."""

_LEAST_WEIGHT = 0.01  # weight of the window relative to its maximum, below which subcarriers are not evaluated


@dataclass(frozen=True)
class BandFocus:
    """Focus of one point in range.

    Attributes
    ----------
    loss_db
        Peak power relative to the peak power of the same spectrum in phase, dB, 0 or less. The loss caused by noise and
        neighbours is removed.
    interference
        Power of noise and neighbours relative to the power of the point: the log-amplitude variance.
    phase_rad
        Quadratic phase at the edges of the band relative to mid-band.
    """

    loss_db: float
    interference: float
    phase_rad: float


def band_focus(spectrum: NDArray[np.complex128], weight: NDArray[np.float64]) -> BandFocus | None:
    """Measure the focus of a point in range; None if the point does not dominate its surroundings in range.

    Parameters
    ----------
    spectrum
        (subcarrier,) complex128, coherent sum of the transfer functions over pulses at the point.
    weight
        (subcarrier,) float64, window of the image over the subcarriers.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1d. Subcarriers are averaged over the shortest blocks in which the point is
    dominant; this average is a gate in range.

    Examples
    --------
    >>> x = np.linspace(-1, 1, 256)
    >>> focus = band_focus(np.exp(3j * x**2), np.hanning(256))
    >>> round(focus.loss_db, 1), round(focus.phase_rad, 1)
    (-0.9, 3.0)
    >>> band_focus(1 + 0.9 * np.exp(10j * x), np.hanning(256)) is None
    True
    """
    used = np.flatnonzero(weight >= _LEAST_WEIGHT * weight.max())
    band = slice(int(used[0]), int(used[-1]) + 1)
    found = _peak_loss(spectrum[band], weight[band], degree=_BAND_TREND, most=_BAND_INTERFERENCE)
    if found is None:
        return None
    # Eq. 1e: second-order term of the phase over x, which is ±1 at the edges of the band.
    count = len(found.blocks)
    at = band.start + found.size * (np.arange(count) + 0.5)
    x = 2 * at / len(spectrum) - 1
    phase = np.unwrap(np.angle(found.blocks))
    curved = float(np.polynomial.polynomial.polyfit(x, phase, 2, w=weight[at.astype(np.int64)])[2])
    return BandFocus(found.loss_db, found.variance, curved)


@dataclass(frozen=True)
class Focus:
    """Focus of an image: verdict and peak loss from its bright points.

    Attributes
    ----------
    verdict
        'focused', 'defocused' or 'inconclusive' (not observable).
    loss_db, std_db
        Median peak loss over the points, weighted by amplitude, and its standard deviation; NaN without points.
    points
        Number of measured points.
    reason
        Reason for the verdict, one line.
    """

    verdict: Verdict
    loss_db: float
    std_db: float
    points: int
    reason: str


def judge(points: Sequence[tuple[float, PointFocus | BandFocus | None]]) -> Focus:
    """Judge the focus of an image from its bright points.

    Parameters
    ----------
    points
        Amplitude and focus of each point.

    Examples
    --------
    >>> judge([(1.0, PointFocus(-3.0, 0.01, 1, 30.0)), (0.9, PointFocus(-3.2, 0.02, 1, 29.0))]).verdict
    'defocused'
    >>> judge([(1.0, None)]).verdict
    'inconclusive'
    """
    measured = [(amplitude, focus) for amplitude, focus in points if focus is not None]
    if not measured:
        return Focus("inconclusive", float("nan"), float("nan"), 0, "no bright point")
    losses = np.array([focus.loss_db for _, focus in measured])
    stds = np.array([loss_std_db(focus) for _, focus in measured])
    weights = np.array([amplitude for amplitude, _ in measured])
    loss = weighted_median(losses, weights)
    spread = 1.4826 * weighted_median(np.abs(losses - loss), weights)
    std = float(np.hypot(spread, np.median(stds)) / np.sqrt(len(measured)))
    verdict = verdict_of_loss(loss, std)
    count = number_of(len(measured), "bright point")
    line = f"peak loss {abs(loss):.2f} ± {std:.2f} dB from phase errors, {count}"
    if verdict == "inconclusive":
        line += f": within two standard deviations of the limit, {-DEFOCUSED_DB:g} dB"
    return Focus(verdict, loss, std, len(measured), line)


def loss_std_db(focus: PointFocus | BandFocus) -> float:
    """Return the standard deviation of the loss of a point from noise and neighbours, dB."""
    return 10 / float(np.log(10)) * focus.interference * float(np.sqrt(2 / LEAST_BLOCKS)) + 0.02


def verdict_of_loss(loss_db: float, std_db: float) -> Verdict:
    """Return the verdict for a peak loss and its standard deviation, significant at two standard deviations.

    Examples
    --------
    >>> verdict_of_loss(-0.2, 0.1), verdict_of_loss(-2.0, 0.1), verdict_of_loss(-4.48, 2.85)
    ('focused', 'defocused', 'inconclusive')
    """
    if loss_db < DEFOCUSED_DB - 2 * std_db:
        return "defocused"
    return "focused" if loss_db > DEFOCUSED_DB + 2 * std_db else "inconclusive"


def focus_with_flags(
    focus: Mapping[str, Any], flags: Iterable[str], *, error_db: float | None = None
) -> dict[str, Any]:
    """Return the section `focus` of image.json, with the verdict 'focused' withdrawn if a flag contradicts it.

    Parameters
    ----------
    focus
        Section with `verdict` and `reason` from the bright points alone.
    flags
        Names of the flags of the image.
    error_db
        Numerical error of the image relative to its peak, dB; None: not measured.

    Notes
    -----
    Source: docs/theory/focus.md, "Verdict".

    Examples
    --------
    >>> focus_with_flags({"verdict": "focused", "reason": "peak loss 0.02 dB"}, ["wrong_code"])["verdict"]
    'inconclusive'
    """
    against = sorted(GEOMETRY_CONTRADICTED.intersection(flags))
    if "accuracy_not_met" in flags and error_db is not None and error_db > MOST_ERROR_DB:
        against.append("accuracy_not_met")
    if focus["verdict"] != "focused" or not against:
        return dict(focus)
    return {**focus, "verdict": "inconclusive", "reason": f"{focus['reason']}; contradicted by {', '.join(against)}"}


def judge_parts(parts: SubApertures, *, cell_m: float) -> Focus:
    """Judge the focus of an image from its subapertures, if no bright point can be measured.

    Parameters
    ----------
    parts
        Subaperture measures of patches.
    cell_m
        Size of the resolution cell, metres: subapertures with a larger drift do not add up to a focused image.

    Examples
    --------
    >>> judge_parts(SubApertures(20.0, 0.9, 0.05, 7.0, 7.1), cell_m=0.3).verdict
    'defocused'
    >>> judge_parts(SubApertures(20.0, 0.9, 0.5, 7.0, 7.1), cell_m=0.3).verdict
    'inconclusive'
    """
    nothing = float("nan"), float("nan"), 0
    line = "no bright point dominates its range cell"
    if parts.drift_m - _SIGMAS * parts.drift_std_m > cell_m and parts.drift_std_m > 0:
        drift = f"{parts.drift_m:.2f} ± {parts.drift_std_m:.2f} m"
        return Focus("defocused", *nothing, f"{line}, and subaperture images are displaced from each other by {drift}")
    if np.isfinite(parts.entropy):
        line += f"; entropy {parts.entropy:.2f}, or {parts.entropy_random_phase:.2f} with random phases"
    return Focus("inconclusive", *nothing, line)
