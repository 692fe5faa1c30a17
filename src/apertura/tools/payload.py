"""Data that the frames of a campaign carry: bits, errors and data rate of each node, from its sidelink."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from apertura.campaign.config import CONFIG, OfdmWaveform, SidelinkCodes
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Floats, Times
from apertura.common.atomic import made_folder, replacement, write_json
from apertura.common.errors import CampaignError
from apertura.common.tables import write_table
from apertura.common.units import decibels, seconds_since
from apertura.core.echo.captures import blocks_of
from apertura.core.echo.constellation import Constellation
from apertura.core.echo.frame_format import FrameFormat
from apertura.stages.acquisition import Captured
from apertura.stages.ingest import captures_of, checked_recording
from apertura.stages.symbols import decided_symbols
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.tools.chart.pareto import save_png


@dataclass(frozen=True)
class FrameRow:
    """Frame of a capture, as in the table of a node."""

    time_utc: str
    capture: int
    detected: bool
    sure: bool
    snr_db: float
    evm_db: float
    counter: int
    header_errors: int
    intact: bool


@dataclass(frozen=True, eq=False)
class NodePayload:
    """Frames that a node received in a flight.

    Attributes
    ----------
    flight, node
        Names.
    time
        (frame,) datetime64[ns], time tags of the node.
    snr_db, evm_db
        (frame,) float64, SNR per subcarrier and error vector magnitude; NaN where no direct path is detected.
    detected, sure, intact
        (frame,) bool: direct path detected; decisions within the limit of the error vector magnitude; header right and
        check sum, if there is one, agrees.
    counter, header_errors
        (frame,) int64, frame counter, and number of wrong bits of the header.
    data
        (frame, byte) uint8, data bits of each frame, padded with zeros to whole bytes.
    frames, constellation, prf_hz
        Format of the frames, constellation, and frames per second.
    """

    flight: str
    node: str
    time: Times
    snr_db: Floats
    evm_db: Floats
    detected: NDArray[np.bool_]
    sure: NDArray[np.bool_]
    intact: NDArray[np.bool_]
    counter: NDArray[np.int64]
    header_errors: NDArray[np.int64]
    data: NDArray[np.uint8]
    frames: FrameFormat
    constellation: Constellation
    prf_hz: float

    @property
    def symbols(self) -> int:
        """Number of data symbols of a frame."""
        return self.frames.total_bits // self.constellation.bits_per_symbol

    @property
    def summary(self) -> dict[str, Any]:
        """Numbers of frames and errors, medians of SNR and EVM, and data rates."""
        count, seen = len(self.time), self.detected
        snr_db = float(np.median(self.snr_db[seen])) if seen.any() else None
        evm_db = float(np.median(self.evm_db[seen])) if seen.any() else None
        expected = None
        if seen.any():
            expected = float(self.constellation.symbol_error_rate(10 ** (self.snr_db[seen] / 10)).mean())
        known = max(int(seen.sum()) * self.frames.header.size, 1)
        return {
            "flight": self.flight,
            "node": self.node,
            "constellation": self.constellation.name,
            "frames": count,
            "detected": int(seen.sum()),
            "sure": int(self.sure.sum()),
            "intact": int(self.intact.sum()),
            "frame_error_rate": round(1 - float(self.intact.mean()), 6) if count else None,
            "frame_error_rate_expected": None if expected is None else round(1 - (1 - expected) ** self.symbols, 6),
            "header_bit_error_rate": round(float(self.header_errors[seen].sum()) / known, 8),
            "symbol_error_rate_expected": None if expected is None else float(f"{expected:.3e}"),
            "snr_db": None if snr_db is None else round(snr_db, 2),
            "evm_db": None if evm_db is None else round(evm_db, 2),
            "data_bits_per_frame": self.frames.data_bits,
            "sent_bit_s": round(self.frames.data_bits * self.prf_hz, 3),
            "received_bit_s": round(self.frames.data_bits * self.prf_hz * float(self.intact.mean()), 3),
        }

    @property
    def rows(self) -> list[FrameRow]:
        """Rows of the table of frames."""
        return [
            FrameRow(
                f"{np.datetime_as_string(self.time[index], unit='us')}Z",
                index,
                bool(self.detected[index]),
                bool(self.sure[index]),
                float(self.snr_db[index]),
                float(self.evm_db[index]),
                int(self.counter[index]),
                int(self.header_errors[index]),
                bool(self.intact[index]),
            )
            for index in range(len(self.time))
        ]


def payloads(campaign: Campaign) -> list[NodePayload]:
    """Return the frames of all nodes that recorded a sidelink.

    Raises
    ------
    CampaignError
        If the waveform has no frame format, or no node recorded a sidelink.
    """
    waveform = campaign.settings.waveform
    codes = getattr(waveform, "codes", None)
    if not (isinstance(waveform, OfdmWaveform) and isinstance(codes, SidelinkCodes) and codes.frame is not None):
        raise CampaignError(
            "no frame format",
            where=f"{CONFIG}: waveform.codes.frame",
            expected="waveform.codes with source: sidelink, constellation and frame",
            remedy="Describe header, counter and check sum of the transmitted frames.",
        )
    sent, read = transmitted(campaign, waveform), list[NodePayload]()
    for flight in campaign.flights:
        for node in flight.recorded:
            recording = checked_recording(campaign, flight.name, node)
            if "sidelink" in recording.channels:
                raw = captures_of(recording, campaign, node=node)
                name = f"raw/{flight.name}/{node}"
                order = campaign.settings.iq_of(node)
                captured = Captured.of(raw, recording.samples.path, Path(name), name, sent, order=order)
                read.append(_payload(captured, sent, campaign.settings.processing.accuracy_db, flight.name, node))
    if not read:
        raise CampaignError(
            "no node recorded a channel named 'sidelink'",
            where="raw",
            expected="a receiver with a sidelink, from which the symbols are decided",
            remedy="Correct apertura:channels.",
        )
    return read


def _payload(captured: Captured, sent: Transmitted, accuracy_db: Any, flight: str, node: str) -> NodePayload:
    """Return the frames in the sidelink of a recording, decided block by block."""
    unknown = sent.unknown
    if unknown is None or unknown.frames is None:
        raise TypeError("the waveform has no frame format")
    symbols, frames = decided_symbols(captured, sent, accuracy_db), unknown.frames
    parts = []
    for block in blocks_of(np.arange(len(captured.raw.start))):
        decisions = symbols.decisions(block)
        bits = unknown.constellation.bits(decisions.labels[:, symbols.decider.data_places])
        parsed, detected = frames.parsed(bits), decisions.path.locked
        data = np.packbits(parsed.data, axis=1)
        measured = (np.where(detected, values, np.nan) for values in (decisions.snr, decisions.evm))
        intact = parsed.intact & detected
        parts.append((*measured, detected, decisions.sure, intact, parsed.counter, parsed.header_errors, data))
    snr, evm, detected, sure, intact, counter, wrong, data = (np.concatenate(part) for part in zip(*parts, strict=True))
    return NodePayload(
        flight,
        node,
        captured.raw.time.values,
        10 * np.log10(snr),
        20 * np.log10(evm),
        detected,
        sure,
        intact,
        counter,
        wrong.astype(np.int64),
        data,
        frames,
        unknown.constellation,
        sent.waveform.prf_hz,
    )


def write_payload(campaign: Campaign, folder: Path) -> list[Path]:
    """Write payload.json, payload.png, and table and data of each node into a folder; print a summary."""
    read, root = payloads(campaign), made_folder(folder)
    files: list[Path] = [root / "payload.json", root / "payload.png"]
    write_json(files[0], {"campaign": campaign.settings.campaign, "nodes": [one.summary for one in read]})
    _draw(read, files[1])
    for one in read:
        table, data = root / f"{one.flight}.{one.node}.csv", root / f"{one.flight}.{one.node}.npy"
        write_table(table, one.rows, digits=4)
        with replacement(data) as temporary, temporary.open("wb") as file:
            np.save(file, one.data)
        files += [table, data]
    _print(read)
    return files


def _print(read: Sequence[NodePayload]) -> None:
    table = Table("flight", "node", "frames", "intact", "SNR dB", "EVM dB", "symbol errors", "data rate kbit/s")
    for one in read:
        values = one.summary
        rate = values["received_bit_s"] / 1e3
        row = (values[key] for key in ("flight", "node", "frames", "intact", "snr_db", "evm_db"))
        table.add_row(*map(str, row), str(values["symbol_error_rate_expected"]), f"{rate:.1f}")
    Console().print(table)


def _draw(read: Sequence[NodePayload], path: Path) -> None:
    """Plot SNR and lost frames of each node over time, one panel for each flight."""
    flights = list(dict.fromkeys(one.flight for one in read))
    figure = Figure(figsize=(10, 1.2 + 2.8 * len(flights)), layout="constrained")
    panels = figure.subplots(len(flights), squeeze=False)[:, 0]
    for axes, flight in zip(panels, flights, strict=True):
        nodes = [one for one in read if one.flight == flight]
        start = min(one.time[0] for one in nodes)
        for one in nodes:
            time_s = seconds_since(one.time, start)
            line = axes.plot(time_s, one.snr_db, linewidth=1, label=f"{one.node}: {one.summary['intact']} intact")[0]
            lost = ~one.intact
            level = np.where(np.isfinite(one.snr_db), one.snr_db, np.nanmin([*one.snr_db, 0.0]))
            axes.plot(time_s[lost], level[lost], "x", color=line.get_color(), label=f"{one.node}: {lost.sum()} lost")
        qam = nodes[0].constellation
        least_db = decibels(qam.least_snr)
        axes.axhline(least_db, color="0.4", linestyle="--", label=f"{qam.name}: least SNR, {least_db:.1f} dB")
        axes.set_title(f"Flight {flight}")
        axes.set_ylabel("SNR per subcarrier, dB")
        axes.legend(loc="best", fontsize="small")
    panels[-1].set_xlabel("Time since the first frame, s")
    save_png(figure, path)
