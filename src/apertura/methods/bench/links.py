"""Links of radars that stand still or are cabled: how steady they are from pulse to pulse, and how long.

Nothing moves, so all that changes is the radar's own: noise, clocks, cables. Equations in docs/theory/bench.md; limits
below with their reasons.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.captures import Pulses, blocks_of
from apertura.core.echo.clock import ClockOffset
from apertura.core.echo.compression import phasors
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.line_of_sight import LineOfSight, fit_block, joined
from apertura.core.quality.measures import coherence_factor
from apertura.methods.bench.channels import MISSED_SHARE, SIGMAS

# ---- Limits ---------------------------------------------------------------------------------------------------------

WEAK_DB = 10.0
"""dB of the compressed pulse: below it, Γ cannot pass 0.91 and phases scatter by 0.22 rad."""

PHASE_RAD = 0.05
"""Of phase beyond what noise allows, rms, and of drift over the recording: 0.01 dB of an image, a thirtieth of λ/4."""

AMPLITUDE_DB = 0.5
"""dB rms of amplitude beyond what noise allows: a contact that is tight keeps it to hundredths."""

DROPOUT_DB, DROPOUT_SHARE = -6.0, 0.01
"""Pulses so far below the median, and the share of them that a tight contact does not have."""

LEAKAGE_DB, APART_CELLS = -20.0, 3.0
"""dB of what arrives at the sidelink's delay against the strongest arrival; and how far this must lie from it."""

TONE_DB = 13.0
"""Of the change of one subcarrier from pulse to pulse, above that of the median: chance makes 5 dB of 20 pulses."""

UNLOCKED_PPM = 0.3
"""Between two oscillators: disciplined ones (GNSS, a cable of 10 MHz) keep below 0.1 ppm, free quartzes do not."""

DRIFT_PPM = 0.02
"""Of a clock over the recording: the carrier at 1.2 GHz moves by 24 Hz."""

PATH_CELLS = 0.1
"""Of a path against the one stated, cells of c/B: a wrong constant moves the whole image by so much."""

SPLIT_DB, SPLIT_RAD = 1.0, 0.3
"""Between two channels fed by one signal: gain, and phase beyond their paths, as between images that are added up."""


# ---- Links: one path from pulse to pulse ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Contact:
    """Amplitude of a path from pulse to pulse.

    Attributes
    ----------
    name
        Of the path, for messages.
    scatter_db
        Beyond what noise allows, rms; 0 where that is chance.
    moves_db
        Largest difference between eighths of the recording; 0 where that is chance.
    dropouts, pulses
        Pulses that do not lock or lie 6 dB below the median; and all.
    snr_db
        Of a compressed pulse.
    """

    name: str
    scatter_db: float
    moves_db: float
    dropouts: int
    pulses: int
    snr_db: float

    @classmethod
    def of(cls, name: str, amplitude: Floats, noise: float, pulses: int) -> "Contact":
        """Return the state of a contact by (pulse,) amplitudes that lock and their relative noise in one component."""
        usual = float(np.median(amplitude))
        rms, snr_db = float(np.std(amplitude)) / usual, -20 * np.log10(np.sqrt(2) * noise)
        chance = 1 + SIGMAS * np.sqrt(2 / len(amplitude))
        scatter = np.sqrt(rms**2 - noise**2) if rms**2 > chance * noise**2 else 0.0
        low = int((amplitude < usual * 10 ** (DROPOUT_DB / 20)).sum())
        # of a weak path noise alone falls so far
        lost = pulses - len(amplitude) + (low if snr_db > 2 * WEAK_DB else 0)
        parts = np.array([np.median(part) for part in np.array_split(amplitude, _PARTS) if part.size])
        relative_range = float(np.ptp(parts)) / usual
        # a median errs by 1.25 times a mean, a difference of two by 1.4 of that
        local = float(np.std(np.diff(amplitude))) / np.sqrt(2) / usual  # scatter without what moves slowly
        chance = SIGMAS * np.sqrt(2) * 1.25 * max(noise, local) / np.sqrt(max(len(amplitude) / _PARTS, 1))
        moves_db = float(20 * np.log10(1 + relative_range)) if relative_range > chance else 0.0
        return cls(name, float(20 * np.log10(1 + scatter)), moves_db, lost, pulses, float(snr_db))

    @property
    def flags(self) -> dict[str, str]:
        """A flag of a path whose amplitude is not steady."""
        steady = max(self.scatter_db, self.moves_db) <= AMPLITUDE_DB
        if self.dropouts <= DROPOUT_SHARE * self.pulses and steady:
            return {}
        return {"contact_intermittent": f"{self.name}: {self.line}"}

    @property
    def line(self) -> str:
        """Measures in one line."""
        return (
            f"amplitude scatters by {self.scatter_db:.2f} dB rms beyond noise, moves by {self.moves_db:.2f} dB, "
            f"{self.dropouts} of {self.pulses} pulses lost or 6 dB low"
        )


