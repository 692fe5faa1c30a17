"""Predicted images of a flight plan, cost of recording and processing, and rehearsal of the flight by simulation."""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from apertura.campaign.config import FmcwWaveform, Node, OfdmWaveform, SampledWaveform
from apertura.common.errors import CampaignError
from apertura.core.echo.compression import centre_frequency
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, geodetic_from_ecef
from apertura.core.planning.plan import undersampling
from apertura.formats.campaign_files import write_config
from apertura.formats.phase_histories.fmcw import sweep_of
from apertura.methods.autofocus.expected import expected_remainder
from apertura.simulation.campaign import write_campaign
from apertura.simulation.impairments import Adc, Impairments, Localization, RadarPoint, Radio
from apertura.simulation.specification import CampaignSpecification, ImageGrid, SimulatedFlight, SimulatedNode
from apertura.simulation.targets import GaussianBeam, Origin, Target, Waypoints
from apertura.simulation.waveform import WaveformSpecification
from apertura.stages.pair import OpenPair
from apertura.stages.refine import autofocus_of, errors_of
from apertura.tools.design.flight_plan import FlightPlan
from apertura.tools.design.layers import (
    Layer,
    PlannedImage,
    PlannedRefinement,
    coherence_layers,
    planned_image,
    planned_job,
    summed_image,
)
from apertura.tools.design.planned_tracks import OpenPlan, errors_of_the_plan, open_plan
from apertura.workflow.lineage import places
from apertura.workflow.resources import Resources
from apertura.workflow.rules import RULES

_SAMPLE_BYTES = 4  # I and Q, 16 bits each
_REAL_BYTES = 2


@dataclass(frozen=True)
class ResourceEstimate:
    """Time, storage and memory of recording and processing.

    Attributes
    ----------
    flight_s
        Flight → flight time including turns, seconds; also including take-off, transit and landing if the plan has a
        home.
    transfer_s
        Flight → time before the first and after the last pulse, seconds; 0 without a home.
    pulses
        Flight → number of transmitted pulses.
    node_bytes_s
        Flight → node → recorded bytes per second.
    recorded_bytes
        Recorded bytes of all nodes and flights.
    processing_s
        Duration of the complete workflow on the machine on which the costs of its steps were measured, seconds.
    memory_bytes
        Memory of the largest job, bytes.
    """

    flight_s: Mapping[str, float]
    transfer_s: Mapping[str, float]
    pulses: Mapping[str, int]
    node_bytes_s: Mapping[str, Mapping[str, float]]
    recorded_bytes: int
    processing_s: float
    memory_bytes: int

    @classmethod
    def of(cls, opened: OpenPlan) -> "ResourceEstimate":
        """Return time, storage and memory of a plan."""
        campaign, waveform = opened.campaign, opened.campaign.settings.waveform
        prf_hz = float(getattr(waveform, "prf_hz", None) or 0.0)
        sizes, flight_s, pulses = dict[tuple[str, str], tuple[int, int]](), dict[str, float](), dict[str, int]()
        rates, transfer_s = dict[str, dict[str, float]](), dict[str, float]()
        for flight in campaign.flights:
            courses, climb_m_s = opened.courses[flight.name].values(), opened.plan.flights[flight.name].climb_m_s
            lasting_s = max(course.length_s for course in courses)
            transfer_s[flight.name] = max(course.transfer_s(climb_m_s) for course in courses)
            count = int(lasting_s * prf_hz) + 1
            flight_s[flight.name] = lasting_s + transfer_s[flight.name]
            pulses[flight.name], rates[flight.name] = count, {}
            for node in flight.participants:
                if isinstance(waveform, SampledWaveform):
                    channels = 1 if node == flight.transmitter else 2  # radar and sidelink
                    capture = waveform.capture_samples * channels * _SAMPLE_BYTES
                elif isinstance(waveform, FmcwWaveform):
                    samples = sweep_of(waveform.model_dump()).sweep_samples
                    capture = samples * (_REAL_BYTES if waveform.iq == "real" else _SAMPLE_BYTES)
                sizes[flight.name, node] = capture * count, count
                rates[flight.name][node] = capture * prf_hz
        scene = opened.scene
        with_grid = campaign.settings.scene.model_copy(
            update={"bounds_m": scene.grid.bounds_m, "spacing_m": scene.grid.spacing_m}
        )
        settled = campaign.settings.model_copy(update={"scene": with_grid})
        resources = Resources(replace(campaign, settings=settled), sizes)
        jobs = [(name, where) for name, rule in RULES.items() if not rule.on_demand for where in places(campaign, rule)]
        wildcards = [
            (name, SimpleNamespace(**dict(zip(RULES[name].of.wildcards, where, strict=False)))) for name, where in jobs
        ]
        memory_mb = [resources[name].mem_mb(which, 1) for name, which in wildcards if RULES[name].demand is not None]
        return cls(
            flight_s,
            transfer_s,
            pulses,
            rates,
            sum(size for size, _ in sizes.values()),
            sum(resources.expected_seconds(name, *where) for name, where in jobs),
            int(max(memory_mb, default=0) * 1e6),
        )


