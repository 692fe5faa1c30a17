"""What every result is made from: files, other results, settings. Rules, steps and checks ask here.

A result is what one rule writes. Its manifest, written last, names its files and what they were made from; another
file, setting or code (`apertura.steps.code`) makes it stale, whatever the times of files say.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

from apertura.campaign import Campaign
from apertura.digests import Result
from apertura.paths import shipped
from apertura.provenance import sha256_tree
from apertura.settings import CLOCKS, CONFIG, FLIGHTS, SEGMENTS, SampledWaveform
from apertura.webmap.page import page_sha256

STUDY = "study"
"""Folder of what is measured when it is asked for."""

_SHOWN = ("layers", "export")
"""Results of a pair that the map shows."""

INTERFEROMETRY = "interferometry"
"""Folder of what two images tell of each other's phase."""

ON_DEMAND = frozenset({"cphd", "page", "pictures", "speed_accuracy", "whole"})
"""Results that are made when they are asked for, and not with the images."""


def on_demand(manifest: str) -> bool:
    """Return whether a manifest is that of a result made when it is asked for.

    Examples
    --------
    >>> on_demand("results/f01/a-b/cphd.manifest.json"), on_demand("results/f01/a-b/echo.manifest.json")
    (True, False)
    """
    return manifest.rpartition("/")[2].removesuffix(".manifest.json") in ON_DEMAND


def result_of(campaign: Campaign, result: str, *where: str) -> Result:
    """Return a result of a campaign.

    Parameters
    ----------
    campaign
        Settings and flights.
    result
        A key of `RESULTS`.
    *where
        Flight and node (raw, track), flight and pair (echo, profile, image, layers, export, cphd, pictures), flight
        (calibration, refined_track, assessment, fused, page), a name of `interferometry.pairs` (interferogram),
        nothing (the others).
    """
    return RESULTS[result](campaign, *where)


def results_of(campaign: Campaign) -> Iterator[tuple[str, Result]]:
    """Yield every result of a campaign with its key of `RESULTS`, each after those it is made from."""
    for result, *where in _order(campaign):
        yield result, result_of(campaign, result, *where)


def _order(campaign: Campaign) -> Iterator[tuple[str, ...]]:
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    for flight in sorted(campaign.flights, key=lambda flight: flight.kind != "calibration"):
        for node in flight.participants if sampled else ():
            yield from ((stage, flight.name, node) for stage in ("raw", "track"))
        yield from (("echo", flight.name, pair) for pair in flight.pairs)
        if flight.kind == "calibration":
            yield "calibration", flight.name
    yield ("scene",)
    if campaign.settings.scene.dem:
        yield ("terrain",)
    for flight in campaign.image_flights:
        yield from (("profile", flight.name, pair) for pair in flight.pairs)
        yield "refined_track", flight.name
        yield from ((stage, flight.name, pair) for stage in ("image", "layers") for pair in flight.pairs)
        yield "assessment", flight.name
        yield from ((result, flight.name, pair) for result in ("export", "cphd") for pair in flight.pairs)
    yield from (("coverage",), ("cube",))
    yield from (("fused", flight.name) for flight in campaign.image_flights)
    yield from (("interferogram", name) for name in campaign.settings.interferometry.pairs)
    yield ("mosaic",)
    yield ("stac",)
    for flight in campaign.image_flights:
        yield from (("pictures", flight.name, pair) for pair in flight.pairs)
        yield "page", flight.name
    yield ("map",)
    yield from (("speed_accuracy",), ("whole",))
    yield ("ro_crate",)


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
    return Result(campaign.manifest("scene"), (*echoes, *_heights(campaign)), settings)


def _terrain(campaign: Campaign) -> Result:
    return Result(
        campaign.manifest("terrain"), (campaign.manifest("scene"), *_heights(campaign)), campaign.relevant("terrain")
    )


def _layers(campaign: Campaign, flight: str, pair: str) -> Result:
    settings = {"campaign": campaign.settings.campaign, **campaign.relevant("layers", pair)}
    return Result(
        campaign.manifest("layers", flight, pair), _seen(campaign, flight, [pair], "echo", "profile"), settings
    )


def _coverage(campaign: Campaign) -> Result:
    pairs = [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]
    made = [campaign.manifest(stage, *pair) for pair in pairs for stage in ("echo", "layers")] + [
        campaign.manifest("scene")
    ]
    return Result(campaign.manifest("coverage"), tuple(made), {"campaign": campaign.settings.campaign})


