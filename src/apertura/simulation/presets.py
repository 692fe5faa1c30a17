"""Presets of simulations: the demo, the scene of the reference paper and its three experiments.

The docstring of an experiment lists the parameters published in the paper, and the values assumed for unpublished
parameters. Assumptions are not tuned to reproduce results of the paper; docs/theory/study.md, "Experiments".
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from apertura.common.units import decibels
from apertura.simulation.continuous import Framing
from apertura.simulation.impairments import (
    Adc,
    Clock,
    Impairments,
    Leakage,
    Localization,
    TimeTag,
    Timing,
    UniformPhase,
)
from apertura.simulation.specification import CampaignSpecification, ImageGrid, SimulatedFlight, SimulatedNode
from apertura.simulation.synthesis import Geometry, straight_pair
from apertura.simulation.targets import (
    Clutter,
    Line,
    Origin,
    PointTarget,
    Scatterers,
    Straight,
    Target,
    TargetChange,
    Vector,
    Wobble,
)
from apertura.simulation.waveform import TransmitWaveform, WaveformSpecification

PAPER_WAVEFORM = WaveformSpecification(4096, 1.2e9, 100e3, 12.5e-6, 3.125e-6, 1.024e9, 100.0, code="newman")
EXPERIMENT_ORIGIN = Origin(48.42255, 9.95509, 620.0)
_UTM = "EPSG:32632"
STATIC_PULSES = 200
RADAR_CABLE_M, SIDELINK_CABLE_M = 10.0, 5.0
"""Electrical lengths of the radar path and of the sidelink in the laboratory experiment, metres."""

COHERENT_SNR_DB = {"cables": 18.5, "first cylinder": 40.0, "second cylinder": 33.0}
"""SNR per compressed pulse, dB, at which M = 200 pulses have the published coherence factors: 0.986 for the cables,
0.9999 and 0.9995 for the cylinders. The SNR is not published; docs/theory/study.md, "Coherence factor"."""

_JOINT_M = 1e-3  # the point target of the cable is 1 mm from its connectors, with the amplitude of a direct connection

SEPARATION_M = 4.7
"""Distance between the two nodes in flight, metres."""

SEGMENT_M, GAP_M, SPEED_M_S, FLIGHT_PRF_HZ = 3.4, 2.4, 0.5, 20.0
"""Length of the track segment of each image and gap between the two segments (metres, both for the midpoint of the
pair's antennas), speed (m/s) and pulse repetition frequency (Hz) of the flight experiment."""


def paper_lab(*, pulses: int = STATIC_PULSES, snr_db: float = COHERENT_SNR_DB["cables"]) -> CampaignSpecification:
    """Return the laboratory experiment: two nodes connected by coaxial cables.

    Parameters
    ----------
    pulses
        Number of pulses; M = 200 in the paper's coherence experiments.
    snr_db
        SNR of the radar channel per compressed pulse, with equal weights of all subcarriers.

    Notes
    -----
    The paper states for the laboratory experiment: coaxial cables, a radar path of 10 m, a sidelink of 5 m, no
    target; Γ = 0.986 after correction. Its table of parameters states the waveform, at 100 Hz, and its text on clocks
    10 ppb. Not published, with the assumed values in parentheses: the SNR (in the radar channel the value that gives
    the published Γ, in the sidelink 40 dB per subcarrier), start and phase of the secondary's captures (±40 ns, ±π),
    losses of cables and attenuators (none), and the type of the lengths (electrical).
    """
    joint = (PointTarget((0.0, 0.0, 1.0 - _JOINT_M), _JOINT_M**2),)
    cable_m = RADAR_CABLE_M - 2 * _JOINT_M
    bench: Mapping[str, float | bool] = {"radar_m": 2 * _JOINT_M, "sidelink_m": 0.0}
    return _static_pair("paper-lab", joint, (0.0, 0.0, 1.0), cable_m, _per_subcarrier(snr_db), pulses, bench=bench)


def paper_static(*, pulses: int = STATIC_PULSES) -> CampaignSpecification:
    """Return the chamber experiment: two cylinders and one receiving antenna whose signal is split to both nodes.

    Notes
    -----
    The paper states for the static experiment: an anechoic chamber (no clutter), cylinders with a diameter of
    15 cm, an over-the-air sidelink, and monostatic and bistatic recordings of one split receive signal; Γ = 0.9999 for
    the first cylinder and 0.9995 for the second. Not published, with the assumed values in parentheses: distances of
    the cylinders (4 m and 6.5 m), their height (15 cm; they are lines without a diameter), the SNR (the value that
    gives the published Γ), common noise of the split signal (none), and the clock of the secondary (as in the
    laboratory experiment). Unlike in the paper, the sidelink is the cable of the laboratory experiment.
    """
    near_m, far_m, antenna_up_m = 4.0, 6.5, 1.0
    weaker_db = COHERENT_SNR_DB["first cylinder"] - COHERENT_SNR_DB["second cylinder"]
    cylinders = (
        _cylinder(near_m - 6.0, antenna_up_m, near_m**2),
        _cylinder(far_m - 6.0, antenna_up_m, far_m**2 * 10 ** (-weaker_db / 20)),
    )
    both_db = decibels(1 + 10 ** (-weaker_db / 10))  # mean power of both relative to that of the first
    snr_db = _per_subcarrier(COHERENT_SNR_DB["first cylinder"]) + both_db
    bench: Mapping[str, float | bool] = {"radar_m": 2 * near_m, "sidelink_m": 0.0, "split": True}
    return _static_pair("paper-static", cylinders, (0.0, -6.0, antenna_up_m), 0.911, snr_db, pulses, bench=bench)


def _cylinder(north_m: float, up_m: float, amplitude: float) -> Line:
    return Line((0.0, north_m, up_m - 0.075), (0.0, north_m, up_m + 0.075), 4, amplitude)


def _per_subcarrier(compressed_db: float) -> float:
    """Convert an SNR per compressed pulse, whose subcarriers add in phase, to an SNR per subcarrier, dB."""
    return compressed_db - decibels(PAPER_WAVEFORM.subcarriers)


def paper_uav(*, pulses: int = 275) -> CampaignSpecification:
    """Return the flight experiment: an extended target in a scene of 12 m × 4 m, one track segment per image.

    The monostatic pair uses the first 3.4 m of the track, the bistatic pair the last; 275 pulses occupy 53 MB.

    Notes
    -----
    The table of the flight states 20 Hz, 0.5 m/s, a height of 4.5 to 5 m (used: 4.8 m), a ground range of 11.5 m, L =
    3.4 m, and 4.7 m between the UAVs, one behind the other. The text on the images states 12 m × 4 m (used: 12 m along
    track) and an extended target, a power generator. Not published, with the assumed values in parentheses: the size of
    the target (rough, 1.2 m × 1.2 m), other targets (four points, to measure widths and phases), the clutter (17 dB
    below a point per m²), the SNR (0 dB per subcarrier, 30 dB in the sidelink), lever arms, wobble, and the track
    segments of the images (a gap of 2.4 m between them).
    """
    targets = (
        PointTarget((0.0, 0.0, 0.0)),
        PointTarget((-2.0, 1.2, 0.0), 0.7),
        PointTarget((1.8, -1.6, 0.0), 0.7),
        PointTarget((1.2, 1.8, 0.0), 0.5),  # the foot of a cylinder, which forms a dihedral with the ground
        Clutter((3.6, -0.6, 4.8, 0.6), 0.5, 60.0),
        Clutter((-7.0, -3.0, 7.0, 3.0), 0.02, 15.0),
    )
    secondary = SimulatedNode(
        {}, {"radar": 0.911, "sidelink": 0.402}, attitude="none", log_format="pos", impairments=_own_clock(0.0, 30.0)
    )
    primary = SimulatedNode({"radar_tx": (0.1, 0.25, 0.12), "radar_rx": (0.1, 0.15, 0.12)}, {"radar": 1.374},
                            impairments=Impairments(radar_snr_db=0.0))  # fmt: skip
    start_m = -SEGMENT_M - GAP_M / 2
    velocity = (SPEED_M_S, 0.0, 0.0)
    tracks = {
        "uav1": Straight((start_m, -11.5, 4.8), velocity, Wobble()),
        "uav2": Straight((start_m + SEPARATION_M, -11.5, 4.8), velocity, Wobble()),
    }
    duration_s = SEGMENT_M / SPEED_M_S
    later_s = (GAP_M / 2 - SEPARATION_M / 2 - start_m) / SPEED_M_S  # its midpoint is half the separation ahead
    segments = {"uav1-uav1": ((0.0, duration_s),), "uav1-uav2": ((later_s, later_s + duration_s),)}
    flight = SimulatedFlight("f01", "uav1", tracks, pulses, segments=segments)
    grid = ImageGrid(_UTM, bounds_m=(570655.3, 5363705.2, 570667.3, 5363709.2), spacing_m=0.05)  # about the origin
    waveform = replace(PAPER_WAVEFORM, prf_hz=FLIGHT_PRF_HZ)
    return CampaignSpecification(
        "paper-uav", EXPERIMENT_ORIGIN, waveform, targets, {"uav1": primary, "uav2": secondary}, (flight,), grid
    )


def _own_clock(radar_snr_db: float, sidelink_snr_db: float) -> Impairments:
    """Return a secondary with a clock offset of 10 ppb, and a random start and phase of each capture."""
    return Impairments(
        clock=Clock(cfo_hz=12.0),
        carrier_phase=UniformPhase(),
        timing=Timing(offset_s=12e-9, half_width_s=40e-9),
        time_tag=TimeTag(offset_s=3.7e-3, jitter_s=0.2e-3),
        radar_snr_db=radar_snr_db,
        sidelink_snr_db=sidelink_snr_db,
    )


def _static_pair(
    name: str,
    targets: tuple[Target, ...],
    position_m: Vector,
    radar_m: float,
    snr_db: float,
    pulses: int,
    *,
    bench: Mapping[str, float | bool],
) -> CampaignSpecification:
    """Return two static nodes with all antennas at one position, a cable as sidelink, and an SNR per subcarrier."""
    secondary = SimulatedNode(
        {}, {"radar": radar_m, "sidelink": SIDELINK_CABLE_M}, impairments=_own_clock(snr_db, 40.0)
    )
    primary = SimulatedNode({}, {"radar": radar_m}, impairments=Impairments(radar_snr_db=snr_db))
    static = Straight(position_m, (0.0, 0.0, 0.0))
    flight = SimulatedFlight("f01", "uav1", {"uav1": static, "uav2": static}, pulses, kind="bench")
    grid = ImageGrid(_UTM, half_width_m=3.0, spacing_m=0.1)
    nodes = {"uav1": primary, "uav2": secondary}
    return CampaignSpecification(name, EXPERIMENT_ORIGIN, PAPER_WAVEFORM, targets, nodes, (flight,), grid, bench=bench)


DEMO_ORIGIN = EXPERIMENT_ORIGIN  # flat terrain by the Danube
_DEMO_WAVEFORM = WaveformSpecification(1024, 1.2e9, 400e3, 3.125e-6, 0.78125e-6, 1.024e9, 20.0)
_DEMO_TARGETS = (
    PointTarget((0.0, 0.0, 0.0)),
    PointTarget((-1.9, -0.7, 0.0), 0.8),
    PointTarget((2.1, 0.9, 0.0), 0.9),
    PointTarget((-1.0, 1.7, 0.0), 0.6),
    PointTarget((1.3, -3.2, 0.0), 0.7),
)
_PRIMARY = SimulatedNode(
    {"radar_tx": (0.1, 0.25, 0.12), "radar_rx": (0.1, 0.15, 0.12), "sidelink": (-0.2, 0.0, 0.05)},
    {"radar": 1.374, "sidelink": 0.655},
    impairments=Impairments(radar_snr_db=25.0, missed_fraction=0.02),
)
_PAPER_TARGETS = ((0.0, 5.0), (-4.0, 10.0), (0.0, 15.0), (4.0, 20.0), (0.0, 25.0))
"""Cross-range and ground range of the targets, m."""


def demo(*, pulses: int = 300) -> CampaignSpecification:
    """Return the campaign of `make demo`: two UAVs, one transmits, both receive, five targets on 12 m × 12 m.

    The secondary has its own clock: time tags have errors of milliseconds, and phase and start of each capture are
    random. Both nodes miss some triggers and digitise 14 bits with noise. Pulses are at 20 Hz and 0.5 m/s; 300 pulses
    occupy about 14 MB.
    """
    tracks = {"uav1": _pass_by(-1.9, pulses), "uav2": _pass_by(2.8, pulses)}
    nodes = {"uav1": _PRIMARY, "uav2": _secondary(0.911, 0.402, tag_s=3.7e-3)}
    return _over_the_demo_scene("tandem_demo", nodes, SimulatedFlight("f01", "uav1", tracks, pulses))


def first_flight(*, pulses: int = 150) -> CampaignSpecification:
    """Return a flight past the demo's targets of half the length, with logs of a (configured) accuracy of 2 cm.

    Its images are defocused with the logged tracks, and focused with the tracks refined by step `refine`.
    """
    flown = demo(pulses=pulses)
    nodes = {
        name: replace(node, position_std_m=0.02, impairments=replace(node.impairments, localization=Localization(0.02)))
        for name, node in flown.nodes.items()
    }
    return replace(flown, campaign="first_flight", nodes=nodes)


def swarm(*, pulses: int = 240) -> CampaignSpecification:
    """Return one transmitter and three more receivers, each with its own clock, past the demo's targets."""
    nodes = {"uav1": _PRIMARY}
    tracks = {"uav1": _pass_by(0.0, pulses)}
    for number, (middle_m, right_m, up_m) in enumerate(((-4.5, -11.5, 4.6), (4.5, -11.0, 5.0), (9.0, -12.5, 5.4)), 2):
        name = f"uav{number}"
        nodes[name] = _secondary(0.4 * number, 0.2 * number, tag_s=1.3e-3 * (number - 3.3))
        tracks[name] = _pass_by(middle_m, pulses, right_m=right_m, up_m=up_m)
    return _over_the_demo_scene("swarm", nodes, SimulatedFlight("f01", "uav1", tracks, pulses))


def payload(*, pulses: int = 300) -> CampaignSpecification:
    """Return the demo with a new frame of 16-QAM symbols in each pulse, which no file of the campaign lists.

    Symbols are decided from the sidelink, whose SNR is 22 dB; at which nearly all frames are received without errors.
    """
    shown = demo(pulses=pulses)
    nodes = dict(shown.nodes)
    nodes["uav2"] = replace(nodes["uav2"], impairments=replace(nodes["uav2"].impairments, sidelink_snr_db=22.0))
    waveform = replace(_DEMO_WAVEFORM, code="16qam", frames=pulses, framed=True)
    return replace(shown, campaign="payload", waveform=waveform, nodes=nodes)


def continuous(*, pulses: int = 60) -> CampaignSpecification:
    """Return a flight with continuous recordings, in which the preambles of the symbols are detected.

    Pulses are at 1 kHz and 20 m/s; 60 pulses occupy about 46 MB.
    """
    waveform = WaveformSpecification(200, 1.2e9, 250e3, 5e-6, 2e-6, 64e6, 1000.0)
    velocity = (20.0, 0.0, 0.0)
    half_m = 10e-3 * (pulses - 1)
    tracks = {name: Straight((x - half_m, -30.0, 20.0), velocity) for name, x in (("uav1", -2.0), ("uav2", 3.0))}
    # the leakage of its own preamble triggers the transmitter's recorder exactly; echoes alone would not
    own = Impairments(radar_snr_db=20.0, leakage=Leakage(20.0))
    late = Impairments(
        timing=Timing(offset_s=7e-6), time_tag=TimeTag(offset_s=0.1e-3), radar_snr_db=20.0, sidelink_snr_db=20.0
    )
    return CampaignSpecification(
        "continuous",
        DEMO_ORIGIN,
        waveform,
        (PointTarget((0.0, 0.0, 0.0)), PointTarget((6.0, 12.0, 0.0), 0.7)),
        {"uav1": SimulatedNode(impairments=own), "uav2": SimulatedNode(impairments=late)},
        (SimulatedFlight("f01", "uav1", tracks, pulses, framing=Framing(), continuous=True),),
        ImageGrid(_UTM, half_width_m=20.0, spacing_m=0.25),
    )


def paper(*, pulses: int = 600) -> CampaignSpecification:
    """Return the paper's simulated scene as a campaign: 4096 subcarriers, 30 m of straight track at 10 m height.

    The paper has 3000 pulses in 30 s; 600 pulses, one every 5 cm, are still unambiguous and occupy 38 MB.
    """
    waveform = replace(PAPER_WAVEFORM, prf_hz=pulses / 30)
    track = Straight((-0.5 * (pulses - 1) / waveform.prf_hz, -15.0, 10.0), (1.0, 0.0, 0.0))
    return CampaignSpecification(
        "paper",
        DEMO_ORIGIN,
        waveform,
        tuple(PointTarget((cross, ground - 15.0, 0.0)) for cross, ground in _PAPER_TARGETS),
        {"uav1": SimulatedNode()},
        (SimulatedFlight("f01", "uav1", {"uav1": track}, pulses),),
        ImageGrid(_UTM, half_width_m=12.0, spacing_m=0.04),
    )


def flight(*, pulses: int = 300_000) -> CampaignSpecification:
    """Return a long flight: ten minutes at 500 Hz and 5 m/s past a scene of 410 m, one transmitter, two receivers.

    A receiver records two channels of 2256 samples per pulse, 5.4 GB; the image has 4096 × 4096 pixels.
    """
    waveform = WaveformSpecification(1024, 1.2e9, 100e3, 10.3125e-6, 4.375e-6, 153.6e6, 500.0)
    nodes = {"uav1": SimulatedNode(impairments=Impairments(radar_snr_db=0.0, adc=Adc(backoff_db=24.0)))}
    tracks, half_m = {"uav1": Straight((0.0, -270.0, 80.0), (5.0, 0.0, 0.0))}, 5.0 * (pulses - 1) / 500.0 / 2
    for name, ahead_m in (("uav2", 12.0), ("uav3", -15.0)):
        nodes[name] = _secondary(0.4, 0.2, tag_s=0.2e-3, missed=0.0)
        # more backoff, because echoes are strongest at the closest approach to targets
        with_backoff = replace(nodes[name].impairments, adc=Adc(backoff_db=24.0))
        nodes[name] = replace(nodes[name], impairments=with_backoff)
        tracks[name] = Straight((ahead_m, -270.0, 82.0), (5.0, 0.0, 0.0))
    tracks = {
        name: replace(track, start_m=(track.start_m[0] - half_m, *track.start_m[1:])) for name, track in tracks.items()
    }
    targets = tuple(PointTarget((x, y, 0.0)) for x in (-150.0, -50.0, 50.0, 150.0) for y in (-160.0, -40.0, 80.0))
    long_flight = SimulatedFlight("f01", "uav1", tracks, pulses)
    grid = ImageGrid(_UTM, half_width_m=204.8, spacing_m=0.1)
    return CampaignSpecification(
        "flight", DEMO_ORIGIN, waveform, targets, nodes, (long_flight,), grid, synthesis="periodic"
    )


def revisit(
    *, flights: int = 5, offset_m: float = 0.1, error_m: float = 0.01, slope_mm: float = 1.0, pulses: int = 100
) -> CampaignSpecification:
    """Return flights past one scene, whose tracks differ, with a slope that moves and targets that change.

    Clutter of 24 m × 24 m contains nine bright points and a slope of 5 m × 5 m. The slope moves by `slope_mm` towards
    the antennas from flight to flight. In the last flight, one target is absent, one has appeared, one is displaced by
    20 cm and one has turned (half the amplitude, another phase). Every second track lies `offset_m` across the line of
    sight. The logs have slowly varying errors of `error_m` per axis, different in every flight.

    Parameters
    ----------
    flights, pulses
        Number of flights, and of pulses per flight.
    offset_m, error_m
        Distance between the tracks, and standard deviation of the logged positions per axis, metres.
    slope_mm
        Motion of the slope towards the antennas from flight to flight, millimetres.

    Examples
    --------
    >>> specification = revisit(flights=2)
    >>> [flight.name for flight in specification.flights], specification.flights[1].changes[0].shift_m[2] > 0
    (['f01', 'f02'], True)
    """
    north_m, up_m = -25.0, 25.0
    middle = np.array([5.0, 4.0, 0.0])  # of the slope
    slope = Clutter((2.5, 1.5, 7.5, 6.5), 1.0, 20.0)
    ground = [
        Clutter((-12.0, -12.0, 12.0, 1.5), 1.0, 20.0),
        Clutter((-12.0, 6.5, 12.0, 12.0), 1.0, 20.0),
        Clutter((-12.0, 1.5, 2.5, 6.5), 1.0, 20.0),
        Clutter((7.5, 1.5, 12.0, 6.5), 1.0, 20.0),
    ]
    points = [PointTarget((east, north, 0.0), 8.0) for east in (-8.0, -1.0, 8.5) for north in (-9.0, -1.0, 9.0)]
    changed = [PointTarget((east, -5.0, 0.0), 4.0) for east in (-6.0, -2.0, 2.0, 6.0)]
    towards = np.array([0.0, north_m, up_m]) - middle
    towards = towards * [0.0, 1.0, 1.0] / np.linalg.norm(towards[1:])
    first = len(ground) + 1 + len(points)
    last = (
        TargetChange(first, factor=0.0),
        TargetChange(first + 2, shift_m=(0.2, 0.1, 0.0)),
        TargetChange(first + 3, factor=-0.3 + 0.4j),
    )
    step_m = 6.0 / pulses
    planned = []
    for number in range(flights):
        across_m = offset_m * (number % 2) * np.sqrt(0.5)
        start = (-step_m / 2 * (pulses - 1), north_m + across_m, up_m + across_m)
        moved = towards * slope_mm * 1e-3 * number
        changes = [TargetChange(0, (moved[0], moved[1], moved[2]))] if slope_mm and number else []
        changes += last if number == flights - 1 else (TargetChange(first + 1, factor=0.0),)
        track = Straight(start, (step_m * 10.0, 0.0, 0.0))
        day = f"2025-05-{14 + number:02d}T09:30:00"
        name = f"f{number + 1:02d}"
        planned.append(SimulatedFlight(name, "uav1", {"uav1": track}, pulses, start_utc=day, changes=tuple(changes)))
    node = SimulatedNode(
        position_std_m=error_m or None,
        impairments=Impairments(
            radar_snr_db=20.0, localization=Localization(error_m, window_s=10.0) if error_m else None
        ),
    )
    return CampaignSpecification(
        "revisit",
        DEMO_ORIGIN,
        WaveformSpecification(256, 1.2e9, 1.6e6, 0.625e-6, 0.5e-6, 512e6, 10.0),
        (slope, *ground, *points, *changed),
        {"uav1": node},
        tuple(planned),
        ImageGrid(_UTM, half_width_m=11.0, spacing_m=0.125),
        stack={"reference": "f01", "flights": tuple(flight.name for flight in planned[1:]), "pair": "uav1-uav1"}
        if flights > 1
        else {},
        synthesis="periodic",
    )


PRESETS: dict[str, Callable[..., CampaignSpecification]] = {
    preset.__name__.replace("_", "-"): preset
    for preset in (
        *(demo, first_flight, paper, swarm, payload, continuous, flight),
        *(paper_lab, paper_static, paper_uav, revisit),
    )
}


def _over_the_demo_scene(name: str, nodes: dict[str, SimulatedNode], flight: SimulatedFlight) -> CampaignSpecification:
    grid = ImageGrid(_UTM, half_width_m=6.0, spacing_m=0.05)
    return CampaignSpecification(name, DEMO_ORIGIN, _DEMO_WAVEFORM, _DEMO_TARGETS, nodes, (flight,), grid)


def _secondary(radar_m: float, sidelink_m: float, *, tag_s: float, missed: float = 0.03) -> SimulatedNode:
    return SimulatedNode(
        path_offset_m={"radar": radar_m, "sidelink": sidelink_m},
        attitude="none",
        log_format="pos",
        impairments=Impairments(
            carrier_phase=UniformPhase(),
            timing=Timing(offset_s=12e-9, half_width_s=40e-9),
            missed_fraction=missed,
            time_tag=TimeTag(offset_s=tag_s, jitter_s=0.2e-3),
            radar_snr_db=25.0,
            sidelink_snr_db=30.0,
        ),
    )


def _pass_by(middle_m: float, pulses: int, *, right_m: float = -11.5, up_m: float = 4.8) -> Straight:
    """Return a track along azimuth 40° at 0.5 m/s, with the scene to its right.

    Along the track, the midpoint of the track is `middle_m` metres beyond the scene centre.
    """
    along = np.array([np.sin(np.radians(40.0)), np.cos(np.radians(40.0)), 0.0])
    right = np.array([along[1], -along[0], 0.0])
    duration_s = (pulses - 1) / _DEMO_WAVEFORM.prf_hz
    start = along * (middle_m - 0.25 * duration_s) + right * right_m + [0.0, 0.0, up_m]
    velocity = 0.5 * along
    return Straight((start[0], start[1], start[2]), (velocity[0], velocity[1], 0.0), Wobble())


def paper_waveform(*, prf_hz: float = 100.0) -> TransmitWaveform:
    """Return the paper's waveform: 4096 subcarriers of 100 kHz at 1.2 GHz, 3.125 µs + 12.5 µs at 1.024 GS/s.

    Examples
    --------
    >>> wave = paper_waveform()
    >>> wave.subcarriers * wave.subcarrier_spacing_hz
    409600000.0
    """
    return replace(PAPER_WAVEFORM, prf_hz=prf_hz).drawn(np.random.default_rng(0))  # this code has no random part


def paper_scene(*, pulses: int = 3000, rx_ahead_m: float = 0.0) -> tuple[Scatterers, Geometry]:
    """Return the paper's simulated scene as arrays: five targets, straight track at 10 m, one position per node.

    Both are in local Cartesian metres: cross-range (along track, centred on zero), ground range, up. The receiver is
    `rx_ahead_m` ahead of the transmitter (4.7 m in the localization study).

    Notes
    -----
    Source: the simulation table of the paper that docs/theory.md cites.

    Examples
    --------
    >>> scatterers, geometry = paper_scene(pulses=3)
    >>> geometry.radar_tx[:, 0], scatterers.position_m[:, 1]
    (array([-15.,   0.,  15.]), array([ 5., 10., 15., 20., 25.]))
    """
    cross_ground = np.array(_PAPER_TARGETS)
    scatterers = Scatterers(np.column_stack([cross_ground, np.zeros(5)]), np.ones(5, np.complex128))
    return scatterers, straight_pair(np.linspace(-15.0, 15.0, pulses), 10.0, rx_ahead_m=rx_ahead_m)
