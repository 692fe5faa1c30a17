"""Check of a campaign folder before a run: configuration, headers, logs and DEM, without reading samples.

All problems are reported at once. A problem prevents imaging. A condition that only degrades images is not reported
here: a step measures the condition and raises a flag.
"""

import shlex
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeVar

from apertura.campaign.config import (
    CLOCKS,
    CONFIG,
    FLIGHTS,
    SEGMENTS,
    Flight,
    located,
    read_clocks,
    read_flights,
    read_segments,
    read_settings,
)
from apertura.campaign.config.processing import HEIGHT_DEFAULT
from apertura.campaign.config.section import table_rows
from apertura.campaign.folder import Campaign, check_name
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of
from apertura.common.lazy import Lazy
from apertura.common.processes import as_typed

if TYPE_CHECKING:
    from apertura.check.examination import Examination

T = TypeVar("T")
Check = Callable[["Examination"], Iterable[CampaignError]]

_CHECKS_OF = Lazy("apertura.check")

CHECKS: Mapping[str, Check] = {
    "flights": _CHECKS_OF.files.check_flights,
    "files": _CHECKS_OF.files.check_files,
    "raw_root": _CHECKS_OF.files.check_raw_root,
    "links": _CHECKS_OF.files.check_links,
    "modules": _CHECKS_OF.files.check_modules,
    "results": _CHECKS_OF.files.check_writable,
    "codes": _CHECKS_OF.recordings.check_codes,
    "recordings": _CHECKS_OF.recordings.check_recordings,
    "histories": _CHECKS_OF.recordings.check_histories,
    "channels": _CHECKS_OF.recordings.check_receivers,
    "intervals": _CHECKS_OF.recordings.check_intervals,
    "overlap": _CHECKS_OF.recordings.check_overlap,
    "segments": _CHECKS_OF.recordings.check_segments,
    "tracks": _CHECKS_OF.tracks.check_tracks,
    "attitude": _CHECKS_OF.tracks.check_attitude,
    "coverage": _CHECKS_OF.tracks.check_coverage,
    "patterns": _CHECKS_OF.reach.check_patterns,
    "constants": _CHECKS_OF.reach.check_constants,
    "crs": _CHECKS_OF.georeferencing.check_scene_crs,
    "reference_points": _CHECKS_OF.georeferencing.check_reference_points,
    "dem": _CHECKS_OF.georeferencing.check_dem,
    "spikes": _CHECKS_OF.georeferencing.check_spikes,
    "apart": _CHECKS_OF.reach.check_nodes_apart,
    "distance": _CHECKS_OF.reach.check_distance,
    "aperture": _CHECKS_OF.reach.check_aperture,
    "ground": _CHECKS_OF.reach.check_ground,
    "calibration": _CHECKS_OF.reach.check_calibration,
    "memory": _CHECKS_OF.files.check_memory,
    "disk": _CHECKS_OF.files.check_disk,
    "scheduler": _CHECKS_OF.files.check_scheduler,
    "imaging": _CHECKS_OF.reach.check_imaging,
    "plan": _CHECKS_OF.reach.check_plan,
}
"""Name of each check → function that takes an `Examination` and yields problems, or raises a problem."""

LAST = frozenset({"imaging", "plan"})
"""Checks that run only if the other checks find no problems: they open pairs, which would repeat these problems."""


def problems(root: str | Path, *, without: Collection[str] = ()) -> list[CampaignError]:
    """Check a campaign folder and return its problems; an empty list if none are found.

    Parameters
    ----------
    root
        The campaign folder.
    without
        Names of checks to omit, such as 'memory' if steps run on another machine.

    Examples
    --------
    >>> [str(problem) for problem in problems("nowhere")]
    ['nowhere: no such folder; expected a campaign folder. Create one with `apertura init`.']
    """
    campaign, wrong = load(Path(root))
    if campaign is None:
        return wrong
    from apertura.check.examination import Examination

    return [*wrong, *problems_of(Examination(campaign), without=without)]


def problems_of(examined: "Examination", *, without: Collection[str] = ()) -> list[CampaignError]:
    """Check an opened campaign and return its problems; for `without`, see `problems`."""
    wrong: list[CampaignError] = []
    for name, function in CHECKS.items():
        if name not in without and not (name in LAST and wrong):
            wrong += _problems_of_check(function, examined)
    return list({str(problem): problem for problem in wrong}.values())


def print_problems(root: str | Path, *, without: Collection[str] = (), stream: TextIO | None = None) -> int:
    """Print the problems of a campaign folder, one line each, or notes if there are none; return their number."""
    return _print_problems(*_examined(root), without=without, stream=stream or sys.stdout)


def _examined(root: str | Path, *, paranoid: bool = False) -> "tuple[Examination | None, list[CampaignError]]":
    from apertura.check.examination import Examination

    campaign, wrong = load(Path(root))
    return None if campaign is None else Examination(campaign, paranoid), wrong


