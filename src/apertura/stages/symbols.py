"""Symbols of a pair's pulses that are decided from a sidelink, in place of symbols known beforehand."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.captures import blocks_of, spread
from apertura.core.echo.decided_symbols import DecisionCheck, SidelinkSymbols
from apertura.core.echo.frame_codes import Inverses
from apertura.core.echo.unknown_symbols import SymbolDecider
from apertura.core.quality.budget import strictest_accuracy_db
from apertura.stages.acquisition import Captured, common_pulses
from apertura.stages.transmitted import Transmitted

FEW_ERRORS = 0.1
"""Fraction of wrong bits in the header below which the order of I and Q is confirmed."""


def decided_symbols(
    source: Captured, sent: Transmitted, accuracy_db: float | Literal["auto"], stage: xr.Dataset | None = None
) -> SidelinkSymbols:
    """Return the symbols in the sidelink of all captures of a node.

    Parameters
    ----------
    source, sent, accuracy_db
        Recording of the node, transmitted signal, and `processing.accuracy_db`.
    stage
        Stage `echo` with the clock and the mean channels of the sidelink; None: they are measured.

    Raises
    ------
    CampaignError
        If the node recorded no sidelink, or no direct path is detected in it.
    """
    unknown = sent.unknown
    if unknown is None:
        raise TypeError("the symbols are known")
    count = len(source.raw.start)
    recorded: dict[str, Any] = {
        "read": source.reader(["sidelink"], np.arange(count)),
        "numerology": source.numerology,
        "symbol_samples": sent.waveform.capture_samples,
        "frames": unknown.frames,
    }
    if stage is not None:
        shapes, middles = stage.symbol_channel.values, stage.symbol_group.values
        return SidelinkSymbols(
            **recorded,
            decider=SymbolDecider(unknown.constellation, shapes, middles, unknown.pilots),
            clock_hz=stage.symbol_clock.values if "symbol_clock" in stage else None,
            sfo_ppm=stage.attrs["symbols"]["decided"]["sfo_ppm"],
        )
    return SidelinkSymbols.measured(
        **recorded,
        count=count,
        accuracy_db=strictest_accuracy_db(accuracy_db),
        constellation=unknown.constellation,
        pilots=unknown.pilots,
        where=str(source.files),
    )


def check_flags(check: DecisionCheck, source: Captured, sent: Transmitted, accuracy_db: Any) -> dict[str, str]:
    """Return the flags of decided symbols of a node, and a flag if the header is that of the conjugated samples."""
    name, flags = source.files.name, check.flags
    if check.header_differs:
        try:
            other = decided_symbols(source.conjugated, sent, accuracy_db)
        except CampaignError:
            pass
        else:
            tested = np.concatenate(spread(len(source.raw.start), groups=4, each=16))
            if other.header_error_rate(tested) < FEW_ERRORS:
                flags["spectrum_inverted"] = (
                    f"the complex conjugates of the samples contain the header; change nodes.{name}.iq, or waveform.iq "
                    "if all nodes are affected"
                )
    return flags


@dataclass(eq=False)
class PairSymbols:
    """Symbols of the pulses of a pair.

    Attributes
    ----------
    sent
        Transmitted signal whose rows are the captures of the source.
    rows
        (pulse,) int64, row of each pulse; -1 if the source did not record it.
    symbols, recorded, accuracy_db
        Symbols and recording of the source, and `processing.accuracy_db`.
    is_monostatic
        True if the pulses are those of a monostatic pair, whose echo cannot be divided by the sidelink of the source.
    check
        Check of the sure symbols, set by `usable`; None before.
    """

    sent: Transmitted
    rows: NDArray[np.int64]
    symbols: SidelinkSymbols
    recorded: Captured
    accuracy_db: float | Literal["auto"]
    is_monostatic: bool
    check: DecisionCheck | None = field(default=None, init=False)

    @classmethod
    def of(
        cls,
        source: Captured,
        sent: Transmitted,
        rows: NDArray[np.int64],
        accuracy_db: float | Literal["auto"],
        *,
        is_monostatic: bool = False,
    ) -> "PairSymbols":
        """Return the symbols of pulses that the captures `rows` of `source` contain in their sidelink.

        Raises
        ------
        CampaignError
            If the source recorded no sidelink, or no direct path is detected in it.
        """
        name = source.files.name
        if "sidelink" not in source.raw.attrs["channels"]:
            raise CampaignError(
                f"node {name} recorded no channel named 'sidelink'",
                where=source.recording,
                expected="the direct path, from which unknown symbols are decided",
                remedy="Set waveform.codes.node to a node with a sidelink, or name the channel in apertura:channels.",
            )
        symbols = decided_symbols(source, sent, accuracy_db)
        return cls(with_symbols(sent, source, symbols), rows, symbols, source, accuracy_db, is_monostatic)

    def usable(self) -> NDArray[np.bool_]:
        """Return True for pulses whose symbols are used; all pulses are decided, block by block.

        Raises
        ------
        CampaignError
            If no pulse is used.
        """
        usable, check = np.zeros(len(self.rows), bool), DecisionCheck(self.symbols)
        for block in blocks_of(np.flatnonzero(self.rows >= 0)):
            decisions = self.symbols.decisions(self.rows[block])
            usable[block] = self.symbols.usable(decisions, divided=self._divided)
            check.add(decisions)
        self.check = check
        if not usable.any():
            qam = self.symbols.decider.constellation
            raise CampaignError(
                f"the symbols of all {len(usable)} pulses are unsure",
                where=f"sidelink of {self.source}",
                expected=f"an SNR of at least {decibels(qam.least_snr):.1f} dB for {qam.name}, and reflections that "
                "change slowly",
                remedy="Check antenna, gain and reflections of the sidelink, and waveform.codes.",
            )
        return usable

    def sidelink_method(self, requested: str) -> str:
        """Return the sidelink correction; of `auto`, division if symbols are unsure, else the one with least noise."""
        if requested != "auto":
            return requested
        return "divide" if self.symbols.unsure else "least_noise"

    def report(self, usable: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the report on the decisions; `usable`: pulses that are used."""
        stated = self.symbols.report(usable, divided=self._divided)
        return {"node": self.source, **stated, "sfo_ppm": self.symbols.sfo_ppm}

    def flags(self, usable: NDArray[np.bool_]) -> dict[str, str]:
        """Return the flags of unsure pulses of the source, and of the check of sure ones; `usable`: used pulses."""
        raised = dict[str, str]()
        if self.check is not None and self._divided:
            raised = self.check.larger
        elif self.check is not None:
            raised = check_flags(self.check, self.recorded, self.sent, self.accuracy_db)
        checked = {flag: f"sidelink of {self.source}: {line}" for flag, line in raised.items()}
        return Flags.merged(checked, self.symbols.flags(usable[self.rows >= 0], divided=self._divided))

    @property
    def source(self) -> str:
        """Name of the node whose sidelink contains the symbols."""
        return self.recorded.files.name

    @property
    def _divided(self) -> bool:
        return self.symbols.unsure and not self.is_monostatic

    @property
    def variables(self) -> dict[str, tuple[tuple[str, ...], NDArray[Any]]]:
        """Mean channels and clock of the sidelink, from which stage `echo` decides its symbols again."""
        decider, clock_hz = self.symbols.decider, self.symbols.clock_hz
        return {
            "symbol_channel": (("symbol_group", "subcarrier"), decider.shapes),
            "symbol_group": (("symbol_group",), decider.middles),
            **({} if clock_hz is None else {"symbol_clock": (("symbol_capture",), clock_hz)}),
        }


def rows_of(tx: Captured, source: Captured, *, prf_hz: float) -> NDArray[np.int64]:
    """Return the capture of `source` that contains the pulse of each capture of a transmitter; -1 if there is none."""
    both, rows = common_pulses(tx, source, prf_hz=prf_hz), np.full(len(tx.raw.time), -1)
    rows[both.tx_index[~both.outlier]] = both.rx_index[~both.outlier]
    return rows


def ambiguous_symbols() -> CampaignError:
    """Return the error of a monostatic pair without a known part of its symbols."""
    return CampaignError(
        "the phase of symbols decided without pilots and header is ambiguous by quarter turns",
        where=f"{CONFIG}: waveform.codes",
        expected="pilots or frame, for monostatic images by the symbols in a sidelink",
        remedy="Configure waveform.codes.pilots or waveform.codes.frame, or image bistatic pairs only.",
    )


def with_symbols(sent: Transmitted, source: Captured, symbols: SidelinkSymbols) -> Transmitted:
    """Return a transmitted signal whose rows are the decided symbols of the captures of `source`."""
    return replace(sent, inverses=Inverses(len(source.raw.start), symbols.inverse))
