"""`apertura align`: clock offset, drift and path of a recorder against its flight log, from its echoes."""

from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import (
    CLOCK_COLUMNS,
    CLOCKS,
    CONFIG,
    FLIGHTS,
    SampledWaveform,
)
from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of
from apertura.common.atomic import write_text
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.units import seconds_since
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.imaging.range_profiles import wave_speed_of
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.formats.times import FIRST
from apertura.methods.alignment.on_ground import align_on_scene
from apertura.methods.alignment.on_point import Alignment, align_on_point, estimate_drift
from apertura.methods.autofocus.motion import Logged, Recorded
from apertura.stages.node_log import NodeLog, raw_log, read_history, shortest_wave
from apertura.stages.positions import scene_air
from apertura.stages.scene import ConfiguredGround, settled_scene
from apertura.stages.transfer import PairEcho

NEAR_S = 5.0
"""Largest offset searched for a clock in UTC, seconds; of a clock without UTC every offset is searched."""

MOST_PULSES = 8192
"""Pulses of a recording that are used, evenly spread: bounds memory."""


@dataclass(frozen=True, eq=False)
class Unaligned:
    """Echoes and log of a node before alignment.

    Attributes
    ----------
    echo, log
        As `apertura.methods.alignment` takes them: each by seconds of its own, from its first pulse and epoch.
    log_start_ns
        Delay of the log's first epoch against the recorder's first pulse, nanoseconds.
    applied_ns
        Offset of config/clocks.tsv that the recorder's times already contain, nanoseconds.
    stated_ns
        That offset, 0 without.
    applied_ppm
        Drift stated there that they already contain.
    taken_off_m
        Path beyond geometry that was already removed from the echoes.
    own_clock
        Whether the recorder's times mean nothing but differences.
    """

    echo: Recorded
    log: Logged
    log_start_ns: int
    applied_ns: int
    stated_ns: int
    applied_ppm: float
    taken_off_m: float
    own_clock: bool

    def less_path(self, path_m: float) -> "Unaligned":
        """Return the same without so much path beyond geometry in the echoes."""
        delay_s = self.echo.reference_delay_s - (path_m - self.taken_off_m) / SPEED_OF_LIGHT_M_S
        return replace(self, echo=replace(self.echo, reference_delay_s=delay_s), taken_off_m=path_m)

    def offset_ns(self, offset_s: float) -> int:
        """Return the offset for clocks.tsv, given one between the first pulse and the first epoch."""
        return self.applied_ns + self.log_start_ns + round(offset_s * 1e9)

    @property
    def stated_s(self) -> float:
        """Offset at which `offset_ns` returns the stated one, seconds."""
        return (self.stated_ns - self.applied_ns - self.log_start_ns) * 1e-9


def unaligned(campaign: Campaign, flight: str, node: str) -> Unaligned:
    """Return echoes and log of a node that sends and receives.

    Raises
    ------
    CampaignError
        If the node does not send and receive in that flight, has no log, or its echoes are not there yet.
    """
    flown = campaign.flight(flight)
    if f"{node}-{node}" not in flown.pairs:
        raise CampaignError(
            f"{node} does not send and receive in {flight}",
            where=campaign.root / FLIGHTS,
            expected=f"a node whose own pulses come back to it; pairs of {flight}: {', '.join(flown.pairs)}",
            remedy="Name such a node, or correct the line of the flight.",
        )
    clock = campaign.clock(flight, node)
    applied_ns, applied_ppm = 0, 0.0
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    if sampled:
        path = campaign.stage("echo", flight, f"{node}-{node}")
        if not manifest_of(path).is_file():
            raise CampaignError(
                "not there yet",
                where=path,
                expected=f"the echo of {node} by its own pulses",
                remedy="Run `apertura run CAMPAIGN --until echo` first.",
            )
        history = _thinned(PairEcho.opened(campaign, flight, f"{node}-{node}").stage)
        off_m, applied_ns = float(history.attrs["stated_offset_m"]), clock.offset_ns
        applied_ppm = clock.drift_ppm
    else:
        history = _thinned(read_history(campaign, flight, node, pair=f"{node}-{node}"))
        off_m = 0.0
    times = history.time.values
    log = raw_log(campaign, flight, node, shortest_wave(history.frequency.values))
    speed = wave_speed_of(history) if sampled else _wave_speed(campaign, log)
    echo = Recorded(
        np.asarray(history.transfer.values),
        history.frequency.values,
        history.reference_delay.values,
        seconds_since(times, times[0]),
        speed,
    )
    log_start_ns = int((log.track.time.values[0] - times[0]).astype("timedelta64[ns]").astype(np.int64))
    own_clock = bool(times[0] < FIRST)
    return Unaligned(echo, _log_geometry(log), log_start_ns, applied_ns, clock.offset_ns, applied_ppm, off_m, own_clock)


