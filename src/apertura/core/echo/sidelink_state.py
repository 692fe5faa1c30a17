"""Measurement of a sidelink: its average, SNR, echoes, ripple, a second path, and the pulses in which it locks."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.echo.captures import AT_ONCE
from apertura.core.echo.line_of_sight import LOCK_FALSE_ALARM, LineOfSight, Weights, fit_block, joined

# ---- Average of the pulses of a sidelink, aligned to the direct path


class SidelinkAverage(NamedTuple):
    """Averages over the locked pulses of a flight, aligned to a direct path of delay 0 and amplitude 1."""

    pulses: int
    noise: float  # mean noise power in a delay cell of one pulse
    power: Floats  # (cell,) mean power
    mean: NDArray[np.complex128]  # (cell,) complex mean
    spectrum: Floats  # (subcarrier,) mean power
    second_cell: int  # of the pulse with the median strongest arrival outside the direct path
    second_power: float


class Averaging:
    """Accumulator of the averages over the locked pulses, block by block.

    Parameters
    ----------
    subcarriers
        Number of subcarriers of the sidelink, and of cells of its profile.
    """

    def __init__(self, subcarriers: int) -> None:
        self._power, self._spectrum = np.zeros(subcarriers), np.zeros(subcarriers)
        self._mean = np.zeros(subcarriers, np.complex128)
        self._noise: list[Floats] = []
        self._cells: list[NDArray[np.intp]] = []
        self._levels: list[NDArray[np.float32]] = []

    def add(self, sidelink: Complexes, path: LineOfSight, profile: Complexes) -> None:
        """Add a block of pulses, (pulse, subcarrier), their direct path, and their aligned profiles, (pulse, cell)."""
        locked = path.locked
        if not locked.any():
            return
        kept = slice(None) if locked.all() else locked  # a mask copies
        direct = path.select(kept)
        scale = 1 / direct.amplitude
        inverse = (scale * np.exp(-1j * direct.phase_rad)).astype(np.complex64)
        normalised, symbols = profile[kept] * inverse[:, None], sidelink[kept]
        power = np.square(normalised.real) + np.square(normalised.imag)
        self._power += power.sum(0)
        self._mean += normalised.sum(0)
        self._spectrum += np.square(scale).astype(np.float32) @ (np.square(symbols.real) + np.square(symbols.imag))
        self._noise.append(direct.noise_power * np.square(scale))
        self._cells.append(power[:, 2:-1].argmax(1) + 2)
        self._levels.append(power[:, 2:-1].max(1))

    def result(self) -> SidelinkAverage:
        """Return the averages over the pulses added; at least one pulse is required."""
        level, noise = np.concatenate(self._levels), np.concatenate(self._noise)
        median, count = int(np.argsort(level, kind="stable")[level.size // 2]), level.size
        return SidelinkAverage(
            count,
            float(np.mean(noise)) / self._power.size,
            self._power / count,
            self._mean / count,
            self._spectrum / count,
            int(np.concatenate(self._cells)[median]),
            float(level[median]),
        )


# ---- Echoes and ripple in addition to the direct path
#
# Source: docs/theory/echo_methods.md, "State of a sidelink".

GATE_CELLS = 16
"""Half width of the gate, in cells of 1/B around the direct path."""


def strongest_echo(average: SidelinkAverage) -> tuple[float, int]:
    """Measure level (dB) and delay (cells; 0 without a detection) of the strongest arrival besides the direct path.

    Ripple causes echoes on both sides of the direct path, a reflection causes an echo on one side. Measured is the
    power on one side in excess of the other.
    """
    cells = np.arange(2, average.power.size - 1)
    excess = average.power - average.noise
    one_sided = np.where(excess[cells] > 4 * np.abs(excess[-cells]), excess[cells] - excess[-cells], 0.0)
    best = int(np.argmax(one_sided))
    level, cell = float(one_sided[best]), int(cells[best])
    # threshold of the highest of N averages of exponentially distributed noise, at the false-alarm rate of the lock
    highest = scipy.special.gammainccinv(average.pulses, LOCK_FALSE_ALARM / average.power.size) / average.pulses
    threshold = average.noise * (float(highest) - 1)
    # an arrival with a varying delay, as from another transmitter with its own clock, averages out
    highest_noise = average.noise * np.log(average.power.size / LOCK_FALSE_ALARM)
    if average.second_power > max(4 * average.power[average.second_cell], highest_noise, level):
        level, cell = average.second_power, average.second_cell
    if level <= threshold:
        return decibels(threshold), 0
    return decibels(level), cell if cell < average.power.size / 2 else cell - average.power.size


def ripple(average: SidelinkAverage, *, one_sided: bool) -> tuple[float, int, float]:
    """Measure the ripple inside the gate (peak to peak, dB), its strongest cell, and the ripple outside the gate.

    Ripple is measured by the echoes common to all pulses: a cosine of amplitude a causes two echoes of a/2, a
    reflection in the transmitter one echo of a. Outside the gate, and inside unless `one_sided`, an echo on one side
    only is attributed to a second path of the sidelink.
    """
    power = np.abs(average.mean / average.mean[0]) ** 2
    cells = np.arange(1, power.size // 2)
    noise = average.noise / average.pulses
    sides = np.stack([power[cells], power[-cells]]) - noise
    single = np.sqrt(np.where(sides > 9 * noise, sides, 0.0)).sum(0)
    paired = np.sqrt(np.where(sides.min(0) > 5 * noise, sides.min(0), 0.0)) * 2
    inside = cells <= GATE_CELLS
    amplitudes = (single if one_sided else paired)[inside], paired[~inside]
    coarse, fine = (min(float(np.sqrt((amplitude**2).sum())), 0.95) for amplitude in amplitudes)
    strongest = int(cells[inside][amplitudes[0].argmax()]) if coarse else 0
    return _peak_to_peak_db(coarse), strongest, _peak_to_peak_db(fine)


def changing_near(average: SidelinkAverage) -> float:
    """Return the power within two cells of the direct path that varies between pulses, dB; -300 if it is only noise."""
    near = [1, 2, -1, -2]
    excess = average.power[near] - np.abs(average.mean[near]) ** 2 - average.noise
    threshold = 5 * average.noise * np.sqrt(len(near) / average.pulses)
    total = float(excess.sum())
    return decibels(total) if total > threshold and average.pulses > 1 else -300.0


def _peak_to_peak_db(amplitude: float) -> float:
    return float(20 * np.log10((1 + amplitude) / (1 - amplitude)))


# ---- State of a sidelink

ECHO_DB = -20.0
"""Tolerated level of ghosts, dB relative to the image; an echo of the sidelink causes a ghost of the same level."""

SECOND_ARRIVAL_DB = -6.0
"""Level, dB relative to the direct path, above which another arrival indicates a second transmitter or strong
reflection."""

NULL_DB = -20.0
"""Level, dB relative to the mean, below which a subcarrier is a null: division would amplify its noise by more than 20
dB."""


@dataclass(frozen=True)
class SidelinkState:
    """Measurements of a sidelink of N `subcarriers`, the basis for the choice of its correction.

    Attributes
    ----------
    snr_db
        SNR per subcarrier, median of the locked pulses.
    echo_db
        Level of the strongest arrival in addition to the direct path, relative to it; the detection threshold if
        `echo_cells` is 0.
    echo_cells
        Delay of that arrival after the direct path, in cells of 1/B; 0 if none was detected.
    echo_steady
        True if the phase of that arrival relative to the direct path is the same in most pulses, so that its cause may
        be the transmitter.
    ripple_db
        Peak-to-peak ripple common to all pulses and resolved within the gate, modelled as one sinusoid.
    ripple_cells
        Distance of the strongest arrival of `ripple_db` from the direct path, in cells of 1/B; 0 without ripple.
    fine_ripple_db
        Peak-to-peak ripple outside the gate.
    near_db
        Power within two cells of the direct path that varies from pulse to pulse, relative to the direct path; -300 if
        it is only noise.
    null_share
        Share of the subcarriers below `NULL_DB`.
    locked
        (pulse,) bool, True if the direct path is detected above the noise.
    path
        The direct path fitted to each pulse.
    flags
        Flag → measured values, one line.
    noise_gain
        Mean noise of a subcarrier relative to that of weighted subcarriers; 1 for a code of constant modulus.
    """

    subcarriers: int
    snr_db: float
    echo_db: float
    echo_cells: int
    echo_steady: bool
    ripple_db: float
    ripple_cells: int
    fine_ripple_db: float
    near_db: float
    null_share: float
    locked: NDArray[np.bool_]
    path: LineOfSight
    flags: Mapping[str, str]
    noise_gain: float = 1.0

    @property
    def delay_cells(self) -> Floats:
        """(pulse,) float64, delay of the direct path in cells of 1/B; NaN in pulses without lock."""
        return np.where(self.path.locked, self.path.delay_cells, np.nan)

    @property
    def snr_of_pulses_db(self) -> Floats:
        """(pulse,) float64, SNR per subcarrier of each pulse, dB; NaN in pulses without lock."""
        snr = self.path.amplitude**2 / np.maximum(self.path.noise_power, 1e-30)
        return np.where(self.path.locked, 10 * np.log10(np.maximum(snr, 1e-30)), np.nan)

    @property
    def phase_rad(self) -> Floats:
        """(pulse,) float64, phase of the direct path at the middle of the band, radians; NaN in pulses without lock."""
        return np.where(self.path.locked, self.path.phase_rad, np.nan)


def measure(sidelink: Complexes, *, where: str = "sidelink") -> SidelinkState:
    """Measure the sidelink of a flight, (pulse, subcarrier) complex64, code removed; see `measure_blocks`.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(2, 40, 256))
    >>> state = measure((10 + noise[0] + 1j * noise[1]).astype(np.complex64))
    >>> round(state.snr_db), state.echo_cells, state.locked.all()
    (17, 0, np.True_)
    """
    return measure_blocks(
        lambda: ((sidelink[first : first + AT_ONCE], None) for first in range(0, len(sidelink), AT_ONCE)), where
    )


Blocks = Callable[[], Iterable[tuple[Complexes, Weights | None]]]
"""Blocks of a sidelink from its start, code removed, and their weights, as of `fit_block`."""


def measure_blocks(blocks: Blocks, where: str = "sidelink") -> SidelinkState:
    """Measure the sidelink of a flight, block by block.

    `blocks` is called again if no pulse locks. Raises CampaignError, whose message contains the recording `where`, if
    there is no signal.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "State of a sidelink".
    """
    averaging: Averaging | None = None
    paths, gains = [], []
    for block, weight in blocks():
        averaging = averaging or Averaging(block.shape[1])
        direct, profile = fit_block(block, weight)
        averaging.add(block, direct, profile)
        paths.append(direct)
        gains.append(1.0 if weight is None else float((1 / weight).mean()))
    path = joined(paths)
    if averaging is None or not path.locked.any():
        return _measure_without_code(blocks, path, where)
    return replace(_state_of(path, averaging.result()), noise_gain=float(np.mean(gains)))


def _state_of(path: LineOfSight, average: SidelinkAverage) -> SidelinkState:
    """Return the state of a sidelink from its direct path and the average of its locked pulses."""
    subcarriers = average.power.size
    snr = float(np.median(path.amplitude[path.locked] ** 2 / np.maximum(path.noise_power[path.locked], 1e-30)))
    echo_db, echo_cells = strongest_echo(average)
    # Transmit ripple and a path of constant excess length are not distinguishable. Reflections in the hardware are
    # weak, those of the terrain may be strong.
    ripple_db, ripple_cells, fine_ripple_db = ripple(
        average, one_sided=not (0 < abs(echo_cells) <= GATE_CELLS and echo_db > ECHO_DB)
    )
    flat = average.spectrum - average.noise * subcarriers
    state = SidelinkState(
        subcarriers=subcarriers,
        snr_db=decibels(snr),
        echo_db=echo_db,
        echo_cells=echo_cells,
        echo_steady=bool(np.abs(average.mean[echo_cells]) ** 2 > (average.power[echo_cells] - average.noise) / 2),
        ripple_db=ripple_db,
        ripple_cells=ripple_cells,
        fine_ripple_db=fine_ripple_db,
        near_db=changing_near(average),
        # a null is measurable only if the noise is well below its level
        null_share=float(np.mean(flat < flat.mean() * 10 ** (NULL_DB / 10))) if snr > 10 else 0.0,
        locked=path.locked,
        path=path,
        flags={},
    )
    return replace(state, flags=_flags(state))


def _measure_without_code(blocks: Blocks, path: LineOfSight, where: str) -> SidelinkState:
    """Distinguish a sidelink of unknown code, whose neighbouring pulses are equal, from a missing sidelink."""
    pulses = path.locked.size
    common = joined(
        [fit_block(products)[0] for products in _neighbours(block for block, _ in blocks())] or [path.select(slice(0))]
    )
    if not common.locked.size or common.locked.mean() < 0.5:
        raise CampaignError(
            f"the sidelink locks in none of {pulses} pulses",
            where=where,
            expected="the direct path of the transmitter above the noise",
            remedy="Check antenna, gain and recorded channel of the sidelink, and waveform.codes: file, seed, frames.",
        )
    product = float(np.median((common.amplitude**2 / np.maximum(common.noise_power, 1e-30))[common.locked]))
    locked = np.zeros(pulses, bool)
    locked[1:] |= common.locked
    locked[:-1] |= common.locked
    # SNR of the product of two noisy factors: product = snr²/(2·snr + 1)
    snr_db = decibels(product + np.sqrt(product**2 + product))
    line = (
        f"the sidelink (SNR {snr_db:.0f} dB) does not contain the configured code: division by the sidelink is valid "
        "for any code, so this image is right; monostatic images of the transmitter are wrong"
    )
    flags = {"wrong_code": line}
    subcarriers = next(iter(blocks()))[0].shape[1]
    return SidelinkState(subcarriers, snr_db, -300.0, 0, False, 0.0, 0, 0.0, -300.0, 0.0, locked, path, flags)


def _neighbours(blocks: Iterable[Complexes]) -> Iterator[Complexes]:
    """Yield each pulse times the conjugate of the preceding pulse, across blocks."""
    last: Complexes | None = None
    for block in blocks:
        pulses = block if last is None else np.concatenate([last, block])
        if len(pulses) > 1:
            yield np.asarray(pulses[1:] * pulses[:-1].conj(), np.complex64)
        last = pulses[-1:]


def _flags(state: SidelinkState) -> dict[str, str]:
    flags = {}
    unlocked = int((~state.locked).sum())
    if unlocked:
        flags["sidelink_lost"] = f"{unlocked} of {state.locked.size} pulses excluded: no sidelink detected"
    if state.echo_cells and state.echo_db > SECOND_ARRIVAL_DB:
        flags["second_arrival"] = (
            f"a second arrival of {state.echo_db:.1f} dB relative to the direct path, {state.echo_cells:+d} cells from "
            "it: two simultaneous transmitters, or a strong reflection"
        )
    if state.null_share:
        flags["sidelink_nulls"] = (
            f"{100 * state.null_share:.1f} % of the subcarriers are more than {-NULL_DB:.0f} dB below the mean: "
            "they are attenuated, not divided"
        )
    return flags


# ---- A second path of the sidelink within a resolution cell


def second_path_flags(state: SidelinkState, *, cell_m: float) -> dict[str, str]:
    """Return a flag if an arrival near the direct path is an echo, or is not distinguishable from transmit ripple.

    Parameters
    ----------
    state
        State of the sidelink.
    cell_m
        c/B, metres of path.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Ripple or echo".
    """
    if state.near_db > ECHO_DB:
        arrival = (
            f"an arrival of {state.near_db:.1f} dB within {2 * cell_m:.2f} m of the direct path varies during the "
            "flight and is therefore an echo"
        )
        effect = _effect_of_echo(10 ** (state.near_db / 20), 1, cell_m)
        return {"sidelink_ripple_or_echo": f"{arrival}: {effect}"}
    if state.echo_db > ECHO_DB and 0 < abs(state.echo_cells) <= GATE_CELLS and state.echo_steady:
        line = (
            f"an arrival of {state.echo_db:.1f} dB {state.echo_cells * cell_m:+.2f} m from the direct path is constant "
            "over the flight: an echo or transmit ripple; the correction of the one causes ghosts of the same level if "
            "it is the other"
        )
        return {"sidelink_ripple_or_echo": line}
    swing = 10 ** (state.ripple_db / 20)
    amplitude = (swing - 1) / (swing + 1)
    if amplitude <= 10 ** (ECHO_DB / 20):
        return {}
    line = (
        f"ripple of {state.ripple_db:.1f} dB in the sidelink is attributed to the transmitter; a single channel does "
        f"not distinguish it from a second path that is constantly {state.ripple_cells * cell_m:.2f} m longer; in that "
        "case, "
    )
    return {"sidelink_ripple_or_echo": line + _effect_of_echo(amplitude, state.ripple_cells, cell_m)}


def _effect_of_echo(amplitude: float, cells: int, cell_m: float) -> str:
    """Describe the effect of an echo of given amplitude: displaced targets if unresolved, ghosts if resolved."""
    if cells > 1:
        return f"it causes ghosts of {20 * np.log10(amplitude):.1f} dB"
    path_cm, phase_rad = 100 * amplitude * cells * cell_m / np.sqrt(2), amplitude / np.sqrt(2)
    return f"paths have an error of about {path_cm:.0f} cm, phases of about {phase_rad:.2f} rad"
