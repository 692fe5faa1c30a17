"""What products are made from: files for other programs, the cube, catalogues, the report, charts."""

from collections.abc import Callable, Mapping

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.digests import Result
from apertura.pipeline.lineage.stages import ground, heights, image, seen

STUDY = "study"
"""Folder of what is measured when it is asked for."""

INTERFEROMETRY = "interferometry"
"""Folder of what two images tell of each other's phase."""

_SHOWN = ("layers", "export")
"""Results of a pair that the map shows."""


def _layers(campaign: Campaign, flight: str, pair: str) -> Result:
    settings = {"campaign": campaign.settings.campaign, **campaign.relevant("layers", pair)}
    return Result(
        campaign.manifest("layers", flight, pair), seen(campaign, flight, [pair], "echo", "profile"), settings
    )


def _coverage(campaign: Campaign) -> Result:
    pairs = [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]
    made = [campaign.manifest(stage, *pair) for pair in pairs for stage in ("echo", "layers")] + [
        campaign.manifest("scene")
    ]
    return Result(campaign.manifest("coverage"), tuple(made), {"campaign": campaign.settings.campaign})


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


def _fused(campaign: Campaign, flight: str) -> Result:
    images = [campaign.manifest("image", flight, pair) for pair in campaign.flight(flight).pairs]
    sources = (*images, campaign.manifest("assessment", flight), campaign.manifest("cube"), campaign.manifest("scene"))
    settings = {"campaign": campaign.settings.campaign, "tile_px": campaign.settings.processing.tile_px}
    return Result(campaign.manifest("export", flight, "fused"), sources, settings)


def _interferogram(campaign: Campaign, name: str) -> Result:
    images = campaign.settings.interferometry.images(name)
    made = [
        source
        for flight, pair in images
        for source in (
            *seen(campaign, flight, [pair], "echo", "profile"),
            *(campaign.manifest(stage, flight, pair) for stage in ("image", "layers")),
        )
    ]
    settings = {"campaign": campaign.settings.campaign, "images": images, **campaign.relevant("interferogram")}
    return Result(campaign.manifest("interferogram", INTERFEROMETRY, name), tuple(dict.fromkeys(made)), settings)


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


def _map(campaign: Campaign) -> Result:
    shown = [(stage, one.name, pair) for one in campaign.image_flights for pair in one.pairs for stage in _SHOWN]
    shown += [("export", one.name, "fused") for one in campaign.image_flights]
    made = [campaign.manifest(*of) for of in (*shown, ("coverage",), ("scene",))]
    truth = ["truth.json"] if (campaign.root / "truth.json").is_file() else []
    known = {key: campaign.values.get(key) for key in ("campaign", "calibration")}
    known["reference_points"] = campaign.values["scene"]["reference_points"]
    return Result(campaign.manifest("map", "map"), (*made, *truth), known)


def _pictures(campaign: Campaign, flight: str, pair: str) -> Result:
    stages = [campaign.manifest(stage, flight, pair) for stage in ("echo", "profile", "image", "layers")]
    if isinstance(campaign.settings.waveform, SampledWaveform):
        stages.append(campaign.manifest("raw", flight, pair.partition("-")[0]))
    sources = (*stages, campaign.manifest("refined_track", flight), *ground(campaign))
    return Result(campaign.manifest("pictures", flight, pair), sources, {"campaign": campaign.settings.campaign})


def _page(campaign: Campaign, flight: str) -> Result:
    pairs = campaign.flight(flight).pairs
    made = [campaign.manifest(of, flight, pair) for pair in pairs for of in ("pictures", "export")]
    images = [campaign.manifest("image", flight, pair) for pair in pairs]
    sources = (*made, *images, campaign.manifest("export", flight, "fused"), campaign.manifest("scene"))
    return Result(campaign.manifest("page", flight), sources, campaign.values)


def _report(campaign: Campaign) -> Result:
    pages = tuple(campaign.manifest("page", flight.name) for flight in campaign.image_flights)
    return Result(campaign.manifest("report"), (*pages, campaign.manifest("coverage")), campaign.values)


def _speed_accuracy(campaign: Campaign) -> Result:
    formed, pair = image(campaign, *charted(campaign)), list(charted(campaign))
    return Result(campaign.manifest("speed_accuracy", STUDY), formed.sources, {"pair": pair, **formed.settings})


def _whole(campaign: Campaign) -> Result:
    nodes = [(flight.name, node) for flight in campaign.flights for node in flight.nodes]
    recorded = [campaign.relative(path) for at in nodes for path in campaign.raw_files(*at).values()]
    return Result(campaign.manifest("whole", STUDY), (*recorded, *heights(campaign)), campaign.values)


def charted(campaign: Campaign) -> tuple[str, str]:
    """Return the flight and the pair that are charted: the last pair of the first flight, bistatic where one is."""
    return campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1]


PRODUCTS: Mapping[str, Callable[..., Result]] = {
    "layers": _layers,
    "coverage": _coverage,
    "cube": _cube,
    "export": _export,
    "cphd": _cphd,
    "fused": _fused,
    "mosaic": _mosaic,
    "stac": _stac,
    "pictures": _pictures,
    "page": _page,
    "report": _report,
    "map": _map,
    "interferogram": _interferogram,
    "speed_accuracy": _speed_accuracy,
    "whole": _whole,
}
"""Name → what it is made from."""
