"""Filter that removes code symbols whose modulus is not constant: reciprocal, matched or Wiener.

A received symbol Y = cH + W is multiplied by the reciprocal 1/c and by a real weight w(|c|²) of mean 1. The weight
trades amplified noise of weak symbols against an echo amplitude that varies with the data
(docs/theory/changing_codes.md, eqs. 4 to 8).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.sidelink_state import NULL_DB

FilterName = Literal["reciprocal", "matched", "wiener"]

Powers = NDArray[np.floating[Any]]
"""|c|² of symbols, (symbol,) or (row, subcarrier)."""

CONSTANT_DB = 0.05
"""Noise gain of the reciprocal filter, dB, below which the modulus of symbols counts as constant."""

INVISIBLE_DB = -50.0
"""Tolerated level of data sidelobes without a requested accuracy, dB: 10 dB below the level of visible sidelobes."""

MOST_EXCESS_DB = 1.0
"""SNR loss of a filter in excess of the smallest one, dB, above which a flag is raised."""


@dataclass(frozen=True)
class SymbolFilter:
    """Weight w(|c|²) = scale/(offset + slope/|c|²) by which symbols divided by the code are multiplied.

    Attributes
    ----------
    name
        reciprocal (w = 1), matched (w ∝ |c|²) or wiener (w ∝ |c|²/(|c|² + P/ρ)).
    scale, offset, slope
        Parameters of the weight, whose mean over the symbols is 1.
    """

    name: FilterName = "reciprocal"
    scale: float = 1.0
    offset: float = 1.0
    slope: float = 0.0

    @classmethod
    def of(cls, name: FilterName, power: Powers, snr: float, window: Floats | None = None) -> "SymbolFilter":
        """Return a filter for the powers |c|² of symbols and an SNR per subcarrier ρ (eqs. 4 to 6).

        Parameters
        ----------
        name, snr
            Filter, and SNR per subcarrier ρ.
        power
            (symbol,) or (row, subcarrier), |c|².
        window
            (subcarrier,) float64, window u of the range compression; None: equal weights.

        Examples
        --------
        >>> SymbolFilter.of("matched", np.array([0.2, 1.0, 1.0, 1.8]), snr=0.1)
        SymbolFilter(name='matched', scale=1.0, offset=0.0, slope=1.0)
        """
        mean = float(power.mean())
        if name == "reciprocal" or (name == "wiener" and not np.isfinite(snr)):
            return cls(name)
        offset, slope = (0.0, 1.0) if name == "matched" else (1.0, mean / max(snr, 1e-12))
        return cls(name, 1 / _mean(1 / (offset + slope / power), window), offset, slope)

    def applied(self, symbols: Complexes, inverse: Complexes) -> Complexes:
        """Return symbols, (pulse, subcarrier) divided by the code, times the weight; `inverse`: 1/c of the pulses."""
        if self.slope == 0:
            return symbols
        gain = np.square(inverse.real) + np.square(inverse.imag)
        return symbols * (np.float32(self.scale) / (np.float32(self.offset) + np.float32(self.slope) * gain))

    def weight(self, power: Powers) -> Powers:
        """Return w(|c|²) of symbol powers of any shape."""
        return np.asarray(self.scale / (self.offset + self.slope / power))

    def noise_gain(self, power: Powers, window: Floats | None = None) -> float:
        """Return the noise relative to a code of constant modulus and equal mean power (eq. 4); arguments as `of`."""
        return float(power.mean()) * _mean(self.weight(power) ** 2 / power, window, order=2)

    def noise_peak(self, power: Powers) -> float:
        """Return the largest noise of a symbol relative to a constant modulus, P·max w²/|c|²."""
        return float(power.mean() * (self.weight(power) ** 2 / power).max())

    def self_noise(self, power: Powers, window: Floats | None = None) -> float:
        """Return the variance κ of the echo amplitude over the data (eq. 5); arguments as `of`."""
        return _mean((self.weight(power) - 1) ** 2, window, order=2)

    def loss(self, power: Powers, snr: float, window: Floats | None = None, divided_snr: float = float("inf")) -> float:
        """Return the noise floor with data relative to that of a constant modulus, both relative to the peak.

        Parameters
        ----------
        power, snr, window
            As of `of`.
        divided_snr
            SNR per subcarrier ρ_s of a sidelink by which the echoes are divided; infinite: they are not divided.

        Notes
        -----
        Source: docs/theory/changing_codes.md, eq. 7, and eqs. 10 and 11 of echoes divided by a sidelink.
        """
        mean = float(power.mean())

        def floor(power: Powers, weight: Powers) -> float:
            first, second = _moments_of_inverse(divided_snr * power / mean)
            peak = _mean(weight * first, window)
            data = _mean(weight**2 * second - 2 * peak * weight * first, window, order=2) + peak**2
            return (mean * _mean(weight**2 * second / power, window, order=2) + snr * data) / peak**2

        return floor(power, self.weight(power)) / floor(np.full_like(power, mean), np.ones_like(power))


def _moments_of_inverse(snr: Powers) -> tuple[Powers, Powers]:
    """Return the mean of A/S and of |A/S|² for subcarriers of an SNR, with |S| limited to A/10 (eq. 11)."""
    if np.isinf(snr).all():
        return np.ones_like(snr), np.ones_like(snr)
    x = np.minimum(snr, 50.0)
    below = scipy.special.expi(x) - np.log(x) - np.euler_gamma + scipy.special.exp1(x * 10 ** (NULL_DB / 10)) + 0.5
    return -np.expm1(-snr), np.where(snr < 50, x * np.exp(-x) * below, 1 + 1 / snr + 2 / snr**2)


def _mean(values: Powers, window: Floats | None, order: int = 1) -> float:
    """Return the mean of values, (symbol,) or (row, subcarrier), over subcarriers with the weights window^order."""
    weights = None if window is None else window**order
    return float(np.average(np.atleast_2d(values).mean(axis=0), weights=weights))


FILTERS: tuple[FilterName, ...] = ("reciprocal", "matched", "wiener")


def echo_snr(transfer: Complexes, power: Powers) -> float:
    """Return the SNR per subcarrier ρ of echoes with symbols of constant modulus and equal mean power.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, divided by the code.
    power
        (row, subcarrier), |c|² of sampled frames.

    Notes
    -----
    Source: docs/theory/changing_codes.md, eq. 8: the noise is the median over the delay cells of the mean power,
    because echoes occupy less than half of the cells.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = rng.normal(size=(2, 200, 256)) @ np.eye(256) / np.sqrt(2)
    >>> round(echo_snr((0.5 + noise[0] + 1j * noise[1]).astype(np.complex64), np.ones((1, 256))), 1)  # 0.25 in truth
    0.2
    """
    count = transfer.shape[1]
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    cells = (np.abs(scipy.fft.ifft(transfer * window.astype(np.float32), axis=1, norm="ortho")) ** 2).mean(
        axis=0, dtype=np.float64
    )
    noise, total = float(np.median(cells)), float(cells.mean())
    return max(total - noise, 0.0) / max(noise, np.finfo(float).tiny) * SymbolFilter().noise_gain(power, window)


@dataclass(frozen=True)
class FilterChoice:
    """Filter of the symbols, reason for its choice, and its predicted effect.

    Attributes
    ----------
    filter
        The filter.
    report
        Name, reason, parameters, SNR per subcarrier, noise gain, SNR loss and data sidelobes.
    flags
        Flag → measured values, one line.
    """

    filter: SymbolFilter
    report: dict[str, Any]
    flags: Flags


def choose_filter(
    power: Powers,
    *,
    requested: str,
    snr: float,
    frames: int,
    tolerated_db: float,
    window: Floats,
    divided_snr: float = float("inf"),
) -> FilterChoice:
    """Choose the filter of the symbols by its predicted noise floor and data sidelobes.

    Parameters
    ----------
    power
        (row, subcarrier), |c|² of sampled frames.
    requested
        A filter, or 'auto'.
    snr
        SNR per subcarrier ρ of the echoes; infinite if unknown.
    frames
        Number of different frames in the flight, over whose data sidelobes average.
    tolerated_db
        Tolerated level of data sidelobes relative to the peak, dB.
    window
        (subcarrier,) float64, window of the range compression.
    divided_snr
        As of `SymbolFilter.loss`.

    Notes
    -----
    Source: docs/theory/changing_codes.md, eqs. 4 to 7, 10 and 11.

    Examples
    --------
    >>> qam, hann = np.tile([0.2, 1.0, 1.0, 1.8], (1, 64)), np.hanning(256)
    >>> for snr, frames in ((0.01, 1000), (100.0, 1000), (0.01, 1)):
    ...     choice = choose_filter(qam, requested="auto", snr=snr, frames=frames, tolerated_db=-45.0, window=hann)
    ...     print(choice.filter.name, choice.report["loss_db"])
    wiener 0.01
    wiener 2.69
    reciprocal 2.76
    """
    power = np.asarray(power, np.float64)
    noise = 1 / max(snr, 1e-12) + 1 / divided_snr  # the filter reduces noise of both channels
    filters = {name: SymbolFilter.of(name, power, 1 / noise if noise else np.inf, window) for name in FILTERS}
    sidelobes = {name: data_sidelobes(item.self_noise(power, window), window, frames) for name, item in filters.items()}
    known = np.isfinite(snr)
    losses = {name: item.loss(power, snr if known else 0.0, window, divided_snr) for name, item in filters.items()}
    summary = f"SNR {decibels(max(snr, 1e-9)):.1f} dB per subcarrier"
    if requested != "auto":
        name: FilterName = next(item for item in FILTERS if item == requested)
        reason = "requested"
    elif not known:
        name, reason = "reciprocal", "largest loss; decided by the SNR of the echoes when they are formed"
    else:
        tolerated = [item for item in FILTERS if sidelobes[item] <= 10 ** (tolerated_db / 10)]
        name = min(tolerated, key=lambda item: losses[item])
        reason = f"{summary}, data sidelobes below {tolerated_db:g} dB: smallest SNR loss"
    chosen = filters[name]
    loss_db = decibels(losses[name])
    report = {
        "filter": name,
        "reason": reason,
        "scale": chosen.scale,
        "offset": chosen.offset,
        "slope": chosen.slope,
        "snr_db": round(decibels(snr), 2) if known and snr > 0 else None,
        "divided_snr_db": round(decibels(divided_snr), 2) if np.isfinite(divided_snr) else None,
        "noise_gain_db": round(decibels(chosen.noise_gain(power, window)), 2),
        **({"noise_peak": chosen.noise_peak(power)} if frames > 1 else {}),
        "self_noise": round(chosen.self_noise(power, window), 4),
        "loss_db": round(loss_db, 2),
        "sidelobes_db": round(decibels(sidelobes[name]), 1) if sidelobes[name] > 0 else None,
    }
    flags, best_db = {}, decibels(min(losses.values()))
    if loss_db > best_db + MOST_EXCESS_DB and requested != "auto":
        flags["symbols_noise"] = f"SNR loss of the {name} filter {loss_db:.1f} dB, smallest loss {best_db:.1f} dB"
    if sidelobes[name] > 10 ** (tolerated_db / 10):
        counted = number_of(frames, "different frame")
        line = f"data sidelobes of {decibels(sidelobes[name]):.1f} dB after the {name} filter, in {counted}"
        flags["symbols_sidelobes"] = f"{line}; {tolerated_db:g} dB tolerated"
    return FilterChoice(chosen, report, Flags(flags))


def tolerated_sidelobes_db(accuracy_db: float | Literal["auto"]) -> float:
    """Return the tolerated level of data sidelobes for `processing.accuracy_db`, dB relative to the peak.

    Examples
    --------
    >>> tolerated_sidelobes_db("auto"), tolerated_sidelobes_db(-45.0)
    (-50.0, -45.0)
    """
    return INVISIBLE_DB if accuracy_db == "auto" else accuracy_db


def data_sidelobes(self_noise: float, window: Floats, frames: int) -> float:
    """Return the expected level of data sidelobes relative to the peak of a point, κ·Σu²/(Σu)²/F (eq. 6).

    Examples
    --------
    >>> round(data_sidelobes(0.32, np.ones(256), 1000), 9)
    1.25e-06
    """
    return self_noise * float((window**2).sum() / window.sum() ** 2) / max(frames, 1)


def filter_of(report: Mapping[str, Any]) -> SymbolFilter | None:
    """Return the filter of a `FilterChoice.report`; None if the report names none."""
    if "filter" not in report:
        return None
    return SymbolFilter(report["filter"], report["scale"], report["offset"], report["slope"])
