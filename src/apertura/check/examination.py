"""Recordings, logs, terrain and grid of a campaign, each opened on first use."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import ProjError

from apertura.campaign.config import SampledWaveform
from apertura.campaign.folder import Campaign, size_of
from apertura.check.facts import LogFacts, RecordingFacts, log_facts, recording_facts
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef
from apertura.formats.names import PHASE_HISTORIES
from apertura.formats.reading import open_recording, read_track
from apertura.workflow.stale import stale_results

if TYPE_CHECKING:
    import xarray as xr

    from apertura.core.scene.grid import SceneGrid
    from apertura.formats.recordings.recording import Recording
    from apertura.stages.scene import ConfiguredGround
    from apertura.stages.transmitted import Transmitted

T = TypeVar("T")
Key = tuple[str, str]
"""Flight and node."""

_SMALL_BYTES = 64 << 20  # largest phase history that is read by the check
_NODES = 128  # pixels along the shorter side of the grid that is used if the pixel spacing is automatic


@dataclass(frozen=True)
class Examination:
    """Opened files of a campaign, and the problems of files that could not be opened.

    Parameters
    ----------
    campaign
        Settings and flights.
    paranoid
        Hash all inputs of the results again, including those with an unchanged size and modification time.
    """

    campaign: Campaign
    paranoid: bool = False

    @cached_property
    def stale(self) -> dict[str, str]:
        """Manifest of each out-of-date result → reason, see `stale_results`."""
        return stale_results(self.campaign, paranoid=self.paranoid)

    @property
    def waveform(self) -> SampledWaveform | None:
        """Transmitted waveform if the campaign was recorded as samples; None for phase histories."""
        waveform = self.campaign.settings.waveform
        return waveform if isinstance(waveform, SampledWaveform) else None

    @property
    def transmitted(self) -> "Transmitted | None":
        """Transmitted signal; None for phase histories, or if the file contradicts the waveform settings."""
        return self._transmitted[0]

    @property
    def transmitted_problems(self) -> list[CampaignError]:
        """Problems of the file of the transmitted signal."""
        return self._transmitted[1]

    @cached_property
    def _transmitted(self) -> "tuple[Transmitted | None, list[CampaignError]]":
        from apertura.stages.transmitted import transmitted

        try:
            return (transmitted(self.campaign, self.waveform) if self.waveform else None), []
        except CampaignError as problem:
            return None, [problem]

    @property
    def keys(self) -> tuple[Key, ...]:
        """Flights and nodes with a recording, or with a required log."""
        every = [(flight, node) for flight in self.campaign.flights for node in flight.recorded]
        return tuple(
            (flight.name, node) for flight, node in every if self.waveform or self.campaign.logged(flight.name, node)
        )

    def needs_log(self, key: Key) -> bool:
        """Return True if the flight of a key requires logs, i.e. for all kinds except bench."""
        return self.campaign.flight(key[0]).kind != "bench"

    @property
    def recordings(self) -> dict[Key, "Recording"]:
        """Recordings that could be opened."""
        return self._recordings[0]

    @cached_property
    def recorded(self) -> dict[Key, RecordingFacts]:
        """Header contents of these recordings."""
        return {key: recording_facts(recording) for key, recording in self.recordings.items()}

    @property
    def recording_problems(self) -> list[CampaignError]:
        """Problems of the recordings that could not be opened."""
        return self._recordings[1]

    @property
    def tracks(self) -> dict[Key, "xr.Dataset"]:
        """Readable flight logs, as datasets of stage `track`."""
        return self._tracks[0]

    @cached_property
    def logs(self) -> dict[Key, LogFacts]:
        """Contents of these logs."""
        return {key: log_facts(track) for key, track in self.tracks.items()}

    @property
    def track_problems(self) -> list[CampaignError]:
        """Problems of the logs that could not be read."""
        return self._tracks[1]

    def opens(self, flight: str, pair: str) -> bool:
        """Return True if the logs and headers of a pair could be opened, or if its phase history is small."""
        if self.waveform is not None:
            keys = {(flight, node) for node in pair.split("-")}
            return keys <= self.tracks.keys() & self.recordings.keys()
        files = self.campaign.history_files(flight, pair.split("-")[1])
        return 0 < sum(map(size_of, files)) <= _SMALL_BYTES

    @cached_property
    def history_problems(self) -> list[CampaignError]:
        """Problems of phase histories: those of all small files, and of the first file if it determines the frame."""
        if self.waveform is not None:
            return []
        from apertura.stages.transfer import recorded_echo

        problems: list[CampaignError] = []
        pairs = [(flight.name, pair) for flight in self.campaign.flights for pair in flight.pairs]
        for number, (flight, pair) in enumerate(pairs):
            try:
                files = self.campaign.history_files(flight, pair.split("-")[1])
            except CampaignError:  # reported by check 'files'
                continue
            size = sum(map(size_of, files))
            if not size or (size > _SMALL_BYTES and (number or self.frame)):
                continue
            try:
                recorded_echo(self.campaign, flight, pair)
            except CampaignError as problem:
                problems.append(problem)
        return problems

    @cached_property
    def _recordings(self) -> tuple[dict[Key, "Recording"], list[CampaignError]]:
        return self._each(self.campaign.recording_files, self._opened)

    def _opened(self, files: tuple[Path, ...], key: Key) -> "Recording":
        """Open a recording and convert its times to UTC with the clock settings of its node."""
        recording = open_recording(files)
        captures = recording.captures
        return replace(recording, captures=replace(captures, time=self.campaign.clock(*key).utc(captures.time)))

    @cached_property
    def _tracks(self) -> tuple[dict[Key, "xr.Dataset"], list[CampaignError]]:
        def files(flight: str, node: str) -> tuple[ConfinedPath, ...]:
            return (self.campaign.track_file(flight, node),)

        options = {name: node.log.options for name, node in self.campaign.settings.nodes.items()}
        return self._each(
            files, lambda logs, key: read_track(logs[0], node=key[1], options=options[key[1]]), self.needs_log
        )

    def _each(
        self,
        files: Callable[[str, str], tuple[ConfinedPath, ...]],
        open_files: Callable[[tuple[ConfinedPath, ...], Key], T],
        needed: Callable[[Key], bool] = lambda _: True,
    ) -> tuple[dict[Key, T], list[CampaignError]]:
        """Open the files that exist and are not empty; check 'files' reports all other files."""
        opened: dict[Key, T] = {}
        problems: list[CampaignError] = []
        for flight, node in filter(needed, self.keys):
            try:
                paths = files(flight, node)
                if not all(map(size_of, paths)):
                    continue
            except CampaignError:
                continue
            try:
                opened[flight, node] = open_files(paths, (flight, node))
            except CampaignError as problem:
                problems.append(problem)
        return opened, problems

    @property
    def frame(self) -> str:
        """Frame of the positions, ecef or local; empty if only the content of a phase history determines the frame."""
        frames = [track.attrs["frame"] for track in self.tracks.values()]
        if frames or self.waveform:
            return next(iter(frames), "ecef")
        return PHASE_HISTORIES[self.campaign.settings.waveform.format].frame  # type: ignore[union-attr]

    @cached_property
    def crs(self) -> str | None:
        """CRS of the scene; for `auto`, the UTM zone of the first image flight; None if unknown or not in metres."""
        requested = self.campaign.settings.scene.crs
        if requested != "auto":
            return requested if requested == LOCAL or in_metres(requested) else None
        from apertura.core.scene.auto_grid import utm_crs

        middle = self.middle_m
        return None if middle is None else utm_crs(middle)

    @property
    def other_frame(self) -> bool:
        """True if the CRS of the scene and the positions refer to different frames (ecef and local)."""
        return bool(self.frame) and (self.campaign.settings.scene.crs == LOCAL) is not (self.frame == LOCAL)

    @cached_property
    def middle_m(self) -> NDArray[np.float64] | None:
        """Median position of the first image flight: (3,) float64 ECEF, metres; None without a log."""
        first = {flight.name for flight in self.campaign.image_flights[:1]}
        logs = [
            track.position.values
            for key, track in self.tracks.items()
            if key[0] in first and track.attrs["frame"] == "ecef"
        ]
        return np.median(np.concatenate(logs), axis=0) if logs else None

    @cached_property
    def grid(self) -> "SceneGrid | None":
        """Grid of the scene, coarser if the spacing is automatic; None if bounds are automatic or the CRS invalid."""
        from apertura.core.scene.grid import SceneGrid

        requested = self.campaign.settings.scene
        if self.crs is None or requested.bounds_m == "auto" or self.other_frame:
            return None
        xmin, ymin, xmax, ymax = requested.bounds_m
        spacing = min(xmax - xmin, ymax - ymin) / _NODES if requested.spacing_m == "auto" else requested.spacing_m
        try:
            return SceneGrid.from_bounds(self.crs, requested.bounds_m, spacing_m=spacing)
        except CampaignError:
            return None

    @property
    def ground(self) -> "ConfiguredGround | None":
        """Configured terrain, opened; None if it cannot be opened, or the CRS is unknown."""
        return self._ground[0]

    @property
    def ground_problems(self) -> list[CampaignError]:
        """Problems of the configured terrain."""
        return self._ground[1]

    @property
    def level_m(self) -> float:
        """Ellipsoidal height (m) of flat terrain under the grid; height of the track if unknown or if a DEM is used."""
        return self._ground[2]

    @cached_property
    def _ground(self) -> "tuple[ConfiguredGround | None, list[CampaignError], float]":
        from apertura.stages.scene import ConfiguredGround

        track_m = 0.0 if self.middle_m is None else float(geodetic_from_ecef(self.middle_m)[2])
        requested = self.campaign.settings.scene
        try:
            files = self.campaign.height_files()
        except CampaignError:
            return None, [], track_m
        if self.crs is None or not all(map(size_of, files.values())):
            return None, [], track_m
        try:
            ground = ConfiguredGround.of(requested, files, crs=self.crs)
            return ground, [], track_m if ground.dem or self.grid is None else ground.level(self.grid).height_m
        except CampaignError as problem:
            return None, [problem], track_m


def in_metres(crs: str) -> bool:
    """Return True if PROJ defines a CRS and it is projected in metres.

    Examples
    --------
    >>> [in_metres(crs) for crs in ("EPSG:32632", "EPSG:4326", "EPSG:2225", "EPSG:5555", "EPSG:99999")]
    [True, False, False, False, False]
    """
    try:
        system = CRS(crs)
    except ProjError:
        return False
    metres = all(axis.unit_name == "metre" for axis in system.axis_info)
    return system.is_projected and not system.is_compound and metres
