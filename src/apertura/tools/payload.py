"""Rule `payload` and `apertura payload`: data in the frames of a flight, with errors and data rate of each node."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from apertura.campaign.config import CONFIG, OfdmWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, record_files
from apertura.common.atomic import replacement, write_json
from apertura.common.errors import CampaignError
from apertura.common.flag_table import FLAGS
from apertura.common.provenance import Provenance
from apertura.common.tables import write_table
from apertura.common.units import decibels, seconds_since
from apertura.core.echo.captures import blocks_of
from apertura.core.echo.constellation import constellation
from apertura.core.echo.decided_symbols import DecisionCheck
from apertura.core.echo.frame_format import FrameCount
from apertura.stages.acquisition import Captured
from apertura.stages.ingest import captures_of, checked_recording
from apertura.stages.symbols import check_flags, decided_symbols
from apertura.stages.tags import tags_of
from apertura.stages.transmitted import Transmitted, UnknownSymbols, transmitted
from apertura.views.quality import PAYLOAD, payload_row
from apertura.views.report.sheet import BLUE, GREEN, ORANGE, RED, SKY, column_of, sheet, thinned
from apertura.workflow.lineage import result_of
from apertura.workflow.rule_inputs import JobScope, Scope, has_frames
from apertura.workflow.stale import outdated_places

_FEWEST_INTACT = 16.0  # expected number of intact frames, of which none is intact with a probability of 10⁻⁷
_COLOURS = (BLUE, ORANGE, GREEN, RED, SKY)


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
        Name of the node, numbers of frames and errors, medians of SNR and EVM, data rates, and remarks on frames that
        do not have the configured format.
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


def payload(campaign: Campaign, flight: str) -> Sequence[Path]:
    """Write the frames of a flight to results/<flight>/payload: payload.json, payload.png, table and data of each node.

    Raises
    ------
    CampaignError
        If the waveform has no frame format, or no node recorded a sidelink.
    """
    lineage = result_of(campaign, "payload", flight).begin(campaign.root)
    read, folder = payloads(campaign, flight), campaign.result(flight, "payload")
    files: list[Path] = [folder / "payload.json", folder / "payload.png"]
    write_json(files[0], {"flight": flight, "nodes": [one.summary for one in read]})
    origin = Provenance.of(lineage.modules, {}, settings=lineage.result.settings)
    title = f"{campaign.settings.campaign}, payload of flight {flight}"
    draw_payload(files[1], read, title=title, tags=tags_of(origin, lineage))
    for one in read:
        table, data = (folder / f"{one.summary['node']}.{suffix}" for suffix in ("csv", "npy"))
        write_table(table, one.rows, digits=4)
        with replacement(data) as temporary, temporary.open("wb") as file:
            np.save(file, one.data)
        files += [table, data]
    record_files(campaign.root / lineage.result.manifest, files, lineage)
    return files


def print_payload(campaign: Campaign) -> list[Path]:
    """Print the frames of all flights; flights without an up-to-date result are read first.

    Raises
    ------
    CampaignError
        If the waveform has no frame format, or no node of a flight recorded a sidelink.
    """
    if not has_frames(JobScope(campaign, Scope.CAMPAIGN, ())):
        raise CampaignError(
            "no frame format",
            where=f"{CONFIG}: waveform.codes.frame",
            expected="waveform.codes with source: sidelink, constellation and frame",
            remedy="Describe header, counter and check sum of the transmitted frames.",
        )
    for where in outdated_places(campaign, "payload"):
        payload(campaign, *where)
    table, files, remarks = Table("flight", *PAYLOAD), list[Path](), list[str]()
    for flight in campaign.flights:
        folder = campaign.result(flight.name, "payload")
        report = open_listed(folder / "payload.json", folder / "payload.manifest.json")
        for summary in report["nodes"]:
            table.add_row(flight.name, *payload_row(summary))
            remarks += [f"{flight.name}, {summary['node']}: {remark}" for remark in summary["remarks"]]
        files += [folder / "payload.json", folder / "payload.png"]
    console = Console()
    console.print(table)
    for remark in remarks:
        console.print(remark, markup=False, highlight=False)
    return files


def payloads(campaign: Campaign, flight: str) -> list[NodePayload]:
    """Return the frames of all nodes that recorded a sidelink in a flight.

    Raises
    ------
    CampaignError
        If no node recorded a sidelink.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, OfdmWaveform):
        raise TypeError("the waveform has no symbols")
    sent, read = transmitted(campaign, waveform), list[NodePayload]()
    for node in campaign.flight(flight).recorded:
        recording = checked_recording(campaign, flight, node)
        if "sidelink" in recording.channels:
            raw = captures_of(recording, campaign, node=node)
            name, order = f"raw/{flight}/{node}", campaign.settings.iq_of(node)
            captured = Captured.of(raw, recording.samples.path, Path(name), name, sent, order=order)
            read.append(_payload(captured, sent, campaign.settings.processing.accuracy_db, node))
    if not read:
        raise CampaignError(
            f"no node recorded a channel named 'sidelink' in flight {flight}",
            where="raw",
            expected="a receiver with a sidelink, from which the symbols are decided",
            remedy="Correct apertura:channels.",
        )
    return read


