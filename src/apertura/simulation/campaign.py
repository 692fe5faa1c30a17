"""Writer of simulated campaigns, in the format of real campaign folders, with the true values in truth.json."""

import json
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator, default_rng
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.geometry.geodesy import geodetic_from_ecef, projected_from_ecef
from apertura.formats.campaign_files import new_folder, write_config, write_csv_log, write_recording
from apertura.formats.tracks.rtklib import write_rtklib_pos
from apertura.formats.tracks.track import FIXES
from apertura.simulation.continuous import continuous_blocks, pulse_samples, recording_start_s
from apertura.simulation.impairments import Adc, independent_streams
from apertura.simulation.observation import Observation, fly
from apertura.simulation.specification import (
    CampaignSpecification,
    DrawnCampaign,
    SimulatedFlight,
    SimulatedNode,
    draw_campaign,
)
from apertura.simulation.synthesis import digitize, full_scale, periodic_samples, samples
from apertura.simulation.targets import Origin, PointTarget, Target, phase_centre, scatterers

TRUE_SYMBOLS = "symbols.npy"
"""File of the true code symbols, (frame, subcarrier) complex64, of a campaign whose config does not name them."""

_LOG_MARGIN_S = 2.0
_RTK_STD_M = 0.005, 0.005, 0.01  # north, east, up: accuracy that a receiver reports for a fixed solution
_PULSES_AT_ONCE = 16


