"""A campaign folder as one value: settings, flights and paths."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.pipeline.config import (
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
    check_interferometry,
    check_radio,
    radio_of,
    read_clocks,
    read_flights,
    read_segments,
    read_settings,
)
from apertura.pipeline.raw_folder import RawFolder


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
        """Whether the radio of its pairs is stated, or their constants were measured, so that images are calibrated."""
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
        """Return whether a stage or document is finished and not `outdated`."""
        from apertura.pipeline.store.manifest import manifest_of  # whoever asks has the store's arrays loaded

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
        """Return which antennas of a pair have beams: radar_tx, radar_rx → node and antenna."""
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
