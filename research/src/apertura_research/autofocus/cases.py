"""Test cases of autofocus: a scene, a flight with errors in its logs, its echoes and the true tracks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import PairRecord, TrackErrors
from apertura.methods.causes import Cause, late_logs, other_arm, other_height
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

AREA_M = (-9.0, 5.0, 9.0, 25.0)
GRID = SceneGrid("local", -10.0, 26.0, 0.05, (440, 400))
CELL_M2 = 0.07 * 0.4
"""Approximate area of a resolution cell of the straight flight."""


@dataclass(frozen=True, eq=False)
class TargetScene(Scatterers):
    """Scatterers in east, north and up, some of them targets.

    Attributes
    ----------
    targets
        (target,) int64, indices of the scatterers whose peaks can be measured.
    """

    targets: NDArray[np.int64]


def _five(generator: np.random.Generator) -> TargetScene:
    places = np.array([(0, 5, 0), (-4, 10, 0), (0, 15, 0), (4, 20, 0), (0, 25, 0)], float)
    return TargetScene(places, _phases(5, generator), np.arange(5))


def _forty(generator: np.random.Generator) -> TargetScene:
    """Return forty points within 20 dB at the receiver; the fifteen brightest are measured."""
    places = _spread(40, generator)
    level = 10 ** (generator.uniform(-20, 0, 40) / 20)
    amplitude = level * _phases(40, generator) * (np.hypot(places[:, 1], 10) / 18) ** 2
    return TargetScene(places, amplitude, np.argsort(-level)[:15])


def _texture(generator: np.random.Generator) -> TargetScene:
    """Return clutter of log-normal power, correlated over half a metre."""
    clutter = _clutter(6000, generator)
    spots = generator.standard_normal((64, 64))
    waves = np.fft.fftfreq(64)[:, None] ** 2 + np.fft.fftfreq(64) ** 2
    spots = np.fft.ifft2(np.fft.fft2(spots) * np.exp(-waves * (0.7 / (20 / 64)) ** 2 * 2 * np.pi**2)).real
    low, size = np.array(AREA_M[:2]), np.array(AREA_M[2:]) - AREA_M[:2]
    east, north = ((clutter.position_m[:, :2] - low) / size * 63).astype(int).T
    return TargetScene(
        clutter.position_m, clutter.amplitude * np.exp(0.6 * spots / spots.std())[east, north], clutter.targets
    )


def _points_over_clutter(above_db: float) -> Callable[[np.random.Generator], TargetScene]:
    def scene(generator: np.random.Generator) -> TargetScene:
        """Return eight points at `above_db` above the clutter of one resolution cell."""
        clutter, places = _clutter(6000, generator), _spread(8, generator)
        places[:, 0] *= 0.8
        in_cell = CELL_M2 * 6000 / _area_m2()
        amplitude = 10 ** (above_db / 20) * np.sqrt(in_cell) * _phases(8, generator)
        return TargetScene(
            np.vstack([clutter.position_m, places]), np.append(clutter.amplitude, amplitude), 6000 + np.arange(8)
        )

    return scene


def _field(generator: np.random.Generator) -> TargetScene:
    """Return speckle that extends beyond the scene on all sides, so that the image contains no edge of the speckle."""
    return _clutter(60_000, generator, (-18.0, 1.0, 18.0, 37.0))


def _dense(generator: np.random.Generator) -> TargetScene:
    """Return fully developed speckle: three scatterers per resolution cell, without points."""
    return _clutter(40_000, generator)


def _few(count: int) -> Callable[[np.random.Generator], TargetScene]:
    def scene(generator: np.random.Generator) -> TargetScene:
        """Return points within 6 dB at the receiver in 14 by 14 m, at least 1.5 m from each other."""
        places: list[Floats] = []
        while len(places) < count:
            place = generator.uniform((-7, 8, 0), (7, 22, 0))
            if all(np.linalg.norm(place - other) > 1.5 for other in places):
                places.append(place)
        level = 10 ** (generator.uniform(-6, 0, count) / 20) * (np.hypot(np.array(places)[:, 1], 10) / 18) ** 2
        return TargetScene(np.array(places), level * _phases(count, generator), np.arange(count))

    return scene


def _thirty(generator: np.random.Generator) -> TargetScene:
    """Return thirty points at 15 to 25 dB above the clutter of one resolution cell."""
    clutter, places = _clutter(6000, generator), _spread(30, generator)
    level = 10 ** (generator.uniform(15, 25, 30) / 20) * np.sqrt(CELL_M2 * 6000 / _area_m2())
    return TargetScene(
        np.vstack([clutter.position_m, places]),
        np.append(clutter.amplitude, level * _phases(30, generator)),
        6000 + np.arange(30),
    )


SCENES: Mapping[str, Callable[[np.random.Generator], TargetScene]] = {
    "five": _five,
    "forty": _forty,
    "texture": _texture,
    "thirty": _thirty,
    **{f"points-{count}": _few(count) for count in range(1, 9)},
    "clutter+10": _points_over_clutter(10.0),
    "clutter+20": _points_over_clutter(20.0),
    "dense": _dense,
    "field": _field,
}


def _clutter(
    count: int, generator: np.random.Generator, area_m: tuple[float, float, float, float] = AREA_M
) -> TargetScene:
    parts = generator.standard_normal((2, count)) / np.sqrt(2)
    return TargetScene(_spread(count, generator, area_m), parts[0] + 1j * parts[1], np.zeros(0, np.int64))


def _spread(count: int, generator: np.random.Generator, area_m: tuple[float, float, float, float] = AREA_M) -> Floats:
    east, north, far_east, far_north = area_m
    places = generator.uniform((east, north), (far_east, far_north), (count, 2))
    return np.concatenate([places, np.zeros((count, 1))], axis=1)


def _phases(count: int, generator: np.random.Generator) -> NDArray[np.complex128]:
    return np.asarray(np.exp(2j * np.pi * generator.random(count)))


def _area_m2() -> float:
    return (AREA_M[2] - AREA_M[0]) * (AREA_M[3] - AREA_M[1])


PULSES_HZ = 100.0
NODES = ("uav1", "uav2")
_NODE_SPACING_M = 4.7


@dataclass(frozen=True, eq=False)
class LoggedFlight:
    """Logged positions of both nodes, metres, east, north, up.

    Attributes
    ----------
    time_s
        (pulse,) float64.
    logged_m
        Node → (pulse, 3) float64.
    reach_m
        Half widths, east and north, of the area about a point in which its peak is searched.
    """

    time_s: Floats
    logged_m: Mapping[str, Floats]
    reach_m: tuple[float, float] = (0.5, 0.6)


def _straight() -> LoggedFlight:
    time_s = np.arange(3000) / PULSES_HZ
    first = np.stack([time_s - 15, 0 * time_s, np.full(3000, 10.0)], -1)
    return LoggedFlight(time_s, dict(zip(NODES, (first, first + [_NODE_SPACING_M, 0, 0]), strict=True)))


def _short() -> LoggedFlight:
    """Return a short flight, typical of a first test: 20 m in 7.5 s, 150 pulses."""
    time_s = np.arange(150) / 20
    first = np.stack([20 / 7.5 * (time_s - 3.725), 0 * time_s, np.full(150, 10.0)], -1)
    return LoggedFlight(time_s, dict(zip(NODES, (first, first + [_NODE_SPACING_M, 0, 0]), strict=True)))


def _wobble() -> LoggedFlight:
    plain = _straight()
    swing = [np.sin(2 * np.pi * plain.time_s / period) for period in (4.3, 7.3, 2.9, 6.1, 8.3)]
    rise = np.sin(2 * np.pi * plain.time_s / 5.1 + 1)
    common = np.stack([0.2 * swing[0], 0.6 * swing[1] + 0.2 * swing[2], 0.5 * rise], -1)
    second = np.stack([0 * rise, 0.5 * swing[3], 0.4 * swing[4]], -1)
    first, other = plain.logged_m.values()
    return LoggedFlight(plain.time_s, dict(zip(NODES, (first + common, other + common + second), strict=True)))


def _circle() -> LoggedFlight:
    """Return one full circle about the scene centre with a radius of 14 m."""
    radius = 14.0
    time_s = np.arange(int(2 * np.pi * radius * PULSES_HZ)) / PULSES_HZ

    def position(angle: Floats) -> Floats:
        return np.stack([radius * np.sin(angle), 15 - radius * np.cos(angle), np.full(len(angle), 10.0)], -1)

    angle = time_s / radius
    second = angle + _NODE_SPACING_M / radius
    return LoggedFlight(time_s, dict(zip(NODES, (position(angle), position(second)), strict=True)))


def _far() -> LoggedFlight:
    """Return a pass at 1 km and ten times the speed: a track error has the same phase at all points of the scene."""
    time_s = np.arange(3000) / PULSES_HZ
    first = np.stack([10 * (time_s - 15), np.full(3000, -985.0), np.full(3000, 300.0)], -1)
    return LoggedFlight(time_s, dict(zip(NODES, (first, first + [_NODE_SPACING_M, 0, 0]), strict=True)), (1.2, 0.6))


FLIGHTS: Mapping[str, Callable[[], LoggedFlight]] = {
    "straight": _straight,
    "short": _short,
    "wobble": _wobble,
    "circle": _circle,
    "far": _far,
}


def drawn_errors(time_s: Floats, errors: TrackErrors, generator: np.random.Generator) -> Floats:
    """Draw position errors, (pulse, 3) metres: white noise averaged over the correlation time, and a slow drift."""
    step_s = time_s[1] - time_s[0]
    width = max(1, round(errors.correlation_s / step_s))
    total = np.cumsum(np.vstack([np.zeros(3), generator.standard_normal((len(time_s) + width, 3))]), axis=0)
    noise = (total[width:] - total[:-width])[: len(time_s)] / np.sqrt(width)
    return np.asarray(noise * errors.std_m + _drift(time_s) @ generator.standard_normal((4, 3)) * errors.drift_std_m)


_STEP_NOISE_M = 0.005
"""Standard deviation of the noise that is added to a step."""


def _step(time_s: Floats, errors: TrackErrors, generator: np.random.Generator) -> Floats:
    """Draw position errors, (pulse, 3) metres: noise of 0.5 cm and a step of `std_m`, typical of a change of fix."""
    noise = drawn_errors(time_s, replace(errors, std_m=(_STEP_NOISE_M,) * 3), generator)
    at_s = time_s[0] + generator.uniform(0.35, 0.65) * (time_s[-1] - time_s[0])
    direction = generator.standard_normal(3)
    step_m = np.array(errors.std_m) * direction / np.linalg.norm(direction)
    return noise + np.where(time_s[:, None] > at_s, step_m, 0.0)


def _walk(time_s: Floats, errors: TrackErrors, generator: np.random.Generator) -> Floats:
    """Draw position errors, (pulse, 3) metres: a random walk with a standard deviation of `std_m` after one second."""
    steps = generator.standard_normal((len(time_s), 3)) * np.sqrt(time_s[1] - time_s[0]) * np.array(errors.std_m)
    walk = np.cumsum(steps, axis=0)
    return np.asarray(walk - walk.mean(axis=0))


_LOG_HZ, _WOBBLE_HZ = 2.0, (0.3, 1.5)


def _sparse(time_s: Floats, errors: TrackErrors, generator: np.random.Generator) -> Floats:
    """Draw position errors, (pulse, 3) metres: a spline through a 2 Hz log of motion with frequencies up to 1.5 Hz."""
    from scipy.interpolate import CubicSpline

    logged_s = np.arange(time_s[0], time_s[-1] + 1 / _LOG_HZ, 1 / _LOG_HZ)
    at_s = np.concatenate([time_s, logged_s])[:, None, None]
    frequency_hz = generator.uniform(*_WOBBLE_HZ, (3, 12))
    wobble = np.cos(2 * np.pi * (frequency_hz * at_s + generator.random((3, 12)))).sum(axis=-1)
    spline_error = wobble[: len(time_s)] - CubicSpline(logged_s, wobble[len(time_s) :])(time_s)
    return np.asarray(spline_error / spline_error.std(axis=0) * errors.std_m)


ERRORS: Mapping[str, Callable[[Floats, TrackErrors, np.random.Generator], Floats]] = {
    "smooth": drawn_errors,
    "step": _step,
    "walk": _walk,
    "sparse": _sparse,
}
"""Models of the logs' errors by name."""