@dataclass(frozen=True, eq=False)
class Design:
    """Predicted images and costs of a plan.

    Attributes
    ----------
    opened
        The plan.
    images
        flight/pair or flight/sum → image.
    refinements
        Flight → refinement of its tracks.
    interferograms
        Key of interferometry.pairs → layers of the interferogram.
    recording
        Cost of recording and processing.
    """

    opened: OpenPlan
    images: Mapping[str, PlannedImage]
    refinements: Mapping[str, PlannedRefinement]
    interferograms: Mapping[str, Mapping[str, Layer]]
    recording: ResourceEstimate

    @property
    def judged(self) -> list[PlannedImage]:
        """Images to which the requirements apply: the sum of each flight, or its only pair."""
        images = []
        for flight in self.opened.campaign.flights:
            name = f"{flight.name}/sum"
            images.append(self.images.get(name) or self.images[f"{flight.name}/{flight.pairs[0]}"])
        return images


def designed(plan: FlightPlan, root: Path, *, threads: int = 1, coarse: int | None = None) -> Design:
    """Predict images and costs of a plan.

    Parameters
    ----------
    plan
        The flight plan.
    root
        Folder of the files named in the plan.
    threads
        Number of tiles computed in parallel.
    coarse
        Number of pixels along the longer side of a coarser grid, on which the integration of the fine grid is used;
        None: the grid of the plan.

    Raises
    ------
    CampaignError
        In the cases of `open_plan`, and if the pulse rate is too low for the scene.
    """
    opened = open_plan(plan, root)
    with errors_of_the_plan():
        for pair in opened.pairs:  # on the full grid: the corner points of a coarse grid have a smaller Doppler spread
            _check_sampled(opened, pair)
        return _computed(opened, threads=threads, coarse=coarse)


def _computed(opened: OpenPlan, *, threads: int, coarse: int | None) -> Design:
    plan, recording = opened.plan, ResourceEstimate.of(opened)
    if coarse is not None:
        opened = opened.coarse(coarse)
    images, refinements = dict[str, PlannedImage](), dict[str, PlannedRefinement]()
    for flight in opened.campaign.flights:
        pairs = [pair for pair in opened.pairs if pair.flight == flight.name]
        refinements[flight.name] = _refinement(opened, pairs)
        of_pairs = [
            planned_image(
                opened.campaign,
                pair,
                opened.scene,
                sigma0_db=plan.expect.sigma0_db,
                rcs_dbsm=plan.expect.rcs_dbsm,
                refinement=refinements[flight.name],
                threads=threads,
            )
            for pair in pairs
        ]
        images |= {image.name: image for image in of_pairs}
        if len(of_pairs) > 1:
            total = summed_image(flight.name, of_pairs)
            images[total.name] = total
    by_name = {f"{pair.flight}/{pair.name}": pair for pair in opened.pairs}
    interferograms = {
        name: coherence_layers(opened.scene, (by_name[first], by_name[second]), (images[first], images[second]))
        for name, (first, second) in opened.campaign.settings.interferometry.pairs.items()
    }
    return Design(opened, images, refinements, interferograms, recording)


