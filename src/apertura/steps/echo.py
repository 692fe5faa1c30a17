"""Rule `echo`: recordings and tracks of a pair become calibrated transfer functions and phase centres."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association
from apertura.echo.association_edges import tag_jitter_s
from apertura.echo.demodulate import remove_path
from apertura.echo.missing_pulses import missing_flags
from apertura.echo.transfer import Transfer, transfer_by_code, transfer_by_sidelink
from apertura.ingest import read_phase_history
from apertura.lineage import result_of
from apertura.load.acquisition import Acquisition, Times, common_pulses, open_acquisition
from apertura.load.positions import Placed, place
from apertura.load.segments import keep_segments
from apertura.load.transmitted import read_codes, symbol_samples
from apertura.provenance import merged
from apertura.settings import OfdmWaveform, PhaseHistoryWaveform, Processing
from apertura.steps.calibration import calibrated, calibration_spec
from apertura.steps.stamping import stamped
from apertura.store import save_stage


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    lineage = result_of(campaign, "echo", flight, pair).begin(campaign.root, [__name__])
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    calibration = calibrated(campaign, flight, pair)
    if isinstance(waveform, PhaseHistoryWaveform):
        files = list(campaign.raw_files(flight, pair.split("-")[1]).values())
        dataset = read_phase_history(waveform.format, files, pair=pair)
    else:
        files = [campaign.codes_file]
        codes = read_codes(files[0], waveform.subcarriers)
        tx, rx = pair.split("-")
        nodes = {node: open_acquisition(campaign, flight, node, waveform) for node in dict.fromkeys((tx, rx))}
        parents = [stage for node in nodes.values() for stage in (node.raw, node.track)]
        dataset = pair_echo(nodes[tx], nodes[rx], codes, waveform, campaign.settings.processing, calibration)
    dataset = keep_segments(campaign, flight, pair, dataset)
    inputs = {name: lineage.sources.digests[name] for name in map(campaign.relative, files)}
    if calibration:
        inputs = merged(inputs, calibration["inputs"])
    relevant = {**campaign.relevant("echo", pair, flight=flight), "calibration": calibration_spec(calibration)}
    folder = campaign.stage("echo", flight, pair)
    stage = stamped(dataset, "echo", modules=[__name__], parents=parents, settings=relevant, inputs=inputs)
    save_stage(stage, folder, lineage=lineage)
    return folder


def pair_echo(
    tx: Acquisition,
    rx: Acquisition,
    codes: NDArray[np.complex64],
    waveform: OfdmWaveform,
    processing: Processing,
    calibration: dict[str, Any] | None,
) -> xr.Dataset:
    """Return the echo of a pair from what its nodes recorded; path offsets are the calibration's, or the config's."""
    pulses = common_pulses(tx, rx, prf_hz=waveform.prf_hz)
    paired = np.flatnonzero(~pulses.outlier)
    placed = place(tx, rx, tx.raw.time.values[pulses.tx_index[paired]])
    paired = paired[placed.good]
    at = tx.raw.time.values[pulses.tx_index[paired]]
    measured, sidelink_m = _transfer(
        (tx, rx), pulses.rx_index[paired], at, codes, waveform=waveform, processing=processing
    )
    at = at[measured.kept]
    offset_m = calibration["offset_m"] if calibration else _stated_offset_m(rx, monostatic=tx.name == rx.name)
    beyond_m = offset_m - sidelink_m  # path of an echo beyond tx → scene → rx
    frequency, delay_s = rx.numerology.frequency_hz, beyond_m / SPEED_OF_LIGHT_M_S
    return xr.Dataset(
        {
            "time": ("pulse", at),
            "tx_position": (("pulse", "axis"), tx.antenna("radar_tx", at)),
            "rx_position": (("pulse", "axis"), rx.antenna("radar_rx", at)),
            "transfer": (("pulse", "subcarrier"), remove_path(measured.transfer, frequency, delay_s=delay_s)),
            "frequency": ("subcarrier", frequency),
            "reference_delay": ("pulse", np.zeros(len(beyond_m))),
            "path_limit": ("pulse", SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s - beyond_m),
            **({} if measured.sidelink_delay_m is None else {"sidelink_delay": ("pulse", measured.sidelink_delay_m)}),
            **_axes((tx, rx), at),
        },
        attrs=_attributes((tx, rx), pulses, placed, measured, at=at, calibration=calibration)
        | {"stated_offset_m": offset_m},
    )


def _attributes(
    nodes: tuple[Acquisition, Acquisition],
    pulses: Association,
    placed: Placed,
    measured: Transfer,
    *,
    at: Times,
    calibration: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return what was found on the way to the pulses used, those sent `at`: edges crossed, pulses left out."""
    missing = missing_flags(at.astype("datetime64[ns]").astype(np.int64))
    attrs = {
        "frame": "ecef",
        "pair": "-".join(node.name for node in nodes),
        **measured.report,
        "positions": placed.report,
        "time_tags": _time_tags(nodes[0], pulses),
        "flags": {**pulses.flags, **placed.flags, **measured.flags, **missing},
        "pulses": _counted(len(nodes[0].raw.time), pulses, placed, measured),
    }
    if calibration:
        attrs["flags"] |= calibration["flags"]
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    return attrs


