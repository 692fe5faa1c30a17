"""Cluster resources and run time of the jobs of each rule, estimated from file sizes and the config.

No recording is opened, because Snakemake calls these functions for each job of up to a thousand flights when it builds
the workflow. The resources are upper bounds. A job that is killed at its memory or time limit is restarted with twice
the resources.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

from apertura.campaign.config import SampledWaveform
from apertura.campaign.folder import Campaign, size_of
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.documents import DAMAGED, read_json
from apertura.common.errors import CampaignError
from apertura.workflow.rules import RULES, Cost, Demand

_CAPTURE_BYTES = 64  # minimum size of the metadata of a capture
_UNKNOWN_PIXELS = 4096**2  # pixels assumed for resources if the grid is still to be derived from the first flight
_USUAL_MPX = 0.25  # megapixels assumed for run times in this case
_AT_ONCE_PIXELS = 4096**2  # maximum number of pixels in memory at a time; larger rasters are processed in blocks
_AT_ONCE_BYTES = 1_000_000_000  # maximum size of range profiles in memory at a time; pulses are processed in blocks
_OVERSAMPLING = 2  # oversampling of range profiles


@dataclass(frozen=True)
class Work:
    """Amount of work of a job.

    Attributes
    ----------
    recorded_bytes
        Size of the recordings of the job's nodes.
    pulses
        Largest number of pulses of a pair.
    profile_bytes
        Size of the range profiles of a pair.
    pixels
        Number of pixels of the grid.
    tiles
        Number of tiles of an image, or of the part of the image that the job forms.
    images
        Number of images.
    """

    recorded_bytes: int
    pulses: int
    profile_bytes: int
    pixels: int
    tiles: int
    images: int = 1


_SNAKEMAKE_MB = 300  # memory of two Snakemake processes, which a batch system counts as part of the job
_LEAST_MINUTES = 10  # allowance for the start on a busy machine and for slow file systems
_SLOWER = 3  # assumed ratio of run times to those on the machine on which the constants were measured


@dataclass(frozen=True)
class Resources:
    """Resources of the jobs of all rules for a campaign.

    Attributes
    ----------
    campaign
        Campaign with settings and flights.
    planned
        Flight and node → bytes and pulses of planned recordings; None if recordings are in raw/.

    Examples
    --------
    >>> Resources(Campaign.load("nowhere"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/config/config.yaml: no such file; ...
    """

    campaign: Campaign
    planned: Mapping[tuple[str, str], tuple[int, int]] | None = None

    def __getitem__(self, rule: str) -> "RuleResources":
        """Return the resources of the jobs of a rule."""
        demand = RULES[rule].demand
        if demand is None:
            raise LookupError(rule)
        return RuleResources(demand, self)

    def expected_seconds(self, rule: str, *where: str) -> float:
        """Return the expected run time of a job of a rule on this machine, seconds.

        Parameters
        ----------
        rule
            Name of the rule; for an unknown name, the default cost is returned.
        *where
            Arguments of the job, beginning with the values of its wildcards; names unknown in the campaign are ignored.
        """
        row = RULES.get(rule)
        cost = row.cost if row else Cost()
        wildcards = row.of.wildcards if row else ()
        needs_size = cost.mb_s or cost.mb_mpx_s
        recorded_mb = self._recorded_mb(dict(zip(wildcards, where, strict=False))) if needs_size else 0.0
        rows, columns = self._shape or (0, 0)
        mpx = rows * columns / 1e6 if self._shape else _USUAL_MPX
        return cost.begin_s + cost.mb_s * recorded_mb + cost.mpx_s * mpx + cost.mb_mpx_s * recorded_mb * mpx

    def _recorded_mb(self, stated: dict[str, str]) -> float:
        """Return the size of the recordings of a job's nodes, MB; 0 for names that are unknown in the campaign."""
        flight, pair, node = (stated.get(word) for word in ("flight", "pair", "node"))
        named = [name for name in (node, *(pair or "").split("-")) if name]
        known = flight in {each.name for each in self.campaign.flights} and {*named} <= {*self.campaign.settings.nodes}
        with suppress(CampaignError, OSError):  # recording missing
            return self.work(flight, pair, node).recorded_bytes / 1e6 if known else 0.0
        return 0.0

    def work(self, flight: str | None, pair: str | None, node: str | None, jobs: int = 1) -> Work:
        """Return the work of a job on a node's recording, a pair, a flight or the campaign.

        Parameters
        ----------
        flight, pair, node
            Wildcards of the job; None for wildcards that the job does not have.
        jobs
            Number of jobs among which the tiles of an image are divided.
        """
        campaign = self.campaign
        flights = [campaign.flight(flight)] if flight else list(campaign.image_flights or campaign.flights)
        first = flights[0]
        images = 1 if pair or node else sum(len(each.pairs) for each in flights)
        nodes = [node] if node else dict.fromkeys(pair.split("-") if pair else first.participants)
        if not isinstance(campaign.settings.waveform, SampledWaveform):  # only receivers record phase histories
            nodes = [node for node in nodes if node in first.nodes]
        recorded = [self._recorded(first.name, name) for name in nodes]
        pulses = max((pulses for _, pulses in recorded), default=0)
        rows, columns = self._shape or (math.isqrt(_UNKNOWN_PIXELS), math.isqrt(_UNKNOWN_PIXELS))
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
        """Return the size of a recording in bytes, and an upper bound of its number of pulses."""
        if self.planned is not None:
            return self.planned[flight, node]
        waveform = self.campaign.settings.waveform
        if not isinstance(waveform, SampledWaveform):
            size = sum(map(size_of, self.campaign.raw_files(flight, node).values()))
            return size, size // 1000
        paths = self.campaign.promised_files(flight, node)
        files = [size_of(path) for path in paths]
        if not paths[-1].is_file():
            return sum(files), self._captures(flight, node)
        samples = files[-1] / 4
        continuous = samples / waveform.sample_rate_hz * waveform.prf_hz  # pulses of a continuous recording
        return sum(files), math.ceil(min(samples / waveform.needed_samples, max(files[0] / _CAPTURE_BYTES, continuous)))

    def _captures(self, flight: str, node: str) -> int:
        """Return the number of captures in stage `raw` of a missing recording; 0 if the number is unknown."""
        with suppress(CampaignError, LookupError, TypeError, ValueError):
            path = self.campaign.stage("raw", flight, node) / "start" / "zarr.json"
            return int(read_json(path, expected="an array of stage raw", remedy=DAMAGED)["shape"][0])
        return 0

    @cached_property
    def _shape(self) -> tuple[int, int] | None:
        """Rows and columns of the grid from scene.json or the config; None if not yet known."""
        scene = self.campaign.settings.scene
        with suppress(CampaignError, LookupError, TypeError, ValueError):  # scene.json missing or damaged
            document = read_json(self.campaign.result("scene.json"), expected="the campaign's grid", remedy=DAMAGED)
            rows, columns = map(int, document["grid"]["shape"])
            return rows, columns
        if scene.bounds_m == "auto" or scene.spacing_m == "auto":
            return None
        xmin, ymin, xmax, ymax = scene.bounds_m
        return math.ceil((ymax - ymin) / scene.spacing_m), math.ceil((xmax - xmin) / scene.spacing_m)

    @cached_property
    def _range_samples(self) -> int:
        """Maximum number of samples in a range profile, limited by the unambiguous range or the depth of the scene."""
        waveform, scene = self.campaign.settings.waveform, self.campaign.settings.scene
        if not isinstance(waveform, SampledWaveform):
            return 1000
        whole = _OVERSAMPLING * waveform.most_subcarriers
        if scene.bounds_m == "auto":
            return whole
        xmin, ymin, xmax, ymax = scene.bounds_m
        depth_m = 2 * math.hypot(xmax - xmin, ymax - ymin)
        cells = depth_m * waveform.widest_band_hz / SPEED_OF_LIGHT_M_S
        return min(whole, 64 + math.ceil(1.1 * _OVERSAMPLING * cells))


@dataclass(frozen=True)
class RuleResources:
    """Resources of the jobs of a rule for Snakemake, as functions of the wildcards of a job."""

    demand: Demand
    of: Resources

    def threads(self, wildcards: Any) -> int:
        """Return the number of threads of a job, which does not exceed the number of tiles."""
        return max(1, min(self.demand.threads, self._work(wildcards).tiles))

    def mem_mb(self, wildcards: Any, attempt: int) -> int:
        """Return the memory of a job, MB of 1e6 bytes; the value doubles with each attempt."""
        work, demand = self._work(wildcards), self.demand
        grows = demand.pulse_bytes * work.pulses
        grows += demand.pixel_bytes * min(work.pixels, _AT_ONCE_PIXELS)
        grows += demand.image_bytes * work.images + demand.tile_bytes * work.tiles
        grows += demand.profile_share * min(work.profile_bytes, _AT_ONCE_BYTES)
        return math.ceil(_SNAKEMAKE_MB + demand.base_mb + grows / 1e6) << attempt - 1

    def runtime(self, wildcards: Any, attempt: int) -> int:
        """Return the time limit of a job, minutes; the value doubles with each attempt."""
        work, demand = self._work(wildcards), self.demand
        seconds = demand.recorded_s * work.recorded_bytes / 1e9 + demand.pixel_s * work.images * work.pixels / 1e6
        seconds += demand.sum_s * work.images * work.pixels * work.pulses / 1e9
        return _LEAST_MINUTES + math.ceil(_SLOWER * seconds / 60) << attempt - 1

    def _work(self, wildcards: Any) -> Work:
        flight, pair, node = (getattr(wildcards, name, None) for name in ("flight", "pair", "node"))
        share = getattr(wildcards, "scatteritem", "1-of-1")
        return self.of.work(flight, pair, node, jobs=int(share.split("-of-")[1]))
