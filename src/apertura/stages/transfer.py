"""Transfer functions of a pair: formed from the recording on reading, recorded, or stored by rule `transfer`."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from apertura.campaign.config import CONFIG, Processing, SampledWaveform
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.campaign.store import finish, open_stage, write_blocks, writing
from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, number_of
from apertura.common.flags import Flags
from apertura.common.units import nanoseconds, seconds_since
from apertura.core.echo.association import missing_flags
from apertura.core.echo.background import Background
from apertura.core.echo.captures import Pulses, Read, Saturation, blocks_of
from apertura.core.echo.compression import window_weights
from apertura.core.echo.dechirp import sweep_motion_flags
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.interference import PulsedInterference
from apertura.core.echo.line_of_sight import LineOfSight
from apertura.core.echo.symbol_filter import filter_of
from apertura.core.echo.tones import Tones
from apertura.core.echo.transfer import Correction, Demodulator, forming, noise_statistics
from apertura.core.geometry.geodesy import LOCAL
from apertura.stages.acquisition import Acquisition, open_acquisition
from apertura.stages.node_log import raw_log, read_history, shortest_wave
from apertura.stages.positions import (
    in_air,
    keep_segments,
    place,
    stated_error,
)
from apertura.stages.symbols import decided_symbols, with_symbols
from apertura.stages.tags import stamped
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.workflow.lineage import reads_kept, result_of

Form = Callable[[Pulses, Correction | None], Complexes]
"""Ascending capture indices and their correction → transfer functions, (pulse, subcarrier) complex64."""


@dataclass(frozen=True, eq=False)
class PairEcho:
    """Echo of a pair, whose transfer functions are formed on reading, block by block.

    Attributes
    ----------
    dataset
        Stage `echo`; if it has no `transfer`, `capture` (pulse,) is the capture index of each pulse.
    source
        Function that forms transfer functions from captures, or reads those that a recorder stored.
    saturation
        Saturation of the samples read so far.
    removed
        Background that is subtracted in `stage`; None: no background is subtracted.
    gain
        (subcarrier,) float32, factors that `stage` applies: 0 for subcarriers with interference; None: no factors.
    pulsed
        Interference that `stage` removes from subcarriers of single pulses; None: nothing is removed.
    tones
        Channel → tones removed from the samples read so far; empty: tones are not removed.
    """

    dataset: xr.Dataset
    source: Form
    saturation: Saturation = field(default_factory=Saturation)
    removed: Background | None = None
    gain: NDArray[np.float32] | None = None
    pulsed: PulsedInterference | None = None
    tones: Mapping[str, Tones] = field(default_factory=dict)

    @classmethod
    def recorded(cls, echo: xr.Dataset) -> "PairEcho":
        """Return the echo of a recorder that stores transfer functions."""
        history = echo.transfer

        def form(rows: Pulses, _: Correction | None) -> Complexes:
            return np.asarray(history[rows].values)

        return cls(echo.drop_vars("transfer").assign(capture=("pulse", np.arange(len(history)))), form)

    @classmethod
    def opened(cls, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Open a finished stage `echo`; its recording is opened when transfer functions are read.

        If the recording is missing, the bit-identical transfer functions of stage `transfer` are used.

        Raises
        ------
        CampaignError
            If the stage is damaged or missing; on reading transfer functions, if the recording is damaged or missing
            and stage `transfer` was not kept.
        """
        stage = open_stage(campaign.stage("echo", flight, pair), "echo")
        if "transfer" not in stage and reads_kept(campaign, flight, pair):
            kept = open_stage(campaign.stage("transfer", flight, pair), "transfer")
            stage = stage.assign(transfer=kept.transfer).assign_attrs(flags=kept.attrs["flags"])

        def receiver() -> tuple[Acquisition, Transmitted, Processing]:
            waveform = campaign.settings.waveform
            if not isinstance(waveform, SampledWaveform):
                raise TypeError("the echo has no transfer functions although its recorder stores them")
            sent, processing = transmitted(campaign, waveform), campaign.settings.processing
            name, source = pair.split("-")[1], campaign.symbol_source(flight, pair)
            rx = open_acquisition(campaign, flight, name, sent)
            if source is not None:
                node = rx if source == name else open_acquisition(campaign, flight, source, sent)
                sent = with_symbols(sent, node, decided_symbols(node, sent, processing.accuracy_db, stage))
            return rx, sent, processing

        return cls.formed(stage, receiver)

    @classmethod
    def formed(
        cls, dataset: xr.Dataset, receiver: Callable[[], tuple[Acquisition, Transmitted, Processing]]
    ) -> "PairEcho":
        """Return the echo of a dataset whose captures `receiver` opens when transfer functions are first read."""
        saturation, tones = Saturation(), dict[str, Tones]()

        @cache
        def source() -> Form:
            read, demodulator = _receiver(dataset, *receiver())
            tones.update(demodulator.tones)
            for channel in tones.values():
                channel.lines = tuple(dataset.attrs.get("tone_lines", ()))
            return forming(read, demodulator, saturation)

        def form(captures: Pulses, correction: Correction | None) -> Complexes:
            return source()(captures, correction)

        return cls(dataset, form, saturation, tones=tones)

    @classmethod
    def cleaned(cls, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Open a finished echo without the background and interference that a finished stage `profile` removes."""
        echo, folder = cls.opened(campaign, flight, pair), campaign.stage("profile", flight, pair)
        if not campaign.is_current(folder):
            return echo
        profile, removed, pulsed = open_stage(folder, "profile"), None, None
        if "background" in profile:
            removed = Background(profile.background.values, profile.background_time.values)
        gain = profile.subcarrier_gain.values if "subcarrier_gain" in profile else None
        if "interference_level" in profile:
            weight = window_weights(profile.attrs["window"], profile.sizes["subcarrier"])
            kept_weight = weight if gain is None else weight * gain
            level = profile.interference_level.values
            pulsed = PulsedInterference(level, kept_weight, noise_peak=echo.noise_peak)
        kept = np.isin(echo.dataset.time.values, profile.time.values)
        echo = echo if kept.all() else echo.select(kept)
        reports = {name: profile.attrs[name] for name in ("background", "interference")}
        return replace(echo, dataset=echo.dataset.assign_attrs(reports), removed=removed, gain=gain, pulsed=pulsed)

    def select(self, kept: NDArray[np.bool_]) -> "PairEcho":
        """Return the echo with the pulses of a mask only."""
        removed = self.removed
        if removed:  # its times start at the first pulse
            removed = replace(removed, time_s=removed.time_s - self.time_s[kept][0])
        return replace(self, dataset=self.dataset.isel(pulse=kept), removed=removed)

    def within(self, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Return the echo without the pulses outside the segments of its pair."""
        return replace(self, dataset=keep_segments(campaign, flight, pair, self.dataset))

    @property
    def flags(self) -> dict[str, str]:
        """Flags of the stage, and of the samples read so far."""
        tones = self.tones["radar"].flags("interference") if "radar" in self.tones else {}
        return Flags.merged(self.dataset.attrs["flags"], self.saturation.flags, tones)

    @property
    def noise_peak(self) -> Floats | float:
        """Largest noise relative to that of a constant gain; 1 if it is constant."""
        of_symbols = float(self.dataset.attrs.get("symbols", {}).get("noise_peak", 1.0))
        return np.maximum(of_symbols, self.dataset.noise_peak.values) if "noise_peak" in self.dataset else of_symbols

    @property
    def expected_excess(self) -> Floats | float:
        """Noise of each subcarrier relative to that of its neighbours without interference, as of `expected_excess`."""
        return self.dataset.noise_excess.values if "noise_excess" in self.dataset else 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """Pulses and subcarriers."""
        return self.dataset.sizes["pulse"], self.dataset.sizes["subcarrier"]

    @property
    def stage(self) -> xr.Dataset:
        """Stage `echo`, whose `transfer` is formed or read on access, after removal of background and interference."""
        if "transfer" in self.dataset and self.removed is None and self.gain is None and self.pulsed is None:
            return self.dataset
        return self.dataset.assign(transfer=xr.Variable(_HISTORY, indexing.LazilyIndexedArray(_Transfer(self))))

    @property
    def hollow(self) -> xr.Dataset:
        """Stage `echo` without `capture`, with a `transfer` of zeros that uses no memory."""
        zeros = np.broadcast_to(np.complex64(0), self.shape)
        return self.dataset.drop_vars("capture").assign(transfer=(_HISTORY, zeros))

    @cached_property
    def form(self) -> Callable[[Pulses], Complexes]:
        """Ascending pulse indices → transfer functions, (pulse, subcarrier) complex64."""
        captures, correction = self.dataset.capture.values, _correction(self.dataset)
        frequency = self.dataset.frequency.values
        path_m = self.dataset.path_removed.values if "path_removed" in self.dataset else None

        def form(pulses: Pulses) -> Complexes:
            measured = self.source(captures[pulses], correction and correction.select(pulses))
            if path_m is None:
                return measured
            return remove_path(measured, frequency, delay_s=path_m[pulses] / SPEED_OF_LIGHT_M_S)

        return form

    @property
    def time_s(self) -> Floats:
        """(pulse,) float64, seconds since the first pulse."""
        time = self.dataset.time.values
        return seconds_since(time, time[0])

    @property
    def extra_s(self) -> Floats:
        """(pulse,) float64, recorded delay of an echo in addition to the geometric one, seconds."""
        if "path_removed" not in self.dataset:
            return np.zeros(len(self.dataset.time))
        return np.asarray(self.dataset.path_removed.values / SPEED_OF_LIGHT_M_S)

    @property
    def delay_s(self) -> Floats:
        """(pulse,) float64, delay that is removed from the recorder's transfer functions, seconds."""
        return np.asarray(self.extra_s + self.dataset.reference_delay.values)

    def read(self, pulses: Pulses) -> Complexes:
        """Return the transfer functions of ascending pulse indices after removal of background and interference."""
        transfer = self.dataset.transfer[pulses].values if "transfer" in self.dataset else self.form(pulses)
        if self.gain is not None:
            transfer = transfer * self.gain
        if self.removed is not None:
            frequency_hz = self.dataset.frequency.values
            transfer = transfer - self.removed.at(self.time_s[pulses], frequency_hz, self.delay_s[pulses])
        return np.asarray(transfer if self.pulsed is None else self.pulsed.removed(transfer))

    def recorded_at(self, pulses: Pulses) -> Complexes:
        """Return the transfer functions of ascending pulse indices, on the delay scale of the recorder."""
        return remove_path(self.read(pulses), self.dataset.frequency.values, delay_s=-self.delay_s[pulses])

    def blocks(self) -> Iterator[Complexes]:
        """Yield `transfer` from the first pulse on, in blocks of pulses."""
        return map(self.form, blocks_of(np.arange(len(self.dataset.time))))

    def at(self, pulses: slice) -> xr.Dataset:
        """Return the stage for a slice of pulses, with its transfer functions in memory."""
        return self.stage.isel(pulse=pulses).load()


_HISTORY = ("pulse", "subcarrier")


class _Transfer(BackendArray):
    """Array of transfer functions that are formed on reading."""

    def __init__(self, echo: PairEcho) -> None:
        self._echo, self.shape, self.dtype = echo, echo.shape, np.dtype(np.complex64)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Complexes:
        support = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, self._formed))

    def _formed(self, key: tuple[Any, Any]) -> Complexes:
        pulses = np.arange(self.shape[0])[key[0]]
        unique, inverse = np.unique(pulses, return_inverse=True)
        blocks = [self._echo.read(block) for block in blocks_of(unique)]
        transfer = np.concatenate(blocks) if blocks else np.empty((0, self.shape[1]), np.complex64)
        if len(unique) != pulses.size or (np.diff(np.atleast_1d(pulses)) < 0).any():
            transfer = transfer[inverse]
        return np.asarray((transfer if pulses.ndim else transfer[0])[..., key[1]])


