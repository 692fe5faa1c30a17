"""Triggers and channels of a recording: missed and false triggers, level, DC offset, I/Q imbalance and stuck bits.

The equations are in docs/theory/bench.md; the limits and their reasons are below.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.units import decibels
from apertura.core.echo.captures import Samples
from apertura.core.echo.demodulate import Numerology

# ---- Limits ---------------------------------------------------------------------------------------------------------

SIGMAS = 5.0
"""Standard deviations above which a measurement is significant: less than one false flag in 10⁴ reports of 12 lines."""

MISSED_SHARE = 0.01
"""Largest fraction of missed pulses among the pulses that a node should have recorded."""

DC_DB = -20.0
"""Largest mean of I and Q relative to the signal, dB; with N = 1000 subcarriers the floor in range is −50 dB."""

IMAGE_DB = -25.0
"""Largest I/Q image due to I/Q imbalance, dB; the image of a subcarrier acts as noise at this level on its mirror
subcarrier."""

FEWEST_COUNTS = 4.0
"""Minimum level of a channel with integer samples, counts rms; quantisation noise is 22 dB below it."""


# ---- Triggers: recorded, missed and false ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Triggers:
    """Trigger counts of a node.

    Attributes
    ----------
    recorded, missed, false
        Numbers of captures, of pulses missing between captures, and of captures between two pulses.
    beyond
        Number of pulses that another node recorded before the first or after the last capture of this node.
    """

    recorded: int
    missed: int
    false: int
    beyond: int = 0

    @property
    def due(self) -> int:
        """Number of pulses from the first to the last capture."""
        return self.recorded - self.false + self.missed

    @property
    def flags(self) -> dict[str, str]:
        """Flag → measured values for exceeded limits."""
        flags, due, lost = {}, self.due + self.beyond, self.missed + self.beyond
        if lost > MISSED_SHARE * due:
            ends = f", {self.beyond} of these before the first or after the last capture" if self.beyond else ""
            flags["triggers_missed"] = f"{lost} of {due} pulses were not recorded{ends}"
        if self.false > 0:
            flags["triggers_false"] = f"{self.false} of {self.recorded} captures lie between two pulses"
        return flags


def triggers(time_s: Floats, *, prf_hz: float) -> Triggers:
    """Count missed pulses and false captures from (capture,) float64 ascending time tags in seconds.

    Examples
    --------
    >>> triggers(np.array([0.0, 0.1, 0.2, 0.25, 0.3, 0.5]), prf_hz=10.0)
    Triggers(recorded=6, missed=1, false=1, beyond=0)
    """
    missed, false, last = 0, 0, float(time_s[0])
    for time in time_s[1:].tolist():
        steps = (time - last) * prf_hz
        # Time tags have errors of a few milliseconds: captures off by more than a quarter of an interval are false.
        if steps < 0.75 or abs(steps - round(steps)) > 0.25:
            false += 1
            continue
        missed += round(steps) - 1
        last = time
    return Triggers(len(time_s), missed, false)


# ---- Channels: samples of the converter -----------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredChannel:
    """Measurements of the samples of one channel.

    Attributes
    ----------
    name
        radar or sidelink.
    counts
        Level, counts rms of the converter.
    dc_db
        Mean of I and Q relative to the mean power, dB.
    image_db
        Level of the I/Q image, dB; eq. 2.
    image_floor_db
        Detection limit of the I/Q image, dB; if both sidebands are occupied, it depends on the code.
    integers
        True if samples are integers.
    stuck
        Numbers of bits that never change while a lower and a higher bit do, 0 for the least significant; eq. 1a.
    """

    name: str
    counts: float
    dc_db: float
    image_db: float
    image_floor_db: float
    integers: bool
    stuck: tuple[int, ...] = ()

    @property
    def flags(self) -> dict[str, str]:
        """Flag → measured values for exceeded limits."""
        flags = {}
        if self.integers and self.counts < FEWEST_COUNTS:
            flags["channel_weak"] = f"channel {self.name}: level {self.counts:.1f} counts rms"
        if self.dc_db > DC_DB:
            flags["channel_dc"] = f"channel {self.name}: mean of I and Q {self.dc_db:.1f} dB relative to the signal"
        if self.image_db > max(IMAGE_DB, self.image_floor_db):
            flags["channel_image"] = f"channel {self.name}: mirror image {self.image_db:.1f} dB relative to the signal"
        if self.stuck:
            flags["channel_bits_stuck"] = f"channel {self.name}: {', '.join(f'bit {bit}' for bit in self.stuck)}"
        return flags


def measure_channel(name: str, blocks: Iterable[Samples], numerology: Numerology) -> MeasuredChannel:
    """Measure the samples of a channel.

    Parameters
    ----------
    name
        Name of the channel.
    blocks
        Arrays (capture, sample, 2): I and Q from the start of the prefix.
    numerology
        Numerology of the symbol; different subcarriers are orthogonal over one period.

    Notes
    -----
    Source: docs/theory/bench.md, eqs. 1, 1a and 2.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> tone = 1000 * np.exp(2j * np.pi * 5 * np.arange(80) / 64)
    >>> iq = np.stack([tone.real * 1.1 + 10, tone.imag], -1)[None].round().astype(np.int16)
    >>> channel = measure_channel("radar", [iq], numerology)
    >>> round(channel.dc_db), round(channel.image_db)
    (-40, -26)
    """
    window = slice(numerology.prefix_samples, numerology.prefix_samples + numerology.dft_samples)
    captures, power, square, mean, integers = 0, 0.0, 0j, 0.0, True
    ones, zeros = 0, 0  # bits that are 1, and 0, in any sample
    # Sums over the blocks: mean of I and Q (eq. 1), power and mean of the squares (eq. 2), bits (eq. 1a).
    for block in blocks:
        if integers := block.dtype.kind == "i":
            ones |= int(np.bitwise_or.reduce(block, axis=None))
            zeros |= ~int(np.bitwise_and.reduce(block, axis=None))
        samples = np.ascontiguousarray(block[:, window], np.float32).view(np.complex64)[..., 0].astype(np.complex128)
        level = samples.mean(axis=1)
        captures += len(samples)
        mean += float((np.abs(level) ** 2).sum())
        rest = samples - level[:, None]
        power += float((np.abs(rest) ** 2).mean(axis=1).sum())
        square += complex((rest**2).mean(axis=1).sum())
    mirrored = np.isin(-numerology.numbers % numerology.dft_samples, numerology.numbers % numerology.dft_samples)
    # If the image of a subcarrier coincides with another subcarrier, products of code symbols do not cancel: the sum of
    # N random products is about √N, and three times this value is significant.
    floor = 3 / (2 * np.sqrt(numerology.numbers.size)) if mirrored.mean() > 0.5 else 0.0
    power = max(power, 1e-30)
    # Eq. 1a: constant bits between changing bits; constant bits below the lowest changing bit are padding.
    changing = ones & zeros
    stuck = tuple(
        bit for bit in range(changing.bit_length()) if changing & ((1 << bit) - 1) != 0 and not changing >> bit & 1
    )
    return MeasuredChannel(
        name,
        float(np.sqrt(power / captures)),
        decibels(mean / power),
        2 * decibels(abs(square) / (2 * power)),
        2 * decibels(floor),
        integers,
        stuck,
    )
