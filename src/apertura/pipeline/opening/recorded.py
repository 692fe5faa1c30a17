"""The echo of a recorder that hands over transfer functions, as it lies in raw/; its positions may lie in a log."""

from typing import Any

import xarray as xr

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags.raised import Flags
from apertura.core.echo.dechirp import sweep_motion_flags
from apertura.core.echo.missing_pulses import missing_flags
from apertura.core.geometry.geodesy import LOCAL
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CONFIG
from apertura.pipeline.opening.node_log import raw_log, shortest_wave
from apertura.pipeline.opening.positions import place, stated_error
from apertura.pipeline.opening.reading import read_history


def recorded_echo(campaign: Campaign, flight: str, pair: str) -> xr.Dataset:
    """Return the echo of a pair as a recorder wrote it, at the times of its log's clock.

    Raises
    ------
    CampaignError
        If positions travel neither with the samples nor in a flight log, or do in both; or if the scene is in another
        frame than theirs.
    """
    tx, rx = pair.split("-")
    history = read_history(campaign, flight, rx, pair=pair)
    history = history.assign(time=("pulse", campaign.clock(flight, rx).utc(history.time.values)))
    logged, placed = campaign.logged(flight, tx), "tx_position" in history
    if logged == placed:
        found = "positions both with the samples and in a flight log" if logged else "samples without positions"
        expected = "positions of one source: phase history with positions, or a flight log raw/<flight>/<node>.track.*"
        where, remedy = (
            campaign.history_files(flight, rx)[0],
            "Take one away." if logged else "Copy the flight log there.",
        )
        raise CampaignError(found, where, expected, remedy)
    if logged:
        return _placed_by_logs(campaign, flight, (tx, rx), history)
    _check_frame(campaign.settings.scene.crs, history.attrs["frame"])
    nodes = campaign.settings.nodes
    known = {leg: stated_error(nodes[node]) | {"node": node} for leg, node in (("tx", tx), ("rx", rx))}
    return history.assign_attrs(positions=known)


def _check_frame(crs: str, frame: str) -> None:
    local = frame == LOCAL
    if local != (crs == LOCAL):
        raise CampaignError(
            f"{crs} for phase history with positions {'in metres of a frame of its own' if local else 'on Earth'}",
            where=f"{CONFIG}: scene.crs",
            expected=LOCAL if local else "an EPSG code, or auto",
            remedy="Correct scene.crs.",
        )


def _placed_by_logs(campaign: Campaign, flight: str, nodes: tuple[str, str], history: xr.Dataset) -> xr.Dataset:
    """Return phase history at the antennas' places, without the pulses that have none.

    The path of the receiving node beyond geometry (docs/theory.md, eq. 3) comes off the delay that samples are referred
    to: no sample changes.
    """
    wave_m = shortest_wave(history.frequency.values)
    logs = {node: raw_log(campaign, flight, node, wave_m) for node in nodes}
    tx, rx = (logs[node] for node in nodes)
    placed = place(tx, rx, history.time.values)
    history = history.isel(pulse=placed.good)
    at = history.time.values
    offset_s = rx.settings.path_offset_m.radar / SPEED_OF_LIGHT_M_S
    beams = {"tx_axes": (tx, tx.settings.antennas.radar_tx), "rx_axes": (rx, rx.settings.antennas.radar_rx)}
    axes: dict[str, Any] = {
        name: (("pulse", "axis", "body"), log.body_axes(at)) for name, (log, beam) in beams.items() if beam
    }
    left_out = {**history.attrs.get("dropped", {}), **placed.reasons}
    counts: dict[str, Any] = {"used": len(at), "dropped": sum(left_out.values()), "reasons": left_out}
    antennas = tx.antenna("radar_tx", at), rx.antenna("radar_rx", at)
    lasting_s = history.attrs.get("sweep_used_s", 0.0)
    missing = missing_flags(at.astype("datetime64[ns]").astype("int64"))
    moved = sweep_motion_flags(at, antennas, lasting_s=lasting_s, frequency_hz=history.frequency.values)
    return history.assign(
        reference_delay=history.reference_delay - offset_s,
        path_limit=history.path_limit - offset_s * SPEED_OF_LIGHT_M_S,
        tx_position=(("pulse", "axis"), antennas[0]),
        rx_position=(("pulse", "axis"), antennas[1]),
        **axes,
    ).assign_attrs(
        frame=tx.track.attrs["frame"],
        flags=Flags.merged(history.attrs["flags"], placed.flags, moved, missing),
        positions=placed.report,
        pulses=counts,
        stated_offset_m=rx.settings.path_offset_m.radar,
        time_tags={"std_s": rx.settings.time_tag_std_s},
    )
