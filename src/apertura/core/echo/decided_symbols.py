"""Symbols of a recording that are decided from its sidelink, their checks, and the choice of decisions or division.

Source: docs/theory/data_symbols.md, "Decisions or division" and "Checks of the decided symbols".
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.echo.captures import Pulses, Read, correct_clock, spread
from apertura.core.echo.clock import GROUPS, clock_of, decide_clock
from apertura.core.echo.constellation import CONSTELLATIONS, Constellation
from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.frame_format import FrameFormat, Frames
from apertura.core.echo.transfer import as_complex
from apertura.core.echo.unknown_symbols import Decisions, Pilots, SymbolDecider

_CHANNEL_GROUPS, _CHANNEL_PULSES = 32, 64  # groups of pulses with a mean channel, and pulses in each
_CLOCK_PULSES = 64  # pulses in each group from which the clock is measured
# Limits of eqs. 18 and 19: probability of a flag of random symbols, unevenness, and tolerated fraction of wrong bits
_FALSE_ALARM, _UNEVEN, _WRONG_SHARE = 1e-7, 0.1, 0.02
# Limits of eq. 20: kurtosis of the errors, and their mean power relative to that of the least SNR
_KURTOSIS, _LEAST_POWER = 1.45, 0.5
_SIMILAR = 0.1  # relative difference of the number of equally frequent points from that of a constellation


@dataclass(eq=False)
class SidelinkSymbols:
    """Symbols of the captures of a recording, decided from its sidelink.

    Attributes
    ----------
    read
        Reader of channel `sidelink`.
    numerology, symbol_samples
        Numerology of the symbol, and number of samples of prefix and symbol.
    decider
        Decider with the mean channels of the sidelink.
    clock_hz, sfo_ppm
        Offset of carrier of each capture (None: not corrected), and of the sampling rate, removed from the samples.
    frames
        Format of the bits, whose header is known; None: the symbols are ambiguous without pilots.
    """

    read: Read
    numerology: Numerology
    symbol_samples: int
    decider: SymbolDecider
    clock_hz: Floats | None
    sfo_ppm: float
    frames: FrameFormat | None = None

    @classmethod
    def measured(
        cls,
        read: Read,
        numerology: Numerology,
        *,
        symbol_samples: int,
        count: int,
        accuracy_db: float,
        constellation: Constellation,
        pilots: Pilots | None = None,
        frames: FrameFormat | None = None,
        where: str = "sidelink",
    ) -> "SidelinkSymbols":
        """Measure clock and mean channels of a sidelink of `count` captures.

        Raises
        ------
        CampaignError
            If the direct path is not detected in any group of pulses.
        """
        clock_hz, sfo_ppm = None, 0.0
        groups = spread(count, groups=GROUPS, each=_CLOCK_PULSES)
        sidelink = (as_complex(read(group)["sidelink"][:, :symbol_samples]) for group in groups)
        try:
            clock = clock_of(sidelink, numerology, pulses=count)
        except ValueError:  # the capture contains no second period
            pass
        else:
            if decide_clock(clock, numerology, accuracy_db=accuracy_db).correct:
                clock_hz, sfo_ppm = clock.cfo_of_pulses_hz(count), clock.sfo_ppm
        empty = SymbolDecider(constellation, np.ones((1, 1), np.complex64), np.zeros(1), pilots)
        symbols = cls(read, numerology, symbol_samples, empty, clock_hz, sfo_ppm, frames=frames)
        try:
            received = ((group, symbols.received(group)) for group in _groups(count))
            symbols.decider = SymbolDecider.measured(received, constellation, pilots)
        except CampaignError as error:
            raise CampaignError(error.found, f"{where}: sidelink", error.expected, error.remedy) from None
        return symbols

    @property
    def unsure(self) -> bool:
        """True if most decisions are unsure, so that division by the noisy sidelink has the smaller error (eq. 7)."""
        return self.decider.snr < self.decider.constellation.least_snr

    def received(self, captures: Pulses) -> Complexes:
        """Return the received symbols of the sidelink in captures, (pulse, subcarrier) complex64."""
        samples = as_complex(self.read(captures)["sidelink"][:, : self.symbol_samples])
        if self.clock_hz is not None:
            cfo_hz = self.clock_hz[captures]
            samples = correct_clock(samples, self.numerology, cfo_hz=cfo_hz, sfo_ppm=self.sfo_ppm)
        return demodulate(samples, self.numerology)

    def decisions(self, captures: Pulses) -> Decisions:
        """Return the decided symbols of captures, without ambiguity if pilots or a header are known."""
        decisions = self.decider.decide(self.received(captures), captures)
        if self.frames is not None and self.decider.pilots is None:
            return self.decider.resolved(decisions, self.frames.known_labels(self.decider.constellation))
        return decisions

    def parsed(self, decisions: Decisions) -> Frames:
        """Return the fields of the frames of decided symbols.

        Raises
        ------
        TypeError
            If there is no frame format.
        """
        if self.frames is None:
            raise TypeError("the waveform has no frame format")
        return self.frames.parsed(self.decider.constellation.bits(decisions.labels[:, self.decider.data_places]))

    def header_error_rate(self, captures: Pulses) -> float:
        """Return the fraction of wrong bits in the headers of captures; 0 without a frame format."""
        if self.frames is None:
            return 0.0
        return float(self.parsed(self.decisions(captures)).header_errors.mean() / self.frames.header.size)

    def usable(self, decisions: Decisions, *, divided: bool) -> Bools:
        """Return True for pulses whose symbols are used: sure ones, or all with a direct path if echoes are divided."""
        return decisions.path.locked if divided else decisions.sure

    def inverse(self, captures: Pulses) -> Complexes:
        """Return 1/ĉ of captures, (pulse, subcarrier) complex64."""
        return np.asarray(1 / self.decisions(captures).symbols, np.complex64)

    def report(self, usable: NDArray[np.bool_], *, divided: bool) -> Mapping[str, Any]:
        """Return the choice between decisions and division with its reason, and the number of unsure pulses.

        Parameters
        ----------
        usable
            (pulse,) bool, pulses that are used.
        divided
            True if echoes are divided by the noisy sidelink.
        """
        qam, snr = self.decider.constellation, self.decider.snr
        decided, divided_db = qam.decided(snr), decibels(qam.noise_gain / snr)
        # of division: the mean of 1/S in noise (docs/theory/echo_methods.md, "Corrections")
        gain = 1 - np.exp(-snr) if divided else decided.gain
        limits = (
            f"SNR {decibels(snr):.1f} dB per subcarrier, {qam.name} requires {decibels(qam.least_snr):.1f} dB: "
            f"decisions lose {-20 * np.log10(decided.gain):.2f} dB and leave an error of {decibels(decided.error):.1f} "
            f"dB, division an error of {divided_db:.1f} dB"
        )
        return {
            "method": "division" if divided else "decisions",
            "reason": limits,
            "constellation": qam.name,
            "snr_db": round(decibels(snr), 2),
            "evm_db": round(float(20 * np.log10(decided.evm)), 2),
            "symbol_error_rate": float(f"{float(qam.symbol_error_rate(snr)):.2e}"),
            "loss_db": round(float(20 * np.log10(max(gain, 1e-10))), 3) + 0.0,
            "error_db": round(divided_db if divided else decibels(decided.error), 2),
            "unsure": int((~usable).sum()),
        }

    def flags(self, usable: NDArray[np.bool_], *, divided: bool) -> dict[str, str]:
        """Return a flag if pulses are unsure, or if echoes are divided; parameters as of `report`."""
        qam, snr = self.decider.constellation, self.decider.snr
        if divided:
            line = (
                f"SNR {decibels(snr):.1f} dB, below {decibels(qam.least_snr):.1f} dB of {qam.name}: echoes are "
                "divided by the noisy sidelink"
            )
            return {"symbols_unsure": line}
        if usable.all():
            return {}
        line = f"symbols of {(~usable).sum()} of {usable.size} pulses are unsure; these pulses are excluded"
        return {"symbols_unsure": line}


@dataclass(eq=False)
class DecisionCheck:
    """Check of decided symbols against constellation and header (eqs. 18 to 20).

    Attributes
    ----------
    symbols
        Symbols of the recording.
    occupancy
        (label,) int64, number of decided data symbols behind header and counter at each point.
    pulses, wrong_bits, expected_bits
        Number of sure pulses, wrong bits of their headers, and expected number of wrong bits.
    detected, error_power, kurtosis
        Number of pulses with a direct path, and sums of error power and kurtosis over these pulses.

    Examples
    --------
    >>> from apertura.core.echo.constellation import constellation
    >>> numerology = Numerology(1e9, 16e6, np.arange(1024), prefix_samples=4, dft_samples=1024)
    >>> decider = SymbolDecider(constellation("16qam"), np.ones((1, 1024), np.complex64), np.zeros(1))
    >>> check = DecisionCheck(SidelinkSymbols(None, numerology, 1028, decider, None, 0.0))
    >>> check.occupancy[[0, 2, 8, 10]] = 256  # the corner points of 16-QAM
    >>> check.pulses = 1
    >>> check.flags["constellation_suspect"][:79]
    'points occupied unevenly, as by qpsk; mean power of the decided symbols +2.6 dB'
    """

    symbols: SidelinkSymbols
    pulses: int = 0
    wrong_bits: int = 0
    expected_bits: float = 0.0
    detected: int = 0
    error_power: float = 0.0
    kurtosis: float = 0.0

    def __post_init__(self) -> None:
        """Set the occupancy to 0."""
        self.occupancy = np.zeros(self.symbols.decider.constellation.points.size, np.int64)

    def add(self, decisions: Decisions) -> None:
        """Add a block of decisions: kurtosis of all pulses with a direct path, the rest of sure pulses."""
        qam, frames, sure = self.symbols.decider.constellation, self.symbols.frames, decisions.sure
        locked = decisions.path.locked
        self.detected += int(locked.sum())
        self.error_power += float(np.square(decisions.evm[locked]).sum())
        self.kurtosis += float(decisions.kurtosis[locked].sum())
        self.pulses += int(sure.sum())
        self.occupancy += np.bincount(decisions.labels[sure][:, self._places].ravel(), minlength=self.occupancy.size)
        if frames is not None:
            self.wrong_bits += int(self.symbols.parsed(decisions).header_errors[sure].sum())
            rate = qam.symbol_error_rate(decisions.snr[sure]) / qam.bits_per_symbol  # Gray: one bit per symbol error
            self.expected_bits += frames.header.size * float(rate.sum())

    @property
    def _places(self) -> NDArray[np.intp]:
        """Subcarriers of the data symbols behind header and counter."""
        frames, decider = self.symbols.frames, self.symbols.decider
        fixed = 0 if frames is None else frames.header.size + frames.counter_bits
        return decider.data_places[-(-fixed // decider.constellation.bits_per_symbol) :]

    @property
    def header_differs(self) -> bool:
        """True if the header has more wrong bits than the SNR permits (eq. 19)."""
        if self.symbols.frames is None:
            return False
        mean, log = 2 * self.expected_bits, -np.log(_FALSE_ALARM)
        most = mean + log / 3 + np.sqrt(log**2 / 9 + 2 * log * mean)  # Bernstein's inequality
        return bool(self.wrong_bits > most + _WRONG_SHARE * self.pulses * self.symbols.frames.header.size)

    @property
    def larger(self) -> dict[str, str]:
        """Flag of errors that have the magnitudes of a larger constellation, not those of noise (eq. 20)."""
        qam, pulses = self.symbols.decider.constellation, max(self.detected, 1)
        kurtosis, power = self.kurtosis / pulses, self.error_power / pulses
        certain = _KURTOSIS - 4 / np.sqrt(pulses * self.symbols.decider.data_places.size)
        if kurtosis > certain or power < _LEAST_POWER * qam.decided(qam.least_snr).evm ** 2:
            return {}
        line = (
            f"errors of the decisions have similar magnitudes (kurtosis {kurtosis:.2f}, noise at least 1.6), as of a "
            f"larger constellation than {qam.name}"
        )
        return {"constellation_suspect": line}

    @property
    def flags(self) -> dict[str, str]:
        """Flags of a larger constellation, an occupancy that is not uniform, and a header with too many errors."""
        qam, count, places = self.symbols.decider.constellation, self.occupancy.sum(), self._places.size
        flags = self.larger
        if count and places:
            frequency = self.occupancy / count
            uneven = qam.points.size * float(np.square(frequency).sum()) - 1  # eq. 18
            if uneven > _UNEVEN + scipy.special.chdtri(qam.points.size - 1, _FALSE_ALARM) / places:
                equal = qam.points.size / (1 + uneven)
                fitting = [
                    f", as by {other.name}"
                    for other in CONSTELLATIONS.values()
                    if other.points.size < qam.points.size and abs(equal / other.points.size - 1) < _SIMILAR
                ]
                power_db = decibels(float(frequency @ np.square(np.abs(qam.points))))
                flags["constellation_suspect"] = (
                    f"points occupied unevenly{''.join(fitting)}; mean power of the decided symbols {power_db:+.1f} "
                    f"dB: if another constellation was sent, images change by up to {-power_db:+.1f} dB"
                )
        if self.symbols.frames is not None and self.header_differs:
            bits = self.pulses * self.symbols.frames.header.size
            flags["header_differs"] = (
                f"{100 * self.wrong_bits / bits:.1f} % of the bits of the header are wrong, "
                f"{100 * self.expected_bits / bits:.2f} % expected from the SNR"
            )
        return flags


def _groups(count: int) -> list[Pulses]:
    """Return the groups of pulses with a mean channel: spread over the flight, or consecutive in a short one."""
    if count <= _CHANNEL_GROUPS * _CHANNEL_PULSES:
        return np.array_split(np.arange(count), max(1, count // _CHANNEL_PULSES))
    return spread(count, groups=_CHANNEL_GROUPS, each=_CHANNEL_PULSES)
