"""Rule `echo`: recordings and tracks of a pair become calibrated transfer functions and phase centres."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association, associate
from apertura.echo.demodulate import remove_path
from apertura.errors import CampaignError
from apertura.ingest import PHASE_HISTORIES
from apertura.load.recording import Recording, open_recording
from apertura.provenance import merged, sha256_file
from apertura.settings import OfdmWaveform, PathOffsets, PhaseHistoryWaveform, Processing
from apertura.steps.calibration import calibrated, calibration_spec
from apertura.steps.stamping import stamped
from apertura.steps.transfer import Transfer, by_code, by_sidelink
from apertura.store import save_stage


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    tx, rx = pair.split("-")
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    offset = calibrated(campaign, flight, pair)
    if isinstance(waveform, PhaseHistoryWaveform):
        files = list(campaign.raw_files(flight, rx).values())
        dataset = PHASE_HISTORIES[waveform.format](files, pair=pair)
    else:
        files = [campaign.root / waveform.codes]
        codes = _read_codes(files[0], waveform.subcarriers)
        recordings = {node: open_recording(campaign, flight, node, waveform) for node in {tx, rx}}
        parents = [stage for node in recordings.values() for stage in (node.raw, node.track)]
        dataset = _ofdm(recordings[tx], recordings[rx], codes, waveform, campaign.settings.processing, offset)
    inputs = {path.relative_to(campaign.root).as_posix(): sha256_file(path) for path in files}
    if offset:
        inputs = merged(inputs, offset["inputs"])
    relevant = {**campaign.relevant("echo", pair), "calibration": calibration_spec(offset)}
    folder = campaign.stage("echo", flight, pair)
    save_stage(stamped(dataset, "echo", modules=[__name__], parents=parents, settings=relevant, inputs=inputs), folder)
    return folder


def _read_codes(path: Path, subcarriers: int) -> NDArray[np.complex64]:
    try:
        codes = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"not readable ({error})", where=path, expected="a .npy file of code symbols", remedy="Copy it there."
        ) from error
    usable = codes.shape == (subcarriers,) and np.isfinite(codes).all() and np.abs(codes).min() > 0
    if not usable:
        raise CampaignError(
            f"{codes.dtype} of shape {codes.shape}, {int((codes == 0).sum())} of them zero",
            where=path,
            expected=f"({subcarriers},) complex64 without zeros, as config/config.yaml: waveform.subcarriers",
            remedy="Use the codes that were transmitted, or correct the waveform.",
        )
    return np.asarray(codes, np.complex64)


def _pulses(tx: Recording, rx: Recording, prf_hz: float) -> Association:
    tx_time, rx_time = (node.raw.time.values.astype("datetime64[ns]").astype(np.int64) for node in (tx, rx))
    return associate(
        tx_time,
        rx_time,
        repetition_interval_s=1 / prf_hz,
        tx_frame=tx.raw.frame.values,
        rx_frame=rx.raw.frame.values,
        where=f"{tx.files} and {rx.files}",
    )


def _ofdm(
    tx: Recording,
    rx: Recording,
    codes: NDArray[np.complex64],
    waveform: OfdmWaveform,
    processing: Processing,
    calibration: dict[str, Any] | None,
) -> xr.Dataset:
    pulses, monostatic = _pulses(tx, rx, waveform.prf_hz), tx.name == rx.name
    found = (
        by_code(rx, pulses, codes, waveform) if monostatic else by_sidelink(tx, rx, pulses, codes, waveform, processing)
    )
    offset_m = _offset_m(rx.settings.path_offset_m, monostatic=monostatic, calibration=calibration)
    flags, attrs = {**pulses.flags, **found.flags}, dict(found.report)
    if calibration:
        flags |= calibration["flags"]
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    attrs |= {
        "stated_offset_m": offset_m,
        "flags": flags,
        "pulses": {"used": len(found.rx_index), "dropped": len(tx.raw.time) - len(found.rx_index)},
    }
    variables = {**_echo_arrays(tx, rx, found, offset_m, waveform), **_axes(tx, rx, found)}
    return xr.Dataset(variables, attrs={"frame": "ecef", "pair": f"{tx.name}-{rx.name}", **attrs})


def _echo_arrays(
    tx: Recording, rx: Recording, found: Transfer, offset_m: float, waveform: OfdmWaveform
) -> dict[str, tuple[str | tuple[str, ...], NDArray[Any]]]:
    frequency = np.asarray(waveform.carrier_hz + rx.waveform.numbers * waveform.subcarrier_spacing_hz, np.float64)
    beyond_m = offset_m - found.sidelink_m  # path of an echo beyond tx → scene → rx
    transfer = remove_path(found.transfer, frequency, delay_s=np.asarray(beyond_m / SPEED_OF_LIGHT_M_S))
    return {
        "time": ("pulse", tx.raw.time.values[found.tx_index]),
        "tx_position": (("pulse", "axis"), tx.antenna("radar_tx", found.tx_index)),
        "rx_position": (("pulse", "axis"), rx.antenna("radar_rx", found.rx_index)),
        "transfer": (("pulse", "subcarrier"), transfer),
        "frequency": ("subcarrier", frequency),
        "reference_delay": ("pulse", np.zeros(len(found.rx_index))),
        "path_limit": ("pulse", SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s - beyond_m),
    }


def _axes(tx: Recording, rx: Recording, found: Transfer) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64]]]:
    """Return the body axes of the nodes whose antennas have a beam."""
    nodes = (
        ("tx_axes", tx, found.tx_index, tx.settings.antennas.radar_tx),
        ("rx_axes", rx, found.rx_index, rx.settings.antennas.radar_rx),
    )
    return {
        name: (("pulse", "axis", "body"), node.body_axes(index))
        for name, node, index, antenna in nodes
        if antenna is not None
    }


def _offset_m(stated: PathOffsets, *, monostatic: bool, calibration: dict[str, Any] | None) -> float:
    if calibration:
        return float(calibration["offset_m"])
    return stated.radar if monostatic else stated.radar - stated.sidelink
