"""A campaign folder as one value: settings, flights and paths."""

import os
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from apertura.campaign.config import (
    CLOCKS,
    CONFIG,
    FLIGHTS,
    SEGMENTS,
    Antenna,
    ClockRow,
    Flight,
    Node,
    SampledWaveform,
    Segment,
    Settings,
    check_interferometry,
    check_radio,
    radio_of,
    read_clocks,
    read_flights,
    read_segments,
    read_settings,
)
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.formats.names import PHASE_HISTORIES, log_suffixes, recording_files

_OF_RAW = ("track.manifest.json", "echo.manifest.json")
"""Manifests that name logs and phase histories among their sources."""


@dataclass(frozen=True)
class RawFolder:
    """The folder raw/ of a campaign.

    Attributes
    ----------
    root
        The campaign folder.
    settings
        Its config.
    """

    root: ConfinedPath
    settings: Settings

    def __post_init__(self) -> None:
        """Confine the paths of the folder, and of raw/ where the config states that it lies elsewhere."""
        elsewhere = getattr(self.settings, "raw_root", None)
        root = ConfinedPath.at(self.root)
        object.__setattr__(self, "root", root.with_elsewhere({"raw": Path(elsewhere)}) if elsewhere else root)

    def raw_files(self, flight: str, node: str) -> dict[str, ConfinedPath]:
        """Return role → file of everything recorded by `node` in `flight`, whether it is there or not."""
        if isinstance(self.settings.waveform, SampledWaveform):
            recorded = {path.suffix: path for path in self.promised_files(flight, node)}
            return {**recorded, "track": self.track_file(flight, node)}
        folder = self.flight_folder(flight)
        files = self.history_files(flight, node)
        history = {f"history.{path.relative_to(folder).as_posix()}": path for path in files}
        return {**history, **({"track": self.track_file(flight, node)} if self.logged(flight, node) else {})}

    def promised_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the files that `recording_files` does, whether they are there or not."""
        return tuple(self._recorded(flight, path.name) for path in recording_files(self.flight_folder(flight), node))

    def recording_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the files of the recording of `node` in `flight`, in the order of their row of `RECORDERS`."""
        return tuple(self._raw_file(flight, node, path) for path in self.promised_files(flight, node))

    def history_files(self, flight: str, node: str) -> list[ConfinedPath]:
        """Return the files of a node's phase history, in the order of their names; of a folder all that it holds."""
        suffix = PHASE_HISTORIES[self.settings.waveform.format].suffix  # type: ignore[union-attr]
        folder = self.flight_folder(flight)
        named = [path for path in sorted(folder.glob(f"{node}*{suffix}")) if path.name[len(node)] == "."]
        found = [file for path in named if not _is_log(path, node) for file in _files(path)]
        own = [path.relative_to(folder).as_posix() for path in found]
        own = own or [name for name in self._made_from(flight, node) if not _is_log(Path(name), node)]
        if not own:
            raise CampaignError(
                "no such file",
                where=folder / f"{node}.*{suffix}",
                expected=f"the phase history of node {node} in flight {flight}",
                remedy=f"Copy the {suffix} files there, named <node>{suffix} or <node>.<anything>{suffix}.",
            )
        return [self._recorded(flight, name) for name in own]

    def logged(self, flight: str, node: str) -> bool:
        """Test whether a flight log of a node is there, or was when results were made."""
        return bool(self._logs(flight, node))

    def track_file(self, flight: str, node: str) -> ConfinedPath:
        """Return the one raw/<flight>/<node>.track.* file."""
        logs = self._logs(flight, node)
        if len(logs) == 1:
            return self._recorded(flight, logs[0])
        raise CampaignError(
            f"{len(logs)} track files {logs}",
            where=self.flight_folder(flight) / f"{node}.track.*",
            expected=f"exactly one flight log of node {node}",
            remedy=f"Copy the log there, named <node>.track.<{'|'.join(log_suffixes())}>.",
        )

    def _logs(self, flight: str, node: str) -> list[str]:
        there = sorted(path.name for path in self.flight_folder(flight).glob(f"{node}.track.*"))
        return there or [name for name in self._made_from(flight, node) if _is_log(Path(name), node)]

    def _made_from(self, flight: str, node: str) -> list[str]:
        """Return the files of a node that results say they were made from, where none is there: raw/ stayed behind."""
        from apertura.campaign.store import read_manifest  # loads arrays, which no config needs

        sources, folder = set[str](), f"raw/{flight}/"
        if any(self.flight_folder(flight).glob(f"{node}.*")):
            return []
        for path in self.root.named(f"results/{flight}", where=self.root).glob("*/*.manifest.json"):
            if path.name in _OF_RAW:
                with suppress(CampaignError):
                    sources |= read_manifest(path).get("sources", {}).keys()
        return sorted(name.removeprefix(folder) for name in sources if name.startswith(f"{folder}{node}."))

    def flight_folder(self, flight: str) -> ConfinedPath:
        """Return raw/<flight>."""
        return self.root.named(f"raw/{flight}", where=self.root)

    def _recorded(self, flight: str, name: str) -> ConfinedPath:
        return self.root.named(f"raw/{flight}/{name}", where=self.root)

    def _raw_file(self, flight: str, node: str, path: ConfinedPath) -> ConfinedPath:
        """Return a file of a node, which must exist."""
        if not path.is_file():
            raise CampaignError(
                "no such file",
                where=path,
                expected=f"the recording of node {node} in flight {flight}",
                remedy=f"Copy it there, or take {node} out of the nodes of {flight} in {FLIGHTS}.",
            )
        return path


