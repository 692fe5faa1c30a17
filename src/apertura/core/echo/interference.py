"""Radio interference: exclusion of subcarriers, of subcarriers of single pulses, and of pulses.

docs/theory/interference.md: subcarriers (eq. 1 to 3), subcarriers of single pulses (eq. 4 and 5), pulses (eq. 6 and 7).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels

LEAST_GAIN_DB = 0.1
"""Minimum gain in SNR by an exclusion, dB; a smaller gain does not justify its sidelobes or the loss of pulses."""

SERVICES: tuple[tuple[float, float, str], ...] = (
    (420e6, 450e6, "radar, amateur radio"),
    (694e6, 862e6, "mobile network or television"),
    (880e6, 960e6, "mobile network"),
    (960e6, 1164e6, "DME, TACAN, secondary radar"),
    (1164e6, 1215e6, "DME, GNSS L5/E5"),
    (1215e6, 1300e6, "GNSS L2/E6, air surveillance radar"),
    (1300e6, 1400e6, "air surveillance radar"),
    (1427e6, 1518e6, "mobile network"),
    (1525e6, 1559e6, "satellite downlink (Inmarsat)"),
    (1559e6, 1610e6, "GNSS L1/E1"),
    (1610e6, 1626.5e6, "Iridium, Globalstar"),
    (1710e6, 2170e6, "mobile network"),
    (2300e6, 2400e6, "mobile network"),
    (2400e6, 2500e6, "wireless LAN, UAV links"),
    (2500e6, 2690e6, "mobile network"),
    (2700e6, 2900e6, "airport surveillance radar"),
    (2900e6, 3300e6, "marine radar"),
    (3300e6, 4200e6, "mobile network"),
    (4200e6, 4400e6, "radar altimeter"),
    (5150e6, 5895e6, "wireless LAN, UAV links"),
    (8500e6, 10500e6, "marine and weather radar"),
)
"""Frequency bands (Hz) and their usual transmitters (ITU Radio Regulations, Article 5, abridged)."""


def service_at(frequency_hz: float) -> str:
    """Return the usual transmitters at a frequency.

    Examples
    --------
    >>> service_at(1.09e9)
    'DME, TACAN, secondary radar'
    """
    return next((name for low, high, name in SERVICES if low <= frequency_hz < high), "no usual service")


# ---- Subcarriers with interference in most pulses --------------------------------------------------------------------

EXCESS_DB = 6.0
"""Excess of the noise over that of the neighbours, dB, above which a subcarrier is excluded."""

_SAMPLES = 64  # number of subcarriers or ranges that represent a pulse
_NEIGHBOURS = 32  # inverse share of the band in half the window of the noise median
_FEWEST_NEIGHBOURS = 8
_LINES, _APART = 8, 8  # largest number of lines that are subtracted as tones, and their distance in subcarriers
_LISTED = 32  # largest number of frequencies in a report


@dataclass(frozen=True, eq=False)
class Interference:
    """Subcarriers with interference in most pulses.

    Attributes
    ----------
    frequency_hz
        (subcarrier,) float64, of the band.
    noise
        (subcarrier,) float64, noise power (eq. 1).
    excess
        (subcarrier,) float64, noise power relative to that of the neighbours and to the expected ratio.
    weight
        (subcarrier,) float64, of range compression; sums to 1.
    """

    frequency_hz: Floats
    noise: Floats
    excess: Floats
    weight: Floats

    @classmethod
    def measured(
        cls, groups: Sequence[Complexes], frequency_hz: Floats, weight: Floats, *, expected: Floats | float = 1.0
    ) -> "Interference":
        """Measure the noise of each subcarrier on groups of consecutive pulses.

        Parameters
        ----------
        groups
            (pulse, subcarrier) transfer functions of the pulses of `apertura.core.echo.captures.sampled_pulses`,
            joined by `apertura.core.echo.captures.runs`.
        frequency_hz, weight
            Of the subcarriers.
        expected
            (subcarrier,) excess without interference, as of `expected_excess`.

        Notes
        -----
        Source: docs/theory/interference.md, eq. 1 and 13.

        Examples
        --------
        >>> rng = np.random.default_rng(1)
        >>> received = (rng.normal(size=(400, 64, 2)) @ [1, 1j]).astype(np.complex64)
        >>> received[:, 20] += 20 * np.exp(2j * np.pi * rng.random(400))
        >>> frequency = 1.2e9 + 1e6 * np.arange(64)
        >>> found = Interference.measured(np.split(received, 50), frequency, np.full(64, 1 / 64))
        >>> np.flatnonzero(found.excluded).tolist(), found.is_removed
        ([20], True)
        >>> found.flags["interference"]
        '1 subcarrier at 1220.00 MHz (GNSS L2/E6, air surveillance radar): noise 22.6 dB above the neighbours; excluded'
        """
        differences = [np.abs(np.diff(group, axis=0)) ** 2 / 2 for group in groups]
        changes = np.concatenate(differences) if differences else np.zeros((0, len(frequency_hz)))
        if not len(changes):
            changes = np.zeros((1, len(frequency_hz)))
        noise = changes.mean(axis=0, dtype=np.float64)
        # The median ignores interference in single pulses, which `PulsedInterference` removes from these pulses only.
        excess = np.minimum(*(values / _usual(values) for values in (noise, np.median(changes, axis=0)))) / expected
        return cls(frequency_hz, noise, excess, weight)

    @property
    def excluded(self) -> NDArray[np.bool_]:
        """(subcarrier,) bool, True for subcarriers with interference."""
        return self.excess >= 10 ** (EXCESS_DB / 10)

    @property
    def lines(self) -> list[int]:
        """Numbers of the subcarriers with the strongest interference, each the maximum within `_APART` subcarriers."""
        highest = scipy.ndimage.maximum_filter1d(self.noise, 2 * _APART + 1)
        peaks = np.flatnonzero(self.excluded & (self.noise == highest))
        strongest = peaks[np.argsort(-self.noise[peaks], kind="stable")][:_LINES]
        return [int(number) for number in np.sort(strongest)]

    @property
    def lost_share(self) -> float:
        """Share of the weights of the excluded subcarriers."""
        return float(self.weight[self.excluded].sum())

    @property
    def gain_db(self) -> float:
        """SNR gained in the image by the exclusion, dB (eq. 3)."""
        kept = ~self.excluded
        noise = [(self.weight[some] ** 2 * self.noise[some]).sum() for some in (slice(None), kept)]
        if noise[1] <= 0:
            return 0.0
        return decibels(float(noise[0] / noise[1])) + 20 * math.log10(max(1 - self.lost_share, 1e-15))

    @property
    def sidelobe_db(self) -> float:
        """Upper bound of the range sidelobes that the exclusion causes, dB (eq. 3)."""
        return 20 * math.log10(max(self.lost_share, 1e-15) / max(1 - self.lost_share, 1e-15))

    @property
    def is_removed(self) -> bool:
        """True if subcarriers are excluded: the exclusion gains SNR."""
        return bool(self.excluded.any()) and self.gain_db >= LEAST_GAIN_DB

    @property
    def gain(self) -> NDArray[np.float32]:
        """(subcarrier,) float32, factors of eq. 2: 0 for excluded subcarriers; the rest preserves echo amplitudes."""
        return np.where(self.excluded, 0.0, 1 / (1 - self.lost_share)).astype(np.float32)

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        if not self.excluded.any():
            return {"subcarriers": 0}
        return {
            "subcarriers": int(self.excluded.sum()),
            "frequencies_hz": self.frequency_hz[self.excluded][:_LISTED].tolist(),
            "excess_db": round(self.strongest[1], 1),
            "excluded": self.is_removed,
            "gain_db": round(self.gain_db, 2),
            "sidelobe_db": round(self.sidelobe_db, 1),
        }

    @property
    def strongest(self) -> tuple[float, float]:
        """Frequency (Hz) and excess (dB) of the subcarrier with the largest excess."""
        return float(self.frequency_hz[self.excess.argmax()]), decibels(float(self.excess.max()))

    @property
    def description(self) -> str:
        """Number, frequency and excess of the subcarriers with interference; empty without any."""
        if not self.excluded.any():
            return ""
        frequency_hz, excess_db = self.strongest
        number = number_of(int(self.excluded.sum()), "subcarrier")
        at = f"{1e-6 * frequency_hz:.2f} MHz ({service_at(frequency_hz)})"
        where = f"{number} at {at}" if self.excluded.sum() == 1 else f"{number}, the strongest at {at}"
        return f"{where}: noise {excess_db:.1f} dB above the neighbours"

    @property
    def flags(self) -> Flags:
        """Flag `interference` if any subcarrier has interference."""
        done = "excluded" if self.is_removed else "not excluded, as that gains nothing"
        return Flags({"interference": f"{self.description}; {done}"} if self.description else {})


def _usual(values: Floats) -> Floats:
    """Return the median of (subcarrier,) powers over 1/16 of the band around each subcarrier; never zero."""
    size = 2 * max(_FEWEST_NEIGHBOURS, len(values) // _NEIGHBOURS) + 1
    usual = scipy.ndimage.median_filter(values, size=min(size, len(values)), mode="nearest")
    return np.asarray(np.where(usual > 0, usual, np.maximum(values, np.finfo(np.float64).tiny)))


def expected_excess(noise_gain: Floats, echo_gain: Floats, usual: Callable[[Floats], Floats] = _usual) -> Floats:
    """Return the largest excess that a mixture of noise and echoes has without interference, at least 1.

    Parameters
    ----------
    noise_gain, echo_gain
        (subcarrier,) float64, power of the noise and of the echoes after all filters, for equal powers before them.
    usual
        Level of the neighbours.

    Notes
    -----
    Source: docs/theory/interference.md, eq. 13.

    Examples
    --------
    >>> flat, pulse = np.ones(9), np.array([1.0, 1, 1, 1, 5, 1, 1, 1, 1])
    >>> expected_excess(pulse, pulse**2, np.median).tolist()  # matched filter
    [1.0, 1.0, 1.0, 1.0, 25.0, 1.0, 1.0, 1.0, 1.0]
    """
    return np.maximum(1.0, np.maximum(*(gain / usual(gain) for gain in (noise_gain, echo_gain))))


# ---- Sidelink --------------------------------------------------------------------------------------------------------


def limited(spectra: Complexes, weight: NDArray[np.float32] | None = None) -> tuple[Complexes, NDArray[np.bool_]]:
    """Limit subcarriers of a sidelink to 20 times the median power of their pulse; return also which are limited.

    A sidelink without interference is unchanged: its direct path has the same power in all subcarriers. A limited
    subcarrier has no effect on delay and phase of the direct path, and attenuates the echo by which it is divided.

    Parameters
    ----------
    spectra
        (pulse, subcarrier) complex64, code removed.
    weight
        (pulse or 1, subcarrier) float32, inverse noise power of the subcarriers, mean 1 over each pulse, or inverse of
        their expected excess: the limit of noisier subcarriers is higher by it. None: equal noise.

    Notes
    -----
    Source: docs/theory/interference.md, eq. 8.

    Examples
    --------
    >>> sidelink = np.array([[1, 1j, 10, 1, -1j]], np.complex64)
    >>> abs(limited(sidelink)[0]).round(2)
    array([[1.  , 1.  , 4.47, 1.  , 1.  ]], dtype=float32)
    """
    power = np.square(spectra.real) + np.square(spectra.imag)
    # The median of some subcarriers is sufficient, and faster.
    usual = np.median(power[:, :: -(-power.shape[1] // _SAMPLES)], axis=1, keepdims=True)
    limit = _HIT * usual if weight is None else _HIT * usual / np.minimum(weight, 1)
    over = (power > limit) & (usual > 0)
    if not over.any():
        return spectra, over
    scale = np.sqrt(limit / np.where(over, power, 1.0))
    return np.asarray(np.where(over, spectra * scale, spectra), np.complex64), over


class SidelinkInterference:
    """Limiter of a sidelink, block by block, with statistics of the limited subcarriers.

    Examples
    --------
    >>> interference = SidelinkInterference(1e9 + 1e6 * np.arange(5))
    >>> _ = interference.limit(np.array([[1, 1j, 10, 1, -1j]], np.complex64))
    >>> interference.flags["interference_sidelink"].partition(": ")[2]
    '20.0 dB above the median; limited to 13 dB'
    """

    def __init__(self, frequency_hz: Floats) -> None:
        self._frequency_hz = frequency_hz
        self._pulses = self._limited = 0
        self._excess = np.zeros(len(frequency_hz))
        self._count = np.zeros(len(frequency_hz), np.int64)

    def limit(self, spectra: Complexes, weight: NDArray[np.float32] | None = None) -> Complexes:
        """Limit the spectra of a block of pulses; parameters as of `limited`."""
        result, over = limited(spectra, weight)
        self._pulses += len(over)
        if over.any():
            self._limited += int(over.any(axis=1).sum())
            self._excess += np.where(over, np.abs(spectra / np.where(over, result, 1)) ** 2 * _HIT, 0).sum(axis=0)
            self._count += over.sum(axis=0)
        return result

    @property
    def flags(self) -> Flags:
        """Flag `interference_sidelink` if more than 0.1 % of the pulses are limited."""
        if self._limited <= 1e-3 * self._pulses:
            return Flags()
        strongest = int(self._excess.argmax())
        at_hz, excess = float(self._frequency_hz[strongest]), self._excess[strongest] / self._count[strongest]
        line = (
            f"{self._limited / self._pulses:.1%} of pulses, strongest at {1e-6 * at_hz:.2f} MHz ({service_at(at_hz)}): "
            f"{decibels(float(excess)):.1f} dB above the median; limited to {decibels(_HIT):.0f} dB"
        )
        return Flags({"interference_sidelink": line})


# ---- Subcarriers of single pulses ------------------------------------------------------------------------------------

_HIT = 20.0
"""Power relative to the median, above which a subcarrier of a pulse is excluded: for noise, with probability 2⁻²⁰."""

_SKIRT = 8.0
"""The same limit for the other subcarriers of that pulse, into which strong interference leaks: 0.4 % of noise."""

_MOST_OF_PULSE = 0.5
"""Largest share of a pulse's weights that is excluded; interference over more of the band affects the whole pulse."""


