"""What images of parts of the aperture say of an image: noise, drift from part to part, sharpness against chance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_CHANCES = 8


@dataclass(frozen=True)
class SubApertures:
    """Measures of some patches of an image, medians over the patches; NaN where there is none.

    Attributes
    ----------
    snr_db
        SNR of a pixel, by images of even and of odd pulses.
    drift_m, drift_std_m
        RMS of where the parts of the aperture show the patch against each other, and how uncertain that is.
    entropy, entropy_by_chance
        Shannon entropy of the patch, nats, and that of the same parts added with random phases: where both are alike
        the phases of the parts do nothing for the patch.
    """

    snr_db: float
    drift_m: float
    drift_std_m: float
    entropy: float
    entropy_by_chance: float


def compare_parts(parts: NDArray[np.complex64], *, spacing_m: float, generator: np.random.Generator) -> SubApertures:
    """Return what images of the parts of the aperture say.

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
    whole = parts.sum(axis=(1, 2))
    drifts = np.array([_drift_px(patch.sum(axis=0)) for patch in parts]) * spacing_m
    common = np.median(drifts, axis=0)
    spread = 1.4826 * np.median(np.abs(drifts - common), axis=0)
    return SubApertures(
        snr_db=float(np.median([_snr_db(*patch.sum(axis=1)) for patch in parts])),
        drift_m=float(np.sqrt((common**2).sum(axis=-1).mean())),
        drift_std_m=float(np.sqrt((spread**2).sum(axis=-1).mean() / len(parts))),
        entropy=float(np.median([_entropy(patch) for patch in whole])),
        entropy_by_chance=float(np.median([_entropy_by_chance(patch.sum(axis=0), generator) for patch in parts])),
    )


def _snr_db(even: NDArray[np.complex64], odd: NDArray[np.complex64]) -> float:
    """Return signal against noise of the sum of two images that share the signal alone."""
    signal = max(float((even * odd.conj()).real.sum()), 0.0)
    noise = float((np.abs(even - odd) ** 2).sum()) / 2
    return 10 * float(np.log10(max(2 * signal, 1e-30) / max(noise, 1e-30)))


def _drift_px(parts: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return (part, 2) where each part shows the patch against the mean over all parts, pixels down and right."""
    power = np.abs(parts).astype(np.float64) ** 2
    power /= np.maximum(power.sum(axis=(-2, -1), keepdims=True), 1e-30)
    mean = np.fft.rfft2(power.mean(axis=0) - power.mean())
    found = np.array([_peak(np.fft.irfft2(np.fft.rfft2(one) * mean.conj(), one.shape)) for one in power])
    return np.asarray(found - found.mean(axis=0))


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
    phases = np.exp(2j * np.pi * generator.random((_CHANCES, len(parts))))
    return float(np.mean([_entropy(np.tensordot(turned, parts, 1)) for turned in phases]))
