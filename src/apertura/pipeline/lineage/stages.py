"""What stages are made from: recordings and logs up to images, and what the images of a flight say of each other."""

from collections.abc import Callable, Mapping, Sequence

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.digests import Result


def _raw(campaign: Campaign, flight: str, node: str) -> Result:
    files = tuple(campaign.relative(path) for path in campaign.recording_files(flight, node))
    return Result(campaign.manifest("raw", flight, node), files, campaign.relevant("raw"))


def _track(campaign: Campaign, flight: str, node: str) -> Result:
    log = campaign.relative(campaign.track_file(flight, node))
    return Result(campaign.manifest("track", flight, node), (log,), campaign.log_settings(node))


def _echo(campaign: Campaign, flight: str, pair: str) -> Result:
    calibration, waveform = campaign.settings.calibration, campaign.settings.waveform
    nodes = dict.fromkeys(pair.split("-"))
    if isinstance(waveform, SampledWaveform):
        sources = [campaign.manifest(stage, flight, node) for node in nodes for stage in ("raw", "track")]
        samples = [campaign.relative(campaign.recording_files(flight, node)[-1]) for node in nodes]
        sources = [campaign.relative(campaign.sent_file), *samples, *sources]
        if calibration is not None and campaign.flight(flight).kind == "image":
            sources.append(campaign.manifest("calibration", calibration.flight))
    else:
        logs = [campaign.track_file(flight, node) for node in nodes if campaign.logged(flight, node)]
        sources = [campaign.relative(path) for path in (*campaign.history_files(flight, [*nodes][-1]), *logs)]
    asked = campaign.relevant("echo", pair, flight=flight)
    return Result(campaign.manifest("echo", flight, pair), tuple(sources), asked)


def _calibration(campaign: Campaign, flight: str) -> Result:
    echoes = tuple(campaign.manifest("echo", flight, pair) for pair in campaign.flight(flight).pairs)
    return Result(campaign.manifest("calibration", flight), echoes, campaign.relevant("calibration"))


def _scene(campaign: Campaign) -> Result:
    asked, first = campaign.settings.scene, campaign.image_flights[0]
    settled_by_flight = "auto" in {asked.crs, asked.spacing_m, asked.bounds_m}
    echoes = [campaign.manifest("echo", first.name, pair) for pair in first.pairs] if settled_by_flight else []
    settings = {**campaign.relevant("scene"), "campaign": campaign.settings.campaign}
    return Result(campaign.manifest("scene"), (*echoes, *heights(campaign)), settings)


def _terrain(campaign: Campaign) -> Result:
    return Result(
        campaign.manifest("terrain"), (campaign.manifest("scene"), *heights(campaign)), campaign.relevant("terrain")
    )


def _profile(campaign: Campaign, flight: str, pair: str) -> Result:
    sources = seen(campaign, flight, [pair], "echo")
    return Result(campaign.manifest("profile", flight, pair), sources, campaign.relevant("profile", pair))


def _refined_track(campaign: Campaign, flight: str) -> Result:
    pairs = [] if campaign.settings.processing.autofocus == "off" else campaign.flight(flight).pairs
    sources = seen(campaign, flight, pairs, "echo", "profile")
    return Result(campaign.manifest("refined_track", flight), sources, campaign.relevant("refined_track"))


def image(campaign: Campaign, flight: str, pair: str) -> Result:
    """Return what a pair's image is made from."""
    sources = (*seen(campaign, flight, [pair], "echo", "profile"), campaign.manifest("refined_track", flight))
    return Result(campaign.manifest("image", flight, pair), sources, campaign.relevant("image", pair))


def _assessment(campaign: Campaign, flight: str) -> Result:
    stages = [campaign.manifest(of, flight, pair) for pair in campaign.flight(flight).pairs for of in ("echo", "image")]
    sources = (*stages, campaign.manifest("refined_track", flight), *ground(campaign))
    return Result(campaign.manifest("assessment", flight), sources, campaign.relevant("assess"))


def seen(campaign: Campaign, flight: str, pairs: Sequence[str], *stages: str) -> tuple[str, ...]:
    """Return stages of some pairs, the ground and the antennas that see it."""
    formed = [campaign.manifest(stage, flight, pair) for pair in pairs for stage in stages]
    patterns = [campaign.relative(path) for pair in pairs for path in campaign.pattern_files(pair).values()]
    return tuple(dict.fromkeys([*formed, *ground(campaign), *patterns]))


def ground(campaign: Campaign) -> list[str]:
    """Return the manifests of the grid and of the heights that make the ground."""
    return [campaign.manifest("scene"), *([campaign.manifest("terrain")] if campaign.settings.scene.dem else [])]


def heights(campaign: Campaign) -> list[str]:
    """Return the files of heights that a campaign names, relative to it."""
    return [campaign.relative(path) for path in campaign.height_files().values()]


STAGES: Mapping[str, Callable[..., Result]] = {
    "raw": _raw,
    "track": _track,
    "echo": _echo,
    "calibration": _calibration,
    "scene": _scene,
    "terrain": _terrain,
    "profile": _profile,
    "refined_track": _refined_track,
    "image": image,
    "assessment": _assessment,
}
"""Name → what it is made from."""