@dataclass(frozen=True, eq=False)
class PulsedInterference:
    """Interference in some subcarriers of some pulses, such as DME, radar pulses, bursts and swept tones.

    Attributes
    ----------
    level
        (subcarrier,) float32, median power over the pulses, without interference.
    weight
        (subcarrier,) float64, of range compression, zero for subcarriers excluded in all pulses; sums to 1.
    report
        Measured on some pulses, as JSON values: shares, strongest frequency, excess and gain.
    noise_peak
        Largest noise relative to that of a constant gain, one value or (subcarrier,) float, by which limits are raised
        if the noise gain changes from pulse to pulse.
    """

    level: NDArray[np.float32]
    weight: Floats
    report: dict[str, Any] = field(default_factory=dict)
    noise_peak: Floats | float = 1.0

    @classmethod
    def measured(
        cls, groups: Sequence[Complexes], frequency_hz: Floats, weight: Floats, *, noise_peak: Floats | float = 1.0
    ) -> "PulsedInterference | None":
        """Measure the interference on some pulses; None if its exclusion would gain less than `LEAST_GAIN_DB`.

        Parameters
        ----------
        groups
            (pulse, subcarrier) transfer functions, background removed.
        frequency_hz, weight
            Of the subcarriers.
        noise_peak
            As in the attributes.

        Notes
        -----
        Source: docs/theory/interference.md, eq. 4 and 5.

        Examples
        --------
        >>> rng = np.random.default_rng(1)
        >>> received = (rng.normal(size=(400, 64, 2)) @ [1, 1j]).astype(np.complex64)
        >>> received[::10, 20:22] += 40
        >>> frequency = 1.05e9 + 1e6 * np.arange(64)
        >>> pulsed = PulsedInterference.measured([received], frequency, np.full(64, 1 / 64))
        >>> pulsed.flags["interference_pulsed"]
        '10.0% of pulses, strongest at 1070.00 MHz (DME, TACAN, secondary radar): 28.4 dB above the level; excluded'
        >>> pulsed.removed(received[:1])[0, 20:22]
        array([0.+0.j, 0.+0.j], dtype=complex64)
        """
        transfer = np.concatenate(groups)
        level = np.median(np.abs(transfer) ** 2, axis=0).astype(np.float32)
        pulsed = cls(level, weight, noise_peak=noise_peak)
        hits = pulsed.hits(transfer)
        power = np.abs(transfer) ** 2
        # Power in the image is proportional to the sum of w²·|H|²; echoes add equally to both sums.
        weighted = weight**2 * power
        lost = (hits * weight).sum(axis=1)
        gain_db = decibels(float(weighted.sum() / (weighted * ~hits / (1 - lost[:, None]) ** 2).sum()))
        if not hits.any() or gain_db < LEAST_GAIN_DB:
            return None
        excess = np.divide(power, level, out=np.zeros_like(power), where=(level > 0) & hits) * np.log(2)
        of_subcarrier = excess.sum(axis=0)
        strongest = int(of_subcarrier.argmax())
        report = {
            "pulses_share": round(float(hits.any(axis=1).mean()), 4),
            "excluded_share": float(f"{lost.mean():.2e}"),
            "frequency_hz": float(frequency_hz[strongest]),
            "excess_db": round(decibels(float(excess[hits].mean())), 1),
            "gain_db": round(gain_db, 2),
        }
        return replace(pulsed, report=report)

    def hits(self, transfer: Complexes) -> NDArray[np.bool_]:
        """Return the subcarriers with interference in each pulse, (pulse, subcarrier) bool (eq. 4).

        Powers are compared with the median of the same pulse: a strong echo raises all subcarriers of a pulse.
        """
        if not (self.level > 0).any():
            return np.zeros(transfer.shape, np.bool_)
        inverse = np.divide(1.0, self.level, out=np.zeros_like(self.level), where=self.level > 0)
        relative = (np.square(transfer.real) + np.square(transfer.imag)) * inverse
        relative /= np.maximum(np.median(relative[:, self.level > 0], axis=1, keepdims=True), np.finfo(np.float32).tiny)
        relative /= np.float32(self.noise_peak)
        hits = relative > np.where(relative.max(axis=1, keepdims=True) > _HIT, _SKIRT, _HIT)
        hits &= (hits @ self.weight <= _MOST_OF_PULSE)[:, None]
        return np.asarray(hits)

    def removed(self, transfer: Complexes) -> Complexes:
        """Return transfer functions without the interference; echoes keep their amplitudes (eq. 5)."""
        hits = self.hits(transfer)
        if not hits.any():
            return transfer
        gain = (1 / (1 - hits @ self.weight)).astype(np.float32)
        return np.asarray(np.where(hits, 0, transfer * gain[:, None]), np.complex64)

    @cached_property
    def flags(self) -> Flags:
        """Flag `interference_pulsed`."""
        at_hz = self.report["frequency_hz"]
        line = (
            f"{self.report['pulses_share']:.1%} of pulses, strongest at {1e-6 * at_hz:.2f} MHz ({service_at(at_hz)}): "
            f"{self.report['excess_db']:.1f} dB above the level; excluded"
        )
        return Flags({"interference_pulsed": line})