def _drift(time_s: Floats) -> Floats:
    """Return (pulse, 4): constant, slope, half sine and half cosine, together of about unit variance."""
    part = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    return np.stack([np.ones_like(part), 2 * part - 1, np.sin(np.pi * part), np.cos(np.pi * part)], -1) / 2


BANDWIDTH_HZ, SUBCARRIERS = 409.6e6, 128
FREQUENCY_HZ: NDArray[np.float64] = 1.2e9 + BANDWIDTH_HZ / SUBCARRIERS * np.arange(SUBCARRIERS, dtype=np.float64)
PAIRS = {"mono": ("uav1-uav1",), "bi": ("uav1-uav2",), "joint": ("uav1-uav1", "uav1-uav2")}
PROBES_M = np.array([(east, north, 0.0) for east in (-6.0, 0.0, 6.0) for north in (6.0, 10.0, 15.0, 20.0, 24.0)])
PROBES_M[:, 0] += np.tile([0.3, -0.4, 0.0, 0.5, -0.2], 3)


@dataclass(frozen=True, eq=False)
class AutofocusCase:
    """Inputs of a refinement, and the true tracks with which the result is compared.

    Attributes
    ----------
    name
        Scene, geometry, pairs, sigma (m), SNR (dB) and seed.
    records
        Echoes of all pairs, with the logged positions.
    errors
        Node → stated errors of its log.
    truth
        Correction that turns the logged positions into the true ones.
    targets_m
        (target, 3) float64, positions of the scatterers whose peaks can be measured.
    probes
        Noise-free echoes of the same pairs from fifteen other points, `PROBES_M`, which no refinement uses.
    reach_m
        Half widths, east and north, of the area about a point in which its peak is searched.
    """

    name: tuple[str, str, str, float, float | None, int]
    records: tuple[PairRecord, ...]
    errors: Mapping[str, TrackErrors]
    truth: TrackCorrection
    targets_m: NDArray[np.float64]
    probes: tuple[PairRecord, ...]
    reach_m: tuple[float, float]