def write_campaign(directory: Path, specification: CampaignSpecification, generator: Generator) -> Path:
    """Simulate a specification into a new or empty folder; the folder is renamed from a temporary one when complete.

    Raises
    ------
    CampaignError
        If the folder is not empty.
    """
    with new_folder(directory) as root:
        campaign = draw_campaign(specification, generator)
        _write_config(root, campaign)
        truth = _write_flights(root, campaign, generator)
        (root / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return directory


def _write_config(root: Path, campaign: DrawnCampaign) -> None:
    specification = campaign.specification
    scene, bounds = specification.scene, specification.scene.bounds(specification.origin)
    document = {
        "campaign": specification.campaign,
        "waveform": specification.waveform.section(campaign.waveform),
        "nodes": {name: _node_section(node) for name, node in specification.nodes.items()},
        "scene": {
            "crs": scene.crs,
            "bounds_m": bounds if bounds == "auto" else list(bounds),
            "spacing_m": scene.spacing_m,
            "height_m": specification.origin.height_m if scene.height_m is None else scene.height_m,
            "height_datum": "ellipsoid",
            **_atmosphere_section(specification),
        },
        **({"bench": {**specification.bench}} if specification.bench else {}),
        **({"stack": {**specification.stack}} if specification.stack else {}),
    }
    write_config(
        root,
        document,
        [(flight.name, flight.kind, flight.transmitter, flight.tracks) for flight in specification.flights],
    )
    _write_segments(root, specification)
    name, sent = campaign.waveform.sent
    framed = getattr(specification.waveform, "framed", False)
    np.save(root / TRUE_SYMBOLS if framed else root / "raw" / name, sent)


def _atmosphere_section(specification: CampaignSpecification) -> dict[str, Any]:
    """Return the section of the config on the atmosphere; empty for the standard atmosphere, which is the default."""
    if specification.atmosphere == "standard":
        return {}
    vacuum = specification.atmosphere == "vacuum"
    return {"atmosphere": {"refractivity_n": 0.0 if vacuum else specification.atmosphere}}


def _write_segments(root: Path, specification: CampaignSpecification) -> None:
    rows = [
        (flight.name, pair, *(np.datetime_as_string(_utc(flight, np.array(ends)), unit="us")))
        for flight in specification.flights
        for pair, segments in flight.segments.items()
        for ends in segments
    ]
    if rows:
        table = "".join("\t".join(row) + "\n" for row in (("flight", "pair", "start", "end"), *rows))
        (root / "config" / "segments.tsv").write_text(table, encoding="utf-8")


def _node_section(node: SimulatedNode) -> dict[str, Any]:
    path_offset_m = node.path_offset_m if node.stated_path_offset_m is None else node.stated_path_offset_m
    beams = {point: {key: list(pair) for key, pair in asdict(beam).items()} for point, beam in node.antennas.items()}
    return {
        **_radio_section(node, beams),
        "lever_arms_m": {name: list(arm) for name, arm in node.lever_arms_m.items()},
        "path_offset_m": dict(path_offset_m),
        "attitude": node.attitude,
        **({} if node.position_std_m is None else {"position_std_m": node.position_std_m}),
    }


def _radio_section(node: SimulatedNode, beams: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the beams of a node and the keys of its radio, if it has one, in the format of the config."""
    radio = node.radio
    if radio is None:
        return {"antennas": dict(beams)} if beams else {}
    gains = {"radar_tx_gain_dbi": radio.transmit_gain_dbi, "radar_rx_gain_dbi": radio.receive_gain_dbi}
    receiver = {"full_scale_dbm": radio.full_scale_dbm, "gain_db": radio.gain_db}
    receiver |= {} if radio.noise_figure_db is None else {"noise_figure_db": radio.noise_figure_db}
    return {
        "antennas": {**beams, **gains},
        "transmit_power_dbm": radio.transmit_power_dbm,
        "receiver": {"full_scale_counts": 2.0 ** (node.impairments.adc.bits - 1), **receiver},
        **({} if radio.amplitude_std_db is None else {"amplitude_std_db": radio.amplitude_std_db}),
    }


def _write_flights(root: Path, campaign: DrawnCampaign, generator: Generator) -> dict[str, Any]:
    """Simulate and write the flights one after the other; return the true values."""
    specification = campaign.specification
    origin, targets = specification.origin, specification.targets
    clutter, *streams = independent_streams(generator, 1 + 2 * len(specification.flights))
    unused = deepcopy(clutter)  # draws the clutter of a changed scene again
    common_scatterers = scatterers(origin, targets, clutter)
    air = specification.air
    true_air = {"refractivity_n": air.atmosphere.refractivity_n if air else 0.0, "at_m": origin.height_m}
    truth: dict[str, Any] = targets_truth(origin, targets, specification.scene.crs)
    truth |= {"atmosphere": true_air, "flights": {}}
    if any(node.radio is not None for node in specification.nodes.values()):
        for target in truth["targets"]:
            target["rcs_m2"] = target["amplitude"] ** 2
    for flight, impairments, noise in zip(specification.flights, streams[::2], streams[1::2], strict=True):
        (root / "raw" / flight.name).mkdir()
        if flight.framing:
            np.save(root / "raw" / flight.name / "preamble.npy", flight.framing.preamble())
        present = common_scatterers if flight.targets is None else scatterers(origin, flight.targets, clutter)
        if flight.changes:
            present = scatterers(origin, targets, deepcopy(unused), flight.changes)
        recordings = fly(campaign, flight, present, impairments)
        node_streams = independent_streams(noise, len(recordings))
        for (name, recording), stream in zip(recordings.items(), node_streams, strict=True):
            stem = root / "raw" / flight.name / name
            _write_log(stem, campaign, flight)
            _write_samples(stem, campaign, flight, recording, stream)
        truth["flights"][flight.name] = flight_truth(campaign, flight, recordings)
    return truth


def _write_samples(
    stem: Path, campaign: DrawnCampaign, flight: SimulatedFlight, recording: Observation, generator: Generator
) -> None:
    waveform, adc = campaign.waveform, campaign.specification.nodes[stem.name].impairments.adc
    time_s, draw, framing = campaign.pulse_times(flight), recording.draw, flight.framing
    if flight.continuous:
        blocks = continuous_blocks(
            recording.channels, time_s, adc, generator, framing=framing, first_frame=flight.first_frame
        )
        start_s = np.array([recording_start_s(recording.channels["radar"]) + draw.tag_error_s[0]])
        captures: list[tuple[int, np.datetime64, int | None]] = [(0, _to_us(_utc(flight, start_s))[0], None)]
    else:
        kept = np.flatnonzero(draw.kept)
        tags = _utc(flight, time_s + draw.start_s + draw.tag_error_s)
        periodic = campaign.specification.synthesis == "periodic"
        blocks = _captures(recording, adc, kept, generator, periodic=periodic)
        frames = [framing.counted(flight.first_frame + int(pulse)) if framing else None for pulse in kept]
        starts = range(0, len(kept) * waveform.capture_samples, waveform.capture_samples)
        captures = list(zip(starts, _to_us(tags[kept]), frames, strict=True))
    described: dict[str, Any] = {"core:hw": "simulated direct-RF node"}
    if framing:  # parameters of the trigger
        signal = {"preamble": f"raw/{flight.name}/preamble.npy", "centre_hz": framing.centre_hz(waveform)}
        described["apertura:framing"] = asdict(framing) | signal
    write_recording(
        stem,
        blocks,
        captures,
        channels=list(recording.channels),
        sample_rate_hz=waveform.sample_rate_hz,
        frequency_hz=waveform.carrier_hz,
        extra=described,
    )


def _captures(
    recording: Observation, adc: Adc, kept: NDArray[np.intp], generator: Generator, *, periodic: bool
) -> Iterator[NDArray[np.int16]]:
    """Yield the counts of captures in blocks, (sample, channel, 2)."""
    channels = recording.channels
    synthesis = periodic_samples if periodic else samples
    scales = {name: full_scale(channel, adc) for name, channel in channels.items()}
    noise = dict(zip(channels, independent_streams(generator, len(channels)), strict=True))
    for start in range(0, len(kept), _PULSES_AT_ONCE):
        block = kept[start : start + _PULSES_AT_ONCE]
        counts = [
            digitize(synthesis(channel, noise[name], block), adc, scales[name]) for name, channel in channels.items()
        ]
        yield np.stack(counts, axis=2).reshape(-1, len(counts), 2)


def _write_log(stem: Path, campaign: DrawnCampaign, flight: SimulatedFlight) -> None:
    node, path = campaign.specification.nodes[stem.name], campaign.trajectories[flight.name, stem.name]
    last_s = (flight.pulses - 1) / campaign.waveform.prf_hz
    rate_hz = node.log_rate_hz
    time_s = np.arange(np.floor(-_LOG_MARGIN_S * rate_hz), np.ceil((last_s + _LOG_MARGIN_S) * rate_hz) + 1) / rate_hz
    geodetic = geodetic_from_ecef(phase_centre(campaign.specification.origin, path, time_s))
    if node.log_format == "csv":
        logged = stem.with_name(f"{stem.name}.track.csv")
        write_csv_log(logged, _to_us(_utc(flight, time_s)), geodetic, path.attitude(time_s))
    else:
        write_rtklib_pos(
            stem.with_name(f"{stem.name}.track.pos"),
            _utc(flight, time_s).astype("datetime64[ms]"),  # the resolution of RTKLIB
            geodetic,
            fix=np.full(len(time_s), FIXES["fix"]),
            std_m=np.tile(_RTK_STD_M, (len(time_s), 1)),
            satellites=18,
            ratio=100.0,
            system="GPST" if node.log_format == "pos" else "UTC",
            header=("program   : RTKPOST ver.2.4.3", "pos mode  : Kinematic", ""),
        )


def _utc(flight: SimulatedFlight, time_s: NDArray[np.float64]) -> NDArray[np.datetime64]:
    return np.asarray(np.datetime64(flight.start_utc, "ns") + np.rint(time_s * 1e9).astype("timedelta64[ns]"))


def _to_us(times: NDArray[np.datetime64]) -> NDArray[np.datetime64]:
    """Return times in microseconds, the resolution of recorders and flight controllers."""
    return times.astype("datetime64[us]")


def targets_truth(origin: Origin, targets: tuple[Target, ...], crs: str) -> dict[str, Any]:
    """Return the true point targets in a projected CRS with ellipsoidal heights, and descriptions of other targets."""
    points = tuple(target for target in targets if isinstance(target, PointTarget))
    others = [repr(target) for target in targets if not isinstance(target, PointTarget)]
    placed = scatterers(origin, points, default_rng(0))
    columns = np.column_stack(
        [projected_from_ecef(crs, placed.position_m), np.abs(placed.amplitude), np.angle(placed.amplitude)]
    )
    listed = [dict(zip(("x", "y", "height_m", "amplitude", "phase_rad"), row, strict=True)) for row in columns.tolist()]
    return {"crs": crs, "targets": listed} | ({"extended": others} if others else {})


def flight_truth(
    campaign: DrawnCampaign, flight: SimulatedFlight, recordings: Mapping[str, Observation]
) -> dict[str, Any]:
    """Return the true values of a flight, node by node, including all random draws."""
    specification = campaign.specification
    truth: dict[str, Any] = {"pulses": flight.pulses, "kind": flight.kind, "nodes": {}}
    if flight.targets is not None:
        truth |= targets_truth(specification.origin, flight.targets, specification.scene.crs)
    if flight.changes:
        truth["changes"] = [
            {"target": change.target, "shift_m": list(change.shift_m), "factor": str(change.factor)}
            for change in flight.changes
        ]
    for name, recording in recordings.items():
        node, draw, radar = specification.nodes[name], recording.draw, recording.channels["radar"]
        truth["nodes"][name] = {
            "kept": None if draw.kept.all() else np.flatnonzero(draw.kept).tolist(),
            "cfo_hz": radar.cfo_hz,
            "sfo_hz": radar.sfo_hz,
            "path_offset_m": dict(node.path_offset_m),
            "phase_rad": _series(draw.phase_rad),
            "start_s": _series(draw.start_s),
            "tag_error_s": _series(draw.tag_error_s),
            "blocked": np.flatnonzero(draw.blocked).tolist(),
            "sidelink_spikes": np.flatnonzero((draw.direct != 1) | (draw.spike_echo != 0)).tolist(),
            "sidelink_error_rad": _series(draw.sidelink_error_rad),
            "position_error_m": draw.position_error_m.tolist() if draw.position_error_m.any() else 0.0,
            "channels": {
                channel_name: {
                    "noise_variance": channel.noise_variance,
                    "full_scale": full_scale(channel, node.impairments.adc),
                }
                for channel_name, channel in recording.channels.items()
            },
            "impairments": repr(node.impairments),
        }
        if flight.continuous:
            truth["nodes"][name]["pulse_start_sample"] = pulse_samples(radar, campaign.pulse_times(flight)).tolist()
    return truth


def _series(values: Floats) -> list[float] | float:
    """Return a single number if all values are equal, else the list of values."""
    return float(values[0]) if (values == values[0]).all() else values.tolist()
