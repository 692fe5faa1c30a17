"""Contents of one file as plain values: a flight log, a recording, phase history, a DEM."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.check.times import (
    LOST_CAPTURE,
    Span,
    TimeFacts,
    frame_numbers,
    recorded_span,
    time_facts,
)
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import geodetic_from_ecef, longitude_range, longitudes_about
from apertura.core.geometry.track_checks import LONG_GAP, CheckedTrack, check_track
from apertura.formats.recordings.recording import Recording
from apertura.formats.tracks.track import FIXES

if TYPE_CHECKING:
    import xarray as xr
    from rasterio import DatasetReader

PRODUCT_TAG = "APERTURA_VERSION"
"""Tag of every raster that apertura writes."""

METRES = frozenset({"", "m", "metre", "meter", "metres", "meters"})
"""Units of heights that are metres, or not stated."""

WAVE_M = 0.25
"""Wavelength that errors between epochs of a log by itself are compared with: L-band."""

_FIX_NAMES = {number: name for name, number in FIXES.items()}
_ACROSS = 512  # posts along a side of a DEM that are read

Range = list[float]
"""Lowest and highest."""


@dataclass(frozen=True, eq=False)
class LogFacts:
    """Contents of a flight log.

    Attributes
    ----------
    times
        When it was logged; a gap is longer than `LONG_GAP` intervals.
    dropped
        Reason → epochs that the reader left out.
    fixes
        Kind of solution → epochs; None where the log says none.
    attitude_share
        Of the epochs, those with roll, pitch and yaw.
    has_attitude
        Whether any angle is logged at any epoch.
    frame
        ecef or local.
    bounds
        Of `bounds_of`.
    middle_m
        (3,) float64: the median of each coordinate in `frame`, metres.
    middle_geodetic
        (3,) float64: the median of latitude, longitude (deg) and ellipsoidal height (m); None in a local frame.
    length_m
        Of the straight lines between epochs, metres.
    median_speed_m_s, largest_speed_m_s
        Between epochs, metres per second.
    stated_std_m
        Median standard deviation to north, east and up, metres, as the log states it; None of an axis, or of all,
        where it does not.
    remarks
        What a person should know of how it was read.
    """

    times: TimeFacts
    dropped: Mapping[str, int]
    fixes: Mapping[str, int] | None
    attitude_share: float
    has_attitude: bool
    frame: str
    bounds: Mapping[str, Range]
    middle_m: NDArray[np.float64]
    middle_geodetic: NDArray[np.float64] | None
    length_m: float
    median_speed_m_s: float
    largest_speed_m_s: float
    stated_std_m: tuple[float | None, ...] | None
    remarks: tuple[str, ...]


def log_facts(track: "xr.Dataset") -> LogFacts:
    """Return the contents of a flight log; `track` is its stage."""
    times, position, frame = track.time.values, track.position.values, track.attrs["frame"]
    steps_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    speed_m_s = steps_m / np.diff(seconds_since(times, times[0]))
    logged = np.isfinite(track.attitude.values)
    places = geodetic_from_ecef(position) if frame == "ecef" else position
    return LogFacts(
        times=time_facts(times, longer=LONG_GAP),
        dropped={why: int(count) for why, count in track.attrs["dropped"].items()},
        fixes=_fixes(track),
        attitude_share=float(logged.all(axis=1).mean()),
        has_attitude=bool(logged.any()),
        frame=frame,
        bounds=_bounds(places, frame),
        middle_m=np.median(position, axis=0),
        middle_geodetic=_middle(places) if frame == "ecef" else None,
        length_m=float(steps_m.sum()),
        median_speed_m_s=float(np.median(speed_m_s)),
        largest_speed_m_s=float(speed_m_s.max()),
        stated_std_m=_stated_std_m(track),
        remarks=tuple(track.attrs.get("remarks", ())),
    )


def _stated_std_m(track: "xr.Dataset") -> tuple[float | None, ...] | None:
    if "position_std" not in track:
        return None
    known = [axis[np.isfinite(axis)] for axis in track.position_std.values.T]
    return tuple(float(np.median(axis)) if axis.size else None for axis in known) if any(map(len, known)) else None


def log_faults(track: "xr.Dataset") -> CheckedTrack:
    """Return the sound part of a log, where errors of 1/16 of `WAVE_M` are tolerated."""
    from apertura.stages.node_log import poorer_fix

    poor = poorer_fix(track.fix.values, "auto") if "fix" in track else np.zeros(track.sizes["epoch"], bool)
    return check_track(
        seconds_since(track.time.values, track.time.values[0]),
        track.position.values,
        poor_fix=poor,
        tolerated_m=WAVE_M / 16,
    )


def bounds_of(position_m: NDArray[np.float64], frame: str) -> dict[str, Range]:
    """Return lowest and highest of each coordinate of (n, 3) positions, geodetic where they are on Earth.

    Longitudes are those of the west and of the east end: the first is the larger one across the antimeridian.

    Examples
    --------
    >>> bounds_of(np.array([[0.0, 1, 2], [5, 1, 2]]), "local")
    {'east_m': [0.0, 5.0], 'north_m': [1.0, 1.0], 'up_m': [2.0, 2.0]}
    """
    return _bounds(geodetic_from_ecef(position_m) if frame == "ecef" else position_m, frame)


def _bounds(places: NDArray[np.float64], frame: str) -> dict[str, Range]:
    earth = frame == "ecef"
    names = ("latitude_deg", "longitude_deg", "height_m") if earth else ("east_m", "north_m", "up_m")
    found = {name: [float(one.min()), float(one.max())] for name, one in zip(names, places.T, strict=True)}
    return found | ({"longitude_deg": [*longitude_range(places[:, 1])]} if earth else {})


def _middle(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of latitude, longitude and height, also across the antimeridian."""
    latitude, longitude, height = places.T
    middle = np.median(longitudes_about(longitude, longitude[0]))
    return np.array([np.median(latitude), (middle + 180) % 360 - 180, np.median(height)])