def case(
    scene: str,
    geometry: str,
    pairs: str,
    sigma_m: float,
    snr_db: float | None,
    seed: int,
    *,
    drift_m: float = 0.0,
    correlation_s: float = 1.0,
    kind: str = "smooth",
    stated_m: float | None = None,
) -> AutofocusCase:
    """Return a case; tracks, scene and noise have separate random streams, so that they change independently.

    Parameters
    ----------
    scene, geometry, pairs
        Names in `SCENES`, `FLIGHTS` and `PAIRS`.
    sigma_m, drift_m
        Standard deviations of the logs' errors in each axis.
    snr_db
        SNR of a range-compressed pulse, dB, of a target with the rms amplitude, or of the mean range cell if the scene
        has no target; None: no noise.
    seed
        Seed of all random streams.
    correlation_s
        Correlation time of the errors.
    kind
        Name in `ERRORS`.
    stated_m
        Standard deviation that is stated to the refinement instead of `sigma_m`.
    """
    of_tracks, of_scene, of_noise, of_probes = np.random.default_rng(seed).spawn(4)
    flight, scatterers = FLIGHTS[geometry](), SCENES[scene](of_scene)
    errors = TrackErrors((sigma_m,) * 3, correlation_s, drift_m)
    streams = zip(NODES, of_tracks.spawn(len(NODES)), strict=True)
    truth = TrackCorrection(
        flight.time_s, {node: ERRORS[kind](flight.time_s, errors, generator) for node, generator in streams}
    )
    stated = errors if stated_m is None else replace(errors, std_m=(stated_m,) * 3)
    probes = _probes(of_probes)
    noises = dict(zip(PAIRS["joint"], of_noise.spawn(2), strict=True))
    return AutofocusCase(
        (scene, geometry, pairs, sigma_m, snr_db, seed),
        tuple(record(pair, flight, truth, scatterers, snr_db, noises[pair]) for pair in PAIRS[pairs]),
        dict.fromkeys(sorted({node for pair in PAIRS[pairs] for node in pair.split("-")}), stated),
        truth,
        scatterers.position_m[scatterers.targets],
        tuple(record(pair, flight, truth, probes, None, noises[pair]) for pair in PAIRS[pairs]),
        flight.reach_m,
    )


