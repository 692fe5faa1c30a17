"""Rule `echo`: recordings and tracks of a pair become calibrated transfer functions and phase centres."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association, associate, detect_wrong_association
from apertura.echo.demodulate import demodulate, remove_path, subcarrier_numbers
from apertura.echo.geometry import phase_centres
from apertura.echo.sidelink import METHODS, choose, edges, measure
from apertura.echo.sidelink_state import SidelinkState
from apertura.errors import CampaignError
from apertura.ingest import PHASE_HISTORIES
from apertura.provenance import sha256_file
from apertura.settings import Node, OfdmWaveform, PhaseHistoryWaveform
from apertura.steps.stamping import stamped
from apertura.store import open_stage, save_stage


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    tx, rx = pair.split("-")
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    if isinstance(waveform, PhaseHistoryWaveform):
        files = list(campaign.raw_files(flight, rx).values())
        dataset = PHASE_HISTORIES[waveform.format](files, pair=pair)
    else:
        files = [campaign.root / waveform.codes]
        codes = _read_codes(files[0], waveform.subcarriers)
        recordings = {node: _open(campaign, flight, node, waveform) for node in {tx, rx}}
        parents = [stage for node in recordings.values() for stage in (node.raw, node.track)]
        sidelink = campaign.settings.processing.sidelink
        dataset = _ofdm(recordings[tx], recordings[rx], codes, waveform, sidelink=sidelink)
    inputs = {path.relative_to(campaign.root).as_posix(): sha256_file(path) for path in files}
    relevant = campaign.relevant("echo", pair)
    folder = campaign.stage("echo", flight, pair)
    save_stage(stamped(dataset, "echo", module=__name__, parents=parents, settings=relevant, inputs=inputs), folder)
    return folder


@dataclass(frozen=True)
class Recording:
    """What one node recorded in one flight."""

    name: str
    raw: xr.Dataset
    track: xr.Dataset
    settings: Node
    files: Path

    def symbols(self, channel: str, pulses: NDArray[np.int64], waveform: OfdmWaveform) -> NDArray[np.complex64]:
        """Return the code symbols received on a channel, (pulse, subcarrier) complex64."""
        channels = self.raw.attrs["channels"]
        if channel not in channels:
            raise CampaignError(
                f"channels {channels}",
                where=f"{self.files}.sigmf-meta: apertura:channels",
                expected=f"a channel named {channel!r}",
                remedy="A secondary node needs its sidelink; name the channel or take the node out of the flight.",
            )
        prefix, dft = (
            round(waveform.cyclic_prefix_s * waveform.sample_rate_hz),
            round(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz),
        )
        iq = self.raw.iq.isel(channel=channels.index(channel)).values[pulses]
        if iq.shape[1] < prefix + dft:
            raise CampaignError(
                f"captures of {iq.shape[1]} samples",
                where=f"{self.files}.sigmf-meta",
                expected=f"at least {prefix + dft}: cyclic prefix and one period of 1/subcarrier_spacing_hz",
                remedy="Correct the waveform in config/config.yaml or record longer captures.",
            )
        numbers = subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is)
        return demodulate(iq, numbers=numbers, prefix_samples=prefix, dft_samples=dft)

    def antenna(
        self, name: Literal["radar_tx", "radar_rx", "sidelink"], pulses: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the ECEF position of an antenna at the node's own time tags, (pulse, 3) float64 metres."""
        return phase_centres(
            self.track.time.values,
            self.track.position.values,
            self.track.attitude.values,
            at=self.raw.time.values[pulses],
            lever_arm_m=getattr(self.settings.lever_arms_m, name),
            attitude_from=self.settings.attitude,
            where=f"{self.files}.track",
        )


def _open(campaign: Campaign, flight: str, node: str, waveform: OfdmWaveform) -> Recording:
    raw, track = (open_stage(campaign.stage(stage, flight, node), stage) for stage in ("raw", "track"))
    files = Path("raw") / flight / node
    for key, found in (("sample_rate_hz", raw.attrs["sample_rate_hz"]), ("carrier_hz", raw.attrs["frequency_hz"])):
        asked = getattr(waveform, key)
        if abs(found - asked) > 1e-9 * asked:
            raise CampaignError(
                f"recorded with {key} {found:.6f}",
                where=f"{files}.sigmf-meta",
                expected=f"{asked:.6f}, as config/config.yaml: waveform.{key}",
                remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
            )
    return Recording(node, raw, track, campaign.settings.nodes[node], files)


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
    tx: Recording, rx: Recording, codes: NDArray[np.complex64], waveform: OfdmWaveform, *, sidelink: str
) -> xr.Dataset:
    pulses = _pulses(tx, rx, waveform.prf_hz)
    tx_index, rx_index = pulses.tx_index, pulses.rx_index
    flags, attrs = dict(pulses.flags), {}
    transfer = rx.symbols("radar", rx_index, waveform) / codes
    beyond_m = np.full(len(rx_index), rx.settings.path_offset_m.radar)  # path of an echo beyond tx → scene → rx
    if tx.name != rx.name:
        direct = rx.symbols("sidelink", rx_index, waveform) / codes
        length_m = np.linalg.norm(tx.antenna("sidelink", tx_index) - rx.antenna("sidelink", rx_index), axis=1)
        state = measure(direct, where=f"{rx.files}: sidelink")
        attrs["sidelink"], crossed = _sidelink_report(state, sidelink, length_m, waveform)
        flags |= crossed
        locked = state.locked
        transfer = METHODS[attrs["sidelink"]["method"]](transfer[locked], direct[locked])
        beyond_m = (beyond_m - rx.settings.path_offset_m.sidelink - length_m)[locked]
        tx_index, rx_index = tx_index[locked], rx_index[locked]
    step = subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is)
    frequency = np.asarray(waveform.carrier_hz + step * waveform.subcarrier_spacing_hz, np.float64)
    sent = len(tx.raw.time)
    attrs |= {"flags": flags, "pulses": {"used": len(rx_index), "dropped": sent - len(rx_index)}}
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
        },
        attrs={"frame": "ecef", "pair": f"{tx.name}-{rx.name}", **attrs},
    )


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
