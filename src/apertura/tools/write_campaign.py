"""Creation of a campaign folder from plain arrays and files; the folder is validated before it gets its final name."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.campaign.config import SampledWaveform, Scene, validated
from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL, ecef_from_geodetic, frame_from_map
from apertura.formats.campaign_files import DATATYPES, new_folder, write_config, write_csv_log, write_recording
from apertura.formats.reading import open_recording
from apertura.formats.times import outside, utc_times
from apertura.stages.node_log import read_log
from apertura.stages.transmitted import transmitted

_AT_ONCE = 1 << 20  # samples


@dataclass(frozen=True)
class RecordedNode:
    """Recording and log of one node in one flight.

    Attributes
    ----------
    samples
        I and Q, (sample, channel, 2) or (capture, sample, channel, 2) of int8, int16, int32 or float32; or the path of
        a .npy file with such an array, or of a file of little-endian int16 samples with interleaved channels.
    time_utc
        (capture,) datetime64 or ISO 8601, UTC: the node's own time tag of the first sample of each capture.
    track
        (epoch, 3) float64: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m); or the path of a flight log,
        whose copy keeps the suffix.
    track_utc
        (epoch,) datetime64 or ISO 8601, UTC; None with a flight log.
    attitude_deg
        (epoch, 3) float64: roll, pitch, yaw of forward-right-down axes, yaw clockwise from north; None: not logged.
    start
        (capture,) int64, first sample of each capture; None: contiguous captures of equal length.
    frame
        (capture,) int64, transmitted frame numbers; None: no frame numbers.
    channels
        Channel names in the order of the samples: radar, sidelink.
    """

    samples: NDArray[Any] | str | Path
    time_utc: ArrayLike
    track: NDArray[np.float64] | str | Path
    track_utc: ArrayLike | None = None
    attitude_deg: NDArray[np.float64] | None = None
    start: ArrayLike | None = None
    frame: ArrayLike | None = None
    channels: tuple[str, ...] = ("radar",)


@dataclass(frozen=True)
class RecordedFlight:
    """A line of flights.tsv, with the recordings of its nodes.

    Attributes
    ----------
    transmitter
        Name of the transmitting node.
    nodes
        Node → recording, including the transmitting node.
    kind
        image or calibration.
    """

    transmitter: str
    nodes: Mapping[str, RecordedNode]
    kind: str = "image"


def write_campaign(
    directory: str | Path,
    config: Mapping[str, Any],
    flights: Mapping[str, RecordedFlight],
    *,
    sent: NDArray[np.complexfloating] | None = None,
) -> Path:
    """Write a campaign folder from plain arrays and files, validate it by reading it, and return its path.

    Parameters
    ----------
    directory
        Folder to create; an existing folder must be empty.
    config
        Contents of config/config.yaml: campaign, waveform, nodes, scene and all other keys without default values.
    flights
        Flight → recordings.
    sent
        Transmitted signal, complex: code symbols of an OFDM waveform, (subcarriers,) or (frames, subcarriers), or
        (sample,) samples of a pulse.

    Raises
    ------
    CampaignError
        If the folder is not empty, a key or an array is invalid, or the written campaign cannot be read. No files are
        left behind in these cases.

    Notes
    -----
    Source: docs/formats.md.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> waveform = {"kind": "ofdm", "carrier_hz": 1.2e9, "subcarriers": 8, "subcarrier_spacing_hz": 1e6, "prf_hz": 1.0,
    ...             "symbol_s": 1e-6, "cyclic_prefix_s": 0.5e-6, "sample_rate_hz": 16e6}
    >>> node = RecordedNode(np.ones((2, 24, 1, 2), np.int16), ["2025-05-14T09:30:01", "2025-05-14T09:30:02"],
    ...                     track=np.array([[48, 9, 600.0], [48, 9.001, 600]]),
    ...                     track_utc=["2025-05-14T09:30:00", "2025-05-14T09:30:09"])
    >>> with TemporaryDirectory() as folder:
    ...     made = write_campaign(f"{folder}/c", {"campaign": "c", "waveform": waveform, "nodes": {"uav1": {}}},
    ...                           {"f01": RecordedFlight("uav1", {"uav1": node})}, sent=np.ones(8))
    ...     sorted(path.name for path in made.rglob("*") if path.is_file())
    ['codes.npy', 'config.yaml', 'flights.tsv', 'uav1.sigmf-data', 'uav1.sigmf-meta', 'uav1.track.csv']
    """
    directory = Path(directory)
    settings = validated(dict(config), where="write_campaign: config")
    if not isinstance(settings.waveform, SampledWaveform):
        found = f"waveform.kind {settings.waveform.kind}"
        raise _wrong("write_campaign: config", found, "a waveform that is recorded as samples")
    lines = [(name, flight.kind, flight.transmitter, flight.nodes) for name, flight in flights.items()]
    with new_folder(directory) as root:
        try:
            write_config(root, settings.model_dump(mode="json", exclude_unset=True), lines)
            campaign = Campaign.load(root)
            if sent is not None:
                if campaign.sent_path is None:
                    raise _wrong("write_campaign: sent", "an array", "None, because waveform.codes is a generator")
                sent_file = root / campaign.relative(campaign.sent_path)
                sent_file.parent.mkdir(parents=True, exist_ok=True)
                np.save(sent_file, np.asarray(sent, np.complex64))
            for name, flight in flights.items():
                (root / "raw" / name).mkdir()
                for node, recorded in flight.nodes.items():
                    _write_node(root / "raw" / name / node, recorded, settings.waveform)
                    _check_degrees(root / "raw" / name / node, recorded, settings.scene)
            transmitted(campaign, settings.waveform)
            _check_opens(campaign, flights)
        except CampaignError as problem:
            where = problem.where.replace(str(root), str(directory))
            raise CampaignError(problem.found, where, problem.expected, problem.remedy) from None
    return directory


def _write_node(stem: Path, recorded: RecordedNode, waveform: SampledWaveform) -> None:
    """Write the recording and the log of a node."""
    samples = _samples(recorded, stem)
    time, start = _times(recorded.time_utc, stem, "time_utc"), _starts(recorded, samples, stem)
    frame = [None] * len(time) if recorded.frame is None else np.asarray(recorded.frame).tolist()
    if not len(time) == len(start) == len(frame):
        found = f"{len(time)} time tags, {len(start)} starts and {len(frame)} frame numbers"
        raise _wrong(stem, found, "one time tag, one start and one frame number for each capture")
    flat = samples.reshape(-1, *samples.shape[-2:])
    write_recording(
        stem,
        (flat[first : first + _AT_ONCE] for first in range(0, len(flat), _AT_ONCE)),
        zip(start.tolist(), time, frame, strict=True),
        channels=recorded.channels,
        sample_rate_hz=waveform.sample_rate_hz,
        frequency_hz=waveform.carrier_hz,
        extra={},
    )
    _write_log(stem, recorded)


def _write_log(stem: Path, recorded: RecordedNode) -> None:
    if isinstance(recorded.track, str | Path):
        source = Path(recorded.track)
        if not source.is_file():
            raise _wrong(source, "no such file", f"the flight log of {stem.parent.name} {stem.name}")
        shutil.copyfile(source, stem.with_name(f"{stem.name}.track{source.suffix}"))
        return
    track, time = np.asarray(recorded.track, np.float64), _times(recorded.track_utc, stem, "track_utc")
    attitude = None if recorded.attitude_deg is None else np.radians(np.asarray(recorded.attitude_deg, np.float64))
    for name, values in (("track", track), ("attitude_deg", attitude)):
        if values is not None and values.shape != (len(time), 3):
            expected = f"shape ({len(time)}, 3) for the epochs of track_utc"
            raise _wrong(stem, f"{name} of shape {values.shape}", expected)
    write_csv_log(stem.with_name(f"{stem.name}.track.csv"), time, track, attitude)


_LARGEST_RAD = np.pi / 2, np.pi
_FARTHEST_M = 200e3  # maximum distance of a track from its scene
_SLOWEST_M_S, _FASTEST_M_S = 1.0, 120.0  # range of ground speeds of an image flight


def _check_degrees(stem: Path, recorded: RecordedNode, scene: Scene) -> None:
    """Raise CampaignError if latitude and longitude of a track are in radians.

    Radians interpreted as degrees give positions in the Gulf of Guinea, where there is no land, and distances that are
    57 times too short. A track in that region is rejected if it agrees with the scene only when its angles are
    interpreted as radians. Without a georeferenced scene, it is rejected if only this interpretation results in the
    speed of a flight.
    """
    track = recorded.track
    if isinstance(track, str | Path) or (np.abs(np.asarray(track)[:, :2]) > _LARGEST_RAD).any():
        return
    angles = np.asarray(track, np.float64)
    positions = [
        ecef_from_geodetic(factor * angles[:, 0], factor * angles[:, 1], angles[:, 2])
        for factor in (1.0, np.degrees(1.0))
    ]
    if scene.crs not in {"auto", LOCAL} and scene.bounds_m != "auto":
        xmin, ymin, xmax, ymax = scene.bounds_m
        middle = frame_from_map(scene.crs, (xmin + xmax) / 2, (ymin + ymax) / 2, 0.0)
        fits = [float(np.linalg.norm(position - middle, axis=1).min()) < _FARTHEST_M for position in positions]
        evidence = f"the track is within {_FARTHEST_M / 1e3:g} km of scene.bounds_m"
    else:
        seconds = np.diff(_times(recorded.track_utc, stem, "track_utc")) / np.timedelta64(1, "s")
        speeds = [
            float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1) / seconds)) for position in positions
        ]
        fits = [_SLOWEST_M_S <= speed <= _FASTEST_M_S for speed in speeds]
        evidence = f"the median speed is {speeds[1]:.3g} m/s instead of {speeds[0]:.2g} m/s"
    if fits == [False, True]:
        latitude, longitude = angles[0, :2]
        coordinates = f"latitude {latitude:.6g}, longitude {longitude:.6g}"
        found = f"{coordinates}, apparently in radians: read as radians, {evidence}"
        raise _wrong(stem, found, "degrees (for a flight at this position, configure scene.crs and scene.bounds_m)")


def _samples(recorded: RecordedNode, stem: Path) -> NDArray[Any]:
    """Return samples as an array in memory or mapped from a file."""
    samples, channels = recorded.samples, len(recorded.channels)
    if isinstance(samples, str | Path):
        path = Path(samples)
        if not path.is_file() or not path.stat().st_size:
            raise _wrong(path, "no such file, or an empty file", f"the samples of {stem.parent.name} {stem.name}")
        if path.suffix == ".npy":
            try:
                samples = np.load(path, mmap_mode="r", allow_pickle=False)
            except (ValueError, EOFError) as error:
                raise _wrong(path, f"not readable ({error})", "an array in a .npy file") from error
        elif path.stat().st_size % (4 * channels):
            raise _wrong(
                path, f"{path.stat().st_size} bytes", f"a multiple of {4 * channels}: int16, {channels} channels"
            )
        else:
            samples = np.memmap(path, "<i2", "r").reshape(-1, channels, 2)
    array: NDArray[Any] = np.asanyarray(samples)
    if array.dtype.name not in DATATYPES or array.ndim not in (3, 4) or array.shape[-2:] != (channels, 2):
        found = f"samples of {array.dtype}, shape {array.shape}"
        raise _wrong(stem, found, f"(sample, {channels}, 2) or (capture, sample, {channels}, 2) of {[*DATATYPES]}")
    return array


def _starts(recorded: RecordedNode, samples: NDArray[Any], stem: Path) -> NDArray[np.int64]:
    """Return the first sample of each capture."""
    if recorded.start is not None:
        return np.asarray(recorded.start, np.int64)
    total = int(np.prod(samples.shape[:-2]))
    captures = samples.shape[0] if samples.ndim == 4 else np.size(recorded.time_utc)
    if not captures or total % captures:
        raise _wrong(stem, f"{total} samples, {captures} captures", "captures of equal length, or `start` indices")
    return np.arange(captures, dtype=np.int64) * (total // captures)


def _times(given: ArrayLike | None, stem: Path, name: str) -> NDArray[np.datetime64]:
    """Return times as datetime64[ns]; text in time zones other than UTC is rejected."""
    times = np.asarray([] if given is None else given).reshape(-1)
    try:
        if times.dtype.kind != "M":
            return utc_times([str(text).removesuffix("Z") for text in times])
        beyond = outside(times.astype("datetime64[s]"))
        if beyond.size:
            raise ValueError(f"{times[beyond[0]]} is not between 1980 and 2199")
    except ValueError as error:
        raise _wrong(stem, f"{name}: {error}", "datetime64 or ISO 8601, UTC") from error
    return times.astype("datetime64[ns]")


def _check_opens(campaign: Campaign, flights: Mapping[str, RecordedFlight]) -> None:
    """Raise CampaignError if the written campaign cannot be read, or its time tags differ from the given time tags."""
    for flight in campaign.flights:
        for node in flight.participants:
            recording = open_recording(campaign.recording_files(flight.name, node))
            recording.check_hash()
            recording.cut(recording.captures, node=node)
            stem, given = campaign.root / "raw" / flight.name / node, flights[flight.name].nodes[node]
            if not np.array_equal(recording.captures.time, _times(given.time_utc, stem, "time_utc")):
                raise _wrong(stem, "written time tags that differ from the given time tags", "unchanged time tags")
            read_log(campaign, flight.name, node)


def _wrong(where: object, found: str, expected: str) -> CampaignError:
    return CampaignError(found, where, expected, "Correct the arguments of write_campaign.")
