"""How each pair of a campaign will be imaged: from its echo, or from the flight logs before anything ran."""

import shutil
from dataclasses import replace

from rich.filesize import decimal

from apertura.common.errors import CampaignError
from apertura.common.flags.raised import Flags
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency
from apertura.core.focus.job import Job
from apertura.core.imaging.job import imaging_job, settle
from apertura.core.planning.accuracy import decide_accuracy
from apertura.core.planning.memory import memory_limit
from apertura.core.planning.plan import Decision, Plan
from apertura.core.planning.planner import make_plan
from apertura.core.scene.clearance import check_antennas
from apertura.core.scene.ground_models import GroundModels
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CONFIG
from apertura.pipeline.opening.antennas import lit
from apertura.pipeline.opening.budget import budget_of
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.scene import OpenScene
from apertura.pipeline.store import manifest_of


def plan_pair(campaign: Campaign, pair: OpenPair, scene: OpenScene, *, threads: int = 1) -> Plan:
    """Return how an open pair will be imaged.

    Parameters
    ----------
    campaign
        Whose config asks.
    pair, scene
        What is known of the pair, and the campaign's grid and ground.
    threads
        Tiles formed at once: for seconds and bytes; nothing is chosen by it.

    Raises
    ------
    CampaignError
        If the job cannot fit in memory or on the disk, or its geometry is impossible.
    """
    where = f"flight {pair.flight}, pair {pair.name}"
    flags = check_antennas(scene.grid, scene.terrain, pair.aperture, where=where)
    accuracy = asked_accuracy(campaign, pair, scene)
    plan = plan_job(campaign, job_of(campaign, pair, scene, threads=threads), accuracy_db=float(accuracy.value))
    plan = replace(plan, decisions=(*plan.decisions, accuracy), flags=Flags.merged(flags, plan.flags))
    written = manifest_of(campaign.stage("image", pair.flight, pair.name)).is_file()
    free_disk = None if written else shutil.disk_usage(campaign.root).free
    check_fits(plan, free_disk=free_disk, where=f"{pair.flight}/{pair.name}")
    return plan


def plan_job(campaign: Campaign, job: Job, *, accuracy_db: float) -> Plan:
    """Return how a job will be done at an accuracy and with the overrides of a campaign."""
    overrides = campaign.settings.processing.planned
    return make_plan(job, accuracy_db=accuracy_db, overrides=overrides, where=f"{CONFIG}: processing")


def asked_accuracy(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Decision:
    """Return the numerical error to ask for, and why."""
    asked = campaign.settings.processing.accuracy_db
    if asked != "auto":
        return Decision("accuracy_db", asked, "asked for")
    return decide_accuracy(budget_of(campaign, pair, scene))


def job_of(campaign: Campaign, pair: OpenPair, scene: OpenScene, *, threads: int = 1) -> Job:
    """Return the planner's job of an open pair, or of some of its pulses."""
    ground = GroundModels.of(scene.terrain, scene.level, scene.grid)
    job = imaging_job(
        pair.aperture,
        pair.frequency_hz,
        pair.weight,
        scene.grid,
        ground,
        history=pair.history,
        beams=pair.beams,
        integration=campaign.settings.processing.integrated,
    )
    return replace(
        job,
        illumination=lit(campaign, pair.name, job.beams, scene, pair.aperture),
        tile_px=campaign.settings.processing.tile_px,
        threads=threads,
        path_limit_m=pair.path_limit_m,
        memory_bytes=memory_limit(),
    )


def weighing(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Beams | None:
    """Return what weighs the pulses of a pair over the scene, antennas and the sector integrated; None where all count.

    As `job_of` settles it, without a look at the echo: what profiles must cover follows from it.
    """
    centre_hz, asked = centre_frequency(pair.frequency_hz), campaign.settings.processing.integrated
    settled = settle(pair.aperture, centre_hz, scene.grid, scene.level, antennas=pair.beams, asked=asked)
    return Beams.within(settled.sector, pair.beams)


def check_fits(plan: Plan, *, free_disk: int | None, where: str, memory: int | None = None) -> None:
    """Raise CampaignError, with the numbers, unless the plan fits this machine.

    Parameters
    ----------
    plan
        Of one pair.
    free_disk
        Bytes; None: do not ask.
    where
        Flight and pair.
    memory
        Bytes, by default those of this machine or of the control group that the process runs in.
    """
    memory = memory or memory_limit()
    if plan.memory_bytes > memory:
        raise CampaignError(
            f"imaging needs {decimal(plan.memory_bytes)} of memory",
            where=where,
            expected=f"at most the {decimal(memory)} that this machine, or the job's share of it, has",
            remedy="Make scene.bounds_m smaller, use fewer threads, or ask for more memory.",
        )
    if free_disk is not None and plan.disk_bytes > free_disk:
        raise CampaignError(
            f"the results need {decimal(plan.disk_bytes)} on disk",
            where=where,
            expected=f"at most the {decimal(free_disk)} that are free",
            remedy="Free some space, make scene.bounds_m smaller or scene.spacing_m larger.",
        )
