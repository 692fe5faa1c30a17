"""Geometry, beams and phase history of a pair, from its echo, or from the flight logs before the echo is formed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Antenna, SampledWaveform, is_monostatic
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.common.units import seconds_since
from apertura.core.antenna.beam import LIMITS_RAD, Beam, Beams, antenna_axes, gaussian_cut, sampled_cut, sampled_phase
from apertura.core.antenna.illumination import Illumination, illuminate
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.gate import RangeGate
from apertura.core.imaging.range_profiles import phase_history_of
from apertura.core.quality.budget import NodePositions
from apertura.core.quality.path_errors import Effect
from apertura.formats.beam_pattern import read_beam_pattern
from apertura.formats.reading import open_recording
from apertura.stages.node_log import NodeLog, raw_log, shortest_wave
from apertura.stages.positions import inside_segments, keep_segments, place, position_error, scene_air
from apertura.stages.scene import Flown, OpenScene
from apertura.stages.transfer import PairEcho, recorded_echo
from apertura.stages.transmitted import transmitted

# ---- Antennas of a pair: from the config to the beams that weight pulses ---------------------------------------------

_AXES_VARIABLES = {"radar_tx": "tx_axes", "radar_rx": "rx_axes"}
_POINTS = 33


def body_axes(echo: xr.Dataset) -> dict[str, NDArray[np.float64]]:
    """Return the body axes of an echo stage: radar_tx, radar_rx → (pulse, axis, body)."""
    return {point: echo[name].values for point, name in _AXES_VARIABLES.items() if name in echo}


def beams_of(campaign: Campaign, pair: str, axes: Mapping[str, NDArray[np.float64]]) -> Beams | None:
    """Return the beams of a pair; None if its antennas are isotropic.

    Parameters
    ----------
    campaign, pair
        Campaign, and name of the pair.
    axes
        radar_tx, radar_rx → (pulse, axis, body), forward, right and down of the body in the frame of the pixels.
    """
    stated = campaign.antennas(pair)
    if not stated:
        return None
    patterns = campaign.pattern_files(pair)
    files = {point: patterns.get(f"nodes.{node}.antennas.{point}.pattern") for point, (node, _) in stated.items()}
    beams = {point: _beam(antenna, files[point], axes[point]) for point, (_, antenna) in stated.items()}
    return Beams(beams.get("radar_tx"), beams.get("radar_rx"))


def pattern_digests(campaign: Campaign, pair: str) -> dict[str, str]:
    """Return config key → SHA-256 of each sampled pattern of a pair's antennas, for provenance."""
    return {key: sha256_file(path) for key, path in campaign.pattern_files(pair).items()}


def _beam(antenna: Antenna, pattern: Path | None, axes: NDArray[np.float64]) -> Beam:
    if antenna.beamwidth_deg is None:
        if pattern is None:
            raise TypeError("antenna without beamwidth and pattern")
        sampled = read_beam_pattern(pattern)
        cuts = tuple(sampled_cut(angle, gain, cutoff_db=antenna.cutoff_db) for angle, gain, _ in sampled)
        phases = [
            None if phase is None else sampled_phase(angle, phase, cut[0])
            for (angle, _, phase), cut in zip(sampled, cuts, strict=True)
        ]
    else:
        widths = zip(antenna.beamwidth_deg, LIMITS_RAD.values(), strict=True)
        azimuth, elevation = (
            gaussian_cut(width, cutoff_db=antenna.cutoff_db, limit_rad=limit) for width, limit in widths
        )
        cuts, phases = (azimuth, elevation), [None, None]
    return Beam(antenna_axes(axes, antenna.boresight_deg), *cuts[0], *cuts[1], *phases)


def antennas_report(campaign: Campaign, pair: str, illumination: Illumination | None) -> dict[str, Any]:
    """Return the antennas of a pair for image.json: configured values, and numbers of pulses that illuminate points."""
    stated = {point: {"node": node, **beam.model_dump()} for point, (node, beam) in campaign.antennas(pair).items()}
    if illumination is None or not stated:
        return {}
    return {"antennas": {**stated, "illuminating_pulses": {**illumination.counts, "of": illumination.pulses}}}


