"""Transmitted signal of a campaign: code symbols or samples of a pulse, and the preamble of each symbol."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG, OfdmWaveform, Processing, PulseWaveform, SampledWaveform, SidelinkCodes
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.echo.constellation import Constellation, constellation
from apertura.core.echo.demodulate import Numerology, subcarrier_numbers
from apertura.core.echo.frame_codes import Inverses, PnCodes, Rows, pn_sequence, sampled_rows
from apertura.core.echo.frame_format import FrameFormat
from apertura.core.echo.pulse_filter import occupied_band, pulse_filter, pulse_spectrum
from apertura.core.echo.symbol_filter import (
    CONSTANT_DB,
    FilterChoice,
    SymbolFilter,
    choose_filter,
    echo_snr,
    tolerated_sidelobes_db,
)
from apertura.core.echo.trigger import PulseFraming
from apertura.core.echo.unknown_symbols import Pilots
from apertura.formats.code_tables import MOST_SYMBOLS, CodeTable
from apertura.formats.npy import read_npy
from apertura.formats.recordings.sample_file import SampleFile

# ---- Band limits of real samples ------------------------------------------------------------------------------------


def check_mixing(samples: SampleFile, numerology: Numerology, *, where: object) -> None:
    """Check the mixing of real samples; raise CampaignError for a mirror image in the band or too short a prefix.

    Parameters
    ----------
    samples
        Sample file of a recording; complex samples always pass.
    numerology
        Numerology of the symbol.
    where
        Recording, for the message.
    """
    mixing = samples.layout.mixing
    if mixing is None:
        return
    low_hz, high_hz = (float(numerology.frequency_hz[end]) - numerology.carrier_hz for end in (0, -1))
    problem = mixing.problem(low_hz, high_hz, numerology.prefix_samples)
    if problem:
        raise CampaignError(
            problem,
            where=where,
            expected="apertura:if_hz and waveform with the whole band within one Nyquist zone",
            remedy="Correct apertura:if_hz (frequency of baseband zero before aliasing) or the waveform.",
        )


# ---- Transmitted signal: code symbols or samples of a pulse ----------------------------------------------------------

MOST_PULSE_SAMPLES = 1 << 22
"""Largest number of samples of a pulse, and of a capture."""

MOST_CHIPS = 1 << 20
"""Largest number of chips of a preamble."""

MOST_LEAD_SAMPLES = 1 << 26
"""Largest number of samples of preamble, counter and guard before a symbol."""

_FEWEST_BINS = 16  # frequency bins of a band
_LEAST_INSIDE = 0.01  # smallest fraction of the pulse's energy within the band


@dataclass(frozen=True, eq=False)
class Transmitted:
    """Transmitted signal for echo processing, of any kind of waveform.

    Attributes
    ----------
    waveform
        Configured waveform.
    numerology
        Grid of the frequencies at which echoes are measured.
    inverses
        Inverse filters of the transmitted pulses.
    mean_power
        E|s|² during transmission, in the units by which echoes are divided: of a symbol, or of a pulse with peak 1;
        the mean over the rows of a code table.
    power
        (row, subcarrier) float32, |c_n|² in sampled rows of a code table; None for a pulse.
    spectrum
        (1, subcarrier) complex64, spectrum of a pulse; None for symbols, whose inverse filter is the reciprocal.
    report, flags
        Report and flags of the inverse filter.
    unknown
        Format of symbols that are decided from a sidelink; `inverses` are then those of random symbols until
        `apertura.stages.symbols.with_symbols` replaces them. None: the symbols are known.
    """

    waveform: SampledWaveform
    numerology: Numerology
    inverses: Inverses
    mean_power: float
    report: dict[str, Any] = field(default_factory=dict)
    flags: dict[str, str] = field(default_factory=dict)
    power: NDArray[np.float32] | None = None
    spectrum: Complexes | None = None
    unknown: "UnknownSymbols | None" = None

    def filter_choice(
        self, processing: Processing, frames: NDArray[np.int64], window: Floats
    ) -> Callable[[Complexes | None, float], FilterChoice] | None:
        """Return the choice of the filter from a sample of transfer functions, None before they are measured.

        Its second argument is the SNR of a sidelink by which they are divided, as of `SymbolFilter.loss`.
        For symbols of constant modulus, there is no choice, and None is returned.

        Parameters
        ----------
        processing
            Settings, of which symbol filter and accuracy are used.
        frames
            (pulse,) int64, frame numbers of the flight.
        window
            (subcarrier,) float64, window of the range compression.
        """
        if self.power is None or decibels(SymbolFilter().noise_gain(self.power)) < CONSTANT_DB:
            return None
        power, different = self.power, len(np.unique(frames % self.inverses.count))

        def choose(sample: Complexes | None, divided_snr: float) -> FilterChoice:
            return choose_filter(
                power,
                requested=processing.symbol_filter,
                snr=np.inf if sample is None else echo_snr(sample, power),
                frames=different,
                tolerated_db=tolerated_sidelobes_db(processing.accuracy_db),
                window=window,
                divided_snr=divided_snr,
            )

        return choose


@dataclass(frozen=True, eq=False)
class UnknownSymbols:
    """Format of symbols that are decided from a sidelink.

    Attributes
    ----------
    constellation
        Constellation of the data symbols.
    pilots
        Known symbols; None: there are no pilots.
    frames
        Format of the bits; None: not configured.
    """

    constellation: Constellation
    pilots: Pilots | None
    frames: FrameFormat | None

    @property
    def unambiguous(self) -> bool:
        """True if pilots or a header determine the phase of the symbols."""
        return self.pilots is not None or self.frames is not None

    @classmethod
    def of(cls, codes: SidelinkCodes, subcarriers: int, pilots: Path | None) -> "UnknownSymbols":
        """Return the configured format; raise CampaignError if pilots or frame do not fit the symbol."""
        qam, known, frames = constellation(codes.constellation), None, None
        count = subcarriers
        if pilots is not None:
            expected = f"({subcarriers},) complex64, 0 at data symbols, for {CONFIG}: waveform.subcarriers"
            remedy = "Write the transmitted pilots, or remove waveform.codes.pilots."
            if not pilots.is_file():
                raise CampaignError("no such file", pilots, expected, "Copy the file there.")
            table = read_npy(pilots, kinds="c", most=MOST_SYMBOLS, expected=expected, remedy=remedy)
            if table.shape != (subcarriers,):
                raise CampaignError(f"{table.dtype} of shape {table.shape}", pilots, expected, remedy)
            known = Pilots.of(table.astype(np.complex64), pilots)
            count -= known.symbols.size
        if codes.frame is not None:
            header = np.unpackbits(np.frombuffer(bytes.fromhex(codes.frame.header), np.uint8))
            frames = FrameFormat(header, codes.frame.counter_bits, codes.frame.crc, count * qam.bits_per_symbol)
            if frames.data_bits < 0 or frames.known_labels(qam).size < FEWEST_KNOWN:
                raise CampaignError(
                    f"header of {header.size} bits in a frame of {frames.total_bits} bits, of which "
                    f"{frames.data_bits} are left for data",
                    where=f"{CONFIG}: waveform.codes.frame",
                    expected=f"a header of at least {FEWEST_KNOWN} symbols, and room for data",
                    remedy="Correct header and counter_bits.",
                )
        return cls(qam, known, frames)


FEWEST_KNOWN = 4
"""Fewest symbols of a header, from which the phase of blind decisions is determined."""


def transmitted(campaign: Campaign, waveform: SampledWaveform) -> Transmitted:
    """Return the transmitted signal, from a waveform and the campaign's file of codes or samples.

    For a flight plan without that file, codes of equal power or a linear chirp over the band are assumed.

    Raises
    ------
    CampaignError
        If the file is missing or contradicts the waveform.
    """
    path = campaign.sent_path
    assumes = campaign.planned and path is not None and not path.exists()
    if isinstance(waveform, OfdmWaveform) and isinstance(waveform.codes, SidelinkCodes):
        unknown = UnknownSymbols.of(waveform.codes, waveform.subcarriers, None if assumes else path)
        points = unknown.constellation.points
        # of the same distribution as the symbols, for averages over pulses
        typical = np.random.default_rng(0).permutation(np.resize(points, 64 * waveform.subcarriers)).reshape(64, -1)
        return Transmitted(
            waveform,
            symbol_numerology(waveform),
            Inverses.of_codes(typical),
            float(waveform.subcarriers),
            power=np.square(np.abs(typical)),
            unknown=unknown,
        )
    if isinstance(waveform, OfdmWaveform):
        codes = np.ones((1, waveform.subcarriers), np.complex64) if assumes else _code_table(waveform, path)
        power = np.abs(codes[sampled_rows(codes.shape[0])]) ** 2
        mean_power = float(power.sum(axis=1).mean())
        return Transmitted(
            waveform, symbol_numerology(waveform), Inverses.of_codes(codes), mean_power, power=power.astype(np.float32)
        )
    if isinstance(waveform, PulseWaveform) and path is not None:
        pulse = _chirp(waveform) if assumes else read_pulse(path, waveform)
        return transmitted_pulse(pulse, waveform, where=path)
    raise TypeError(f"no inverse filter for a {type(waveform).__name__}")


def _code_table(waveform: OfdmWaveform, path: Path | None) -> Rows:
    """Return the table of the code symbols: in a file, or generated."""
    codes = waveform.codes
    if isinstance(codes, SidelinkCodes):
        raise TypeError("symbols from a sidelink are not a table")
    if isinstance(codes, str):
        return CodeTable(Path() if path is None else path, waveform.subcarriers)
    try:
        sequence = pn_sequence(codes.polynomial, codes.seed)
    except ValueError as problem:
        raise CampaignError(
            str(problem),
            where=f"{CONFIG}: waveform.codes",
            expected="exponents of a primitive polynomial, and a seed below 2^degree",
            remedy="Use the polynomial and the seed of the transmitter.",
        ) from problem
    return PnCodes(sequence, codes.constellation, waveform.subcarriers, codes.frames)


def symbol_numerology(waveform: OfdmWaveform) -> Numerology:
    """Return the numerology of an OFDM symbol at the receiver's sample rate."""
    return Numerology(
        waveform.carrier_hz,
        waveform.sample_rate_hz,
        subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is),
        prefix_samples=waveform.prefix_samples,
        dft_samples=waveform.dft_samples,
    )