def _profile(campaign: Campaign, flight: str, pair: str) -> Result:
    seen = _seen(campaign, flight, [pair], "echo")
    return Result(campaign.manifest("profile", flight, pair), seen, campaign.relevant("profile", pair))


def _refined_track(campaign: Campaign, flight: str) -> Result:
    pairs = [] if campaign.settings.processing.autofocus == "off" else campaign.flight(flight).pairs
    sources = _seen(campaign, flight, pairs, "echo", "profile")
    return Result(campaign.manifest("refined_track", flight), sources, campaign.relevant("refined_track"))


def _image(campaign: Campaign, flight: str, pair: str) -> Result:
    sources = (*_seen(campaign, flight, [pair], "echo", "profile"), campaign.manifest("refined_track", flight))
    return Result(campaign.manifest("image", flight, pair), sources, campaign.relevant("image", pair))


def _seen(campaign: Campaign, flight: str, pairs: Sequence[str], *stages: str) -> tuple[str, ...]:
    """Return stages of some pairs, the ground and the antennas that see it."""
    formed = [campaign.manifest(stage, flight, pair) for pair in pairs for stage in stages]
    patterns = [campaign.relative(path) for pair in pairs for path in campaign.pattern_files(pair).values()]
    return tuple(dict.fromkeys([*formed, *_ground(campaign), *patterns]))


def _assessment(campaign: Campaign, flight: str) -> Result:
    stages = [campaign.manifest(of, flight, pair) for pair in campaign.flight(flight).pairs for of in ("echo", "image")]
    sources = (*stages, campaign.manifest("refined_track", flight), *_ground(campaign))
    return Result(campaign.manifest("assessment", flight), sources, campaign.relevant("assess"))


def _cube(campaign: Campaign) -> Result:
    flights = campaign.image_flights
    images = [campaign.manifest("image", flight.name, pair) for flight in flights for pair in flight.pairs]
    sources = (*images, *(campaign.manifest("assessment", one.name) for one in flights), campaign.manifest("scene"))
    return Result(campaign.manifest("cube"), sources, {"tile_px": campaign.settings.processing.tile_px})


def _export(campaign: Campaign, flight: str, pair: str) -> Result:
    sources = tuple(campaign.manifest(*of) for of in (("image", flight, pair), ("assessment", flight), ("scene",)))
    return Result(campaign.manifest("export", flight, pair), sources, {"campaign": campaign.settings.campaign})


def _cphd(campaign: Campaign, flight: str, pair: str) -> Result:
    sources = (campaign.manifest("echo", flight, pair), campaign.manifest("scene"))
    return Result(campaign.manifest("cphd", flight, pair), sources, {"campaign": campaign.settings.campaign})


def _pictures(campaign: Campaign, flight: str, pair: str) -> Result:
    stages = [campaign.manifest(stage, flight, pair) for stage in ("echo", "profile", "image", "layers")]
    if isinstance(campaign.settings.waveform, SampledWaveform):
        stages.append(campaign.manifest("raw", flight, pair.partition("-")[0]))
    sources = (*stages, campaign.manifest("refined_track", flight), *_ground(campaign))
    return Result(campaign.manifest("pictures", flight, pair), sources, {"campaign": campaign.settings.campaign})


def _page(campaign: Campaign, flight: str) -> Result:
    pairs = campaign.flight(flight).pairs
    made = [campaign.manifest(of, flight, pair) for pair in pairs for of in ("pictures", "export")]
    images = [campaign.manifest("image", flight, pair) for pair in pairs]
    sources = (*made, *images, campaign.manifest("export", flight, "fused"), campaign.manifest("scene"))
    return Result(campaign.manifest("page", flight), sources, campaign.values)


def _fused(campaign: Campaign, flight: str) -> Result:
    images = [campaign.manifest("image", flight, pair) for pair in campaign.flight(flight).pairs]
    sources = (*images, campaign.manifest("assessment", flight), campaign.manifest("cube"), campaign.manifest("scene"))
    settings = {"campaign": campaign.settings.campaign, "tile_px": campaign.settings.processing.tile_px}
    return Result(campaign.manifest("export", flight, "fused"), sources, settings)


def _mosaic(campaign: Campaign) -> Result:
    made = [
        campaign.manifest(result, flight.name, folder)
        for flight in campaign.image_flights
        for result, folders in (("layers", flight.pairs), ("export", (*flight.pairs, "fused")))
        for folder in folders
    ]
    return Result(campaign.manifest("mosaic", "mosaic"), tuple(made), {"campaign": campaign.settings.campaign})