def _thinned(history: xr.Dataset) -> xr.Dataset:
    """Return at most `MOST_PULSES` pulses, evenly spread."""
    return history.isel(pulse=slice(None, None, -(-history.sizes["pulse"] // MOST_PULSES)))


def _wave_speed(campaign: Campaign, log: NodeLog) -> float:
    """Return the speed of the wave over a whole log: which part of it was recorded is not known before alignment."""
    times = log.track.time.values[log.checked.kept]
    times = times[:: -(-len(times) // MOST_PULSES)][1:-1]
    aperture = Aperture(log.antenna("radar_tx", times), log.antenna("radar_rx", times))
    return scene_air(campaign, aperture.tx_m).over(aperture).wave_speed_m_s


def _log_geometry(log: NodeLog) -> Logged:
    times = log.track.time.values[log.checked.kept]
    began = log.track.time.values[0]

    def phase_centres(at_s: NDArray[np.float64]) -> Aperture:
        at = began + np.round(at_s * 1e9).astype("timedelta64[ns]")
        return Aperture(log.antenna("radar_tx", at), log.antenna("radar_rx", at))

    first_s, last_s = seconds_since(times[[0, -1]], began)
    return Logged(phase_centres, first_s + 1e-9, last_s - 1e-9)


def align(
    campaign: Campaign,
    flight: str,
    node: str,
    *,
    point: tuple[float, float, float] | None = None,
    search_s: float | None = None,
    search_m: float = 10.0,
    drift: bool = False,
) -> tuple[Alignment, dict[str, Any]]:
    """Return the alignment of a recorder to its log, and the same as values of the campaign's config.

    Parameters
    ----------
    campaign, flight, node
        Of a node that sends and receives.
    point
        Easting, northing in the scene's CRS and ellipsoidal height (z in a local frame) of a reflector, metres; None:
        by the sharpness of the scene.
    search_s
        How far the clock may be off; None: `NEAR_S`, or overlapping where the recorder has no clock but its own.
    search_m
        How long the electrical path may be, metres of total path; 0: as stated in the config.
    drift
        Whether to estimate the drift of the recorder's clock as well; needs a reflector.

    Returns
    -------
    Alignment
        In the recorder's and the log's own seconds.
    dict
        offset_s, of clocks.tsv, to its last digit as text, and drift_ppm; path_offset_m, of the config.

    Raises
    ------
    CampaignError
        If nothing can be estimated.
    """
    if drift and point is None:
        raise CampaignError(
            "a drift asked for without a point",
            where="apertura align --drift",
            expected="the place of a reflector: sharpness alone does not determine a drift",
            remedy="Give it by --point, or leave --drift out.",
        )
    given = unaligned(campaign, campaign.flight(flight).name, node)
    if search_m == 0.0:
        given = given.less_path(campaign.settings.nodes[node].path_offset_m.radar)
    within_s = _search_range(given, search_s)
    try:
        if point is None:
            found = align_on_scene(given.echo, given.log, *_scene(campaign), within_s=within_s, search_m=search_m)
        else:
            place = frame_from_map(_crs(campaign, given), *point)
            found = align_on_point(given.echo, given.log, place, within_s=within_s, search_m=search_m)
            found = estimate_drift(found, given.echo, given.log, place) if drift else found
    except ValueError as error:
        raise CampaignError(
            str(error),
            where=campaign.root / "raw" / flight,
            expected="a recording within the times of the log of its node",
            remedy="Check that recording and log belong together, and nodes.<node>.log.",
        ) from error
    offset = Decimal(given.offset_ns(found.offset_s)).scaleb(-9)
    stated = {"offset_s": str(offset), "drift_ppm": round(given.applied_ppm + found.drift_ppm, 4)}
    return found, stated | {"path_offset_m": given.taken_off_m + found.path_m}


def write_clock(
    campaign: Campaign, flight: str, node: str, *, offset_s: str, std_s: float, drift_ppm: float = 0.0
) -> Path:
    """Write the line of a node's clock into config/clocks.tsv; the others stay."""
    path = campaign.root.named(CLOCKS.as_posix(), where=campaign.root)
    others = [clock for clock in campaign.clocks if (clock.flight, clock.node) != (flight, node)]
    kept = [
        (one.flight, one.node, Decimal(one.offset_ns).scaleb(-9), one.drift_ppm, "" if one.std_s is None else one.std_s)
        for one in others
    ]
    rows = [CLOCK_COLUMNS, *kept, (flight, node, offset_s, drift_ppm, f"{std_s:.6f}")]
    write_text(path, "".join("\t".join(map(str, row)) + "\n" for row in rows))
    return path


def print_alignment(campaign: Campaign, flight: str, node: str, *, write: bool, **options: Any) -> None:
    """Align, print the result and the lines for the config, and with `write` write clocks.tsv."""
    found, stated = align(campaign, flight, node, **options)
    length = f"path beyond geometry {stated['path_offset_m']:.4f} m"
    length += f" ± {found.path_width_m:.4f} m" if options["search_m"] > 0 else ", as the config says: not measured"
    print(
        f"{flight} {node}: the recording begins {found.offset_s:.4f} s ± {found.offset_width_s:.4f} s after the first "
        f"epoch of the log; {length}"
    )
    print(
        f"by {found.report['method']}, on {found.report['pulses']} pulses, {found.contrast_db:.1f} dB above "
        f"{'other offsets' if options['point'] else 'the median of the image'}"
    )
    for name, line in found.flags.items():
        print(f"doubtful: {name}: {line}")
    if options["drift"]:
        print(f"drift {found.drift_ppm:.2f} ppm: {found.report['drift']}")
    cells = (flight, node, stated["offset_s"], stated["drift_ppm"], f"{found.offset_width_s:.6f}")
    print(f"{CLOCKS}: {chr(9).join(map(str, cells))}")
    if options["search_m"] > 0:
        print(f"{CONFIG}: nodes.{node}.path_offset_m.radar: {stated['path_offset_m']:.4f}")
    if write:
        clock = {name: stated[name] for name in ("offset_s", "drift_ppm")}
        written = write_clock(campaign, flight, node, std_s=found.offset_width_s, **clock)
        print(f"{written} is written")


def _search_range(given: Unaligned, search_s: float | None) -> tuple[float, float]:
    """Return the least and largest offset between first pulse and first epoch to try, seconds."""
    recorded_s = float(given.echo.time_s[-1])
    overlapping = given.log.first_s - recorded_s, given.log.last_s
    if search_s is None and given.own_clock:
        return overlapping
    near_s = NEAR_S if search_s is None else search_s
    return max(overlapping[0], given.stated_s - near_s), min(overlapping[1], given.stated_s + near_s)


def _crs(campaign: Campaign, given: Unaligned) -> str:
    """Return the CRS that a place is in; `auto` is as settled, and before that the UTM zone of the log."""
    if campaign.settings.scene.crs != "auto":
        return campaign.settings.scene.crs
    if manifest_of(campaign.result("scene.json")).is_file():
        return settled_scene(campaign).grid.crs
    middle_s = np.array([given.log.first_s + given.log.last_s]) / 2
    return utm_crs(given.log.phase_centres(middle_s).tx_m[0])


def _scene(campaign: Campaign) -> tuple[SceneGrid, FlatGround]:
    """Return the grid that the config states, and level ground."""
    settings = campaign.settings.scene
    if "auto" in {settings.crs, settings.bounds_m, settings.spacing_m}:
        raise CampaignError(
            "crs, bounds_m or spacing_m is auto",
            where=f"{CONFIG}: scene",
            expected="a scene that is stated: what is settled from a flight needs its clock first",
            remedy="State them, or give the place of a reflector by --point.",
        )
    bounds_m, spacing_m = settings.bounds_m, settings.spacing_m
    grid = SceneGrid.from_bounds(settings.crs, bounds_m, spacing_m=spacing_m)  # type: ignore[arg-type]
    return grid, ConfiguredGround.of(settings, campaign.height_files(), crs=settings.crs).level(grid)
