"""What a job of each rule asks of a cluster before it runs: memory, minutes, threads, by sizes of files and the config.

Nothing here opens a recording: each job of a thousand flights is asked about while the workflow is put together.
Estimates are from above; a job that was killed for want of memory or time asks for twice as much.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.documents import DAMAGED, read_json
from apertura.common.errors import CampaignError
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform

_CAPTURE_BYTES = 64  # of a recording's metadata at least
_UNKNOWN_PIXELS = 4096**2  # of a grid that is settled by the first flight
_AT_ONCE_PIXELS = 4096**2  # more are read and written by blocks
_AT_ONCE_BYTES = 1_000_000_000  # of range profiles; more are formed by blocks of pulses
_OVERSAMPLING = 2  # of range profiles


@dataclass(frozen=True)
class Work:
    """What a job works on.

    Attributes
    ----------
    recorded_bytes
        Of the recordings of its nodes.
    pulses
        Of one pair, at most.
    profile_bytes
        Of one pair's range profiles.
    pixels
        Of the grid.
    tiles
        Of one image, or of a job's share of them.
    images
        Pairs that it looks at.
    """

    recorded_bytes: int
    pulses: int
    profile_bytes: int
    pixels: int
    tiles: int
    images: int = 1


@dataclass(frozen=True)
class Demand:
    """What a job of one rule takes: a constant, and what grows with its work. One row a rule, from measured runs.

    Attributes
    ----------
    base_mb
        Resident memory whatever the work; what was measured on small work, and half as much again.
    pulse_bytes, pixel_bytes, tile_bytes, image_bytes
        Memory per pulse, per pixel in memory at once, per tile to be formed, and per image that is described.
    profile_share
        Memory per byte of range profiles in memory at once.
    threads
        As many as it can use.
    recorded_s
        Seconds per GB recorded.
    pixel_s
        Seconds per million pixels and image.
    sum_s
        Seconds of one thread per 1e9 pixels times pulses.
    """

    base_mb: float
    pulse_bytes: float = 0.0
    pixel_bytes: float = 0.0
    tile_bytes: float = 0.0
    image_bytes: float = 0.0
    profile_share: float = 0.0
    threads: int = 1
    recorded_s: float = 0.0
    pixel_s: float = 0.0
    sum_s: float = 0.0


_IMAGE = Demand(
    900,
    pulse_bytes=1000,
    pixel_bytes=30,
    tile_bytes=15_000,
    profile_share=3.0,
    threads=4,
    recorded_s=30,
    pixel_s=5,
    sum_s=3,
)

DEMANDS: Mapping[str, Demand] = {
    "ingest": Demand(250, pulse_bytes=100, recorded_s=60),
    "echo": Demand(400, pulse_bytes=400, recorded_s=120),
    "calibrate": Demand(500, pulse_bytes=1000, recorded_s=60),
    "scene": Demand(400, pulse_bytes=500),
    "terrain": Demand(500, pixel_bytes=50, pixel_s=10),
    "layers": Demand(600, pulse_bytes=500, pixel_bytes=30, pixel_s=5, recorded_s=20, threads=2),
    "coverage": Demand(600, pulse_bytes=500, pixel_s=1),
    "profile": Demand(500, pulse_bytes=500, recorded_s=120),
    "refine": Demand(600, pulse_bytes=40_000, pixel_bytes=30, pixel_s=10, recorded_s=120),
    "tiles": _IMAGE,
    "image": _IMAGE,
    "assess": Demand(500, pulse_bytes=500, pixel_bytes=30, pixel_s=5),
    "cube": Demand(500, pixel_bytes=50, pixel_s=10),
    "interferogram": Demand(600, pulse_bytes=1000, pixel_bytes=700, pixel_s=60),
    "cphd": Demand(500, pulse_bytes=500, recorded_s=120),
    "export": Demand(500, pixel_bytes=50, pixel_s=30),
    "export_fused": Demand(500, pixel_bytes=50, pixel_s=30),
    "mosaic": Demand(500),
    "stac": Demand(400, image_bytes=200_000),
    "ro_crate": Demand(350, image_bytes=1_000_000),
    "pictures": Demand(600, pulse_bytes=2000, pixel_s=5, recorded_s=60),
    "page": Demand(500, pixel_s=5),
    "map": Demand(500, pixel_s=1),
    "speed_accuracy": Demand(2000, profile_share=3.0, recorded_s=600),
    "whole_chart": Demand(2000, profile_share=3.0, recorded_s=1200),
}
"""Rule → what its jobs take."""

_BESIDE_MB = 300  # Snakemake, twice: a batch system counts them as the job's
_LEAST_MINUTES = 10  # the start on a busy node, and a file system that is slow to answer
_SLOWER = 3  # than the machine that the constants are from


@dataclass(frozen=True)
class Resources:
    """What the jobs of a campaign's rules ask for; rules quote its methods, and Snakemake calls them.

    Examples
    --------
    >>> Resources(Campaign.load("nowhere"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/config/config.yaml: no such file; ...
    """

    campaign: Campaign

    def __getitem__(self, rule: str) -> "RuleResources":
        """Return what the jobs of a rule ask for."""
        return RuleResources(DEMANDS[rule], self)

    def work(self, flight: str | None, pair: str | None, node: str | None, jobs: int = 1) -> Work:
        """Return what a job works on: a node's recording, a pair, a flight, or all of them.

        Parameters
        ----------
        flight, pair, node
            Wildcards of the job; None where it has none.
        jobs
            That share the tiles of an image.
        """
        campaign = self.campaign
        flights = [campaign.flight(flight)] if flight else list(campaign.image_flights or campaign.flights)
        first = flights[0]
        images = 1 if pair or node else sum(len(one.pairs) for one in flights)
        nodes = [node] if node else dict.fromkeys(pair.split("-") if pair else first.participants)
        if not isinstance(campaign.settings.waveform, SampledWaveform):  # all that is recorded lies with the receivers
            nodes = [node for node in nodes if node in first.nodes]
        recorded = [self._recorded(first.name, name) for name in nodes]
        pulses = max((pulses for _, pulses in recorded), default=0)
        rows, columns = self._shape
        side = campaign.settings.processing.tile_px
        tiles = math.ceil(rows / side) * math.ceil(columns / side)
        return Work(
            recorded_bytes=sum(size for size, _ in recorded),
            pulses=pulses,
            profile_bytes=8 * pulses * self._range_samples,
            pixels=math.ceil(rows * columns / jobs),
            tiles=math.ceil(tiles / jobs),
            images=images,
        )

    @cached_property
    def _recorded(self) -> Any:
        return cache(self._bytes_and_pulses)

    def _bytes_and_pulses(self, flight: str, node: str) -> tuple[int, int]:
        """Return the bytes of a recording and how many pulses it has at most."""
        waveform = self.campaign.settings.waveform
        if not isinstance(waveform, SampledWaveform):
            size = sum(path.stat().st_size for path in self.campaign.raw_files(flight, node).values())
            return size, size // 1000
        files = [path.stat().st_size for path in self.campaign.recording_files(flight, node)]
        samples = files[-1] / 4
        ran_through = samples / waveform.sample_rate_hz * waveform.prf_hz  # one capture, of all pulses
        return sum(files), math.ceil(
            min(samples / waveform.needed_samples, max(files[0] / _CAPTURE_BYTES, ran_through))
        )

    @cached_property
    def _shape(self) -> tuple[int, int]:
        """Rows and columns: as settled, as asked for, or of a large image where nobody knows yet."""
        asked = self.campaign.settings.scene
        with suppress(CampaignError, LookupError, TypeError, ValueError):  # not there, or damaged
            settled = read_json(self.campaign.result("scene.json"), expected="a settled scene", remedy=DAMAGED)
            rows, columns = map(int, settled["grid"]["shape"])
            return rows, columns
        if asked.bounds_m == "auto" or asked.spacing_m == "auto":
            return math.isqrt(_UNKNOWN_PIXELS), math.isqrt(_UNKNOWN_PIXELS)
        xmin, ymin, xmax, ymax = asked.bounds_m
        return math.ceil((ymax - ymin) / asked.spacing_m), math.ceil((xmax - xmin) / asked.spacing_m)

    @cached_property
    def _range_samples(self) -> int:
        """How many samples a range profile has at most: those of the whole period, or of the scene's depth."""
        waveform, asked = self.campaign.settings.waveform, self.campaign.settings.scene
        if not isinstance(waveform, SampledWaveform):
            return 1000
        whole = _OVERSAMPLING * waveform.most_subcarriers
        if asked.bounds_m == "auto":
            return whole
        xmin, ymin, xmax, ymax = asked.bounds_m
        depth_m = 2 * math.hypot(xmax - xmin, ymax - ymin)
        cells = depth_m * waveform.widest_band_hz / SPEED_OF_LIGHT_M_S
        return min(whole, 64 + math.ceil(1.1 * _OVERSAMPLING * cells))


@dataclass(frozen=True)
class RuleResources:
    """What the jobs of one rule ask for, as Snakemake calls it: by the wildcards of a job."""

    demand: Demand
    of: Resources

    def threads(self, wildcards: Any) -> int:
        """Return how many threads a job can use: not more than it has tiles, where it forms them."""
        return max(1, min(self.demand.threads, self._work(wildcards).tiles))

    def mem_mb(self, wildcards: Any, attempt: int) -> int:
        """Return the memory of a job, MB of 1e6 bytes; twice as much at each further attempt."""
        work, demand = self._work(wildcards), self.demand
        grows = demand.pulse_bytes * work.pulses
        grows += demand.pixel_bytes * min(work.pixels, _AT_ONCE_PIXELS)
        grows += demand.image_bytes * work.images + demand.tile_bytes * work.tiles
        grows += demand.profile_share * min(work.profile_bytes, _AT_ONCE_BYTES)
        return math.ceil(_BESIDE_MB + demand.base_mb + grows / 1e6) << attempt - 1

    def runtime(self, wildcards: Any, attempt: int) -> int:
        """Return the time limit of a job, minutes; twice as much at each further attempt."""
        work, demand = self._work(wildcards), self.demand
        seconds = demand.recorded_s * work.recorded_bytes / 1e9 + demand.pixel_s * work.images * work.pixels / 1e6
        seconds += demand.sum_s * work.images * work.pixels * work.pulses / 1e9
        return _LEAST_MINUTES + math.ceil(_SLOWER * seconds / 60) << attempt - 1

    def _work(self, wildcards: Any) -> Work:
        flight, pair, node = (getattr(wildcards, name, None) for name in ("flight", "pair", "node"))
        share = getattr(wildcards, "scatteritem", "1-of-1")
        return self.of.work(flight, pair, node, jobs=int(share.split("-of-")[1]))