def _chirp(waveform: PulseWaveform) -> NDArray[np.complex128]:
    """Return a linear chirp over the configured band; without a configured band, over 0.8 of the sample rate."""
    half = 0.4 * waveform.sample_rate_hz
    low, high = waveform.band_hz or (-half, half)
    time = np.arange(round(waveform.pulse_s * waveform.sample_rate_hz)) / waveform.sample_rate_hz
    return np.asarray(np.exp(2j * np.pi * (low * time + (high - low) / waveform.pulse_s * time**2 / 2)))


def transmitted_pulse(pulse: NDArray[np.complex128], waveform: PulseWaveform, *, where: Path) -> Transmitted:
    """Return a single transmitted pulse: DFT over the whole capture, and its filter (docs/theory/waveforms.md)."""
    length = waveform.capture_samples
    lead = waveform.lead_s * waveform.sample_rate_hz
    spectrum = pulse_spectrum(pulse, lead=lead, length=length)
    power = np.abs(spectrum) ** 2
    if waveform.band_hz is None:
        first, last = occupied_band(power)
    else:
        spacing_hz = waveform.sample_rate_hz / length
        first = int(np.ceil(waveform.band_hz[0] / spacing_hz - 1e-6))
        last = min(int(np.floor(waveform.band_hz[1] / spacing_hz + 1e-6)), first + length - 1)
    numbers = np.arange(first, last + 1)
    inside = float(power[numbers % length].sum() / power.sum())
    if numbers.size < _FEWEST_BINS or inside < _LEAST_INSIDE:
        raise CampaignError(
            f"the band contains a fraction {inside:.2g} of the pulse's energy in {max(numbers.size, 0)} bins of "
            f"{waveform.sample_rate_hz / length:g} Hz",
            where=where,
            expected=f"at least a fraction {_LEAST_INSIDE} of the energy, in at least {_FEWEST_BINS} bins of {CONFIG}: "
            "waveform.band_hz",
            remedy="Correct band_hz (baseband frequencies, relative to the carrier), or the file.",
        )
    chosen = pulse_filter(spectrum[numbers % length], requested=waveform.filter)
    longest = length - round((waveform.lead_s + waveform.pulse_s) * waveform.sample_rate_hz)
    numerology = Numerology(waveform.carrier_hz, waveform.sample_rate_hz, numbers, 0, length, longest)
    band_hz = [float(number * numerology.spacing_hz) for number in (first, last)]
    report = {**chosen.report, "band_hz": band_hz, "energy_inside": round(inside, 4)}
    mean_power = float((np.abs(pulse) ** 2).mean())
    inverses, inside_band = Inverses.fixed(chosen.inverse), spectrum[numbers % length].astype(np.complex64)[None]
    return Transmitted(waveform, numerology, inverses, mean_power, report, chosen.flags, spectrum=inside_band)


