"""The echo of a pair from the recordings of its nodes: pulses, positions, transfer functions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from apertura.campaign.config import FLIGHTS, Processing, PulseWaveform, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of, open_stage
from apertura.common.arrays import Complexes, Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import seconds_since
from apertura.core.echo.association import Association, missing_flags, tag_jitter_s
from apertura.core.echo.captures import Pulses, Saturation, blocks_of
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.line_of_sight import LineOfSight
from apertura.core.echo.pulse_filter import truncation_flags
from apertura.core.echo.sidelink import DIVIDING
from apertura.core.echo.transfer import (
    Correction,
    Demodulator,
    Transfer,
    forming,
    transfer_by_code,
    transfer_by_sidelink,
)
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.atmosphere import SceneAir
from apertura.core.imaging.range_profiles import wave_speed_of
from apertura.core.quality.budget import strictest_accuracy_db
from apertura.formats.times import FIRST
from apertura.methods.autofocus.motion import Logged, Recorded
from apertura.stages.acquisition import Acquisition, common_pulses, open_acquisition
from apertura.stages.node_log import NodeLog, raw_log, read_history, shortest_wave
from apertura.stages.positions import PulsePositions, keep_segments, place, scene_air, stated_air
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.workflow.lineage import reads_kept

# ---- The echo of a pair: its stage, and transfer functions that are formed when they are needed ---------------------

Form = Callable[[Pulses, Correction | None], Complexes]
"""Captures, ascending, and their correction → transfer functions, (pulse, subcarrier) complex64."""


@dataclass(frozen=True, eq=False)
class PairEcho:
    """The echo of a pair, whose transfer functions are formed as often as they are needed, block by block.

    Attributes
    ----------
    dataset
        The stage; without `transfer`, `capture` (pulse,) says what each pulse is formed of.
    source
        Of captures, or of pulses of a recorder that stores transfer functions.
    saturation
        Of the samples read so far.
    """

    dataset: xr.Dataset
    source: Form
    saturation: Saturation = field(default_factory=Saturation)

    @classmethod
    def recorded(cls, echo: xr.Dataset) -> "PairEcho":
        """Return the echo of a recorder that stores transfer functions."""
        history = echo.transfer

        def form(rows: Pulses, _: Correction | None) -> Complexes:
            return np.asarray(history[rows].values)

        return cls(echo.drop_vars("transfer").assign(capture=("pulse", np.arange(len(history)))), form)

    @classmethod
    def opened(cls, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Return that of a finished stage `echo`; the recording is opened when a transfer function is asked for.

        Where the recording is not there its transfer functions are those that stage `transfer` keeps, to the bit.

        Raises
        ------
        CampaignError
            If the stage is damaged or missing; when a transfer function is asked for, if the recording is, and nothing
            was kept of it.
        """
        stage, saturation = open_stage(campaign.stage("echo", flight, pair), "echo"), Saturation()
        if "transfer" not in stage and reads_kept(campaign, flight, pair):
            kept = open_stage(campaign.stage("transfer", flight, pair), "transfer")
            stage = stage.assign(transfer=kept.transfer).assign_attrs(flags=kept.attrs["flags"])

        @cache
        def source() -> Form:
            waveform = campaign.settings.waveform
            if not isinstance(waveform, SampledWaveform):
                raise TypeError("the echo of a recorder of transfer functions holds them")
            sent = transmitted(campaign, waveform)
            receiver = open_acquisition(campaign, flight, pair.split("-")[1], sent)
            return _source(receiver, sent, saturation, divided="sidelink_amplitude" in stage)

        def form(captures: Pulses, correction: Correction | None) -> Complexes:
            return source()(captures, correction)

        return cls(stage, form, saturation)

    def within(self, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Return the echo inside the segments of its pair."""
        return replace(self, dataset=keep_segments(campaign, flight, pair, self.dataset))

    @property
    def flags(self) -> dict[str, str]:
        """Flags of the stage, and of the samples read so far."""
        return Flags.merged(self.dataset.attrs["flags"], self.saturation.flags)

    @property
    def shape(self) -> tuple[int, int]:
        """Pulses and subcarriers."""
        return self.dataset.sizes["pulse"], self.dataset.sizes["subcarrier"]

    @property
    def stage(self) -> xr.Dataset:
        """The stage, its `transfer` read or formed on access."""
        if "transfer" in self.dataset:
            return self.dataset
        return self.dataset.assign(transfer=xr.Variable(_HISTORY, indexing.LazilyIndexedArray(_Transfer(self))))

    @property
    def hollow(self) -> xr.Dataset:
        """The stage without what captures say, with zeros that take no memory for `transfer`."""
        zeros = np.broadcast_to(np.complex64(0), self.shape)
        return self.dataset.drop_vars("capture").assign(transfer=(_HISTORY, zeros))

    @cached_property
    def form(self) -> Callable[[Pulses], Complexes]:
        """Numbers of a few pulses, ascending → their transfer functions, (pulse, subcarrier) complex64."""
        captures, correction = self.dataset.capture.values, _correction(self.dataset)
        frequency = self.dataset.frequency.values
        path_m = self.dataset.path_removed.values if "path_removed" in self.dataset else None

        def form(pulses: Pulses) -> Complexes:
            measured = self.source(captures[pulses], correction and correction.select(pulses))
            if path_m is None:
                return measured
            return remove_path(measured, frequency, delay_s=path_m[pulses] / SPEED_OF_LIGHT_M_S)

        return form

    def blocks(self) -> Iterator[Complexes]:
        """Yield `transfer` from its beginning, some pulses at a time."""
        return map(self.form, blocks_of(np.arange(len(self.dataset.time))))

    def at(self, pulses: slice) -> xr.Dataset:
        """Return the stage at some pulses, formed."""
        return self.stage.isel(pulse=pulses).load()


_HISTORY = ("pulse", "subcarrier")


class _Transfer(BackendArray):
    """Transfer functions as an array that is formed where it is read."""

    def __init__(self, echo: PairEcho) -> None:
        self._echo, self.shape, self.dtype = echo, echo.shape, np.dtype(np.complex64)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Complexes:
        support = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, self._formed))

    def _formed(self, key: tuple[Any, Any]) -> Complexes:
        pulses = np.arange(self.shape[0])[key[0]]
        some, back = np.unique(pulses, return_inverse=True)
        blocks = [self._echo.form(block) for block in blocks_of(some)]
        transfer = np.concatenate(blocks) if blocks else np.empty((0, self.shape[1]), np.complex64)
        if len(some) != pulses.size or (np.diff(np.atleast_1d(pulses)) < 0).any():
            transfer = transfer[back]
        return np.asarray((transfer if pulses.ndim else transfer[0])[..., key[1]])


def _source(rx: Acquisition, sent: Transmitted, saturation: Saturation, *, divided: bool) -> Form:
    """Return what forms transfer functions of captures of a recording."""
    read = rx.reader(["radar", "sidelink"] if divided else ["radar"], np.arange(len(rx.raw.start)))
    demodulator = Demodulator(sent.inverse, rx.numerology, sent.waveform.capture_samples)
    return forming(read, demodulator, saturation)


def _correction(stage: xr.Dataset) -> Correction | None:
    """Return what the pulses of a stage are corrected by; None where a node hears itself."""
    if "sidelink_amplitude" not in stage:
        return None
    amplitude, cell_m = stage.sidelink_amplitude.values, SPEED_OF_LIGHT_M_S / _bandwidth_hz(stage)
    noise = amplitude**2 / 10 ** (stage.sidelink_snr.values / 10)
    locked = np.isfinite(amplitude)
    delay, phase = stage.sidelink_delay.values / cell_m, stage.sidelink_phase.values
    known = [np.where(locked, values, 0.0) for values in (delay, phase, amplitude, noise)]
    path = LineOfSight(known[0], known[1], known[2], known[3], locked)
    clock_hz = stage.clock_offset.values if "clock_offset" in stage else None
    return Correction(stage.attrs["sidelink"]["method"], path, clock_hz, stage.attrs["clock"].get("sfo_ppm", 0.0))


def _bandwidth_hz(stage: xr.Dataset) -> float:
    frequency = stage.frequency.values
    return float((frequency[-1] - frequency[0]) * len(frequency) / (len(frequency) - 1))


def pair_echo(
    tx: Acquisition,
    rx: Acquisition,
    sent: Transmitted,
    processing: Processing,
    calibration: dict[str, Any] | None,
    air: SceneAir,
    *,
    hovers: bool = False,
) -> PairEcho:
    """Return the echo of a pair from its nodes' recordings; path offsets are the calibration's, or the config's.

    Pulses of a hover are left out unless `hovers`, as `apertura.stages.positions.place` does.
    """
    pulses = common_pulses(tx, rx, prf_hz=sent.waveform.prf_hz)
    repeats = rx.raw.repeats.values[pulses.rx_index]
    paired = np.flatnonzero(~pulses.outlier & ~repeats)
    positions = place(tx, rx, tx.raw.time.values[pulses.tx_index[paired]], hovers=hovers)
    paired = paired[positions.good]
    at = tx.raw.time.values[pulses.tx_index[paired]]
    measured, sidelink_m = _transfer((tx, rx), pulses.rx_index[paired], at, sent, processing, air)
    at = at[measured.kept]
    offset_m = calibration["offset_m"] if calibration else _stated_offset_m(rx, monostatic=tx.name == rx.name)
    beyond_m = offset_m - sidelink_m  # electrical path of an echo beyond tx → scene → rx
    aperture = Aperture(tx.antenna("radar_tx", at), rx.antenna("radar_rx", at))
    flown = air.over(aperture)
    delay_s = beyond_m / SPEED_OF_LIGHT_M_S
    dataset = xr.Dataset(
        {
            "time": ("pulse", at),
            "capture": ("pulse", pulses.rx_index[paired][measured.kept]),
            "path_removed": ("pulse", beyond_m),
            "tx_position": (("pulse", "axis"), aperture.tx_m),
            "rx_position": (("pulse", "axis"), aperture.rx_m),
            "frequency": ("subcarrier", rx.numerology.frequency_hz),
            "reference_delay": ("pulse", np.zeros(len(beyond_m))),
            "path_limit": ("pulse", flown.wave_speed_m_s * (sent.waveform.longest_delay_s - delay_s)),
            **_sidelink(measured),
            **_axes((tx, rx), at),
            **_sidelink_vector((tx, rx), at),
        },
        attrs=_attributes((tx, rx), pulses, positions, measured, repeats, at=at, calibration=calibration)
        | {"stated_offset_m": offset_m, **stated_air(flown)},
    )
    saturation = Saturation()
    return PairEcho(dataset, _source(rx, sent, saturation, divided=tx.name != rx.name), saturation)


def _attributes(
    nodes: tuple[Acquisition, Acquisition],
    pulses: Association,
    positions: PulsePositions,
    measured: Transfer,
    repeats: NDArray[np.bool_],
    *,
    at: Times,
    calibration: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return the attributes of an echo whose pulses were sent `at`: flags, counts of pulses left out, reports."""
    missing = missing_flags(at.astype("datetime64[ns]").astype(np.int64))
    attrs = {
        "frame": "ecef",
        "pair": "-".join(node.name for node in nodes),
        **measured.report,
        "positions": positions.report,
        "time_tags": _time_tags(nodes[0], pulses),
        "flags": Flags.merged(
            pulses.flags,
            _repeated(nodes[1], pulses, repeats),
            positions.flags,
            measured.flags,
            missing,
            calibration["flags"] if calibration else {},
        ),
        "pulses": _counted(len(nodes[0].raw.time), pulses, repeats, positions, measured),
    }
    if calibration:
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    return attrs


def _transfer(
    nodes: tuple[Acquisition, Acquisition],
    captures: NDArray[np.int64],
    at: Times,
    sent: Transmitted,
    processing: Processing,
    air: SceneAir,
) -> tuple[Transfer, NDArray[np.float64]]:
    """Return the transfer functions of captures, sent `at` the transmitter's tags, and electrical lengths of sidelinks.

    In metres; 0 without. Both ends are taken from the logs at the transmitter's tag (docs/theory.md, "Geometry").
    """
    tx, rx = nodes
    if tx.name == rx.name:
        read, sent_ns = rx.reader(["radar"], captures), at.astype("datetime64[ns]").astype(np.int64)
        measured = transfer_by_code(read, sent.inverse, rx.numerology, time_s=(sent_ns - sent_ns[0]) * 1e-9)
        return _of_what_was_sent(measured, sent), np.zeros(len(at))
    length_m = air.electrical_m(tx.antenna("sidelink", at), rx.antenna("sidelink", at))
    measured = transfer_by_sidelink(
        rx.reader(["radar", "sidelink"], captures),
        sent.inverse,
        rx.numerology,
        symbol_samples=sent.waveform.capture_samples,
        sidelink_m=length_m,
        method=processing.sidelink,
        accuracy_db=strictest_accuracy_db(processing.accuracy_db),
        where=str(rx.files),
    )
    return _of_what_was_sent(measured, sent), length_m[measured.kept]


def _sidelink(measured: Transfer) -> dict[str, tuple[str, Any]]:
    """Return what was measured of the sidelink in each pulse; nothing of a node that hears itself."""
    correction, kept = measured.correction, measured.kept
    if correction is None:
        return {}
    known = {
        "sidelink_delay": measured.sidelink_delay_m,
        "sidelink_snr": measured.sidelink_snr_db,
        "sidelink_phase": measured.sidelink_phase_rad,
        "sidelink_amplitude": np.where(correction.path.locked, correction.path.amplitude, np.nan)[kept],
        "clock_offset": correction.clock_hz if correction.clock_hz is None else correction.clock_hz[kept],
    }
    return {name: ("pulse", values) for name, values in known.items() if values is not None}


def _of_what_was_sent(measured: Transfer, sent: Transmitted) -> Transfer:
    """Return what captures measured, with what was decided of the waveform, and whether they hold it whole."""
    flags, waveform = dict(sent.flags), sent.waveform
    if measured.report.get("sidelink", {}).get("method") in DIVIDING:
        flags.pop("waveform_sidelobes", None)  # the pulse cancels: it is in both channels
    if isinstance(waveform, PulseWaveform) and measured.sidelink_delay_m is not None:
        window = {name: getattr(waveform, name) for name in ("lead_s", "pulse_s", "listen_s")}
        cell_s = 1 / (sent.numerology.numbers.size * sent.numerology.spacing_hz)
        cut = truncation_flags(measured.sidelink_delay_m / SPEED_OF_LIGHT_M_S, cell_s=cell_s, **window)
        flags = Flags.merged(flags, cut)
    report = {**measured.report, **({"waveform": sent.report} if sent.report else {})}
    return replace(measured, flags=Flags.merged(measured.flags, flags), report=report)


def _time_tags(tx: Acquisition, pulses: Association) -> dict[str, Any]:
    """Return how the nodes' tags lie to each other, and what is known of the transmitter's own errors."""
    return {
        **{name: getattr(pulses, name) for name in ("offset_s", "drift_ppm", "residual_s", "method")},
        "std_s": tx.settings.time_tag_std_s,
        "jitter_s": tag_jitter_s(tx.raw.time.values.astype("datetime64[ns]").astype(np.int64)),
    }


def _repeated(rx: Acquisition, pulses: Association, repeats: NDArray[np.bool_]) -> Flags:
    """Raise a flag where captures of the receiver repeat earlier ones bit for bit; they are left out."""
    if not repeats.any():
        return Flags()
    first = int(pulses.rx_index[int(repeats.argmax())])
    line = f"{int(repeats.sum())} of {len(repeats)} captures of {rx.name}, the first is number {first}"
    return Flags({"captures_repeated": line})


def _counted(
    sent: int, pulses: Association, repeats: NDArray[np.bool_], positions: PulsePositions, measured: Transfer
) -> dict[str, Any]:
    """Return how many of the pulses sent are used, how many not, and why."""
    used = int(measured.kept.sum())
    reasons = {
        "unpaired": pulses.tx_dropped,
        "time_tag_outlier": int(pulses.outlier.sum()),
        "captures_repeated": int((repeats & ~pulses.outlier).sum()),
        **positions.reasons,
        "sidelink_lost": int((~measured.kept).sum()),
    }
    return {"used": used, "dropped": sent - used, "reasons": {why: count for why, count in reasons.items() if count}}


def _axes(nodes: tuple[Acquisition, Acquisition], at: Times) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64]]]:
    """Return the body axes of the nodes whose attitude counts."""
    tx, rx = nodes
    turning = {"tx_axes": tx.turns("radar_tx") and tx, "rx_axes": rx.turns("radar_rx") and rx}
    return {name: (("pulse", "axis", "body"), node.body_axes(at)) for name, node in turning.items() if node}


