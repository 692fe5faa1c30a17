"""State of a sidelink: its SNR, echoes and ripple, and the pulses in which it locks."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.echo.captures import AT_ONCE
from apertura.core.echo.line_of_sight import Complexes, Floats, LineOfSight, fit_block, joined
from apertura.core.echo.sidelink_arrivals import GATE_CELLS, changing_near, decibels, ripple, strongest_echo
from apertura.core.echo.sidelink_average import Averaging, SidelinkAverage

ECHO_DB = -20.0
"""Ghosts this far below the image are tolerated; an echo of the sidelink makes one as strong as itself."""

SECOND_ARRIVAL_DB = -6.0
"""An arrival this strong beside the direct path is another transmitter, or a reflection as good as one."""

NULL_DB = -20.0
"""Subcarriers this far below the mean are nulls: divided, they would amplify noise by more than a hundred."""


@dataclass(frozen=True)
class SidelinkState:
    """What decides which correction a sidelink of N `subcarriers` allows.

    Attributes
    ----------
    snr_db
        Per subcarrier, median of the locked pulses.
    echo_db
        Strongest arrival beside the direct path, relative to it; where `echo_cells` is 0, the level below
        which none would have been seen.
    echo_cells
        Delay of that arrival after the direct path, in cells of 1/B; 0 if none was seen.
    echo_stays
        Whether its phase against the direct path is the same in most pulses: then it may be the transmitter's, too.
    ripple_db
        Peak-to-peak ripple of the band that repeats in every pulse and fits into the gate, as of one sinusoid.
    ripple_cells
        How far from the direct path the strongest arrival behind `ripple_db` lies, in cells of 1/B; 0 without.
    fine_ripple_db
        The same for ripple too fine for the gate.
    near_db
        What changes from pulse to pulse within two cells of the direct path, relative to it; -300 where it is noise.
    null_share
        Share of the subcarriers below `NULL_DB`.
    locked
        (pulse,) bool, whether the direct path stands out of the noise.
    path
        The direct path as fitted to each pulse.
    flags
        Edge crossed → what was measured, in one line.
    """

    subcarriers: int
    snr_db: float
    echo_db: float
    echo_cells: int
    echo_stays: bool
    ripple_db: float
    ripple_cells: int
    fine_ripple_db: float
    near_db: float
    null_share: float
    locked: NDArray[np.bool_]
    path: LineOfSight
    flags: Mapping[str, str]

    @property
    def delay_cells(self) -> Floats:
        """(pulse,) float64, delay of the direct path in cells of 1/B; NaN where it did not lock."""
        return np.where(self.path.locked, self.path.delay_cells, np.nan)

    @property
    def snr_of_pulses_db(self) -> Floats:
        """(pulse,) float64, SNR per subcarrier of each pulse, dB; NaN where it did not lock."""
        snr = self.path.amplitude**2 / np.maximum(self.path.noise_power, 1e-30)
        return np.where(self.path.locked, 10 * np.log10(np.maximum(snr, 1e-30)), np.nan)

    @property
    def phase_rad(self) -> Floats:
        """(pulse,) float64, phase of the direct path at the middle of the band, radians; NaN where it did not lock."""
        return np.where(self.path.locked, self.path.phase_rad, np.nan)


def measure(sidelink: Complexes, *, where: str = "sidelink") -> SidelinkState:
    """Measure the sidelink of a flight, (pulse, subcarrier) complex64, the code removed; as `measure_blocks`.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(2, 40, 256))
    >>> state = measure((10 + noise[0] + 1j * noise[1]).astype(np.complex64))
    >>> round(state.snr_db), state.echo_cells, state.locked.all()
    (17, 0, np.True_)
    """
    return measure_blocks(
        lambda: (sidelink[first : first + AT_ONCE] for first in range(0, len(sidelink), AT_ONCE)), where
    )


def measure_blocks(blocks: Callable[[], Iterable[Complexes]], where: str = "sidelink") -> SidelinkState:
    """Measure the sidelink of a flight, block by block.

    `blocks` gives it from its beginning, (pulse, subcarrier) complex64 each, the code removed; it is asked once more
    where no pulse locks. Errors call the recording `where`; CampaignError if it carries nothing.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "State of a sidelink".
    """
    averaging: Averaging | None = None
    paths = []
    for block in blocks():
        averaging = averaging or Averaging(block.shape[1])
        direct, profile = fit_block(block)
        averaging.add(block, direct, profile)
        paths.append(direct)
    path = joined(paths)
    if averaging is None or not path.locked.any():
        return _measure_without_code(blocks, path, where)
    return _state_of(path, averaging.result())


def _state_of(path: LineOfSight, average: SidelinkAverage) -> SidelinkState:
    """Return the state of a sidelink from its direct path and the average of its locked pulses."""
    subcarriers = average.power.size
    snr = float(np.median(path.amplitude[path.locked] ** 2 / np.maximum(path.noise_power[path.locked], 1e-30)))
    echo_db, echo_cells = strongest_echo(average)
    # transmit ripple and a path of constant excess look alike; hardware reflects little, the ground may a lot
    ripple_db, ripple_cells, fine_ripple_db = ripple(
        average, one_sided=not (0 < abs(echo_cells) <= GATE_CELLS and echo_db > ECHO_DB)
    )
    flat = average.spectrum - average.noise * subcarriers
    state = SidelinkState(
        subcarriers=subcarriers,
        snr_db=decibels(snr),
        echo_db=echo_db,
        echo_cells=echo_cells,
        echo_stays=bool(np.abs(average.mean[echo_cells]) ** 2 > (average.power[echo_cells] - average.noise) / 2),
        ripple_db=ripple_db,
        ripple_cells=ripple_cells,
        fine_ripple_db=fine_ripple_db,
        near_db=changing_near(average),
        # a null is seen only where the noise lies well below it
        null_share=float(np.mean(flat < flat.mean() * 10 ** (NULL_DB / 10))) if snr > 10 else 0.0,
        locked=path.locked,
        path=path,
        flags={},
    )
    return replace(state, flags=_flags(state))


def _measure_without_code(blocks: Callable[[], Iterable[Complexes]], path: LineOfSight, where: str) -> SidelinkState:
    """Tell a sidelink of unknown code, whose neighbouring pulses still agree, from no sidelink at all."""
    pulses = path.locked.size
    common = joined([fit_block(products)[0] for products in _neighbours(blocks())] or [path.select(slice(0))])
    if not common.locked.size or common.locked.mean() < 0.5:
        raise CampaignError(
            f"a sidelink that locks in none of {pulses} pulses",
            where=where,
            expected="the direct path of the transmitter above the noise",
            remedy="Check antenna and gain of the sidelink and which channel it was recorded on.",
        )
    product = float(np.median((common.amplitude**2 / np.maximum(common.noise_power, 1e-30))[common.locked]))
    locked = np.zeros(pulses, bool)
    locked[1:] |= common.locked
    locked[:-1] |= common.locked
    snr_db = decibels(product + np.sqrt(product**2 + product))  # noise of both factors: product = snr²/(2·snr + 1)
    line = (
        f"the sidelink ({snr_db:.0f} dB) does not carry the given code: this image is divided by it and right without "
        "one, monostatic images of the transmitter are wrong"
    )
    flags = {"wrong_code": line}
    subcarriers = next(iter(blocks())).shape[1]
    return SidelinkState(subcarriers, snr_db, -300.0, 0, False, 0.0, 0, 0.0, -300.0, 0.0, locked, path, flags)


def _neighbours(blocks: Iterable[Complexes]) -> Iterator[Complexes]:
    """Yield each pulse times the conjugate of the one before it, across blocks."""
    last: Complexes | None = None
    for block in blocks:
        some = block if last is None else np.concatenate([last, block])
        if len(some) > 1:
            yield np.asarray(some[1:] * some[:-1].conj(), np.complex64)
        last = some[-1:]


def _flags(state: SidelinkState) -> dict[str, str]:
    flags = {}
    lost = int((~state.locked).sum())
    if lost:
        flags["sidelink_lost"] = f"{lost} of {state.locked.size} pulses dropped: their sidelink does not lock"
    if state.echo_cells and state.echo_db > SECOND_ARRIVAL_DB:
        flags["second_arrival"] = (
            f"a second arrival {state.echo_db:.1f} dB beside the direct path at {state.echo_cells:+d} cells: "
            "two transmitters at once, or a reflection as strong as the direct path"
        )
    if state.null_share:
        flags["sidelink_nulls"] = (
            f"{100 * state.null_share:.1f} % of the subcarriers lie {-NULL_DB:.0f} dB below the mean: "
            "they are attenuated, not divided"
        )
    return flags