def _refinement(opened: OpenPlan, pairs: Sequence[OpenPair]) -> PlannedRefinement:
    """Decide on the refinement of a flight's tracks, and predict the loss due to residual position errors."""
    errors = errors_of([replace(pair, positions=tuple(node.assumed for node in pair.positions)) for pair in pairs])
    remainder_db, obstacles = expected_remainder(
        errors.values(),
        wavelength_m=pairs[0].wave_speed_m_s / centre_frequency(pairs[0].frequency_hz),
        pulse_interval_s=float(np.median(np.diff(pairs[0].time_s))),
    )
    decision, *_ = autofocus_of(opened.campaign, pairs, opened.scene)
    return PlannedRefinement(decision, remainder_db, tuple(obstacles))


def _check_sampled(opened: OpenPlan, pair: OpenPair) -> None:
    """Raise CampaignError if the pulse rate is so low that the image has Doppler ambiguities."""
    job, _, _ = planned_job(opened.campaign, pair, opened.scene)
    if sparse := undersampling(job):
        prf_hz = float(getattr(opened.plan.waveform, "prf_hz", None) or 0.0)
        spread, _ = job.aperture.phase_rates(job.points_m, wavelength_m=pair.wave_speed_m_s / job.band_hz[1])
        doppler_hz = spread / float(np.median(np.diff(pair.time_s)))
        raise CampaignError(
            f"{pair.flight}/{pair.name}: {sparse}",
            "the plan: waveform.prf_hz",
            f"at least {math.ceil(doppler_hz)} Hz, the Doppler spread over the scene, instead of {prf_hz:g} Hz",
            "Increase waveform.prf_hz, fly slower, configure the antenna beams, or make the scene smaller.",
        )


_BITS = 14


def rehearse(
    opened: OpenPlan, targets: Sequence[Target], directory: Path, *, seed: int = 1, erring: bool = False
) -> Path:
    """Simulate the flight of a plan in a campaign folder with the config of the later campaign; return the folder.

    Parameters
    ----------
    opened
        Plan with an OFDM radar and a georeferenced CRS.
    targets
        Point targets, metres from the scene centre; amplitudes are square roots of cross-sections in m².
    directory
        New or empty folder.
    seed
        Seed of noise and errors.
    erring
        True: position errors with the standard deviation nodes.<n>.position_std_m are added to the logs.

    Raises
    ------
    CampaignError
        If the waveform of the plan is not OFDM, its frame is local, or the folder is not empty.
    """
    plan, scene = opened.plan, opened.scene
    if not isinstance(plan.waveform, OfdmWaveform) or scene.grid.crs == LOCAL:
        raise CampaignError(
            f"waveform {plan.waveform.kind} in scene.crs {scene.grid.crs}",
            "the plan",
            "an OFDM radar in a georeferenced CRS",
            "Use a plan with kind: ofdm and a georeferenced scene.crs.",
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
            position = origin.enu(frame_from_map(scene.grid.crs, *course.place_m.T))
            tracks[node] = Waypoints(tuple(course.time_s.tolist()), tuple(map(tuple, position.tolist())))
        course = opened.courses[flight.name][flight.transmitter]
        pulses = int(course.imaged_s[-1][1] * plan.waveform.prf_hz + 1e-9) + 1
        segments = dict.fromkeys(flight.pairs, course.imaged_s) if len(course.imaged_s) > 1 else {}
        flights.append(SimulatedFlight(flight.name, flight.transmitter, tracks, pulses, segments=segments))
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
    rows = [(flight.name, flight.kind, flight.transmitter, flight.nodes) for flight in plan.image_flights]
    write_config(directory, plan.document, rows)
    for name, file in opened.campaign.height_files().items():
        named = getattr(plan.scene, name)
        (directory / named).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, directory / named)
    return directory


def _simulated(node: Node, *, erring: bool) -> SimulatedNode:
    """Return the simulated counterpart of a planned node."""
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
    localization = Localization(sigma, node.position_correlation_s) if erring and sigma else None
    arms = node.lever_arms_m
    return SimulatedNode(
        {"radar_tx": arms.radar_tx, "radar_rx": arms.radar_rx, "sidelink": arms.sidelink},
        attitude=node.attitude,
        impairments=Impairments(localization=localization, adc=Adc(bits=_BITS)),
        radio=radio,
        antennas={
            point: GaussianBeam(beam.boresight_deg, beam.beamwidth_deg)
            for point, beam in beams.items()
            if beam is not None and beam.beamwidth_deg is not None
        },
    )
