"""`apertura reproduce`: a product made again from the raw samples elsewhere, and compared byte for byte."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of, shown
from apertura.common.processes import holder
from apertura.run.driver import run_workflow
from apertura.views.verify.diff import differences, first_difference
from apertura.views.verify.products import find_product
from apertura.workflow.lineage import on_demand, results_of, with_inputs

_LINES = 8
_LONGEST = 400


def print_reproduced(path: Path, *, cores: int, keep: Path | None = None) -> int:
    """Make a product again and say whether it is the same; the campaign itself is only read.

    Parameters
    ----------
    path
        Absolute: a file, a stage or a manifest below results/, or a campaign folder.
    cores
        To use.
    keep
        A new folder to make it in, which stays.

    Returns
    -------
    int
        0 if every byte is the same, 1 if not; otherwise what the workflow has ended with.

    Raises
    ------
    CampaignError
        If it is no product of the campaign as its config stands, or a run holds the campaign.
    """
    product = find_product(path)
    campaign, whole = Campaign.load(product.root), product.file is None
    running = holder(product.root)
    if running is not None:
        raise CampaignError(f"a run holds it: {running}", product.root, "a campaign at rest", "Wait until it ends.")
    known = [result.manifest for _, result in results_of(campaign)]
    if not whole and product.manifest not in known:
        expected = f"one of the {len(known)} results of its campaign"
        raise CampaignError("no result that the config promises", path, expected, "`apertura list` names them.")
    wanted = [one for one in known if (product.root / one).is_file()] if whole else [product.manifest]
    if not wanted:
        raise CampaignError("no results", product.root, "a campaign that was run", "Run it: `apertura run`.")
    asked = [one for one in wanted if on_demand(campaign, one)]
    with _scratch(campaign, keep) as again:
        status = run_workflow(again, cores, *(["all", *asked] if whole else wanted))
        if status:
            return status
        lines = _found(product.root, again, wanted, known)
    for line in lines:
        print(shown(line, _LONGEST))
    if keep is not None:
        print(shown(f"made again in {keep}", _LONGEST))
    return 0 if lines[0].startswith("same") else 1


def _found(root: Path, again: Path, wanted: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return what differs in the results wanted, and with which of those known that begins; or that nothing does."""
    lines = [line for manifest in wanted for line in compared(root, again, manifest)]
    if not lines:
        count, more = sum(len(_files(root, one)) for one in wanted), len(wanted) - 1
        others = f" and {more} more results" if more else ""
        return [f"same     {number_of(count, 'file')}, byte for byte, of {wanted[0]}{others}"]
    begins = next((one for one in known if _differs(root, again, one)), None)
    if begins is None:
        return [*lines, "its manifest is the same: a file was changed after it was made, see `apertura verify`"]
    return [*lines, f"the first result of the chain that differs is {begins}"]


@contextmanager
def _scratch(campaign: Campaign, keep: Path | None) -> Iterator[Path]:
    """Yield a campaign folder with the same inputs and no results."""
    root = campaign.root
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="apertura-reproduce-") as folder:
            yield with_inputs(campaign, Path(folder, root.name), link=True)
        return
    if keep.is_relative_to(root) or keep.is_symlink() or (keep.exists() and not keep.is_dir()):
        raise CampaignError("cannot be made again there", keep, "a new folder outside the campaign", "Name another.")
    if keep.is_dir() and any(keep.iterdir()):
        raise CampaignError("not empty", keep, "a new folder", "Name another; nothing was changed.")
    yield with_inputs(campaign, keep, link=False)


def compared(root: Path, again: Path, manifest: str) -> list[str]:
    """Return what differs between a result and the same result made again, a line each.

    Parameters
    ----------
    root, again
        Campaign folders.
    manifest
        Of the result, relative to both.

    Raises
    ------
    CampaignError
        If a manifest is damaged, or names a file outside.
    """
    lines = []
    there = _files(root, manifest), _files(again, manifest)
    for name in [*sorted({*there[0], *there[1]}), manifest]:
        folder = "" if name == manifest else f"{manifest.rpartition('/')[0]}/"
        pair = [ConfinedPath.at(where).named(f"{folder}{name}", where=manifest) for where in (root, again)]
        if not all(path.is_file() for path in pair):
            lines.append(f"missing  {folder}{name}: {'there' if pair[0].is_file() else 'made again'} alone")
        elif (at := first_difference(*pair)) is not None:
            lines.append(f"changed  {folder}{name}: first differs at byte {at}")
            lines += _differences(*pair) if len(lines) == 1 else []
    return lines


def _differences(path: Path, again: Path) -> Iterator[str]:
    """Yield what `apertura diff` says of the first file that differs, from what is there to what was made again."""
    stage = next((folder for folder in path.parents if folder.suffix == ".zarr"), None)
    if stage is not None:
        path, again = stage, again.parents[len(path.relative_to(stage).parts) - 1]
    with suppress(CampaignError):  # a stage that is damaged is not opened
        differing = [(section, line) for section, lines in differences(path, again).items() for line in lines]
        yield from (f"         {section:<9}{line}" for section, line in differing[:_LINES])
        if len(differing) > _LINES:
            yield f"         and {len(differing) - _LINES} more"


def _files(root: Path, manifest: str) -> Mapping[str, str]:
    path = root / manifest
    files: Mapping[str, str] = read_manifest(path)["files"] if path.is_file() else {}
    return files


def _differs(root: Path, again: Path, manifest: str) -> bool:
    there = root / manifest, again / manifest
    return all(path.is_file() for path in there) and first_difference(*there) is not None
