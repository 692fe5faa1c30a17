"""Kaiser window, and the Kaiser-windowed sinc that interpolates band-limited samples.

The window is implemented in numpy, because scipy.signal provides it only at integer samples and takes a second to
import.
"""

import numpy as np

from apertura.common.arrays import Floats


def kaiser_beta(rejection_db: float) -> float:
    """Return the β of a Kaiser window for a stopband rejection A above 50 dB: 0.1102·(A - 8.7).

    Parameters
    ----------
    rejection_db
        A, level of the stopband below the passband, dB, above 50.

    Notes
    -----
    Source: J. F. Kaiser, "Nonrecursive digital filter design using the I0-sinh window function", ISCAS 1974.

    Examples
    --------
    >>> round(kaiser_beta(100.0), 3)
    10.061
    """
    return 0.1102 * (rejection_db - 8.7)


def kaiser_window(position: Floats, beta: float) -> Floats:
    """Return the Kaiser window I0(β·√(1 - position²))/I0(β), zero outside -1…1.

    Parameters
    ----------
    position
        (...,) float64, offset from the centre of the window as a fraction of its half width.
    beta
        Shape parameter; a larger value gives a wider main lobe and lower sidelobes.

    Examples
    --------
    >>> bool(np.allclose(kaiser_window(np.linspace(-1, 1, 9), 6.0), np.kaiser(9, 6.0)))
    True
    """
    inside = 1 - position**2
    return np.where(inside >= 0, np.i0(beta * np.sqrt(np.maximum(inside, 0.0))) / np.i0(beta), 0.0)


def kaiser_sinc(distance: Floats, *, half: int, beta: float) -> Floats:
    """Return the weights of samples in an interpolated value: sinc(distance) under a Kaiser window.

    Parameters
    ----------
    distance
        (...,) float64, distance from the interpolated position to each sample, in samples.
    half
        Number of samples used on each side.
    beta
        Shape parameter of the window.

    Examples
    --------
    >>> tone = np.cos(0.5 * np.arange(-10, 10))
    >>> weights = kaiser_sinc(0.25 - np.arange(-10, 10), half=10, beta=10.0)
    >>> bool(abs(weights @ tone - np.cos(0.5 * 0.25)) < 1e-5)
    True
    """
    return np.asarray(np.sinc(distance) * kaiser_window(distance / half, beta))