def measure_contact(name: str, form: Callable[[Pulses], Complexes], pulses: int) -> Contact | None:
    """Measure how steady the strongest path of a channel is, wherever its captures begin; None where none locks.

    Parameters
    ----------
    name, form
        As of `measure_link`.
    pulses
        How many there are.
    """
    blocks = [form(some) for some in blocks_of(np.arange(pulses))]
    paths = joined([fit_block(block)[0] for block in blocks])
    if paths.locked.sum() < 2:
        return None
    amplitude = paths.amplitude[paths.locked]
    # noise of the path's amplitude, of N subcarriers; the median of many is better known than that of a pulse
    noise = float(np.median(paths.noise_power[paths.locked])) / blocks[0].shape[1]
    return Contact.of(name, amplitude, float(np.sqrt(noise / 2) / np.median(amplitude)), pulses)


@dataclass(frozen=True)
class Arrival:
    """Arrival beside the strongest path: later by metres of path, at a level in dB of it."""

    later_m: float
    level_db: float


@dataclass(frozen=True, eq=False)
class MeasuredLink:
    """The strongest path of a channel over all its pulses.

    Attributes
    ----------
    name
        Of the link, for messages.
    time_s
        (pulse,) float64, seconds; pulses that lock.
    pulses
        Of the link, also those that do not lock.
    path_m, path_std_m
        Its electrical length beyond what starts the capture or, divided by the sidelink, beyond that; metres of total
        path in vacuum. The deviation is that of the mean, from the scatter of the pulses.
    cell_m
        c/B.
    frequency_hz
        Middle of the band.
    terms
        (pulse,) complex128, compressed at `path_m`: what an image adds.
    noise
        Mean power of the noise of a term.
    arrivals
        Others, strongest first.
    direct_db
        What arrives with the sidelink, dB of the path; None where that is the path, or less than its sidelobes.
    mean
        (subcarrier,) complex128, mean of the pulses.
    jumped, jump_m
        Pulses that lock at another delay, and the median of how far from it, metres.
    tone_hz, tone_db
        Where the band changes most from pulse to pulse, and by how much more than elsewhere, dB.
    """

    name: str
    time_s: Floats
    pulses: int
    path_m: float
    path_std_m: float
    cell_m: float
    frequency_hz: float
    terms: NDArray[np.complex128]
    noise: float
    arrivals: tuple[Arrival, ...]
    direct_db: float | None
    mean: NDArray[np.complex128]
    jumped: int
    jump_m: float
    tone_hz: float
    tone_db: float
    delay_ps: Floats = field(repr=False)

    @property
    def profile(self) -> tuple[Floats, Floats]:
        """(cell,) total path, metres, ascending about the strongest, and level of the mean profile, dB of it."""
        cells = self.mean.size
        later = np.arange(cells) - cells // 2
        start = -(cells - 1) / 2 * self.path_m / self.cell_m / cells
        turns = np.arange(cells) * self.path_m / self.cell_m / cells + start
        power = np.abs(fft.ifft(self.mean * np.exp(2j * np.pi * turns))) ** 2
        level_db: Floats = 10 * np.log10(np.maximum(power[later] / power[0], 1e-12))
        path_m: Floats = np.asarray(self.path_m + later * self.cell_m, np.float64)
        return path_m, level_db

    @property
    def coherence(self) -> float:
        """Coherence factor Γ over the pulses."""
        return coherence_factor(self.terms)

    @property
    def snr(self) -> float:
        """Signal to noise ratio of a term."""
        power = float((np.abs(self.terms) ** 2).mean())
        return max(power - self.noise, 1e-30) / max(self.noise, 1e-30)

    @property
    def coherence_limit(self) -> float:
        """Γ that the noise allows in the mean, eq. 4."""
        return (self.snr + 1 / len(self.terms)) / (self.snr + 1)

    @property
    def coherence_std(self) -> float:
        """Standard deviation of Γ by the noise, eq. 5."""
        return (1 - self.coherence_limit) / float(np.sqrt(max(len(self.terms) - 1, 1)))

    @property
    def noise_rad(self) -> float:
        """Phase noise that the SNR allows, rms."""
        return float(np.sqrt(1 / (2 * self.snr)))

    @property
    def phase_rad(self) -> Floats:
        """(pulse,) phase against the mean of all pulses, unwrapped from pulse to pulse."""
        return np.unwrap(np.angle(self.terms * np.conj(self.terms.mean())))

    @property
    def phase_excess_rad(self) -> float:
        """Phase noise beyond what the SNR allows, rms about a straight line; 0 where that is chance."""
        left = self.phase_rad - np.polyval(self._line(self.phase_rad)[0], self._centred_s)
        rms, allowed = float(np.sqrt(np.mean(left**2))), self.noise_rad
        chance = 1 + SIGMAS * np.sqrt(2 / len(left))
        return float(np.sqrt(rms**2 - allowed**2)) if rms**2 > chance * allowed**2 else 0.0

    @property
    def phase_drift_rad(self) -> tuple[float, float]:
        """Change of phase over the recording by a straight line, and its standard deviation."""
        (slope, _), std = self._line(self.phase_rad)
        return slope * self.lasts_s, std * self.lasts_s

    @property
    def delay_drift_ps(self) -> tuple[float, float]:
        """Change of delay over the recording by a straight line, and its standard deviation."""
        (slope, _), std = self._line(self.delay_ps)
        return slope * self.lasts_s, std * self.lasts_s

    @property
    def lasts_s(self) -> float:
        """Length of the recording."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def contact(self) -> "Contact":
        """Steadiness of its amplitude."""
        return Contact.of(self.name, np.abs(self.terms), self.noise_rad, self.pulses - self.jumped)

    @property
    def _centred_s(self) -> Floats:
        return self.time_s - float(self.time_s.mean())

    def _line(self, values: Floats) -> tuple[tuple[float, float], float]:
        """Return slope and level of a straight line, and the standard deviation of the slope."""
        time = self._centred_s
        squares = float((time**2).sum()) or 1.0
        slope, level = float(time @ values) / squares, float(values.mean())
        scatter = float(np.sqrt(((values - level - slope * time) ** 2).sum() / max(len(values) - 2, 1)))
        return (slope, level), scatter / np.sqrt(squares)

    def deviation(self, interval_s: float) -> list[tuple[float, float]]:
        """Return averaging time, s, and overlapping Allan deviation of the link's delay, by its phase; eq. 6.

        Parameters
        ----------
        interval_s
            Between pulses, seconds; intervals with a missing pulse are left out.
        """
        place = np.round((self.time_s - self.time_s[0]) / interval_s).astype(np.int64)
        error_s = np.full(int(place[-1]) + 1, np.nan)
        error_s[place] = self.phase_rad / (2 * np.pi * self.frequency_hz)
        found, step = [], 1
        while 2 * step < len(error_s):
            second = error_s[2 * step :] - 2 * error_s[step:-step] + error_s[: -2 * step]
            second = second[np.isfinite(second)]
            if len(second) < _FEWEST_DIFFERENCES:
                break
            found.append((step * interval_s, float(np.sqrt(np.mean(second**2) / 2)) / (step * interval_s)))
            step *= 2
        return found

    @property
    def flags(self) -> dict[str, str]:
        """Flags of limits that are crossed."""
        flags, snr_db = {}, decibels(self.snr)
        if snr_db < WEAK_DB:
            flags["link_weak"] = f"{self.name}: {snr_db:.1f} dB in a compressed pulse"
        if self.jumped > MISSED_SHARE * self.pulses and snr_db > WEAK_DB:
            flags["delay_jumps"] = (
                f"{self.name}: {self.jumped} of {self.pulses} pulses arrive {self.jump_m:+.2f} m from the "
                "others, which all else here is of"
            )
        if self.tone_db > TONE_DB:
            flags["interference"] = (
                f"{self.name}: {self.tone_db:.0f} dB above the other subcarriers at {self.tone_hz / 1e6:.2f} MHz"
            )
        excess = self.phase_excess_rad
        random = 1 - self.coherence > 0.5 > 1 - self.coherence_limit
        if excess > PHASE_RAD or random:
            flags["link_incoherent"] = (
                f"{self.name}: Γ {self.coherence:.5f}, noise allows {self.coherence_limit:.5f}; phase scatters by "
                f"{excess:.2g} rad rms beyond it"
            )
        drift, std = self.phase_drift_rad
        if abs(drift) > max(PHASE_RAD, SIGMAS * std) and not random:
            moved, moved_std = self.delay_drift_ps
            flags["link_drifts"] = (
                f"{self.name}: phase moves by {drift:+.3f} ± {std:.3f} rad in {self.lasts_s:.3g} s, delay by "
                f"{moved:+.1f} ± {moved_std:.1f} ps"
            )
        if self.direct_db is not None and self.direct_db > LEAKAGE_DB:
            flags["channel_crosstalk"] = (
                f"{self.name}: what the sidelink carries arrives at {self.direct_db:.1f} dB of the strongest path"
            )
        return Flags.merged(flags, self.contact.flags)


_FEWEST_DIFFERENCES = 8
_PARTS = 8  # of a recording, whose amplitudes are compared
_SHOWN = 4  # arrivals
_HANN_STD = 1.51  # deviation of a delay by noise of the fit under a Hann window, over that without: measured
_STANDS_OUT = 20.0  # times the noise of the mean: 13 dB


def measure_link(
    name: str,
    form: Callable[[Pulses], Complexes],
    time_s: Floats,
    numerology: Numerology,
    *,
    divided: bool,
    prefix_cells: int | None = None,
) -> MeasuredLink | None:
    """Measure the strongest path of a channel over all its pulses; None where it rises above the noise in none.

    Parameters
    ----------
    name
        For messages.
    form
        Numbers of pulses → their transfer functions, (pulse, subcarrier) complex64.
    time_s
        (pulse,) float64, when each was sent, seconds.
    numerology
        Of the symbol.
    divided
        Whether transfer functions were divided by the sidelink: its delay is zero.
    prefix_cells
        Cells that a delay may have at most; None: half of all, either sign.

    Notes
    -----
    Source: docs/theory/bench.md, eq. 3 to 5.

    Examples
    --------
    >>> rng, numerology = np.random.default_rng(1), Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> noise = 0.1 * (rng.normal(size=(50, 32)) + 1j * rng.normal(size=(50, 32)))
    >>> echo = (np.exp(-2j * np.pi * np.arange(32) * 3.25 / 32) + noise).astype(np.complex64)
    >>> link = measure_link("a", lambda some: echo[some], np.arange(50.0), numerology, divided=False)
    >>> round(link.path_m / link.cell_m, 2), round(10 * np.log10(link.snr)), link.flags
    (3.25, 32, {})
    """
    count, subcarriers = len(time_s), numerology.numbers.size
    cell_m = SPEED_OF_LIGHT_M_S / (subcarriers * numerology.spacing_hz)
    every = np.arange(count)
    # 1. The direct path of each pulse: delay, phase and amplitude by maximum likelihood.
    paths: LineOfSight = joined([fit_block(form(some))[0] for some in blocks_of(every)])
    locked = paths.locked
    if locked.sum() < 2:
        return None
    # 2. One delay for all: the median about the first, for it is counted modulo the length of the profile.
    first = float(paths.delay_cells[locked][0])
    off = (paths.delay_cells - first + subcarriers / 2) % subcarriers - subcarriers / 2
    #    Where pulses arrive at several, that of most: a median would lie between them.
    ordered = np.sort(off[locked])
    in_cell = np.searchsorted(ordered, ordered + 1.0, side="right") - np.arange(ordered.size)  # pulses within a cell
    most = int(in_cell.argmax())
    middle = float(np.median(ordered[most : most + in_cell[most]]))
    delay = first + middle
    elsewhere = locked & (np.abs(off - middle) > 1.0)
    jump_m = float(np.median(off[elsewhere] - middle)) * cell_m if elsewhere.any() else 0.0
    locked = locked & ~elsewhere
    if locked.sum() < 2:
        return None
    if prefix_cells is not None:
        delay %= subcarriers
    # 3. Every pulse at that delay: what an image would add; and the noise by how cells far from it change.
    align = phasors(np.array([delay / subcarriers]), subcarriers, first=-(subcarriers - 1) / 2)
    power, total = np.zeros(subcarriers), np.zeros(subcarriers, np.complex128)
    band, band_total = np.zeros(subcarriers), np.zeros(subcarriers, np.complex128)
    terms = np.zeros(count, np.complex128)
    for some in blocks_of(every[locked]):
        aligned = form(some) * align
        profile = fft.ifft(aligned, axis=1).astype(np.complex128)
        band += (np.abs(aligned) ** 2).sum(axis=0)
        band_total += aligned.sum(axis=0)
        terms[some] = profile[:, 0]
        power += (np.abs(profile) ** 2).sum(axis=0)
        total += profile.sum(axis=0)
    used = int(locked.sum())
    changes = (power - np.abs(total) ** 2 / used) / (used - 1)
    # of few pulses the median over cells of a mean of exponential variables lies below its mean
    noise = float(np.median(changes)) / (1 - 1 / (9 * (used - 1))) ** 3
    mean = total / used
    scatter = float(np.std(off[locked]))
    changing = np.maximum(band - np.abs(band_total) ** 2 / used, 1e-30)
    tone = int(changing.argmax())
    direct = _at_sidelink(mean, delay, noise / used) if divided else None
    # 4. The path again, of the mean under a Hann window: sidelobes of other arrivals move it by millimetres without.
    bell = (fft.fft(mean) * np.hanning(subcarriers)).astype(np.complex64)
    path_m = (delay + float(fit_block(bell[None])[0].delay_cells[0])) * cell_m
    return MeasuredLink(
        name,
        time_s[locked],
        count,
        path_m,
        _HANN_STD * scatter * cell_m / np.sqrt(used),
        cell_m,
        float(numerology.carrier_hz + numerology.middle_hz),
        terms[locked],
        noise,
        _arrivals(mean, noise / used, cell_m),
        direct,
        fft.fft(mean) * np.conj(align[0]),
        int(elsewhere.sum()),
        jump_m,
        float(numerology.frequency_hz[tone]),
        decibels(changing[tone] / float(np.median(changing))),
        (off[locked] - middle) * cell_m / SPEED_OF_LIGHT_M_S * 1e12,
    )


def _arrivals(mean: NDArray[np.complex128], noise: float, cell_m: float) -> tuple[Arrival, ...]:
    """Return the arrivals that stand out of the mean profile beside the path, which lies in cell 0."""
    power, cells = np.abs(mean) ** 2, mean.size
    peaks = (power > np.roll(power, 1)) & (power >= np.roll(power, -1)) & (power > _STANDS_OUT * noise)
    later = np.arange(cells)
    later = np.where(later >= cells / 2, later - cells, later)
    peaks &= np.abs(later) > 2  # cells of its own main lobe
    best = np.flatnonzero(peaks)[np.argsort(-power[peaks])][:_SHOWN]
    return tuple(Arrival(float(later[one] * cell_m), decibels(power[one] / power[0])) for one in best)


def _at_sidelink(mean: NDArray[np.complex128], delay_cells: float, noise: float) -> float | None:
    """Return the level of what arrives at delay zero, dB of the path, where the path lies elsewhere."""
    if abs(delay_cells) < APART_CELLS:
        return None
    near = np.abs(mean[(round(-delay_cells) + np.arange(-1, 2)) % mean.size]) ** 2
    level = float(near.max())
    return decibels(level / float(np.abs(mean[0]) ** 2)) if level > _STANDS_OUT * noise else None


# ---- Clocks, paths, and two channels of one signal ------------------------------------------------------------------


def clock_flags(name: str, clock: ClockOffset, numerology: Numerology, pulses: int) -> dict[str, str]:
    """Return flags of a receiver's clock against the transmitter's: not locked to one reference, or moving.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> sorted(clock_flags("b", ClockOffset(2e3, 0.0, 2.0, 5.0, 0.01, one_clock=True), numerology, 100))
    ['clock_unlocked']
    """
    ppm, std = clock.ppm(numerology)
    flags, moved_ppm = {}, clock.cfo_slope_hz * pulses / numerology.carrier_hz * 1e6
    if abs(ppm) > UNLOCKED_PPM + SIGMAS * (std or 0.0):
        flags["clock_unlocked"] = f"{name}: {ppm:+.3f} ± {std or 0.0:.3f} ppm against the transmitter's clock"
    if abs(moved_ppm) > DRIFT_PPM:
        flags["clock_drifts"] = f"{name}: the clock moves by {moved_ppm:+.3f} ppm over the recording"
    return flags


@dataclass(frozen=True)
class BenchPathOffset:
    """Electrical path of a link beyond what was set up, metres of total path.

    Attributes
    ----------
    offset_m, std_m
        Measured, and standard deviation by noise.
    stated_m
        As the config has it.
    cell_m
        c/B.
    """

    offset_m: float
    std_m: float
    stated_m: float
    cell_m: float

    def flags(self, name: str) -> dict[str, str]:
        """Return a flag where the config says another path."""
        apart_m = self.offset_m - self.stated_m
        if abs(apart_m) <= max(PATH_CELLS * self.cell_m, SIGMAS * self.std_m):
            return {}
        return {
            "path_offset_disagrees": f"{name}: {self.offset_m:+.3f} ± {self.std_m:.3f} m beyond the set-up, "
            f"configured {self.stated_m:+.3f} m"
        }


def reversed_flags(link: MeasuredLink, expected_m: float | None) -> dict[str, str]:
    """Return a flag where echoes of a link arrive before its sidelink, and nobody expected that."""
    early_m = link.path_m
    if early_m > -APART_CELLS / 2 * link.cell_m or (expected_m is not None and expected_m < 0):
        return {}
    return {"channels_swapped": f"{link.name}: the strongest echo arrives {-early_m:.2f} m before the sidelink"}


@dataclass(frozen=True)
class SplitAgreement:
    """Two channels that are fed by one signal: the second against the first.

    Attributes
    ----------
    gain_db
        Ratio of amplitudes.
    path_m
        Difference of electrical paths, metres.
    phase_rad, phase_std_rad
        Phase at the middle of the band beyond what that difference turns it by, and standard deviation.
    band_rad, band_db
        RMS over the band of what one path and noise leave, phase and amplitude.
    """

    gain_db: float
    path_m: float
    phase_rad: float
    phase_std_rad: float
    band_rad: float
    band_db: float

    def flags(self, name: str) -> dict[str, str]:
        """Return a flag where they differ by more than two channels of one signal may."""
        off = abs(self.phase_rad) > max(SPLIT_RAD, SIGMAS * self.phase_std_rad)
        if not off and abs(self.gain_db) <= SPLIT_DB and self.band_rad <= SPLIT_RAD and self.band_db <= SPLIT_DB:
            return {}
        return {
            "splitter_channels_differ": f"{name}: {self.gain_db:+.2f} dB, "
            f"{self.phase_rad:+.3f} ± {self.phase_std_rad:.3f} rad; "
            f"over the band {self.band_db:.2f} dB and {self.band_rad:.3f} rad rms"
        }


def split_agreement(first: MeasuredLink, second: MeasuredLink) -> SplitAgreement:
    """Compare two links that are fed by one signal; eq. 7 of docs/theory/bench.md.

    Examples
    --------
    >>> rng, numerology = np.random.default_rng(1), Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> echo = (np.ones((9, 32)) + 1e-3 * rng.normal(size=(9, 32))).astype(np.complex64)
    >>> one, two = (measure_link("a", lambda some, of=of: of * echo[some], np.arange(9.0), numerology, divided=False)
    ...             for of in (1, np.complex64(2j)))
    >>> agreed = split_agreement(one, two)
    >>> round(agreed.gain_db, 1), round(agreed.phase_rad, 2)
    (6.0, 1.57)
    """
    weight = np.abs(first.mean) * np.abs(second.mean)
    ratio = (second.mean * np.conj(first.mean) / np.maximum(weight, 1e-30)).astype(np.complex64)
    path, _ = fit_block(ratio[None])
    delay_s = float(path.delay_cells[0]) * first.cell_m / SPEED_OF_LIGHT_M_S
    turn = 2 * np.pi * first.frequency_hz * delay_s
    phase = float(np.angle(np.exp(1j * (float(path.phase_rad[0]) + turn))))
    std_s = np.hypot(first.path_std_m, second.path_std_m) / SPEED_OF_LIGHT_M_S
    return SplitAgreement(
        float(20 * np.log10(np.abs(second.terms).mean() / np.abs(first.terms).mean())),
        delay_s * SPEED_OF_LIGHT_M_S,
        phase,
        float(np.hypot(2 * np.pi * first.frequency_hz * std_s, np.sqrt(1 / len(first.terms)) * first.noise_rad)),
        *_over_the_band(first, second),
    )


_GROUP_NOISE = 0.005  # rad², of the phase of a group of subcarriers: where noise is small, it is what is predicted


def _over_the_band(first: MeasuredLink, second: MeasuredLink) -> tuple[float, float]:
    """Return the scatter of phase and amplitude of one link over another over the band beyond noise, rms, rad and dB.

    Of groups of subcarriers, each as many as its noise asks for; zero where fewer than four are left.
    """
    subcarriers = first.mean.size
    noise = sum(map(_band_noise, (first, second)))
    groups = int(min(subcarriers, subcarriers * _GROUP_NOISE / max(noise, 1e-30)))
    if groups < 4:
        return 0.0, 0.0
    edges = np.linspace(0, subcarriers, groups + 1).astype(np.int64)[:-1]
    flat = []
    for link in (first, second):
        delay = np.array([link.path_m / link.cell_m / subcarriers])
        aligned = link.mean * phasors(delay, subcarriers, first=-(subcarriers - 1) / 2)[0]
        flat.append(np.add.reduceat(aligned, edges))
    ratio = flat[1] * np.conj(flat[0])
    left = np.angle(ratio * np.conj(ratio.sum()))
    size_db = 20 * np.log10(np.maximum(np.abs(flat[1]), 1e-30) / np.maximum(np.abs(flat[0]), 1e-30))
    chance = (1 + SIGMAS * np.sqrt(2 / groups)) * noise * groups / subcarriers
    return (
        float(np.sqrt(max(0.0, float(np.mean(left**2)) - chance))),
        float(np.sqrt(max(0.0, float(np.var(size_db)) - chance * (20 / np.log(10)) ** 2))),
    )


def _band_noise(link: MeasuredLink) -> float:
    """Return the variance of the phase of a link's mean transfer function in a subcarrier, by noise, rad²."""
    return link.noise * link.mean.size / len(link.terms) / (2 * float(np.mean(np.abs(link.mean) ** 2)))
