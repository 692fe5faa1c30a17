"""Rule `echo`: pulse association, phase centres, clock and sidelink of a pair, from recordings and tracks.

The calibrated transfer functions follow from this stage and the recordings. The stage contains them if the recorder
stores transfer functions itself; otherwise rule `transfer` stores them if `processing.keep` lists echo.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Processing, PulseWaveform, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import save_stage
from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.common.units import nanoseconds
from apertura.core.echo.association import Association, missing_flags, tag_jitter_s
from apertura.core.echo.captures import repeat_flags, runs, sampled_pulses, spread
from apertura.core.echo.compression import window_weights
from apertura.core.echo.demodulate import demodulate
from apertura.core.echo.frame_codes import displacement
from apertura.core.echo.interference import Interference
from apertura.core.echo.pulse_filter import truncation_flags
from apertura.core.echo.sidelink import DIVIDING
from apertura.core.echo.transfer import (
    Transfer,
    as_complex,
    transfer_by_code,
    transfer_by_sidelink,
)
from apertura.core.echo.trigger import ABSENT
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.atmosphere import SceneAir
from apertura.core.quality.budget import strictest_accuracy_db
from apertura.stages.acquisition import Acquisition, common_pulses, open_acquisition
from apertura.stages.calibration import calibrated, calibration_spec
from apertura.stages.positions import PulsePositions, place, scene_air, stated_air
from apertura.stages.symbols import PairSymbols, ambiguous_symbols, rows_of
from apertura.stages.tags import stamped
from apertura.stages.transfer import (
    FEWEST_PULSES,
    PairEcho,
    demodulator_of,
    noise_variables,
    recorded_echo,
    save_transfer,
)
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.workflow.lineage import result_of


def echo(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/echo.zarr."""
    lineage = result_of(campaign, "echo", flight, pair).begin(campaign.root)
    waveform = campaign.settings.waveform
    parents: list[xr.Dataset] = []
    calibration = calibrated(campaign, flight, pair)
    if not isinstance(waveform, SampledWaveform):
        files = [campaign.root / name for name in lineage.result.sources]
        formed = PairEcho.recorded(recorded_echo(campaign, flight, pair))
    else:
        files = campaign.sent_files
        sent = transmitted(campaign, waveform)
        tx, rx = pair.split("-")
        source = campaign.symbol_source(flight, pair)
        names = dict.fromkeys(name for name in (tx, rx, source) if name is not None)
        nodes = {node: open_acquisition(campaign, flight, node, sent) for node in names}
        parents = [stage for node in nodes.values() for stage in (node.raw, node.track)]
        air = scene_air(campaign, nodes[tx].track.position.values)
        hovers = bool(campaign.segments_of(flight, pair))
        formed = pair_echo(
            nodes[tx],
            nodes[rx],
            sent,
            campaign.settings.processing,
            calibration,
            air,
            hovers=hovers,
            source=None if source is None else nodes[source],
        )
    formed = formed.within(campaign, flight, pair)
    inputs = {name: lineage.sources.digests[name] for name in map(campaign.relative, files)}
    if calibration:
        inputs = merged(inputs, calibration["inputs"])
    relevant = {**lineage.result.settings, "calibration": calibration_spec(calibration)}
    folder = campaign.stage("echo", flight, pair)
    origin: dict[str, Any] = {"modules": lineage.modules, "parents": parents, "settings": relevant, "inputs": inputs}
    if isinstance(waveform, SampledWaveform):
        save_stage(stamped(formed.dataset, "echo", **origin), folder, lineage=lineage)
    else:
        save_transfer(formed, stamped(formed.hollow, "echo", **origin), folder, lineage)
    return folder


