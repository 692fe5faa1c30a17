"""Constants measured at reflectors, written for later campaigns and printed."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from apertura.common.atomic import write_json
from apertura.common.errors import CampaignError
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.constants import FILE
from apertura.pipeline.opening.reflectors import measured_constants
from apertura.pipeline.stale import stale_results


def write_constants(campaign: Campaign, to: Path | None = None) -> Path:
    """Measure the constants of a finished campaign at its reflectors, print them, and write them; return the file.

    Raises
    ------
    CampaignError
        If nothing can be measured, images are overtaken, or the file is the one that the campaign itself takes up.
    """
    path = campaign.root / FILE if to is None else to
    used = campaign.calibration_file
    if used is not None and path.resolve() == used.real():
        raise CampaignError(
            "is what processing.radiometric_calibration takes up",
            where=path,
            expected="another file: what is measured is compared with it",
            remedy="Name one with --to.",
        )
    images = {campaign.manifest("image", one.name, pair) for one in campaign.image_flights for pair in one.pairs}
    overtaken = [manifest for manifest in stale_results(campaign) if manifest in images]
    if overtaken:
        raise CampaignError(
            f"{len(overtaken)} of {len(images)} images are overtaken, {overtaken[0]} among them",
            where=campaign.root,
            expected="images made from the files and settings of now",
            remedy="Run the workflow first.",
        )
    constants, left_out = measured_constants(campaign)
    write_json(path, constants.model_dump(mode="json"))
    console = Console(width=120)
    table = Table(title=f"{constants.campaign}: constants at reflectors", title_justify="left")
    for heading in ("pair", "constant, dB", "reflectors", "flights", f"phase against {constants.reference}, rad"):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for pair, one in constants.pairs.items():
        phase = "" if one.phase_rad is None else f"{one.phase_rad:+.3f} ± {one.phase_std_rad:.3f}"
        counts = str(one.reflectors), str(one.flights)
        table.add_row(pair, f"{one.constant_db:.2f} ± {one.std_db:.2f}", *counts, phase)
    console.print(table)
    for pair, one in constants.pairs.items():
        for name, line in one.flags.items():
            print(f"{pair}: {name}: {line}")
    for line in left_out:
        print(f"left out: {line}")
    return path