def _fixes(track: "xr.Dataset") -> dict[str, int] | None:
    if "fix" not in track:
        return None
    kinds, counts = np.unique(track.fix.values, return_counts=True)
    return {
        _FIX_NAMES.get(kind, "not stated" if kind == 0 else f"Q {kind}"): count
        for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True)
    }


@dataclass(frozen=True, eq=False)
class RecordingFacts:
    """Contents of the header of a recording.

    Attributes
    ----------
    channels
        Their names.
    sample_rate_hz
        Complex samples per second.
    carrier_hz
        RF frequency at baseband zero; None where it is not stated.
    samples
        Of each channel.
    captures, capture_samples
        How many, and samples of each.
    span
        The first and the last capture, or the samples of a recorder that ran through.
    times
        Of captures; a gap is longer than `LOST_CAPTURE` intervals. None where the recorder ran through.
    frames
        Of captures; None where there are none.
    """

    channels: tuple[str, ...]
    sample_rate_hz: float
    carrier_hz: float | None
    samples: int
    captures: int
    capture_samples: int
    span: Span
    times: TimeFacts | None
    frames: dict[str, int] | None

    @property
    def runs_through(self) -> bool:
        """True if the recorder ran through: it was not triggered by pulses."""
        return self.times is None


def recording_facts(recording: Recording) -> RecordingFacts:
    """Return the contents of the header of a recording; no sample is read."""
    captures, triggered = recording.captures, recording.framing is None
    return RecordingFacts(
        channels=tuple(recording.channels),
        sample_rate_hz=float(recording.sample_rate_hz),
        carrier_hz=float(recording.frequency_hz) or None,
        samples=len(recording.samples),
        captures=len(captures.start),
        capture_samples=captures.length,
        span=recorded_span(recording),
        times=time_facts(captures.time, longer=LOST_CAPTURE) if triggered else None,
        frames=_frames(frame_numbers(recording)) if triggered else None,
    )


def _frames(numbers: NDArray[np.int64]) -> dict[str, int] | None:
    if not numbers.size:
        return None
    steps = np.diff(numbers)
    return {
        "first": int(numbers[0]),
        "last": int(numbers[-1]),
        "missing": int((steps[steps > 1] - 1).sum()),
        "restarts": int((steps <= 0).sum()),
    }


@dataclass(frozen=True, eq=False)
class HistoryFacts:
    """Contents of phase history.

    Attributes
    ----------
    times
        Of pulses; a gap is longer than `LOST_CAPTURE` intervals.
    frequencies
        Of each pulse.
    band_hz
        The lowest and the highest.
    resolution_m, unambiguous_m
        Of the total path, metres; None of one frequency.
    frame
        Of positions, ecef or local; None where there are none.
    bistatic
        Whether the antennas are apart.
    bounds
        tx and rx → of `bounds_of`.
    dropped
        Reason → pulses that the reader left out.
    flags
        That the reader raised.
    remarks
        What a person should know of how it was read.
    """

    times: TimeFacts
    frequencies: int
    band_hz: Range
    resolution_m: float | None
    unambiguous_m: float | None
    frame: str | None
    bistatic: bool
    bounds: Mapping[str, Mapping[str, Range]]
    dropped: Mapping[str, int]
    flags: Mapping[str, str]
    remarks: tuple[str, ...]


