"""Estimation of unknown data symbols from the sidelink: channel of the direct path, decisions, and their quality.

A receiver records the direct path of each pulse. Its symbols follow from the constellation, and are then the reference
of echo and sidelink, as symbols known beforehand would be.

Source: docs/theory/data_symbols.md, "Unknown symbols".
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import Constellation, Labels
from apertura.core.echo.line_of_sight import LineOfSight, fit_block, phasor
from apertura.core.echo.sidelink_state import GATE_CELLS

_UPDATES = 3  # fits of delay, phase and amplitude to the decisions
_REFLECTIONS = 3  # largest number of reflections of a pulse that its initial channel contains
_SIGNIFICANT = 3.3  # amplitude of a reflection relative to its standard deviation: 2 % of pulses without one
_CHANNELS = 8  # largest number of estimates of the channel of a pulse
_LEAST_GAIN = 0.99  # error vector magnitude relative to the previous one, above which an estimate is not used
# Limits of a pulse with right symbols: power of its channel before the direct path relative to it, and excess of its
# noise over the median of its group, standard deviations
_MOST_EARLY, _NOISE_SIGMAS = 0.03, 5.0
_ROUNDS = 4  # fits of the mean channel to the decisions


@dataclass(frozen=True, eq=False)
class Pilots:
    """Known symbols at equally spaced subcarriers.

    Attributes
    ----------
    subcarriers
        N.
    first, step
        Index of the first pilot, and distance between pilots, subcarriers.
    symbols
        (pilot,) complex64.
    """

    subcarriers: int
    first: int
    step: int
    symbols: Complexes

    @classmethod
    def of(cls, table: Complexes, where: object) -> "Pilots":
        """Return the pilots of a table, (subcarrier,) complex64, which is 0 at data symbols.

        Raises
        ------
        CampaignError
            If there are fewer than 16 pilots, or their distances differ.

        Examples
        --------
        >>> table = np.zeros(64, np.complex64)
        >>> table[2::4] = 1
        >>> pilots = Pilots.of(table, "pilots.npy")
        >>> pilots.first, pilots.step, pilots.symbols.size
        (2, 4, 16)
        """
        indices = np.flatnonzero(table)
        steps = np.unique(np.diff(indices))
        if indices.size < 16 or steps.size != 1 or not np.isfinite(table).all():
            raise CampaignError(
                f"{indices.size} pilots at distances of {', '.join(map(str, steps[:5])) or 'no'} subcarriers",
                where=where,
                expected="at least 16 finite pilot symbols at equal distances, and 0 at all other subcarriers",
                remedy="Write the transmitted pilots, or remove the key to estimate the channel without pilots.",
            )
        return cls(table.size, int(indices[0]), int(steps[0]), table[indices].astype(np.complex64))

    @property
    def places(self) -> slice:
        """Subcarriers of the pilots."""
        return slice(self.first, self.first + self.step * self.symbols.size, self.step)


@dataclass(frozen=True, eq=False)
class Decisions:
    """Symbols decided in a block of pulses.

    Attributes
    ----------
    symbols
        (pulse, subcarrier) complex64, decided symbols; pilots at their subcarriers.
    labels
        (pulse, subcarrier) uint8, labels of the decided symbols; 0 at pilots.
    path
        Direct path of each pulse; its `locked` is False if no direct path is detected.
    evm
        (pulse,) float64, error vector magnitude relative to the decisions, of data symbols of unit mean power.
    kurtosis
        (pulse,) float64, E|e|⁴/(E|e|²)² of the errors e of the received data symbols; 2 for noise without wrong
        decisions, and less if the errors have similar magnitudes.
    snr
        (pulse,) float64, SNR per subcarrier that corresponds to the error vector magnitude.
    sure
        (pulse,) bool, True if the direct path is detected, the error vector magnitude is below its limit, and noise
        and channel are those of right symbols.
    """

    symbols: Complexes
    labels: Labels
    path: LineOfSight
    evm: Floats
    kurtosis: Floats
    snr: Floats
    sure: Bools


class _Pulses(NamedTuple):
    """Solution of a block of pulses."""

    path: LineOfSight
    symbols: Complexes
    labels: Labels
    error: Floats
    kurtosis: Floats
    channel: Complexes

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Arrays with one row per pulse."""
        return (*(getattr(self.path, field.name) for field in fields(LineOfSight)), *self[1:])


