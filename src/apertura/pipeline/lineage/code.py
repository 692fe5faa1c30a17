"""Which code makes each result: its step and, of the tables of formats and engines, what this campaign meets."""

from collections.abc import Iterator
from functools import cache

from apertura.common.code_imports import import_closure
from apertura.core.focus.engines import ENGINES
from apertura.formats.export import EXPORTS, export_modules
from apertura.formats.names import FINDERS, PHASE_HISTORIES, RECORDERS, TRACKS, log_format
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform

_STEPS = {
    "raw": "apertura.pipeline.steps.ingest",
    "track": "apertura.pipeline.steps.ingest",
    "refined_track": "apertura.pipeline.steps.refine",
    "pictures": "apertura.views.report.pictures",
    "page": "apertura.views.report.step",
    "assessment": "apertura.pipeline.steps.assess",
    "fused": "apertura.pipeline.steps.export",
    "report": "apertura.views.report.step",
    "map": "apertura.views.webmap.step",
    "speed_accuracy": "apertura.views.chart.speed_accuracy",
    "whole": "apertura.views.chart.whole",
}
"""Results that are called otherwise than the module of `apertura.pipeline.steps` that makes them."""

_EXPORTS = {"export": "pair", **{kind: kind for kind in ("fused", "layers", "interferogram")}}
"""Results whose files the rows of `apertura.formats.export` write → the kind of their rows."""

_READS = "apertura.formats.reading"
"""Calls the readers of rows: a result whose step imports it may read what was recorded."""

_FOCUSES = frozenset(
    {
        "apertura.core.focus.tiles",
        "apertura.methods.autofocus.patches",
        "apertura.methods.synchronisation.scene_alignment",
    }
)
"""Call engines: a result whose step imports one of them may stand on pixels that any engine has formed."""


def modules_of(campaign: Campaign, result: str, *where: str) -> tuple[str, ...]:
    """Return the modules whose import closure is the code that makes a result, as dotted names.

    Of readers those count that the files in raw/ name: another format's reader makes nothing again.

    Parameters
    ----------
    campaign, result, *where
        As `apertura.pipeline.lineage.result_of`.
    """
    step = (_STEPS.get(result, f"apertura.pipeline.steps.{result}"), *_written(result))
    runs = _closure(step)
    engines = tuple(ENGINES.values()) if _FOCUSES & runs else ()
    readers = sorted(set(_readers(campaign, result, where))) if _READS in runs else ()
    return (*step, *engines, *readers)


def _written(result: str) -> tuple[str, ...]:
    if result == "mosaic":  # VRTs of what is there, with the styles of its bands
        return tuple(sorted({row.module for row in EXPORTS if row.style}))
    return tuple(export_modules(_EXPORTS[result])) if result in _EXPORTS else ()


@cache
def _closure(modules: tuple[str, ...]) -> frozenset[str]:
    return frozenset(import_closure(modules))


def _readers(campaign: Campaign, result: str, where: tuple[str, ...]) -> Iterator[str]:
    """Yield the modules that read what the nodes of a place have recorded, and their logs."""
    flights = [campaign.flight(where[0])] if where and result != "interferogram" else campaign.flights
    for flight in flights:
        own = {node for named in where[1:] for node in named.split("-")} & {*flight.participants}
        for node in own or flight.participants:
            if not isinstance(campaign.settings.waveform, SampledWaveform):
                yield _module(PHASE_HISTORIES[campaign.settings.waveform.format].reader)
            elif result != "track":
                first = campaign.recording_files(flight.name, node)[0].name
                rows = [row for row in RECORDERS if first.endswith(row[0])]
                yield from (_module(table[row]) for table in (RECORDERS, FINDERS) for row in rows if row in table)
            if result != "raw" and campaign.logged(flight.name, node):
                options = campaign.settings.nodes[node].log.options
                yield _module(TRACKS[log_format(campaign.track_file(flight.name, node), options)].reader)


def _module(function: str) -> str:
    return function.partition(":")[0]
