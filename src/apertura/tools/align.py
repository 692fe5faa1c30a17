"""`apertura align`: estimate clock offset, drift and path offset of a recorder, from its echoes and its flight log."""

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
"""Half width of the search range for the offset of a UTC clock, seconds.

For a free-running clock, all offsets at which recording and log overlap are searched.
"""

MOST_PULSES = 8192
"""Maximum number of pulses used, evenly spread over the recording; limits memory."""


@dataclass(frozen=True, eq=False)
class Unaligned:
    """Echoes and log of a node before alignment.

    Attributes
    ----------
    echo, log
        Inputs of `apertura.methods.alignment`; times are in seconds, from the first pulse in `echo` and from the first
        epoch in `log`.
    log_start_ns
        Delay of the log's first epoch relative to the recorder's first pulse, nanoseconds.
    applied_ns
        Offset from config/clocks.tsv that is already applied to the recorder's times, nanoseconds.
    stated_ns
        Offset in config/clocks.tsv, nanoseconds; 0 without an entry.
    applied_ppm
        Drift from config/clocks.tsv that is already applied to the recorder's times, ppm.
    taken_off_m
        Path offset that was already removed from the echoes, metres.
    own_clock
        True if the recorder's clock is free-running, so that only differences between its times are meaningful.
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
        """Return a copy with a given path offset removed from the echoes."""
        delay_s = self.echo.reference_delay_s - (path_m - self.taken_off_m) / SPEED_OF_LIGHT_M_S
        return replace(self, echo=replace(self.echo, reference_delay_s=delay_s), taken_off_m=path_m)

    def offset_ns(self, offset_s: float) -> int:
        """Convert an offset between the first pulse and the first epoch into the offset for clocks.tsv."""
        return self.applied_ns + self.log_start_ns + round(offset_s * 1e9)

    @property
    def stated_s(self) -> float:
        """Offset for which `offset_ns` returns `stated_ns`, seconds."""
        return (self.stated_ns - self.applied_ns - self.log_start_ns) * 1e-9


def unaligned(campaign: Campaign, flight: str, node: str) -> Unaligned:
    """Open the echoes and the log of a node of a monostatic pair.

    Raises
    ------
    CampaignError
        If the node does not both transmit and receive in that flight, if it has no log, or if its echoes have not been
        computed.
    """
    flown = campaign.flight(flight)
    if f"{node}-{node}" not in flown.pairs:
        raise CampaignError(
            f"{node} does not both transmit and receive in {flight}",
            where=campaign.root / FLIGHTS,
            expected=f"a node of a monostatic pair; pairs of {flight}: {', '.join(flown.pairs)}",
            remedy="Specify a node of a monostatic pair, or correct the line of the flight.",
        )
    clock = campaign.clock(flight, node)
    applied_ns, applied_ppm = 0, 0.0
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    if sampled:
        path = campaign.stage("echo", flight, f"{node}-{node}")
        if not manifest_of(path).is_file():
            raise CampaignError(
                "no echo stage",
                where=path,
                expected=f"the echo stage of the monostatic pair of {node}",
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
    """Reduce a history to at most `MOST_PULSES` evenly spread pulses."""
    return history.isel(pulse=slice(None, None, -(-history.sizes["pulse"] // MOST_PULSES)))


def _wave_speed(campaign: Campaign, log: NodeLog) -> float:
    """Return the wave speed for the whole log, because the recorded part of the log is unknown before alignment."""
    times = log.track.time.values[log.checked.kept]
    times = times[:: -(-len(times) // MOST_PULSES)][1:-1]
    aperture = Aperture(log.antenna("radar_tx", times), log.antenna("radar_rx", times))
    return scene_air(campaign, aperture.tx_m).over(aperture).wave_speed_m_s


def _log_geometry(log: NodeLog) -> Logged:
    times = log.track.time.values[log.checked.kept]
    start = log.track.time.values[0]

    def phase_centres(time_s: NDArray[np.float64]) -> Aperture:
        time = start + np.round(time_s * 1e9).astype("timedelta64[ns]")
        return Aperture(log.antenna("radar_tx", time), log.antenna("radar_rx", time))

    first_s, last_s = seconds_since(times[[0, -1]], start)
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
    """Estimate the alignment of a recorder with its log; return the alignment, and values for the campaign's config.

    Parameters
    ----------
    campaign, flight, node
        Campaign, flight and a node of a monostatic pair.
    point
        Easting and northing in the scene's CRS and ellipsoidal height (z in a local frame) of a reflector, metres.
        None: the sharpness of the scene is maximised instead.
    search_s
        Maximum difference from the configured clock offset, seconds. None: `NEAR_S`, or, for a free-running clock, all
        offsets at which recording and log overlap.
    search_m
        Maximum path offset, metres of total path; 0: the configured path offset is used.
    drift
        Estimate the drift of the recorder's clock as well; requires a reflector.

    Returns
    -------
    Alignment
        Alignment, with times in seconds as in `Unaligned`.
    dict
        offset_s for clocks.tsv as text with all digits, drift_ppm, and path_offset_m for the config.

    Raises
    ------
    CampaignError
        If the alignment cannot be estimated.
    """
    if drift and point is None:
        raise CampaignError(
            "--drift without --point",
            where="apertura align",
            expected="the position of a reflector, because the sharpness of a scene does not determine a drift",
            remedy="Give --point, or omit --drift.",
        )
    inputs = unaligned(campaign, campaign.flight(flight).name, node)
    if search_m == 0.0:
        inputs = inputs.less_path(campaign.settings.nodes[node].path_offset_m.radar)
    within_s = _search_range(inputs, search_s)
    try:
        if point is None:
            alignment = align_on_scene(inputs.echo, inputs.log, *_scene(campaign), within_s=within_s, search_m=search_m)
        else:
            position_m = frame_from_map(_crs(campaign, inputs), *point)
            alignment = align_on_point(inputs.echo, inputs.log, position_m, within_s=within_s, search_m=search_m)
            if drift:
                alignment = estimate_drift(alignment, inputs.echo, inputs.log, position_m)
    except ValueError as error:
        raise CampaignError(
            str(error),
            where=campaign.root / "raw" / flight,
            expected="a recording within the time span of its node's log",
            remedy="Check that recording and log are of the same flight, and check nodes.<node>.log.",
        ) from error
    offset = Decimal(inputs.offset_ns(alignment.offset_s)).scaleb(-9)
    values = {"offset_s": str(offset), "drift_ppm": round(inputs.applied_ppm + alignment.drift_ppm, 4)}
    return alignment, values | {"path_offset_m": inputs.taken_off_m + alignment.path_m}


def write_clock(
    campaign: Campaign, flight: str, node: str, *, offset_s: str, std_s: float, drift_ppm: float = 0.0
) -> Path:
    """Write the line of a node's clock into config/clocks.tsv; other lines are kept."""
    path = campaign.root.named(CLOCKS.as_posix(), where=campaign.root)
    kept = [
        (
            clock.flight,
            clock.node,
            Decimal(clock.offset_ns).scaleb(-9),
            clock.drift_ppm,
            "" if clock.std_s is None else clock.std_s,
        )
        for clock in campaign.clocks
        if (clock.flight, clock.node) != (flight, node)
    ]
    rows = [CLOCK_COLUMNS, *kept, (flight, node, offset_s, drift_ppm, f"{std_s:.6f}")]
    write_text(path, "".join("\t".join(map(str, row)) + "\n" for row in rows))
    return path


