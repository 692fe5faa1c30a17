"""`apertura preview`: quicklooks, verdicts, a page and a map in results/preview, updated until the recordings end."""

import json
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache, cached_property
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura import __version__
from apertura.campaign.config import CONFIG, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.common.atomic import write_json, write_text
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.processes import as_typed
from apertura.common.provenance import sha256_file
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.planning.plan import Plan
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import MAP, PREVIEW
from apertura.formats.export.cog import power, write_cog
from apertura.formats.export.db import DB, decibels
from apertura.formats.export.quicklook import write_quicklook
from apertura.stages.pair import open_pair
from apertura.stages.scene import ConfiguredGround, Flown, settled
from apertura.stages.transfer import PairEcho, recorded_echo
from apertura.stages.transmitted import transmitted
from apertura.tools.preview.node import NodeSoFar
from apertura.tools.preview.pair import PairSoFar, PulseBlock
from apertura.views.quality import explained_flags
from apertura.views.webmap.document import Layer, Place, crs_of, map_document, stated_places, true_places, url_of

_POLLS = 2  # number of polls of the files per update of the images
_BEHIND = 3  # delay, in update intervals, above which the decimation of pulses is doubled
_AT_EASE = 0.3  # fraction of busy time below which the decimation is halved
_MOST_DECIMATED = 64


