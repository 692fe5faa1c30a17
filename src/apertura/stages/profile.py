"""Rule `profile`: range profiles of a pair from its transfer functions, cropped to the ranges of the scene."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Processing
from apertura.campaign.folder import Campaign
from apertura.campaign.store import blocks_of_rows, finish, write_blocks, writing
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.core.echo.background import Background, GroupMeans, background_excess_db
from apertura.core.echo.captures import runs, sampled_pulses
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.gain_step import gain_step_flags
from apertura.core.echo.interference import Interference, NoisyPulses, PulsedInterference
from apertura.core.imaging.background import BackgroundScene, Removal, decide_removal
from apertura.core.imaging.range_profiles import CompressionError, RangeWindow, phase_history_of, range_compress
from apertura.stages.pair import open_pair, pattern_digests
from apertura.stages.planning import gated, ranges_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import stamped
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of


def profile(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/profile.zarr, block by block."""
    lineage = result_of(campaign, "profile", flight, pair).begin(campaign.root)
    echo, scene = PairEcho.opened(campaign, flight, pair), open_scene(campaign)
    # Opened for itself: samples read for the decisions do not count twice among those checked for saturation.
    cleaning = _decide(PairEcho.opened(campaign, flight, pair), scene, campaign.settings.processing)
    echo = replace(echo, gain=cleaning.gain, removed=cleaning.background, pulsed=cleaning.pulsed)
    settings = {**lineage.result.settings, **scene.spec}
    inputs = merged(scene.inputs, pattern_digests(campaign, pair))
    folder = campaign.stage("profile", flight, pair)

    def write(wip: Path, echo: PairEcho, noisy: NoisyPulses) -> float:
        """Write the profiles of all pulses of an echo, add them to `noisy`; return the compression error, dB."""
        source, error = echo.stage, CompressionError(np.random.default_rng(0))
        window = ranges_of(campaign, gated(campaign, open_pair(campaign, flight, pair, echo=source), scene), scene)
        dataset = _empty(echo, window, campaign.settings.processing.window)
        parents = [source, *scene.parents]
        stage = stamped(dataset, "profile", modules=lineage.modules, parents=parents, settings=settings, inputs=inputs)
        write_blocks(wip, stage, "profile", _compressed(source, dataset.attrs["window"], window, scene, error, noisy))
        return round(error.decibels, 2)

    with writing(folder) as wip:
        noisy = NoisyPulses()
        error_db = write(wip, echo, noisy)
        power = noisy.power
        if cleaning.interference is None:
            noisy = NoisyPulses()
        kept = np.where(noisy.excluded, 0.0, power) if noisy.excluded.any() else power
        steps = gain_step_flags(kept, echo.time_s)
        flags = Flags.merged(echo.flags, steps, cleaning.flags, noisy.flags)  # before samples are read again
        if noisy.excluded.any():
            error_db = write(wip, echo.select(~noisy.excluded), NoisyPulses())
        attributes: dict[str, Any] = {
            "background": {"requested": campaign.settings.processing.background_method, **cleaning.background_report},
            "interference": cleaning.interference_report(noisy),
        }
        finish(wip, folder, lineage=lineage, flags=flags, compression_error_db=error_db, **attributes)
    return folder


def _empty(echo: PairEcho, window: RangeWindow, requested: str) -> xr.Dataset:
    """Return stage `profile` with zeros, which use no memory, in place of the profiles."""
    source = echo.stage
    zeros = np.broadcast_to(np.complex64(0), (source.sizes["pulse"], window.samples))
    dataset = source[["time", "tx_position", "rx_position"]].assign(
        profile=(("pulse", "range"), zeros), start=("pulse", window.start_m)
    )
    if echo.gain is not None:
        dataset["subcarrier_gain"] = ("subcarrier", echo.gain)
    if echo.pulsed:
        dataset["interference_level"] = ("subcarrier", echo.pulsed.level)
    if echo.removed:
        dataset["background"] = (("background_knot", "subcarrier"), echo.removed.values)
        dataset["background_time"] = ("background_knot", echo.removed.time_s)
    frequency = source.frequency.values
    dataset.attrs = {name: source.attrs[name] for name in ("frame", "pair", "flags")} | {
        "background": {},  # set after the last pulse
        "interference": {},
        "step_m": window.step_m,
        "centre_frequency_hz": centre_frequency(frequency),
        "oversampling": window.unambiguous / len(frequency),
        "window": requested,
        "wave_speed_m_s": window.wave_speed_m_s,
        "compression_error_db": 0.0,
    }
    return dataset