def _sidelink_vector(nodes: tuple[Acquisition, Acquisition], at: Times) -> dict[str, tuple[tuple[str, ...], Any]]:
    """Return b of docs/theory/autofocus.md, eq. 2, where the echo was given back its length."""
    tx, rx = nodes
    if tx.name == rx.name:
        return {}
    return {"sidelink_vector": (("pulse", "axis"), tx.antenna("sidelink", at) - rx.antenna("sidelink", at))}


def _stated_offset_m(rx: Acquisition, *, monostatic: bool) -> float:
    stated = rx.settings.path_offset_m
    return stated.radar if monostatic else stated.radar - stated.sidelink


# ---- Echoes by the recorder's clock and antennas by the log's -------------------------------------------------------

MOST_PULSES = 8192
"""Of a recording, evenly spread: bounds memory; their changes show when the node moved."""


@dataclass(frozen=True, eq=False)
class Unaligned:
    """Echoes and log of a node before alignment.

    Attributes
    ----------
    echo, log
        As `apertura.methods.synchronisation` takes them: each by seconds of its own, from its first pulse and epoch.
    apart_ns
        Delay of the log's first epoch against the recorder's first pulse, nanoseconds.
    applied_ns
        Offset of config/clocks.tsv that the recorder's times already contain, nanoseconds.
    stated_ns
        That offset, 0 without.
    applied_ppm
        Drift stated there that they already contain.
    taken_off_m
        Path beyond geometry that was already removed from the echoes.
    own_clock
        Whether the recorder's times mean nothing but differences.
    """

    echo: Recorded
    log: Logged
    apart_ns: int
    applied_ns: int
    stated_ns: int
    applied_ppm: float
    taken_off_m: float
    own_clock: bool

    def less_path(self, path_m: float) -> "Unaligned":
        """Return the same without so much path beyond geometry in the echoes."""
        delay_s = self.echo.reference_delay_s - (path_m - self.taken_off_m) / SPEED_OF_LIGHT_M_S
        return replace(self, echo=replace(self.echo, reference_delay_s=delay_s), taken_off_m=path_m)

    def offset_ns(self, offset_s: float) -> int:
        """Return the offset for clocks.tsv, given one between the first pulse and the first epoch."""
        return self.applied_ns + self.apart_ns + round(offset_s * 1e9)

    @property
    def stated_s(self) -> float:
        """Offset at which `offset_ns` returns the stated one, seconds."""
        return (self.stated_ns - self.applied_ns - self.apart_ns) * 1e-9


