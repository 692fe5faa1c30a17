"""A pair, opened once: from its echo, or before that is formed from what the flight logs promise."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import window_weights
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.stages import phase_history_of
from apertura.core.quality.budget import NodePositions
from apertura.core.quality.path_errors import Effect
from apertura.formats.reading import open_recording
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.opening.antennas import beams_of, body_axes
from apertura.pipeline.opening.node_log import raw_log, shortest_wave
from apertura.pipeline.opening.positions import position_error
from apertura.pipeline.opening.recorded import recorded_echo
from apertura.pipeline.opening.scene import Flown
from apertura.pipeline.opening.segments import inside_segments, keep_segments
from apertura.pipeline.opening.transmitted import transmitted
from apertura.pipeline.store import manifest_of, open_stage


@dataclass(frozen=True, eq=False)
class OpenPair:
    """What is known of a pair.

    Attributes
    ----------
    flight, name
        Which: the name is transmitter-receiver.
    aperture
        Phase centres.
    frequency_hz, weight
        (subcarrier,) float64, RF frequency and window.
    path_limit_m
        Longest total path inside the cyclic prefix.
    time_s
        (pulse,) float64, seconds from the first.
    began
        The first pulse, UTC.
    positions
        What is known of the node's positions, or of the transmitter's and the receiver's.
    history
        The echo itself; None before it is formed.
    beams
        Of the antennas; None where they are isotropic.
    sidelink_m
        (pulse, 3) float64, metres, from the receiver's sidelink point to the transmitter's; None where the echo was not
        given back a sidelink's length, and before it is formed.
    left
        What is left of errors of position after the tracks were refined; None where they are those of the logs.
    report
        What the echo stage says of itself: its attributes; empty before it is formed.
    """

    flight: str
    name: str
    aperture: Aperture
    frequency_hz: NDArray[np.float64]
    weight: NDArray[np.float64]
    path_limit_m: float
    time_s: NDArray[np.float64]
    began: np.datetime64
    positions: tuple[NodePositions, ...]
    history: PhaseHistory | None = None
    beams: Beams | None = None
    sidelink_m: NDArray[np.float64] | None = None
    left: Effect | None = None
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def monostatic(self) -> bool:
        """Whether one node sends and receives."""
        tx, rx = self.name.split("-")
        return tx == rx

    @property
    def flown(self) -> Flown:
        """What `auto` settles the grid from."""
        return Flown(self.aperture, self.frequency_hz, self.path_limit_m)


def open_pair(campaign: Campaign, flight: str, pair: str, *, echo: xr.Dataset | None = None) -> OpenPair:
    """Return what is known of a pair: `echo`, its stage as far as it is formed, or what the logs promise."""
    waveform = campaign.settings.waveform
    if echo is None and manifest_of(campaign.stage("echo", flight, pair)).is_file():
        echo = open_stage(campaign.stage("echo", flight, pair), "echo")
    if echo is None:
        if isinstance(waveform, SampledWaveform):
            return _expected(campaign, flight, pair, waveform)
        echo = keep_segments(campaign, flight, pair, recorded_echo(campaign, flight, pair))
    history = phase_history_of(echo, campaign.settings.processing.window, lazy=True)
    limit_m = float(echo.path_limit.values.min())
    beams = beams_of(campaign, pair, body_axes(echo))
    stated = echo.attrs.get("positions", {})
    return OpenPair(
        flight,
        pair,
        history.aperture,
        history.frequency_hz,
        history.weight,
        limit_m,
        time_s=_seconds(echo.time.values),
        began=echo.time.values[0],
        positions=tuple(_positions(stated.get(leg, {})) for leg in _legs(pair)),
        history=history,
        beams=beams,
        sidelink_m=echo.sidelink_vector.values if "sidelink_vector" in echo else None,
        report=echo.attrs,
    )


def _expected(campaign: Campaign, flight: str, pair: str, waveform: SampledWaveform) -> OpenPair:
    """Return what the logs promise: the transmitter's pulses, as far as every log reaches."""
    frequency = transmitted(campaign, waveform).numerology.frequency_hz
    tx, rx = (raw_log(campaign, flight, node, shortest_wave(frequency)) for node in pair.split("-"))
    first = max(log.track.time.values[0] for log in (tx, rx))
    last = min(log.track.time.values[-1] for log in (tx, rx))
    recorded = open_recording(campaign.recording_files(flight, tx.name)).captures.time
    recorded = campaign.clock(flight, tx.name).utc(recorded)
    times = _pulse_times(recorded, first, last, waveform.prf_hz)
    times = times[inside_segments(campaign, flight, pair, times)]
    beams = {"radar_tx": tx, "radar_rx": rx}
    axes = {antenna: beams[antenna].body_axes(times) for antenna in campaign.antennas(pair)}
    offset = rx.settings.path_offset_m
    beyond_m = offset.radar
    if tx.name != rx.name:
        length_m = np.linalg.norm(tx.antenna("sidelink", times) - rx.antenna("sidelink", times), axis=1)
        beyond_m -= offset.sidelink + float(length_m.min())
    weight = window_weights(campaign.settings.processing.window, len(frequency))
    limit_m = SPEED_OF_LIGHT_M_S * waveform.longest_delay_s - beyond_m
    known = {log.name: _positions(position_error(log.track, log.settings, times)) for log in (tx, rx)}
    return OpenPair(
        flight,
        pair,
        Aperture(tx.antenna("radar_tx", times), rx.antenna("radar_rx", times)),
        frequency,
        weight,
        limit_m,
        time_s=_seconds(times),
        began=times[0],
        positions=tuple(known.values()),
        beams=beams_of(campaign, pair, axes),
    )


def _pulse_times(
    recorded: NDArray[np.datetime64], first: np.datetime64, last: np.datetime64, prf_hz: float
) -> NDArray[np.datetime64]:
    """Return the recorded capture times inside the logs, or a regular series where the recorder ran through."""
    if len(recorded) < 2:
        count = int((last - first) / np.timedelta64(1, "s") * prf_hz) + 1
        recorded = first + (1e9 / prf_hz * np.arange(count)).astype("timedelta64[ns]")
    return recorded[(recorded >= first) & (recorded <= last)]


def _legs(pair: str) -> tuple[str, ...]:
    """Return which legs of a pair have positions of their own: one where one node sends and receives."""
    tx, rx = pair.split("-")
    return ("tx",) if tx == rx else ("tx", "rx")


def _positions(stated: Mapping[str, Any]) -> NodePositions:
    """Return what an echo stage says of a node's positions; its deviations are north, east, up."""
    std = stated.get("std_m")
    axes = None if std is None else (float(std[1]), float(std[0]), float(std[2]))
    return NodePositions(
        axes,
        float(stated.get("correlation_s", 1.0)),
        str(stated.get("stated_by", "nobody")),
        float(stated.get("drift_m", 0.0)),
    )


def _seconds(times: NDArray[np.datetime64]) -> NDArray[np.float64]:
    return np.asarray((times - times[0]) / np.timedelta64(1, "s"), np.float64)
