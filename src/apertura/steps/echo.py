"""Rule `echo`: recordings and tracks of a pair become calibrated transfer functions and phase centres."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association
from apertura.echo.demodulate import remove_path
from apertura.echo.transfer import Transfer, transfer_by_code, transfer_by_sidelink
from apertura.ingest import read_phase_history
from apertura.load.acquisition import Acquisition, common_pulses, open_acquisition
from apertura.load.segments import keep_segments
from apertura.load.transmitted import read_codes, symbol_samples
from apertura.provenance import merged, sha256_file
from apertura.settings import OfdmWaveform, PhaseHistoryWaveform, Processing
from apertura.steps.calibration import calibrated, calibration_spec
from apertura.steps.stamping import stamped
from apertura.store import save_stage


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    calibration = calibrated(campaign, flight, pair)
    if isinstance(waveform, PhaseHistoryWaveform):
        files = list(campaign.raw_files(flight, pair.split("-")[1]).values())
        dataset = read_phase_history(waveform.format, files, pair=pair)
    else:
        files = [campaign.root / waveform.codes]
        codes = read_codes(files[0], waveform.subcarriers)
        tx, rx = pair.split("-")
        nodes = {node: open_acquisition(campaign, flight, node, waveform) for node in dict.fromkeys((tx, rx))}
        parents = [stage for node in nodes.values() for stage in (node.raw, node.track)]
        dataset = _echo(nodes[tx], nodes[rx], codes, waveform, campaign.settings.processing, calibration)
    dataset = keep_segments(campaign, flight, pair, dataset)
    inputs = {path.relative_to(campaign.root).as_posix(): sha256_file(path) for path in files}
    if calibration:
        inputs = merged(inputs, calibration["inputs"])
    relevant = {**campaign.relevant("echo", pair, flight=flight), "calibration": calibration_spec(calibration)}
    folder = campaign.stage("echo", flight, pair)
    save_stage(stamped(dataset, "echo", modules=[__name__], parents=parents, settings=relevant, inputs=inputs), folder)
    return folder


def _echo(
    tx: Acquisition,
    rx: Acquisition,
    codes: NDArray[np.complex64],
    waveform: OfdmWaveform,
    processing: Processing,
    calibration: dict[str, Any] | None,
) -> xr.Dataset:
    pulses = common_pulses(tx, rx, prf_hz=waveform.prf_hz)
    measured, sidelink_m = _transfer(tx, rx, pulses, codes, waveform, processing)
    offset_m = calibration["offset_m"] if calibration else _stated_offset_m(rx, monostatic=tx.name == rx.name)
    attrs = {
        "frame": "ecef",
        "pair": f"{tx.name}-{rx.name}",
        **measured.report,
        "stated_offset_m": offset_m,
        "flags": {**pulses.flags, **measured.flags},
        "pulses": {"used": len(measured.transfer), "dropped": len(tx.raw.time) - len(measured.transfer)},
    }
    if calibration:
        attrs["flags"] |= calibration["flags"]
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    index = pulses.tx_index[measured.kept], pulses.rx_index[measured.kept]
    beyond_m = offset_m - sidelink_m  # path of an echo beyond tx → scene → rx
    frequency, delay_s = rx.numerology.frequency_hz, beyond_m / SPEED_OF_LIGHT_M_S
    return xr.Dataset(
        {
            "time": ("pulse", tx.raw.time.values[index[0]]),
            "tx_position": (("pulse", "axis"), tx.antenna("radar_tx", index[0])),
            "rx_position": (("pulse", "axis"), rx.antenna("radar_rx", index[1])),
            "transfer": (("pulse", "subcarrier"), remove_path(measured.transfer, frequency, delay_s=delay_s)),
            "frequency": ("subcarrier", frequency),
            "reference_delay": ("pulse", np.zeros(len(beyond_m))),
            "path_limit": ("pulse", SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s - beyond_m),
            **_axes((tx, rx), index),
        },
        attrs=attrs,
    )


def _transfer(
    tx: Acquisition,
    rx: Acquisition,
    pulses: Association,
    codes: NDArray[np.complex64],
    waveform: OfdmWaveform,
    processing: Processing,
) -> tuple[Transfer, NDArray[np.float64]]:
    """Return what the pulses of a pair measured, and the sidelink's length (m) in those kept; 0 without one."""
    if tx.name == rx.name:
        measured = transfer_by_code(rx.captures("radar", pulses.rx_index), codes, rx.numerology)
        return measured, np.zeros(len(measured.transfer))
    ends = tx.antenna("sidelink", pulses.tx_index), rx.antenna("sidelink", pulses.rx_index)
    length_m = np.linalg.norm(ends[0] - ends[1], axis=1)
    measured = transfer_by_sidelink(
        {channel: rx.captures(channel, pulses.rx_index) for channel in ("radar", "sidelink")},
        codes,
        rx.numerology,
        symbol_samples=symbol_samples(waveform),
        sidelink_m=length_m,
        method=processing.sidelink,
        accuracy_db=processing.accuracy_db,
        where=str(rx.files),
    )
    return measured, length_m[measured.kept]


def _axes(
    nodes: tuple[Acquisition, Acquisition], index: tuple[NDArray[np.int64], NDArray[np.int64]]
) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64]]]:
    """Return the body axes of the nodes whose antennas have a beam."""
    beams = nodes[0].settings.antennas.radar_tx, nodes[1].settings.antennas.radar_rx
    return {
        name: (("pulse", "axis", "body"), node.body_axes(pulses))
        for name, node, pulses, beam in zip(("tx_axes", "rx_axes"), nodes, index, beams, strict=True)
        if beam is not None
    }


def _stated_offset_m(rx: Acquisition, *, monostatic: bool) -> float:
    stated = rx.settings.path_offset_m
    return stated.radar if monostatic else stated.radar - stated.sidelink