def pair_echo(
    tx: Acquisition,
    rx: Acquisition,
    sent: Transmitted,
    processing: Processing,
    calibration: dict[str, Any] | None,
    air: SceneAir,
    *,
    hovers: bool = False,
    source: Acquisition | None = None,
) -> PairEcho:
    """Return the echo of a pair from its nodes' recordings, with calibrated or else configured path offsets.

    Pulses of a hover are excluded unless `hovers` is True, as in `apertura.stages.positions.place`. `source`: node
    whose sidelink gives unknown symbols of the pulses, by default the receiver.
    """
    pulses = common_pulses(tx, rx, prf_hz=sent.waveform.prf_hz, speed_m_s=tx.speed_m_s)
    repeats = rx.raw.repeats.values[pulses.rx_index]
    paired = np.flatnonzero(~pulses.outlier & ~repeats)
    positions = place(tx, rx, tx.raw.time.values[pulses.tx_index[paired]], hovers=hovers)
    paired = paired[positions.good]
    if sent.unknown is None:
        frames = tx.frames.numbers[pulses.tx_index[paired]]
        frames, displaced = _placed((tx, rx), pulses.rx_index[paired], frames, sent)
        decided, basis, channels = dict[str, Any](), tx.frames.basis, dict[str, Any]()
    else:
        if tx.name == rx.name and not sent.unknown.unambiguous:
            raise ambiguous_symbols()
        if source is None or source is rx:
            source, rows = rx, pulses.rx_index
        else:
            rows = rows_of(tx, source, prf_hz=sent.waveform.prf_hz)[pulses.tx_index]
        decision = PairSymbols.of(source, sent, rows[paired], processing.accuracy_db, is_monostatic=tx.name == rx.name)
        usable = decision.usable()
        sent, frames, paired = decision.sent, decision.rows[usable], paired[usable]
        decided, displaced = {"decided": decision.report(usable)}, Flags(decision.flags(usable))
        basis, channels = f"captures of {decision.source}", decision.variables
        processing = processing.model_copy(update={"sidelink": decision.sidelink_method(processing.sidelink)})
    at = tx.raw.time.values[pulses.tx_index[paired]]
    _check_number(len(at), pulses, rx)
    measured, sidelink_m = _transfer((tx, rx), (pulses.rx_index[paired], frames), at, sent, processing, air)
    at = at[measured.kept]
    _check_number(len(at), pulses, rx)
    stated = rx.settings.path_offset_m
    stated_m = stated.radar if tx.name == rx.name else stated.radar - stated.sidelink
    offset_m = calibration["offset_m"] if calibration else stated_m
    extra_path_m = offset_m - sidelink_m  # electrical path of an echo in addition to tx → scene → rx
    aperture = Aperture(tx.antenna("radar_tx", at), rx.antenna("radar_rx", at))
    air_on_track = air.over(aperture)
    extra_delay_s = extra_path_m / SPEED_OF_LIGHT_M_S
    # Body axes are stored for nodes whose attitude affects the echo.
    rotating = {"tx_axes": tx.turns("radar_tx") and tx, "rx_axes": rx.turns("radar_rx") and rx}
    geometry: dict[str, tuple[tuple[str, ...], NDArray[np.float64]]] = {
        name: (("pulse", "axis", "body"), node.body_axes(at)) for name, node in rotating.items() if node
    }
    if tx.name != rx.name:  # b of docs/theory/autofocus.md, eq. 2: the sidelink's length was added to the echo
        sidelink_m = tx.antenna("sidelink", at) - rx.antenna("sidelink", at)
        geometry["sidelink_vector"] = (("pulse", "axis"), sidelink_m)
    if sent.inverses.count > 1:
        symbols = {"rows": sent.inverses.count, "frames": basis, **decided, **measured.report.get("symbols", {})}
        report = {**measured.report, "symbols": symbols}
        measured = replace(measured, report=report, flags=Flags.merged(measured.flags, displaced))
    dataset = xr.Dataset(
        {
            "time": ("pulse", at),
            "capture": ("pulse", pulses.rx_index[paired][measured.kept]),
            "frame": ("pulse", frames[measured.kept]),
            "path_removed": ("pulse", extra_path_m),
            "tx_position": (("pulse", "axis"), aperture.tx_m),
            "rx_position": (("pulse", "axis"), aperture.rx_m),
            "frequency": ("subcarrier", rx.numerology.frequency_hz),
            "reference_delay": ("pulse", np.zeros(len(extra_path_m))),
            "path_limit": ("pulse", air_on_track.wave_speed_m_s * (sent.waveform.longest_delay_s - extra_delay_s)),
            **_sidelink(measured),
            **geometry,
            **channels,
        },
        attrs=_attributes((tx, rx), pulses, positions, measured, repeats, at=at, calibration=calibration)
        | {"stated_offset_m": offset_m, **stated_air(air_on_track)},
    )
    if processing.interference != "none":
        unchanged = processing.model_copy(update={"interference": "none"})
        dataset = dataset.assign(noise_variables(dataset, rx, sent, unchanged))
        lines = _tone_lines(PairEcho.formed(dataset, lambda: (rx, sent, unchanged)))
        dataset = dataset.assign_attrs(tone_lines=lines)
    return PairEcho.formed(dataset, lambda: (rx, sent, processing))