def history_facts(echo: "xr.Dataset") -> HistoryFacts:
    """Return the contents of phase history; `echo` is its stage."""
    frequency = echo.frequency.values
    band_hz = [float(frequency[0]), float(frequency[-1])]
    step_hz = (band_hz[1] - band_hz[0]) / (frequency.size - 1) if frequency.size > 1 else None
    placed = "tx_position" in echo
    tx, rx = (echo.tx_position.values, echo.rx_position.values) if placed else (np.zeros((1, 3)), np.zeros((1, 3)))
    frame = echo.attrs["frame"] if placed else None
    return HistoryFacts(
        times=time_facts(echo.time.values, longer=LOST_CAPTURE),
        frequencies=frequency.size,
        band_hz=band_hz,
        resolution_m=None if step_hz is None else SPEED_OF_LIGHT_M_S / (step_hz * frequency.size),
        unambiguous_m=None if step_hz is None else SPEED_OF_LIGHT_M_S / step_hz,
        frame=frame,
        bistatic=bool(np.abs(tx - rx).max() > 0),
        bounds={leg: bounds_of(at, str(frame)) for leg, at in (("tx", tx), ("rx", rx))} if placed else {},
        dropped={why: int(count) for why, count in echo.attrs.get("dropped", {}).items()},
        flags=dict(echo.attrs.get("flags", {})),
        remarks=tuple(echo.attrs.get("remarks", ())),
    )


@dataclass(frozen=True, eq=False)
class DemFacts:
    """Contents of a raster of heights, or of a product of apertura.

    Attributes
    ----------
    tags
        Of the file; `PRODUCT_TAG` is among them where it is a product of apertura.
    description, values_unit
        Of the first band; empty where the file does not state them. Of heights in a compound CRS the unit is that of
        its vertical axis.
    posts
        Rows and columns.
    crs
        As the file states it; empty where it does not.
    unit
        Of its horizontal coordinates.
    bounds
        Left, bottom, right, top.
    spacing
        Of posts, to the east and to the north.
    bands, dtype
        How many, and the type of the first.
    heights
        (row, column) float32 in `values_unit`, scale and offset applied: of at most 512 posts along a side, NaN where
        there is none; None where the raster is larger than can be used, or of complex numbers.
    """

    tags: Mapping[str, str]
    description: str
    values_unit: str
    posts: tuple[int, int]
    crs: str
    unit: str
    bounds: tuple[float, float, float, float]
    spacing: tuple[float, float]
    bands: int
    dtype: str
    heights: NDArray[np.float32] | None


def dem_facts(path: Path) -> DemFacts:
    """Return the contents of a raster of heights.

    Raises
    ------
    CampaignError
        If it is no GeoTIFF.
    """
    from apertura.common.raster import opened_raster

    with opened_raster(path, expected="a GeoTIFF of heights", remedy="Convert it.") as raster:
        bounds, crs = raster.bounds, raster.crs
        return DemFacts(
            tags={str(name): str(value) for name, value in raster.tags().items()},
            description=str(raster.descriptions[0] or ""),
            values_unit=_values_unit(raster),
            posts=(raster.height, raster.width),
            crs=str(crs or ""),
            unit=str(crs.linear_units) if crs and crs.is_projected else "deg",
            bounds=(bounds.left, bounds.bottom, bounds.right, bounds.top),
            spacing=(abs(float(raster.res[0])), abs(float(raster.res[1]))),
            bands=raster.count,
            dtype=str(raster.dtypes[0]),
            heights=_heights(raster),
        )


def _values_unit(raster: "DatasetReader") -> str:
    """Return the unit of the first band: of the vertical axis of a compound CRS, else as the band states it."""
    from pyproj import CRS
    from pyproj.exceptions import ProjError

    try:
        axes = CRS.from_user_input(raster.crs).axis_info if raster.crs else []
    except ProjError:
        axes = []
    return str(axes[2].unit_name if len(axes) == 3 else raster.units[0] or "")


def _heights(raster: "DatasetReader") -> NDArray[np.float32] | None:
    from apertura.core.scene.dem import MOST_POSTS

    if raster.height * raster.width > MOST_POSTS or raster.dtypes[0].startswith("complex"):
        return None
    shape = tuple(min(side, _ACROSS) for side in raster.shape)
    read = raster.read(1, out_shape=shape, masked=True).astype(np.float64)
    return np.asarray(np.ma.filled(read, np.nan) * raster.scales[0] + raster.offsets[0], np.float32)
