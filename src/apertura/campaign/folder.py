"""Campaign folder: settings, flights and paths."""

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
    SidelinkCodes,
    check_interferometry,
    check_radio,
    check_stack,
    radio_of,
    read_clocks,
    read_flights,
    read_segments,
    read_settings,
)
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of
from apertura.formats.names import PHASE_HISTORIES, log_suffixes, recording_files

_RAW_MANIFESTS = ("track.manifest.json", "echo.manifest.json")
"""Manifests that list logs and phase histories among their sources."""


@dataclass(frozen=True)
class RawFolder:
    """Folder raw/ of a campaign.

    Attributes
    ----------
    root
        Campaign folder.
    settings
        Config of the campaign.
    """

    root: ConfinedPath
    settings: Settings

    def __post_init__(self) -> None:
        """Confine paths to the campaign folder, and paths in raw/ to the configured raw_root."""
        elsewhere = getattr(self.settings, "raw_root", None)
        root = ConfinedPath.at(self.root)
        object.__setattr__(self, "root", root.with_elsewhere({"raw": Path(elsewhere)}) if elsewhere else root)

    def raw_files(self, flight: str, node: str) -> dict[str, ConfinedPath]:
        """Return role → path of all recorded files of `node` in `flight`, existing or not."""
        if isinstance(self.settings.waveform, SampledWaveform):
            recorded = {path.suffix: path for path in self.promised_files(flight, node)}
            return {**recorded, "track": self.track_file(flight, node)}
        folder = self.flight_folder(flight)
        files = self.history_files(flight, node)
        history = {f"history.{path.relative_to(folder).as_posix()}": path for path in files}
        return {**history, **({"track": self.track_file(flight, node)} if self.logged(flight, node) else {})}

    def promised_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the paths returned by `recording_files`, also of files that do not exist."""
        return tuple(self._recorded(flight, path.name) for path in recording_files(self.flight_folder(flight), node))

    def recording_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the files of the recording of `node` in `flight`, in the order of the format's row of `RECORDERS`."""
        return tuple(self._raw_file(flight, node, path) for path in self.promised_files(flight, node))

    def history_files(self, flight: str, node: str) -> list[ConfinedPath]:
        """Return the files of a node's phase history, sorted by name; for a folder, all files in the folder."""
        suffix = PHASE_HISTORIES[self.settings.waveform.format].suffix  # type: ignore[union-attr]
        folder = self.flight_folder(flight)
        paths = [path for path in sorted(folder.glob(f"{node}*{suffix}")) if path.name[len(node)] == "."]
        files = [file for path in paths if not _is_log(path, node) for file in _files(path)]
        own = [path.relative_to(folder).as_posix() for path in files]
        own = own or [name for name in self._recorded_sources(flight, node) if not _is_log(Path(name), node)]
        if not own:
            raise CampaignError(
                "no such file",
                where=folder / f"{node}.*{suffix}",
                expected=f"the phase history of node {node} in flight {flight}",
                remedy=f"Copy the {suffix} files there with the names <node>{suffix} or <node>.<anything>{suffix}.",
            )
        return [self._recorded(flight, name) for name in own]

    def logged(self, flight: str, node: str) -> bool:
        """Return True if a flight log of a node exists, or existed when results were written."""
        return bool(self._logs(flight, node))

    def track_file(self, flight: str, node: str) -> ConfinedPath:
        """Return the flight log raw/<flight>/<node>.track.*; raise CampaignError unless there is exactly one."""
        logs = self._logs(flight, node)
        if len(logs) == 1:
            return self._recorded(flight, logs[0])
        raise CampaignError(
            f"{number_of(len(logs), 'flight log')} {logs}" if logs else "no flight log",
            where=self.flight_folder(flight) / f"{node}.track.*",
            expected=f"exactly one flight log of node {node}",
            remedy="Remove or rename all but one of them."
            if logs
            else f"Copy the log there with the name <node>.track.<{'|'.join(log_suffixes())}>.",
        )

    def _logs(self, flight: str, node: str) -> list[str]:
        existing = sorted(path.name for path in self.flight_folder(flight).glob(f"{node}.track.*"))
        return existing or [name for name in self._recorded_sources(flight, node) if _is_log(Path(name), node)]

    def _recorded_sources(self, flight: str, node: str) -> list[str]:
        """Return a node's files listed in manifests of results, for a campaign whose raw/ contains no such files."""
        from apertura.campaign.store import read_manifest  # loads zarr, which reading the config does not need

        sources, folder = set[str](), f"raw/{flight}/"
        if any(self.flight_folder(flight).glob(f"{node}.*")):
            return []
        for path in self.root.named(f"results/{flight}", where=self.root).glob("*/*.manifest.json"):
            if path.name in _RAW_MANIFESTS:
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
                remedy=f"Copy the file there, or remove {node} from the nodes of {flight} in {FLIGHTS}.",
            )
        return path


