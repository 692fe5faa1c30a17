"""Pulses and channels of a recording: what the trigger missed, and what the converter saw.

Equations in docs/theory/bench.md; limits below with their reasons.
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
"""Standard deviations of a measurement beyond which it is no chance: some dozen lines, never one in 10⁴ benches."""

MISSED_SHARE = 0.01
"""Of the pulses that a node should have recorded."""

DC_DB = -20.0
"""dB of the mean of I and Q against the signal: over N = 1000 subcarriers it leaves a floor of −50 dB in range."""

IMAGE_DB = -25.0
"""dB of the mirror image by unequal I and Q: of a subcarrier it falls on another, as noise of that level."""

FEWEST_COUNTS = 4.0
"""Counts rms of a channel of integers: quantisation lies 22 dB below."""


# ---- Pulses: which were recorded ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Triggers:
    """When a node was triggered.

    Attributes
    ----------
    recorded, missed, false
        Captures; pulses between them that are not there; captures that lie between two pulses.
    beyond
        Pulses that another node recorded before its first capture, or after its last.
    """

    recorded: int
    missed: int
    false: int
    beyond: int = 0

    @property
    def due(self) -> int:
        """Pulses from its first capture to its last."""
        return self.recorded - self.false + self.missed

    @property
    def flags(self) -> dict[str, str]:
        """Flags of limits that are crossed."""
        flags, due, lost = {}, self.due + self.beyond, self.missed + self.beyond
        if lost > MISSED_SHARE * due:
            ends = f", {self.beyond} of them before its first capture or after its last" if self.beyond else ""
            flags["triggers_missed"] = f"{lost} of {due} pulses were not recorded{ends}"
        if self.false > 0:
            flags["triggers_false"] = f"{self.false} of {self.recorded} captures lie between two pulses"
        return flags


def triggers(time_s: Floats, *, prf_hz: float) -> Triggers:
    """Count pulses missed and captures too many, by (capture,) float64 ascending time tags, seconds.

    Examples
    --------
    >>> triggers(np.array([0.0, 0.1, 0.2, 0.25, 0.3, 0.5]), prf_hz=10.0)
    Triggers(recorded=6, missed=1, false=1, beyond=0)
    """
    missed, false, last = 0, 0, float(time_s[0])
    for time in time_s[1:].tolist():
        steps = (time - last) * prf_hz
        # Tags are good to a few milliseconds, some to whole ones: a quarter of an interval is no pulse of the radar.
        if steps < 0.75 or abs(steps - round(steps)) > 0.25:
            false += 1
            continue
        missed += round(steps) - 1
        last = time
    return Triggers(len(time_s), missed, false)


# ---- Channels: what the converter saw -------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredChannel:
    """The samples of one channel.

    Attributes
    ----------
    name
        radar or sidelink.
    counts
        Root of the mean power, in counts of the converter.
    dc_db
        Mean of I and Q, dB of the mean power.
    image_db
        Mirror image, dB; eq. 2.
    image_floor_db
        What the code itself looks like where both sidebands are occupied, dB.
    integers
        Whether samples are integers.
    stuck
        Bits that never change while both a lower and a higher one do, 0 for the least significant; eq. 1a.
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
        """Flags of limits that are crossed."""
        flags = {}
        if self.integers and self.counts < FEWEST_COUNTS:
            flags["channel_weak"] = f"channel {self.name}: {self.counts:.1f} counts rms"
        if self.dc_db > DC_DB:
            flags["channel_dc"] = f"channel {self.name}: mean of I and Q {self.dc_db:.1f} dB of the signal"
        if self.image_db > max(IMAGE_DB, self.image_floor_db):
            flags["channel_image"] = f"channel {self.name}: mirror image at {self.image_db:.1f} dB"
        if self.stuck:
            flags["channel_bits_stuck"] = f"channel {self.name}: {', '.join(f'bit {bit}' for bit in self.stuck)}"
        return flags


def measure_channel(name: str, blocks: Iterable[Samples], numerology: Numerology) -> MeasuredChannel:
    """Measure the samples of a channel.

    Parameters
    ----------
    name
        Of the channel.
    blocks
        (capture, sample, 2) each, I and Q from the start of the prefix.
    numerology
        Of the symbol: over one period of it, unlike subcarriers are orthogonal.

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
    ones, zeros = 0, 0  # bits that were 1, and 0, in any sample
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
    # Where the image of a subcarrier falls on another, products of code symbols do not add up to zero: of N random
    # ones √N are left, and three times as much is no chance.
    floor = 3 / (2 * np.sqrt(numerology.numbers.size)) if mirrored.mean() > 0.5 else 0.0
    power = max(power, 1e-30)
    # Eq. 1a: bits that stay between bits that change; below the lowest that changes, samples are shifted up.
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
