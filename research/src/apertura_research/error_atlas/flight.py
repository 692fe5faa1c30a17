"""The flight of the error atlas: two nodes over five targets, their echoes, and the pipeline's assumptions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beam, Beams, antenna_axes, gaussian_cut
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.association import baseline_residual, detect_wrong_association
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.sidelink import METHODS, measure
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import body_axes
from apertura.core.geometry.lever_arms import position_spline
from apertura.core.geometry.track_checks import CheckedTrack, check_track
from apertura.core.quality.budget import NodePositions
from apertura.core.quality.path_errors import PointPaths
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Terrain
from apertura.simulation.impairments import Impairments
from apertura.simulation.synthesis import Geometry
from apertura.simulation.targets import GaussianBeam, Sampled, Straight, Wobble
from apertura_research.paper_scene import RX_AHEAD_M, Disturbance, PaperScene, receive_pair, reduced_scene

PAIRS = ("a-a", "a-b")
"""Monostatic pair of node a, and bistatic pair with the receiver b ahead of a."""

LASTING_S, SUBCARRIERS = 10.0, 256
GRID = SceneGrid("local", -6.0, 27.0, 0.08, (300, 150))
"""The paper's scene: east is along the track, north across the track."""

_LEVEL = FlatGround(0.0)
_NOISE = Disturbance(Impairments(radar_snr_db=20.0, sidelink_snr_db=30.0))
_LOOKING_DEG, _BEAMWIDTH_DEG = (-90.0, -35.0), 60.0
_CUTOFF_DB = -20.0


@dataclass(frozen=True)
class Received:
    """True echoes of a pair.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64; divided by the sidelink if the pair is bistatic.
    sidelink_m
        (pulse,) float64, measured path of the sidelink; None for a monostatic pair.
    flags
        Flags raised on the echoes.
    """

    transfer: Complexes
    sidelink_m: Floats | None
    flags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class AssumedFlight:
    """Assumptions of the pipeline about a flight, correct or erroneous.

    Attributes
    ----------
    apertures
        Pair → phase centres.
    terrain
        Surface of the scene.
    longer_m, turned_rad
        Pair → uncorrected path and phase in its echo.
    used
        Mask of the imaged pulses; None: all pulses.
    beams
        Pair → beams; empty: isotropic.
    presum
        Presumming factor; None: chosen by the planner.
    flags
        Flags raised by the checks of the logs.
    """

    apertures: Mapping[str, Aperture]
    terrain: Terrain = _LEVEL
    longer_m: Mapping[str, float] = field(default_factory=dict)
    turned_rad: Mapping[str, float] = field(default_factory=dict)
    used: NDArray[np.bool_] | None = None
    beams: Mapping[str, Beams] = field(default_factory=dict)
    presum: int | None = None
    flags: Mapping[str, str] = field(default_factory=dict)

    def history(self, pair: str, received: Received, frequency_hz: Floats) -> PhaseHistory:
        """Return the phase history of a pair as computed by the pipeline."""
        aperture, used = self.apertures[pair], slice(None) if self.used is None else self.used
        longer_m = np.full(len(aperture), self.longer_m.get(pair, 0.0))
        if received.sidelink_m is not None:
            longer_m += np.linalg.norm(aperture.tx_m - aperture.rx_m, axis=1)
        turn = np.complex64(np.exp(1j * self.turned_rad.get(pair, 0.0)))
        weight = window_weights("hann", len(frequency_hz))
        delay_s = longer_m[used] / SPEED_OF_LIGHT_M_S
        return PhaseHistory(received.transfer[used] * turn, frequency_hz, weight, delay_s, aperture[used])

    def sidelink_flags(self, pair: str, received: Received) -> dict[str, str]:
        """Return the flag of a sidelink whose length disagrees with the logs."""
        if received.sidelink_m is None:
            return {}
        used = slice(None) if self.used is None else self.used
        length_m = np.linalg.norm(self.apertures[pair].tx_m - self.apertures[pair].rx_m, axis=1)
        line = detect_wrong_association(baseline_residual(received.sidelink_m[used], length_m[used]))
        return {"association_suspect": line} if line else {}