def size_of(path: ConfinedPath) -> int:
    """Return the size of a file in bytes; 0 if it is missing."""
    return path.stat().st_size if path.is_file() else 0


def _is_log(path: Path, node: str) -> bool:
    return path.name.startswith(f"{node}.track.")


def _files(path: ConfinedPath) -> list[ConfinedPath]:
    """Return the files at any depth of a folder, or the file itself; raise CampaignError for a link."""
    paths = list(path.rglob("*")) if path.is_dir() else [path]
    return [file for file in paths if not file.is_dir()]


def check_name(root: Path) -> None:
    """Check that the absolute path of a folder is UTF-8 text, as required by tags, JSON and GDAL.

    Parameters
    ----------
    root
        Campaign folder.
    """
    name = os.path.abspath(root)  # noqa: PTH100  (follows no link)
    try:
        name.encode()
    except UnicodeEncodeError:
        raise CampaignError(
            "the path is not UTF-8 text",
            root.name or root,
            "UTF-8 names of the folder and its parent folders",
            "Rename the folder (convmv -f latin1 -t utf8), or set a UTF-8 locale: LC_ALL=C.UTF-8.",
        ) from None


@dataclass(frozen=True)
class Campaign(RawFolder):
    """Validated campaign folder.

    Attributes
    ----------
    flights, segments, clocks
        Lines of the tables in config/.
    planned
        True for a flight plan, which has no recordings and possibly no file of the transmitted signal.
    outdated
        Manifests of results that are out of date and therefore not used for plans.

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

    def __repr__(self) -> str:
        """Return one line; `settings` contains the configuration."""
        count = number_of(len(self.flights), "flight")
        return f"<Campaign {self.settings.campaign} in {self.root}: {count}, nodes {', '.join(self.settings.nodes)}>"

    @classmethod
    def load(cls, root: str | Path) -> "Campaign":
        """Read and validate `root`/config; raise CampaignError for the first invalid file."""
        check_name(Path(root))
        root = ConfinedPath.at(root)
        config, table, segments, clocks = (root / path for path in (CONFIG, FLIGHTS, SEGMENTS, CLOCKS))
        settings = read_settings(config)
        flights = tuple(read_flights(table, nodes=settings.nodes))
        images = [f"{flight.name}/{pair}" for flight in flights if flight.kind == "image" for pair in flight.pairs]
        check_interferometry(settings.interferometry, images, where=CONFIG)
        check_stack(settings.stack, images, where=CONFIG)
        imaging = tuple(read_segments(segments, flights=flights))
        campaign = cls(root, settings, flights, imaging, tuple(read_clocks(clocks, flights=flights)))
        campaign.check_radio()
        return campaign

    @property
    def image_flights(self) -> tuple[Flight, ...]:
        """Flights of kind image."""
        return tuple(flight for flight in self.flights if flight.kind == "image")

    @property
    def images(self) -> dict[str, tuple[str, ...]]:
        """Image flight → names of its images: the pairs, and the sums if there are several pairs."""
        return {flight.name: flight.images for flight in self.image_flights}

    def check_images(self) -> None:
        """Raise CampaignError if the campaign has no image flight."""
        if not self.image_flights:
            kinds = ", ".join(dict.fromkeys(flight.kind for flight in self.flights))
            raise CampaignError(
                f"only flights of kind {kinds}",
                where=self.root / FLIGHTS,
                expected="a flight of kind image",
                remedy="Add a flight of kind image, or use `apertura bench` for a stationary radar.",
            )

    @cached_property
    def calibrated(self) -> bool:
        """True if images are calibrated, either by the configured radio of the pairs or by measured constants."""
        if self.settings.processing.radiometric_calibration:
            return True
        radios = (radio_of(self.settings.nodes, pair) for pair in self._pairs)
        return any(value is not None for radio in radios for value in radio.values())

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Sources of kinds ``radiometry`` (none for relative images) and ``multilook`` to be written."""
        processing = self.settings.processing
        coefficients = processing.radiometry if self.calibrated else ()
        of_gamma0 = ("scattering_area", "gamma_sigma_ratio", "ellipsoidal_incidence")
        written = (*coefficients, *(of_gamma0 if "gamma0" in coefficients else ()))
        if processing.multilook is None:
            return written
        averaged = [f"multilook_{name}" for name in coefficients] or ["multilook"]
        noise = ["multilook_noise"] * processing.multilook.subtract_noise
        return (*written, *averaged, *noise, "multilook_coherent", "multilook_noncoherent")

    def check_radio(self) -> None:
        """Check that the radio of the pairs is configured completely or not at all, unless constants are measured."""
        if self.settings.processing.radiometric_calibration:
            return
        sampled = isinstance(self.settings.waveform, SampledWaveform)
        check_radio(self.settings.nodes, self._pairs, sampled=sampled, where=CONFIG)

    @property
    def _pairs(self) -> list[str]:
        return sorted({pair for flight in self.image_flights for pair in flight.pairs})

    @cached_property
    def values(self) -> dict[str, Any]:
        """Settings as JSON values, except scheduler and raw_root, which do not affect results."""
        return self.settings.model_dump(mode="json", exclude={"raw_root": True, "processing": {"scheduler"}})

    @property
    def results(self) -> ConfinedPath:
        """Folder of the results."""
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
        """Return the manifest of a stage, relative to the campaign folder."""
        return "/".join(["results", *where, f"{stage}.manifest.json"])

    def is_current(self, result: ConfinedPath) -> bool:
        """Return True if a stage or document is finished and not `outdated`."""
        from apertura.campaign.store.manifest import manifest_of  # callers have already loaded zarr

        manifest = manifest_of(result)
        return manifest.is_file() and self.relative(manifest) not in self.outdated

    def file(self, name: str, key: str) -> ConfinedPath:
        """Return the file named by config key `key`; raise CampaignError if it is outside the campaign folder."""
        return self.root.named(name, where=f"{CONFIG}: {key}")

    @property
    def sent_path(self) -> ConfinedPath | None:
        """File or Zarr folder of the transmitted signal: codes, pilots or samples of a pulse; None if there is none."""
        key = getattr(self.settings.waveform, "file_key", "")
        stated = getattr(self.settings.waveform, key, "")
        stated = getattr(stated, "pilots", stated)
        return self.file(stated, f"waveform.{key}") if isinstance(stated, str) else None

    @property
    def sent_files(self) -> list[ConfinedPath]:
        """Files of the transmitted signal; none if it is generated."""
        path = self.sent_path
        return [] if path is None else sorted(_files(path))

    def symbol_source(self, flight: str, pair: str) -> str | None:
        """Return the node whose sidelink gives the code symbols of a pair; None if the symbols are known."""
        codes = getattr(self.settings.waveform, "codes", None)
        if not isinstance(codes, SidelinkCodes):
            return None
        transmitter, receiver = pair.split("-")
        nodes = self.flight(flight).participants
        if transmitter != receiver:
            return receiver
        if codes.node is None:
            return next((node for node in nodes if node != transmitter), transmitter)
        if codes.node not in nodes:
            raise CampaignError(
                f"node {codes.node!r} is not part of flight {flight}",
                where=f"{CONFIG}: waveform.codes.node",
                expected=f"one of {', '.join(nodes)}",
                remedy="Correct the node, or remove the key.",
            )
        return codes.node

    @property
    def calibration_file(self) -> ConfinedPath | None:
        """File of the constants measured at reflectors; None if not configured."""
        named = self.settings.processing.radiometric_calibration
        return self.file(named, "processing.radiometric_calibration") if named else None

    def relative(self, path: Path) -> str:
        """Return a path relative to the campaign folder, with forward slashes."""
        return path.relative_to(self.root).as_posix()

    def height_files(self) -> dict[str, ConfinedPath]:
        """Return role → file of the DEM and of the geoid grid, as far as configured."""
        scene = self.settings.scene
        named = {"dem": scene.dem, "geoid": scene.geoid}
        return {role: self.file(name, f"scene.{role}") for role, name in named.items() if name}

    def antennas(self, pair: str) -> dict[str, tuple[str, Antenna]]:
        """Return the antennas of a pair that have beams: radar_tx, radar_rx → node and antenna."""
        nodes = zip(("radar_tx", "radar_rx"), pair.split("-"), strict=True)
        antennas = {point: (name, getattr(self.settings.nodes[name].antennas, point)) for point, name in nodes}
        return {point: (name, antenna) for point, (name, antenna) in antennas.items() if antenna is not None}

    def pattern_files(self, pair: str) -> dict[str, ConfinedPath]:
        """Return config key → file of each sampled pattern of a pair's antennas."""
        named = {
            f"nodes.{node}.antennas.{point}.pattern": antenna.pattern
            for point, (node, antenna) in self.antennas(pair).items()
            if antenna.pattern
        }
        return {key: self.file(name, key) for key, name in named.items()}

    def segments_of(self, flight: str, pair: str) -> list[tuple[str, str]]:
        """Return start and end (UTC) of the track segments from which a pair is imaged; empty for the whole track."""
        return self._segments.get((flight, pair), [])

    @cached_property
    def _segments(self) -> dict[tuple[str, str], list[tuple[str, str]]]:
        own: dict[tuple[str, str], list[tuple[str, str]]] = {}
        for segment in sorted(self.segments, key=lambda row: (row.start, row.end)):
            own.setdefault((segment.flight, segment.pair), []).append((segment.start, segment.end))
        return own

    def clock(self, flight: str, node: str) -> ClockRow:
        """Return the clock of a node's recorder relative to the node's log in a flight."""
        return self._clocks.get((flight, node), ClockRow(flight, node))

    def node(self, flight: str, node: str) -> Node:
        """Return the settings of a node in a flight; clocks.tsv overrides the configured time tag accuracy."""
        stated, std_s = self.settings.nodes[node], self.clock(flight, node).std_s
        return stated if std_s is None else stated.model_copy(update={"time_tag_std_s": std_s})

    @cached_property
    def _clocks(self) -> dict[tuple[str, str], ClockRow]:
        return {(clock.flight, clock.node): clock for clock in self.clocks}

    def flight(self, name: str) -> Flight:
        """Return the flight called `name`; raise CampaignError, which lists all names, if there is no such flight."""
        if name not in self._flights:
            raise CampaignError(
                f"no flight {name!r}",
                where=self.root / FLIGHTS,
                expected=f"one of {', '.join(self._flights)}",
                remedy="Correct the name of the flight, or add it to the table.",
            )
        return self._flights[name]

    @cached_property
    def _flights(self) -> dict[str, Flight]:
        return {flight.name: flight for flight in self.flights}