def print_alignment(campaign: Campaign, flight: str, node: str, *, write: bool, **options: Any) -> None:
    """Estimate the alignment; print the result and the lines for the config, and write clocks.tsv if `write` is set."""
    alignment, values = align(campaign, flight, node, **options)
    path_text = f"path offset {values['path_offset_m']:.4f} m"
    path_text += f" ± {alignment.path_width_m:.4f} m" if options["search_m"] > 0 else " (configured, not measured)"
    print(
        f"{flight} {node}: the recording starts {alignment.offset_s:.4f} s ± {alignment.offset_width_s:.4f} s after "
        f"the first epoch of the log; {path_text}"
    )
    print(
        f"method: {alignment.report['method']}, {alignment.report['pulses']} pulses, contrast "
        f"{alignment.contrast_db:.1f} dB above {'other offsets' if options['point'] else 'the median of the image'}"
    )
    for name, line in alignment.flags.items():
        print(f"uncertain: {name}: {line}")
    if options["drift"]:
        print(f"drift {alignment.drift_ppm:.2f} ppm: {alignment.report['drift']}")
    cells = (flight, node, values["offset_s"], values["drift_ppm"], f"{alignment.offset_width_s:.6f}")
    print(f"{CLOCKS}: {chr(9).join(map(str, cells))}")
    if options["search_m"] > 0:
        print(f"{CONFIG}: nodes.{node}.path_offset_m.radar: {values['path_offset_m']:.4f}")
    if write:
        clock = {name: values[name] for name in ("offset_s", "drift_ppm")}
        written = write_clock(campaign, flight, node, std_s=alignment.offset_width_s, **clock)
        print(f"{written} written")


def _search_range(inputs: Unaligned, search_s: float | None) -> tuple[float, float]:
    """Return the bounds of the search for the offset between first pulse and first epoch, seconds."""
    recorded_s = float(inputs.echo.time_s[-1])
    overlapping = inputs.log.first_s - recorded_s, inputs.log.last_s
    if search_s is None and inputs.own_clock:
        return overlapping
    near_s = NEAR_S if search_s is None else search_s
    return max(overlapping[0], inputs.stated_s - near_s), min(overlapping[1], inputs.stated_s + near_s)


def _crs(campaign: Campaign, inputs: Unaligned) -> str:
    """Return the CRS of `point`; for `auto`, the CRS of a finished scene stage, or else the UTM zone of the log."""
    if campaign.settings.scene.crs != "auto":
        return campaign.settings.scene.crs
    if manifest_of(campaign.result("scene.json")).is_file():
        return settled_scene(campaign).grid.crs
    middle_s = np.array([inputs.log.first_s + inputs.log.last_s]) / 2
    return utm_crs(inputs.log.phase_centres(middle_s).tx_m[0])


def _scene(campaign: Campaign) -> tuple[SceneGrid, FlatGround]:
    """Return the configured grid, and flat terrain."""
    settings = campaign.settings.scene
    if "auto" in {settings.crs, settings.bounds_m, settings.spacing_m}:
        raise CampaignError(
            "crs, bounds_m or spacing_m is auto",
            where=f"{CONFIG}: scene",
            expected="a configured scene, because automatic settings require an aligned clock",
            remedy="Configure these keys, or give the position of a reflector with --point.",
        )
    bounds_m, spacing_m = settings.bounds_m, settings.spacing_m
    grid = SceneGrid.from_bounds(settings.crs, bounds_m, spacing_m=spacing_m)  # type: ignore[arg-type]
    return grid, ConfiguredGround.of(settings, campaign.height_files(), crs=settings.crs).level(grid)
