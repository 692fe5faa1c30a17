"""Symbols of a recording that are decided from its sidelink, and the choice between decisions and division.

Source: docs/theory/data_symbols.md, "Decisions or division".
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.echo.captures import Pulses, Read, correct_clock, spread
from apertura.core.echo.clock import GROUPS, clock_of, decide_clock
from apertura.core.echo.constellation import Constellation, Labels
from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.transfer import as_complex
from apertura.core.echo.unknown_symbols import Decisions, Pilots, SymbolDecider

_CHANNEL_GROUPS, _CHANNEL_PULSES = 32, 64  # groups of pulses with a mean channel, and pulses in each
_CLOCK_PULSES = 64  # pulses in each group from which the clock is measured


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
    known
        Labels of the first data symbols of each pulse, of the header; None: the symbols are ambiguous without pilots.
    """

    read: Read
    numerology: Numerology
    symbol_samples: int
    decider: SymbolDecider
    clock_hz: Floats | None
    sfo_ppm: float
    known: Labels | None = None

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
        known: Labels | None = None,
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
        symbols = cls(read, numerology, symbol_samples, empty, clock_hz, sfo_ppm, known=known)
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
        if self.known is not None and self.decider.pilots is None:
            return self.decider.resolved(decisions, self.known)
        return decisions

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


def _groups(count: int) -> list[Pulses]:
    """Return the groups of pulses with a mean channel: spread over the flight, or consecutive in a short one."""
    if count <= _CHANNEL_GROUPS * _CHANNEL_PULSES:
        return np.array_split(np.arange(count), max(1, count // _CHANNEL_PULSES))
    return spread(count, groups=_CHANNEL_GROUPS, each=_CHANNEL_PULSES)