def read_pulse(path: Path, waveform: PulseWaveform) -> NDArray[np.complex128]:
    """Read a transmitted pulse, (sample,) complex128.

    Raises
    ------
    CampaignError
        If the file is missing, its length is not waveform.pulse_s, or its samples are all zero or not finite.
    """
    count = round(waveform.pulse_s * waveform.sample_rate_hz)
    expected = (
        f"({count},) complex or ({count}, 2) integers, for {CONFIG}: waveform.pulse_s times waveform.sample_rate_hz"
    )
    remedy = "Use the samples that were transmitted, or correct the waveform."
    if not path.is_file():
        raise CampaignError("no such file", where=path, expected=expected, remedy="Copy the file there.")
    stored = read_npy(path, kinds="ci", most=2 * MOST_PULSE_SAMPLES, expected=expected, remedy=remedy)
    if waveform.capture_samples > MOST_PULSE_SAMPLES:
        raise CampaignError(
            f"captures of {waveform.capture_samples} samples",
            where=f"{CONFIG}: waveform",
            expected=f"at most {MOST_PULSE_SAMPLES} in lead_s, pulse_s and listen_s",
            remedy="Shorten listen_s to the longest delay of the scene.",
        )
    pairs = stored.dtype.kind == "i" and stored.shape == (count, 2)
    if not (pairs or (stored.dtype.kind == "c" and stored.shape == (count,))):
        raise CampaignError(f"{stored.dtype} of shape {stored.shape}", where=path, expected=expected, remedy=remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite and NaN values are rejected below
        pulse = stored[:, 0] + 1j * stored[:, 1].astype(np.float64) if pairs else stored.astype(np.complex128)
        level = np.abs(pulse)
    invalid = int((~np.isfinite(level)).sum())
    if invalid or not level.max() > 0:
        problem = f"{invalid} samples are not finite" if invalid else "all samples are zero"
        raise CampaignError(problem, where=path, expected=expected, remedy=remedy)
    return np.asarray(pulse / level.max(), np.complex128)


def read_framing(path: Path, described: Mapping[str, Any], *, sample_rate_hz: float, where: Path) -> PulseFraming:
    """Read the preamble of each symbol.

    Parameters
    ----------
    path
        .npy file of the preamble's chips, ±1.
    described
        apertura:framing of the recorder's metadata.
    sample_rate_hz
        Complex samples per second.
    where
        Metadata file, for messages.

    Raises
    ------
    CampaignError
        If the file is missing, its values are not ±1, or the preamble is longer than `MOST_LEAD_SAMPLES`.
    """
    if not path.is_file():
        raise CampaignError(
            "no such file",
            where=path,
            expected=f"the preamble named in {where.name}: apertura:framing",
            remedy="Copy the file there.",
        )
    expected = f"a one-dimensional array of at most {MOST_CHIPS} chips, +1 or -1"
    remedy = "Save the preamble that was transmitted."
    chips = read_npy(path, kinds="if", most=MOST_CHIPS, expected=expected, remedy=remedy)
    if chips.ndim != 1 or not chips.size or not np.isin(chips, (-1, 1)).all():
        invalid = int((~np.isin(chips, (-1, 1))).sum())
        problem = f"{chips.dtype} of shape {chips.shape}, of which {invalid} are neither 1 nor -1"
        raise CampaignError(problem, where=path, expected=expected, remedy=remedy)
    keys = ("chip_samples", "centre_hz", "counter_bits", "bit_chips", "guard_samples")
    framing = PulseFraming(
        chips.astype(np.int64), sample_rate_hz=sample_rate_hz, **{key: described[key] for key in keys}
    )
    if framing.lead_samples > MOST_LEAD_SAMPLES:
        raise CampaignError(
            f"{framing.lead_samples} samples of preamble, counter and guard before each symbol",
            where=where,
            expected=f"at most {MOST_LEAD_SAMPLES}",
            remedy="Correct apertura:framing.",
        )
    return framing