@dataclass(frozen=True)
class _Cleaning:
    """Decisions on interference and background of a pair; None: not requested, or nothing to remove."""

    interference: Interference | None = None
    removal: Removal | None = None
    pulsed: PulsedInterference | None = None

    @property
    def gain(self) -> NDArray[np.float32] | None:
        return self.interference.gain if self.interference and self.interference.is_removed else None

    @property
    def background(self) -> Background | None:
        return self.removal.background if self.removal else None

    @property
    def background_report(self) -> dict[str, Any]:
        return self.removal.report if self.removal else {}

    def interference_report(self, noisy: NoisyPulses) -> dict[str, Any]:
        if not self.interference:
            return {}
        pulsed = {"pulsed": self.pulsed.report} if self.pulsed else {}
        return {**self.interference.report, **pulsed, **({"noisy_pulses": noisy.report} if noisy.report else {})}

    @property
    def flags(self) -> Flags:
        return Flags.merged(*(part.flags for part in (self.interference, self.removal, self.pulsed) if part))


def _decide(echo: PairEcho, scene: OpenScene, processing: Processing) -> _Cleaning:
    """Decide on the removal of interference and background of a pair."""
    method, frequency = processing.background_method, echo.dataset.frequency.values
    pulses, cleaning = sampled_pulses(echo.shape[0]), _Cleaning()
    sampled = [echo.read(group) for group in pulses] if (processing.interference, method) != ("none", "none") else []
    weight = window_weights(processing.window, echo.shape[1])
    if processing.interference != "none":
        expected = echo.expected_excess
        cleaning = _Cleaning(Interference.measured(runs(pulses, sampled), frequency, weight, expected=expected))
        if cleaning.gain is not None:
            echo = replace(echo, gain=cleaning.gain)
            sampled = [group * cleaning.gain for group in sampled]
            weight = weight * cleaning.gain
    parts = zip(sampled, pulses, strict=True)
    if method not in ("auto", "none") or (
        method == "auto"
        and background_excess_db([remove_path(part, frequency, delay_s=-echo.delay_s[at]) for part, at in parts]) >= 0
    ):
        history = phase_history_of(echo.stage, processing.window, lazy=True)
        over_scene = BackgroundScene(history, echo.delay_s, echo.extra_s, echo.time_s, scene.grid, scene.level)
        means = GroupMeans.of(echo.recorded_at, echo.time_s)
        removal = decide_removal(means, over_scene, method=method, generator=np.random.default_rng(0))
        cleaning = replace(cleaning, removal=removal)
        if removal.background:
            sampled = [
                part - removal.background.at(echo.time_s[at], frequency, echo.delay_s[at])
                for part, at in zip(sampled, pulses, strict=True)
            ]
    if cleaning.interference:
        cleaning = replace(
            cleaning, pulsed=PulsedInterference.measured(sampled, frequency, weight, noise_peak=echo.noise_peak)
        )
    return cleaning


def _compressed(
    source: xr.Dataset,
    requested: str,
    window: RangeWindow,
    scene: OpenScene,
    error: CompressionError,
    noisy: NoisyPulses,
) -> Iterator[NDArray[np.complex64]]:
    """Yield the profiles of one chunk of the echo at a time; zeros if none of its pulses contributes to the scene."""
    for part in blocks_of_rows(source, "transfer"):
        if not window.contributing[part].any():
            noisy.skip(part.stop - part.start)
            yield np.zeros((part.stop - part.start, window.samples), np.complex64)
            continue
        history = phase_history_of(source.isel(pulse=part), requested)
        chunk = window.part(part)
        profiles = range_compress(history, scene.grid, scene.terrain, window=chunk)
        error.add(history, profiles, chunk.gate)
        noisy.add(history.transfer, profiles.samples)
        yield profiles.samples
