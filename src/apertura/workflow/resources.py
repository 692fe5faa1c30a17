"""Resources of a job of each rule, by sizes of files and the config: of a cluster, and time on this machine.

Nothing here opens a recording: it runs for each job of a thousand flights while the workflow is put together.
Estimates are from above; a job that was killed for want of memory or time asks for twice as much.
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

_CAPTURE_BYTES = 64  # of a recording's metadata at least
_UNKNOWN_PIXELS = 4096**2  # of a grid that is settled by the first flight
_USUAL_MPX = 0.25  # of such a grid, as most are
_AT_ONCE_PIXELS = 4096**2  # more are read and written by blocks
_AT_ONCE_BYTES = 1_000_000_000  # of range profiles; more are formed by blocks of pulses
_OVERSAMPLING = 2  # of range profiles


@dataclass(frozen=True)
class Work:
    """Amount of work of a job.

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


_BESIDE_MB = 300  # Snakemake, twice: a batch system counts them as the job's
_LEAST_MINUTES = 10  # the start on a busy node, and a file system that is slow to answer
_SLOWER = 3  # than the machine that the constants are from


@dataclass(frozen=True)
class Resources:
    """Resources of the jobs of a campaign's rules; rules quote its methods, and Snakemake calls them.

    Attributes
    ----------
    campaign
        Settings and flights.
    planned
        Flight and node → bytes and pulses of recordings that are not there yet; None: they lie in raw/.

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
        """Return the expected time of a job of a rule on this machine, seconds.

        Parameters
        ----------
        rule
            The rule's name; any other counts as one that is soon done.
        *where
            Words of its job, first the values of its wildcards; what the campaign does not have counts for nothing.
        """
        row = RULES.get(rule)
        cost = row.cost if row else Cost()
        wildcards = row.of.wildcards if row else ()
        counts = cost.mb_s or cost.mb_mpx_s
        recorded_mb = self._recorded_mb(dict(zip(wildcards, where, strict=False))) if counts else 0.0
        rows, columns = self._shape or (0, 0)
        mpx = rows * columns / 1e6 if self._shape else _USUAL_MPX
        return cost.begin_s + cost.mb_s * recorded_mb + cost.mpx_s * mpx + cost.mb_mpx_s * recorded_mb * mpx

    def _recorded_mb(self, stated: dict[str, str]) -> float:
        """Return the recorded megabytes of the nodes of a job; 0 for names that are not in the campaign."""
        flight, pair, node = (stated.get(word) for word in ("flight", "pair", "node"))
        named = [name for name in (node, *(pair or "").split("-")) if name]
        known = flight in {each.name for each in self.campaign.flights} and {*named} <= {*self.campaign.settings.nodes}
        with suppress(CampaignError, OSError):  # not there yet
            return self.work(flight, pair, node).recorded_bytes / 1e6 if known else 0.0
        return 0.0

    def work(self, flight: str | None, pair: str | None, node: str | None, jobs: int = 1) -> Work:
        """Return the work of a job: of a node's recording, a pair, a flight, or all of them.

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
        """Return the bytes of a recording and how many pulses it has at most."""
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
        ran_through = samples / waveform.sample_rate_hz * waveform.prf_hz  # one capture, of all pulses
        return sum(files), math.ceil(
            min(samples / waveform.needed_samples, max(files[0] / _CAPTURE_BYTES, ran_through))
        )

    def _captures(self, flight: str, node: str) -> int:
        """Count the captures in stage `raw` of a recording that is not there; 0 where it is not known."""
        with suppress(CampaignError, LookupError, TypeError, ValueError):
            path = self.campaign.stage("raw", flight, node) / "start" / "zarr.json"
            return int(read_json(path, expected="an array of stage raw", remedy=DAMAGED)["shape"][0])
        return 0

    @cached_property
    def _shape(self) -> tuple[int, int] | None:
        """Rows and columns: as settled, or as the config says; None where they are not known yet."""
        scene = self.campaign.settings.scene
        with suppress(CampaignError, LookupError, TypeError, ValueError):  # not there, or damaged
            settled = read_json(self.campaign.result("scene.json"), expected="a settled scene", remedy=DAMAGED)
            rows, columns = map(int, settled["grid"]["shape"])
            return rows, columns
        if scene.bounds_m == "auto" or scene.spacing_m == "auto":
            return None
        xmin, ymin, xmax, ymax = scene.bounds_m
        return math.ceil((ymax - ymin) / scene.spacing_m), math.ceil((xmax - xmin) / scene.spacing_m)

    @cached_property
    def _range_samples(self) -> int:
        """Largest number of samples of a range profile: of the whole period, or of the scene's depth."""
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
    """Resources of the jobs of one rule, as Snakemake calls them: by the wildcards of a job."""

    demand: Demand
    of: Resources

    def threads(self, wildcards: Any) -> int:
        """Return the threads of a job: not more than it has tiles, where it forms them."""
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
