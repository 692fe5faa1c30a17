"""Whether the calibration that the config names exists, for every pair that takes offsets from it."""

from collections.abc import Iterator

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import frame_from_map
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.check.places import pair_aperture
from apertura.pipeline.config import CONFIG, FLIGHTS, Calibration, Flight

_WHERE = f"{CONFIG}: calibration"


def check_calibration(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a calibration flight that is none, pairs that it does not have, a reflector out of reach of the prefix."""
    campaign = inspected.campaign
    asked, kinds = campaign.settings.calibration, {flight.name: flight for flight in campaign.flights}
    if asked is None:
        flown = [flight.name for flight in campaign.flights if flight.kind == "calibration"]
        if flown:
            yield CampaignError(
                f"no section calibration, and {FLIGHTS} has flight {flown[0]} of kind calibration",
                where=CONFIG,
                expected="calibration.flight and calibration.reflector_m",
                remedy="Say where the reflector stands, or take the flight out.",
            )
        return
    flight = kinds.get(asked.flight)
    if flight is None or flight.kind != "calibration":
        named = [name for name, one in kinds.items() if one.kind == "calibration"]
        yield CampaignError(
            f"flight {asked.flight} is {'not in the table' if flight is None else 'of kind image'}",
            where=f"{_WHERE}.flight",
            expected=f"a flight of kind calibration in {FLIGHTS}, which has {', '.join(named) or 'none'}",
            remedy="Correct the name or the flight's kind.",
        )
        return
    for image in campaign.image_flights:
        missing = [pair for pair in image.pairs if pair not in flight.pairs]
        if missing:
            yield CampaignError(
                f"flight {image.name} has pairs {', '.join(missing)}, which {flight.name} did not calibrate",
                where=f"{_WHERE}.flight",
                expected=f"the pairs of {flight.name}: {', '.join(flight.pairs)}",
                remedy="Fly the calibration with the same transmitter and nodes, or take out config: calibration.",
            )
    yield from _reflector(inspected, flight, asked)


def _reflector(inspected: Inspected, flight: Flight, asked: Calibration) -> Iterator[CampaignError]:
    """Yield a reflector from which no echo arrives while a capture lasts."""
    waveform = inspected.waveform
    aperture = waveform and pair_aperture(inspected, flight, flight.transmitter, waveform)
    if not waveform or not aperture or inspected.crs is None:
        return
    place = frame_from_map(inspected.crs, *(np.array(value) for value in asked.reflector_m))
    distance_m = float(np.linalg.norm(aperture.tx_m - place, axis=1).min())
    reach_m = SPEED_OF_LIGHT_M_S * waveform.capture_s
    if distance_m > reach_m:
        yield CampaignError(
            f"{list(asked.reflector_m)} is {distance_m / 1e3:.1f} km from the track of {flight.name}",
            where=f"{_WHERE}.reflector_m",
            expected=f"a reflector within {reach_m / 1e3:.1f} km: easting, northing in {inspected.crs}, height",
            remedy="Correct reflector_m (easting before northing), or the place in the log.",
        )