# ---- Flights with one wrong constant of the config ------------------------------------------------------------------

_SWAY = {"yaw": ((8.0, 3.1), (4.0, 1.3)), "roll": ((5.0, 2.3),)}
"""Amplitudes (degrees) and periods (seconds) of the attitude oscillation of a platform in wind."""

_WIDEST = {"time": 0.2, "lever arm": 0.3, "height": 0.5}
"""Largest drawn error: seconds, metres in each axis, metres."""


def body_axes(flight: LoggedFlight, node: str, generator: np.random.Generator) -> Floats:
    """Return forward, right and down of a body that sways about its course, (pulse, 3, 3): columns, in the frame."""
    east, north, _ = np.gradient(flight.logged_m[node], flight.time_s, axis=0).T
    angle = {
        name: sum(
            np.radians(size) * np.sin(2 * np.pi * flight.time_s / period_s + generator.uniform(0, 2 * np.pi))
            for size, period_s in waves
        )
        for name, waves in _SWAY.items()
    }
    course = np.arctan2(north, east) + angle["yaw"]
    level, flat = np.zeros_like(course), np.array([0.0, 0.0, 1.0])
    forward = np.stack([np.cos(course), np.sin(course), level], -1)
    starboard = np.stack([np.sin(course), -np.cos(course), level], -1)
    right = np.cos(angle["roll"])[:, None] * starboard - np.sin(angle["roll"])[:, None] * flat
    return np.stack([forward, right, np.cross(forward, right)], -1)