def _stac(campaign: Campaign) -> Result:
    flights = campaign.image_flights
    pairs = [(one.name, pair) for one in flights for pair in one.pairs]
    of_pairs = [(result, *pair) for pair in pairs for result in ("echo", "layers", "export")]
    described = [*of_pairs, *(("export", one.name, "fused") for one in flights), ("scene",)]
    sources = tuple(campaign.manifest(*of) for of in described)
    return Result(campaign.manifest("stac"), sources, {"campaign": campaign.settings.campaign})


def _ro_crate(campaign: Campaign) -> Result:
    made = [result_of(campaign, name, *where).manifest for name, *where in _order(campaign) if name != "ro_crate"]
    stated = [path.as_posix() for path in (CONFIG, FLIGHTS, SEGMENTS, CLOCKS) if (campaign.root / path).is_file()]
    sources = (*stated, *(manifest for manifest in made if not on_demand(manifest)))
    settings = {"campaign": campaign.settings.campaign, "workflow": sha256_tree(shipped() / "workflow")}
    return Result(campaign.manifest("ro_crate"), sources, settings)


def _map(campaign: Campaign) -> Result:
    shown = [(stage, one.name, pair) for one in campaign.image_flights for pair in one.pairs for stage in _SHOWN]
    shown += [("export", one.name, "fused") for one in campaign.image_flights]
    made = [campaign.manifest(*of) for of in (*shown, ("coverage",), ("scene",))]
    truth = ["truth.json"] if (campaign.root / "truth.json").is_file() else []
    known = {key: campaign.values.get(key) for key in ("campaign", "calibration")}
    known["reference_points"] = campaign.values["scene"]["reference_points"]
    return Result(campaign.manifest("map", "map"), (*made, *truth), {**known, "page": page_sha256()})


def _interferogram(campaign: Campaign, name: str) -> Result:
    images = campaign.settings.interferometry.images(name)
    made = [
        source
        for flight, pair in images
        for source in (
            *_seen(campaign, flight, [pair], "echo", "profile"),
            *(campaign.manifest(stage, flight, pair) for stage in ("image", "layers")),
        )
    ]
    settings = {"campaign": campaign.settings.campaign, "images": images, **campaign.relevant("interferogram")}
    return Result(campaign.manifest("interferogram", INTERFEROMETRY, name), tuple(dict.fromkeys(made)), settings)


def _speed_accuracy(campaign: Campaign) -> Result:
    image, pair = _image(campaign, *charted(campaign)), list(charted(campaign))
    return Result(campaign.manifest("speed_accuracy", STUDY), image.sources, {"pair": pair, **image.settings})


def _whole(campaign: Campaign) -> Result:
    nodes = [(flight.name, node) for flight in campaign.flights for node in flight.nodes]
    recorded = [campaign.relative(path) for at in nodes for path in campaign.raw_files(*at).values()]
    return Result(campaign.manifest("whole", STUDY), (*recorded, *_heights(campaign)), campaign.values)


def charted(campaign: Campaign) -> tuple[str, str]:
    """Return the flight and the pair that are charted: the last pair of the first flight, bistatic where one is."""
    return campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1]


def _heights(campaign: Campaign) -> list[str]:
    return [campaign.relative(path) for path in campaign.height_files().values()]


def _ground(campaign: Campaign) -> list[str]:
    return [campaign.manifest("scene"), *([campaign.manifest("terrain")] if campaign.settings.scene.dem else [])]


RESULTS: Mapping[str, Callable[..., Result]] = {
    "raw": _raw,
    "track": _track,
    "echo": _echo,
    "calibration": _calibration,
    "scene": _scene,
    "terrain": _terrain,
    "layers": _layers,
    "coverage": _coverage,
    "profile": _profile,
    "refined_track": _refined_track,
    "image": _image,
    "assessment": _assessment,
    "cube": _cube,
    "export": _export,
    "cphd": _cphd,
    "fused": _fused,
    "mosaic": _mosaic,
    "stac": _stac,
    "ro_crate": _ro_crate,
    "pictures": _pictures,
    "page": _page,
    "map": _map,
    "interferogram": _interferogram,
    "speed_accuracy": _speed_accuracy,
    "whole": _whole,
}
"""Name → what it is made from."""