def scene_illumination(
    campaign: Campaign,
    pair: str,
    beams: Beams | None,
    scene: OpenScene,
    aperture: Aperture,
) -> Illumination | None:
    """Count the pulses that illuminate points of the scene; None without beams.

    Parameters
    ----------
    campaign, pair
        Campaign, and name of the pair.
    beams
        Beams of the pair.
    scene
        Scene of the campaign.
    aperture
        Aperture of the pair.

    Raises
    ------
    CampaignError
        If no pulse illuminates any point of the scene.
    """
    if beams is None:
        return None
    points = scene.grid.sample_points(_POINTS, scene.level.height_m)
    illumination = illuminate(beams, aperture, points.reshape(-1, 3))
    if illumination.unilluminated == 1:
        _raise_unilluminated(campaign, pair, beams, points[points.shape[0] // 2, points.shape[1] // 2], aperture)
    return illumination


def _raise_unilluminated(
    campaign: Campaign,
    pair: str,
    beams: Beams,
    middle_m: NDArray[np.float64],
    aperture: Aperture,
) -> None:
    """Raise an error whose message contains the smallest angle of each antenna between boresight and scene centre."""
    stated = campaign.antennas(pair)
    keys, lines = [f"nodes.{node}.antennas.{point}" for point, (node, _) in stated.items()], []
    legs = {"radar_tx": (beams.transmit, aperture.tx_m), "radar_rx": (beams.receive, aperture.rx_m)}
    for point, (node, _) in stated.items():
        beam, antenna_m = legs[point]
        if beam is None:
            continue
        azimuth, elevation = beam.angles(antenna_m, middle_m[None])[..., 0]
        off = np.degrees(np.arccos(np.cos(azimuth) * np.cos(elevation)))
        best = int(off.argmin())
        side, up, *ends = np.degrees([azimuth[best], elevation[best], beam.azimuth_rad[-1], beam.elevation_rad[-1]])
        lines.append(
            f"at least {off[best]:.0f}° from the boresight of {node}'s {point} (azimuth {side:+.0f}°, elevation "
            f"{up:+.0f}°; the pattern ends at {ends[0]:.0f}° and {ends[1]:.0f}°)"
        )
    raise CampaignError(
        f"no pulse illuminates the scene: its centre is {' and '.join(lines)}",
        where=f"config/config.yaml: {', '.join(keys)}",
        expected="a scene that both antennas illuminate during at least one pulse",
        remedy="Check boresight_deg (azimuth clockwise from forward: right is +90; elevation: down is negative), the "
        "log's yaw (clockwise from north) and scene.bounds_m.",
    )


# ---- Pair, opened from its echo, or from the flight logs before the echo is formed -----------------------------------


@dataclass(frozen=True, eq=False)
class OpenPair:
    """Pair with its geometry, band, position errors and, once its echo is formed, its phase history.

    Attributes
    ----------
    flight, name
        Flight, and name of the pair as transmitter-receiver.
    aperture
        Phase centres.
    frequency_hz, weight
        (subcarrier,) float64, RF frequency and window.
    path_limits_m
        (pulse,) float64, longest total path inside the cyclic prefix.
    time_s
        (pulse,) float64, seconds from the first pulse.
    began
        Time of the first pulse, UTC.
    positions
        Position accuracy of the node, or of transmitter and receiver.
    history
        Phase history; None before the echo is formed.
    beams
        Antenna beams; None if the antennas are isotropic.
    gate
        Gate of the recorded paths, from `apertura.stages.planning.gated`; None if all echoes of the scene are recorded.
    axes
        Body axes as in `beams_of`, for the antennas that are affected by attitude.
    sidelink_m
        (pulse, 3) float64, metres, from the receiver's sidelink antenna to the transmitter's; None if no sidelink
        length was added to the echo, and before the echo is formed.
    left
        Residual effect of position errors after track refinement; None if the tracks are those of the logs.
    report
        Attributes of stage echo; empty before the echo is formed.
    wave_speed_m_s
        Wave speed along the paths.
    air
        Report on the atmosphere along the paths, as in stage echo.
    """

    flight: str
    name: str
    aperture: Aperture
    frequency_hz: NDArray[np.float64]
    weight: NDArray[np.float64]
    path_limits_m: NDArray[np.float64]
    time_s: NDArray[np.float64]
    began: np.datetime64
    positions: tuple[NodePositions, ...]
    history: PhaseHistory | None = None
    beams: Beams | None = None
    gate: RangeGate | None = None
    axes: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    sidelink_m: NDArray[np.float64] | None = None
    left: Effect | None = None
    report: Mapping[str, Any] = field(default_factory=dict)
    wave_speed_m_s: float = field(kw_only=True)
    air: Mapping[str, Any] = field(kw_only=True)

    @property
    def monostatic(self) -> bool:
        """True if one node transmits and receives."""
        tx, rx = self.name.split("-")
        return tx == rx

    @property
    def path_limit_m(self) -> float:
        """Longest total path inside the cyclic prefix of every pulse."""
        return float(self.path_limits_m.min())

    @property
    def flown(self) -> Flown:
        """Geometry and band from which `auto` derives the grid."""
        return Flown(self.aperture, self.frequency_hz, self.path_limit_m)


def open_pair(
    campaign: Campaign, flight: str, pair: str, *, echo: xr.Dataset | None = None, recorded: Times | None = None
) -> OpenPair:
    """Open a pair from its stage `echo` if it is formed, else from the flight logs.

    If `recorded`, the time tags of pulses recorded by both nodes, is given, the logs are used even if the stage is
    formed.
    """
    waveform = campaign.settings.waveform
    if echo is None and recorded is None and campaign.is_current(campaign.stage("echo", flight, pair)):
        echo = PairEcho.cleaned(campaign, flight, pair).stage
    if echo is None:
        if isinstance(waveform, SampledWaveform):
            return _expected(campaign, flight, pair, waveform, recorded)
        echo = keep_segments(campaign, flight, pair, recorded_echo(campaign, flight, pair))
    history = phase_history_of(echo, campaign.settings.processing.window, lazy=True)
    axes = body_axes(echo)
    stated = echo.attrs.get("positions", {})
    legs = ("tx",) if is_monostatic(pair) else ("tx", "rx")  # one node has one position
    return OpenPair(
        flight,
        pair,
        history.aperture,
        history.frequency_hz,
        history.weight,
        echo.path_limit.values,
        time_s=seconds_since(echo.time.values, echo.time.values[0]),
        began=echo.time.values[0],
        positions=tuple(_positions(stated.get(leg, {})) for leg in legs),
        history=history,
        beams=beams_of(campaign, pair, axes),
        axes=axes,
        sidelink_m=echo.sidelink_vector.values if "sidelink_vector" in echo else None,
        report=echo.attrs,
        wave_speed_m_s=history.wave_speed_m_s,
        air=echo.attrs["atmosphere"],
    )


def _expected(
    campaign: Campaign, flight: str, pair: str, waveform: SampledWaveform, recorded: Times | None
) -> OpenPair:
    """Return the pair expected from the logs: the pulses with positions in both logs, without pulses during hovers."""
    frequency = transmitted(campaign, waveform).numerology.frequency_hz
    tx, rx = (raw_log(campaign, flight, node, shortest_wave(frequency)) for node in pair.split("-"))
    first = max(log.track.time.values[0] for log in (tx, rx))
    last = min(log.track.time.values[-1] for log in (tx, rx))
    if recorded is None:
        recorded = open_recording(campaign.recording_files(flight, tx.name)).captures.time
        recorded = campaign.clock(flight, tx.name).utc(recorded)
    if len(recorded) < 2:
        count = int((last - first) / np.timedelta64(1, "s") * waveform.prf_hz) + 1
        recorded = first + (1e9 / waveform.prf_hz * np.arange(count)).astype("timedelta64[ns]")
    times = recorded[(recorded >= first) & (recorded <= last)]
    times = times[inside_segments(campaign, flight, pair, times)]
    times = times[place(tx, rx, times, hovers=bool(campaign.segments_of(flight, pair))).good]
    return expected_pair(campaign, flight, (tx, rx), times, frequency_hz=frequency, delay_s=waveform.longest_delay_s)


def expected_pair(
    campaign: Campaign,
    flight: str,
    nodes: tuple[NodeLog, NodeLog],
    times: NDArray[np.datetime64],
    *,
    frequency_hz: NDArray[np.float64],
    delay_s: float,
) -> OpenPair:
    """Return a pair from logs or planned tracks, before its echo is formed.

    Parameters
    ----------
    campaign, flight
        Campaign, and name of the flight.
    nodes
        Logs or planned tracks of transmitter and receiver.
    times
        (pulse,) datetime64[ns], UTC, within both logs.
    frequency_hz
        (subcarrier,) float64, ascending.
    delay_s
        Longest delay of an echo that is recorded completely.
    """
    tx, rx = nodes
    rotating = {"radar_tx": tx.turns("radar_tx") and tx, "radar_rx": rx.turns("radar_rx") and rx}
    axes = {antenna: log.body_axes(times) for antenna, log in rotating.items() if log}
    offset = rx.settings.path_offset_m
    extra_path_m = np.full(len(times), offset.radar)
    if tx.name != rx.name:
        length_m = np.linalg.norm(tx.antenna("sidelink", times) - rx.antenna("sidelink", times), axis=1)
        extra_path_m -= offset.sidelink + length_m
    weight = window_weights(campaign.settings.processing.window, len(frequency_hz))
    aperture = Aperture(tx.antenna("radar_tx", times), rx.antenna("radar_rx", times))
    air_on_track = scene_air(campaign, aperture.tx_m).over(aperture)
    limits_m = air_on_track.wave_speed_m_s * delay_s - extra_path_m
    positions = {log.name: _positions(position_error(log.track, log.settings, times)) for log in (tx, rx)}
    pair = f"{tx.name}-{rx.name}"
    return OpenPair(
        flight,
        pair,
        aperture,
        frequency_hz,
        weight,
        limits_m,
        time_s=seconds_since(times, times[0]),
        began=times[0],
        positions=tuple(positions.values()),
        beams=beams_of(campaign, pair, axes),
        axes=axes,
        wave_speed_m_s=air_on_track.wave_speed_m_s,
        air=air_on_track.report,
    )


def _positions(stated: Mapping[str, Any]) -> NodePositions:
    """Return the position accuracy of a node from an echo stage, which lists it in the order north, east, up."""
    std = stated.get("std_m")
    axes = None if std is None else (float(std[1]), float(std[0]), float(std[2]))
    return NodePositions(
        axes,
        float(stated.get("correlation_s", 1.0)),
        str(stated.get("stated_by", "none")),
        float(stated.get("drift_m", 0.0)),
        stated.get("receiver"),
    )
