"""What is wrong with a campaign folder, all of it at once, before anything runs: headers, logs and numbers, no samples.

Here stands what cannot be imaged at all; what is merely worse is measured by the step that meets it, and is a flag.
"""

import pkgutil
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from apertura.common.errors import CampaignError
from apertura.common.processes import as_typed
from apertura.pipeline.check.loading import load
from apertura.pipeline.config import located

if TYPE_CHECKING:
    from apertura.pipeline.check.inspected import Inspected

Check = Callable[["Inspected"], Iterable[CampaignError]]

CHECKS: Mapping[str, str] = {
    "flights": "apertura.pipeline.check.flights:check_flights",
    "files": "apertura.pipeline.check.files:check_files",
    "links": "apertura.pipeline.check.links:check_links",
    "modules": "apertura.pipeline.check.links:check_modules",
    "results": "apertura.pipeline.check.results:check_writable",
    "codes": "apertura.pipeline.check.codes:check_codes",
    "recordings": "apertura.pipeline.check.recordings:check_recordings",
    "histories": "apertura.pipeline.check.histories:check_histories",
    "channels": "apertura.pipeline.check.recordings:check_channels",
    "intervals": "apertura.pipeline.check.tags:check_intervals",
    "overlap": "apertura.pipeline.check.tags:check_overlap",
    "segments": "apertura.pipeline.check.tags:check_segments",
    "tracks": "apertura.pipeline.check.tracks:check_tracks",
    "attitude": "apertura.pipeline.check.tracks:check_attitude",
    "coverage": "apertura.pipeline.check.coverage:check_coverage",
    "patterns": "apertura.pipeline.check.antennas:check_patterns",
    "crs": "apertura.pipeline.check.scene:check_scene_crs",
    "reference_points": "apertura.pipeline.check.scene:check_reference_points",
    "dem": "apertura.pipeline.check.dem:check_dem",
    "spikes": "apertura.pipeline.check.dem:check_spikes",
    "apart": "apertura.pipeline.check.places:check_nodes_apart",
    "distance": "apertura.pipeline.check.places:check_distance",
    "ground": "apertura.pipeline.check.ground:check_ground",
    "calibration": "apertura.pipeline.check.calibration:check_calibration",
    "memory": "apertura.pipeline.check.resources:check_memory",
    "disk": "apertura.pipeline.check.resources:check_disk",
}
"""Name → ``module:function``; a function takes what is `Inspected` and yields problems, or raises one."""


def problems(root: str | Path, *, without: Collection[str] = ()) -> list[CampaignError]:
    """Return what is wrong with a campaign folder; an empty list: nothing known.

    Parameters
    ----------
    root
        The campaign folder.
    without
        Names of checks to leave out, such as 'memory' where steps run on another machine.

    Examples
    --------
    >>> [str(problem) for problem in problems("nowhere")]
    ['nowhere: no such folder; expected a campaign folder. `apertura init` makes one.']
    """
    campaign, found = load(Path(root))
    if campaign is None:
        return found
    from apertura.pipeline.check.inspected import Inspected

    return [*found, *problems_of(Inspected(campaign), without=without)]


def problems_of(inspected: "Inspected", *, without: Collection[str] = ()) -> list[CampaignError]:
    """Return what is wrong with a campaign that is opened already; `without` as of `problems`."""
    found: list[CampaignError] = []
    for name, function in CHECKS.items():
        if name not in without:
            found += _each(pkgutil.resolve_name(function), inspected)
    return list({str(problem): problem for problem in found}.values())


def print_problems(root: str | Path, *, without: Collection[str] = (), stream: TextIO | None = None) -> int:
    """Print the problems of a campaign folder, one line each; return how many there are."""
    found = problems(root, without=without)
    for problem in found:
        print(as_typed(as_line(problem)), file=stream or sys.stdout)
    return len(found)


def print_findings(root: str | Path, *, products: bool = False, paranoid: bool = False) -> int:
    """Print the problems of a campaign folder and what of its results is overtaken; return how many lines.

    Parameters
    ----------
    root
        The campaign folder.
    products
        Read every byte of the results, too, and name what is not as it was written.
    paranoid
        Read every input again, also those whose state is that of a hash taken before.
    """
    found = print_problems(root)
    campaign, _ = load(Path(root))
    if campaign is None or found:
        return found
    from apertura.pipeline.check.stale import damaged_results, stale_lines, stale_results

    lines = list(stale_lines(stale_results(campaign, paranoid=paranoid)))
    if products:
        damaged = damaged_results(campaign).items()
        lines += [f"{manifest}: damaged, {why}. Delete it and run the workflow again." for manifest, why in damaged]
    for line in lines:
        print(line)
    return len(lines)


def as_line(problem: CampaignError) -> str:
    r"""Return a problem as one line, with the config's place where it names a key alone.

    Examples
    --------
    >>> as_line(CampaignError("a\nb", "scene.dem", "c", "D."))
    'config/config.yaml: scene.dem: a\\nb; expected c. D.'
    """
    return " ".join(located(str(problem)).split())


def _each(check: Check, inspected: "Inspected") -> Iterator[CampaignError]:
    """Yield what a check yields, and what it raises in the end."""
    try:
        yield from check(inspected)
    except CampaignError as problem:
        yield problem