class Preview:
    """Live view of a campaign.

    Parameters
    ----------
    campaign
        A campaign whose recordings may still grow.
    follow
        True to read the recordings while they grow, False to read them once.
    every_s
        Interval between updates of the images, seconds.
    end_after_s
        Time without new data after which the recordings are considered finished, seconds. Recordings are also finished
        when their metadata contain the hash of their samples and all samples are present.
    threads
        Number of tiles formed in parallel.

    Raises
    ------
    CampaignError
        If the campaign has no images, or a recording cannot be read while it grows.
    """

    def __init__(
        self, campaign: Campaign, *, follow: bool, every_s: float = 5.0, end_after_s: float = 10.0, threads: int = 1
    ) -> None:
        campaign.check_images()
        self.campaign, self.follow, self.every_s, self.end_after_s = campaign, follow, every_s, end_after_s
        self.finish = threading.Event()
        """Event that is set when the recordings have ended."""
        self.decimated, self.busy_s = 1, 0.0
        self._map = LiveMap(campaign, PREVIEW, every_s=every_s)
        self._delay_s = np.inf  # at the previous update
        self._reported = set[str]()  # file errors that were printed already
        waveform = campaign.settings.waveform
        self.nodes: dict[tuple[str, str], NodeSoFar] = {}
        self.pairs: list[PairSoFar] = []
        self._settled: tuple[SceneGrid, ConfiguredGround] | None = None
        if not isinstance(waveform, SampledWaveform):
            if follow:
                raise CampaignError(
                    f"waveform.kind {waveform.kind}, whose files cannot be read before they are complete",
                    campaign.root / CONFIG,
                    "ofdm or samples, recorded as SigMF, for --follow",
                    "Use apertura preview without --follow when the files are complete.",
                )
            for flight in campaign.image_flights:
                for pair in flight.pairs:
                    echo = PairEcho.recorded(recorded_echo(campaign, flight.name, pair))
                    echo = echo.within(campaign, flight.name, pair)
                    self.pairs.append(PairSoFar(campaign, flight.name, pair, self._scene, echo))
            return
        check_bounds(campaign, follow=follow)
        sent, plans = transmitted(campaign, waveform), dict[int, Plan]()
        for flight in campaign.image_flights:
            for node in flight.participants:
                self.nodes[flight.name, node] = NodeSoFar(campaign, flight.name, node, sent, follow=follow)
            for pair in flight.pairs:
                tx, rx = (self.nodes[flight.name, node] for node in pair.split("-"))
                decided_by = campaign.symbol_source(flight.name, pair)
                source = None if decided_by in {None, rx.name} else self.nodes[flight.name, str(decided_by)]
                self.pairs.append(
                    PairSoFar(campaign, flight.name, pair, self._scene, None, tx, rx, sent, threads, plans, source)
                )

    def _scene(self, block: PulseBlock) -> tuple[SceneGrid, ConfiguredGround]:
        """Return the common grid of all pairs and its terrain; automatic settings are determined once.

        Automatic settings are derived from all data read so far, or with `follow` from the first block; `follow`
        requires configured bounds.
        """
        if self._settled is None:
            campaign, history = self.campaign, block.history
            of_block = Flown(history.aperture, history.frequency_hz, np.inf)
            self._settled = settled(campaign, cache(lambda: of_block if self.follow else self._flown()))[:2]
        return self._settled

    def _flown(self) -> Flown:
        """Return the joint geometry of all pairs of the first flight from its logs."""
        pairs = [pair for pair in self.pairs if pair.flight == self.pairs[0].flight]
        times = [None if pair.tx is None else pair.tx.time for pair in pairs]
        opened = (
            open_pair(self.campaign, pair.flight, pair.name, recorded=time)
            for pair, time in zip(pairs, times, strict=True)
        )
        return Flown.together([pair.flown for pair in opened])

    def _read(self) -> bool:
        """Read new data and reset the pairs of restarted recordings; return True if there were new data."""
        grown = [node.read() for node in self.nodes.values()]
        for node in self.nodes.values():
            # before the first data, the status lines of the pairs report the reason for waiting
            if node.waits and self.follow and node.has_read and node.waits not in self._reported:
                self._reported.add(node.waits)
                print(
                    f"{datetime.now(UTC):%H:%M:%S}  files of {node.name} are not readable at present: {node.waits}",
                    flush=True,
                )
            if not node.restart:
                continue
            print(f"{datetime.now(UTC):%H:%M:%S}  {node.restart}", flush=True)
            node.restart = ""
            for number, pair in enumerate(self.pairs):
                if node in pair.nodes:
                    self._map.drop(pair)
                    self._picture(pair).unlink(missing_ok=True)
                    self.pairs[number] = pair.reset()
        return any(grown)

    def run(self) -> None:
        """Read data and update the images until the recordings end, then complete the fine images."""
        poll_s, shown_at, ended = self.every_s / _POLLS, time.monotonic(), False
        self._map.begin()
        while not ended:
            polled = time.monotonic()
            grown = self._read()
            grown_at = [node.grown_at for node in self.nodes.values() if node.grown_at is not None]
            idle = bool(grown_at) and time.monotonic() - max(grown_at) > self.end_after_s
            complete = not grown and all(node.complete for node in self.nodes.values())
            ended = not self.follow or self.finish.is_set() or idle or complete
            if self.follow and idle and not (complete or self.finish.is_set()):
                missing = "; ".join(node.missing for node in self.nodes.values() if node.missing)
                print(f"finished: no new data for {self.end_after_s:g} s (--end-after); {missing}", flush=True)
            self._add(ended=ended, until=shown_at + self.every_s)
            self.busy_s += time.monotonic() - polled
            while not ended and time.monotonic() < polled + poll_s and any(pair.refine_next() for pair in self.pairs):
                pass
            if ended or time.monotonic() >= shown_at + self.every_s:
                while ended and any(pair.refine_next() for pair in self.pairs):
                    pass
                self.show(ended=ended, elapsed_s=time.monotonic() - shown_at)
                shown_at = time.monotonic()
            elif not ended:
                self.finish.wait(max(0.0, polled + poll_s - time.monotonic()))

    def _add(self, *, ended: bool, until: float) -> None:
        """Add new pulses to the images, one block for each pair in turn, until the next update is due."""
        more = True
        while more and (ended or time.monotonic() < until):
            added = [pair.add_next(ended=ended, every=self.decimated) for pair in self.pairs]
            more = any(added)

    def show(self, *, ended: bool, elapsed_s: float) -> None:
        """Write quicklooks, status and page, print a line for each pair, and adapt the decimation to the delay."""
        began = time.monotonic()
        pairs = {}
        for pair in self.pairs:
            report = self.show_pair(pair)
            pairs[f"{pair.flight}/{pair.name}"] = report
            print(f"{datetime.now(UTC):%H:%M:%S}  {_line(pair, report, self.decimated)}", flush=True)
        delays = [report["delay_s"] for report in pairs.values() if report["delay_s"] is not None]
        status = {
            "campaign": self.campaign.settings.campaign,
            "shown": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
            "state": "ended" if ended else "following",
            "one_pulse_in": self.decimated,
            "pairs": pairs,
        }
        folder = self.campaign.result(PREVIEW)
        write_json(folder / "status.json", status)
        self._map.write(ended=ended)
        write_text(folder / "index.html", _page(status, refresh_s=0 if ended else max(1, round(self.every_s))))
        self.busy_s += time.monotonic() - began
        busy = self.busy_s / max(elapsed_s, 1e-3)
        self.busy_s = 0.0
        delay_s, previous_s = max(delays, default=0.0), self._delay_s
        self._delay_s = delay_s if delays else previous_s
        if not ended and delay_s > max(previous_s, _BEHIND * self.every_s):  # large and increasing
            self.decimated = min(_MOST_DECIMATED, 2 * self.decimated)
        elif busy < _AT_EASE and self.decimated > 1:
            self.decimated //= 2

    def show_pair(self, pair: PairSoFar) -> dict[str, Any]:
        """Write the quicklook of a pair; return its status report."""
        shown = pair.shown
        report: dict[str, Any] = {"pulses": pair.counts, "waits": pair.waits, "delay_s": None, "image": None}
        if shown is None or not shown.sums.any():
            return report
        judged, bound_db = pair.judged(), float(shown.error_db)
        error_db = round(bound_db, 1) if np.isfinite(bound_db) else None
        report |= {"peak": shown.peak, **judged, "flags": Flags.merged(pair.flags, shown.flags, judged["flags"])}
        report |= {"share": shown.share, "error_db": error_db}
        report |= {"spacing_m": shown.grid.spacing_m, "setting": shown.setting}
        report["delay_s"] = pair.delay_s
        path = self._picture(pair)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._draw(path, pair, report)
        self._map.add(pair, report)
        if pair.tx is not None:
            pair.tx.read()
            if pair.tx.restart:
                return {"pulses": pair.reset().counts, "waits": "", "delay_s": None, "image": None}
        report |= {"delay_s": pair.delay_s, "pulses": pair.counts}  # after writing the quicklook
        report["image"] = f"{pair.flight}/{pair.name}.png"
        return report

    def _picture(self, pair: PairSoFar) -> Path:
        return self.campaign.result(PREVIEW, pair.flight, f"{pair.name}.png")

    def _draw(self, path: Path, pair: PairSoFar, report: Mapping[str, Any]) -> None:
        shown = pair.shown
        if shown is None:
            raise TypeError("the pair has no image yet")
        image, grid = shown.image, shown.grid
        image[image == 0] = np.complex64(complex(np.nan, np.nan))  # not illuminated so far
        focus = {"verdict": report["verdict"], **({"loss_db": report["loss_db"]} if "loss_db" in report else {})}
        tags = {
            "APERTURA_VERSION": __version__,
            "APERTURA_FOCUS": json.dumps(focus),
            **({} if report["error_db"] is None else {"APERTURA_ERROR_DB": f"{report['error_db']:g}"}),
            **({"APERTURA_FLAGS": json.dumps(report["flags"])} if report["flags"] else {}),
        }
        write_quicklook(
            path,
            image,
            **placed_on(grid),
            tags=tags,
            title=f"{self.campaign.settings.campaign} · {pair.flight} {pair.name}, so far",
            subtitle=_subtitle(pair, report, self.decimated),
            markers=[(report["peak"]["x_m"], report["peak"]["y_m"], "peak")],
        )


