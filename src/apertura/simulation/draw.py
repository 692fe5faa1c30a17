"""What is drawn of a node's impairments in one flight.

Every random impairment has its own stream of random numbers, so that switching one on leaves the others as
they were.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.simulation.impairments import Blockage, Impairments, Localization, PhaseWalk, Timing, UniformPhase


@dataclass(frozen=True)
class ImpairmentDraw:
    """What was drawn for one node and flight, pulse by pulse.

    Attributes
    ----------
    kept
        (pulse,) bool, the recorder fired.
    phase_rad, start_s, tag_error_s
        (pulse,) float64: carrier phase, start of capture less start of pulse, time tag less truth.
    blocked
        (pulse,) bool, sidelink shadowed.
    position_error_m
        (pulse, 3) float64, logged less true position, ECEF.
    """

    kept: NDArray[np.bool_]
    phase_rad: Floats
    start_s: Floats
    tag_error_s: Floats
    blocked: NDArray[np.bool_]
    position_error_m: Floats


def draw_impairments(
    impairments: Impairments, time_s: Floats, sample_rate_hz: float, generator: Generator
) -> ImpairmentDraw:
    """Draw what is random about a node at (pulse,) times; the generator advances by as much whatever is on.

    Examples
    --------
    >>> wrong = Impairments(carrier_phase=UniformPhase())
    >>> drawn = draw_impairments(wrong, np.arange(5.0), 1e9, np.random.default_rng(1))
    >>> drawn.phase_rad.round(2), drawn.start_s
    (array([...]), array([0., 0., 0., 0., 0.]))
    """
    streams = independent_streams(generator, 6)
    pulses = time_s.size
    return ImpairmentDraw(
        kept=streams[0].random(pulses) >= impairments.missed_fraction,
        phase_rad=_phases(impairments, time_s, streams[1]),
        start_s=_starts(impairments.timing, pulses, sample_rate_hz, streams[2]),
        tag_error_s=impairments.time_tag.offset_s
        + impairments.time_tag.drift_ppm * 1e-6 * time_s
        + impairments.time_tag.jitter_s * streams[3].standard_normal(pulses),
        blocked=_bursts(impairments.sidelink_blockage, pulses, streams[4]),
        position_error_m=_position_error(impairments.localization, time_s, streams[5]),
    )


def independent_streams(generator: Generator, count: int) -> list[Generator]:
    """Return `count` generators that depend on nothing but the state of `generator`, which moves on."""
    root = SeedSequence([int(word) for word in generator.integers(0, 2**32, 4)])
    return [default_rng(seed) for seed in root.spawn(count)]


def _phases(impairments: Impairments, time_s: Floats, generator: Generator) -> Floats:
    phase = np.zeros(time_s.size)
    match impairments.carrier_phase:
        case UniformPhase(half_width_rad=width):
            phase = generator.uniform(-width, width, time_s.size)
        case PhaseWalk(rad_per_root_s=rate):
            steps = np.sqrt(np.diff(time_s, prepend=time_s[:1]))
            phase = np.cumsum(rate * steps * generator.standard_normal(time_s.size))
    if impairments.clock.continuous_phase:
        phase = phase - 2 * np.pi * impairments.clock.cfo_hz * time_s
    return np.asarray(phase)


def _starts(timing: Timing, pulses: int, sample_rate_hz: float, generator: Generator) -> Floats:
    uniform = generator.uniform(-1.0, 1.0, pulses) * timing.half_width_s
    late = np.rint(generator.standard_normal(pulses) * timing.jitter_samples) / sample_rate_hz
    return np.asarray(timing.offset_s + uniform + late)


def _bursts(blockage: Blockage | None, pulses: int, generator: Generator) -> NDArray[np.bool_]:
    blocked = np.zeros(pulses, np.bool_)
    if blockage is None:
        return blocked
    leave = 1 / blockage.mean_pulses
    enter = leave * blockage.fraction / (1 - blockage.fraction)
    state = False
    for pulse, chance in enumerate(generator.random(pulses)):
        limit = blockage.fraction if pulse == 0 else (1 - leave if state else enter)
        state = bool(chance < limit)
        blocked[pulse] = state
    return blocked


def _position_error(localization: Localization | None, time_s: Floats, generator: Generator) -> Floats:
    if localization is None:
        return np.zeros((time_s.size, 3))
    step_s = np.median(np.diff(time_s)) if time_s.size > 1 else localization.window_s
    length = max(1, round(localization.window_s / float(step_s)))
    white = generator.standard_normal((time_s.size + length - 1, 3)) * localization.sigma_m * np.sqrt(length)
    kernel = np.full(length, 1 / length)
    return np.column_stack([np.convolve(axis, kernel, "valid") for axis in white.T])
