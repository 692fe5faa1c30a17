"""Unknown symbols of a sidelink: channel, decisions, error rates against theory, unsure pulses, ambiguity."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import CONSTELLATIONS, Constellation, constellation
from apertura.core.echo.decided_symbols import DecisionCheck, SidelinkSymbols
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.frame_format import FrameFormat
from apertura.core.echo.unknown_symbols import Decisions, Pilots, SymbolDecider

N, GROUP = 1024, 64


class Sidelink:
    """Sidelink of pulses with random symbols, clock phases and trigger delays, and one reflection."""

    def __init__(
        self,
        qam: Constellation,
        snr_db: float,
        *,
        reflection_db: float = -300.0,
        changing: bool = False,
        pulses: int = GROUP,
        pilots: Pilots | None = None,
    ) -> None:
        random = np.random.default_rng(7)
        number = np.arange(N) - (N - 1) / 2
        self.sent = random.integers(0, len(qam.points), (pulses, N))
        self.symbols = qam.points[self.sent]
        if pilots is not None:
            self.symbols[:, pilots.places] = pilots.symbols
        self.delay = random.uniform(-20, 20, (pulses, 1)) + 17.3
        self.phase = random.uniform(-np.pi, np.pi, (pulses, 1))
        turn = random.uniform(0, 2 * np.pi, (pulses, 1)) if changing else 1.1
        self.channel = 1 + 10 ** (reflection_db / 20) * np.exp(1j * turn - 2j * np.pi * number * 5.4 / N)
        path = 5 * self.channel * np.exp(1j * self.phase - 2j * np.pi * number * self.delay / N)
        noise = random.normal(scale=5 * np.sqrt(0.5 / 10 ** (snr_db / 10)), size=(pulses, N, 2)) @ [1, 1j]
        self.received = (path * self.symbols + noise).astype(np.complex64)
        self.numbers = np.arange(pulses)

    def decider(self, qam: Constellation, pilots: Pilots | None = None) -> SymbolDecider:
        """Return a decider with the mean channel of all pulses."""
        groups = [self.numbers[i : i + GROUP] for i in range(0, self.numbers.size, GROUP)]
        return SymbolDecider.measured([(group, self.received[group]) for group in groups], qam, pilots)

    def decisions(self, qam: Constellation) -> Decisions:
        """Return the blind decisions, without ambiguity by 16 known symbols."""
        decider = self.decider(qam)
        return decider.resolved(decider.decide(self.received, self.numbers), self.sent[:, :16])

    def error_rate(self, qam: Constellation, snr_db: float) -> float:
        """Return the theoretical symbol error rate, averaged over the channel."""
        snr = 10 ** (snr_db / 10) * np.abs(self.channel) ** 2
        return float(np.mean(qam.symbol_error_rate(snr)))


@pytest.mark.parametrize("name", CONSTELLATIONS)
@pytest.mark.parametrize("errors", [0.14, 0.02])
def test_decided_reference_has_the_gain_error_and_evm_of_the_closed_form(name: str, errors: float) -> None:
    """Gain, error and EVM of decisions in noise equal eqs. 4 and 5 within the scatter of the simulation."""
    qam, random, count = constellation(name), np.random.default_rng(3), 60_000
    snr = np.logspace(0, 4, 2001)
    snr = snr[np.argmin(np.abs(qam.symbol_error_rate(snr) - errors))]
    sent = random.integers(0, len(qam.points), count)
    received = qam.points[sent] + random.normal(scale=np.sqrt(0.5 / snr), size=(count, 2)) @ [1, 1j]
    decided = qam.points[qam.decide(received)]
    ratio = qam.points[sent] / decided
    theory = qam.decided(snr)
    assert np.mean(ratio) == pytest.approx(theory.gain, abs=5 * np.sqrt(theory.error / count))
    assert np.var(ratio) / abs(np.mean(ratio)) ** 2 == pytest.approx(theory.error, rel=0.1)
    assert np.sqrt(np.mean(np.abs(received - decided) ** 2)) == pytest.approx(theory.evm, rel=0.01)


@pytest.mark.parametrize("name", CONSTELLATIONS)
def test_decisions_lose_less_than_division_above_the_least_snr_only(name: str) -> None:
    """Eq. 7: adequate at the least SNR, inadequate 0.2 dB below; the error is below that of division up to 40 dB."""
    qam = constellation(name)

    def adequate(snr: float) -> bool:
        decided = qam.decided(snr)
        return 20 * np.log10(decided.gain) >= -0.2 and decided.error <= qam.noise_gain / snr

    assert not adequate(qam.least_snr * 10**-0.02)
    assert all(adequate(snr) for snr in qam.least_snr * 10 ** np.linspace(0, 2, 30))


@pytest.mark.parametrize(("name", "snr_db"), [("qpsk", 8), ("16qam", 14), ("64qam", 20), ("256qam", 26)])
@pytest.mark.parametrize("reflection_db", [-300.0, -20.0, -6.0])
def test_symbol_error_rate_of_unknown_symbols_equals_theory(name: str, snr_db: float, reflection_db: float) -> None:
    """Blind decisions have the error rate of a known channel, within 0.5 dB of SNR, and all pulses are sure."""
    qam = constellation(name)
    sidelink = Sidelink(qam, snr_db, reflection_db=reflection_db)
    decisions = sidelink.decisions(qam)
    errors = float(np.mean(decisions.labels != sidelink.sent))
    scatter = 4 * np.sqrt(errors / decisions.labels.size)
    assert sidelink.error_rate(qam, snr_db) - scatter < errors < sidelink.error_rate(qam, snr_db - 0.5) + scatter
    assert decisions.sure.all()


@pytest.mark.parametrize("name", CONSTELLATIONS)
def test_pulses_are_unsure_below_the_least_snr(name: str) -> None:
    """The limit of the EVM separates SNRs 1 dB above the least SNR from those 1 dB below."""
    qam = constellation(name)
    least_db = 10 * np.log10(qam.least_snr)
    for change_db, sure in ((1, True), (-1, False)):
        sidelink = Sidelink(qam, least_db + change_db)
        decisions = sidelink.decider(qam).decide(sidelink.received, sidelink.numbers)
        assert np.mean(decisions.sure == sure) > 0.95
    assert 10 * np.log10(np.median(decisions.snr)) == pytest.approx(least_db - 1, abs=0.4)


@pytest.mark.quick("16qam")
@pytest.mark.parametrize("name", ["qpsk", "16qam", "64qam"])
def test_pulses_with_a_changing_reflection_are_decided_or_unsure(name: str) -> None:
    """Of pulses with a reflection of another phase in each, less than 0.1 % are sure with wrong symbols."""
    qam, wrong_and_sure = constellation(name), 0
    snr_db, pulses = 10 * np.log10(qam.least_snr) + 4, 512
    for reflection_db in (-14.0, -12.5, -11.0):
        sidelink = Sidelink(qam, snr_db, reflection_db=reflection_db, changing=True, pulses=pulses)
        decisions = sidelink.decisions(qam)
        errors = np.mean(decisions.labels != sidelink.sent, axis=1)
        wrong = errors > 2 * float(qam.symbol_error_rate(qam.least_snr))
        wrong_and_sure += int((wrong & decisions.sure).sum())
        assert np.mean(wrong) < 0.05
        assert np.mean(decisions.sure) > 0.9
    assert wrong_and_sure < 1e-3 * 3 * pulses


@pytest.mark.quick("64qam-*")
@pytest.mark.parametrize(("name", "most"), [("qpsk", 0.0), ("16qam", 0.0), ("64qam", 0.0), ("256qam", 3e-3)])
def test_pulses_without_a_reflection_are_sure(name: str, most: float) -> None:
    """Share of 2048 pulses, 2 dB above the least SNR, that the tests of noise and channel exclude."""
    qam = constellation(name)
    sidelink = Sidelink(qam, 10 * np.log10(qam.least_snr) + 2, pulses=2048)
    decider = sidelink.decider(qam)
    assert np.mean(~decider.decide(sidelink.received, sidelink.numbers).sure) <= most


@pytest.mark.parametrize("changed", [{"noise": None}, {}])
def test_pulses_with_more_noise_than_their_group_are_unsure(changed: dict[str, None]) -> None:
    """Their error vector magnitude alone is below its limit."""
    qam = constellation("64qam")
    sidelink = Sidelink(qam, 10 * np.log10(qam.least_snr) + 4, pulses=256)
    decider = replace(sidelink.decider(qam), **changed)
    assert decider.decide(sidelink.received, sidelink.numbers).sure.all()
    sidelink.received[::8] *= (1 + 0.04 * np.random.default_rng(2).normal(size=(32, N, 2)) @ [1, 1j]).astype(
        np.complex64
    )
    sure = decider.decide(sidelink.received, sidelink.numbers).sure
    assert sure[::8].any() == ("noise" in changed)
    assert sure[1::8].all()


def test_pulses_without_signal_are_not_detected() -> None:
    """Captures of zeros and of noise alone change no other pulse, and are unsure."""
    qam = constellation("16qam")
    sidelink = Sidelink(qam, 25)
    sidelink.received[3:5] = 0
    sidelink.received[5] = np.random.default_rng(1).normal(size=(N, 2)) @ [1, 1j]
    decisions = sidelink.decisions(qam)
    assert np.flatnonzero(~decisions.sure).tolist() == [3, 4, 5]
    assert np.array_equal(decisions.labels[6:], sidelink.sent[6:])


def test_channel_of_a_pulse_lowers_the_error_rate_of_a_changing_reflection() -> None:
    """With a reflection of -20 dB that changes from pulse to pulse, 64-QAM is decided by the channel of each pulse."""
    qam = constellation("64qam")
    sidelink = Sidelink(qam, 28, reflection_db=-20, changing=True)
    decisions = sidelink.decisions(qam)
    assert np.mean(decisions.labels != sidelink.sent) < 3e-3
    # the mean channel alone leaves the reflection as an error of -20 dB
    decider = sidelink.decider(qam)
    flat = sidelink.received / decider.shapes
    assert np.median(decider._fitted(flat, decider._detected(flat), decider.shapes)[3]) > 1.3 * np.median(decisions.evm)


def test_known_symbols_resolve_the_ambiguity_of_a_blind_estimate() -> None:
    """Symbols, delay and phase are those sent, for a delay beyond N/8 cells, at which the blind delay is ambiguous."""
    qam = constellation("16qam")
    sidelink = Sidelink(qam, 25, pulses=16)
    number = np.arange(N) - (N - 1) / 2
    shift = N / 4 + 3.0
    sidelink.received = (sidelink.received * np.exp(-2j * np.pi * number * shift / N)).astype(np.complex64)
    decider = sidelink.decider(qam)
    blind = decider.decide(sidelink.received, sidelink.numbers)
    assert np.mean(blind.labels != sidelink.sent) > 0.5
    decisions = decider.resolved(blind, sidelink.sent[:, :8])
    assert np.array_equal(decisions.labels, sidelink.sent)
    assert decisions.path.delay_cells == pytest.approx(sidelink.delay[:, 0] + shift, abs=0.01)
    turn = np.angle(np.exp(1j * (decisions.path.phase_rad - sidelink.phase[:, 0])))
    assert np.ptp(turn) < 0.05
    assert abs(turn.mean()) < 0.05
    # the ratio of echo to sidelink does not depend on the ambiguity
    echo = sidelink.symbols * np.exp(-2j * np.pi * number * 40 / N)
    ratios = [(echo / d.symbols) / (sidelink.received / d.symbols) for d in (blind, decisions)]
    assert np.allclose(*ratios, rtol=1e-4)


def test_pilots_estimate_the_channel_below_the_snr_of_a_blind_estimate() -> None:
    """At 0 dB the fourth power does not detect QPSK; with 128 pilots the error rate is that of theory."""
    qam, table = constellation("qpsk"), np.zeros(N, np.complex64)
    table[3::8] = np.exp(2j * np.pi * np.random.default_rng(5).integers(0, 4, 128) / 4)
    pilots = Pilots.of(table, "pilots.npy")
    sidelink = Sidelink(qam, 0, reflection_db=-20, pilots=pilots)
    decider = sidelink.decider(qam, pilots)
    decisions = decider.decide(sidelink.received, sidelink.numbers)
    data = decider.data_places
    errors = float(np.mean(decisions.labels[:, data] != sidelink.sent[:, data]))
    assert errors == pytest.approx(sidelink.error_rate(qam, 0), abs=0.03)
    assert np.array_equal(decisions.symbols[:, pilots.places], np.broadcast_to(pilots.symbols, (GROUP, 128)))
    with pytest.raises(CampaignError, match=r"no direct path.*pilots of waveform\.codes, waveform\.iq"):
        Sidelink(qam, -3).decider(qam)


@pytest.mark.parametrize("spoil", [lambda table: table[:300:16].fill(0), lambda table: table[::1].fill(0)])
def test_irregular_pilots_are_refused(spoil: Any) -> None:
    """The error states the number of pilots and their distances."""
    table: NDArray[np.complex64] = np.zeros(N, np.complex64)
    table[3::16] = 1
    table[5] = 1
    spoil(table)
    with pytest.raises(CampaignError, match="pilots at distances of"):
        Pilots.of(table, "pilots.npy")


def pilot_comb(step: int = 8) -> Pilots:
    """Return QPSK pilots at every `step`-th subcarrier."""
    table = np.zeros(N, np.complex64)
    table[::step] = np.exp(2j * np.pi * (np.random.default_rng(5).integers(0, 4, N // step) + 0.5) / 4)
    return Pilots.of(table, "pilots.npy")


def checked(sidelink: Sidelink, decider: SymbolDecider, frames: FrameFormat | None = None) -> DecisionCheck:
    """Return the check of the decisions of all pulses."""
    numerology = Numerology(1e9, 64e6, np.arange(N), prefix_samples=0, dft_samples=N)
    symbols = SidelinkSymbols(lambda _: {}, numerology, N, decider, None, 0.0, frames)
    check, decisions = DecisionCheck(symbols), decider.decide(sidelink.received, sidelink.numbers)
    if frames is not None and decider.pilots is None:
        decisions = decider.resolved(decisions, frames.known_labels(decider.constellation))
    check.add(decisions)
    return check


@pytest.mark.parametrize("name", CONSTELLATIONS)
def test_random_data_raise_no_flag_of_the_occupancy(name: str) -> None:
    """New data in each pulse, 0.5 dB above the least SNR and without noise, and the same data in all pulses."""
    qam = constellation(name)
    for snr_db in (10 * np.log10(qam.least_snr) + 0.5, 60.0):
        sidelink = Sidelink(qam, snr_db)
        assert checked(sidelink, sidelink.decider(qam)).flags == {}
    sidelink.received[:] = sidelink.received[:1]
    assert checked(sidelink, sidelink.decider(qam)).flags == {}


@pytest.mark.parametrize(
    ("sent", "configured", "snr_db", "mean_power"),
    # QPSK: corners of 16-QAM, (1 + 1)·9/10; 16-QAM: levels ±3 and ±7 of 64-QAM, 2·(9 + 49)/2·3/126
    [("qpsk", "16qam", 25.0, 9 / 5), ("16qam", "64qam", 45.0, 29 / 21)],
)
def test_another_constellation_is_found_by_the_points_that_its_symbols_do_not_occupy(
    sent: str, configured: str, snr_db: float, mean_power: float
) -> None:
    """Eq. 18: with pilots, all pulses are sure, and images would lose the mean power of the decided symbols."""
    pilots = pilot_comb()
    sidelink = Sidelink(constellation(sent), snr_db, pilots=pilots)
    check = checked(sidelink, sidelink.decider(constellation(configured), pilots))
    assert check.pulses == GROUP
    assert check.flags.keys() == {"constellation_suspect"}
    line = check.flags["constellation_suspect"]
    assert f"as by {sent}; mean power of the decided symbols {10 * np.log10(mean_power):+.1f} dB" in line
    right = checked(sidelink, sidelink.decider(constellation(sent), pilots))
    assert right.flags == {}


@pytest.mark.parametrize(
    ("sent", "configured", "snr_db", "sure"),
    [("64qam", "16qam", 25.0, True), ("256qam", "64qam", 35.0, True), ("16qam", "qpsk", 20.0, False)],
)
@pytest.mark.parametrize("pilots", [None, pilot_comb()], ids=["blind", "pilots"])
def test_larger_constellation_is_found_by_the_kurtosis_of_the_errors(
    sent: str, configured: str, snr_db: float, sure: bool, pilots: Pilots | None
) -> None:
    """Eq. 20: 64-QAM is decided as 16-QAM in sure pulses, and evenly."""
    sidelink = Sidelink(constellation(sent), snr_db, pilots=pilots)
    check = checked(sidelink, sidelink.decider(constellation(configured), pilots))
    assert (check.pulses > GROUP // 2) == sure
    assert check.flags.keys() == check.larger.keys() == {"constellation_suspect"}
    assert f"a larger constellation than {configured}" in check.flags["constellation_suspect"]
    assert checked(sidelink, sidelink.decider(constellation(sent), pilots)).flags == {}


@pytest.mark.parametrize("name", CONSTELLATIONS)
@pytest.mark.parametrize("excess_db", [-3.0, 0.0, 3.0])
def test_errors_by_noise_are_not_those_of_a_larger_constellation(name: str, excess_db: float) -> None:
    qam = constellation(name)
    sidelink = Sidelink(qam, 10 * np.log10(qam.least_snr) + excess_db, reflection_db=-10.0)
    check = checked(sidelink, sidelink.decider(qam))
    assert check.kurtosis / check.detected > 1.6
    assert check.larger == {}


def test_small_errors_of_equal_magnitude_are_not_those_of_a_larger_constellation() -> None:
    """The image of I and Q of QPSK, -25 dB: κ is 1."""
    sidelink = Sidelink(constellation("qpsk"), 60.0)
    sidelink.received += 10 ** (-25 / 20) * sidelink.received[:, ::-1].conj()
    check = checked(sidelink, sidelink.decider(constellation("qpsk")))
    assert check.kurtosis / check.detected < 1.2
    assert check.flags == {}


def test_data_that_are_not_scrambled_are_found_by_their_occupancy() -> None:
    """Capital letters in ASCII: bits 010 or 100 and 101 begin each byte, so that 16-QAM uses few of its points."""
    qam, pilots = constellation("16qam"), pilot_comb()
    sidelink = Sidelink(qam, 60.0, pilots=pilots)
    letters = np.random.default_rng(1).integers(ord("A"), ord("Z") + 1, (GROUP, N // 2), np.uint8)
    labels = qam.labels(np.unpackbits(letters, axis=1))
    turn = sidelink.received / sidelink.symbols
    sidelink.symbols = qam.points[labels]
    sidelink.symbols[:, pilots.places] = pilots.symbols
    sidelink.received = turn * sidelink.symbols
    check = checked(sidelink, sidelink.decider(qam, pilots))
    assert check.flags.keys() == {"constellation_suspect"}


@pytest.mark.parametrize("name", ["qpsk", "64qam"])
@pytest.mark.parametrize(("excess_db", "wrong_bits"), [(0.5, 0), (0.5, 4), (8.0, 0), (8.0, 1)])
def test_header_differs_if_a_bit_is_wrong_in_all_frames(name: str, excess_db: float, wrong_bits: int) -> None:
    """Eq. 19: errors of a header of 32 bits by noise raise no flag; 4 wrong bits do, and above the least SNR, one."""
    qam, pilots = constellation(name), pilot_comb()
    header = np.unpackbits(np.frombuffer(bytes.fromhex("1acffc1d"), np.uint8))
    sidelink = Sidelink(qam, 300.0, pilots=pilots, pulses=256)
    data = np.setdiff1d(np.arange(N), np.arange(N)[pilots.places])
    framed = qam.bits(sidelink.sent[:, data])
    framed[:, :32] = header
    framed[:, 5 : 5 + wrong_bits] ^= 1
    sidelink.received[:, data] *= qam.symbols(framed) / qam.points[sidelink.sent[:, data]]
    level = 5 * np.sqrt(0.5 / (qam.least_snr * 10 ** (excess_db / 10)))
    sidelink.received += level * np.random.default_rng(6).normal(size=(256, N, 2)) @ [1, 1j]
    frames = FrameFormat(header, 16, True, data.size * qam.bits_per_symbol)
    check = checked(sidelink, sidelink.decider(qam, pilots), frames)
    assert ("header_differs" in check.flags) == bool(wrong_bits)
    if not wrong_bits:
        assert check.expected_bits == pytest.approx(check.wrong_bits, rel=0.2, abs=3)