@dataclass(frozen=True, eq=False)
class SymbolDecider:
    """Decider of the symbols of a sidelink.

    Attributes
    ----------
    constellation
        Constellation of the data symbols.
    shapes
        (group, subcarrier) complex64, mean channel of groups of neighbouring pulses relative to the direct path:
        transmit ripple and reflections; mean power 1.
    middles
        (group,) float64, number of the middle pulse of each group, ascending.
    pilots
        Known symbols; None: delay and phase are estimated from the constellation.
    noise
        (group,) float64, median noise per subcarrier of the pulses of each group; None: not measured.
    snr
        Median SNR per subcarrier of the pulses with a direct path in the groups; 0 if it was not measured.

    Examples
    --------
    >>> from apertura.core.echo.constellation import constellation
    >>> random, qam = np.random.default_rng(1), constellation("16qam")
    >>> sent = random.integers(0, 16, (8, 512))
    >>> delayed = 3 * qam.points[sent] * np.exp(-2j * np.pi * np.arange(512) * 4.3 / 512)
    >>> received = (delayed + random.normal(scale=0.1, size=(8, 512, 2)) @ [1, 1j]).astype(np.complex64)
    >>> decider = SymbolDecider.measured([(np.arange(8), received)], qam)
    >>> decisions = decider.resolved(decider.decide(received, np.arange(8)), sent[:, :16])
    >>> bool((decisions.labels == sent).all()), (10 * np.log10(decisions.snr.mean())).round().item()
    (True, 27.0)
    """

    constellation: Constellation
    shapes: Complexes
    middles: Floats
    pilots: Pilots | None = None
    noise: Floats | None = None
    snr: float = 0.0

    @classmethod
    def measured(
        cls,
        groups: Iterable[tuple[NDArray[np.int64], Complexes]],
        constellation: Constellation,
        pilots: Pilots | None = None,
    ) -> "SymbolDecider":
        """Return a decider with the mean channels of groups of neighbouring pulses.

        Parameters
        ----------
        groups
            Pulse numbers, ascending, and their received symbols, (pulse, subcarrier) complex64, of each group.
        constellation, pilots
            Constellation of the data symbols, and known symbols.

        Raises
        ------
        CampaignError
            If the direct path is not detected in any group.
        """
        shapes, middles, noise, snrs, count = [], [], [], [], 0
        for numbers, received in groups:
            count += len(numbers)
            decider = cls(constellation, np.ones((1, received.shape[1]), np.complex64), np.zeros(1), pilots)
            shaped = decider._shaped_by(received)
            if shaped is not None:
                shapes.append(shaped.shapes[0])
                middles.append(float(numbers.mean()))
                decisions = shaped.decide(received, numbers)
                locked = decisions.path.locked
                noise.append(float(np.median(decisions.path.noise_power[locked])) if locked.any() else np.inf)
                snrs.append(decisions.snr[locked])
        if not shapes:
            raise CampaignError(
                f"no direct path of {constellation.name} symbols in {count} pulses",
                where="sidelink",
                expected=f"data symbols of constellation {constellation.name} above the noise",
                remedy="Check constellation and pilots of waveform.codes, waveform.iq and nodes.<n>.iq, and antenna, "
                "gain and recorded channel of the sidelink.",
            )
        snr = np.concatenate(snrs)
        median_snr = float(np.median(snr)) if snr.size else 0.0
        return cls(constellation, np.array(shapes), np.array(middles), pilots, np.array(noise), median_snr)

    def _shaped_by(self, received: Complexes) -> "SymbolDecider | None":
        """Return a decider with the mean channel of pulses; None if the direct path is not detected in any pulse."""
        decider = self
        if self.pilots is None:
            decider = decider._with_shape(_minimum_phase(received))
        path = decider._detected(received / decider.shapes)
        received, path = received[path.locked], path.select(path.locked)
        if not len(received):
            return None
        direct = phasor(path, received.shape[1]) * path.amplitude[:, None].astype(np.float32)
        decider = decider._with_shape(decider._initial_shape(received / direct))
        for _ in range(_ROUNDS):  # the mean of the channel after removal of the decisions (eq. 11)
            flat = received / decider.shapes
            path, symbols, _, error, _ = decider._fitted(flat, decider._detected(flat), decider.shapes)
            weight = (path.amplitude / np.square(error))[:, None]
            decider = decider._with_shape((weight * received / (symbols * phasor(path, received.shape[1]))).sum(0))
        return decider

    def _with_shape(self, channel: NDArray[Any]) -> "SymbolDecider":
        """Return a decider with the smooth part of one channel, (subcarrier,), scaled to the mean power 1."""
        smooth = _smooth(channel[None])
        return replace(self, shapes=smooth / np.sqrt(np.mean(np.square(np.abs(smooth)))))

    def decide(self, sidelink: Complexes, numbers: NDArray[np.int64]) -> Decisions:
        """Decide the symbols of a block of pulses, each on its own.

        Parameters
        ----------
        sidelink
            (pulse, subcarrier) complex64, received symbols of the direct path.
        numbers
            (pulse,) pulse numbers, as those of the groups.
        """
        nearest = np.searchsorted((self.middles[1:] + self.middles[:-1]) / 2, numbers)
        shape = self.shapes[nearest]
        pulse = self._solved(sidelink, shape)
        rows, reflected = _reflections(sidelink / shape)  # a second start, with reflections that the shape lacks
        if rows.size:
            second = self._solved(sidelink[rows], shape[rows] * reflected)
            better = second.error < _LEAST_GAIN * pulse.error[rows]
            for of_all, of_rows in zip(pulse.arrays, second.arrays, strict=True):
                of_all[rows[better]] = of_rows[better]
        path, error = pulse.path, pulse.error
        path = replace(path, noise_power=np.square(path.amplitude * error) * np.square(np.abs(pulse.channel)).mean(1))
        doubt = np.zeros(len(numbers))  # eq. 15
        if self.noise is not None:
            excess = path.noise_power / np.maximum(self.noise[nearest], 1e-30) - 1
            doubt += np.maximum(excess, 0) * np.sqrt(sidelink.shape[1]) / _NOISE_SIGMAS
        if self.pilots is None:
            doubt += _early(pulse.channel / shape) / _MOST_EARLY
        limit = self.constellation.decided(self.constellation.least_snr).evm
        sure = path.locked & (error <= limit) & (doubt <= 1)
        snr = self.constellation.snr_of_evm(error)
        return Decisions(pulse.symbols, pulse.labels, path, error, pulse.kurtosis, snr, sure)

    def _solved(self, sidelink: Complexes, initial: Complexes) -> "_Pulses":
        """Return the symbols of pulses from an initial channel, (pulse, subcarrier), and the channel of each pulse.

        The channel is estimated within ±16 cells of the direct path (eq. 12), and absorbs a part of the noise.
        """
        subcarriers, flat = sidelink.shape[1], sidelink / initial
        path, symbols, labels, error, kurtosis = self._fitted(flat, self._detected(flat), initial)
        absorbed, rows = _basis(subcarriers).shape[1] / subcarriers, np.flatnonzero(path.locked)
        direct = phasor(path, subcarriers) * np.maximum(path.amplitude, 1e-30)[:, None].astype(np.float32)
        pulses = _Pulses(path, symbols, labels, error, kurtosis, initial.copy())
        for _ in range(_CHANNELS):
            if not rows.size:
                break
            relative = _smooth(flat[rows] / (direct[rows] * symbols[rows]))
            channel = initial[rows] * relative
            own = self._fitted(flat[rows] / relative, path.select(rows), channel, updates=0)
            own_error = own[3] / np.sqrt(1 - absorbed)
            better = own_error < _LEAST_GAIN * error[rows]
            rows = rows[better]
            for of_all, of_rows in zip(pulses.arrays[-5:], (*own[1:3], own_error, own[4], channel), strict=True):
                of_all[rows] = of_rows[better]
        return pulses

    def resolved(self, decisions: Decisions, known: Labels) -> Decisions:
        """Return decisions without the ambiguity of a blind estimate, from known labels of the first subcarriers.

        Parameters
        ----------
        decisions
            Decisions of this decider.
        known
            (symbol,) or (pulse, symbol), known labels of the first data symbols, at least two.

        Notes
        -----
        Source: docs/theory/data_symbols.md, eq. 13: of the 16 sequences j^(k + ln), that with most known labels.
        """
        data = self.data_places
        known = np.broadcast_to(known, (len(decisions.labels), known.shape[-1]))
        first = data[: known.shape[1]]
        numbers = np.arange(decisions.labels.shape[1])
        turns = [(k, step) for k in range(4) for step in range(4)]
        rotations = np.array([1j ** ((k + step * numbers) % 4) for k, step in turns], np.complex64)
        agreement = np.array([
            (self.constellation.decide(decisions.symbols[:, first] * rotation[first]) == known).sum(1)
            for rotation in rotations
        ])  # fmt: skip
        best = agreement.argmax(0)
        symbols = decisions.symbols * rotations[best]
        labels = self.constellation.decide(symbols)
        centre, subcarriers = (numbers.size - 1) / 2, numbers.size
        chosen = np.array(turns)[best]
        # the direct path turns by the inverse of the symbols: j^-(k + ln) is a delay of lN/4 cells
        delay = decisions.path.delay_cells + chosen[:, 1] * subcarriers / 4
        phase = decisions.path.phase_rad - np.pi / 2 * (chosen[:, 0] + chosen[:, 1] * centre)
        delay = (delay + subcarriers / 2) % subcarriers - subcarriers / 2
        path = replace(decisions.path, delay_cells=delay, phase_rad=phase)
        return replace(decisions, symbols=symbols, labels=labels, path=path)

    @property
    def data_places(self) -> NDArray[np.intp]:
        """Subcarriers of the data symbols."""
        places = np.arange(self.shapes.shape[1])
        return places if self.pilots is None else np.setdiff1d(places, places[self.pilots.places])

    def _detected(self, flat: Complexes) -> LineOfSight:
        """Return the direct path of each pulse from its pilots, or from the fourth power of its symbols (eqs. 8, 9)."""
        pilots, subcarriers = self.pilots, flat.shape[1]
        if pilots is not None:
            comb = flat[:, pilots.places] / pilots.symbols
            path = fit_block(np.ascontiguousarray(comb))[0]
            # the middle of the comb lies beside the middle of the band
            offset = pilots.first + pilots.step * (pilots.symbols.size - 1) / 2 - (subcarriers - 1) / 2
            delay = path.delay_cells * subcarriers / (pilots.step * pilots.symbols.size)
            phase = path.phase_rad + 2 * np.pi * offset * delay / subcarriers
            return replace(path, delay_cells=delay, phase_rad=phase)
        rms = np.sqrt(np.mean(np.square(np.abs(flat)), axis=1, keepdims=True))
        scale = np.where(rms > 0, rms, 1).astype(np.float32)
        path = fit_block(np.square(np.square(flat / scale)))[0]
        amplitude = scale[:, 0] * (path.amplitude / abs(self._fourth_moment)) ** 0.25
        # E[c⁴] is negative
        return replace(
            path, delay_cells=path.delay_cells / 4, phase_rad=(path.phase_rad - np.pi) / 4, amplitude=amplitude
        )

    @property
    def _fourth_moment(self) -> float:
        """E[c⁴], negative for all square constellations."""
        return float(np.mean(self.constellation.points.astype(complex) ** 4).real)

    def _initial_shape(self, aligned: Complexes) -> NDArray[Any]:
        """Return the channel relative to the direct path from the pilots, or from the mean fourth power (eq. 10)."""
        pilots, numbers = self.pilots, np.arange(aligned.shape[1])
        if pilots is not None:
            comb = (aligned[:, pilots.places] / pilots.symbols).mean(0)
            known = numbers[pilots.places]
            return np.asarray(np.interp(numbers, known, comb.real) + 1j * np.interp(numbers, known, comb.imag))
        # the fourth root is unambiguous because the phase of the minimum-phase channel is accurate to less than π/4
        residual = ((aligned / self.shapes).astype(complex) ** 4).mean(0) / self._fourth_moment
        return np.asarray(self.shapes[0] * residual**0.25)

    def _fitted(
        self, flat: Complexes, path: LineOfSight, shape: Complexes, *, updates: int = _UPDATES
    ) -> tuple[LineOfSight, Complexes, Labels, Floats, Floats]:
        """Return direct path, symbols, labels, EVM and kurtosis after fits to the decisions (eqs. 11 and 20)."""
        subcarriers = flat.shape[1]
        number = (np.arange(subcarriers) - (subcarriers - 1) / 2).astype(np.float32)
        power = np.square(shape.real) + np.square(shape.imag)
        for update in range(updates + 1):
            amplitude = np.maximum(path.amplitude, 1e-30)[:, None].astype(np.float32)
            received = flat * (phasor(path, subcarriers).conj() / amplitude)
            labels = self.constellation.decide(received)
            symbols = self.constellation.points[labels]
            if self.pilots is not None:
                symbols[:, self.pilots.places] = self.pilots.symbols
            if update == updates:
                break
            # least squares of gain and delay: products with the weights |G_n·ĉ_n|² of the ratios of received to decided
            product = received * symbols.conj() * power
            weight = (np.square(symbols.real) + np.square(symbols.imag)) * power
            gain = product.sum(1) / weight.sum(1)
            turned = (product @ number) * np.exp(-1j * np.angle(gain))
            slope = turned.imag / (weight @ np.square(number)) / np.maximum(np.abs(gain), 1e-30)
            path = replace(
                path,
                delay_cells=path.delay_cells - slope * subcarriers / (2 * np.pi),
                phase_rad=path.phase_rad + np.angle(gain),
                amplitude=path.amplitude * np.abs(gain),
            )
        error = received - symbols
        error_power = (np.square(error.real) + np.square(error.imag)) * power
        data = np.ones(subcarriers, np.float32)
        if self.pilots is not None:
            data[self.pilots.places] = 0
        mean_power = np.maximum(np.broadcast_to(power, flat.shape) @ data, 1e-30)
        first, second = (np.asarray(moment @ data, np.float64) for moment in (error_power, np.square(error_power)))
        kurtosis = data.sum() * second / np.maximum(np.square(first), 1e-30)
        return path, symbols, labels, np.sqrt(first / mean_power), kurtosis


