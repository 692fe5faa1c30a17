"""Links of stationary or cabled radars: pulse-to-pulse stability and electrical length.

Because nothing moves, all changes are due to the radar: noise, clocks, cables. The equations are in
docs/theory/bench.md; the limits and their reasons are below.
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
from apertura.core.echo.captures import Pulses, blocks_of, runs, sampled_pulses
from apertura.core.echo.clock import ClockOffset
from apertura.core.echo.compression import phasors
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.interference import Interference
from apertura.core.echo.line_of_sight import LineOfSight, fit_block, joined
from apertura.core.quality.measures import coherence_factor
from apertura.methods.bench.channels import MISSED_SHARE, SIGMAS

# ---- Limits ---------------------------------------------------------------------------------------------------------

WEAK_DB = 10.0
"""Minimum SNR of a compressed pulse, dB; below it Γ is less than 0.91 and phases scatter by 0.22 rad."""

PHASE_RAD = 0.05
"""Largest phase scatter in excess of noise, rms, and largest phase drift over the recording; each causes 0.01 dB of
loss.
"""

AMPLITUDE_DB = 0.5
"""Largest amplitude scatter in excess of noise, dB rms; tight connectors cause some hundredths of a dB."""

DROPOUT_DB, DROPOUT_SHARE = -6.0, 0.01
"""Level of a dropout relative to the median, dB, and largest share of dropouts with tight connectors."""

LEAKAGE_DB, APART_CELLS = -20.0, 3.0
"""Largest level at the delay of the sidelink relative to the strongest path, dB; minimum difference of the two delays,
cells.
"""

UNLOCKED_PPM = 0.3
"""Largest offset between locked oscillators; the offset of disciplined oscillators (GNSS, 10 MHz cable) is below 0.1
ppm.
"""

DRIFT_PPM = 0.02
"""Largest clock drift over the recording; a carrier of 1.2 GHz then drifts by 24 Hz."""

PATH_CELLS = 0.1
"""Largest difference between measured and configured path, cells c/B; a wrong constant displaces the whole image."""

SPLIT_DB, SPLIT_RAD = 1.0, 0.3
"""Largest differences between two channels fed by one signal: gain, and phase in excess of that of the path
difference.
"""


# ---- Links: one path from pulse to pulse ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Contact:
    """Amplitude stability of a path from pulse to pulse.

    Attributes
    ----------
    name
        Name of the path, for messages.
    scatter_db
        Amplitude scatter in excess of noise, rms; 0 if not significant.
    moves_db
        Largest amplitude difference between eighths of the recording; 0 if not significant.
    dropouts, pulses
        Number of pulses without lock or 6 dB below the median; number of all pulses.
    snr_db
        SNR of a compressed pulse.
    """

    name: str
    scatter_db: float
    moves_db: float
    dropouts: int
    pulses: int
    snr_db: float

    @classmethod
    def of(cls, name: str, amplitude: Floats, noise: float, pulses: int) -> "Contact":
        """Return the stability from (pulse,) amplitudes of locked pulses and their relative noise in I or Q."""
        median = float(np.median(amplitude))
        rms, snr_db = float(np.std(amplitude)) / median, -20 * np.log10(np.sqrt(2) * noise)
        threshold = 1 + SIGMAS * np.sqrt(2 / len(amplitude))
        scatter = np.sqrt(rms**2 - noise**2) if rms**2 > threshold * noise**2 else 0.0
        low = int((amplitude < median * 10 ** (DROPOUT_DB / 20)).sum())
        # on a weak path, noise alone causes amplitudes below this level
        lost = pulses - len(amplitude) + (low if snr_db > 2 * WEAK_DB else 0)
        parts = np.array([np.median(part) for part in np.array_split(amplitude, _PARTS) if part.size])
        relative_range = float(np.ptp(parts)) / median
        # the error of a median is 1.25 times that of a mean, the error of a difference √2 times that
        local = float(np.std(np.diff(amplitude))) / np.sqrt(2) / median  # scatter without slow changes
        threshold = SIGMAS * np.sqrt(2) * 1.25 * max(noise, local) / np.sqrt(max(len(amplitude) / _PARTS, 1))
        moves_db = float(20 * np.log10(1 + relative_range)) if relative_range > threshold else 0.0
        return cls(name, float(20 * np.log10(1 + scatter)), moves_db, lost, pulses, float(snr_db))

    @property
    def flags(self) -> dict[str, str]:
        """Flag for an unsteady amplitude."""
        is_steady = max(self.scatter_db, self.moves_db) <= AMPLITUDE_DB
        if self.dropouts <= DROPOUT_SHARE * self.pulses and is_steady:
            return {}
        return {"contact_intermittent": f"{self.name}: {self.line}"}

    @property
    def line(self) -> str:
        """Measured values, one line."""
        return (
            f"amplitude scatter {self.scatter_db:.2f} dB rms in excess of noise, slow change {self.moves_db:.2f} dB, "
            f"{self.dropouts} of {self.pulses} pulses lost or 6 dB below the median"
        )


def measure_contact(name: str, form: Callable[[Pulses], Complexes], pulses: int) -> Contact | None:
    """Measure the amplitude stability of the strongest path of a channel; None if fewer than two pulses lock.

    The captures need not start at a common delay.

    Parameters
    ----------
    name, form
        As for `measure_link`.
    pulses
        Number of pulses.
    """
    blocks = [form(block) for block in blocks_of(np.arange(pulses))]
    paths = joined([fit_block(block)[0] for block in blocks])
    if paths.locked.sum() < 2:
        return None
    amplitude = paths.amplitude[paths.locked]
    # noise of the path's amplitude from N subcarriers; the median over pulses is more accurate than a single estimate
    noise = float(np.median(paths.noise_power[paths.locked])) / blocks[0].shape[1]
    return Contact.of(name, amplitude, float(np.sqrt(noise / 2) / np.median(amplitude)), pulses)


@dataclass(frozen=True)
class Arrival:
    """Arrival in addition to the strongest path: path (metres) and level (dB) relative to the strongest path."""

    later_m: float
    level_db: float


@dataclass(frozen=True, eq=False)
class MeasuredLink:
    """Measurements of the strongest path of a channel over all pulses.

    Attributes
    ----------
    name
        Name of the link, for messages.
    time_s
        (pulse,) float64, seconds, of locked pulses.
    pulses
        Number of pulses of the link, locked or not.
    path_m, path_std_m
        Electrical length, metres of total path in vacuum, relative to the start of the capture or, after division by
        the sidelink, to the sidelink; and standard deviation of its mean, from the scatter of the pulses.
    cell_m
        Range cell c/B of total path.
    frequency_hz
        Band centre.
    terms
        (pulse,) complex128, pulses compressed at `path_m`, the contributions to an image.
    noise
        Mean noise power of a term.
    arrivals
        Further arrivals, strongest first.
    direct_db
        Level at the delay of the sidelink relative to the strongest path, dB; None if the strongest path has that delay
        or the level is not significant.
    mean
        (subcarrier,) complex128, mean of the pulses.
    jumped, jump_m
        Number of pulses locked at a different delay, and median path difference of these pulses, metres.
    interference
        Noise of the subcarriers relative to their neighbours.
    delay_ps
        (pulse,) float64, delay relative to the median, ps.
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
    interference: Interference
    delay_ps: Floats = field(repr=False)

    @property
    def profile(self) -> tuple[Floats, Floats]:
        """(cell,) total paths about the strongest path, ascending, metres; levels of the mean profile there, dB."""
        cells = self.mean.size
        later = np.arange(cells) - cells // 2
        start = -(cells - 1) / 2 * self.path_m / self.cell_m / cells
        cycles = np.arange(cells) * self.path_m / self.cell_m / cells + start
        power = np.abs(fft.ifft(self.mean * np.exp(2j * np.pi * cycles))) ** 2
        level_db: Floats = 10 * np.log10(np.maximum(power[later] / power[0], 1e-12))
        path_m: Floats = np.asarray(self.path_m + later * self.cell_m, np.float64)
        return path_m, level_db

    @property
    def coherence(self) -> float:
        """Coherence factor Γ over the pulses."""
        return coherence_factor(self.terms)

    @property
    def snr(self) -> float:
        """Signal-to-noise ratio of a term."""
        power = float((np.abs(self.terms) ** 2).mean())
        return max(power - self.noise, 1e-30) / max(self.noise, 1e-30)

    @property
    def coherence_limit(self) -> float:
        """Expected Γ at the given noise, eq. 4."""
        return (self.snr + 1 / len(self.terms)) / (self.snr + 1)

    @property
    def coherence_std(self) -> float:
        """Standard deviation of Γ due to noise, eq. 5."""
        return (1 - self.coherence_limit) / float(np.sqrt(max(len(self.terms) - 1, 1)))

    @property
    def noise_rad(self) -> float:
        """Phase noise expected at the measured SNR, rms."""
        return float(np.sqrt(1 / (2 * self.snr)))

    @property
    def phase_rad(self) -> Floats:
        """(pulse,) phase relative to the mean of all pulses, unwrapped from pulse to pulse."""
        return np.unwrap(np.angle(self.terms * np.conj(self.terms.mean())))

    @property
    def phase_excess_rad(self) -> float:
        """Phase noise in excess of that expected at the SNR, rms about a straight line; 0 if not significant."""
        residual = self.phase_rad - np.polyval(self._line(self.phase_rad)[0], self._centred_s)
        rms, allowed = float(np.sqrt(np.mean(residual**2))), self.noise_rad
        threshold = 1 + SIGMAS * np.sqrt(2 / len(residual))
        return float(np.sqrt(rms**2 - allowed**2)) if rms**2 > threshold * allowed**2 else 0.0

    @property
    def phase_drift_rad(self) -> tuple[float, float]:
        """Phase change over the recording from a linear fit, and its standard deviation."""
        (slope, _), std = self._line(self.phase_rad)
        return slope * self.lasts_s, std * self.lasts_s

    @property
    def delay_drift_ps(self) -> tuple[float, float]:
        """Delay change over the recording from a linear fit, and its standard deviation."""
        (slope, _), std = self._line(self.delay_ps)
        return slope * self.lasts_s, std * self.lasts_s

    @property
    def lasts_s(self) -> float:
        """Duration of the recording, seconds."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def contact(self) -> "Contact":
        """Amplitude stability of the path."""
        return Contact.of(self.name, np.abs(self.terms), self.noise_rad, self.pulses - self.jumped)

    @property
    def _centred_s(self) -> Floats:
        return self.time_s - float(self.time_s.mean())

    def _line(self, values: Floats) -> tuple[tuple[float, float], float]:
        """Return slope and level of a linear fit, and the standard deviation of the slope."""
        time = self._centred_s
        squares = float((time**2).sum()) or 1.0
        slope, level = float(time @ values) / squares, float(values.mean())
        scatter = float(np.sqrt(((values - level - slope * time) ** 2).sum() / max(len(values) - 2, 1)))
        return (slope, level), scatter / np.sqrt(squares)

    def deviation(self, interval_s: float) -> list[tuple[float, float]]:
        """Return averaging times, s, and overlapping Allan deviations of the link's delay, from its phase; eq. 6.

        Parameters
        ----------
        interval_s
            Pulse interval, seconds; differences that involve a missing pulse are omitted.
        """
        index = np.round((self.time_s - self.time_s[0]) / interval_s).astype(np.int64)
        error_s = np.full(int(index[-1]) + 1, np.nan)
        error_s[index] = self.phase_rad / (2 * np.pi * self.frequency_hz)
        deviations, step = [], 1
        while 2 * step < len(error_s):
            second = error_s[2 * step :] - 2 * error_s[step:-step] + error_s[: -2 * step]
            second = second[np.isfinite(second)]
            if len(second) < _FEWEST_DIFFERENCES:
                break
            deviations.append((step * interval_s, float(np.sqrt(np.mean(second**2) / 2)) / (step * interval_s)))
            step *= 2
        return deviations

    @property
    def flags(self) -> dict[str, str]:
        """Flag → measured values for exceeded limits."""
        flags, snr_db = {}, decibels(self.snr)
        if snr_db < WEAK_DB:
            flags["link_weak"] = f"{self.name}: SNR {snr_db:.1f} dB in a compressed pulse"
        if self.jumped > MISSED_SHARE * self.pulses and snr_db > WEAK_DB:
            flags["delay_jumps"] = (
                f"{self.name}: the path of {self.jumped} of {self.pulses} pulses differs by {self.jump_m:+.2f} m from "
                "the path of the other pulses; these pulses are excluded from all other measurements"
            )
        if self.interference.description:
            flags["interference"] = f"{self.name}: {self.interference.description}"
        excess = self.phase_excess_rad
        is_random = 1 - self.coherence > 0.5 > 1 - self.coherence_limit
        if excess > PHASE_RAD or is_random:
            flags["link_incoherent"] = (
                f"{self.name}: Γ {self.coherence:.5f}, {self.coherence_limit:.5f} expected from noise; phase scatter "
                f"{excess:.2g} rad rms in excess of noise"
            )
        drift, std = self.phase_drift_rad
        if abs(drift) > max(PHASE_RAD, SIGMAS * std) and not is_random:
            delay_ps, delay_std_ps = self.delay_drift_ps
            flags["link_drifts"] = (
                f"{self.name}: phase drift {drift:+.3f} ± {std:.3f} rad in {self.lasts_s:.3g} s, delay drift "
                f"{delay_ps:+.1f} ± {delay_std_ps:.1f} ps"
            )
        if self.direct_db is not None and self.direct_db > LEAKAGE_DB:
            flags["channel_crosstalk"] = (
                f"{self.name}: the sidelink signal arrives at {self.direct_db:.1f} dB relative to the strongest path"
            )
        return Flags.merged(flags, self.contact.flags)


_FEWEST_DIFFERENCES = 8  # minimum number of second differences for an Allan deviation
_PARTS = 8  # parts of a recording whose amplitudes are compared
_SHOWN = 4  # number of reported arrivals
_HANN_STD = 1.51  # ratio of the standard deviations of a delay fitted with and without a Hann window (measured)
_STANDS_OUT = 20.0  # minimum power of an arrival relative to the noise of the mean profile: 13 dB


def measure_link(
    name: str,
    form: Callable[[Pulses], Complexes],
    time_s: Floats,
    numerology: Numerology,
    *,
    divided: bool,
    prefix_cells: int | None = None,
    noise_gain: Floats | float = 1.0,
) -> MeasuredLink | None:
    """Measure the strongest path of a channel over all pulses; None if fewer than two pulses lock.

    Parameters
    ----------
    name
        Name of the link, for messages.
    form
        Function of pulse numbers that returns transfer functions, (pulse, subcarrier) complex64.
    time_s
        (pulse,) float64, transmission times, seconds.
    numerology
        Numerology of the symbol.
    divided
        True if transfer functions are divided by the sidelink, whose delay is then zero.
    prefix_cells
        Largest delay in cells; None permits delays of either sign up to half of all cells.
    noise_gain
        (subcarrier,) float64, mean of 1/|c|² over the pulses, by which the code shapes white noise.

    Notes
    -----
    Source: docs/theory/bench.md, eq. 3 to 5.

    Examples
    --------
    >>> rng, numerology = np.random.default_rng(1), Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> noise = 0.1 * (rng.normal(size=(50, 32)) + 1j * rng.normal(size=(50, 32)))
    >>> echo = (np.exp(-2j * np.pi * np.arange(32) * 3.25 / 32) + noise).astype(np.complex64)
    >>> link = measure_link("a", lambda block: echo[block], np.arange(50.0), numerology, divided=False)
    >>> round(link.path_m / link.cell_m, 2), round(10 * np.log10(link.snr)), link.flags
    (3.25, 32, {})
    """
    count, subcarriers = len(time_s), numerology.numbers.size
    cell_m = SPEED_OF_LIGHT_M_S / (subcarriers * numerology.spacing_hz)
    numbers = np.arange(count)
    # 1. Delay, phase and amplitude of each pulse's direct path by maximum likelihood.
    paths: LineOfSight = joined([fit_block(form(block))[0] for block in blocks_of(numbers)])
    locked = paths.locked
    if locked.sum() < 2:
        return None
    # 2. One delay for all pulses: the median of delays relative to the first, modulo the length of the profile.
    first = float(paths.delay_cells[locked][0])
    relative = (paths.delay_cells - first + subcarriers / 2) % subcarriers - subcarriers / 2
    #    If pulses lock at several delays, the most frequent delay is used, because a median might lie between them.
    ordered = np.sort(relative[locked])
    in_cell = np.searchsorted(ordered, ordered + 1.0, side="right") - np.arange(ordered.size)  # pulses within a cell
    most = int(in_cell.argmax())
    middle = float(np.median(ordered[most : most + in_cell[most]]))
    delay = first + middle
    jumped = locked & (np.abs(relative - middle) > 1.0)
    jump_m = float(np.median(relative[jumped] - middle)) * cell_m if jumped.any() else 0.0
    locked = locked & ~jumped
    if locked.sum() < 2:
        return None
    if prefix_cells is not None:
        delay %= subcarriers
    # 3. Value of every pulse at this delay, its contribution to an image; noise from pulse-to-pulse changes of cells.
    align = phasors(np.array([delay / subcarriers]), subcarriers, first=-(subcarriers - 1) / 2)
    power, total = np.zeros(subcarriers), np.zeros(subcarriers, np.complex128)
    terms = np.zeros(count, np.complex128)
    for block in blocks_of(numbers[locked]):
        aligned = form(block) * align
        profile = fft.ifft(aligned, axis=1).astype(np.complex128)
        terms[block] = profile[:, 0]
        power += (np.abs(profile) ** 2).sum(axis=0)
        total += profile.sum(axis=0)
    used = int(locked.sum())
    changes = (power - np.abs(total) ** 2 / used) / (used - 1)
    # for few pulses, the median over cells of a mean of exponential variables is below its expectation
    noise = float(np.median(changes)) / (1 - 1 / (9 * (used - 1))) ** 3
    mean = total / used
    scatter = float(np.std(relative[locked]))
    groups, white = sampled_pulses(used), 1 / np.sqrt(noise_gain)
    sampled = runs(groups, [form(numbers[locked][group]) * white for group in groups])
    interference = Interference.measured(sampled, numerology.frequency_hz, np.full(subcarriers, 1 / subcarriers))
    direct = _at_sidelink(mean, delay, noise / used) if divided else None
    # 4. Path from the mean under a Hann window; otherwise sidelobes of other arrivals displace the path by millimetres.
    windowed = (fft.fft(mean) * np.hanning(subcarriers)).astype(np.complex64)
    path_m = (delay + float(fit_block(windowed[None])[0].delay_cells[0])) * cell_m
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
        int(jumped.sum()),
        jump_m,
        interference,
        (relative[locked] - middle) * cell_m / SPEED_OF_LIGHT_M_S * 1e12,
    )


def _arrivals(mean: NDArray[np.complex128], noise: float, cell_m: float) -> tuple[Arrival, ...]:
    """Return significant arrivals of the mean profile other than the path, which lies in cell 0."""
    power, cells = np.abs(mean) ** 2, mean.size
    peaks = (power > np.roll(power, 1)) & (power >= np.roll(power, -1)) & (power > _STANDS_OUT * noise)
    later = np.arange(cells)
    later = np.where(later >= cells / 2, later - cells, later)
    peaks &= np.abs(later) > 2  # exclude the main lobe of the path
    best = np.flatnonzero(peaks)[np.argsort(-power[peaks])][:_SHOWN]
    return tuple(Arrival(float(later[cell] * cell_m), decibels(power[cell] / power[0])) for cell in best)


def _at_sidelink(mean: NDArray[np.complex128], delay_cells: float, noise: float) -> float | None:
    """Return the level at zero delay relative to the path, dB; None if the delays are similar or the level is noise."""
    if abs(delay_cells) < APART_CELLS:
        return None
    near = np.abs(mean[(round(-delay_cells) + np.arange(-1, 2)) % mean.size]) ** 2
    level = float(near.max())
    return decibels(level / float(np.abs(mean[0]) ** 2)) if level > _STANDS_OUT * noise else None


# ---- Clocks, paths, and two channels of one signal ------------------------------------------------------------------


def clock_flags(name: str, clock: ClockOffset, numerology: Numerology, pulses: int) -> dict[str, str]:
    """Return flags of a receiver's clock relative to the transmitter's clock: no common reference, or drift.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> sorted(clock_flags("b", ClockOffset(2e3, 0.0, 2.0, 5.0, 0.01, one_clock=True), numerology, 100))
    ['clock_unlocked']
    """
    ppm, std = clock.ppm(numerology)
    flags, drift_ppm = {}, clock.cfo_slope_hz * pulses / numerology.carrier_hz * 1e6
    if abs(ppm) > UNLOCKED_PPM + SIGMAS * (std or 0.0):
        flags["clock_unlocked"] = f"{name}: {ppm:+.3f} ± {std or 0.0:.3f} ppm relative to the transmitter's clock"
    if abs(drift_ppm) > DRIFT_PPM:
        flags["clock_drifts"] = f"{name}: the clock drifts by {drift_ppm:+.3f} ppm over the recording"
    return flags


@dataclass(frozen=True)
class BenchPathOffset:
    """Electrical path of a link in excess of the geometric path of the set-up, metres of total path.

    Attributes
    ----------
    offset_m, std_m
        Measured path offset, and its standard deviation due to noise.
    stated_m
        Configured path offset.
    cell_m
        Range cell c/B.
    """

    offset_m: float
    std_m: float
    stated_m: float
    cell_m: float

    def flags(self, name: str) -> dict[str, str]:
        """Return a flag if the measured and the configured path offset disagree."""
        difference_m = self.offset_m - self.stated_m
        if abs(difference_m) <= max(PATH_CELLS * self.cell_m, SIGMAS * self.std_m):
            return {}
        return {
            "path_offset_disagrees": f"{name}: path offset {self.offset_m:+.3f} ± {self.std_m:.3f} m measured, "
            f"{self.stated_m:+.3f} m configured"
        }


def reversed_flags(link: MeasuredLink, expected_m: float | None) -> dict[str, str]:
    """Return a flag if echoes of a link arrive before its sidelink signal, unless the set-up explains this."""
    early_m = link.path_m
    if early_m > -APART_CELLS / 2 * link.cell_m or (expected_m is not None and expected_m < 0):
        return {}
    return {"channels_swapped": f"{link.name}: the strongest echo arrives {-early_m:.2f} m before the sidelink"}


@dataclass(frozen=True)
class SplitAgreement:
    """Differences between two channels fed by one signal, the second relative to the first.

    Attributes
    ----------
    gain_db
        Ratio of amplitudes.
    path_m
        Difference of electrical paths, metres.
    phase_rad, phase_std_rad
        Phase difference at the band centre in excess of that of the path difference, and its standard deviation.
    band_rad, band_db
        Rms phase and amplitude differences over the band in excess of the path difference and noise.
    """

    gain_db: float
    path_m: float
    phase_rad: float
    phase_std_rad: float
    band_rad: float
    band_db: float

    def flags(self, name: str) -> dict[str, str]:
        """Return a flag if the channels differ by more than the limits for channels fed by one signal."""
        differs = abs(self.phase_rad) > max(SPLIT_RAD, SIGMAS * self.phase_std_rad)
        if not differs and abs(self.gain_db) <= SPLIT_DB and self.band_rad <= SPLIT_RAD and self.band_db <= SPLIT_DB:
            return {}
        return {
            "splitter_channels_differ": f"{name}: gain {self.gain_db:+.2f} dB, phase {self.phase_rad:+.3f} ± "
            f"{self.phase_std_rad:.3f} rad; over the band {self.band_db:.2f} dB and {self.band_rad:.3f} rad rms"
        }


def split_agreement(first: MeasuredLink, second: MeasuredLink) -> SplitAgreement:
    """Compare two links that are fed by one signal; eq. 7 of docs/theory/bench.md.

    Examples
    --------
    >>> rng, numerology = np.random.default_rng(1), Numerology(1e9, 64e6, np.arange(32), 16, 64)
    >>> echo = (np.ones((9, 32)) + 1e-3 * rng.normal(size=(9, 32))).astype(np.complex64)
    >>> first, second = (
    ...     measure_link("a", lambda block, gain=gain: gain * echo[block], np.arange(9.0), numerology, divided=False)
    ...     for gain in (1, np.complex64(2j)))
    >>> agreement = split_agreement(first, second)
    >>> round(agreement.gain_db, 1), round(agreement.phase_rad, 2)
    (6.0, 1.57)
    """
    weight = np.abs(first.mean) * np.abs(second.mean)
    ratio = (second.mean * np.conj(first.mean) / np.maximum(weight, 1e-30)).astype(np.complex64)
    path, _ = fit_block(ratio[None])
    delay_s = float(path.delay_cells[0]) * first.cell_m / SPEED_OF_LIGHT_M_S
    path_rad = 2 * np.pi * first.frequency_hz * delay_s
    phase = float(np.angle(np.exp(1j * (float(path.phase_rad[0]) + path_rad))))
    std_s = np.hypot(first.path_std_m, second.path_std_m) / SPEED_OF_LIGHT_M_S
    return SplitAgreement(
        float(20 * np.log10(np.abs(second.terms).mean() / np.abs(first.terms).mean())),
        delay_s * SPEED_OF_LIGHT_M_S,
        phase,
        float(np.hypot(2 * np.pi * first.frequency_hz * std_s, np.sqrt(1 / len(first.terms)) * first.noise_rad)),
        *_over_the_band(first, second),
    )


_GROUP_NOISE = 0.005  # rad², phase noise of a group of subcarriers, small enough for the linear noise prediction


def _over_the_band(first: MeasuredLink, second: MeasuredLink) -> tuple[float, float]:
    """Return the rms phase (rad) and amplitude (dB) differences of two links over the band in excess of noise.

    Subcarriers are averaged in groups whose size depends on the noise; the scatter is 0 for fewer than four groups.
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
    residual = np.angle(ratio * np.conj(ratio.sum()))
    size_db = 20 * np.log10(np.maximum(np.abs(flat[1]), 1e-30) / np.maximum(np.abs(flat[0]), 1e-30))
    by_noise = (1 + SIGMAS * np.sqrt(2 / groups)) * noise * groups / subcarriers
    return (
        float(np.sqrt(max(0.0, float(np.mean(residual**2)) - by_noise))),
        float(np.sqrt(max(0.0, float(np.var(size_db)) - by_noise * (20 / np.log(10)) ** 2))),
    )


def _band_noise(link: MeasuredLink) -> float:
    """Return the phase variance due to noise of a subcarrier in a link's mean transfer function, rad²."""
    return link.noise * link.mean.size / len(link.terms) / (2 * float(np.mean(np.abs(link.mean) ** 2)))