def _payload(captured: Captured, sent: Transmitted, accuracy_db: Any, node: str) -> NodePayload:
    """Return the frames in the sidelink of a recording, decided block by block."""
    unknown = sent.unknown
    if unknown is None or unknown.frames is None:
        raise TypeError("the waveform has no frame format")
    symbols, parts, data = decided_symbols(captured, sent, accuracy_db), list[dict[str, NDArray[Any]]](), []
    check = DecisionCheck(symbols)
    for block in blocks_of(np.arange(len(captured.raw.start))):
        decisions = symbols.decisions(block)
        frames, detected = symbols.parsed(decisions), decisions.path.locked
        check.add(decisions)
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
    columns = {"time": captured.raw.time.values, **columns}
    summary = _summary(columns, unknown, sent.waveform.prf_hz)
    flags = check_flags(check, captured, sent, accuracy_db)
    explained = [f"{line}: {FLAGS[flag].meaning}. Advice: {FLAGS[flag].advice}." for flag, line in flags.items()]
    summary["remarks"] = explained + summary["remarks"]
    return NodePayload(columns, np.concatenate(data), {"node": node, **summary})


def _summary(columns: Mapping[str, NDArray[Any]], unknown: UnknownSymbols, prf_hz: float) -> dict[str, Any]:
    """Return numbers of frames and errors, medians of SNR and EVM, data rates, and remarks on counter and check sum."""
    qam, frames, seen = unknown.constellation, unknown.frames, columns["detected"]
    if frames is None:
        raise TypeError("the waveform has no frame format")
    counts = {"frames": seen.size, **{name: int(columns[name].sum()) for name in ("detected", "sure", "intact")}}
    time_s = seconds_since(columns["time"], columns["time"][0])
    count = FrameCount.of(columns["counter"], columns["intact"], time_s, prf_hz=prf_hz, bits=frames.counter_bits)
    received, rate_bit_s = min(counts["intact"] / count.sent, 1.0), frames.data_bits * prf_hz
    remarks = list[str]()
    if count.steps > count.agreeing == 0 and not np.ptp(columns["counter"][columns["intact"]]):
        remarks.append(f"the counter is {columns['counter'][columns['intact']][0]} in all intact frames.")
    elif count.agreeing < count.steps:
        remarks.append(
            f"the counter agrees with time tags and prf_hz in {count.agreeing} of {count.steps} steps from an intact "
            f"frame to the next; its median advance is {count.advance:g} per frame interval."
        )
    measured = dict[str, float | None](snr_db=None, evm_db=None, header_bit_error_rate=None)
    if seen.any():
        # eqs. 3 and 16
        expected = qam.symbol_error_rate(10 ** (columns["snr_db"][seen] / 10))
        measured = {name: round(float(np.median(columns[name][seen])), 2) for name in ("snr_db", "evm_db")}
        measured["header_bit_error_rate"] = float(columns["header_errors"][seen].mean() / frames.header.size)
        measured["symbol_error_rate_expected"] = float(f"{expected.mean():.3e}")
        lost = 1 - (1 - expected) ** (frames.total_bits // qam.bits_per_symbol)
        measured["frame_error_rate_expected"] = float(f"{lost.mean():.3e}")
        predicted = float((1 - lost)[columns["sure"][seen]].sum())
        if not counts["intact"] and predicted > _FEWEST_INTACT:
            remarks.append(
                f"no frame is intact, of {predicted:.1f} expected from the SNR. Advice: waveform.codes.frame; "
                "reflections of the sidelink."
            )
    return {
        "constellation": qam.name,
        **counts,
        "sent": count.sent,
        "lost": max(count.sent - counts["intact"], 0),
        "frame_error_rate": round(1 - received, 6),
        **measured,
        "data_bits_per_frame": frames.data_bits,
        "sent_bit_s": rate_bit_s,
        "received_bit_s": rate_bit_s * received,
        "remarks": remarks,
    }


def draw_payload(path: Path, read: Sequence[NodePayload], *, title: str, tags: Mapping[str, str]) -> None:
    """Plot SNR, error vector magnitude and lost frames of each node of a flight over time."""
    start, qam = min(one.columns["time"][0] for one in read), constellation(read[0].summary["constellation"])
    with sheet(path, 4.6, title=title, tags=tags) as figure:
        snr, evm = column_of(figure, 2)
        for number, (one, colour) in enumerate(zip(read, _COLOURS * len(read), strict=False)):
            time_s, node = seconds_since(one.columns["time"], start), one.summary["node"]
            drawn, lost = thinned(len(time_s)), np.flatnonzero(~one.columns["intact"])
            for axes, name in ((snr, "snr_db"), (evm, "evm_db")):
                axes.plot(time_s[drawn], one.columns[name][drawn], ".-", ms=2, lw=0.6, color=colour, label=node)
            # lost frames may have no SNR: marks at a constant height above the time axis
            marked = time_s[lost[thinned(len(lost))]] if len(lost) else lost
            height = np.full(len(marked), 0.04 + 0.05 * number)
            unrecorded = max(one.summary["sent"] - len(time_s), 0)
            label = f"{node}: {len(lost)} frames not intact, {unrecorded} not recorded"
            snr.plot(marked, height, "x", ms=4, color=colour, label=label, transform=snr.get_xaxis_transform())
        least_db, most_db = decibels(qam.least_snr), 2 * decibels(qam.decided(qam.least_snr).evm)
        snr.axhline(least_db, color="0.4", ls="--", label=f"least SNR of {qam.name}: {least_db:.1f} dB")
        evm.axhline(most_db, color="0.4", ls="--", label=f"EVM at the least SNR: {most_db:.1f} dB")
        snr.margins(y=0.2)
        snr.set(ylabel="SNR per subcarrier, dB", title=title)
        evm.set(ylabel="error vector magnitude, dB", xlabel="time since the first frame, s")
        for axes in (snr, evm):
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
