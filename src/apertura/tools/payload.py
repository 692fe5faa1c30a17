"""Data that the frames of a campaign carry: bits, errors and data rate of each node, from its sidelink."""

from collections.abc import Mapping, Sequence
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
from apertura.common.atomic import made_folder, replacement, write_json
from apertura.common.errors import CampaignError
from apertura.common.tables import write_table
from apertura.common.units import decibels, seconds_since
from apertura.core.echo.captures import blocks_of
from apertura.core.echo.constellation import constellation
from apertura.stages.acquisition import Captured
from apertura.stages.ingest import captures_of, checked_recording
from apertura.stages.symbols import decided_symbols
from apertura.stages.transmitted import Transmitted, UnknownSymbols, transmitted
from apertura.tools.chart.pareto import save_png

_PRINTED = {
    **{name: name for name in ("flight", "node", "frames", "intact")},
    "snr_db": "SNR dB",
    "evm_db": "EVM dB",
    "symbol_error_rate_expected": "SER",
    "received_bit_s": "bit/s",
}
"""Key of the summary → heading of the printed table."""


@dataclass(frozen=True, eq=False)
class NodePayload:
    """Frames that a node received in a flight.

    Attributes
    ----------
    columns
        Quantity → (frame,) values: `time` of the capture, `detected` (direct path), `sure` (decisions within the limit
        of the error vector magnitude), `snr_db` and `evm_db` (NaN where not detected), `counter`, `header_errors`
        (wrong bits), and `intact` (header right, and check sum, if there is one, agrees).
    data
        (frame, byte) uint8, data bits of each frame, padded with zeros to whole bytes.
    summary
        Names of flight and node, numbers of frames and errors, medians of SNR and EVM, and data rates.
    """

    columns: Mapping[str, NDArray[Any]]
    data: NDArray[np.uint8]
    summary: Mapping[str, Any]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table of frames."""
        time = [f"{text}Z" for text in np.datetime_as_string(self.columns["time"], unit="us")]
        columns = {**{name: values.tolist() for name, values in self.columns.items()}, "time": time}
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


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
                name, order = f"raw/{flight.name}/{node}", campaign.settings.iq_of(node)
                captured = Captured.of(raw, recording.samples.path, Path(name), name, sent, order=order)
                names = {"flight": flight.name, "node": node}
                read.append(_payload(captured, sent, campaign.settings.processing.accuracy_db, names))
    if not read:
        raise CampaignError(
            "no node recorded a channel named 'sidelink'",
            where="raw",
            expected="a receiver with a sidelink, from which the symbols are decided",
            remedy="Correct apertura:channels.",
        )
    return read


def _payload(captured: Captured, sent: Transmitted, accuracy_db: Any, names: Mapping[str, str]) -> NodePayload:
    """Return the frames in the sidelink of a recording, decided block by block."""
    unknown = sent.unknown
    if unknown is None or unknown.frames is None:
        raise TypeError("the waveform has no frame format")
    symbols, parts, data = decided_symbols(captured, sent, accuracy_db), list[dict[str, NDArray[Any]]](), []
    for block in blocks_of(np.arange(len(captured.raw.start))):
        decisions = symbols.decisions(block)
        bits = unknown.constellation.bits(decisions.labels[:, symbols.decider.data_places])
        frames, detected = unknown.frames.parsed(bits), decisions.path.locked
        data.append(np.packbits(frames.data, axis=1))
        parts.append({
            "detected": detected,
            "sure": decisions.sure,
            "snr_db": np.where(detected, 10 * np.log10(decisions.snr), np.nan),
            "evm_db": np.where(detected, 20 * np.log10(decisions.evm), np.nan),
            "counter": frames.counter,
            "header_errors": frames.header_errors,
            "intact": frames.intact & detected,
        })  # fmt: skip
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    summary = {**names, **_summary(columns, unknown, sent.waveform.prf_hz)}
    return NodePayload({"time": captured.raw.time.values, **columns}, np.concatenate(data), summary)


def _summary(columns: Mapping[str, NDArray[Any]], unknown: UnknownSymbols, prf_hz: float) -> dict[str, Any]:
    """Return numbers of frames and errors, medians of SNR and EVM, and data rates."""
    qam, frames, seen = unknown.constellation, unknown.frames, columns["detected"]
    if frames is None:
        raise TypeError("the waveform has no frame format")
    counts = {"frames": seen.size, **{name: int(columns[name].sum()) for name in ("detected", "sure", "intact")}}
    intact, rate_bit_s = counts["intact"] / max(seen.size, 1), frames.data_bits * prf_hz
    measured = dict[str, float | None](snr_db=None, evm_db=None, header_bit_error_rate=None)
    if seen.any():
        # eqs. 3 and 16
        expected = float(qam.symbol_error_rate(10 ** (columns["snr_db"][seen] / 10)).mean())
        measured = {name: round(float(np.median(columns[name][seen])), 2) for name in ("snr_db", "evm_db")}
        measured["header_bit_error_rate"] = float(columns["header_errors"][seen].mean() / frames.header.size)
        measured["symbol_error_rate_expected"] = float(f"{expected:.3e}")
        lost = 1 - (1 - expected) ** (frames.total_bits // qam.bits_per_symbol)
        measured["frame_error_rate_expected"] = float(f"{lost:.3e}")
    return {
        "constellation": qam.name,
        **counts,
        "frame_error_rate": round(1 - intact, 6),
        **measured,
        "data_bits_per_frame": frames.data_bits,
        "sent_bit_s": rate_bit_s,
        "received_bit_s": rate_bit_s * intact,
    }


def write_payload(campaign: Campaign, folder: Path) -> list[Path]:
    """Write payload.json, payload.png, and table and data of each node into a folder; print a summary."""
    read, root = payloads(campaign), made_folder(folder)
    files: list[Path] = [root / "payload.json", root / "payload.png"]
    write_json(files[0], {"campaign": campaign.settings.campaign, "nodes": [one.summary for one in read]})
    _draw(read, files[1])
    table = Table(*_PRINTED.values())
    for one in read:
        name = "{flight}.{node}".format_map(one.summary)
        write_table(root / f"{name}.csv", one.rows, digits=4)
        with replacement(root / f"{name}.npy") as temporary, temporary.open("wb") as file:
            np.save(file, one.data)
        files += [root / f"{name}.csv", root / f"{name}.npy"]
        table.add_row(*(str(one.summary.get(key)) for key in _PRINTED))
    Console().print(table)
    return files


def _draw(read: Sequence[NodePayload], path: Path) -> None:
    """Plot SNR and lost frames of each node over time, one panel for each flight."""
    flights = list(dict.fromkeys(one.summary["flight"] for one in read))
    figure = Figure(figsize=(10, 1.2 + 2.8 * len(flights)), layout="constrained")
    for axes, flight in zip(figure.subplots(len(flights), squeeze=False)[:, 0], flights, strict=True):
        nodes = [one for one in read if one.summary["flight"] == flight]
        start = min(one.columns["time"][0] for one in nodes)
        for one in nodes:
            time_s, snr_db = seconds_since(one.columns["time"], start), one.columns["snr_db"]
            lost, label = ~one.columns["intact"], one.summary["node"]
            line = axes.plot(time_s, snr_db, linewidth=1, label=f"{label}: {(~lost).sum()} intact")[0]
            level = np.where(np.isfinite(snr_db), snr_db, 0.0)
            axes.plot(time_s[lost], level[lost], "x", color=line.get_color(), label=f"{label}: {lost.sum()} lost")
        qam = constellation(nodes[0].summary["constellation"])
        least_db = decibels(qam.least_snr)
        axes.axhline(least_db, color="0.4", linestyle="--", label=f"{qam.name}: least SNR, {least_db:.1f} dB")
        axes.set(title=f"Flight {flight}", ylabel="SNR per subcarrier, dB", xlabel="Time since the first frame, s")
        axes.legend(loc="best", fontsize="small")
    save_png(figure, path)