def _print_problems(
    examined: "Examination | None", wrong: list[CampaignError], *, without: Collection[str], stream: TextIO
) -> int:
    notes: list[str] = []
    if examined is not None:
        wrong += problems_of(examined, without=without)
        notes = [] if wrong else [*assumptions(examined)]
    for line in (*map(as_line, wrong), *notes):
        print(as_typed(line), file=stream)
    return len(wrong)


def assumptions(examined: "Examination") -> Iterator[str]:
    """Yield notes on uncertain assumptions that are made where a setting is not configured."""
    from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef

    scene = examined.campaign.settings.scene
    if scene.height_is_default and scene.crs != LOCAL and examined.middle_m is not None:
        above_m = float(geodetic_from_ecef(examined.middle_m)[2])
        yield (
            f"note: {HEIGHT_DEFAULT}; the track is {above_m:.0f} m above the ellipsoid. Set scene.height_m, or "
            "configure a DEM in scene.dem"
        )


def print_findings(root: str | Path, *, products: bool = False, paranoid: bool = False) -> int:
    """Print the problems of a campaign folder and its out-of-date results; return the number of lines.

    Parameters
    ----------
    root
        The campaign folder.
    products
        Also read all results, and report damaged files.
    paranoid
        Hash all inputs again, including those with an unchanged size and modification time.
    """
    examined, wrong = _examined(root, paranoid=paranoid)
    count = _print_problems(examined, wrong, without=(), stream=sys.stdout)
    if examined is None or count:
        return count
    from apertura.workflow.stale import absent_lines, damaged_results, stale_lines

    campaign = examined.campaign
    for line in absent_lines(campaign):  # notes, not problems
        print(line)
    lines = list(stale_lines(examined.stale))
    if products:
        damaged = damaged_results(campaign).items()
        lines += [
            f"{manifest}: the result is damaged: {reason}. Delete this file and run the workflow again."
            for manifest, reason in damaged
        ]
    for line in lines:
        print(line)
    folder = shlex.quote(as_typed(root))
    flights, nodes = len(campaign.flights), sum(len(flight.participants) for flight in campaign.flights)
    files = f"{number_of(flights, 'flight')}, {number_of(nodes, 'recording')} with their logs"
    then = f"apertura run {folder}" if lines else f"apertura plan {folder}, then apertura run {folder}"
    print(f"No problems found in {files}. Next: {then}")
    return len(lines)


def as_line(problem: CampaignError) -> str:
    r"""Format a problem as one line, with the path of the configuration before a bare key.

    Examples
    --------
    >>> as_line(CampaignError("a\nb", "scene.dem", "c", "D."))
    'config/config.yaml: scene.dem: a\\nb; expected c. D.'
    """
    return " ".join(located(str(problem)).split())


def _problems_of_check(check: Check, examined: "Examination") -> Iterator[CampaignError]:
    """Yield the problems that a check yields, and the problem that it raises, if any."""
    try:
        yield from check(examined)
    except CampaignError as problem:
        yield problem


class _AnyNode(frozenset[str]):
    """Set that contains every name, used instead of the nodes of an unreadable configuration."""

    def __contains__(self, _: object) -> bool:
        return True


def load(root: Path) -> tuple[Campaign | None, list[CampaignError]]:
    """Load a campaign; return the campaign, or None, and the problems of config.yaml and of the tables.

    Each file is read even if another file is invalid.

    Examples
    --------
    >>> load(Path("nowhere"))[0] is None
    True
    """
    try:
        check_name(root)
    except CampaignError as problem:
        return None, [problem]
    root = ConfinedPath.at(root)
    if not root.is_dir():
        remedy = "Create one with `apertura init`."
        return None, [CampaignError("no such folder", where=root, expected="a campaign folder", remedy=remedy)]
    wrong: list[CampaignError] = []
    settings = _tried(lambda: read_settings(root / CONFIG), wrong)
    nodes = settings.nodes if settings else _AnyNode()
    flights = _tried(lambda: tuple(read_flights(root / FLIGHTS, nodes=nodes)), wrong)
    listed = _listed_flights(root / FLIGHTS) if flights is None else flights
    segments = _tried(lambda: tuple(read_segments(root / SEGMENTS, flights=listed)), wrong) if listed else ()
    clocks = _tried(lambda: tuple(read_clocks(root / CLOCKS, flights=listed)), wrong) if listed else ()
    if settings is None or flights is None or segments is None or clocks is None:
        return None, wrong
    campaign = Campaign(root, settings, flights, segments, clocks)
    _tried(campaign.check_radio, wrong)
    return campaign, wrong


def _tried(read: Callable[[], T], wrong: list[CampaignError]) -> T | None:
    try:
        return read()
    except CampaignError as problem:
        wrong.append(problem)
        return None


def _listed_flights(path: Path) -> tuple[Flight, ...]:
    """Return the flights of an invalid table, unvalidated, for comparison with segments and clocks."""
    rows = _tried(
        lambda: [cells for _, cells in table_rows(path, ["flight", "kind", "transmitter", "nodes"], remedy="")], []
    )
    return tuple(
        Flight(row["flight"], row["kind"], row["transmitter"], tuple(map(str.strip, row["nodes"].split(","))))
        for row in rows or ()
    )
