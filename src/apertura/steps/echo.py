"""Rule `echo`: recordings and tracks of a pair become calibrated transfer functions and phase centres."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association, associate, detect_wrong_association
from apertura.echo.captures import CODE_SIGMA, SATURATED_SHARE, code_contrast_sigma, saturated_share
from apertura.echo.clock import decide_clock, estimate_clock
from apertura.echo.demodulate import remove_path
from apertura.echo.resampling import Waveform, correct_clock
from apertura.echo.sidelink import METHODS, choose, edges, measure
from apertura.echo.sidelink_state import SidelinkState
from apertura.errors import CampaignError
from apertura.ingest import PHASE_HISTORIES
from apertura.provenance import merged, sha256_file
from apertura.settings import OfdmWaveform, PathOffsets, PhaseHistoryWaveform, Processing
from apertura.steps.calibration import calibrated, calibration_spec
from apertura.steps.recording import Recording, open_recording
from apertura.steps.stamping import stamped
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
    save_stage(stamped(dataset, "echo", module=__name__, parents=parents, settings=relevant, inputs=inputs), folder)
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
    pulses = _pulses(tx, rx, waveform.prf_hz)
    tx_index, rx_index = pulses.tx_index, pulses.rx_index
    symbol = round((waveform.cyclic_prefix_s + waveform.symbol_s) * waveform.sample_rate_hz)
    iq = {name: rx.captures(name, rx_index) for name in (["radar"] if tx.name == rx.name else ["radar", "sidelink"])}
    flags: dict[str, str] = {**pulses.flags, **_saturation(iq)}
    attrs: dict[str, Any] = {}
    captured = {name: _complex(samples[:, :symbol]) for name, samples in iq.items()}
    offset_m = _offset_m(rx.settings.path_offset_m, monostatic=tx.name == rx.name, calibration=calibration)
    beyond_m = np.full(len(rx_index), offset_m)  # path of an echo beyond tx → scene → rx
    if tx.name == rx.name:
        transfer = rx.symbols(captured["radar"]) / codes
        flags |= _code_fits(transfer, waveform)
    else:
        captured, attrs["clock"], crossed = _clock_corrected(captured, rx.waveform, processing.accuracy_db)
        flags |= crossed
        transfer, direct = (rx.symbols(captured[name]) / codes for name in ("radar", "sidelink"))
        length_m = np.linalg.norm(tx.antenna("sidelink", tx_index) - rx.antenna("sidelink", rx_index), axis=1)
        state = measure(direct, where=f"{rx.files}: sidelink")
        attrs["sidelink"], crossed = _sidelink_report(state, processing.sidelink, length_m, waveform)
        flags |= crossed
        locked = state.locked
        transfer = METHODS[attrs["sidelink"]["method"]](transfer[locked], direct[locked])
        beyond_m = (beyond_m - length_m)[locked]
        tx_index, rx_index = tx_index[locked], rx_index[locked]
    frequency = np.asarray(waveform.carrier_hz + rx.waveform.numbers * waveform.subcarrier_spacing_hz, np.float64)
    sent = len(tx.raw.time)
    if calibration:
        flags |= calibration["flags"]
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    attrs |= {
        "stated_offset_m": offset_m,
        "flags": flags,
        "pulses": {"used": len(rx_index), "dropped": sent - len(rx_index)},
    }
    return xr.Dataset(
        {
            "time": ("pulse", tx.raw.time.values[tx_index]),
            "tx_position": (("pulse", "axis"), tx.antenna("radar_tx", tx_index)),
            "rx_position": (("pulse", "axis"), rx.antenna("radar_rx", rx_index)),
            "transfer": (
                ("pulse", "subcarrier"),
                remove_path(transfer, frequency, delay_s=np.asarray(beyond_m / SPEED_OF_LIGHT_M_S)),
            ),
            "frequency": ("subcarrier", frequency),
            "reference_delay": ("pulse", np.zeros(len(rx_index))),
            "path_limit": ("pulse", SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s - beyond_m),
            **{
                name: (("pulse", "axis", "body"), node.body_axes(index))
                for name, node, index, antenna in (
                    ("tx_axes", tx, tx_index, tx.settings.antennas.radar_tx),
                    ("rx_axes", rx, rx_index, rx.settings.antennas.radar_rx),
                )
                if antenna is not None
            },
        },
        attrs={"frame": "ecef", "pair": f"{tx.name}-{rx.name}", **attrs},
    )


def _offset_m(stated: PathOffsets, *, monostatic: bool, calibration: dict[str, Any] | None) -> float:
    if calibration:
        return float(calibration["offset_m"])
    return stated.radar if monostatic else stated.radar - stated.sidelink


def _complex(iq: NDArray[np.int16]) -> NDArray[np.complex64]:
    return np.ascontiguousarray(iq, np.float32).view(np.complex64)[..., 0]


def _saturation(iq: dict[str, NDArray[np.int16]]) -> dict[str, str]:
    shares = {name: saturated_share(samples) for name, samples in iq.items()}
    return {
        f"saturated_{name}": f"{100 * share:.2f} % of the samples of channel {name} sit at the converter's end stops"
        for name, share in shares.items()
        if share > SATURATED_SHARE
    }


def _code_fits(transfer: NDArray[np.complex64], waveform: OfdmWaveform) -> dict[str, str]:
    bandwidth_hz = waveform.subcarriers * waveform.subcarrier_spacing_hz
    found = code_contrast_sigma(transfer, prefix_cells=round(waveform.cyclic_prefix_s * bandwidth_hz))
    if found >= CODE_SIGMA:
        return {}
    line = f"energy inside the prefix stands {found:.1f} σ out of an even spread, {CODE_SIGMA} σ expected: "
    return {"code_unconfirmed": line + "the codes file is wrong, or no echo rises above the noise"}


def _clock_corrected(
    captured: dict[str, NDArray[np.complex64]], waveform: Waveform, accuracy_db: float
) -> tuple[dict[str, NDArray[np.complex64]], dict[str, Any], dict[str, str]]:
    """Correct the receiver's clock in the samples where it matters; return also what was found, and flags."""
    try:
        clock = estimate_clock(captured["sidelink"], waveform)
    except ValueError as error:
        return captured, {"corrected": False, "reason": str(error)}, {"clock_unmeasured": str(error)}
    decision = decide_clock(clock, waveform, accuracy_db=accuracy_db)
    report = {"corrected": decision.correct, "reason": decision.reason, "floor_db": round(decision.floor_db, 2)}
    if decision.correct:
        cfo_hz = clock.cfo_of_pulses_hz(len(captured["sidelink"]))
        captured = {
            name: correct_clock(samples, waveform, cfo_hz=cfo_hz, sfo_ppm=clock.sfo_ppm)
            for name, samples in captured.items()
        }
    return captured, report, dict(decision.flags)


def _sidelink_report(
    state: SidelinkState, asked: str, length_m: NDArray[np.float64], waveform: OfdmWaveform
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what was chosen and measured, and the edges that were crossed."""
    method, reason = choose(state) if asked == "auto" else (asked, "asked for in config/config.yaml")
    cell_m = SPEED_OF_LIGHT_M_S / (waveform.subcarriers * waveform.subcarrier_spacing_hz)
    wrong = detect_wrong_association(state.delay_cells * cell_m, length_m)
    lock_rate = float(state.locked.mean())
    flags = {**state.flags, **edges(method, state)}
    if wrong:
        flags["association_suspect"] = wrong
    report = {
        "method": method,
        "reason": reason,
        "lock_rate": round(lock_rate, 4),
        "snr_db": round(state.snr_db, 2),
        "echo_db": round(state.echo_db, 2),
    }
    return report, flags
