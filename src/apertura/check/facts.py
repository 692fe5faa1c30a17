"""Contents of input files as plain values: flight logs, recordings, phase histories and DEMs."""

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
"""Tag of every raster written by apertura."""

METRES = frozenset({"", "m", "metre", "meter", "metres", "meters"})
"""Unit names of heights in metres; an empty name is interpreted as metres."""

WAVE_M = 0.25
"""Wavelength assumed for the tolerance of errors in a log that is read without a campaign, metres (L-band)."""

_FIX_NAMES = {number: name for name, number in FIXES.items()}
_ACROSS = 512  # largest number of DEM posts read along a side

Range = list[float]
"""Minimum and maximum."""


@dataclass(frozen=True, eq=False)
class LogFacts:
    """Contents of a flight log.

    Attributes
    ----------
    times
        Times of the epochs; a gap is longer than `LONG_GAP` intervals.
    dropped
        Reason → number of epochs excluded by the reader.
    fixes
        Solution class → number of epochs; None if the log contains no solution class.
    attitude_share
        Fraction of epochs with roll, pitch and yaw.
    has_attitude
        True if any angle is logged at any epoch.
    frame
        ecef or local.
    bounds
        Result of `bounds_of`.
    middle_m
        (3,) float64: median of each coordinate in `frame`, metres.
    middle_geodetic
        (3,) float64: median of latitude, longitude (deg) and ellipsoidal height (m); None in a local frame.
    length_m
        Length of the track, along straight lines between epochs, metres.
    median_speed_m_s, largest_speed_m_s
        Median and largest speed between epochs, metres per second.
    stated_std_m
        Median of the logged standard deviations in north, east and up, metres; None for an axis without values; None
        instead of the tuple if no axis has values.
    remarks
        Remarks of the reader for the user.
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
    """Summarise the contents of a flight log, from the dataset of its stage `track`."""
    times, position, frame = track.time.values, track.position.values, track.attrs["frame"]
    steps_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    speed_m_s = steps_m / np.diff(seconds_since(times, times[0]))
    logged = np.isfinite(track.attitude.values)
    places = geodetic_from_ecef(position) if frame == "ecef" else position
    return LogFacts(
        times=time_facts(times, longer=LONG_GAP),
        dropped={reason: int(count) for reason, count in track.attrs["dropped"].items()},
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
    """Check a log with a position tolerance of 1/16 of `WAVE_M`, and return the result with the usable epochs."""
    from apertura.stages.node_log import poorer_fix

    poor = poorer_fix(track.fix.values, "auto") if "fix" in track else np.zeros(track.sizes["epoch"], bool)
    return check_track(
        seconds_since(track.time.values, track.time.values[0]),
        track.position.values,
        poor_fix=poor,
        tolerated_m=WAVE_M / 16,
    )


def bounds_of(position_m: NDArray[np.float64], frame: str) -> dict[str, Range]:
    """Return minimum and maximum of each coordinate of (n, 3) positions; geodetic coordinates for frame ecef.

    Longitudes are those of the western and the eastern end. If the positions cross the antimeridian, the first
    longitude is larger.

    Examples
    --------
    >>> bounds_of(np.array([[0.0, 1, 2], [5, 1, 2]]), "local")
    {'east_m': [0.0, 5.0], 'north_m': [1.0, 1.0], 'up_m': [2.0, 2.0]}
    """
    return _bounds(geodetic_from_ecef(position_m) if frame == "ecef" else position_m, frame)


def _bounds(places: NDArray[np.float64], frame: str) -> dict[str, Range]:
    earth = frame == "ecef"
    names = ("latitude_deg", "longitude_deg", "height_m") if earth else ("east_m", "north_m", "up_m")
    bounds = {name: [float(axis.min()), float(axis.max())] for name, axis in zip(names, places.T, strict=True)}
    return bounds | ({"longitude_deg": [*longitude_range(places[:, 1])]} if earth else {})


def _middle(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the medians of latitude, longitude and height, also for positions across the antimeridian."""
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
        Names of the channels.
    sample_rate_hz
        Complex samples per second.
    carrier_hz
        RF frequency that corresponds to zero frequency at baseband; None if not stated.
    samples
        Number of samples of each channel.
    captures, capture_samples
        Number of captures, and number of samples per capture.
    span
        Times of the first and last capture, or time span of a continuous recording.
    times
        Times of captures; a gap is longer than `LOST_CAPTURE` intervals. None for a continuous recording.
    frames
        First and last frame number, and numbers of missing frames and restarts; None without a frame counter.
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
        """True for a continuous recording, i.e. one that is not triggered by pulses."""
        return self.times is None


