"""Measurement of a flight of kind bench: channels and clocks of nodes, links of pairs, and lines of the verdict."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from apertura.campaign.config import CONFIG, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import decibels, seconds_since
from apertura.core.echo.captures import (
    SATURATED_SHARE,
    Pulses,
    Read,
    Samples,
    Saturation,
    blocks_of,
    spread,
)
from apertura.core.echo.clock import GROUPS, ClockOffset, clock_of
from apertura.core.echo.frame_codes import sampled_rows
from apertura.core.echo.interference import EXCESS_DB
from apertura.core.echo.transfer import (
    Demodulator,
    Transfer,
    as_complex,
    transfer_by_code,
    transfer_by_sidelink,
)
from apertura.core.quality.budget import strictest_accuracy_db
from apertura.methods.bench.channels import (
    DC_DB,
    FEWEST_COUNTS,
    IMAGE_DB,
    MISSED_SHARE,
    MeasuredChannel,
    Triggers,
    measure_channel,
    triggers,
)
from apertura.methods.bench.links import (
    AMPLITUDE_DB,
    DRIFT_PPM,
    DROPOUT_SHARE,
    LEAKAGE_DB,
    PATH_CELLS,
    PHASE_RAD,
    SPLIT_DB,
    SPLIT_RAD,
    UNLOCKED_PPM,
    WEAK_DB,
    BenchPathOffset,
    Contact,
    MeasuredLink,
    SplitAgreement,
    clock_flags,
    measure_contact,
    measure_link,
    reversed_flags,
    split_agreement,
)
from apertura.stages.acquisition import Captured
from apertura.stages.ingest import captures_of, checked_recording
from apertura.stages.symbols import FEW_ERRORS, PairSymbols, ambiguous_symbols, rows_of
from apertura.stages.transmitted import Transmitted, transmitted

_CHANNELS = ("radar", "sidelink")
_STRETCH = 256  # consecutive captures in each of `GROUPS` groups of a recording
_EVERY_CAPTURE = 4096
"""Maximum number of captures of a node whose samples are analysed; longer recordings are sampled evenly."""


@dataclass(frozen=True)
class VerdictLine:
    """A line of the verdict: quantity, measurement, limit and flags.

    Attributes
    ----------
    of
        Node, node and channel, or pair.
    what
        Quantity.
    measured, limit
        Measured value and limit, with units.
    flags
        Names of the raised flags; empty if the value is within its limit.
    """

    of: str
    what: str
    measured: str
    limit: str
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class BenchNode:
    """Measurements of one node on the bench.

    Attributes
    ----------
    name
        Name of the node.
    triggers, channels, saturated
        Recorded and missed pulses; state of each channel; channel → fraction of saturated samples.
    clock
        Clock offset relative to the transmitter; None for the transmitter itself, and if the offset cannot be measured.
    sidelink, contact
        State of the sidelink as measured for the sidelink correction, and stability of its amplitude; None without a
        sidelink.
    link
        Strongest path: for the transmitter in its own echo, for a receiver in its echo divided by the sidelink; None if
        no path is found.
    coherence_before
        Γ of the radar channel without sidelink correction; None for ambiguous symbols.
    symbols
        Source and quality of symbols that are decided from a sidelink; empty if the symbols are known.
    flags
        Flags of all measurements.
    """

    name: str
    triggers: Triggers
    channels: tuple[MeasuredChannel, ...]
    saturated: Mapping[str, float]
    clock: ClockOffset | None
    sidelink: Mapping[str, Any] | None
    contact: Contact | None
    link: MeasuredLink | None
    coherence_before: float | None
    symbols: str
    flags: Flags


@dataclass(frozen=True, eq=False)
class Bench:
    """Measurements of a flight of kind bench.

    Attributes
    ----------
    flight, transmitter
        Names of the flight and the transmitting node.
    nodes
        Recording nodes, the transmitter first.
    offsets
        Node → path offset of its radar channel minus that of its sidelink channel, relative to the paths of the set-up.
    splits
        Pair → comparison of its radar channel with that of the transmitter, if one signal is split to both channels.
    carrier_hz, interval_s
        Nominal carrier frequency, and pulse interval.
    """

    flight: str
    transmitter: str
    nodes: tuple[BenchNode, ...]
    offsets: Mapping[str, BenchPathOffset]
    splits: Mapping[str, SplitAgreement]
    carrier_hz: float
    interval_s: float
    pair_flags: Flags = field(default_factory=Flags)

    def pair(self, node: str) -> str:
        """Return the name of the pair of a node."""
        return f"{self.transmitter}-{node}"

    @property
    def flags(self) -> Flags:
        """Flags of all nodes and pairs."""
        return Flags.merged(*(node.flags for node in self.nodes), self.pair_flags)

    @property
    def lines(self) -> list[VerdictLine]:
        """Lines of the verdict for all nodes."""
        return [line for node in self.nodes for line in self._lines(node)]

    def _lines(self, node: BenchNode) -> Iterator[VerdictLine]:
        raised = [*node.flags, *(name for name, line in self.pair_flags.items() if self.pair(node.name) in line)]

        def line(of: str, what: str, measured: str, limit: str, *names: str) -> VerdictLine:
            return VerdictLine(of, what, measured, limit, tuple(name for name in names if name in raised))

        count = node.triggers
        missed, expected = count.missed + count.beyond, count.due + count.beyond
        yield line(
            node.name,
            "pulses",
            f"{count.recorded} recorded, {missed} of {expected} missed, {count.false} false",
            f"missed {100 * MISSED_SHARE:g} %, false 0",
            "triggers_missed",
            "triggers_false",
        )
        for channel in node.channels:
            of, flags = f"{node.name} {channel.name}", {*channel.flags}
            level = f"{channel.counts:.0f} counts rms" if channel.integers else f"{channel.counts:.3g} rms"
            share = node.saturated.get(channel.name, 0.0)
            yield line(of, "level", level, f"at least {FEWEST_COUNTS:g}", *({"channel_weak"} & flags))
            yield line(
                of,
                "saturated samples",
                f"{100 * share:.3f} %",
                f"{100 * SATURATED_SHARE:g} %",
                *([f"saturated_{channel.name}"] if share > SATURATED_SHARE else []),
            )
            if channel.stuck:
                bits = ", ".join(map(str, channel.stuck))
                yield line(of, "constant bits", bits, "none", *({"channel_bits_stuck"} & flags))
            yield line(of, "DC", f"{channel.dc_db:.1f} dB", f"{DC_DB:g} dB", *({"channel_dc"} & flags))
            limit_db = max(IMAGE_DB, channel.image_floor_db)
            yield line(
                of, "I/Q image", f"{channel.image_db:.1f} dB", f"{limit_db:.0f} dB", *({"channel_image"} & flags)
            )
        if node.symbols:
            names = "symbols_unsure", "constellation_suspect", "header_differs"
            yield line(node.name, "data symbols", node.symbols, "decided in all recorded pulses", *names)
        yield from self._received(node, line)
        if node.link is not None:
            yield from self._link(node, node.link, line)
        else:
            problem = "no path above the noise" if "symbols_unsure" not in raised else "not measured"
            names = "link_weak", "sidelink_lost", "symbols_unsure"
            yield line(self.pair(node.name), "path", problem, "one path", *names)

    def _received(self, node: BenchNode, line: Any) -> Iterator[VerdictLine]:
        """Yield the lines for a receiver's clock and sidelink."""
        if node.name == self.transmitter:
            return
        if node.clock is not None:
            ppm, std = node.clock.cfo_hz / self.carrier_hz * 1e6, node.clock.cfo_std_hz / self.carrier_hz * 1e6
            sampling = f"{node.clock.sfo_ppm:+.4f} ± {node.clock.sfo_std_ppm:.4f} ppm of the sampling rate"
            yield line(node.name, "carrier frequency offset", f"{ppm:+.4f} ± {std:.4f} ppm", f"{UNLOCKED_PPM:g} ppm",
                       "clock_unlocked", "clock_ambiguous")  # fmt: skip
            yield line(node.name, "sampling frequency offset", sampling, "equal to the carrier offset in ppm")
            change_ppm = node.clock.cfo_slope_hz * node.triggers.recorded / self.carrier_hz * 1e6
            yield line(node.name, "change of the carrier offset over the recording", f"{change_ppm:+.4f} ppm",
                       f"{DRIFT_PPM:g} ppm", "clock_drifts")  # fmt: skip
        of = f"{node.name} sidelink"
        if node.sidelink is not None:
            state = node.sidelink
            method = "depends on the correction method"
            yield line(of, "SNR", f"{state['snr_db']:.1f} dB per subcarrier", method, "sidelink_noisy")
            yield line(of, "lock", f"{100 * state['lock_rate']:.1f} % of the pulses", "100 %", "sidelink_lost")
            yield line(of, "echoes in addition to the direct path", f"at most {state['echo_db']:.1f} dB", method,
                       "sidelink_echo", "second_arrival", "sidelink_ripple_or_echo")  # fmt: skip
            yield line(of, "ripple over the band", f"{state['ripple_db']:.2f} dB", method,
                       "sidelink_ripple", "sidelink_nulls")  # fmt: skip
            yield line(of, "correction", f"{state['method']}: {state['reason']}", "", "wrong_code")
        if node.contact is not None:
            yield self._steady(node.contact, of)

    def _steady(self, contact: Contact, of: str) -> VerdictLine:
        return VerdictLine(of, "amplitude", contact.line.removeprefix("amplitude "),
                    f"{AMPLITUDE_DB:g} dB, {100 * DROPOUT_SHARE:g} %",
                    tuple(contact.flags))  # fmt: skip

    def _link(self, node: BenchNode, link: MeasuredLink, line: Any) -> Iterator[VerdictLine]:
        pair, phase_drift, delay_drift = self.pair(node.name), link.phase_drift_rad, link.delay_drift_ps
        if node.coherence_before is not None:
            yield line(pair, "coherence Γ without sidelink correction", f"{node.coherence_before:.4f}", "no limit")
        yield line(
            pair,
            "coherence Γ",
            f"{link.coherence:.6f}",
            f"{link.coherence_limit:.6f} ± {link.coherence_std:.6f}, from the SNR",
            "link_incoherent",
            "phase_unstable",
        )
        yield line(pair, "SNR of a compressed pulse", f"{decibels(link.snr):.1f} dB", f"{WEAK_DB:g} dB",
                   "link_weak", "code_unconfirmed", "wrong_code", "spectrum_inverted")  # fmt: skip
        yield line(
            pair,
            "phase",
            f"{link.phase_excess_rad:.4f} rad rms in excess of noise ({link.noise_rad:.4f} rad)",
            f"{PHASE_RAD:g} rad",
            "link_incoherent",
        )
        yield line(
            pair,
            "drift over the recording",
            f"{phase_drift[0]:+.4f} ± {phase_drift[1]:.4f} rad, {delay_drift[0]:+.2f} ± {delay_drift[1]:.2f} ps",
            f"{PHASE_RAD:g} rad",
            "link_drifts",
        )
        yield self._steady(link.contact, pair)
        path = f"{link.path_m:+.4f} ± {link.path_std_m:.4f} m"
        yield line(pair, "path", path, "equal for all pulses", "channels_swapped", "delay_jumps")
        frequency_hz, excess_db = link.interference.strongest
        yield line(
            pair,
            "strongest interference",
            f"{excess_db:.1f} dB at {frequency_hz / 1e6:.2f} MHz",
            f"{EXCESS_DB:g} dB re neighbours",
            "interference",
        )
        if (offset := self.offsets.get(node.name)) is not None:
            yield line(
                pair,
                "path offset relative to the set-up",
                f"{offset.offset_m:+.4f} ± {offset.std_m:.4f} m, config {offset.stated_m:+.4f} m",
                f"{PATH_CELLS * offset.cell_m:.3f} m",
                "path_offset_disagrees",
            )
        if link.direct_db is not None:
            yield line(pair, "sidelink in the radar channel", f"{link.direct_db:.1f} dB re path",
                       f"{LEAKAGE_DB:g} dB", "channel_crosstalk")  # fmt: skip
        if link.arrivals:
            others = ", ".join(f"{arrival.level_db:.1f} dB {arrival.later_m:+.2f} m" for arrival in link.arrivals)
            yield line(pair, "other arrivals", others, "")
        if (split := self.splits.get(pair)) is not None:
            yield line(
                pair,
                f"difference from {self.pair(self.transmitter)} with a split signal",
                f"{split.gain_db:+.2f} dB, {split.phase_rad:+.3f} ± {split.phase_std_rad:.3f} rad, path "
                f"{split.path_m:+.3f} m (receiver: relative to its sidelink); over the band {split.band_db:.2f} dB, "
                f"{split.band_rad:.3f} rad rms",
                f"{SPLIT_DB:g} dB, {SPLIT_RAD:g} rad",
                "splitter_channels_differ",
            )

    @property
    def report(self) -> dict[str, Any]:
        """All measurements as a JSON document."""
        return {
            "flight": self.flight,
            "transmitter": self.transmitter,
            "lines": [vars(line) | {"flags": list(line.flags)} for line in self.lines],
            "links": {self.pair(node.name): _link_report(node, self.interval_s) for node in self.nodes if node.link},
            "path_offset_m": {
                node.name: {
                    "offset_m": round(self.offsets[node.name].offset_m, 5),
                    "std_m": round(self.offsets[node.name].std_m, 5),
                    "stated_m": self.offsets[node.name].stated_m,
                    "doubts": sorted(_DOUBTS & node.flags.keys()),
                }
                for node in self.nodes
                if node.name in self.offsets
            },
            "flags": self.flags,
        }


