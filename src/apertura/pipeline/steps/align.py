"""`apertura align`: clock offset, drift and path of a recorder against its flight log, from its echoes."""

from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from apertura.common.atomic import write_text
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.synchronisation.clock_alignment import Alignment, align_on_point, estimate_drift
from apertura.methods.synchronisation.scene_alignment import align_on_scene
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CLOCK_COLUMNS, CLOCKS, CONFIG
from apertura.pipeline.opening.echo import Unaligned, unaligned
from apertura.pipeline.opening.scene import ConfiguredGround, settled_scene
from apertura.pipeline.store import manifest_of

NEAR_S = 5.0
"""Largest offset searched for a clock in UTC, seconds; of a clock without UTC every offset is searched."""


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
    within_s = _within(given, search_s)
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


def _within(given: Unaligned, search_s: float | None) -> tuple[float, float]:
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