def demodulator_of(
    rx: Acquisition, sent: Transmitted, processing: Processing, frames: NDArray[np.int64]
) -> Demodulator:
    """Return the demodulator of a receiving node; it removes tones unless `processing.interference` is none.

    Parameters
    ----------
    rx, sent, processing
        Receiving node, transmitted signal and settings.
    frames
        (capture,) int64, frame number of each capture by its number in the reader of samples.
    """
    demodulator = Demodulator(
        lambda captures: sent.inverses.at(frames[captures]),
        rx.numerology,
        sent.waveform.capture_samples,
        spectrum=sent.spectrum,
    )
    return demodulator if processing.interference == "none" else demodulator.without_tones()


def _receiver(
    dataset: xr.Dataset, rx: Acquisition, sent: Transmitted, processing: Processing
) -> tuple[Read, Demodulator]:
    """Return the reader of a receiving node's samples by capture index, and the demodulator of stage `echo`."""
    frames = np.zeros(len(rx.raw.start), np.int64)
    frames[dataset.capture.values] = dataset.frame.values
    demodulator = demodulator_of(rx, sent, processing, frames)
    channels = ["radar", "sidelink"] if "sidelink_amplitude" in dataset else ["radar"]
    read = rx.reader(channels, np.arange(len(rx.raw.start)))
    return read, replace(demodulator, filter=filter_of(dataset.attrs.get("symbols", {})))