def size_of(path: ConfinedPath) -> int:
    """Return the bytes of a file; 0 where it is not there."""
    return path.stat().st_size if path.is_file() else 0


def _is_log(path: Path, node: str) -> bool:
    return path.name.startswith(f"{node}.track.")


def _files(path: ConfinedPath) -> list[ConfinedPath]:
    """Return a file itself, or those of a folder; raise CampaignError at a link."""
    inside_it = list(path.rglob("*")) if path.is_dir() else [path]
    return [file for file in inside_it if not file.is_dir()]


def check_name(root: Path) -> None:
    """Raise CampaignError where the name of a folder, or of one above it, is not UTF-8 text.

    Tags, JSON and GDAL's names are UTF-8: steps would end in an encoding error.

    Parameters
    ----------
    root
        The campaign folder.
    """
    name = os.path.abspath(root)  # noqa: PTH100  (follows no link)
    try:
        name.encode()
    except UnicodeEncodeError:
        raise CampaignError(
            "a name that is not UTF-8 text",
            root.name or root,
            "the folder and those above it named in UTF-8",
            "Rename it (convmv -f latin1 -t utf8), or set a UTF-8 locale: LC_ALL=C.UTF-8.",
        ) from None


@dataclass(frozen=True)
class Campaign(RawFolder):
    """A validated campaign folder.

    Attributes
    ----------
    flights, segments, clocks
        Lines of the tables beside the config.
    planned
        Whether it is a flight plan: nothing was recorded, and what is sent may not be there yet.
    outdated
        Manifests of results that are out of date: what is planned from the config does not read them.

    Examples
    --------
    >>> Campaign.load("nowhere")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/config/config.yaml: no such file; ...
    """

    flights: tuple[Flight, ...]
    segments: tuple[Segment, ...] = ()
    clocks: tuple[ClockRow, ...] = ()
    planned: bool = False
    outdated: frozenset[str] = frozenset()

    @classmethod
    def load(cls, root: str | Path) -> "Campaign":
        """Read and validate `root`/config; raise CampaignError on the first file that is wrong."""
        check_name(Path(root))
        root = ConfinedPath.at(root)
        config, table, segments, clocks = (root / path for path in (CONFIG, FLIGHTS, SEGMENTS, CLOCKS))
        settings = read_settings(config)
        flights = tuple(read_flights(table, nodes=settings.nodes))
        images = [f"{one.name}/{pair}" for one in flights if one.kind == "image" for pair in one.pairs]
        check_interferometry(settings.interferometry, images, where=CONFIG)
        imaging = tuple(read_segments(segments, flights=flights))
        campaign = cls(root, settings, flights, imaging, tuple(read_clocks(clocks, flights=flights)))
        campaign.check_radio()
        return campaign

    @property
    def image_flights(self) -> tuple[Flight, ...]:
        """Flights that become images."""
        return tuple(flight for flight in self.flights if flight.kind == "image")

    @property
    def images(self) -> dict[str, tuple[str, ...]]:
        """Flight that becomes images → their names: its pairs, and their sums where there are two pairs to add."""
        return {flight.name: flight.images for flight in self.image_flights}

    def check_images(self) -> None:
        """Raise CampaignError where no flight becomes an image: what shows images has nothing to show."""
        if not self.image_flights:
            kinds = ", ".join(dict.fromkeys(flight.kind for flight in self.flights))
            raise CampaignError(
                f"flights of kind {kinds} alone",
                where=self.root / FLIGHTS,
                expected="a flight of kind image",
                remedy="`apertura bench` measures a radar that stands still; add a flight for images.",
            )

    @cached_property
    def calibrated(self) -> bool:
        """True if the radio of its pairs is stated, or their constants were measured, so that images are calibrated."""
        if self.settings.processing.radiometric_calibration:
            return True
        stated = (radio_of(self.settings.nodes, pair) for pair in self._pairs)
        return any(value is not None for one in stated for value in one.values())

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Backscattering coefficients that are written of its images, none where they are relative; and multilooked."""
        processing = self.settings.processing
        written = processing.radiometry if self.calibrated else ()
        if processing.multilook is None:
            return written
        averaged = [f"multilook_{name}" for name in written] or ["multilook"]
        noise = ["multilook_noise"] * processing.multilook.subtract_noise
        return (*written, *averaged, *noise, "multilook_coherent", "multilook_noncoherent")

    def check_radio(self) -> None:
        """Raise CampaignError where the radio of its pairs is stated in parts, unless their constants were measured."""
        if self.settings.processing.radiometric_calibration:
            return
        sampled = isinstance(self.settings.waveform, SampledWaveform)
        check_radio(self.settings.nodes, self._pairs, sampled=sampled, where=CONFIG)

    @property
    def _pairs(self) -> list[str]:
        return sorted({pair for flight in self.image_flights for pair in flight.pairs})

    @cached_property
    def values(self) -> dict[str, Any]:
        """The settings as JSON values, without those that only state where to compute and where recordings lie."""
        return self.settings.model_dump(mode="json", exclude={"raw_root": True, "processing": {"scheduler"}})

    @property
    def results(self) -> ConfinedPath:
        """The folder of everything the pipeline writes."""
        return self.root / "results"

    def stage(self, stage: str, *where: str) -> ConfinedPath:
        """Return the folder of a stage: results/<where…>/<stage>.zarr.

        Examples
        --------
        >>> Campaign(ConfinedPath.at("c"), None, ()).stage("echo", "f01", "uav1-uav2").as_posix()
        'c/results/f01/uav1-uav2/echo.zarr'
        """
        return self.result(*where, f"{stage}.zarr")

    def result(self, *where: str) -> ConfinedPath:
        """Return results/<where…>."""
        return self.root.named("/".join(["results", *where]), where=self.root)

    def manifest(self, stage: str, *where: str) -> str:
        """Return the manifest of a stage relative to the campaign folder, as the workflow names it."""
        return "/".join(["results", *where, f"{stage}.manifest.json"])

    def is_current(self, result: ConfinedPath) -> bool:
        """Test whether a stage or document is finished and not `outdated`."""
        from apertura.campaign.store.manifest import manifest_of  # callers have the store's arrays loaded

        manifest = manifest_of(result)
        return manifest.is_file() and self.relative(manifest) not in self.outdated

    def file(self, name: str, key: str) -> ConfinedPath:
        """Return a file that `key` of the config names; raise CampaignError unless it lies in the campaign folder."""
        return self.root.named(name, where=f"{CONFIG}: {key}")

    @property
    def sent_file(self) -> ConfinedPath:
        """The file of the transmitted signal: code symbols, or the samples of a pulse."""
        key = getattr(self.settings.waveform, "file_key", "")
        return self.file(getattr(self.settings.waveform, key, ""), f"waveform.{key}")

    @property
    def calibration_file(self) -> ConfinedPath | None:
        """The file of the constants that were measured at reflectors, where the config names one."""
        named = self.settings.processing.radiometric_calibration
        return self.file(named, "processing.radiometric_calibration") if named else None

    def relative(self, path: Path) -> str:
        """Return a path inside the campaign folder as the workflow names it."""
        return path.relative_to(self.root).as_posix()

    def height_files(self) -> dict[str, ConfinedPath]:
        """Return role → file of the DEM and of the grid of the geoid, where the config names them."""
        scene = self.settings.scene
        named = {"dem": scene.dem, "geoid": scene.geoid}
        return {role: self.file(name, f"scene.{role}") for role, name in named.items() if name}

    def antennas(self, pair: str) -> dict[str, tuple[str, Antenna]]:
        """Return the antennas of a pair that have beams: radar_tx, radar_rx → node and antenna."""
        nodes = zip(("radar_tx", "radar_rx"), pair.split("-"), strict=True)
        found = {point: (name, getattr(self.settings.nodes[name].antennas, point)) for point, name in nodes}
        return {point: (name, antenna) for point, (name, antenna) in found.items() if antenna is not None}

    def pattern_files(self, pair: str) -> dict[str, ConfinedPath]:
        """Return key of the config → file of each sampled pattern of a pair's antennas."""
        named = {
            f"nodes.{node}.antennas.{point}.pattern": antenna.pattern
            for point, (node, antenna) in self.antennas(pair).items()
            if antenna.pattern
        }
        return {key: self.file(name, key) for key, name in named.items()}

    def segments_of(self, flight: str, pair: str) -> list[tuple[str, str]]:
        """Return start and end (UTC) of the parts of the track that image a pair; none: all of it."""
        return self._segments.get((flight, pair), [])

    @cached_property
    def _segments(self) -> dict[tuple[str, str], list[tuple[str, str]]]:
        own: dict[tuple[str, str], list[tuple[str, str]]] = {}
        for segment in sorted(self.segments, key=lambda one: (one.start, one.end)):
            own.setdefault((segment.flight, segment.pair), []).append((segment.start, segment.end))
        return own

    def clock(self, flight: str, node: str) -> ClockRow:
        """Return the clock of a node's recorder against its log in a flight."""
        return self._clocks.get((flight, node), ClockRow(flight, node))

    def node(self, flight: str, node: str) -> Node:
        """Return the settings of a node in a flight; clocks.tsv overrides its stated time tags."""
        stated, std_s = self.settings.nodes[node], self.clock(flight, node).std_s
        return stated if std_s is None else stated.model_copy(update={"time_tag_std_s": std_s})

    @cached_property
    def _clocks(self) -> dict[tuple[str, str], ClockRow]:
        return {(clock.flight, clock.node): clock for clock in self.clocks}

    def flight(self, name: str) -> Flight:
        """Return the flight called `name`; raise CampaignError with the names there are if it is none of them."""
        if name not in self._flights:
            raise CampaignError(
                f"no flight {name!r}",
                where=self.root / FLIGHTS,
                expected=f"one of {', '.join(self._flights)}",
                remedy="Correct the flight's name, or add its line.",
            )
        return self._flights[name]

    @cached_property
    def _flights(self) -> dict[str, Flight]:
        return {flight.name: flight for flight in self.flights}
