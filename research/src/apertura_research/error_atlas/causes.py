"""Causes of image errors, from negligible to destructive size, and the effect that the error budget expects."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from apertura.core.quality.budget import NodePositions, offset_line, position_lines
from apertura.core.quality.path_errors import Effect
from apertura.core.scene.terrain import FlatGround, GridHeights
from apertura_research.error_atlas.flight import (
    GRID,
    AssumedFlight,
    LogErrors,
    TrueFlight,
    assumed_from_logs,
    between_epochs,
    flight,
)
from apertura_research.error_atlas.reception import Receive, echoes_alone, with_coupling, with_pulses, with_tone

Assume = Callable[[TrueFlight, float, Generator], AssumedFlight]
Expect = Callable[[TrueFlight, str, float], Effect]

_CM, _MS = 1e-2, 1e-3
_WHOLE_FLIGHT_S = 1e3
_DEM_CORRELATION_M = 3.0


@dataclass(frozen=True)
class AssumedError:
    """Cause of an image error and its simulated sizes, from negligible to destructive.

    Attributes
    ----------
    assume
        Flight, size and generator → assumptions of the pipeline.
    expect
        Flight, pair and size → effect that the budget expects if the size is configured.
    stated
        Term of the budget to which the size is configured.
    draws
        Number of random draws.
    added
        True if the error affects only the coherent sum of both pairs; the loss is then that of the sum.
    pulses
        Number of pulses in 10 s.
    receive
        Echoes of a pair → these echoes with other signals, after their removal.
    """

    title: str
    unit: str
    sizes: tuple[float, ...]
    assume: Assume
    expect: Expect
    stated: str
    draws: int = 4
    beamed: bool = False
    added: bool = False
    pulses: int = 300
    receive: Receive = echoes_alone

    def flight(self) -> TrueFlight:
        """Return the true flight."""
        return flight(pulses=self.pulses, beamed=self.beamed)


def nothing(flown: TrueFlight, pair: str, size: float) -> Effect:  # noqa: ARG001
    """Return no expected effect, for causes without a line in the budget."""
    return Effect(0.0, 0.0, 0.0)


def known_flight(flown: TrueFlight, size: float, generator: Generator) -> AssumedFlight:  # noqa: ARG001
    """Return the assumptions without any error, for causes in the received signal."""
    return flown.truth


def positions(flown: TrueFlight, pair: str, *known: NodePositions) -> Effect:
    """Return the expected effect of position errors of a pair's nodes, in the order a, b; omitted nodes are exact."""
    exact = NodePositions((1e-9,) * 3, 1.0, "truth")
    nodes = [*known, exact, exact]
    return position_lines(flown.paths(pair), nodes[: len(set(pair.split("-")))], sidelink=pair == "a-b")[0].effect


def offset(
    flown: TrueFlight, pair: str, slope: Callable[..., np.ndarray], size: float, *, common: bool = False
) -> Effect:
    """Return the expected effect of a constant error; `slope` gives its path per unit from the paths of a point."""
    paths = flown.paths(pair)
    return offset_line(paths, "", slope(paths), size, unit="", common=common).effect


def _noise(size: float, correlation_s: float) -> NodePositions:
    return NodePositions((_CM * size,) * 3, correlation_s, "truth")


def _wander(flown: TrueFlight, log: LogErrors, generator: Generator) -> AssumedFlight:
    return assumed_from_logs(flown, generator, a=log, b=log)


def _late(flown: TrueFlight, pair: str, late_ms: float) -> Effect:
    return offset(flown, pair, lambda paths: -_MS * paths.rate_m_s, late_ms, common=True)


def _higher(flown: TrueFlight, pair: str, higher_cm: float) -> Effect:
    return offset(flown, pair, lambda paths: -_CM * paths.gradient[:, 2], higher_cm, common=True)


def _only(pair: str, effect: Callable[..., Effect]) -> Expect:
    """Return an expectation that applies to one pair only."""
    return lambda flown, one, size: effect(flown, one, size) if one == pair else Effect(0.0, 0.0, 0.0)


def _late_receiver(flown: TrueFlight, size: float, _: Generator) -> AssumedFlight:
    moved = flown.antenna("b", flown.time_s + _MS * size)
    return replace(flown.truth, apertures=flown.apertures(b=moved))


def _late_nodes(flown: TrueFlight, size: float, _: Generator) -> AssumedFlight:
    moved = {node: flown.antenna(node, flown.time_s + _MS * size) for node in flown.nodes}
    return replace(flown.truth, apertures=flown.apertures(**moved))


def _rough(flown: TrueFlight, size: float, generator: Generator) -> AssumedFlight:
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(generator.standard_normal(GRID.shape), _DEM_CORRELATION_M / GRID.spacing_m, mode="wrap")
    return replace(flown.truth, terrain=GridHeights(GRID, _CM * size * field / field.std()))


def _every(flown: TrueFlight, size: float, _: Generator) -> AssumedFlight:
    return replace(flown.truth, used=np.arange(len(flown.time_s)) % round(size) == 0)


def _mispaired(flown: TrueFlight, size: float, _: Generator) -> AssumedFlight:
    late_s = flown.time_s + size * flown.time_s[1]
    moved = flown.apertures(**{node: flown.antenna(node, late_s) for node in flown.nodes})
    return replace(flown.truth, apertures={**flown.apertures(), "a-b": moved["a-b"]})