def noise_variables(
    dataset: xr.Dataset, rx: Acquisition, sent: Transmitted, processing: Processing
) -> dict[str, tuple[str, NDArray[np.float32]]]:
    """Return the variables `noise_excess` and `noise_peak` of a stage `echo`."""
    statistics = noise_statistics(
        *_receiver(dataset, rx, sent, processing), dataset.capture.values, _correction(dataset)
    )
    names = "noise_excess", "noise_peak"
    return {name: ("subcarrier", values.astype(np.float32)) for name, values in zip(names, statistics, strict=True)}


def _correction(stage: xr.Dataset) -> Correction | None:
    """Return the sidelink correction of a stage's pulses; None for a monostatic pair."""
    if "sidelink_amplitude" not in stage:
        return None
    frequency, amplitude = stage.frequency.values, stage.sidelink_amplitude.values
    bandwidth_hz = float((frequency[-1] - frequency[0]) * len(frequency) / (len(frequency) - 1))
    cell_m = SPEED_OF_LIGHT_M_S / bandwidth_hz
    noise = amplitude**2 / 10 ** (stage.sidelink_snr.values / 10)
    locked = np.isfinite(amplitude)
    delay, phase = stage.sidelink_delay.values / cell_m, stage.sidelink_phase.values
    delay, phase, amplitude, noise = (np.where(locked, values, 0.0) for values in (delay, phase, amplitude, noise))
    path = LineOfSight(delay, phase, amplitude, noise, locked)
    clock_hz = stage.clock_offset.values if "clock_offset" in stage else None
    return Correction(stage.attrs["sidelink"]["method"], path, clock_hz, stage.attrs["clock"].get("sfo_ppm", 0.0))