def _smooth(channel: NDArray[Any]) -> Complexes:
    """Return the part of channels, (pulse, subcarrier), within ±16 cells of the direct path."""
    basis = _basis(channel.shape[1])
    return ((channel.astype(np.complex64) @ basis) @ basis.T).astype(np.complex64)


def _minimum_phase(received: Complexes) -> Complexes:
    """Return the minimum-phase channel, (subcarrier,), of the mean power of pulses, by its cepstrum (eq. 10)."""
    power = np.square(np.abs(received))
    power = (power / np.maximum(power.mean(1, keepdims=True), 1e-30)).mean(0)
    cepstrum = scipy.fft.ifft(np.log(np.maximum(power, 1e-6)) / 2)
    middle = power.size // 2
    cepstrum[1:middle] *= 2
    cepstrum[middle + 1 :] = 0
    return np.asarray(np.exp(scipy.fft.fft(cepstrum)), np.complex64)


def _reflections(flat: Complexes) -> tuple[NDArray[np.intp], Complexes]:
    """Return the pulses of a block with reflections in their power, and the minimum-phase channels of these (eq. 14).

    The strongest reflection is fitted to the power of the pulse, which is divided by its effect, and so on.
    """
    subcarriers = flat.shape[1]
    power = np.square(flat.real) + np.square(flat.imag)
    power /= np.maximum(power.mean(1, keepdims=True), 1e-30)
    deviation = np.sqrt(np.square(power - 1).mean(1) / subcarriers)  # of the amplitude of a reflection
    screened = np.abs(scipy.fft.rfft(power - 1, 2 * subcarriers, axis=1)[:, 2:]).max(1) / subcarriers
    rows = np.flatnonzero(screened > _SIGNIFICANT * deviation)
    power, number = power[rows], np.arange(subcarriers) - (subcarriers - 1) / 2
    channel, fine = np.ones(power.shape, np.complex64), 8  # steps per cell
    for _ in range(_REFLECTIONS if rows.size else 0):
        rest = power / (np.square(channel.real) + np.square(channel.imag))
        rest = rest / np.maximum(rest.mean(1, keepdims=True), 1e-30) - 1
        correlation = scipy.fft.rfft(rest, fine * subcarriers, axis=1).conj() / subcarriers
        correlation[:, :fine] = 0
        step = np.abs(correlation).argmax(1)
        cells = step / fine
        peak = correlation[np.arange(len(rows)), step] * np.exp(-1j * np.pi * cells * (subcarriers - 1) / subcarriers)
        level = np.minimum(np.abs(peak), 0.45)  # a/(1 + a²) of a reflection of amplitude a
        amplitude = 2 * level / (1 + np.sqrt(1 - 4 * level**2))
        amplitude *= np.abs(peak) > _SIGNIFICANT * np.sqrt(np.square(rest).mean(1) / subcarriers)
        delayed = np.exp(1j * (np.angle(peak)[:, None] - 2 * np.pi * number * cells[:, None] / subcarriers))
        channel = (channel * (1 + amplitude[:, None] * delayed)).astype(np.complex64)
    return rows, channel


