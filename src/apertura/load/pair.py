"""A pair, opened once: from its echo, or before that is formed from what the flight logs promise."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.campaign import Campaign
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.compression import window_weights
from apertura.echo.demodulate import subcarrier_numbers
from apertura.focus.inputs import PhaseHistory
from apertura.geometry.aperture import Aperture
from apertura.geometry.phase_centres import attitude_axes, phase_centres
from apertura.imaging.stages import phase_history_of
from apertura.ingest import open_recording, read_phase_history, read_track
from apertura.load.antennas import beams_of, body_axes
from apertura.load.scene import Flown
from apertura.load.segments import inside_segments, keep_segments
from apertura.settings import OfdmWaveform
from apertura.store import manifest_of, open_stage


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
    history
        The echo itself; None before it is formed.
    beams
        Of the antennas; None where they are isotropic.
    """

    flight: str
    name: str
    aperture: Aperture
    frequency_hz: NDArray[np.float64]
    weight: NDArray[np.float64]
    path_limit_m: float
    history: PhaseHistory | None = None
    beams: Beams | None = None

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
        if isinstance(waveform, OfdmWaveform):
            return _expected(campaign, flight, pair, waveform)
        files = list(campaign.raw_files(flight, pair.split("-")[1]).values())
        echo = keep_segments(campaign, flight, pair, read_phase_history(waveform.format, files, pair=pair))
    history = phase_history_of(echo, campaign.settings.processing.window)
    limit_m = float(echo.path_limit.values.min())
    beams = beams_of(campaign, pair, body_axes(echo))
    return OpenPair(flight, pair, history.aperture, history.frequency_hz, history.weight, limit_m, history, beams)


def _expected(campaign: Campaign, flight: str, pair: str, waveform: OfdmWaveform) -> OpenPair:
    """Return what the logs promise: the transmitter's pulses, as far as every log reaches."""
    tx, rx = pair.split("-")
    logs = {node: campaign.track_file(flight, node) for node in (tx, rx)}
    tracks = {node: read_track(log, node=node) for node, log in logs.items()}
    first = max(track.time.values[0] for track in tracks.values())
    last = min(track.time.values[-1] for track in tracks.values())
    recorded = open_recording(campaign.recording_files(flight, tx)).captures.time
    times = _pulse_times(recorded, first, last, waveform.prf_hz)
    times = times[inside_segments(campaign, flight, pair, times)]
    places, axes = [], {}
    for node, antenna in ((tx, "radar_tx"), (rx, "radar_rx")):
        track, settings = tracks[node], campaign.settings.nodes[node]
        log = (track.time.values, track.position.values, track.attitude.values)
        arm = getattr(settings.lever_arms_m, antenna)
        stated: dict[str, Any] = {"at": times, "attitude_from": settings.attitude, "where": logs[node]}
        places.append(phase_centres(*log, lever_arm_m=arm, **stated))
        if antenna in campaign.antennas(pair):
            axes[antenna] = attitude_axes(*log, **stated)
    numbers = subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is)
    frequency = np.asarray(waveform.carrier_hz + numbers * waveform.subcarrier_spacing_hz, np.float64)
    weight = window_weights(campaign.settings.processing.window, len(frequency))
    limit_m = SPEED_OF_LIGHT_M_S * waveform.cyclic_prefix_s
    aperture = Aperture(places[0], places[1])
    return OpenPair(flight, pair, aperture, frequency, weight, limit_m, beams=beams_of(campaign, pair, axes))


def _pulse_times(
    recorded: NDArray[np.datetime64], first: np.datetime64, last: np.datetime64, prf_hz: float
) -> NDArray[np.datetime64]:
    """Return the recorded capture times inside the logs, or a regular series where the recorder ran through."""
    if len(recorded) < 2:
        count = int((last - first) / np.timedelta64(1, "s") * prf_hz) + 1
        recorded = first + (1e9 / prf_hz * np.arange(count)).astype("timedelta64[ns]")
    return recorded[(recorded >= first) & (recorded <= last)]