# ---- Recorders that store transfer functions: FMCW, phase history ---------------------------------------------------


FEWEST_PULSES = 3
"""Smallest number of pulses of an echo: positions, rates and interference follow from neighbouring pulses."""


def recorded_echo(campaign: Campaign, flight: str, pair: str) -> xr.Dataset:
    """Return the echo of a pair as a recorder stored it, with times on the clock of the flight log.

    Raises
    ------
    CampaignError
        If positions are stored neither with the samples nor in a flight log, or in both; if their frame is not that of
        the scene; or if there are fewer than `FEWEST_PULSES` pulses, or all their positions are equal.
    """
    tx, rx = pair.split("-")
    history = read_history(campaign, flight, rx, pair=pair)
    where = campaign.history_files(flight, rx)[0]
    _check_number(history, where)
    history = history.assign(time=("pulse", campaign.clock(flight, rx).utc(history.time.values)))
    logged, has_positions = campaign.logged(flight, tx), "tx_position" in history
    if logged == has_positions:
        raise CampaignError(
            "positions both with the samples and in a flight log" if logged else "samples without positions",
            where=where,
            expected="positions from a single source: either stored with the samples or read from a flight log "
            "raw/<flight>/<node>.track.*",
            remedy="Remove one of them." if logged else "Copy the flight log there.",
        )
    if logged:
        return in_air(campaign, _with_log_positions(campaign, flight, (tx, rx), history))
    crs = campaign.settings.scene.crs
    local = history.attrs["frame"] == LOCAL
    if local != (crs == LOCAL):
        raise CampaignError(
            f"{crs} for a phase history with positions in {'a local frame' if local else 'ECEF'}",
            where=f"{CONFIG}: scene.crs",
            expected=LOCAL if local else "an EPSG code, or auto",
            remedy="Correct scene.crs.",
        )
    legs = (history.tx_position.values, history.rx_position.values)
    if all((position_m == position_m[0]).all() for position_m in legs):
        raise CampaignError(
            "the antenna positions of all pulses are equal",
            where=where,
            expected="antennas that move: without an aperture, no image can be formed",
            remedy="Store the positions at each pulse.",
        )
    history = in_air(campaign, history)
    nodes = campaign.settings.nodes
    accuracies = {leg: stated_error(nodes[node]) | {"node": node} for leg, node in (("tx", tx), ("rx", rx))}
    return history.assign_attrs(positions=accuracies)


