"""Processing of a campaign by the rules of the workflow in this process, without Snakemake: notebooks and debuggers."""

from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.workflow.lineage import on_demand, places_of
from apertura.workflow.rules import RESULTS


def process(campaign: Campaign | str | Path, *, first: str = "", last: str = "", threads: int = 1) -> Campaign:
    """Run the steps of a campaign one after the other in this process.

    All selected steps run, whether their results are up to date or not. `apertura run` runs them in parallel, resumes,
    and omits results that are up to date; both write the same files.

    Parameters
    ----------
    campaign
        Campaign, or its folder.
    first, last
        First and last step in the order of the workflow's rules, such as ``echo`` and ``image``; empty for the first
        and the last one. Steps whose results are written on demand only are omitted.
    threads
        Number of tiles processed in parallel.

    Returns
    -------
    Campaign
        The campaign, loaded.

    Raises
    ------
    CampaignError
        If the folder is not a valid campaign, or a step rejects its inputs.
    ValueError
        If `first` or `last` is not a step of the workflow.

    Examples
    --------
    >>> import tempfile
    >>> import apertura as ap
    >>> from apertura.simulation import preset
    >>> folder = ap.simulate(tempfile.mkdtemp() + "/campaign", preset("demo", pulses=8))
    >>> campaign = ap.process(folder, last="echo")
    >>> ap.open_campaign(folder).stage("echo", "f01", "uav1-uav2").sizes["pulse"]
    8
    """
    opened = campaign if isinstance(campaign, Campaign) else Campaign.load(campaign)
    names = list(dict.fromkeys(rule.name for rule in RESULTS.values()))
    for name in filter(None, (first, last)):
        if name not in names:
            raise ValueError(f"{name!r} is not a step of the workflow: {', '.join(names)}")
    selected = names[names.index(first or names[0]) : names.index(last or names[-1]) + 1]
    done = set()
    for result, where, written in places_of(opened):
        rule = RESULTS[result]
        if rule.name not in selected or (rule.name, where) in done or on_demand(opened, written.manifest):
            continue
        done.add((rule.name, where))  # a step may write several results
        rule.step(opened, *where, *rule.last_words, **({"threads": threads} if "threads" in rule.options else {}))
    return opened