def _check_number(used: int, pulses: Association, rx: Acquisition) -> None:
    """Raise CampaignError if too few pulses remain for an image."""
    if used < FEWEST_PULSES:
        raise CampaignError(
            f"{used} of {len(pulses.rx_index)} common pulses remain",
            where=rx.recording,
            expected=f"at least {FEWEST_PULSES} pulses with good positions and the transmitted code",
            remedy="Check waveform.codes (file, seed, constellation, pilots), waveform.iq, and channels, time tags and "
            "logs of both nodes.",
        )


def _tone_lines(echo: PairEcho) -> list[int]:
    """Return the subcarriers with a line in most pulses, measured before the removal of tones."""
    groups, subcarriers = sampled_pulses(echo.shape[0]), echo.shape[1]
    sampled = runs(groups, [echo.read(group) for group in groups])
    equal = np.full(subcarriers, 1 / subcarriers)
    frequency, expected = echo.dataset.frequency.values, echo.expected_excess
    return Interference.measured(sampled, frequency, equal, expected=expected).lines


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
    """Return the attributes of an echo: flags, counts of excluded pulses, reports; `at`: transmit times."""
    tx, rx = nodes
    missing = missing_flags(nanoseconds(at))
    attrs = {
        "frame": "ecef",
        "pair": f"{tx.name}-{rx.name}",
        **measured.report,
        "positions": positions.report,
        "time_tags": {
            **{name: getattr(pulses, name) for name in ("offset_s", "drift_ppm", "residual_s", "method")},
            "std_s": tx.settings.time_tag_std_s,
            "jitter_s": tag_jitter_s(nanoseconds(tx.raw.time.values)),
        },
        "flags": Flags.merged(
            pulses.flags,
            repeat_flags(repeats, rx.name, first=int(pulses.rx_index[int(repeats.argmax())])),
            positions.flags,
            measured.flags,
            missing,
            calibration["flags"] if calibration else {},
        ),
        "pulses": _pulse_counts(len(tx.raw.time), pulses, repeats, positions, measured),
    }
    if calibration:
        attrs["calibration"] = {name: calibration[name] for name in ("flight", "offset_m", "std_m")}
    return attrs


def _placed(
    nodes: tuple[Acquisition, Acquisition], captures: NDArray[np.int64], frames: NDArray[np.int64], sent: Transmitted
) -> tuple[NDArray[np.int64], Flags]:
    """Return the frame numbers of captures, displaced if the symbols of other frames are found in them, and a flag."""
    tx, rx = nodes
    if sent.inverses.count == 1:
        return frames, Flags()
    channel = "radar" if tx.name == rx.name else "sidelink"
    tested = np.concatenate(spread(len(captures), groups=4, each=16))
    samples = rx.reader([channel], captures[tested])(np.arange(len(tested)))[channel]
    moved = displacement(
        demodulate(as_complex(samples), rx.numerology), sent.inverses, frames[tested], same_delay=rx is tx
    )
    if not moved:
        return frames, Flags()
    by_order = (tx.raw.frame.values == ABSENT).all()
    line = (
        f"{rx.files.name}: captures contain the symbols of the {abs(moved)}. frame {'after' if moved > 0 else 'before'}"
    )
    flags = Flags({"frames_displaced": f"{line} their frame number; {'corrected' if by_order else 'not corrected'}"})
    return (frames + moved if by_order else frames), flags


