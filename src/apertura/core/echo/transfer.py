"""Transfer functions from the captures of a pair, computed from the code alone or corrected by the sidelink.

Captures are read in two passes. The first pass measures clock and sidelink, a few numbers per pulse. The second pass
computes transfer functions from the captures and these numbers, block by block and on demand. Only one block of
captures is in memory at a time, for any length of the flight.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.progress import progress
from apertura.common.units import decibels
from apertura.core.echo.association import BaselineResidual, baseline_residual, detect_wrong_association
from apertura.core.echo.captures import (
    Pulses,
    Read,
    Samples,
    Saturation,
    blocks_of,
    conjugates,
    correct_clock,
    sampled_pulses,
    spread,
)
from apertura.core.echo.clock import GROUPS, clock_of, decide_clock, repeated_share
from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.interference import SidelinkInterference, expected_excess, limited, noise_peaks
from apertura.core.echo.line_of_sight import LineOfSight, Weights
from apertura.core.echo.own_pulses import CodeEvidence, own_code, phase_stability
from apertura.core.echo.sidelink import DIVIDING, LEAST_NOISE, METHODS, choose, edges
from apertura.core.echo.sidelink_spikes import find_spikes
from apertura.core.echo.sidelink_state import SidelinkState, measure_blocks, second_path_flags
from apertura.core.echo.symbol_filter import FilterChoice, SymbolFilter
from apertura.core.echo.tones import Tones

Inverse = Callable[[Pulses], Complexes]
"""Ascending capture numbers, as of `Read` → inverse spectra of their transmitted pulses, as of `Inverses.at`."""

ChooseSymbols = Callable[[Complexes, float], FilterChoice]
"""Sample of transfer functions divided by the code, and SNR of the sidelink by which they are divided, per subcarrier
with a constant modulus (infinite: not divided) → filter of the symbols."""

_INVERTED = (
    "the conjugate samples contain the code: set waveform.iq to swapped if I and Q are swapped, or to conjugate if the "
    "local oscillator is above the band; for a single node, set nodes.<n>.iq"
)
# minimum factor by which the peak-to-mean ratio of delay profiles increases if the samples are conjugated
_COMPRESSED = 4.0

_STRETCH = 128  # number of consecutive pulses in each part of the flight in which code and phase are checked
_FEWEST_TESTED = 8  # minimum number of pulses of a part of the flight in which the code is checked
_SIGNAL_SHARE = 0.8
"""Share of signals in the power of captures, above which the right code compresses an echo: a signal that fills the
cyclic prefix is then at least 10 dB above the level beyond it."""
_CLOCK_STRETCH = 256  # number of consecutive pulses in each part of the flight in which the clock is measured


@dataclass(frozen=True)
class Correction:
    """Correction of the transfer functions of a secondary node, pulse by pulse.

    Attributes
    ----------
    method
        A key of `METHODS`.
    path
        Direct path in the sidelink of each pulse.
    clock_hz
        (pulse,) float64, carrier offset removed from the samples of the receiver, Hz; None: not corrected.
    sfo_ppm
        Offset of the sampling rate of the receiver, which is corrected together with the carrier offset.
    """

    method: str
    path: LineOfSight
    clock_hz: Floats | None
    sfo_ppm: float

    def select(self, pulses: Pulses | NDArray[np.bool_]) -> "Correction":
        """Return the correction of the selected pulses."""
        clock_hz = None if self.clock_hz is None else self.clock_hz[pulses]
        return replace(self, path=self.path.select(pulses), clock_hz=clock_hz)


@dataclass(frozen=True)
class Demodulator:
    """Demodulator that converts samples of captures to symbols and transfer functions.

    Attributes
    ----------
    inverse, numerology
        Inverse spectra of the transmitted pulses (1/c_n for a symbol), and sampling of the signal.
    symbol_samples
        (T_cp + T)·f_s, or the length of a capture; later samples are not used.
    tones
        Channel → removal of tones of other transmitters; empty: tones are not removed.
    filter
        Filter of symbols of varying modulus in the radar channel; None: the modulus is constant.
    spectrum
        (1, subcarrier) complex64, spectrum of the transmitted pulse, whose filter is not its reciprocal; None: it is.
    """

    inverse: Inverse
    numerology: Numerology
    symbol_samples: int
    tones: Mapping[str, Tones] = field(default_factory=dict)
    filter: SymbolFilter | None = None
    spectrum: Complexes | None = None

    def without_tones(self) -> "Demodulator":
        """Return a demodulator that removes the tones of other transmitters from both channels."""
        tones = {channel: Tones(self.numerology, sent=self.spectrum) for channel in ("radar", "sidelink")}
        return replace(self, tones=tones)

    def symbols(
        self,
        iq: Samples,
        captures: Pulses,
        clock_hz: Floats | None = None,
        sfo_ppm: float = 0.0,
        *,
        channel: str = "radar",
    ) -> Complexes:
        """Demodulate samples of captures, (pulse, sample, 2), after clock correction; return (pulse, subcarrier)."""
        numerology, inverse = self.numerology, self.inverse(captures)
        if clock_hz is None:
            received = demodulate(as_complex(iq), numerology)
        else:
            samples = as_complex(iq[:, : self.symbol_samples])
            received = demodulate(correct_clock(samples, numerology, cfo_hz=clock_hz, sfo_ppm=sfo_ppm), numerology)
        if channel in self.tones:
            received = self.tones[channel].removed(received, inverse)
        return received * inverse

    def transfer(self, iq: Mapping[str, Samples], captures: Pulses, correction: Correction | None = None) -> Complexes:
        """Return the transfer functions of a block of captures, (pulse, subcarrier) complex64.

        Parameters
        ----------
        iq
            Channel → (pulse, sample, 2): `radar`, and `sidelink` if there is a correction.
        captures
            Numbers of these captures.
        correction
            Correction of these pulses; None for a node that receives its own echoes.
        """
        clock = (None, 0.0) if correction is None else (correction.clock_hz, correction.sfo_ppm)
        radar = self.symbols(iq["radar"], captures, *clock)
        if self.filter is not None:
            radar = self.filter.applied(radar, self.inverse(captures))
        if correction is None:
            return radar
        sidelink, weight = self.symbols(iq["sidelink"], captures, *clock, channel="sidelink"), self.weight(captures)
        sidelink = limited(sidelink, self.limit_weight(captures))[0]
        return METHODS[correction.method](radar, sidelink, correction.path, weight)

    def weight(self, captures: Pulses) -> Weights | None:
        """Return |c|² of symbols of varying modulus, mean 1 over each pulse, the weights of a sidelink."""
        if self.filter is None:
            return None
        inverse = self.inverse(captures)
        power = 1 / (np.square(inverse.real) + np.square(inverse.imag))
        return np.asarray(power / power.mean(axis=1, keepdims=True), np.float32)

    def limit_weight(self, captures: Pulses) -> Weights | None:
        """Return the weights by which limits of a sidelink are raised, as of `limited`."""
        if self.spectrum is None:
            return self.weight(captures)
        noise = np.abs(self.inverse(captures)[0]) ** 2
        return np.asarray(1 / expected_excess(noise, noise * self.sent_power(captures)[0], np.median), np.float32)[None]

    def sent_power(self, captures: Pulses) -> Floats:
        """Return the power of the transmitted spectra, (1 or pulse, subcarrier)."""
        return np.abs(1 / self.inverse(captures) if self.spectrum is None else self.spectrum) ** 2

    def gain(self, iq: Mapping[str, Samples], captures: Pulses, correction: Correction | None = None) -> Floats:
        """Return the gain of the radar channel's noise power in transfer functions, (pulse, subcarrier) float32.

        It is the response to an impulse in the radar channel. Parameters as of `transfer`.
        """
        impulse = np.zeros(iq["radar"].shape, np.float32)
        impulse[:, self.numerology.prefix_samples + self.numerology.dft_samples // 2, 0] = self.numerology.dft_samples
        return np.square(np.abs(replace(self, tones={}).transfer({**iq, "radar": impulse}, captures, correction)))


@dataclass(frozen=True)
class Transfer:
    """Transfer functions of a pair, with the measurements on its captures.

    Attributes
    ----------
    kept
        (capture,) bool, True for captures that are used.
    flags
        Flag → measured values, one line.
    report
        Decisions with reasons: clock, sidelink, code.
    sidelink_delay_m, sidelink_snr_db, sidelink_phase_rad
        (pulse,) float64, measurements of the sidelink in the captures that are used: delay multiplied by c, metres; SNR
        per subcarrier; and phase at band centre. NaN in pulses without lock; None without a sidelink.
    form
        Function of ascending capture numbers that returns their transfer functions, (pulse, subcarrier) complex64. The
        code is removed; electrical paths are not removed.
    saturation
        Saturation of the captures demodulated so far.
    correction
        Correction of all captures; None for a node that receives its own echoes.
    """

    kept: NDArray[np.bool_]
    flags: dict[str, str]
    report: dict[str, Any]
    sidelink_delay_m: Floats | None
    form: Callable[[Pulses], Complexes]
    saturation: Saturation
    sidelink_snr_db: Floats | None = None
    sidelink_phase_rad: Floats | None = None
    correction: Correction | None = None


def transfer_by_code(
    read: Read, demodulator: Demodulator, *, time_s: Floats, choose_symbols: ChooseSymbols | None = None
) -> Transfer:
    """Return the monostatic transfer functions of a node; transmitter and receiver have the same clock.

    Parameters
    ----------
    read
        Reader of channel `radar`.
    demodulator
        Demodulator of the captures.
    time_s
        (capture,) float64, times of transmission, seconds from any origin.
    choose_symbols
        Choice of the filter of symbols of varying modulus; None: the modulus is constant.

    Notes
    -----
    Code and phase are checked on up to 2048 captures, in 16 groups spread over the flight.

    Examples
    --------
    >>> from apertura.core.echo.frame_codes import Inverses
    >>> numerology = Numerology(1e9, 16e6, np.arange(8), prefix_samples=4, dft_samples=16)
    >>> tone = 1000 * np.exp(2j * np.pi * 3 * np.arange(20) / 16)
    >>> iq = np.stack([tone.real, tone.imag], -1)[None].round().astype(np.int16)
    >>> demodulator = Demodulator(Inverses.fixed(np.full(8, 0.5, np.complex64)).at, numerology, 20)
    >>> measured = transfer_by_code(lambda pulses: {"radar": iq[pulses]}, demodulator, time_s=np.zeros(1))
    >>> abs(measured.form(np.arange(1))).round(0)
    array([[  0.,   0.,   0., 500.,   0.,   0.,   0.,   0.]], dtype=float32)
    """
    numerology, saturation = demodulator.numerology, Saturation()
    groups = spread(len(time_s), groups=GROUPS, each=_STRETCH)
    checked = np.concatenate(groups)
    sample = np.concatenate([demodulator.transfer(read(block), block) for block in blocks_of(checked)])
    code = own_code(sample, prefix_cells=numerology.delay_cells)
    if code.carried is not False and len(demodulator.inverse(checked[:2])) > 1:  # the code changes
        parts = np.split(sample, np.cumsum([len(group) for group in groups])[:-1])
        code = _code_of_parts(code, read, demodulator, list(zip(groups, parts, strict=True)))
    inverted: Mapping[str, str] = {}
    if not code.carried:
        conjugate = [
            demodulator.transfer({"radar": conjugates(read(block)["radar"])}, block) for block in blocks_of(checked)
        ]
        if own_code(np.concatenate(conjugate), prefix_cells=numerology.delay_cells).carried:
            inverted = {"spectrum_inverted": _INVERTED}
    phase = phase_stability(sample, time_s[checked], prefix_cells=numerology.delay_cells)
    flags = Flags.merged(code.flags, inverted, phase.flags if phase else {})
    report = {"code": code.report, **({"own_phase": phase.report} if phase else {})}
    if choose_symbols is not None:
        choice = choose_symbols(sample, np.inf)
        demodulator = replace(demodulator, filter=choice.filter)
        flags, report["symbols"] = Flags.merged(flags, choice.flags), choice.report
    formed = forming(read, demodulator, saturation)

    def form(captures: Pulses) -> Complexes:
        return formed(captures, None)

    return Transfer(np.ones(len(time_s), bool), flags, report, None, form, saturation)


def _code_of_parts(
    code: CodeEvidence, read: Read, demodulator: Demodulator, parts: Sequence[tuple[Pulses, Complexes]]
) -> CodeEvidence:
    """Return evidence against changing codes, if parts of the flight contain signals that the code does not compress.

    `parts`: captures, and their transfer functions. Of changing codes, wrong ones leave no signal that is common to all
    pulses; that captures contain a signal is measured on the repeated samples of the symbol.
    """
    numerology, wrong, tested = demodulator.numerology, [], 0
    for captures, transfer in parts:
        samples = as_complex(read(captures)["radar"][:, : demodulator.symbol_samples])
        try:
            share = repeated_share(samples, numerology)
        except ValueError:  # the signal has no repetition, or captures are too short
            return code
        if len(captures) >= _FEWEST_TESTED and share > _SIGNAL_SHARE:
            tested += 1
            if not own_code(transfer, prefix_cells=numerology.delay_cells).carried:
                wrong.append(share)
    if not wrong:
        return code
    line = (
        f"in {len(wrong)} of {tested} parts of the flight, {100 * min(wrong):.0f} % of the power is that of signals, "
        "but the code compresses no echo: other symbols were transmitted"
    )
    return CodeEvidence(False, line)


def transfer_by_sidelink(
    read: Read,
    demodulator: Demodulator,
    *,
    sidelink_m: Floats,
    method: str,
    accuracy_db: float,
    where: str,
    time_s: Floats | None = None,
    choose_symbols: ChooseSymbols | None = None,
) -> Transfer:
    """Return the transfer functions of a secondary node, corrected by its sidelink.

    Parameters
    ----------
    read
        Reader of channels `radar` and `sidelink`.
    demodulator
        Demodulator of the captures.
    sidelink_m
        (capture,) float64, distance between the antennas of the sidelink, metres, with which the measured delay is
        compared.
    method
        A key of `METHODS`; 'auto', for the adequate method of lowest cost, or 'least_noise'.
    accuracy_db
        Tolerated level of clock errors relative to the peak, dB.
    where
        Name of the recording in error messages.
    time_s
        (capture,) float64, time of transmission, seconds from any origin, to exclude pulses in which only the sidelink
        is disturbed; None: these are not searched for, as on a bench.
    choose_symbols
        Choice of the filter of symbols of varying modulus in the radar channel; None: the modulus is constant.

    Raises
    ------
    CampaignError
        If the sidelink does not lock in any capture.

    Notes
    -----
    Source: docs/theory/echo_methods.md. The clock is measured on up to 4096 captures, in 16 groups spread over the
    flight; the state of the sidelink is measured on all captures.
    """
    # First pass: measure the clock on a sample of captures, and the state of the sidelink on all captures.
    numerology = demodulator.numerology
    if choose_symbols is not None:
        demodulator = replace(demodulator, filter=SymbolFilter())
    receiver = _Receiver.measured(read, demodulator, len(sidelink_m), accuracy_db)
    interference = SidelinkInterference(numerology.frequency_hz)
    with progress("sidelinks", len(sidelink_m)) as done:
        try:
            state = measure_blocks(lambda: receiver.sidelink(interference, done), f"{where}: sidelink")
        except CampaignError as unlocked:
            if not _compresses_conjugated(read, demodulator, len(sidelink_m)):
                raise
            expected, remedy = (
                "samples I + jQ with I and Q in the configured order",
                "Set waveform.iq, or nodes.<n>.iq of a single node.",
            )
            raise CampaignError(f"{unlocked.found}; {_INVERTED}", f"{where}: sidelink", expected, remedy) from None
    # Choose the method; raise flags for errors that the method does not remove, and for faults of the recording.
    orders = {"auto": tuple(METHODS), "least_noise": LEAST_NOISE}
    chosen, reason = choose(state, orders[method]) if method in orders else (method, "requested")
    clock_flags = receiver.clock_flags if numerology.repeats or chosen not in DIVIDING else {}
    cell_m = SPEED_OF_LIGHT_M_S / (numerology.numbers.size * numerology.spacing_hz)
    delay_m = state.delay_cells * cell_m
    inverted = "wrong_code" in state.flags and _compresses_conjugated(read, demodulator, len(sidelink_m))
    residual = baseline_residual(delay_m, sidelink_m)
    wrong = detect_wrong_association(residual)
    kept, spike_flags = state.locked, Flags()
    if time_s is not None and "wrong_code" not in state.flags:
        middle_hz = numerology.carrier_hz + numerology.middle_hz
        wave_m = SPEED_OF_LIGHT_M_S / middle_hz
        spikes = find_spikes(state.path, sidelink_m / cell_m, time_s, cycles_per_cell=cell_m / wave_m, wave_m=wave_m)
        kept, spike_flags = kept & ~spikes.excluded, Flags(spikes.flags)
    flags = Flags.merged(
        clock_flags,
        interference.flags,
        demodulator.tones["sidelink"].flags("interference_sidelink") if demodulator.tones else {},
        state.flags,
        spike_flags,
        edges(chosen, state),
        second_path_flags(state, cell_m=cell_m),
        {"association_suspect": wrong} if wrong else {},
        {"spectrum_inverted": _INVERTED} if inverted else {},
    )
    quality = {"method": chosen, "reason": reason, **_sidelink_report(state, residual, chosen)}
    if not np.array_equal(kept, state.locked):
        quality["spikes"] = int((state.locked & ~kept).sum())
    report = {"clock": receiver.report, "sidelink": quality, "code": _sidelink_code(state).report}
    if choose_symbols is not None:
        divided = chosen in DIVIDING
        choice = choose_symbols(receiver.radar(), state.noise_gain * 10 ** (state.snr_db / 10) if divided else np.inf)
        demodulator = replace(demodulator, filter=choice.filter)
        flags, report["symbols"] = Flags.merged(flags, choice.flags), choice.report
    # Second pass, block by block on demand.
    correction = Correction(chosen, state.path, receiver.clock_hz, receiver.sfo_ppm)
    saturation = Saturation()
    formed = forming(read, demodulator, saturation)

    def form(captures: Pulses) -> Complexes:
        return formed(captures, correction.select(captures))

    return Transfer(
        kept,
        flags,
        report,
        delay_m[kept],
        form,
        saturation,
        state.snr_of_pulses_db[kept],
        state.phase_rad[kept],
        correction,
    )


def forming(
    read: Read, demodulator: Demodulator, saturation: Saturation
) -> Callable[[Pulses, Correction | None], Complexes]:
    """Return a function that computes transfer functions of captures and counts saturated samples."""

    def form(captures: Pulses, correction: Correction | None) -> Complexes:
        iq = read(captures)
        saturation.count(iq)
        return demodulator.transfer(iq, captures, correction)

    return form


def noise_statistics(
    read: Read, demodulator: Demodulator, captures: Pulses, correction: Correction | None = None
) -> tuple[Floats, Floats]:
    """Return the expected excess and the largest noise of subcarriers, from the gain in some of the captures.

    Parameters
    ----------
    read, demodulator
        Reader of the captures, and their demodulator.
    captures, correction
        (pulse,) int64, numbers of the captures, and their correction.

    Returns
    -------
    tuple of ndarray
        (subcarrier,) float64: see `expected_excess` and `noise_peaks`.

    Notes
    -----
    Source: docs/theory/interference.md, eq. 13 and 14.
    """
    gains, echoes = [], []
    for pulses in sampled_pulses(len(captures)):
        block = captures[pulses]
        gains.append(demodulator.gain(read(block), block, correction and correction.select(pulses)))
        echoes.append(gains[-1] * demodulator.sent_power(block))
    noise, echo = (np.median(np.concatenate(values), axis=0).astype(np.float64) for values in (gains, echoes))
    return expected_excess(noise, echo), noise_peaks(np.concatenate(gains))


def _compresses_conjugated(read: Read, demodulator: Demodulator, count: int) -> bool:
    """Return True if, after removal of the code, only the conjugated samples of the sidelink compress to a path."""
    pulses = np.concatenate(spread(count, groups=4, each=16))

    def compression(samples: Samples) -> float:
        power = np.abs(np.fft.ifft(demodulator.symbols(samples, pulses, channel="sidelink"), axis=1)) ** 2
        return float(np.median(power.max(axis=1) / power.mean(axis=1)))

    sidelink = read(pulses)["sidelink"]
    return compression(conjugates(sidelink)) > _COMPRESSED * compression(sidelink)


def as_complex(iq: Samples) -> Complexes:
    """Convert I and Q, (…, 2), to complex64."""
    return np.ascontiguousarray(iq, np.float32).view(np.complex64)[..., 0]


@dataclass(frozen=True)
class _Receiver:
    """Receiver with a separate clock; the clock offset is corrected in the samples if necessary."""

    read: Read
    demodulator: Demodulator
    count: int  # number of captures
    report: dict[str, Any]
    clock_flags: dict[str, str]
    clock_hz: Floats | None = None  # carrier offset of each capture, Hz; None: not corrected
    sfo_ppm: float = 0.0

    @classmethod
    def measured(cls, read: Read, demodulator: Demodulator, count: int, accuracy_db: float) -> "_Receiver":
        """Measure the clock offset, and decide whether to correct it in the samples."""
        groups, numerology = spread(count, groups=GROUPS, each=_CLOCK_STRETCH), demodulator.numerology
        length = demodulator.symbol_samples
        sidelink: Iterable[Complexes] = (as_complex(read(group)["sidelink"][:, :length]) for group in groups)
        try:
            clock = clock_of(sidelink, numerology, pulses=count)
        except ValueError as error:
            report = {"corrected": False, "reason": str(error)}
            return cls(read, demodulator, count, report, {"clock_unmeasured": str(error)})
        decision = decide_clock(clock, numerology, accuracy_db=accuracy_db)
        ppm, std_ppm = clock.ppm(numerology)
        report = {
            "corrected": decision.correct,
            "reason": decision.reason,
            "floor_db": round(decision.floor_db, 2),
            "ppm": round(ppm, 4),
            "std_ppm": None if std_ppm is None else round(std_ppm, 4),
        }
        if decision.correct:
            report["sfo_ppm"] = clock.sfo_ppm
        corrected = (clock.cfo_of_pulses_hz(count), clock.sfo_ppm) if decision.correct else ()
        return cls(read, demodulator, count, report, decision.flags, *corrected)

    def sidelink(
        self, interference: SidelinkInterference, done: Callable[[int], None]
    ) -> Iterator[tuple[Complexes, Weights | None]]:
        """Yield the limited symbols of the sidelink with the code removed, and their weights, as of `fit_block`."""
        for block in blocks_of(np.arange(self.count)):
            clock_hz = None if self.clock_hz is None else self.clock_hz[block]
            iq = self.read(block)["sidelink"]
            symbols = self.demodulator.symbols(iq, block, clock_hz, self.sfo_ppm, channel="sidelink")
            symbols = interference.limit(symbols, self.demodulator.limit_weight(block))
            yield symbols, self.demodulator.weight(block)
            done(len(block))

    def radar(self) -> Complexes:
        """Return the radar channel divided by the code in captures spread over the flight, (pulse, subcarrier)."""
        blocks = spread(self.count, groups=GROUPS, each=8)
        return np.concatenate(
            [
                self.demodulator.symbols(
                    self.read(block)["radar"],
                    block,
                    None if self.clock_hz is None else self.clock_hz[block],
                    self.sfo_ppm,
                )
                for block in blocks
            ]
        )


def _sidelink_report(state: SidelinkState, residual: BaselineResidual | None, method: str) -> dict[str, float]:
    gain = 1.0 if method in DIVIDING else state.noise_gain  # the other methods weight the subcarriers
    report = {
        "lock_rate": round(float(state.locked.mean()), 4),
        "snr_db": round(state.snr_db + decibels(gain), 2),
        "echo_db": round(state.echo_db, 2),
        "ripple_db": round(max(state.ripple_db, state.fine_ripple_db), 2),
    }
    if residual is not None:
        report |= {"delay_residual_m": round(residual.residual_m, 4), "delay_noise_m": round(residual.noise_m, 4)}
    return report


def _sidelink_code(state: SidelinkState) -> CodeEvidence:
    if "wrong_code" in state.flags:
        return CodeEvidence(carried=False, evidence=state.flags["wrong_code"])
    return CodeEvidence(True, f"with the configured code, the sidelink locks in {state.locked.mean():.0%} of pulses")
