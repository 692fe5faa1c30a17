"""The flight of the atlas: two nodes over five targets, what they truly heard, and what the pipeline is told."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beam, Beams, antenna_axes, gaussian_cut
from apertura.core.echo.baseline import baseline_residual, detect_wrong_association
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.sidelink import METHODS, measure
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import body_axes
from apertura.core.quality.path_errors import PointPaths
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Terrain
from apertura.simulation.impairments import Impairments
from apertura.simulation.recording import Geometry
from apertura.simulation.trajectory import GaussianBeam, Sampled, Straight, Wobble
from apertura_research.study.paper_scene import RX_AHEAD_M, Disturbance, PaperScene, receive_pair, reduced_scene

PAIRS = ("a-a", "a-b")
"""A node that sends and receives, and one ahead of it that receives."""

LASTING_S, SUBCARRIERS = 10.0, 256
GRID = SceneGrid("local", -6.0, 27.0, 0.08, (300, 150))
"""The paper's scene: east along the track, north across it."""

_LEVEL = FlatGround(0.0)
_NOISE = Disturbance(Impairments(radar_snr_db=20.0, sidelink_snr_db=30.0))
_LOOKING_DEG, _BEAMWIDTH_DEG = (-90.0, -35.0), 60.0
_CUTOFF_DB = -20.0


@dataclass(frozen=True)
class Heard:
    """What a pair truly heard.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64; divided by the sidelink where it is bistatic.
    sidelink_m
        (pulse,) float64, path of the sidelink as measured; None of one node alone.
    """

    transfer: Complexes
    sidelink_m: Floats | None


@dataclass(frozen=True, eq=False)
class Told:
    """What the pipeline is told of a flight, right or wrong.

    Attributes
    ----------
    apertures
        Pair → phase centres.
    terrain
        The ground.
    longer_m, turned_rad
        Pair → path and phase that nobody takes off its echo.
    used
        Pulses that are imaged; None: all.
    beams
        Pair → beams; empty: isotropic.
    presum
        Pulses that are made one; None: as the planner likes.
    flags
        What checks of logs said already.
    """

    apertures: Mapping[str, Aperture]
    terrain: Terrain = _LEVEL
    longer_m: Mapping[str, float] = field(default_factory=dict)
    turned_rad: Mapping[str, float] = field(default_factory=dict)
    used: NDArray[np.bool_] | None = None
    beams: Mapping[str, Beams] = field(default_factory=dict)
    presum: int | None = None
    flags: Mapping[str, str] = field(default_factory=dict)

    def history(self, pair: str, heard: Heard, frequency_hz: Floats) -> PhaseHistory:
        """Return the phase history of a pair as the pipeline would make it."""
        aperture, used = self.apertures[pair], slice(None) if self.used is None else self.used
        longer_m = np.full(len(aperture), self.longer_m.get(pair, 0.0))
        if heard.sidelink_m is not None:
            longer_m += np.linalg.norm(aperture.tx_m - aperture.rx_m, axis=1)
        turn = np.complex64(np.exp(1j * self.turned_rad.get(pair, 0.0)))
        weight = window_weights("hann", len(frequency_hz))
        delay_s = longer_m[used] / SPEED_OF_LIGHT_M_S
        return PhaseHistory(heard.transfer[used] * turn, frequency_hz, weight, delay_s, aperture[used])

    def sidelink_flags(self, pair: str, heard: Heard) -> dict[str, str]:
        """Return the flag of a sidelink that does not move as the logs say."""
        if heard.sidelink_m is None:
            return {}
        used = slice(None) if self.used is None else self.used
        length_m = np.linalg.norm(self.apertures[pair].tx_m - self.apertures[pair].rx_m, axis=1)
        line = detect_wrong_association(baseline_residual(heard.sidelink_m[used], length_m[used]))
        return {"association_suspect": line} if line else {}