def _transfer(
    nodes: tuple[Acquisition, Acquisition],
    captures: tuple[NDArray[np.int64], NDArray[np.int64]],
    at: Times,
    sent: Transmitted,
    processing: Processing,
    air: SceneAir,
) -> tuple[Transfer, NDArray[np.float64]]:
    """Return the transfer functions of captures, and the electrical length of the sidelink per pulse, in metres.

    `captures`: their indices in the receiver's recording, and the frame numbers of their pulses. The length is 0 for
    a monostatic pair. `at`: time tags of the transmitter, at which both logs are evaluated (docs/theory.md,
    "Geometry").
    """
    (tx, rx), (index, frames) = nodes, captures
    accuracy_db = strictest_accuracy_db(processing.accuracy_db)
    # a later change of the window does not change the echo: the choice is that of a Hann window
    choose = sent.filter_choice(processing, frames, window_weights("hann", len(rx.numerology.frequency_hz)))
    sent_ns = nanoseconds(at)
    time_s = (sent_ns - sent_ns[0]) * 1e-9
    if tx.name == rx.name:
        read = rx.reader(["radar"], index)
        demodulator = demodulator_of(rx, sent, processing, frames)
        measured = transfer_by_code(read, demodulator, time_s=time_s, choose_symbols=choose)
        return _with_waveform(measured, sent), np.zeros(len(at))
    length_m = air.electrical_m(tx.antenna("sidelink", at), rx.antenna("sidelink", at))
    measured = transfer_by_sidelink(
        rx.reader(["radar", "sidelink"], index),
        demodulator_of(rx, sent, processing, frames),
        sidelink_m=length_m,
        method=processing.sidelink,
        accuracy_db=accuracy_db,
        where=str(rx.files),
        time_s=time_s,
        choose_symbols=choose,
    )
    return _with_waveform(measured, sent), length_m[measured.kept]


def _sidelink(measured: Transfer) -> dict[str, tuple[str, Any]]:
    """Return the sidelink measurements per pulse; empty for a monostatic pair."""
    correction, kept = measured.correction, measured.kept
    if correction is None:
        return {}
    quantities = {
        "sidelink_delay": measured.sidelink_delay_m,
        "sidelink_snr": measured.sidelink_snr_db,
        "sidelink_phase": measured.sidelink_phase_rad,
        "sidelink_amplitude": np.where(correction.path.locked, correction.path.amplitude, np.nan)[kept],
        "clock_offset": correction.clock_hz if correction.clock_hz is None else correction.clock_hz[kept],
    }
    return {name: ("pulse", values) for name, values in quantities.items() if values is not None}


def _with_waveform(measured: Transfer, sent: Transmitted) -> Transfer:
    """Add flags and report of the transmitted waveform, and flags of truncated captures, to the transfer functions."""
    flags, waveform = dict(sent.flags), sent.waveform
    if measured.report.get("sidelink", {}).get("method") in DIVIDING:
        flags.pop("waveform_sidelobes", None)  # both channels contain the pulse, and the division removes it
    if isinstance(waveform, PulseWaveform) and measured.sidelink_delay_m is not None:
        window = {name: getattr(waveform, name) for name in ("lead_s", "pulse_s", "listen_s")}
        cell_s = 1 / (sent.numerology.numbers.size * sent.numerology.spacing_hz)
        cut = truncation_flags(measured.sidelink_delay_m / SPEED_OF_LIGHT_M_S, cell_s=cell_s, **window)
        flags = Flags.merged(flags, cut)
    report = {**measured.report, **({"waveform": sent.report} if sent.report else {})}
    return replace(measured, flags=Flags.merged(measured.flags, flags), report=report)


def _pulse_counts(
    sent: int, pulses: Association, repeats: NDArray[np.bool_], positions: PulsePositions, measured: Transfer
) -> dict[str, Any]:
    """Count the transmitted pulses that are used, and the excluded ones by reason."""
    used, spikes = int(measured.kept.sum()), measured.report.get("sidelink", {}).get("spikes", 0)
    reasons = {
        "unpaired": pulses.tx_dropped,
        "time_tag_outlier": int(pulses.outlier.sum()),
        "captures_repeated": int((repeats & ~pulses.outlier).sum()),
        **positions.reasons,
        "symbols_unsure": measured.report.get("symbols", {}).get("decided", {}).get("unsure", 0),
        "sidelink_lost": int((~measured.kept).sum()) - spikes,
        "sidelink_spikes": spikes,
    }
    return {
        "used": used,
        "dropped": sent - used,
        "reasons": {reason: count for reason, count in reasons.items() if count},
    }