_DOUBTS = frozenset({
    "link_weak", "link_incoherent", "contact_intermittent", "delay_jumps", "wrong_code", "code_unconfirmed",
    "spectrum_inverted", "saturated_radar", "saturated_sidelink", "sidelink_lost", "interference",
})  # fmt: skip
"""Flags that prevent the measured path offset of a node from being written to the config."""


def _link_report(node: BenchNode, interval_s: float) -> dict[str, Any]:
    link = node.link
    if link is None:
        return {}
    phase_drift, delay_drift = link.phase_drift_rad, link.delay_drift_ps
    return {
        "coherence": link.coherence,
        "coherence_limit": round(link.coherence_limit, 9),
        "coherence_std": round(link.coherence_std, 9),
        "coherence_before": node.coherence_before,
        "snr_db": round(decibels(link.snr), 2),
        "phase_excess_rad": round(link.phase_excess_rad, 5),
        "phase_drift_rad": [round(value, 5) for value in phase_drift],
        "delay_drift_ps": [round(value, 3) for value in delay_drift],
        "path_m": round(link.path_m, 5),
        "path_std_m": round(link.path_std_m, 6),
        "arrivals": [
            {"later_m": round(arrival.later_m, 3), "level_db": round(arrival.level_db, 1)} for arrival in link.arrivals
        ],
        "allan_deviation": [[time_s, float(f"{value:.4g}")] for time_s, value in link.deviation(interval_s)],
    }


