"""How good an image is as a whole: numerical error, entropy, coherence, noise floor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class NumericalError:
    """Difference of an image from `reference` at some pixels, after one complex gain.

    Attributes
    ----------
    rms_db
        RMS of the difference over RMS of the reference at those pixels, dB.
    peak_db
        Largest difference over the image's peak, dB.
    """

    rms_db: float
    peak_db: float


def random_pixels(shape: tuple[int, int], count: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Return (count, 2) rows and columns drawn evenly over an image, without repeats where it is large enough.

    Examples
    --------
    >>> random_pixels((2, 2), 256, np.random.default_rng(0)).shape
    (4, 2)
    """
    size = shape[0] * shape[1]
    chosen = generator.choice(size, min(count, size), replace=False)
    return np.stack(np.unravel_index(np.sort(chosen), shape), -1)


def numerical_error(
    computed: NDArray[np.complex64], reference: NDArray[np.complex128], *, peak: float | None = None
) -> NumericalError:
    """Return the error of pixel values against the reference's.

    Parameters
    ----------
    computed, reference
        (pixel,) complex.
    peak
        Largest magnitude of the whole image; by default of these pixels.

    Notes
    -----
    Source: DESIGN section 5, the definitions of numerical_error_db and peak_error_db.

    Examples
    --------
    >>> exact = np.array([1.0 + 0j, 2.0, 2.0])
    >>> round(numerical_error(2j * (exact + [0, 0, 0.003]), exact).rms_db, 1)
    -62.6
    """
    values = computed.astype(np.complex128)
    power = np.vdot(values, values).real
    gain = complex(np.vdot(values, reference) / power) if power else 0j
    difference = np.abs(gain * values - reference)
    top = abs(gain) * peak if peak is not None else np.abs(reference).max()
    return NumericalError(
        _ratio_db(np.sqrt((difference**2).mean()), np.sqrt((np.abs(reference) ** 2).mean())),
        _ratio_db(difference.max(), top),
    )


def _ratio_db(amplitude: float, against: float) -> float:
    floor = np.finfo(np.float64).eps
    return float(20 * np.log10(max(amplitude / against, floor))) if against > 0 else 0.0


def entropy(image: NDArray[np.complex64]) -> float:
    """Return the Shannon entropy of the image's power, nats: the lower, the better focused.

    Examples
    --------
    >>> round(entropy(np.ones((10, 10), np.complex64)), 3)
    4.605
    """
    power = np.abs(image[np.isfinite(image)]).astype(np.float64) ** 2
    share = power[power > 0] / power.sum()
    return float(-(share * np.log(share)).sum())


def coherence_factor(contributions: NDArray[np.complex128]) -> float:
    """Return Γ = |Σ s_m|² / (M Σ |s_m|²) of what each pulse adds at a pixel: 1 in phase, 1/M at random.

    Notes
    -----
    Source: DESIGN section 4.

    Examples
    --------
    >>> coherence_factor(np.exp(1j * np.array([0.3, 0.3, 0.3])))
    1.0
    """
    energy = len(contributions) * float((np.abs(contributions) ** 2).sum())
    return float(np.round(np.abs(contributions.sum()) ** 2 / energy, 12)) if energy else 0.0


def noise_floor_db(image: NDArray[np.complex64]) -> float:
    """Return the median power over the peak power, dB: what lies between the targets.

    Examples
    --------
    >>> round(noise_floor_db(np.array([[1.0, 0.1], [0.1, 0.1]], np.complex64)), 1)
    -20.0
    """
    power = np.abs(image[np.isfinite(image)]).astype(np.float64) ** 2
    return float(10 * np.log10(np.median(power) / power.max()))