@dataclass(frozen=True, eq=False)
class TrueFlight:
    """True flight: 10 m at 1 m/s, 10 m above the terrain, with the wind disturbances of `Wobble`.

    Attributes
    ----------
    nodes
        Node → true trajectory.
    scene
        Waveform and scatterers.
    time_s
        (pulse,) float64, seconds.
    beamed
        True if the antennas of node a have beams; all others are isotropic.
    """

    nodes: Mapping[str, Sampled]
    scene: PaperScene
    time_s: Floats
    beamed: bool = False

    def antenna(self, node: str, at_s: Floats | None = None, arm_m: tuple[float, float, float] = (0, 0, 0)) -> Floats:
        """Return antenna positions of a node, (pulse, 3) float64, with lever arm `arm_m` from its logged point."""
        at_s = self.time_s if at_s is None else at_s
        return np.asarray(self.nodes[node].position(at_s) + self.turn(node, at_s) @ np.array(arm_m, np.float64))

    def turn(self, node: str, at_s: Floats) -> Floats:
        """Return the rotation of a node from forward-right-down to east-north-up, (pulse, 3, 3) float64."""
        to_ned = body_axes(self.nodes[node].attitude(at_s))
        return np.stack([to_ned[:, 1], to_ned[:, 0], -to_ned[:, 2]], axis=1)

    def apertures(self, **moved: Floats) -> dict[str, Aperture]:
        """Return pair → phase centres, with the positions of some nodes replaced, (pulse, 3) metres."""
        places = {node: moved.get(node, self.antenna(node)) for node in self.nodes}
        return {pair: Aperture(*(places[node] for node in pair.split("-"))) for pair in PAIRS}

    @property
    def truth(self) -> AssumedFlight:
        """Assumptions without any error."""
        return AssumedFlight(self.apertures(), beams=self.beams())

    def beams(self, off_deg: float = 0.0) -> dict[str, Beams]:
        """Return pair → beams of node a's antennas, with a boresight error in azimuth."""
        if not self.beamed:
            return {}
        axes = antenna_axes(self.turn("a", self.time_s), (_LOOKING_DEG[0] + off_deg, _LOOKING_DEG[1]))
        cuts = [gaussian_cut(_BEAMWIDTH_DEG, cutoff_db=_CUTOFF_DB, limit_rad=limit) for limit in (np.pi, np.pi / 2)]
        beam = Beam(axes, *cuts[0], *cuts[1])
        return {"a-a": Beams(beam, beam), "a-b": Beams(transmit=beam)}

    def receive(self, pair: str, generator: np.random.Generator) -> Received:
        """Simulate the echoes of a pair, with an SNR per subcarrier of 20 dB, and 30 dB for the sidelink."""
        tx_m, rx_m = self.apertures()[pair].legs
        geometry = Geometry(tx_m, rx_m, tx_m, rx_m, gain=self._gain(pair))
        scene = PaperScene(self.scene.waveform, self.scene.scatterers, geometry)
        radar, sidelink, _ = receive_pair(scene, _NOISE, generator)
        if pair == "a-a":
            return Received(radar, None)
        cell_m = SPEED_OF_LIGHT_M_S / np.ptp(self.frequency_hz) * (SUBCARRIERS - 1) / SUBCARRIERS
        return Received(METHODS["divide"](radar, sidelink), measure(sidelink).delay_cells * cell_m)

    def paths(self, pair: str) -> PointPaths:
        """Return the paths of a point at the scene centre, for which the budget is computed."""
        return PointPaths.of(
            self.apertures()[pair],
            self.time_s,
            point_m=np.array([0.0, 15.0, 0.0]),
            axes=np.eye(3),
            wavelength_m=SPEED_OF_LIGHT_M_S / centre_frequency(self.frequency_hz),
        )

    @property
    def frequency_hz(self) -> Floats:
        """(subcarrier,) float64."""
        return self.scene.waveform.frequency_hz

    @property
    def targets_m(self) -> Floats:
        """(target, 3) float64."""
        return self.scene.scatterers.position_m

    def _gain(self, pair: str) -> Floats | float:
        if not self.beamed:
            return 1.0
        beam = GaussianBeam(_LOOKING_DEG, (_BEAMWIDTH_DEG, _BEAMWIDTH_DEG))
        gain = beam.gain(self.turn("a", self.time_s), self.antenna("a"), self.targets_m)
        return gain**2 if pair == "a-a" else gain