def unaligned(campaign: Campaign, flight: str, node: str) -> Unaligned:
    """Return echoes and log of a node that sends and receives.

    Raises
    ------
    CampaignError
        If the node does not send and receive in that flight, has no log, or its echoes are not there yet.
    """
    flown = campaign.flight(flight)
    if f"{node}-{node}" not in flown.pairs:
        raise CampaignError(
            f"{node} does not send and receive in {flight}",
            where=campaign.root / FLIGHTS,
            expected=f"a node whose own pulses come back to it; pairs of {flight}: {', '.join(flown.pairs)}",
            remedy="Name such a node, or correct the line of the flight.",
        )
    clock = campaign.clock(flight, node)
    applied_ns, applied_ppm = 0, 0.0
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    if sampled:
        path = campaign.stage("echo", flight, f"{node}-{node}")
        if not manifest_of(path).is_file():
            raise CampaignError(
                "not there yet",
                where=path,
                expected=f"the echo of {node} by its own pulses",
                remedy="Run `apertura run CAMPAIGN --until echo` first.",
            )
        history = _some(PairEcho.opened(campaign, flight, f"{node}-{node}").stage)
        off_m, applied_ns = float(history.attrs["stated_offset_m"]), clock.offset_ns
        applied_ppm = clock.drift_ppm
    else:
        history = _some(read_history(campaign, flight, node, pair=f"{node}-{node}"))
        off_m = 0.0
    times = history.time.values
    log = raw_log(campaign, flight, node, shortest_wave(history.frequency.values))
    speed = wave_speed_of(history) if sampled else _wave_speed(campaign, log)
    echo = Recorded(
        np.asarray(history.transfer.values),
        history.frequency.values,
        history.reference_delay.values,
        seconds_since(times, times[0]),
        speed,
    )
    apart_ns = int((log.track.time.values[0] - times[0]).astype("timedelta64[ns]").astype(np.int64))
    own_clock = bool(times[0] < FIRST)
    return Unaligned(echo, _logged(log), apart_ns, applied_ns, clock.offset_ns, applied_ppm, off_m, own_clock)


def _some(history: xr.Dataset) -> xr.Dataset:
    """Return at most `MOST_PULSES` pulses, evenly spread."""
    return history.isel(pulse=slice(None, None, -(-history.sizes["pulse"] // MOST_PULSES)))


def _wave_speed(campaign: Campaign, log: NodeLog) -> float:
    """Return the speed of the wave over a whole log: which part of it was recorded is not known before alignment."""
    times = log.track.time.values[log.checked.kept]
    times = times[:: -(-len(times) // MOST_PULSES)][1:-1]
    aperture = Aperture(log.antenna("radar_tx", times), log.antenna("radar_rx", times))
    return scene_air(campaign, aperture.tx_m).over(aperture).wave_speed_m_s


def _logged(log: NodeLog) -> Logged:
    times = log.track.time.values[log.checked.kept]
    began = log.track.time.values[0]

    def phase_centres(at_s: NDArray[np.float64]) -> Aperture:
        at = began + np.round(at_s * 1e9).astype("timedelta64[ns]")
        return Aperture(log.antenna("radar_tx", at), log.antenna("radar_rx", at))

    first_s, last_s = seconds_since(times[[0, -1]], began)
    return Logged(phase_centres, first_s + 1e-9, last_s - 1e-9)