def _check_number(history: xr.Dataset, where: Path) -> None:
    """Raise CampaignError if too few pulses remain for an image."""
    if history.sizes["pulse"] < FEWEST_PULSES:
        raise CampaignError(
            f"{number_of(history.sizes['pulse'], 'pulse')} with samples and positions",
            where=where,
            expected=f"at least {FEWEST_PULSES}",
            remedy="Check that the recording is complete, and that its times are those of the flight log.",
        )


def _with_log_positions(campaign: Campaign, flight: str, nodes: tuple[str, str], history: xr.Dataset) -> xr.Dataset:
    """Return a phase history with antenna positions from the logs, without the pulses that have no position.

    The path offset of the receiving node (docs/theory.md, eq. 3) is subtracted from the reference delay of the samples;
    samples are unchanged.
    """
    wave_m = shortest_wave(history.frequency.values)
    logs = {node: raw_log(campaign, flight, node, wave_m) for node in nodes}
    tx, rx = (logs[node] for node in nodes)
    segmented = bool(campaign.segments_of(flight, "-".join(nodes)))
    positions = place(tx, rx, history.time.values, hovers=segmented)
    history = history.isel(pulse=positions.good)
    _check_number(history, campaign.history_files(flight, nodes[1])[0])
    at = history.time.values
    offset_s = rx.settings.path_offset_m.radar / SPEED_OF_LIGHT_M_S
    rotating = {"tx_axes": tx.turns("radar_tx") and tx, "rx_axes": rx.turns("radar_rx") and rx}
    axes: dict[str, Any] = {
        name: (("pulse", "axis", "body"), log.body_axes(at)) for name, log in rotating.items() if log
    }
    recorded = history.attrs.get("pulses", {}).get("reasons", history.attrs.get("dropped", {}))
    reasons = {**recorded, **positions.reasons}
    counts: dict[str, Any] = {"used": len(at), "dropped": sum(reasons.values()), "reasons": reasons}
    antennas = tx.antenna("radar_tx", at), rx.antenna("radar_rx", at)
    lasting_s = history.attrs.get("sweep_used_s", 0.0)
    missing = missing_flags(nanoseconds(at))
    motion = sweep_motion_flags(at, antennas, lasting_s=lasting_s, frequency_hz=history.frequency.values)
    return history.assign(
        reference_delay=history.reference_delay - offset_s,
        path_limit=history.path_limit - offset_s * SPEED_OF_LIGHT_M_S,
        tx_position=(("pulse", "axis"), antennas[0]),
        rx_position=(("pulse", "axis"), antennas[1]),
        **axes,
    ).assign_attrs(
        frame=tx.track.attrs["frame"],
        flags=Flags.merged(history.attrs["flags"], positions.flags, motion, missing),
        positions=positions.report,
        pulses=counts,
        stated_offset_m=rx.settings.path_offset_m.radar,
        time_tags={"std_s": rx.settings.time_tag_std_s},
    )


def transfer(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/transfer.zarr: the transfer functions of the pulses in echo.zarr."""
    lineage = result_of(campaign, "transfer", flight, pair).begin(campaign.root)
    formed, folder = PairEcho.opened(campaign, flight, pair), campaign.stage("transfer", flight, pair)
    kept = formed.hollow[["time", "frequency", "transfer"]]
    save_transfer(formed, stamped(kept, "transfer", modules=lineage.modules, parents=[formed.dataset]), folder, lineage)
    return folder


def save_transfer(formed: PairEcho, stage: xr.Dataset, folder: Path, lineage: Lineage) -> None:
    """Write a stage with the transfer functions of a pair, block by block."""
    with writing(folder) as wip:
        write_blocks(wip, stage, "transfer", formed.blocks())
        finish(wip, folder, lineage=lineage, flags=formed.flags)
