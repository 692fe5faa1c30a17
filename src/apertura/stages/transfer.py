"""Transfer functions of a pair: formed from the recording when they are read, recorded, or kept by rule `transfer`."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from apertura.campaign.config import CONFIG, SampledWaveform
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.campaign.store import finish, open_stage, write_blocks, writing
from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import nanoseconds, seconds_since
from apertura.core.echo.association import missing_flags
from apertura.core.echo.background import Background
from apertura.core.echo.captures import Pulses, Saturation, blocks_of
from apertura.core.echo.dechirp import sweep_motion_flags
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.line_of_sight import LineOfSight
from apertura.core.echo.transfer import (
    Correction,
    Demodulator,
    forming,
)
from apertura.core.geometry.geodesy import LOCAL
from apertura.stages.acquisition import Acquisition, open_acquisition
from apertura.stages.node_log import raw_log, read_history, shortest_wave
from apertura.stages.positions import (
    in_air,
    keep_segments,
    place,
    stated_error,
)
from apertura.stages.tags import stamped
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.workflow.lineage import reads_kept, result_of

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
    removed
        Background that `stage` is without.
    gain
        (subcarrier,) float32, factors of `stage`: 0 where interference is excluded.
    """

    dataset: xr.Dataset
    source: Form
    saturation: Saturation = field(default_factory=Saturation)
    removed: Background | None = None
    gain: NDArray[np.float32] | None = None

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
            return forming_from(receiver, sent, saturation, divided="sidelink_amplitude" in stage)

        def form(captures: Pulses, correction: Correction | None) -> Complexes:
            return source()(captures, correction)

        return cls(stage, form, saturation)

    @classmethod
    def cleaned(cls, campaign: Campaign, flight: str, pair: str) -> "PairEcho":
        """Return a finished echo without what a finished stage `profile` removes: background and interference."""
        echo, folder = cls.opened(campaign, flight, pair), campaign.stage("profile", flight, pair)
        if not campaign.is_current(folder):
            return echo
        profile, removed = open_stage(folder, "profile"), None
        if "background" in profile:
            removed = Background(profile.background.values, profile.background_time.values)
        gain = profile.subcarrier_gain.values if "subcarrier_gain" in profile else None
        reports = {name: profile.attrs[name] for name in ("background", "interference")}
        return replace(echo, dataset=echo.dataset.assign_attrs(reports), removed=removed, gain=gain)

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
        """The stage, its `transfer` read or formed on access, less the background that is removed."""
        if "transfer" in self.dataset and self.removed is None and self.gain is None:
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

    @property
    def time_s(self) -> Floats:
        """(pulse,) float64, seconds from the first pulse."""
        time = self.dataset.time.values
        return seconds_since(time, time[0])

    @property
    def extra_s(self) -> Floats:
        """(pulse,) float64, delay of an echo in the recorder beyond geometry."""
        if "path_removed" not in self.dataset:
            return np.zeros(len(self.dataset.time))
        return np.asarray(self.dataset.path_removed.values / SPEED_OF_LIGHT_M_S)

    @property
    def delay_s(self) -> Floats:
        """(pulse,) float64, delay that is removed from the recorder's transfer functions."""
        return np.asarray(self.extra_s + self.dataset.reference_delay.values)

    def read(self, pulses: Pulses) -> Complexes:
        """Return the transfer functions of a few pulses, ascending, without removed background and interference."""
        transfer = self.dataset.transfer[pulses].values if "transfer" in self.dataset else self.form(pulses)
        if self.gain is not None:
            transfer = transfer * self.gain
        if self.removed is None:
            return np.asarray(transfer)
        frequency_hz = self.dataset.frequency.values
        return np.asarray(transfer - self.removed.at(self.time_s[pulses], frequency_hz, self.delay_s[pulses]))

    def recorded_at(self, pulses: Pulses) -> Complexes:
        """Return the transfer functions of a few pulses, ascending, in delays of the recorder."""
        return remove_path(self.read(pulses), self.dataset.frequency.values, delay_s=-self.delay_s[pulses])

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
        blocks = [self._echo.read(block) for block in blocks_of(some)]
        transfer = np.concatenate(blocks) if blocks else np.empty((0, self.shape[1]), np.complex64)
        if len(some) != pulses.size or (np.diff(np.atleast_1d(pulses)) < 0).any():
            transfer = transfer[back]
        return np.asarray((transfer if pulses.ndim else transfer[0])[..., key[1]])


def forming_from(rx: Acquisition, sent: Transmitted, saturation: Saturation, *, divided: bool) -> Form:
    """Return the former of transfer functions of a recording, divided by the sidelink or by the code."""
    read = rx.reader(["radar", "sidelink"] if divided else ["radar"], np.arange(len(rx.raw.start)))
    demodulator = Demodulator(sent.inverse, rx.numerology, sent.waveform.capture_samples)
    return forming(read, demodulator, saturation)