def measure_bench(campaign: Campaign, flight: str) -> Bench:
    """Measure a flight of kind bench from its recordings, without flight logs.

    Raises
    ------
    CampaignError
        If the waveform is not recorded as samples, or a recording cannot be opened.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):
        raise CampaignError(
            f"waveform.kind {waveform.kind}",
            where=CONFIG,
            expected="a waveform recorded as samples, from which clocks and channels are measured",
            remedy="Remove flights of kind bench from flights.tsv.",
        )
    flown, coded = campaign.flight(flight), _Coded(campaign, flight, transmitted(campaign, waveform))
    names = [name for name in flown.participants if name in flown.nodes]
    nodes = tuple(_node(coded, name) for name in names)
    due = max((node.triggers.due for node in nodes), default=0)
    # `beyond`: pulses that other nodes recorded before this node started or after it stopped
    counts = [replace(node.triggers, beyond=due - node.triggers.due) for node in nodes]
    nodes = tuple(
        replace(node, triggers=triggers, flags=Flags.merged(node.flags, triggers.flags))
        for node, triggers in zip(nodes, counts, strict=True)
    )
    stated, offsets, flags = campaign.settings.bench, {}, []
    for node in nodes:
        is_transmitter = node.name == flown.transmitter
        expected_m = stated.radar_m
        if not is_transmitter and expected_m is not None:
            expected_m = None if stated.sidelink_m is None else expected_m - stated.sidelink_m
        if node.link is None:
            continue
        if not is_transmitter:
            flags.append(reversed_flags(node.link, expected_m))
        if expected_m is not None:
            paths = campaign.settings.nodes[node.name].path_offset_m
            offset_m = paths.radar if is_transmitter else paths.radar - paths.sidelink
            link = node.link
            offsets[node.name] = BenchPathOffset(link.path_m - expected_m, link.path_std_m, offset_m, link.cell_m)
            flags.append(offsets[node.name].flags(link.name))
    first = nodes[0].link if nodes and nodes[0].name == flown.transmitter else None
    splits = {}
    if stated.split and first is not None:
        for node in nodes[1:]:
            if node.link is not None:
                splits[node.link.name] = split_agreement(first, node.link)
                flags.append(splits[node.link.name].flags(node.link.name))
    return Bench(
        flight, flown.transmitter, nodes, offsets, splits, waveform.carrier_hz, 1 / waveform.prf_hz,
        Flags.merged(*flags),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Code:
    """Code of the captures of a node, known or decided.

    `captured` is read in the order of I and Q in which it contains the code. `rows`: (capture,) int64, rows of the
    inverse spectra of `sent`. `used`: captures whose symbols are known. `decided`: decided symbols; None: known ones.
    """

    captured: Captured
    sent: Transmitted
    rows: Pulses
    used: Pulses
    decided: PairSymbols | None = None

    @classmethod
    def of(cls, captured: Captured, decided: PairSymbols) -> "_Code":
        """Return the decided code of captures; raise CampaignError if it is decided in fewer than two."""
        used = np.flatnonzero(decided.usable())
        if len(used) < 2:
            raise CampaignError(
                f"symbols are decided in {len(used)} of {len(decided.rows)} pulses",
                where=captured.recording,
                expected=f"pulses that the sidelink of {decided.source} contains above the SNR of the constellation",
                remedy="Check antenna, gain and reflections of the sidelink.",
            )
        return cls(captured, decided.sent, decided.rows, used, decided)

    def part(self, channels: Sequence[str], captures: Pulses) -> tuple[Read, Demodulator]:
        """Return reader and demodulator of a part of the captures."""
        inverses, rows = self.sent.inverses, self.rows[captures]
        length, numerology = self.sent.waveform.capture_samples, self.captured.numerology
        return (
            self.captured.reader(channels, captures),
            Demodulator(lambda pulses: inverses.at(rows[pulses]), numerology, length, spectrum=self.sent.spectrum),
        )

    def transfer(self, channel: str, captures: Pulses) -> Callable[[Pulses], Complexes]:
        """Return a function that computes transfer functions of a channel from the code, 0 where it is not known."""
        (read, demodulator), known = self.part([channel], captures), np.isin(captures, self.used)
        return lambda pulses: demodulator.symbols(read(pulses)[channel], pulses, channel=channel) * known[pulses, None]

    def locks(self, channel: str) -> bool:
        """Return True if the code compresses a path in most pulses of a channel."""
        pulses = self.used[np.concatenate(spread(len(self.used), groups=4, each=16))]
        contact = measure_contact(channel, self.transfer(channel, pulses), len(pulses))
        return contact is not None and 2 * contact.dropouts < contact.pulses

    @property
    def noise_gain(self) -> Floats:
        """(subcarrier,) float64, mean of 1/|c|² over the pulses, from at most 64 of them."""
        inverse = self.sent.inverses.at(self.rows[self.used][sampled_rows(len(self.used))])
        gain = np.square(np.abs(inverse)).mean(axis=0, dtype=np.float64)
        return np.where(gain > 0, gain, 1.0)

    @property
    def symbols(self) -> str:
        """Source and quality of decided symbols; empty for known ones."""
        if self.decided is None:
            return ""
        report, recorded = self.decided.report(np.isin(np.arange(len(self.rows)), self.used)), (self.rows >= 0).sum()
        return (
            f"{report['constellation']} of the sidelink of {report['node']}, SNR {report['snr_db']:.1f} dB, EVM "
            f"{report['evm_db']:.1f} dB, decided in {len(self.used)} of {recorded} pulses recorded by {report['node']}"
        )


class _Coded:
    """Recordings of a flight of kind bench, and the codes of their captures."""

    def __init__(self, campaign: Campaign, flight: str, sent: Transmitted) -> None:
        self.campaign, self.flight, self.sent = campaign, campaign.flight(flight), sent
        self.accuracy_db = strictest_accuracy_db(campaign.settings.processing.accuracy_db)
        self.captured, self.code = cache(self._captured), cache(self._code)

    def _captured(self, name: str) -> Captured:
        recording, where = checked_recording(self.campaign, self.flight.name, name), f"raw/{self.flight.name}/{name}"
        raw, order = captures_of(recording, self.campaign, node=name), self.campaign.settings.iq_of(name)
        return Captured.of(raw, recording.samples.path, Path(where), where, self.sent, order=order)

    def _code(self, name: str) -> _Code:
        """Return the code of a node; raise CampaignError if unknown symbols cannot be decided."""
        captured, transmitter, unknown = self.captured(name), self.flight.transmitter, self.sent.unknown
        every, channel = np.arange(len(captured.raw.start)), "radar" if name == transmitter else "sidelink"
        # read as configured, or else the complex conjugates
        orders = captured, captured.conjugated
        if unknown is None:
            code = _Code(captured, self.sent, captured.frames.numbers, every)
        else:
            if name == transmitter and not unknown.unambiguous:
                raise ambiguous_symbols()
            source = self.campaign.symbol_source(self.flight.name, f"{transmitter}-{name}")
            if source == name:
                return self._decided(orders, every)
            of_source = self.code(source)
            rows = rows_of(captured, of_source.captured, prf_hz=self.sent.waveform.prf_hz)
            code = _Code.of(captured, replace(cast("PairSymbols", of_source.decided), rows=rows, is_monostatic=True))
        conjugate = replace(code, captured=orders[1])
        return conjugate if not code.locks(channel) and conjugate.locks(channel) else code

    def _decided(self, orders: Sequence[Captured], every: Pulses) -> _Code:
        """Return the code in the sidelink of a node, of the order of I and Q in which the header has fewer errors."""
        tested, found, problems = np.concatenate(spread(len(every), groups=4, each=16)), [], list[CampaignError]()
        for captured in orders:
            try:
                decided = PairSymbols.of(captured, self.sent, every, self.accuracy_db)
            except CampaignError as problem:
                problems.append(problem)
            else:
                found.append((decided.symbols.header_error_rate(tested), captured, decided))
                if found[-1][0] < FEW_ERRORS:
                    break
        if not found:
            raise problems[0]
        return _Code.of(*min(found, key=lambda one: one[0])[1:])


def _node(coded: _Coded, name: str) -> BenchNode:
    sent, captured, processing = coded.sent, coded.captured(name), coded.campaign.settings.processing
    is_transmitter, pair = name == coded.flight.transmitter, f"{coded.flight.transmitter}-{name}"
    time_s = seconds_since(captured.raw.time.values, captured.raw.time.values[0])
    counted = triggers(time_s, prf_hz=sent.waveform.prf_hz)
    present = [channel for channel in _CHANNELS if channel in captured.raw.attrs["channels"]]
    every, recorded = np.arange(len(time_s)), present if is_transmitter else list(_CHANNELS)
    channels, saturation = _channels(captured.reader(recorded, every), present, captured, len(every))
    flags = [channel.flags for channel in channels] + [saturation.flags]
    try:
        code = coded.code(name)
    except CampaignError as error:
        symbols = f"not decided: {error.found}"
        flags.append({"symbols_unsure": f"{name}: {symbols}"})
        nothing = (None, None, None, None, None)
        return BenchNode(name, counted, channels, saturation.shares, *nothing, symbols, Flags.merged(*flags))
    if code.captured.order != captured.order:
        line = (
            f"{name}: the code matches the complex conjugate of the samples; change nodes.{name}.iq, or waveform.iq "
            "if all nodes are affected"
        )
        flags.append({"spectrum_inverted": line})
    before, clock, contact, state, link, method = None, None, None, None, None, str(processing.sidelink)
    if code.decided is not None:
        method, known = code.decided.sidelink_method(method), np.isin(every, code.used)
        raised = code.decided.flags(known)
        flags.append({key: f"{name}: {line}" for key, line in raised.items()})
    measured: Transfer | None = None
    used, time_s = code.used, time_s[code.used]
    if is_transmitter:
        measured = transfer_by_code(*code.part(["radar"], used), time_s=time_s)
    else:
        contact = measure_contact(f"{name} sidelink", code.transfer("sidelink", every), len(every))
        flags.append(contact.flags if contact else {})
        clock, flags_of_clock = _clock(code.captured.reader(["sidelink"], every), sent, name, len(every))
        flags.append(flags_of_clock)
        if sent.unknown is None or sent.unknown.unambiguous:
            uncorrected = measure_link(pair, code.transfer("radar", used), time_s, captured.numerology, divided=False)
            before = uncorrected.coherence if uncorrected else None
        try:
            measured = transfer_by_sidelink(
                *code.part(_CHANNELS, used), sidelink_m=np.zeros(len(used)), method=method,
                accuracy_db=coded.accuracy_db, where=captured.recording,
            )  # fmt: skip
        except CampaignError as error:
            flags.append({"sidelink_lost": f"{name}: {error.found}"})
        else:
            state = measured.report["sidelink"]
    if measured is not None:
        # the radar is stationary: the flags of echo processing that assume a flight do not apply
        flags.append({key: line for key, line in measured.flags.items() if key not in _OF_FLIGHTS})
        kept = np.flatnonzero(measured.kept)
        if len(kept) > 1:
            rows = measured.form
            link = measure_link(
                pair, lambda pulses: rows(kept[pulses]), time_s[kept], captured.numerology, divided=not is_transmitter,
                prefix_cells=captured.numerology.delay_cells if is_transmitter else None, noise_gain=code.noise_gain,
            )  # fmt: skip
            flags.append(link.flags if link else {"link_weak": f"{pair}: no path above the noise"})
    return BenchNode(
        name, counted, channels, saturation.shares, clock, state, contact, link, before, code.symbols,
        Flags.merged(*flags),
    )  # fmt: skip


_OF_FLIGHTS = frozenset({"association_suspect", "phase_unstable"})


def _channels(
    read: Read, present: list[str], captured: Captured, count: int
) -> tuple[tuple[MeasuredChannel, ...], Saturation]:
    """Return the state and saturation of each channel, from at most `_EVERY_CAPTURE` captures."""
    captures = np.unique(np.linspace(0, count - 1, min(count, _EVERY_CAPTURE)).astype(np.int64))
    saturation = Saturation()

    def blocks(channel: str) -> Iterator[Samples]:
        for block in blocks_of(captures):
            iq = read(block)[channel]
            saturation.count({channel: iq})
            yield iq

    return tuple(measure_channel(name, blocks(name), captured.numerology) for name in present), saturation


def _clock(read: Read, sent: Transmitted, name: str, count: int) -> tuple[ClockOffset | None, dict[str, str]]:
    groups = spread(count, groups=GROUPS, each=_STRETCH)
    length = sent.waveform.capture_samples
    try:
        clock = clock_of(
            (as_complex(read(group)["sidelink"][:, :length]) for group in groups), sent.numerology, pulses=count
        )
    except ValueError as error:
        return None, {"clock_unmeasured": f"{name}: {error}"}
    return clock, clock_flags(name, clock, sent.numerology, count)


def series(link: MeasuredLink) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the plotted series, (pulse,) each: time in s, phase in rad, delay in ps, amplitude in dB re median."""
    size = np.abs(link.terms)
    return link.time_s, link.phase_rad, link.delay_ps, 20 * np.log10(size / np.median(size))
