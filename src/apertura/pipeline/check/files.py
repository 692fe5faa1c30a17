"""Whether everything is there that flights.tsv and the config promise."""

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.formats.names import recording_files
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import CONFIG, FLIGHTS, Flight, SampledWaveform

_AHEAD_S = 5.0


def check_files(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield every file that is missing, empty, dated in the future or may not be read."""
    campaign = inspected.campaign
    for flight in campaign.flights:
        yield from _recorded(campaign, flight)
    lookups: list[Callable[[], dict[str, Path]]] = [
        lambda: {f"scene.{role}": path for role, path in campaign.height_files().items()}
    ]
    lookups += [partial(campaign.pattern_files, pair) for flight in campaign.image_flights for pair in flight.pairs]
    waveform = campaign.settings.waveform
    if isinstance(waveform, SampledWaveform):
        lookups.append(lambda: {f"waveform.{waveform.file_key}": campaign.sent_file})
    for lookup in lookups:
        try:
            named = lookup()
        except CampaignError as problem:  # a path that leaves the folder
            yield problem
            continue
        for key, path in named.items():
            yield from _readable(path, f"the file of {CONFIG}: {key}", f"Copy it there, or correct {key}.")


def _recorded(campaign: Campaign, flight: Flight) -> Iterator[CampaignError]:
    """Yield what is wrong with the files of a flight: samples and logs, or phase history."""
    if not isinstance(campaign.settings.waveform, SampledWaveform):
        for node in flight.nodes:
            yield from _found(lambda node=node: list(campaign.raw_files(flight.name, node).values()))  # type: ignore[misc]
        return
    for node in flight.participants:
        expected = f"the recording of node {node} in flight {flight.name}"
        remedy = f"Copy it there, or take {node} out of the nodes of {flight.name} in {FLIGHTS}."
        try:
            promised = recording_files(campaign.flight_folder(flight.name), node)
        except CampaignError as problem:  # metadata that name files
            yield problem
            promised = ()
        for path in promised:
            try:
                inside(campaign.root, campaign.relative(path), where=campaign.root)
            except CampaignError as problem:  # a link
                yield problem
                continue
            yield from _readable(path, expected, remedy)
        yield from _found(lambda node=node: [campaign.track_file(flight.name, node)])  # type: ignore[misc]


def _found(files: Callable[[], list[Path]]) -> Iterator[CampaignError]:
    """Yield that files are missing, as whoever looks for them says it, or what is wrong with those found."""
    try:
        paths = files()
    except CampaignError as problem:
        yield problem
        return
    for path in paths:
        yield from _readable(path, "what was recorded", "Copy it again.")


def _readable(path: Path, expected: str, remedy: str) -> Iterator[CampaignError]:
    if not path.is_file():
        yield CampaignError("no such file", where=path, expected=expected, remedy=remedy)
    elif path.stat().st_mtime > time.time() + _AHEAD_S:
        yield CampaignError(
            f"dated {(path.stat().st_mtime - time.time()) / 3600:.1f} h in the future",
            where=path,
            expected="a time that has been, by this machine's clock",
            remedy=f"Set the clock, or run `touch {path}`: Snakemake takes no input from the future.",
        )
    elif path.stat().st_size == 0:
        yield CampaignError("empty, 0 bytes", where=path, expected=expected, remedy="Copy it again.")
    elif not os.access(path, os.R_OK):
        yield CampaignError("may not be read", where=path, expected=expected, remedy=f"Run `chmod u+r {path}`.")