def recording_facts(recording: Recording) -> RecordingFacts:
    """Summarise the header of a recording; samples are not read."""
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
    """Contents of a phase history.

    Attributes
    ----------
    times
        Times of pulses; a gap is longer than `LOST_CAPTURE` intervals.
    frequencies
        Number of frequencies per pulse.
    band_hz
        Lowest and highest frequency.
    resolution_m, unambiguous_m
        Resolution and unambiguous interval of the total path, metres; None for a single frequency.
    frame
        Frame of the positions, ecef or local; None without positions.
    bistatic
        True if transmit and receive antenna have different positions.
    bounds
        tx and rx → result of `bounds_of`.
    dropped
        Reason → number of pulses excluded by the reader.
    flags
        Flags raised by the reader.
    remarks
        Remarks of the reader for the user.
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
    """Summarise the contents of a phase history, from the dataset of its stage `echo`."""
    frequency = echo.frequency.values
    band_hz = [float(frequency[0]), float(frequency[-1])]
    step_hz = (band_hz[1] - band_hz[0]) / (frequency.size - 1) if frequency.size > 1 else None
    has_positions = "tx_position" in echo
    none = np.zeros((1, 3))
    tx, rx = (echo.tx_position.values, echo.rx_position.values) if has_positions else (none, none)
    frame = echo.attrs["frame"] if has_positions else None
    return HistoryFacts(
        times=time_facts(echo.time.values, longer=LOST_CAPTURE),
        frequencies=frequency.size,
        band_hz=band_hz,
        resolution_m=None if step_hz is None else SPEED_OF_LIGHT_M_S / (step_hz * frequency.size),
        unambiguous_m=None if step_hz is None else SPEED_OF_LIGHT_M_S / step_hz,
        frame=frame,
        bistatic=bool(np.abs(tx - rx).max() > 0),
        bounds={leg: bounds_of(at, str(frame)) for leg, at in (("tx", tx), ("rx", rx))} if has_positions else {},
        dropped={reason: int(count) for reason, count in echo.attrs.get("dropped", {}).items()},
        flags=dict(echo.attrs.get("flags", {})),
        remarks=tuple(echo.attrs.get("remarks", ())),
    )


@dataclass(frozen=True, eq=False)
class DemFacts:
    """Contents of a height raster, or of a product of apertura.

    Attributes
    ----------
    tags
        Tags of the file; they include `PRODUCT_TAG` for a product of apertura.
    description, values_unit
        Description and unit of the first band; empty if not stated. For a compound CRS, the unit is that of the
        vertical axis.
    posts
        Rows and columns.
    crs
        CRS stated in the file; empty if not stated.
    unit
        Unit of the horizontal coordinates.
    bounds
        Left, bottom, right, top.
    spacing
        Post spacing to the east and north.
    bands, dtype
        Number of bands, and data type of the first band.
    heights
        (row, column) float32 in `values_unit`, with scale and offset applied, reduced to at most 512 posts along a
        side, NaN for nodata; None if the raster is too large or has complex values.
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
    """Summarise the contents of a height raster.

    Raises
    ------
    CampaignError
        If the file is not a GeoTIFF.
    """
    from apertura.common.raster import opened_raster

    with opened_raster(path, expected="a GeoTIFF of heights", remedy="Convert the file to GeoTIFF.") as raster:
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
    """Return the unit of the vertical axis of a compound CRS; for other CRSs, the unit stated for the first band."""
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
