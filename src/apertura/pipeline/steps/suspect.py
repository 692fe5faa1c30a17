"""What would make a bad image better: hypotheses tried on one bright place, the best of them named."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.errors import CampaignError
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.imaging.sharpness import gathered
from apertura.core.scene.grid import SceneGrid
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import OfdmWaveform, SampledWaveform
from apertura.pipeline.opening.acquisition import Acquisition, open_acquisition
from apertura.pipeline.opening.echo import pair_echo
from apertura.pipeline.opening.refined import open_refined
from apertura.pipeline.opening.scene import OpenScene, open_scene
from apertura.pipeline.opening.suspects import Evidence, Suspicion, evidence_of, seen_from, some_pulses, suspicions
from apertura.pipeline.opening.transmitted import Transmitted, transmitted
from apertura.pipeline.steps.calibration import calibrated
from apertura.pipeline.store import open_stage

LEAST_GAIN_DB = 1.0
"""A hypothesis is named if the echoes of the flight gather better by so much where it is true."""

_SIDE_PX = 128
_PIXELS_PER_CELL = 2.5
_MOST_NAMED = 3


def hypotheses(
    campaign: Campaign, flight: str, *, brightest: tuple[float, float], cell_m: float
) -> list[dict[str, Any]]:
    """Return what would make the images of a flight sharper and agree, the best first; nothing is changed by it.

    Parameters
    ----------
    campaign, flight
        Which.
    brightest
        Easting and northing of a bright place in the scene's CRS, metres.
    cell_m
        Resolution cell.

    Returns
    -------
    list
        what, kind, and gain_db: how much more of the echoes gathers at one place.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):
        return []
    sent = transmitted(campaign, waveform)
    logged = {node: open_acquisition(campaign, flight, node, sent) for node in campaign.flight(flight).nodes}
    window, track = campaign.settings.processing.window, open_refined(campaign, flight)
    found = [
        _evidence(logged, pair, open_stage(campaign.stage("echo", flight, pair), "echo"), window)
        for pair in campaign.flight(flight).pairs
    ]
    nodes = {name: track.node(node) for name, node in logged.items()}
    if track.correction is not None:
        found = seen_from(nodes, found)
    scene = open_scene(campaign)
    now = gathered([one.history for one in found], _around(scene, brightest, cell_m), scene.level.height_m)
    named: list[tuple[float, Suspicion]] = []
    for suspicion in chain(suspicions(nodes, found), _other_echoes(campaign, flight, nodes, found, sent=sent)):
        grid = _around(scene, _moved(scene.grid, brightest, found, suspicion.histories), cell_m)
        try:
            then = gathered(suspicion.histories, grid, scene.level.height_m + suspicion.height_m)
        except ValueError:  # the places are too far apart for one pulse: it is not that
            continue
        gain_db = 10 * float(np.log10(max(then, 1e-12) / now))
        if gain_db > LEAST_GAIN_DB:
            named.append((gain_db, suspicion))
    named.sort(key=lambda one: -one[0])
    return [{"what": one.what, "kind": one.kind, "gain_db": round(gain_db, 2)} for gain_db, one in named[:_MOST_NAMED]]


def _evidence(nodes: Mapping[str, Acquisition], pair: str, echo: xr.Dataset, window: str) -> Evidence:
    return evidence_of(nodes, pair, echo.isel(pulse=some_pulses(echo)), window)


def _other_echoes(
    campaign: Campaign,
    flight: str,
    nodes: Mapping[str, Acquisition],
    found: Sequence[Evidence],
    *,
    sent: Transmitted,
) -> Iterator[Suspicion]:
    """Yield what only another reading of the samples shows: channels swapped, the other end of the band as carrier."""
    calibration = {one.pair: calibrated(campaign, flight, one.pair) for one in found}

    def formed(one: Evidence, nodes: Mapping[str, Acquisition], sent: Transmitted) -> PhaseHistory:
        tx, rx = (nodes[name] for name in one.pair.split("-"))
        echo = pair_echo(tx, rx, sent, campaign.settings.processing, calibration[one.pair])
        some = echo.at(some_pulses(echo.dataset))
        return evidence_of(nodes, one.pair, some, campaign.settings.processing.window).history

    waveform = sent.waveform
    if isinstance(waveform, OfdmWaveform):
        other = "band_centre" if waveform.carrier_is == "band_start" else "band_start"
        changed = transmitted(campaign, waveform.model_copy(update={"carrier_is": other}))
        placed = {name: replace(node, numerology=changed.numerology) for name, node in nodes.items()}
        with suppress(CampaignError):
            yield Suspicion(
                f"waveform.carrier_is is {other}", "carrier_is", tuple(formed(one, placed, changed) for one in found)
            )
    for name, node in nodes.items():
        names = node.raw.attrs["channels"]
        swapped = {**nodes, name: replace(node, raw=node.raw.assign_attrs(channels=names[::-1]))}
        with suppress(CampaignError):
            if len(names) == 2:
                histories = (
                    formed(one, swapped, sent) if one.pair.endswith(f"-{name}") else one.history for one in found
                )
                yield Suspicion(f"the channels of {name} are swapped", "channels", tuple(histories))


def hypothesis_line(named: Sequence[dict[str, Any]]) -> str:
    """Return what to look at first, to be put behind a flag; nothing where no hypothesis helps."""
    return f"; focus improves {named[0]['gain_db']:.1f} dB if {named[0]['what']}" if named else ""


def _around(scene: OpenScene, place: tuple[float, float], cell_m: float) -> SceneGrid:
    """Return a grid about a place, coarser than the scene's."""
    spacing_m, (x, y) = cell_m / _PIXELS_PER_CELL, place
    half = _SIDE_PX / 2 * spacing_m
    return SceneGrid(scene.grid.crs, x - half, y + half, spacing_m, (_SIDE_PX, _SIDE_PX), name=scene.grid.name)


def _moved(
    grid: SceneGrid, place: tuple[float, float], found: Sequence[Evidence], histories: Sequence[Any]
) -> tuple[float, float]:
    """Return where a place is expected if the antennas were elsewhere: as far away as they are, on average."""
    rows, columns = [], []
    for one, history in zip(found, histories, strict=True):
        for before, after in zip(one.history.aperture.legs, history.aperture.legs, strict=True):
            ends = grid.pixel_below(np.stack([before.mean(axis=0), after.mean(axis=0)]))
            rows.append(ends[1, 0] - ends[0, 0])
            columns.append(ends[1, 1] - ends[0, 1])
    return place[0] + grid.spacing_m * float(np.mean(columns)), place[1] - grid.spacing_m * float(np.mean(rows))