def _correction(stage: xr.Dataset) -> Correction | None:
    """Return the correction of the pulses of a stage; None of a monostatic pair."""
    if "sidelink_amplitude" not in stage:
        return None
    frequency, amplitude = stage.frequency.values, stage.sidelink_amplitude.values
    bandwidth_hz = float((frequency[-1] - frequency[0]) * len(frequency) / (len(frequency) - 1))
    cell_m = SPEED_OF_LIGHT_M_S / bandwidth_hz
    noise = amplitude**2 / 10 ** (stage.sidelink_snr.values / 10)
    locked = np.isfinite(amplitude)
    delay, phase = stage.sidelink_delay.values / cell_m, stage.sidelink_phase.values
    known = [np.where(locked, values, 0.0) for values in (delay, phase, amplitude, noise)]
    path = LineOfSight(known[0], known[1], known[2], known[3], locked)
    clock_hz = stage.clock_offset.values if "clock_offset" in stage else None
    return Correction(stage.attrs["sidelink"]["method"], path, clock_hz, stage.attrs["clock"].get("sfo_ppm", 0.0))


# ---- Recorders that store transfer functions: FMCW, phase history ---------------------------------------------------


def recorded_echo(campaign: Campaign, flight: str, pair: str) -> xr.Dataset:
    """Return the echo of a pair as a recorder wrote it, at the times of its log's clock.

    Raises
    ------
    CampaignError
        If positions travel neither with the samples nor in a flight log, or do in both; or if the scene is in another
        frame than theirs.
    """
    tx, rx = pair.split("-")
    history = read_history(campaign, flight, rx, pair=pair)
    history = history.assign(time=("pulse", campaign.clock(flight, rx).utc(history.time.values)))
    logged, placed = campaign.logged(flight, tx), "tx_position" in history
    if logged == placed:
        found = "positions both with the samples and in a flight log" if logged else "samples without positions"
        expected = "positions of one source: phase history with positions, or a flight log raw/<flight>/<node>.track.*"
        where, remedy = (
            campaign.history_files(flight, rx)[0],
            "Take one away." if logged else "Copy the flight log there.",
        )
        raise CampaignError(found, where, expected, remedy)
    if logged:
        return in_air(campaign, _placed_by_logs(campaign, flight, (tx, rx), history))
    crs = campaign.settings.scene.crs
    local = history.attrs["frame"] == LOCAL
    if local != (crs == LOCAL):
        raise CampaignError(
            f"{crs} for phase history with positions {'in metres of a frame of its own' if local else 'on Earth'}",
            where=f"{CONFIG}: scene.crs",
            expected=LOCAL if local else "an EPSG code, or auto",
            remedy="Correct scene.crs.",
        )
    history = in_air(campaign, history)
    nodes = campaign.settings.nodes
    known = {leg: stated_error(nodes[node]) | {"node": node} for leg, node in (("tx", tx), ("rx", rx))}
    return history.assign_attrs(positions=known)


def _placed_by_logs(campaign: Campaign, flight: str, nodes: tuple[str, str], history: xr.Dataset) -> xr.Dataset:
    """Return phase history at the antennas' places, without the pulses that have none.

    The path of the receiving node beyond geometry (docs/theory.md, eq. 3) comes off the delay that samples are referred
    to: no sample changes.
    """
    wave_m = shortest_wave(history.frequency.values)
    logs = {node: raw_log(campaign, flight, node, wave_m) for node in nodes}
    tx, rx = (logs[node] for node in nodes)
    segmented = bool(campaign.segments_of(flight, "-".join(nodes)))
    placed = place(tx, rx, history.time.values, hovers=segmented)
    history = history.isel(pulse=placed.good)
    at = history.time.values
    offset_s = rx.settings.path_offset_m.radar / SPEED_OF_LIGHT_M_S
    turning = {"tx_axes": tx.turns("radar_tx") and tx, "rx_axes": rx.turns("radar_rx") and rx}
    axes: dict[str, Any] = {
        name: (("pulse", "axis", "body"), log.body_axes(at)) for name, log in turning.items() if log
    }
    left_out = {**history.attrs.get("dropped", {}), **placed.reasons}
    counts: dict[str, Any] = {"used": len(at), "dropped": sum(left_out.values()), "reasons": left_out}
    antennas = tx.antenna("radar_tx", at), rx.antenna("radar_rx", at)
    lasting_s = history.attrs.get("sweep_used_s", 0.0)
    missing = missing_flags(nanoseconds(at))
    moved = sweep_motion_flags(at, antennas, lasting_s=lasting_s, frequency_hz=history.frequency.values)
    return history.assign(
        reference_delay=history.reference_delay - offset_s,
        path_limit=history.path_limit - offset_s * SPEED_OF_LIGHT_M_S,
        tx_position=(("pulse", "axis"), antennas[0]),
        rx_position=(("pulse", "axis"), antennas[1]),
        **axes,
    ).assign_attrs(
        frame=tx.track.attrs["frame"],
        flags=Flags.merged(history.attrs["flags"], placed.flags, moved, missing),
        positions=placed.report,
        pulses=counts,
        stated_offset_m=rx.settings.path_offset_m.radar,
        time_tags={"std_s": rx.settings.time_tag_std_s},
    )


def transfer(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/transfer.zarr, pulse by pulse those of echo.zarr."""
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