def noise_peaks(gains: Floats) -> Floats:
    """Return the largest noise of each subcarrier relative to that of a constant gain, (subcarrier,) float64.

    Parameters
    ----------
    gains
        (pulse, subcarrier), gain of the noise power in some pulses.

    Notes
    -----
    Source: docs/theory/interference.md, eq. 14, solved by bisection in log t.

    Examples
    --------
    >>> noise_peaks(np.array([[1.0, 1.0], [1.0, 4.0], [1.0, 1.0]])).round(1)
    array([1. , 2.5])
    """
    gains = np.maximum(gains, np.finfo(np.float32).tiny)
    if (gains.max(axis=0) <= _CONSTANT * gains.min(axis=0)).all():
        return np.ones(gains.shape[1])

    def exceeded(logarithm: float) -> Floats:
        low, high = np.log(gains.min(axis=0)) - 3, np.log(gains.max(axis=0)) + 4
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            is_above = np.exp(-np.exp(middle) / gains).mean(axis=0) > np.exp(-logarithm)
            low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
        return np.asarray(np.exp(high))

    return exceeded(_HIT * np.log(2)) / (_HIT * exceeded(np.log(2)))


_CONSTANT = 1.01  # ratio of largest and smallest gain, below which limits are not raised
_BISECTIONS = 24  # to 1e-5 of the limit for gains within a factor of 1e16


