"""Rules `image` and `tiles`: a focused image of one pair with its measured error, by one job or by many."""

from pathlib import Path

from apertura.atomic import write_json
from apertura.campaign import Campaign
from apertura.load.antennas import antennas_report
from apertura.steps.forming import Work
from apertura.steps.quality import certified, measures
from apertura.store import finish, open_array, resume, sharing, writing

_QUOTED = ("pulses", "sidelink", "clock", "calibration")


def image(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Path:
    """Write results/<flight>/<pair>/image.zarr and image.json.

    Tiles that are there already are kept: from a run that was killed, or from the jobs of rule `tiles`.
    """
    work = Work.of(campaign, flight, pair, module=__name__, threads=threads)
    folder, echo, plan = work.folder, work.echo, work.plan
    with writing(folder) as wip:
        missing = resume(wip, work.empty, "image", work.windows)
        target = open_array(wip, "image")
        work.form_planned(target, missing)
        quality = {
            "engine": plan.engine,
            "models": plan.reasons,
            "predicted_error_db": round(plan.predicted_error_db, 2),
            **certified(work, target, plan.better, campaign.settings.processing.accuracy_db),
            **measures(work, target),
            **{name: echo.attrs[name] for name in _QUOTED if name in echo.attrs},
            **work.heights.report,
            **antennas_report(campaign, pair, plan.illumination),
        }
        quality["flags"] = {**echo.attrs["flags"], **plan.flags, **quality.pop("crossed")}
        write_json(folder.with_name("image.json"), {"flight": flight, "pair": pair, **quality})
        finish(wip, folder, quality=quality, flags=quality["flags"])
    return folder


def tiles(campaign: Campaign, flight: str, pair: str, share: str, *, threads: int = 1) -> Path:
    """Form one job's share of a pair's tiles for `image` to finish; write results/<flight>/<pair>/tiles/<share>.json.

    Parameters
    ----------
    campaign, flight, pair
        Which image.
    share
        '2-of-8': every eighth tile, from the second on.
    threads
        Tiles in work at once.

    Raises
    ------
    ValueError
        If `share` is no such share.
    """
    number, jobs = (int(part) for part in share.split("-of-"))
    if not 1 <= number <= jobs:
        raise ValueError(f"{share=}: must be one of 1-of-{jobs} to {jobs}-of-{jobs}")
    work = Work.of(campaign, flight, pair, module=__name__, threads=threads)
    mine = work.windows[number - 1 :: jobs]
    with sharing(work.folder, work.empty, "image", work.windows) as (wip, missing):
        todo = [window for window in mine if window in missing]
        if todo:
            work.form_planned(open_array(wip, "image"), todo)
    receipt = work.folder.with_name("tiles") / f"{share}.json"
    write_json(receipt, {"tiles": len(mine), "formed": len(todo), "with": work.plan.setting.line})
    return receipt
