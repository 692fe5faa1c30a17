"""One case: a scene, a flight with errors in its logs, what its pairs saw, and the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import window_weights
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import PairRecord, TrackErrors
from apertura_research.study.refinement.echoes import transfer
from apertura_research.study.refinement.flights import FLIGHTS, NODES, Flight, drawn_errors
from apertura_research.study.refinement.scenes import GRID, SCENES, Scatterers

BANDWIDTH_HZ, SUBCARRIERS = 409.6e6, 128
FREQUENCY_HZ: NDArray[np.float64] = 1.2e9 + BANDWIDTH_HZ / SUBCARRIERS * np.arange(SUBCARRIERS, dtype=np.float64)
PAIRS = {"mono": ("uav1-uav1",), "bi": ("uav1-uav2",), "joint": ("uav1-uav1", "uav1-uav2")}
PROBES_M = np.array([(east, north, 0.0) for east in (-6.0, 0.0, 6.0) for north in (6.0, 10.0, 15.0, 20.0, 24.0)])
PROBES_M[:, 0] += np.tile([0.3, -0.4, 0.0, 0.5, -0.2], 3)


@dataclass(frozen=True, eq=False)
class Case:
    """What a refinement is given, and what it is judged by.

    Attributes
    ----------
    name
        scene, geometry, pairs, sigma (m), SNR (dB) and seed.
    records
        Of all pairs, as the logs have them.
    errors
        Node → what is known of the errors of its log.
    truth
        What must be added to the logs.
    targets_m
        (target, 3) float64, of scatterers whose peaks can be measured.
    probes
        The same pairs over fifteen points elsewhere, `PROBES_M`, without noise: no refinement sees them.
    reach_m
        East and north of a point, within which its peak is looked for.
    """

    name: tuple[str, str, str, float, float | None, int]
    records: tuple[PairRecord, ...]
    errors: Mapping[str, TrackErrors]
    truth: TrackCorrection
    targets_m: NDArray[np.float64]
    probes: tuple[PairRecord, ...]
    reach_m: tuple[float, float]


def case(
    scene: str, geometry: str, pairs: str, sigma_m: float, snr_db: float | None, seed: int, *, drift_m: float = 0.0
) -> Case:
    """Return a case; tracks, scene and noise of a seed are drawn apart, so that each stays when another is changed.

    Parameters
    ----------
    scene, geometry, pairs
        Rows of `SCENES`, `FLIGHTS` and `PAIRS`.
    sigma_m, drift_m
        Standard deviations of the logs' errors in each axis.
    snr_db
        Range-compressed, per pulse, of the rms target, or of the mean range cell where the scene has no target;
        None is without noise.
    seed
        Of everything random.
    """
    of_tracks, of_scene, of_noise, of_probes = np.random.default_rng(seed).spawn(4)
    flight, scatterers = FLIGHTS[geometry](), SCENES[scene](of_scene)
    errors = TrackErrors((sigma_m,) * 3, drift_std_m=drift_m)
    streams = zip(NODES, of_tracks.spawn(len(NODES)), strict=True)
    truth = TrackCorrection(flight.time_s, {node: drawn_errors(flight.time_s, errors, one) for node, one in streams})
    probes = _probes(of_probes)
    noises = dict(zip(PAIRS["joint"], of_noise.spawn(2), strict=True))
    return Case(
        (scene, geometry, pairs, sigma_m, snr_db, seed),
        tuple(record(pair, flight, truth, scatterers, snr_db, noises[pair]) for pair in PAIRS[pairs]),
        dict.fromkeys(sorted({node for pair in PAIRS[pairs] for node in pair.split("-")}), errors),
        truth,
        scatterers.places_m[scatterers.targets],
        tuple(record(pair, flight, truth, probes, None, noises[pair]) for pair in PAIRS[pairs]),
        flight.reach_m,
    )


def _probes(generator: np.random.Generator) -> Scatterers:
    phases = np.exp(2j * np.pi * generator.random(len(PROBES_M)))
    return Scatterers(PROBES_M, phases * (np.hypot(PROBES_M[:, 1], 10) / 18) ** 2, np.arange(len(PROBES_M)))


def record(
    pair: str,
    flight: Flight,
    truth: TrackCorrection,
    scatterers: Scatterers,
    snr_db: float | None,
    generator: np.random.Generator,
) -> PairRecord:
    """Return what a pair saw of some scatterers, given back the sidelink's length that the logs have.

    Parameters
    ----------
    pair
        transmitter-receiver, one of `NODES` each.
    flight
        Where the logs have the nodes.
    truth
        What must be added to the logs.
    scatterers
        What echoes.
    snr_db
        As of `case`; None is without noise.
    generator
        Of the noise.
    """
    tx, rx = pair.split("-")
    logged = Aperture(flight.logged_m[tx], flight.logged_m[rx])
    between_m = None if tx == rx else logged.tx_m - logged.rx_m
    flown = truth.aperture(logged, pair, flight.time_s)
    echo = transfer(scatterers, flown, FREQUENCY_HZ, further_m=-truth.longer_m(pair, flight.time_s, between_m))
    if snr_db is not None:
        std = np.sqrt(_signal_power(echo, scatterers, flown) * SUBCARRIERS / 10 ** (snr_db / 10) / 2)
        parts = generator.standard_normal((*echo.shape, 2), np.float32)
        echo += np.float32(std) * parts.view(np.complex64)[..., 0]
    weights = window_weights("hann", SUBCARRIERS)
    history = PhaseHistory(echo, FREQUENCY_HZ, weights, np.zeros(len(echo)), logged)
    return PairRecord(pair, range_compress(history, GRID, FlatGround(0.0)), flight.time_s, between_m)


def _signal_power(echo: NDArray[np.complex64], scatterers: Scatterers, flown: Aperture) -> float:
    """Return the mean power of a target's echo, or of a range cell c/B of total path."""
    if not len(scatterers.targets):
        paths = flown[::10].path(scatterers.places_m[::10])
        cells = np.ptp(paths, axis=1).mean() / (SPEED_OF_LIGHT_M_S / BANDWIDTH_HZ)
        return float(np.mean(np.abs(echo) ** 2) / cells)
    places, amplitude = (part[scatterers.targets] for part in (scatterers.places_m, scatterers.amplitude))
    there, back = (np.linalg.norm(leg[::10, None] - places, axis=2) for leg in flown.legs)
    return float(np.mean(np.abs(amplitude / (there * back)) ** 2))