# ---- Pulses with excess noise ----------------------------------------------------------------------------------------

_NOISY = 4.0
"""Noise of a pulse relative to that of its neighbours, above which the pulse is excluded."""

_NOISE_SHARE = 0.2
"""Difference of a pulse from its neighbours relative to its power, above which noise dominates it; 0.5 for noise alone.
A share that is four times the usual one is sufficient."""

_BLOCK = 128  # pulses over which the usual noise is a quantile
_MOST_PULSES = 0.3
"""Largest share of pulses that is excluded; more is not interference, or cannot be distinguished from echoes."""


class NoisyPulses:
    """Noise of each pulse, from transfer functions and range profiles, block by block.

    Notes
    -----
    Source: docs/theory/interference.md, eq. 6. Noise raises both the difference from the neighbouring pulses, which
    echoes do not, and the median over the ranges, which single targets do not.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> received = (rng.normal(size=(400, 64, 2)) @ [1, 1j]).astype(np.complex64)
    >>> received[7] *= 10
    >>> noisy = NoisyPulses()
    >>> noisy.add(received, np.fft.ifft(received, axis=1))
    >>> np.flatnonzero(noisy.excluded).tolist(), noisy.flags["pulses_noisy"]
    ([7], '1 of 400 pulses: noise up to 20.0 dB above the neighbouring pulses; excluded')
    """

    def __init__(self) -> None:
        self._noise: list[Floats] = [np.zeros(0)]
        self._floor: list[Floats] = [np.zeros(0)]
        self._power: list[Floats] = [np.zeros(0)]

    def add(self, transfer: Complexes, profiles: Complexes) -> None:
        """Add consecutive pulses: (pulse, subcarrier) transfer functions and (pulse, range) profiles."""
        some = transfer[:, :: -(-transfer.shape[1] // _SAMPLES)]
        change = np.full(len(some) + 1, np.inf)  # from the neighbours; infinite at the ends of the block
        change[1:-1] = (np.abs(np.diff(some, axis=0)) ** 2).mean(axis=1) / 2
        nearer = np.minimum(change[:-1], change[1:])
        self._noise.append(np.where(np.isfinite(nearer), nearer, 0.0))
        self._power.append((np.abs(some) ** 2).mean(axis=1, dtype=np.float64))
        samples = profiles[:, :: max(1, profiles.shape[1] // _SAMPLES)]
        self._floor.append(np.median(np.abs(samples) ** 2, axis=1).astype(np.float64))

    def skip(self, pulses: int) -> None:
        """Add pulses that do not contribute to the scene."""
        self._noise.append(np.zeros(pulses))
        self._floor.append(np.zeros(pulses))
        self._power.append(np.zeros(pulses))

    @property
    def power(self) -> Floats:
        """(pulse,) float64, mean power of the transfer functions; 0 for pulses that do not contribute to the scene."""
        return np.concatenate(self._power)

    @cached_property
    def _relative(self) -> Floats:
        """(pulse,) float64, noise relative to that of the neighbouring pulses, by differences (eq. 6)."""
        return np.maximum(2 * _over_neighbours(np.concatenate(self._noise), 0.25) - 1, 0.0)

    @cached_property
    def excess(self) -> Floats:
        """(pulse,) float64, noise relative to the usual noise: the lower of both tests; 0 where echoes dominate."""
        excess = np.minimum(self._relative, _over_neighbours(np.concatenate(self._floor), 0.5))
        power = self.power
        share = np.divide(np.concatenate(self._noise), power, out=np.zeros_like(power), where=power > 0)
        usual = float(np.median(share[power > 0])) if (power > 0).any() else 0.0
        return np.where(share > min(_NOISE_SHARE, _NOISY * usual), excess, 0.0)

    @cached_property
    def _noisy(self) -> NDArray[np.bool_]:
        """(pulse,) bool, True for pulses whose noise exceeds the limit in both tests."""
        return np.asarray(self.excess > _NOISY)

    @cached_property
    def excluded(self) -> NDArray[np.bool_]:
        """(pulse,) bool, True for pulses that are excluded: this gains SNR (eq. 7)."""
        return self._noisy if self.gain_db >= LEAST_GAIN_DB else np.zeros_like(self._noisy)

    @property
    def gain_db(self) -> float:
        """SNR gained in the image by the exclusion, dB (eq. 7); 0 if more than 30 % of the pulses would be excluded."""
        noise, used = self._relative, self._relative > 0
        kept = used & ~self._noisy
        if not kept.any() or self._noisy.sum() > _MOST_PULSES * used.sum():
            return 0.0
        return decibels(float(noise[used].sum() / noise[kept].sum() * (kept.sum() / used.sum()) ** 2))

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values; {} if no pulse has interference."""
        if not self.flags:
            return {}
        return {
            "pulses": int(self._noisy.sum()),
            "of": len(self._noisy),
            "excess_db": round(decibels(float(self.excess.max())), 1),
            "excluded": bool(self.excluded.any()),
            "gain_db": round(self.gain_db, 2),
        }

    @property
    def flags(self) -> Flags:
        """Flag `pulses_noisy` if pulses have interference that is excluded, or too many to be excluded."""
        number, pulses = int(self._noisy.sum()), len(self._noisy)
        too_many = number > _MOST_PULSES * pulses
        if not self.excluded.any() and not too_many:
            return Flags()
        done = "not excluded, because there are too many" if too_many else "excluded"
        excess_db = decibels(float(self.excess.max()))
        line = (
            f"{number} of {number_of(pulses, 'pulse')}: noise up to {excess_db:.1f} dB above the "
            f"neighbouring pulses; {done}"
        )
        return Flags({"pulses_noisy": line})


def _over_neighbours(values: Floats, quantile: float) -> Floats:
    """Return (pulse,) values relative to a quantile of some hundred neighbours, or of all pulses if that is higher."""
    blocks = np.array_split(values, max(1, round(len(values) / _BLOCK)))
    each_block = np.array([np.quantile(block[block > 0], quantile) if (block > 0).any() else 0.0 for block in blocks])
    usual = scipy.ndimage.median_filter(each_block, size=min(3, len(blocks)), mode="nearest")
    # At rest, echoes are constant and removed with the background: the usual value is at least that of all pulses.
    usual = np.maximum(usual, np.quantile(values[values > 0], quantile) if (values > 0).any() else 0.0)
    each = np.repeat(usual, [len(block) for block in blocks])
    return np.asarray(np.divide(values, each, out=np.zeros_like(values), where=each > 0))
