"""What every result is made from: files, other results, settings. Rules, steps and checks ask here.

A result is what one rule writes. Its manifest, written last, names its files and what they were made from; another
file, setting or code (`apertura.pipeline.lineage.code`) makes it stale, whatever the times of files say.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from apertura.common.paths import shipped
from apertura.common.provenance import sha256_tree
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CLOCKS, CONFIG, FLIGHTS, SEGMENTS, SampledWaveform
from apertura.pipeline.digests import Result
from apertura.pipeline.lineage.code import modules_of
from apertura.pipeline.lineage.products import INTERFEROMETRY, PRODUCTS, STUDY, charted
from apertura.pipeline.lineage.stages import STAGES

__all__ = [
    "INTERFEROMETRY",
    "ON_DEMAND",
    "RESULTS",
    "STUDY",
    "charted",
    "on_demand",
    "places_of",
    "result_of",
    "results_of",
]

ON_DEMAND = frozenset({"cphd", "page", "pictures", "report", "speed_accuracy", "whole"})
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
    return replace(RESULTS[result](campaign, *where), modules=modules_of(campaign, result, *where))


def results_of(campaign: Campaign) -> Iterator[tuple[str, Result]]:
    """Yield every result of a campaign with its key of `RESULTS`, each after those it is made from."""
    for result, _, made in places_of(campaign):
        yield result, made


def places_of(campaign: Campaign) -> Iterator[tuple[str, tuple[str, ...], Result]]:
    """Yield every result as `results_of` does, with what it is of, as `result_of` takes it."""
    for result, *where in _order(campaign):
        yield result, tuple(where), result_of(campaign, result, *where)


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
    yield ("report",)
    yield ("map",)
    yield from (("speed_accuracy",), ("whole",))
    yield ("ro_crate",)


def _ro_crate(campaign: Campaign) -> Result:
    made = [result_of(campaign, name, *where).manifest for name, *where in _order(campaign) if name != "ro_crate"]
    stated = [path.as_posix() for path in (CONFIG, FLIGHTS, SEGMENTS, CLOCKS) if (campaign.root / path).is_file()]
    sources = (*stated, *(manifest for manifest in made if not on_demand(manifest)))
    settings = {"campaign": campaign.settings.campaign, "workflow": sha256_tree(shipped() / "workflow")}
    return Result(campaign.manifest("ro_crate"), sources, settings)


RESULTS: Mapping[str, Callable[..., Result]] = {**STAGES, **PRODUCTS, "ro_crate": _ro_crate}
"""Name → what it is made from."""