def _transfer(
    nodes: tuple[Acquisition, Acquisition],
    captures: NDArray[np.int64],
    at: Times,
    codes: NDArray[np.complex64],
    *,
    waveform: OfdmWaveform,
    processing: Processing,
) -> tuple[Transfer, NDArray[np.float64]]:
    """Return what some captures, sent `at` the transmitter's tags, measured, and the sidelink's length (m); 0 without.

    Both of its ends are where the logs put them at the transmitter's tag (docs/theory.md, "Geometry").
    """
    tx, rx = nodes
    if tx.name == rx.name:
        radar, sent_ns = rx.captures("radar", captures), at.astype("datetime64[ns]").astype(np.int64)
        measured = transfer_by_code(radar, codes, rx.numerology, time_s=(sent_ns - sent_ns[0]) * 1e-9)
        return measured, np.zeros(len(measured.transfer))
    length_m = np.linalg.norm(tx.antenna("sidelink", at) - rx.antenna("sidelink", at), axis=1)
    measured = transfer_by_sidelink(
        {channel: rx.captures(channel, captures) for channel in ("radar", "sidelink")},
        codes,
        rx.numerology,
        symbol_samples=symbol_samples(waveform),
        sidelink_m=length_m,
        method=processing.sidelink,
        accuracy_db=processing.asked_db,
        where=str(rx.files),
    )
    return measured, length_m[measured.kept]


def _time_tags(tx: Acquisition, pulses: Association) -> dict[str, Any]:
    """Return how the nodes' tags lie to each other, and what is known of the transmitter's own errors."""
    return {
        **{name: getattr(pulses, name) for name in ("offset_s", "drift_ppm", "residual_s", "method")},
        "std_s": tx.settings.time_tag_std_s,
        "jitter_s": tag_jitter_s(tx.raw.time.values.astype("datetime64[ns]").astype(np.int64)),
    }


def _counted(sent: int, pulses: Association, placed: Placed, measured: Transfer) -> dict[str, Any]:
    """Return how many of the pulses sent are used, how many not, and why."""
    used = len(measured.transfer)
    reasons = {
        "unpaired": pulses.tx_dropped,
        "time_tag_outlier": int(pulses.outlier.sum()),
        **placed.reasons,
        "sidelink_lost": int((~measured.kept).sum()),
    }
    return {"used": used, "dropped": sent - used, "reasons": {why: count for why, count in reasons.items() if count}}


def _axes(nodes: tuple[Acquisition, Acquisition], at: Times) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64]]]:
    """Return the body axes of the nodes whose antennas have a beam."""
    beams = nodes[0].settings.antennas.radar_tx, nodes[1].settings.antennas.radar_rx
    return {
        name: (("pulse", "axis", "body"), node.body_axes(at))
        for name, node, beam in zip(("tx_axes", "rx_axes"), nodes, beams, strict=True)
        if beam is not None
    }


def _stated_offset_m(rx: Acquisition, *, monostatic: bool) -> float:
    stated = rx.settings.path_offset_m
    return stated.radar if monostatic else stated.radar - stated.sidelink