def _early(relative: Complexes) -> Floats:
    """Return the power of channels, (pulse, subcarrier), before the direct path, relative to it (eq. 15)."""
    taper = np.hanning(relative.shape[1]).astype(np.float32)
    power = np.square(np.abs(scipy.fft.ifft(relative * taper, axis=1)))
    return np.asarray(power[:, -_gate(relative.shape[1]) : -1].sum(1) / np.maximum(power[:, 0], 1e-30), np.float64)


def _gate(subcarriers: int) -> int:
    """Return the half width of the gate, cells; of few subcarriers, most of the noise remains outside."""
    return min(GATE_CELLS, max(subcarriers // 64, 1))


@lru_cache(maxsize=4)
def _basis(subcarriers: int) -> NDArray[np.float32]:
    """Return an orthonormal basis, (subcarrier, function), of channels within ±16 cells of the direct path.

    Discrete prolate spheroidal sequences represent reflections at fractions of a cell without the sidelobes of a gate
    in delay.
    """
    cells = _gate(subcarriers)
    # eigenvectors of the tridiagonal matrix that commutes with the band limitation (Slepian 1978, eq. 14)
    number = np.arange(subcarriers)
    diagonal = np.square((subcarriers - 1 - 2 * number) / 2) * np.cos(2 * np.pi * cells / subcarriers)
    beside = number[1:] * (subcarriers - number[1:]) / 2
    kept = (max(subcarriers - 2 * cells - 4, 0), subcarriers - 1)
    return np.asarray(scipy.linalg.eigh_tridiagonal(diagonal, beside, select="i", select_range=kept)[1], np.float32)
