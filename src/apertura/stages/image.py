"""Rules `image` and `tiles`: image formation of one pair with its measured error, in one job or several."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.campaign.folder import Campaign
from apertura.campaign.store import (
    finish,
    mark_rewritten,
    open_array,
    open_stage,
    resume,
    sharing,
    writing,
)
from apertura.common.atomic import write_json
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import Window
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.core.backprojection.engines import instruction_set
from apertura.core.backprojection.tiles import compute_tiles
from apertura.core.imaging.certify import certified, measures
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.judgement import judgement
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.imaging.view import view_report
from apertura.core.quality.budget import arithmetic_line
from apertura.stages.pair import OpenPair, antennas_report, open_pair, pattern_digests
from apertura.stages.planning import budget_of, gated, plan_pair
from apertura.stages.refine import RefinedTrack, open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import stamped
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of

_MISSING = np.complex64(complex(np.nan, np.nan))
"""Value of a tile that no pulse illuminates; it is not stored."""

_QUOTED = (
    "pulses",
    "background",
    "interference",
    "positions",
    "time_tags",
    "symbols",
    "sidelink",
    "clock",
    "code",
    "calibration",
    "atmosphere",
)


def image(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Path:
    """Write results/<flight>/<pair>/image.zarr.

    Tiles that exist already, from an interrupted run or from the jobs of rule `tiles`, are kept.
    """
    lineage = result_of(campaign, "image", flight, pair).begin(campaign.root)
    work = _open(campaign, flight, pair, threads=threads)
    folder, echo, plan = work.folder, work.echo, work.formation.plan
    with writing(folder) as wip:
        missing = resume(wip, work.empty, "image", work.formation.windows)
        target = open_array(wip, "image")
        work.compute(missing, target)
        budget = budget_of(campaign, work.pair, work.scene)
        quality = {
            "engine": plan.engine,
            "instruction_set": instruction_set(plan.engine),
            "models": plan.reasons,
            "predicted_error_db": round(plan.predicted_error_db, 2),
            **certified(
                work.formation,
                target,
                accuracy_db=plan.accuracy_db,
                threads=threads,
                scheduler=work.scheduler,
                rewriting=partial(mark_rewritten, wip, "image", work.formation.windows),
            ),
            **measures(work.formation, target),
            **{name: echo.attrs[name] for name in _QUOTED if name in echo.attrs},
            **work.scene.report,
            **antennas_report(campaign, pair, plan.illumination),
            **work.report,
            "view": view_report(work.formation, work.pair.began, work.pair.time_s),
            "autofocus": work.track.report(pair),
        }
        judged = judgement(work.formation, target, [*budget, arithmetic_line(quality["numerical_error_db"])])
        quality |= {"focus": judged.focus, "budget": judged.budget}
        stage_flags = work.empty.attrs["flags"], work.track.stage.attrs["flags"]
        quality["flags"] = Flags.merged(*stage_flags, plan.flags, quality["flags"], judged.flags)
        finish(wip, folder, lineage=lineage, quality=quality, flags=quality["flags"])
    # Remove all receipts, including those of an earlier run with another number of jobs.
    _receipts(folder).remove()
    return folder


def tiles(campaign: Campaign, flight: str, pair: str, share: str, *, threads: int = 1) -> Path:
    """Form the tiles of an image that are assigned to one job; write results/<flight>/<pair>/tiles/<share>.json.

    Parameters
    ----------
    campaign, flight, pair
        Campaign, flight and pair of the image.
    share
        Tiles of the job, such as '2-of-8': every eighth tile, starting with the second.
    threads
        Number of tiles processed in parallel.

    Raises
    ------
    ValueError
        If `share` is not valid.
    """
    number, jobs = (int(part) for part in share.split("-of-"))
    if not 1 <= number <= jobs:
        raise ValueError(f"{share=}: must be one of 1-of-{jobs} to {jobs}-of-{jobs}")
    work = _open(campaign, flight, pair, threads=threads)
    windows = work.formation.windows
    mine = windows[number - 1 :: jobs]
    with sharing(work.folder, work.empty, "image", windows) as (wip, missing):
        todo = [window for window in mine if window in missing]
        if todo:
            work.compute(todo, open_array(wip, "image"))
    receipt = _receipts(work.folder) / f"{share}.json"
    write_json(receipt, {"tiles": len(mine), "formed": len(todo), "with": work.formation.plan.setting.line})
    return receipt


def _receipts(folder: ConfinedPath) -> ConfinedPath:
    """Return the folder of the receipts of finished shares, which exists until the image is complete."""
    return folder.with_name("tiles")


@dataclass(frozen=True, eq=False)
class _Work:
    """Common inputs of both rules: stage folder, upstream stages, image formation."""

    folder: ConfinedPath
    echo: xr.Dataset
    track: RefinedTrack
    pair: OpenPair
    scene: OpenScene
    formation: Formation
    empty: xr.Dataset
    threads: int
    scheduler: str

    @property
    def report(self) -> dict[str, Any]:
        """Integration and tile counts, for image.json."""
        integration, formation = self.formation.plan.integration, self.formation
        empty = 1 - len(formation.windows) / len(formation.tiles)
        tiles = {"tiles": {"formed": len(formation.windows), "empty_share": round(empty, 6)}}
        return (
            tiles
            if integration is None
            else {**tiles, "integration": {"chosen": integration.value, **integration.report}}
        )

    def compute(self, windows: list[Window], target: Any) -> None:
        """Compute the tiles of the given windows with the planned setting."""
        line = self.formation.plan.setting.line
        count = number_of(len(self.formation.windows), "tile")
        print(f"forming {len(windows)} of {count} with {line}", flush=True)
        if windows:
            image = self.formation.image
            compute_tiles(image, windows, target, threads=self.threads, scheduler=self.scheduler)
        if variants := self.formation.variant_counts:
            shares = ", ".join(f"{100 * count / variants.total():.3g} % {name}" for name, count in variants.items())
            print(f"fraction of pixel-pulse pairs by method of range computation: {shares}", flush=True)


def _open(campaign: Campaign, flight: str, pair: str, *, threads: int) -> _Work:
    echo = PairEcho.cleaned(campaign, flight, pair).stage
    profile = open_stage(campaign.stage("profile", flight, pair), "profile")
    scene = open_scene(campaign)
    logged = gated(campaign, open_pair(campaign, flight, pair, echo=echo), scene)
    track = open_refined(campaign, flight)
    opened, profiles = track.pair(logged), track.profiles(logged, profiles_of(profile, lazy=True))
    if opened.history is None:
        raise TypeError("the open echo stage has no phase history")
    plan = plan_pair(campaign, opened, scene, threads=threads)
    plan = replace(plan, decisions=(*plan.decisions, *track.decisions))
    compression_db = profile.attrs["compression_error_db"]
    formation = Formation(
        opened.history, profiles, scene.grid, plan, campaign.settings.processing.tile_px, compression_db
    )
    result = result_of(campaign, "image", flight, pair)
    # The number of pulse blocks depends on the memory of a job and does not affect the image, which jobs may share.
    choices = {name: value for name, value in plan.choices.items() if name != "pulse_blocks"}
    empty = stamped(
        xr.Dataset(
            {"image": (("y", "x"), np.broadcast_to(_MISSING, scene.grid.shape))},
            coords=scene.grid.coordinates,
            attrs={"frame": scene.grid.frame, "pair": pair, "flags": profile.attrs["flags"], "quality": {}},
        ),
        "image",
        modules=result.modules,
        parents=[echo, profile, track.stage, *scene.parents],
        inputs=pattern_digests(campaign, pair),
        settings={**result.settings, **scene.spec, "plan": choices},
    )
    scheduler = campaign.settings.processing.scheduler
    folder = campaign.stage("image", flight, pair)
    return _Work(folder, echo, track, opened, scene, formation, empty, threads, scheduler)