@cache
def flight(*, pulses: int = 300, beamed: bool = False) -> TrueFlight:
    """Return the flight of every sweep with a given number of pulses."""
    generator = np.random.default_rng(7)
    nodes = {
        node: Wobble().around(Straight((middle_m - LASTING_S / 2, 0.0, 10.0), (1.0, 0.0, 0.0)), LASTING_S, generator)
        for node, middle_m in (("a", 0.0), ("b", RX_AHEAD_M))
    }
    scene = reduced_scene(pulses=pulses, subcarriers=SUBCARRIERS)
    return TrueFlight(nodes, scene, np.arange(pulses) * LASTING_S / pulses, beamed=beamed)


NOISE_M = 0.002
"""Standard deviation of the uncorrelated noise of every epoch, metres per axis."""

USUAL_HZ = 20.0
_MARGIN_S = 9.0
_TOLERATED_WAVELENGTHS = 1 / 16


@dataclass(frozen=True)
class LogErrors:
    """Errors of a node's log.

    Attributes
    ----------
    rate_hz
        Epochs per second.
    wander_m, correlation_s
        Standard deviation and correlation time of the position error per axis: white noise after a moving average.
    gap_s
        Length of the gap in the middle of the log.
    """

    rate_hz: float = USUAL_HZ
    wander_m: float = 0.0
    correlation_s: float = 1.0
    gap_s: float = 0.0

    def checked(self, flown: TrueFlight, node: str, generator: Generator) -> tuple[Floats, CheckedTrack]:
        """Return the logged positions of the pulses, (pulse, 3) float64, and the results of the log's checks."""
        end_s = float(flown.time_s[-1])
        time_s = np.arange(-_MARGIN_S, end_s + _MARGIN_S, 1 / self.rate_hz)
        place_m = flown.nodes[node].position(time_s)
        place_m += NOISE_M * generator.standard_normal(place_m.shape)
        place_m += self.wander_m * self._wander(len(time_s), generator)
        logged = np.abs(time_s - end_s / 2) >= self.gap_s / 2
        time_s, place_m = time_s[logged], place_m[logged]
        wavelength_m = flown.paths("a-a").wavelength_m
        checked = check_track(
            time_s,
            place_m,
            poor_fix=np.zeros(len(time_s), bool),
            tolerated_m=wavelength_m * _TOLERATED_WAVELENGTHS,
        )
        spline = position_spline(time_s[checked.kept], place_m[checked.kept])
        return np.asarray(spline(flown.time_s)), checked

    def _wander(self, count: int, generator: Generator) -> Floats:
        """Draw correlated errors of unit variance, (epoch, 3) float64."""
        width = max(1, round(self.correlation_s * self.rate_hz))
        white = generator.standard_normal((count + width - 1, 3)) / np.sqrt(width)
        return np.stack([np.convolve(axis, np.ones(width), "valid") for axis in white.T], -1)


def assumed_from_logs(flown: TrueFlight, generator: Generator, **logs: LogErrors) -> AssumedFlight:
    """Return the assumptions of a pipeline with erroneous logs; other nodes have their true positions."""
    places, used, flags = {}, np.ones(len(flown.time_s), bool), dict[str, str]()
    for node, log in logs.items():
        places[node], checked = log.checked(flown, node, generator)
        barred = checked.excluded(flown.time_s)
        flags |= {cause: node for cause, out in barred.items() if out.any()}
        flags |= {cause: node for cause, text in checked.faults.items() if text}
        for out in barred.values():
            used &= ~out
    return replace(flown.truth, apertures=flown.apertures(**places), used=used, flags=flags)


def between_epochs(flown: TrueFlight, log: LogErrors) -> NodePositions:
    """Return the position accuracy between a log's epochs, estimated by the checks of the log, for the budget."""
    _, checked = log.checked(flown, "a", np.random.default_rng(0))
    std_m = checked.interpolation_m or 0.0
    return NodePositions((std_m,) * 3, 1 / log.rate_hz, "the log's own epochs")
