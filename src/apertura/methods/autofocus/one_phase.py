"""Phases of blocks of pulses that make patches sharp, the same for the whole scene: phase gradient, minimum entropy."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Patches = Sequence[NDArray[np.complex64]]
"""What blocks add to the pixels of each patch, (pixel, block)."""

_SHRINK = 0.7  # of the window, from one pass to the next
_EDGE_DB, _WIDER = 10.0, 1.5  # the window holds what is brighter below the peak, and half as much again
_LEAST_UNREST = 0.02  # of a line's power: no point is quieter
_SETTLED_RAD = 0.05
_MOST_PASSES = 30
_CHOICES = 2  # of the brightest pixels, before and after they have been sharpened
_MOST_STEPS = 100


def phase_gradient(patches: Patches) -> Floats:
    """Return the phases by which blocks have to be turned, from how the brightest pixels' phases go on.

    Parameters
    ----------
    patches
        What blocks add, (pixel, block) complex64 each.

    Returns
    -------
    ndarray
        (block,) float64, radians, continuous, without mean and slope.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 32; D. E. Wahl, P. H. Eichel, D. C. Ghiglia and C. V. Jakowatz, "Phase
    gradient autofocus", IEEE Trans. Aerospace and Electronic Systems 30(3), 1994.

    Examples
    --------
    >>> wrong = np.exp(2j * np.sin(np.arange(64) / 5))
    >>> mended = wrong * np.exp(1j * phase_gradient([wrong[None].astype(np.complex64)]))
    >>> [round(float(np.abs(np.fft.fft(one, 1024)).max()) / 64, 1) for one in (wrong, mended)]
    [0.6, 1.0]
    """
    count = patches[0].shape[1]
    cycles = np.abs(np.fft.fftfreq(2 * count, 1 / count))
    phase, window = np.zeros(count), float(count)
    for _ in range(_MOST_PASSES):
        spectrum = np.fft.fft(_lines(patches, phase), 2 * count, axis=1)
        least = _spread(spectrum, cycles)
        narrow = window <= least
        window = min(window, least) if narrow else max(window * _SHRINK, least)
        windowed = np.fft.ifft(np.where(cycles <= window / 2, spectrum, 0), axis=1)[:, :count]
        steps = (windowed[:, 1:] * windowed[:, :-1].conj() / _unrest(windowed)).sum(axis=0)
        wrong = _level(np.append(0.0, np.cumsum(np.angle(steps))))
        phase = phase - wrong
        if narrow and wrong.std() < _SETTLED_RAD:
            break
    return phase


def minimum_entropy(patches: Patches) -> Floats:
    """Return the phases at which the lines through the brightest pixels have the least entropy.

    Parameters and result as `phase_gradient`.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 33.

    Examples
    --------
    >>> wrong = np.exp(2j * np.sin(np.arange(64) / 5))
    >>> mended = wrong * np.exp(1j * minimum_entropy([wrong[None].astype(np.complex64)]))
    >>> [round(float(np.abs(np.fft.fft(one, 1024)).max()) / 64, 1) for one in (wrong, mended)]
    [0.6, 1.0]
    """
    from scipy.optimize import minimize  # slow to import

    phase = np.zeros(patches[0].shape[1])
    options = {"maxiter": _MOST_STEPS, "maxcor": 20}
    for _ in range(_CHOICES):
        lines = _lines(patches, phase)
        found = minimize(partial(entropy, lines), np.zeros_like(phase), jac=True, method="L-BFGS-B", options=options)
        phase = _level(phase + np.unwrap(found.x))
    return phase


def entropy(lines: NDArray[np.complex128], phase: Floats) -> tuple[float, Floats]:
    """Return the entropy of lines of the image and its derivative by the phase of each block.

    Parameters
    ----------
    lines
        (line, block) complex128, what blocks add to a pixel of each line.
    phase
        (block,) float64, radians by which blocks are turned.

    Returns
    -------
    tuple
        nats; (block,) float64, nats per radian.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 33. Blocks are followed by as many zeros, so that
    neither a peak between two samples nor one at the line's end is blurred; the energy is that of the blocks whatever
    their phases.

    Examples
    --------
    >>> lines, step = np.exp(1j * np.arange(8.0) ** 2)[None], 1e-6 * np.eye(8)[3]
    >>> slope = (entropy(lines, step)[0] - entropy(lines, -step)[0]) / 2e-6
    >>> round(slope, 6), round(float(entropy(lines, 0 * step)[1][3]), 6)
    (0.114494, 0.114494)
    """
    turned = lines * np.exp(1j * phase)
    blocks = turned.shape[1]
    image = np.fft.fft(turned, 2 * blocks, axis=1, norm="ortho")
    power = np.abs(image) ** 2
    total = max(float(power.sum()), 1e-300)
    share = power / total
    logarithm = np.log(np.maximum(share, 1e-300))
    by_image = -(logarithm + 1) * image / total
    by_turned = np.fft.ifft(by_image, axis=1, norm="ortho")[:, :blocks]
    return -float((share * logarithm).sum()), -2 * (turned * by_turned.conj()).imag.sum(axis=0)


def _lines(patches: Patches, phase: Floats) -> NDArray[np.complex128]:
    """Return (patch, block), what blocks as turned add to the brightest pixel of each patch."""
    turn = np.exp(1j * phase)
    brightest = (int(np.abs(patch @ turn.astype(np.complex64)).argmax()) for patch in patches)
    return np.stack([patch[pixel] * turn for patch, pixel in zip(patches, brightest, strict=True)])


def _spread(spectrum: NDArray[np.complex128], cycles: Floats) -> float:
    """Return the width of the window that holds the blurred points, cycles over the aperture."""
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    return 2 * _WIDER * max(float(cycles[power > power.max() * 10 ** (-_EDGE_DB / 10)].max(initial=0.0)), 1.0)


def _unrest(windowed: NDArray[np.complex128]) -> Floats:
    """Return (line, 1) what beside its point a line holds: the variance of its magnitude."""
    level = np.abs(windowed)
    return np.asarray(level.var(axis=1) + _LEAST_UNREST * level.mean(axis=1) ** 2)[:, None] + 1e-300


def _level(phase: Floats) -> Floats:
    """Return phases without what only shifts a line and turns it."""
    at = np.linspace(-1, 1, len(phase))
    return np.asarray(phase - phase.mean() - at * (at @ phase) / (at @ at))


METHODS: Mapping[str, Callable[[Patches], Floats]] = {
    "phase_gradient": phase_gradient,
    "minimum_entropy": minimum_entropy,
}
"""What `processing.autofocus_method` may name where one phase per pulse suffices."""