def check_bounds(campaign: Campaign, *, follow: bool) -> None:
    """Raise CampaignError if `follow` is set and the scene bounds would be determined from the whole flight."""
    if follow and campaign.settings.scene.bounds_m == "auto":
        raise CampaignError(
            "auto, which requires the complete flight",
            where=f"{campaign.root / CONFIG}: scene.bounds_m",
            expected="configured bounds for --follow",
            remedy="Set scene.bounds_m.",
        )


@contextmanager
def finished_by_interrupt(preview: Preview) -> Iterator[None]:
    """Handle the first Ctrl-C as the end of the recordings; a second Ctrl-C stops the command."""

    def finish(_: int, __: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        print("finishing with the data read so far; press Ctrl-C again to stop", flush=True)
        preview.finish.set()

    before = signal.signal(signal.SIGINT, finish)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def run_preview(campaign: Campaign, *, follow: bool, every_s: float, end_after_s: float, threads: int) -> None:
    """Display images of the pulses recorded so far; with `follow`, update the images until the recordings end."""
    preview = Preview(campaign, follow=follow, every_s=every_s, end_after_s=end_after_s, threads=threads)
    print(f"images are shown in {as_typed(campaign.result(PREVIEW, 'index.html'))}", flush=True)
    if not follow:
        preview.run()
        return
    with finished_by_interrupt(preview):
        preview.run()


# ---- Text -----------------------------------------------------------------------------------------------------------


def _decimation_text(every: int) -> str:
    return f"1 pulse in {every}" if every > 1 else ""


def _delay_text(delay_s: float | None) -> str:
    return "" if delay_s is None else f"{delay_s:.1f} s behind"


def _resolution_text(report: Mapping[str, Any]) -> str:
    level = "coarse: half the bandwidth, every 2nd pixel" if report["share"] == 2 else "fine"
    return f"{level} ({report['spacing_m']:g} m)"


def _subtitle(pair: PairSoFar, report: Mapping[str, Any], every: int) -> str:
    until = "" if pair.until is None else f"{str(pair.until)[11:21]}Z"
    parts = (
        f"{report['pulses']['added']} pulses until {until}",
        _delay_text(report["delay_s"]),
        _decimation_text(every),
        _resolution_text(report),
    )
    return " · ".join(part for part in parts if part)


def _line(pair: PairSoFar, report: Mapping[str, Any], every: int) -> str:
    name, counts = f"{pair.flight} {pair.name}", report["pulses"]
    if report["image"] is None:
        return f"{name}: no image yet, {counts['recorded']} pulses recorded{report['waits'] and '; '}{report['waits']}"
    parts = (
        f"{counts['added']} of {counts['recorded']} pulses",
        _delay_text(report["delay_s"]),
        _decimation_text(every),
        _resolution_text(report),
        report["verdict"],
        f"peak at {report['peak']['x_m']:.2f}, {report['peak']['y_m']:.2f}",
        ", ".join(flag for flag in report["flags"] if flag != report["verdict"]),
    )
    return f"{name}: {'; '.join(part for part in parts if part)}"


_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8">
{%- if refresh_s %}<meta http-equiv="refresh" content="{{ refresh_s }}">{% endif -%}
<title>{{ status.campaign }}, so far</title><style>
body{font-family:sans-serif;margin:1em}section{display:inline-block;vertical-align:top;max-width:48em}
img{max-width:100%}th{text-align:left;vertical-align:top;padding-right:1em;font-weight:normal;color:#555}
</style></head><body><h1>{{ status.campaign }}, so far</h1>
<p>{{ status.state }}, updated {{ status.shown }}, 1 pulse in {{ status.one_pulse_in }} used</p>
{% for name, pair in status.pairs.items() -%}
<section><h2>{{ name }}</h2>
{%- if pair.image %}<img src="{{ pair.image }}" alt="">{% else %}<p>no image yet</p>{% endif %}<table>
{%- for key, value in pair.items() if key != "image" and value not in (none, "", {}) -%}
<tr><th>{{ key }}</th><td>
{%- if value is mapping %}{% for name, part in value.items() %}{{ "; " if not loop.first }}{{ name }}: {{ part }}
{%- endfor %}{% else %}{{ value }}{% endif -%}
</td></tr>
{%- endfor %}</table></section>
{% endfor %}</body></html>
"""


def _page(status: Mapping[str, Any], *, refresh_s: int) -> str:
    """Render a page of quicklooks and text without external resources, which reloads itself during the flight."""
    from jinja2 import Environment

    page = Environment(autoescape=True, keep_trailing_newline=True).from_string(_PAGE)
    return page.render(status=status, refresh_s=refresh_s)


_KEPT = 2
"""Number of images kept for each pair, so that a page with the previous document can still load its image."""


class LiveMap:
    """Live document of the map page, in a folder with the layout of the results.

    Parameters
    ----------
    campaign
        The campaign.
    folder
        Folder of the live view, relative to the results.
    every_s
        Interval at which a page reloads the document, seconds.
    """

    def __init__(self, campaign: Campaign, folder: str, *, every_s: float) -> None:
        self._campaign, self._folder, self._every_s = campaign, campaign.result(folder), every_s
        self._grid: SceneGrid | None = None
        self._entries: dict[str, dict[str, Any]] = {}
        self._places: dict[str, Place] = {}
        self._shown: Counter[str] = Counter()

    @cached_property
    def _fixed(self) -> dict[str, Any]:
        """Constant part of the document."""
        if self._grid is None:
            raise ValueError("no image was added")
        campaign, grid, notes = self._campaign, self._grid, list[str]()
        return {
            "grid": {"bounds_m": grid.bounds_m, "spacing_m": grid.spacing_m, "shape": grid.shape},
            "crs": crs_of(grid),
            "places": [*stated_places(campaign), *true_places(campaign, grid.crs, notes)],
            "notes": notes,
        }

    def begin(self) -> None:
        """Remove the document of an earlier live view; the map server then waits for the first image of a new view."""
        (self._folder / MAP).unlink(missing_ok=True)

    def add(self, pair: PairSoFar, report: Mapping[str, Any]) -> None:
        """Write the current image of a pair and its report."""
        shown, grid = pair.shown, pair.images[-1].grid
        if shown is None:
            return
        self._grid = grid
        name = f"{pair.flight}/{pair.name}"
        image = on_grid(shown.image, shown.share, grid.shape)
        path = self._folder / name / f"db.{self._shown[name] % _KEPT}.tif"
        self._shown[name] += 1
        path.parent.mkdir(parents=True, exist_ok=True)
        write_cog(path, image, DB, value=lambda block: decibels(power(block)), tags={}, **placed_on(grid))
        level = decibels(power(image[image != 0]))
        high = round(float(np.nanmax(level, initial=-300.0)), 1)
        low = min(round(float(np.nanmedian(level)), 1), high - 1.0) if np.isfinite(level).any() else high - 60.0
        layer = Layer("db.tif", sha256_file(path), "image", "image so far", "dB", low, high)
        self._entries[name] = {
            "flight": pair.flight,
            "image": pair.name,
            "verdict": report["verdict"],
            "reason": report["reason"],
            "error_db": report["error_db"],
            "flags": explained_flags(report["flags"]),
            "acquired": [],
            "licence": None,
            "layers": [{**asdict(layer), "url": url_of(f"{name}/{path.name}", layer.sha256)}],
        }
        peak = report["peak"]
        self._places[name] = Place("brightest", "found", float(peak["x_m"]), float(peak["y_m"]), name)

    def drop(self, pair: PairSoFar) -> None:
        """Remove a pair whose recording was restarted, until it is added again."""
        name = f"{pair.flight}/{pair.name}"
        self._entries.pop(name, None)
        self._places.pop(name, None)

    def write(self, *, ended: bool) -> None:
        """Write the document of the added images; nothing is written before the first image."""
        if self._grid is None:
            return
        document = map_document(
            self._campaign.settings.campaign,
            **self._fixed | {"places": [*self._fixed["places"], *self._places.values()]},
            images=list(self._entries.values()),
            coverage_url=None,
            again_s=None if ended else self._every_s,
        )
        path = self._folder / MAP
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, document)


def placed_on(grid: SceneGrid) -> dict[str, Any]:
    """Return transform and CRS of a grid as arguments of the export functions."""
    return {"transform": Affine(*grid.transform), "crs": grid.crs_wkt if grid.crs == LOCAL else grid.crs}


def on_grid(image: NDArray[np.complex64], side: int, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    """Resample an image by repeating each pixel `side` × `side` times on a grid of `shape`; 0 beyond the last pixel.

    Examples
    --------
    >>> on_grid(np.array([[1, 2]], np.complex64), 2, (2, 5)).real.astype(int).tolist()
    [[1, 1, 2, 2, 0], [1, 1, 2, 2, 0]]
    """
    fine = np.zeros(shape, np.complex64)
    blocks = image.repeat(side, axis=0).repeat(side, axis=1)
    fine[: blocks.shape[0], : blocks.shape[1]] = blocks[: shape[0], : shape[1]]
    return fine
