"""Background of a recording: echoes at constant delay while the antennas move, such as antenna coupling.

docs/theory/background.md: signal model (eq. 1), Doppler test (eq. 2), estimators (eq. 3). Whether the
background is removed depends on the scene and is decided in `apertura.core.imaging.background`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.units import decibels
from apertura.core.echo.captures import Pulses, blocks_of
from apertura.core.echo.compression import window_weights
from apertura.core.echo.demodulate import remove_path

Read = Callable[[Pulses], Complexes]
"""Pulse numbers, ascending → (pulse, subcarrier) transfer functions G of eq. 1, with delays in the recorder's time
base."""

_GROUPS = 512
"""Number of groups of pulses whose means are used for estimates: a burst of interference corrupts few of them."""

# Doppler frequencies compared with zero Doppler, in units of 1/duration: higher than those of a slow drift of coupling
_DOPPLER_CELLS = 3, 12
_FALSE_ALARM = 1e-6
"""Probability that noise alone passes the test."""

_LEAST_GROUPS = 16
"""Minimum length of a running median in groups; minimum number of pulses for the test."""


@dataclass(frozen=True, eq=False)
class Background:
    """Component of the transfer functions of a pair at constant delay.

    Attributes
    ----------
    values
        (knot, subcarrier) complex64, C of eq. 1.
    time_s
        (knot,) float64, seconds from the first pulse; values are interpolated linearly between knots.
    """

    values: Complexes
    time_s: Floats

    def outside(self, delays: NDArray[np.bool_]) -> "Background":
        """Return the background without the delays of a mask, (subcarrier,) bool in steps of the resolution."""
        profiles = scipy.fft.ifft(self.values, axis=1) * ~delays
        return Background(scipy.fft.fft(profiles, axis=1).astype(np.complex64), self.time_s)

    def at(self, time_s: Floats, frequency_hz: Floats, delay_s: Floats) -> Complexes:
        """Return the background in the transfer functions of pulses, (pulse, subcarrier) complex64.

        Parameters
        ----------
        time_s
            (pulse,) float64, seconds from the first pulse.
        frequency_hz
            (subcarrier,) float64, ascending in equal steps.
        delay_s
            (pulse,) float64, delay that was removed from the recorder's transfer functions, s of eq. 1.

        Examples
        --------
        >>> drifting = Background(np.array([[1.0], [3.0]], np.complex64), np.array([0.0, 4.0]))
        >>> drifting.at(np.array([0.0, 1.0]), np.array([1e9]), np.zeros(2)).real.tolist()
        [[1.0], [1.5]]
        """
        if len(self.time_s) == 1:
            values = np.broadcast_to(self.values, (len(time_s), self.values.shape[1]))
        else:
            right = np.clip(np.searchsorted(self.time_s, time_s), 1, len(self.time_s) - 1)
            share = (time_s - self.time_s[right - 1]) / (self.time_s[right] - self.time_s[right - 1])
            later = np.clip(share, 0.0, 1.0).astype(np.float32)[:, None]
            values = (1 - later) * self.values[right - 1] + later * self.values[right]
        return remove_path(values, frequency_hz, delay_s=delay_s)


def background_excess_db(groups: Sequence[Complexes]) -> float:
    """Return the excess of zero Doppler in some hundred pulses over its threshold, dB; negative: not detected.

    Parameters
    ----------
    groups
        (pulse, subcarrier) transfer functions G of eq. 1 of the pulses of
        `apertura.core.echo.captures.sampled_pulses`.

    Notes
    -----
    Source: docs/theory/background.md, eq. 2. Echoes of the scene pass zero Doppler at least as fast as the neighbouring
    cells, and noise is white: neither increases the ratio.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = (rng.normal(size=(400, 16, 2)) @ [1, 1j]).astype(np.complex64)
    >>> [background_excess_db(np.split(noise + coupling, 50)) > 0 for coupling in (0, 3)]
    [False, True]
    """
    cells = np.arange(*_DOPPLER_CELLS)
    cells = cells[cells < len(groups) // 2]
    if len(groups) < _LEAST_GROUPS:
        return -math.inf
    means = np.stack([group.mean(axis=0, dtype=np.complex128) for group in groups])
    subcarriers = means.shape[1]
    profiles = scipy.fft.ifft(means * window_weights("hann", subcarriers), axis=1)
    doppler = np.abs(scipy.fft.fft(profiles * window_weights("hann", len(groups))[:, None], axis=0)) ** 2
    others = doppler[np.concatenate([cells, len(groups) - cells])].mean(axis=0)
    ratio = float((doppler[0] / np.maximum(others, np.finfo(np.float64).tiny)).max())
    # A Hann window correlates neighbouring cells: half of them are independent, each with two degrees of freedom. The
    # ratio of noise then has the F-distribution of 2 and d degrees of freedom, P(ratio > q) = (1 + 2q/d)^(−d/2).
    freedom = 2 * len(cells)
    threshold = freedom / 2 * ((_FALSE_ALARM / subcarriers) ** (-2 / freedom) - 1)
    return decibels(ratio / threshold)


@dataclass(frozen=True, eq=False)
class GroupMeans:
    """Mean transfer functions of groups of consecutive pulses.

    Attributes
    ----------
    values
        (group, subcarrier) complex128.
    time_s
        (group,) float64, mean times, seconds from the first pulse.
    """

    values: NDArray[np.complex128]
    time_s: Floats

    @classmethod
    def of(cls, read: Read, time_s: Floats) -> "GroupMeans":
        """Return the means of all pulses, whose times (pulse,) are ascending."""
        groups = np.array_split(np.arange(len(time_s)), min(len(time_s), _GROUPS))
        means = []
        for group in groups:
            total: Any = sum(read(some).sum(axis=0, dtype=np.complex128) for some in blocks_of(group))
            means.append(total / len(group))
        return cls(np.stack(means), np.array([time_s[group].mean() for group in groups]))

    @property
    def shortest_s(self) -> float:
        """Length of the shortest running median, s."""
        return _LEAST_GROUPS * float(np.ptp(self.time_s)) / len(self.time_s)

    def background(self, method: str | float) -> Background:
        """Estimate the background (eq. 3): median or mean of all groups, or a running median with a length in seconds.

        Examples
        --------
        >>> means = GroupMeans(np.array([[1.0], [2.0], [9.0]], np.complex128), np.arange(3.0))
        >>> [complex(means.background(method).values[0, 0]).real for method in ("median", "mean")]
        [2.0, 4.0]
        """
        if isinstance(method, str):
            return Background(_middle(self.values, method)[None], np.zeros(1))
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        knots = np.linspace(first, last, max(2, math.ceil(2 * (last - first) / method) + 1))
        # Near the ends the window is one-sided, so that its length is constant.
        starts = np.clip(knots - method / 2, first, max(first, last - method))
        windows = [(self.time_s >= start) & (self.time_s <= start + method) for start in starts]
        return Background(np.stack([_middle(self.values[window], "median") for window in windows]), knots)


def _middle(means: NDArray[np.complex128], method: str) -> Complexes:
    """Return the medians of real and imaginary parts over the groups, or the mean, (subcarrier,)."""
    if method == "mean":
        return np.asarray(means.mean(axis=0), np.complex64)
    return np.asarray(np.median(means.real, axis=0) + 1j * np.median(means.imag, axis=0), np.complex64)