def wrong_case(
    kind: str, scene: str, geometry: str, sigma_m: float, seed: int, *, snr_db: float = 10.0
) -> tuple[AutofocusCase, tuple[Cause, ...], tuple[str, Floats]]:
    """Return a case of both pairs with one wrong constant in addition to the logs' errors, and its possible causes.

    Parameters
    ----------
    kind
        time, lever arm, height, or nothing.
    scene, geometry, sigma_m, seed, snr_db
        See `case`.

    Returns
    -------
    tuple
        The case; all possible causes in a campaign with such logs; the true cause: node, or 'all', and its values.
    """
    one, flight, generator = case(scene, geometry, "joint", sigma_m, snr_db, seed), FLIGHTS[geometry](), _drawn(seed)
    axes = {node: body_axes(flight, node, generator) for node in NODES}
    flown = {node: (flight.time_s, flight.logged_m[node]) for node in NODES}
    causes = [
        *(late_logs([node], flown) for node in NODES),
        *(other_arm(node, flight.time_s, axes[node]) for node in NODES),
        other_height(NODES, flight.time_s, np.array([0.0, 0.0, 1.0])),
        late_logs(NODES, flown),
    ]
    possible = [cause for cause in causes if cause.quantity.kind == kind]
    node, values = "", np.zeros(0)
    moved = {node: np.array(moved_m) for node, moved_m in one.truth.moved_m.items()}
    if possible:
        wrong = possible[generator.integers(min(len(NODES), len(possible)))]
        values = generator.uniform(0.2, 1.0, len(wrong.std)) * generator.choice([-1, 1], len(wrong.std)) * _WIDEST[kind]
        for name, by_unit in wrong.moved_m.items():
            moved[name] += np.tensordot(values, by_unit, axes=1)
        node = next(iter(wrong.moved_m)) if len(wrong.moved_m) == 1 else "all"
    truth = TrackCorrection(flight.time_s, moved)
    _, of_scene, of_noise, of_probes = np.random.default_rng(seed).spawn(4)
    scatterers, probes = SCENES[scene](of_scene), _probes(of_probes)
    noises = dict(zip(PAIRS["joint"], of_noise.spawn(2), strict=True))
    wrong_constant = replace(
        one,
        truth=truth,
        records=tuple(record(pair, flight, truth, scatterers, snr_db, noises[pair]) for pair in PAIRS["joint"]),
        probes=tuple(record(pair, flight, truth, probes, None, noises[pair]) for pair in PAIRS["joint"]),
    )
    return wrong_constant, tuple(causes), (node, values)