@dataclass(frozen=True, eq=False)
class Flight:
    """What was flown: 10 m at 1 m/s and 10 m above the ground, shaken by the wind as far as `Wobble` says.

    Attributes
    ----------
    nodes
        Node → how it flew.
    scene
        Waveform and scatterers.
    time_s
        (pulse,) float64, seconds.
    beamed
        Whether the antennas of node a have beams; else all are isotropic.
    """

    nodes: Mapping[str, Sampled]
    scene: PaperScene
    time_s: Floats
    beamed: bool = False

    def antenna(self, node: str, at_s: Floats | None = None, arm_m: tuple[float, float, float] = (0, 0, 0)) -> Floats:
        """Return (pulse, 3) float64 places of a node's antennas, which lie `arm_m` from its logged point."""
        at_s = self.time_s if at_s is None else at_s
        return np.asarray(self.nodes[node].position(at_s) + self.turn(node, at_s) @ np.array(arm_m, np.float64))

    def turn(self, node: str, at_s: Floats) -> Floats:
        """Return (pulse, 3, 3) float64, forward-right-down of a node into east-north-up."""
        to_ned = body_axes(self.nodes[node].attitude(at_s))
        return np.stack([to_ned[:, 1], to_ned[:, 0], -to_ned[:, 2]], axis=1)

    def apertures(self, **moved: Floats) -> dict[str, Aperture]:
        """Return pair → phase centres, with some nodes elsewhere, (pulse, 3) metres."""
        places = {node: moved.get(node, self.antenna(node)) for node in self.nodes}
        return {pair: Aperture(*(places[node] for node in pair.split("-"))) for pair in PAIRS}

    @property
    def truth(self) -> Told:
        """What a pipeline is told that knows everything."""
        return Told(self.apertures(), beams=self.beams())

    def beams(self, off_deg: float = 0.0) -> dict[str, Beams]:
        """Return pair → beams of node a's antennas, turned off their boresight in azimuth."""
        if not self.beamed:
            return {}
        axes = antenna_axes(self.turn("a", self.time_s), (_LOOKING_DEG[0] + off_deg, _LOOKING_DEG[1]))
        cuts = [gaussian_cut(_BEAMWIDTH_DEG, cutoff_db=_CUTOFF_DB, limit_rad=limit) for limit in (np.pi, np.pi / 2)]
        beam = Beam(axes, *cuts[0], *cuts[1])
        return {"a-a": Beams(beam, beam), "a-b": Beams(transmit=beam)}

    def hear(self, pair: str, generator: np.random.Generator) -> Heard:
        """Return what a pair heard, with 20 dB SNR per subcarrier and 30 dB of the sidelink."""
        tx_m, rx_m = self.apertures()[pair].legs
        geometry = Geometry(tx_m, rx_m, tx_m, rx_m, gain=self._gain(pair))
        scene = PaperScene(self.scene.waveform, self.scene.scatterers, geometry)
        radar, sidelink, _ = receive_pair(scene, _NOISE, generator)
        if pair == "a-a":
            return Heard(radar, None)
        cell_m = SPEED_OF_LIGHT_M_S / np.ptp(self.frequency_hz) * (SUBCARRIERS - 1) / SUBCARRIERS
        return Heard(METHODS["divide"](radar, sidelink), measure(sidelink).delay_cells * cell_m)

    def paths(self, pair: str) -> PointPaths:
        """Return the paths of a point in the middle of the scene, which the budget is of."""
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
def flight(*, pulses: int = 300, beamed: bool = False) -> Flight:
    """Return the flight of every sweep, with so many pulses."""
    generator = np.random.default_rng(7)
    nodes = {
        node: Wobble().around(Straight((middle_m - LASTING_S / 2, 0.0, 10.0), (1.0, 0.0, 0.0)), LASTING_S, generator)
        for node, middle_m in (("a", 0.0), ("b", RX_AHEAD_M))
    }
    scene = reduced_scene(pulses=pulses, subcarriers=SUBCARRIERS)
    return Flight(nodes, scene, np.arange(pulses) * LASTING_S / pulses, beamed=beamed)
