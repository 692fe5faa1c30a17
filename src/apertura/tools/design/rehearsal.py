"""A flight plan as a simulation: the same radar, tracks and errors, sampled and processed before anybody flies."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from apertura.campaign.config import Node, OfdmWaveform
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, geodetic_from_ecef
from apertura.formats.campaign_files import write_config
from apertura.simulation.campaign import write_campaign
from apertura.simulation.impairments import Adc, Impairments, Localization, RadarPoint, Radio
from apertura.simulation.scene import GaussianBeam, Origin, Target, Waypoints
from apertura.simulation.specification import CampaignSpecification, ImageGrid, SimulatedFlight, SimulatedNode
from apertura.simulation.waveform import WaveformSpecification
from apertura.tools.design.planned import OpenPlan

_BITS = 14


def rehearse(
    opened: OpenPlan, targets: Sequence[Target], directory: Path, *, seed: int = 1, erring: bool = False
) -> Path:
    """Simulate a plan into a campaign folder with the config that the plan becomes; return the folder.

    Parameters
    ----------
    opened
        Of an OFDM radar, on Earth.
    targets
        What stands there, metres from the scene's middle; amplitudes are roots of cross-sections in m².
    directory
        New or empty.
    seed
        Of noise and errors.
    erring
        Whether logs err by nodes.<n>.position_std_m.

    Raises
    ------
    CampaignError
        If the plan is of another waveform or in a local frame, or the folder holds something.
    """
    plan, scene = opened.plan, opened.scene
    if not isinstance(plan.waveform, OfdmWaveform) or scene.grid.crs == LOCAL:
        raise CampaignError(
            f"{plan.waveform.kind} in {scene.grid.crs}", "the plan", "an OFDM radar on Earth", "Rehearse another plan."
        )
    latitude, longitude, height = map(float, geodetic_from_ecef(scene.middle_m))
    origin = Origin(latitude, longitude, height)
    names = ("carrier_hz", "subcarrier_spacing_hz", "symbol_s", "cyclic_prefix_s", "sample_rate_hz", "prf_hz")
    stated = {name: getattr(plan.waveform, name) for name in names}
    waveform = WaveformSpecification(plan.waveform.subcarriers, **stated, carrier_is=plan.waveform.carrier_is)
    flights = []
    for flight in opened.campaign.flights:
        tracks = {}
        for node in flight.participants:
            course = opened.courses[flight.name][node]
            place = origin.enu(frame_from_map(scene.grid.crs, *course.place_m.T))
            tracks[node] = Waypoints(tuple(course.time_s.tolist()), tuple(map(tuple, place.tolist())))
        course = opened.courses[flight.name][flight.transmitter]
        pulses = int(course.imaged_s[-1][1] * plan.waveform.prf_hz + 1e-9) + 1
        several = dict.fromkeys(flight.pairs, course.imaged_s) if len(course.imaged_s) > 1 else {}
        flights.append(SimulatedFlight(flight.name, flight.transmitter, tracks, pulses, segments=several))
    specification = CampaignSpecification(
        plan.campaign,
        origin,
        waveform,
        tuple(targets),
        {name: _simulated(node, erring=erring) for name, node in plan.nodes.items()},
        tuple(flights),
        ImageGrid(scene.grid.crs, bounds_m=scene.grid.bounds_m, spacing_m=scene.grid.spacing_m),
    )
    write_campaign(directory, specification, np.random.default_rng(seed))
    write_config(
        directory, plan.document, [(one.name, one.kind, one.transmitter, one.nodes) for one in plan.image_flights]
    )
    for name, file in opened.campaign.height_files().items():
        named = getattr(plan.scene, name)
        (directory / named).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, directory / named)
    return directory


def _simulated(node: Node, *, erring: bool) -> SimulatedNode:
    """Return a node as the simulation has it."""
    receiver, antennas = node.receiver, node.antennas
    radio = None
    if receiver is not None:
        radio = Radio(
            node.transmit_power_dbm or 0.0,
            antennas.radar_tx_gain_dbi or 0.0,
            antennas.radar_rx_gain_dbi or 0.0,
            receiver.at_full_scale_dbm,
            receiver.gain_db,
            receiver.noise_figure_db,
        )
    points: tuple[RadarPoint, ...] = ("radar_tx", "radar_rx")
    beams = {point: getattr(antennas, point) for point in points}
    sigma = float(np.mean(node.position_std_m)) if node.position_std_m else 0.0
    wrong = Localization(sigma, node.position_correlation_s) if erring and sigma else None
    arms = node.lever_arms_m
    return SimulatedNode(
        {"radar_tx": arms.radar_tx, "radar_rx": arms.radar_rx, "sidelink": arms.sidelink},
        attitude=node.attitude,
        impairments=Impairments(localization=wrong, adc=Adc(bits=_BITS)),
        radio=radio,
        antennas={
            point: GaussianBeam(beam.boresight_deg, beam.beamwidth_deg)
            for point, beam in beams.items()
            if beam is not None and beam.beamwidth_deg is not None
        },
    )
