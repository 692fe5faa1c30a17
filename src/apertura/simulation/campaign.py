"""A simulated campaign as a folder no different from a real one, with its truth beside it."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.atomic import replacement
from apertura.errors import CampaignError
from apertura.geometry.geodesy import geodetic_from_ecef
from apertura.simulation.continuous import continuous_blocks, recording_start_s
from apertura.simulation.flight import phase_centre
from apertura.simulation.hidden import independent_streams
from apertura.simulation.impairments import Adc
from apertura.simulation.logs import write_csv_log, write_pos_log
from apertura.simulation.plan import Flight, Node, Recorded, Simulation, fly, pulse_times
from apertura.simulation.recorder import Segment, write_recording
from apertura.simulation.recording import digitize, full_scale
from apertura.simulation.scene import Scene
from apertura.simulation.synthesis import samples
from apertura.simulation.truth import flight_truth, targets_truth, write_truth

_LOG_MARGIN_S = 2.0
_PULSES_AT_ONCE = 16


def write_campaign(directory: str | Path, simulation: Simulation, generator: Generator) -> Path:
    """Fly a simulation and write its campaign folder.

    Parameters
    ----------
    directory
        The folder to make; it must not exist, or be empty.
    simulation
        Who flies what over which scene.
    generator
        Everything random; the same state gives identical bytes.

    Returns
    -------
    Path
        `directory`.

    Raises
    ------
    CampaignError
        If the folder holds something already.

    Notes
    -----
    Source: the input contract, ../shared/DESIGN.md section 3.
    """
    directory = Path(directory)
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise CampaignError(
            "something is there already",
            where=directory,
            expected="a new or empty folder for the simulated campaign",
            remedy="Remove it or choose another name.",
        )
    with replacement(directory) as root:
        (root / "config").mkdir(parents=True)
        (root / "raw").mkdir()
        _write_config(root, simulation)
        write_truth(root / "truth.json", _write_flights(root, simulation, generator))
    return directory


def _write_config(root: Path, simulation: Simulation) -> None:
    waveform, grid = simulation.waveform, simulation.grid
    document = {
        "campaign": simulation.name,
        "waveform": {
            "kind": "ofdm",
            "codes": "raw/codes.npy",
            "carrier_hz": waveform.carrier_hz,
            "carrier_is": waveform.carrier_is,
            "subcarriers": len(waveform.codes),
            "subcarrier_spacing_hz": waveform.subcarrier_spacing_hz,
            "symbol_s": waveform.symbol_s,
            "cyclic_prefix_s": waveform.cyclic_prefix_s,
            "sample_rate_hz": waveform.sample_rate_hz,
            "prf_hz": waveform.prf_hz,
        },
        "nodes": {node.name: _node_section(node) for node in simulation.nodes},
        "scene": {
            "crs": grid.crs,
            "bounds_m": grid.bounds_m if grid.bounds_m == "auto" else list(grid.bounds_m),
            "spacing_m": grid.spacing_m,
            "height_m": grid.height_m,
            "height_datum": "ellipsoid",
        },
    }
    text = yaml.safe_dump(document, sort_keys=False)
    (root / "config" / "config.yaml").write_text(text, encoding="utf-8")
    rows = [
        "\t".join((flight.name, flight.kind, flight.transmitter, ",".join(flight.paths)))
        for flight in simulation.flights
    ]
    table = "\n".join(("flight\tkind\ttransmitter\tnodes", *rows)) + "\n"
    (root / "config" / "flights.tsv").write_text(table, encoding="utf-8")
    np.save(root / "raw" / "codes.npy", waveform.codes.astype(np.complex64))


def _node_section(node: Node) -> dict[str, Any]:
    stated = node.path_offset_m if node.stated_path_offset_m is None else node.stated_path_offset_m
    beams = {point: {key: list(pair) for key, pair in asdict(beam).items()} for point, beam in node.antennas.items()}
    return {
        **({"antennas": beams} if beams else {}),
        "lever_arms_m": {name: [float(value) for value in arm] for name, arm in node.lever_arms_m.items()},
        "path_offset_m": {name: float(value) for name, value in stated.items()},
        "attitude": node.attitude,
    }


def _write_flights(root: Path, simulation: Simulation, generator: Generator) -> dict[str, Any]:
    """Fly one flight after the other; return the truth."""
    ground, *streams = independent_streams(generator, 1 + 2 * len(simulation.flights))
    scatterers = simulation.scene.scatterers(ground)
    truth: dict[str, Any] = targets_truth(simulation.scene, simulation.grid) | {"flights": {}}
    for flight, drawing, noise in zip(simulation.flights, streams[::2], streams[1::2], strict=True):
        (root / "raw" / flight.name).mkdir()
        if flight.framing:
            np.save(root / "raw" / flight.name / "preamble.npy", flight.framing.preamble())
        there = scatterers
        if flight.targets is not None:
            there = Scene(simulation.scene.origin, flight.targets).scatterers(ground)
        recorded = fly(simulation, flight, there, drawing)
        for (name, record), own in zip(recorded.items(), independent_streams(noise, len(recorded)), strict=True):
            stem = root / "raw" / flight.name / name
            _write_log(stem, simulation, flight, simulation.node(name))
            _write_samples(stem, simulation, flight, record, own)
        truth["flights"][flight.name] = flight_truth(simulation, flight, recorded)
    return truth


def _write_samples(stem: Path, simulation: Simulation, flight: Flight, record: Recorded, generator: Generator) -> None:
    waveform, adc = simulation.waveform, simulation.node(stem.name).impairments.adc
    time_s = pulse_times(simulation, flight)
    if flight.continuous:
        blocks = continuous_blocks(
            record.channels, time_s, adc, generator, framing=flight.framing, first_frame=flight.first_frame
        )
        begun = np.array([recording_start_s(record.channels["radar"]) + record.hidden.tag_error_s[0]])
        segments = [Segment(0, _utc(flight, begun)[0])]
    else:
        kept = np.flatnonzero(record.hidden.kept)
        tags = _utc(flight, time_s + record.hidden.start_s + record.hidden.tag_error_s)
        blocks = _captures(record, adc, kept, generator)
        segments = [
            Segment(order * waveform.capture_samples, tags[pulse], _frame_number(flight, int(pulse)))
            for order, pulse in enumerate(kept)
        ]
    write_recording(
        stem,
        blocks,
        segments,
        channels=list(record.channels),
        sample_rate_hz=waveform.sample_rate_hz,
        frequency_hz=waveform.carrier_hz,
        extra=_framing_section(simulation, flight),
    )


def _captures(record: Recorded, adc: Adc, kept: NDArray[np.intp], generator: Generator) -> Iterator[NDArray[np.int16]]:
    """Yield (sample, channel, 2) counts of a few captures at a time."""
    scales = {name: full_scale(channel, adc) for name, channel in record.channels.items()}
    noise = dict(zip(record.channels, independent_streams(generator, len(record.channels)), strict=True))
    for start in range(0, len(kept), _PULSES_AT_ONCE):
        some = kept[start : start + _PULSES_AT_ONCE]
        counts = [
            digitize(samples(channel, noise[name], some), adc, scales[name])
            for name, channel in record.channels.items()
        ]
        yield np.stack(counts, axis=2).reshape(-1, len(counts), 2)


def _frame_number(flight: Flight, pulse: int) -> int | None:
    return flight.framing.counted(flight.first_frame + pulse) if flight.framing else None


def _framing_section(simulation: Simulation, flight: Flight) -> dict[str, Any]:
    """Say what a trigger must know, in the metadata of the recording itself."""
    if not flight.framing:
        return {}
    described = asdict(flight.framing) | {
        "preamble": f"raw/{flight.name}/preamble.npy",
        "centre_hz": flight.framing.centre_hz(simulation.waveform),
    }
    return {"apertura:framing": described}


def _write_log(stem: Path, simulation: Simulation, flight: Flight, node: Node) -> None:
    last_s = (flight.pulses - 1) / simulation.waveform.prf_hz
    epochs = np.arange(
        np.floor(-_LOG_MARGIN_S * node.log_rate_hz), np.ceil((last_s + _LOG_MARGIN_S) * node.log_rate_hz) + 1
    )
    time_s = epochs / node.log_rate_hz
    path = flight.paths[node.name]
    geodetic = geodetic_from_ecef(phase_centre(simulation.scene.origin, path, time_s))
    if node.log_format == "csv":
        write_csv_log(stem.with_name(f"{node.name}.track.csv"), _utc(flight, time_s), geodetic, path.attitude(time_s))
    else:
        system = "GPST" if node.log_format == "pos" else "UTC"
        write_pos_log(stem.with_name(f"{node.name}.track.pos"), _utc(flight, time_s), geodetic, system=system)


def _utc(flight: Flight, time_s: NDArray[np.float64]) -> NDArray[np.datetime64]:
    return np.asarray(np.datetime64(flight.start_utc, "ns") + np.rint(time_s * 1e9).astype("timedelta64[ns]"))