def _drawn(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, 1])


def _probes(generator: np.random.Generator) -> TargetScene:
    phases = np.exp(2j * np.pi * generator.random(len(PROBES_M)))
    return TargetScene(PROBES_M, phases * (np.hypot(PROBES_M[:, 1], 10) / 18) ** 2, np.arange(len(PROBES_M)))


def record(
    pair: str,
    flight: LoggedFlight,
    truth: TrackCorrection,
    scatterers: TargetScene,
    snr_db: float | None,
    generator: np.random.Generator,
) -> PairRecord:
    """Simulate the echoes of scatterers that a pair records, with the sidelink length restored from the logs.

    Parameters
    ----------
    pair
        transmitter-receiver, each one of `NODES`.
    flight
        Logged positions of the nodes.
    truth
        Correction that turns the logged positions into the true ones.
    scatterers
        Scatterers of the scene.
    snr_db
        See `case`; None: no noise.
    generator
        Random generator of the noise.
    """
    tx, rx = pair.split("-")
    logged = Aperture(flight.logged_m[tx], flight.logged_m[rx])
    between_m = None if tx == rx else logged.tx_m - logged.rx_m
    flown = truth.aperture(logged, pair, flight.time_s)
    longer_m = -truth.longer_m(pair, flight.time_s, between_m)
    echo = transfer(scatterers, flown, FREQUENCY_HZ, longer_m=longer_m, gridded=True)
    if snr_db is not None:
        std = np.sqrt(_signal_power(echo, scatterers, flown) * SUBCARRIERS / 10 ** (snr_db / 10) / 2)
        parts = generator.standard_normal((*echo.shape, 2), np.float32)
        echo += np.float32(std) * parts.view(np.complex64)[..., 0]
    weights = window_weights("hann", SUBCARRIERS)
    history = PhaseHistory(echo, FREQUENCY_HZ, weights, np.zeros(len(echo)), logged)
    return PairRecord(pair, range_compress(history, GRID, FlatGround(0.0)), flight.time_s, between_m)


def _signal_power(echo: NDArray[np.complex64], scatterers: TargetScene, flown: Aperture) -> float:
    """Return the mean echo power of a target, or of a range cell of c/B in total path if there is no target."""
    if not len(scatterers.targets):
        paths = flown[::10].path(scatterers.position_m[::10])
        cells = np.ptp(paths, axis=1).mean() / (SPEED_OF_LIGHT_M_S / BANDWIDTH_HZ)
        return float(np.mean(np.abs(echo) ** 2) / cells)
    places, amplitude = (part[scatterers.targets] for part in (scatterers.position_m, scatterers.amplitude))
    there, back = (np.linalg.norm(leg[::10, None] - places, axis=2) for leg in flown.legs)
    return float(np.mean(np.abs(amplitude / (there * back)) ** 2))
