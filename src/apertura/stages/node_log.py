"""Flight log of a node: its valid epochs, and positions of its antennas at any time."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Node
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import LOCAL, LOCAL_NED, ned_axes
from apertura.core.geometry.lever_arms import attitude_axes, phase_centres, position_spline
from apertura.core.geometry.track_checks import CheckedTrack, YawFault, check_track, check_yaw
from apertura.formats.reading import read_phase_history, read_track
from apertura.formats.tracks.track import FIXES

if TYPE_CHECKING:
    import xarray as xr


def read_log(campaign: Campaign, flight: str, node: str) -> "xr.Dataset":
    """Read the flight log of a node as a `track` stage."""
    options = campaign.settings.nodes[node].log.options
    return read_track(campaign.track_file(flight, node), node=node, options=options)


def read_history(campaign: Campaign, flight: str, node: str, *, pair: str) -> "xr.Dataset":
    """Read the phase history recorded by a node of a pair, in the configured format."""
    waveform = campaign.settings.waveform.model_dump()
    files = campaign.history_files(flight, node)
    history = read_phase_history(waveform["format"], files, pair=pair, described=waveform)
    if waveform["kind"] == "phase_history" and waveform["iq"] == "conjugate":
        return history.assign(transfer=history.transfer.conj())
    return history


@dataclass(frozen=True)
class NodeLog:
    """Log of a node in one flight, with the node's settings.

    Attributes
    ----------
    name, settings
        Name and settings of the node.
    track
        Stage `track`.
    log
        Log file, for messages.
    shortest_wave_m
        Wavelength of the highest frequency, metres; the tolerated error between epochs is proportional to it.
    """

    name: str
    settings: Node
    track: xr.Dataset
    log: str
    shortest_wave_m: float

    @cached_property
    def checked(self) -> CheckedTrack:
        """Result of the checks of the log's epochs; errors up to λ/16 between epochs are tolerated."""
        poor = np.zeros(self.track.sizes["epoch"], bool)
        if "fix" in self.track:
            poor = poorer_fix(self.track.fix.values, self.settings.worst_fix)
        return check_track(
            self.log_seconds(self.track.time.values),
            self.track.position.values,
            poor_fix=poor,
            tolerated_m=self.shortest_wave_m / 16,
            longest_gap_s=self.settings.log.longest_gap_s or np.inf,
        )

    @cached_property
    def yaw_fault(self) -> YawFault | None:
        """Contradiction between the logged attitude and the course; None if the logged attitude is not used."""
        is_used = self.settings.attitude == "log" and (self.settings.antennas.any() or self.settings.lever_arms_m.any())
        return yaw_fault_of(self.track.isel(epoch=self.checked.kept)) if is_used else None

    def log_seconds(self, at: Times) -> NDArray[np.float64]:
        """Return times in seconds since the log's first epoch, float64."""
        return seconds_since(at, self.track.time.values[0])

    def log_time(self, time_s: float) -> str:
        """Return the UTC time of day of a time in seconds since the log's first epoch, truncated to 10 ms."""
        time = self.track.time.values[0] + np.timedelta64(round(time_s * 1e9), "ns")
        return f"{np.datetime_as_string(time, 'ms')[11:-1]}Z"

    @property
    def interval_s(self) -> float:
        """Median interval between epochs of the log, seconds."""
        return float(np.median(np.diff(self.log_seconds(self.track.time.values))))

    @property
    def speed_m_s(self) -> float:
        """Median speed over the log, metres per second."""
        step_m = np.linalg.norm(np.diff(self.track.position.values, axis=0), axis=1)
        return float(np.median(step_m / np.diff(self.log_seconds(self.track.time.values))))

    @cached_property
    def smoothing_residual_m(self) -> float | None:
        """RMS change of the valid epochs due to smoothing, metres per axis; None without smoothing."""
        if self.settings.log.smoothing_m is None:
            return None
        times, position, _ = self._valid_epochs
        smooth = position_spline(self.log_seconds(times), position, smoothing_m=self.settings.log.smoothing_m)
        return float(np.sqrt(np.mean((smooth(self.log_seconds(times)) - position) ** 2)))

    def antenna(self, name: Literal["radar_tx", "radar_rx", "sidelink"], at: Times) -> NDArray[np.float64]:
        """Return antenna positions from the valid epochs of the log, (time, 3) float64 metres in the log's frame."""
        return phase_centres(
            *self._valid_epochs, at=at, lever_arm_m=getattr(self.settings.lever_arms_m, name), **self._from_log
        )

    @property
    def has_attitude(self) -> bool:
        """True if body axes are known: from the log at all its valid epochs, or from the course."""
        _, _, logged = self._valid_epochs
        return self.settings.attitude == "course" or (
            self.settings.attitude == "log" and bool(np.isfinite(logged).all())
        )

    def turns(self, name: Literal["radar_tx", "radar_rx"]) -> bool:
        """Return True if attitude affects this antenna, i.e. the antenna has a beam or the node has a lever arm."""
        return getattr(self.settings.antennas, name) is not None or self.settings.lever_arms_m.any()

    def body_axes(self, at: Times) -> NDArray[np.float64]:
        """Return the body axes forward, right and down in the log's frame, (time, axis, body) float64."""
        return attitude_axes(*self._valid_epochs, at=at, **self._from_log)

    @cached_property
    def _valid_epochs(self) -> tuple[Times, NDArray[np.float64], NDArray[np.float64]]:
        track = self.track.isel(epoch=self.checked.kept)
        return track.time.values, track.position.values, track.attitude.values

    @property
    def _from_log(self) -> dict[str, Any]:
        return {
            "attitude_from": self.settings.attitude,
            "where": self.log,
            "frame": self.track.attrs["frame"],
            "smoothing_m": self.settings.log.smoothing_m,
        }


def raw_log(campaign: Campaign, flight: str, node: str, wave_m: float) -> NodeLog:
    """Read the log of a node from raw/; `wave_m` is the shortest wavelength."""
    file = str(campaign.track_file(flight, node))
    return NodeLog(node, campaign.node(flight, node), read_log(campaign, flight, node), file, wave_m)


def yaw_fault_of(track: xr.Dataset) -> YawFault | None:
    """Return the contradiction between attitude and course of a track; None if they agree."""
    position = track.position.values
    ned = LOCAL_NED if track.attrs["frame"] == LOCAL else ned_axes(position)
    return check_yaw(position, track.attitude.values, ned)


def shortest_wave(frequency_hz: NDArray[np.float64]) -> float:
    """Return the wavelength of the last of ascending frequencies (Hz), metres."""
    return SPEED_OF_LIGHT_M_S / float(frequency_hz[-1])


def poorer_fix(fix: NDArray[np.int8], worst: Literal["auto", "fix", "float", "any"]) -> NDArray[np.bool_]:
    """Return (epoch,) bool, True for solutions poorer than `worst`.

    Epochs without a logged solution are False. For 'auto', all epochs are False if the log has no RTK solution.

    Examples
    --------
    >>> poorer_fix(np.array([1, 2, 5, 0], np.int8), "auto"), poorer_fix(np.array([5, 4], np.int8), "auto")
    (array([False,  True,  True, False]), array([False, False]))
    >>> poorer_fix(np.array([5, 4], np.int8), "fix")
    array([ True,  True])
    """
    rtk = FIXES["fix"], FIXES["float"]
    if worst == "any" or (worst == "auto" and not np.isin(fix, rtk).any()):
        return np.zeros(len(fix), bool)
    return ~np.isin(fix, (0, *rtk[: 1 + (worst == "float")]))