CAUSES: Mapping[str, AssumedError] = {
    "track_noise": AssumedError(
        "Noise of the tracks, correlated over 1 s, σ per axis", "cm", (0.1, 0.3, 0.6, 1, 1.5, 2, 3, 5),
        lambda flown, size, generator: _wander(flown, LogErrors(wander_m=_CM * size), generator),
        lambda flown, pair, size: positions(flown, pair, *[_noise(size, 1.0)] * 2), "positions", draws=6,
    ),
    "track_noise_time": AssumedError(
        "Correlation time of track noise of 1.5 cm", "s", (0.1, 0.3, 1, 3, 10, 30),
        lambda flown, size, generator: _wander(flown, LogErrors(wander_m=0.015, correlation_s=size), generator),
        lambda flown, pair, size: positions(flown, pair, *[_noise(1.5, size)] * 2), "positions", draws=6,
    ),
    "track_gap": AssumedError(
        "Gap in the transmitter's log", "s", (0.1, 0.3, 0.6, 1, 2, 3, 5, 8),
        lambda flown, size, generator: assumed_from_logs(flown, generator, a=LogErrors(gap_s=size), b=LogErrors()),
        nothing, "missing pulses (no loss)",
    ),
    "log_rate": AssumedError(
        "Epochs per second of both logs", "Hz", (50, 20, 10, 5, 2, 1, 0.5, 0.3),
        lambda flown, size, generator: _wander(flown, LogErrors(rate_hz=size), generator),
        lambda flown, pair, size: positions(flown, pair, *[between_epochs(flown, LogErrors(rate_hz=size))] * 2),
        "interpolation_m as positions",
    ),
    "tags_common": AssumedError(
        "Time tags of both nodes late", "ms", (1, 3, 10, 30, 60, 100, 300, 1000), _late_nodes, _late, "time tags",
        draws=2,
    ),
    "tags_of_one": AssumedError(
        "Time tags of the receiver late", "ms", (0.3, 1, 3, 10, 20, 50, 100, 300), _late_receiver, _only("a-b", _late),
        "time tags", draws=2,
    ),
    "height": AssumedError(
        "Assumed terrain too high", "cm", (0.3, 1, 3, 10, 20, 40, 100),
        lambda flown, size, _: replace(flown.truth, terrain=FlatGround(_CM * size)),
        _higher, "heights", draws=2,
    ),
    "dem": AssumedError(
        "Error of the DEM, correlated over 3 m, rms", "cm", (0.3, 1, 3, 10, 20, 40, 60), _rough, _higher, "heights",
    ),
    "arm": AssumedError(
        "Lever arm error of the transmitting node, in each axis", "cm", (0.1, 0.3, 1, 3, 10, 30, 100),
        lambda flown, size, _: replace(
            flown.truth, apertures=flown.apertures(a=flown.antenna("a", arm_m=(_CM * size,) * 3))
        ),
        lambda flown, pair, size: positions(flown, pair, _noise(size, _WHOLE_FLIGHT_S)),
        "positions, one error for the whole flight", draws=2,
    ),
    "prf": AssumedError(
        "Decimation of pulses, of 30 per metre", "1", (1, 2, 3, 4, 6, 8, 12, 16), _every, nothing,
        "missing pulses (no loss)", draws=2,
    ),
    "presum": AssumedError(
        "Presumming of pulses, of 120 per metre", "1", (1, 2, 3, 4, 5, 6, 8),
        lambda flown, size, _: replace(flown.truth, presum=round(size)), nothing, "arithmetic, as measured", draws=1,
        pulses=1200,
    ),
    "antenna": AssumedError(
        "Boresight error in azimuth, beam of 60°", "deg", (1, 3, 6, 10, 20, 30, 45, 60),
        lambda flown, size, _: replace(flown.truth, beams=flown.beams(size)), nothing, "no line", draws=2, beamed=True,
    ),
    "calibration": AssumedError(
        "Path offset error of the bistatic pair", "cm", (0.1, 0.3, 1, 2, 3, 6, 10, 30),
        lambda flown, size, _: replace(flown.truth, longer_m={"a-b": _CM * size}),
        _only("a-b", lambda flown, pair, size: offset(flown, pair, lambda p: np.full(len(p.time_s), _CM), size)),
        "calibration", draws=2,
    ),
    "association": AssumedError(
        "Receiver's pulses paired late", "pulses", (1, 2, 3, 5, 10, 20, 30), _mispaired,
        _only("a-b", lambda flown, pair, size: _late(flown, pair, size * flown.time_s[1] / _MS)), "time tags", draws=2,
    ),
    "fusion_phase": AssumedError(
        "Phase difference between the pairs", "rad", (0.1, 0.3, 0.6, 0.8, 1, 1.3, 1.6, 2.4, 3.1),
        lambda flown, size, _: replace(flown.truth, turned_rad={"a-b": size}),
        lambda _, __, size: Effect(20 * float(np.log10(max(abs(np.cos(size / 2)), 1e-3))), 0.0, size),
        "phase of a pair", draws=2, added=True,
    ),
    "tone": AssumedError(
        "Continuous tone relative to the echoes", "dB", (-40, -30, -20, -10, 0, 10, 20, 40, 60), known_flight, nothing,
        "no line", draws=2, receive=with_tone,
    ),
    "pulsed_tones": AssumedError(
        "Pulsed tones in a tenth of the pulses relative to the echoes", "dB", (-40, -30, -20, -10, 0, 10, 20, 40, 60),
        known_flight, nothing, "no line", draws=2, receive=with_pulses,
    ),
    "coupling": AssumedError(
        "Coupling of the antennas relative to the echoes", "dB", (-40, -20, -10, 0, 10, 20, 40, 60), known_flight,
        nothing, "no line", draws=2, receive=with_coupling,
    ),
}  # fmt: skip
