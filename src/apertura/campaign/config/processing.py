"""Sections `scene`, `processing`, `calibration`, `bench`, `interferometry` and `stack` of the config."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.campaign.config.section import CrsName, Metres3, Name, Section, plain_crs
from apertura.common.attribution import Title
from apertura.common.constants import LARGEST_REFRACTIVITY, VERTICAL_DATUMS
from apertura.common.errors import CampaignError, quoted
from apertura.core.imaging.options import ImagingChoices

# ---- Sections `processing` and `calibration` ------------------------------------------------------------------------


class Fusion(Section):
    """Settings of the sum of the images of a flight's pairs."""

    align_phase: bool = Field(
        False, description="remove the phase offset between pairs, measured at bright points, before the coherent sum"
    )


class Multilooking(Section):
    """Settings of multilooking: mean power on a coarser grid."""

    spacing_m: float = Field(
        gt=0, description="side of the squares over which power is averaged, rounded to whole pixels, m"
    )
    subtract_noise: bool = Field(
        False, description="subtract the measured noise power: pixels without echo then scatter about zero"
    )
    speckle_filter: Literal["none", "lee"] = Field("none", description="filter for the remaining speckle")


class RunningBackground(Section):
    """Background that changes during a flight."""

    running_s: float = Field(gt=0, description="length of the running median, s")


class Processing(ImagingChoices):
    """Processing settings; every key has a default."""

    sidelink: Literal["auto", "divide", "wiener", "gated", "two_parameter"] = Field(
        "auto", description="correction of a receiving node by its sidelink; auto: the simplest adequate method"
    )
    symbol_filter: Literal["auto", "reciprocal", "matched", "wiener"] = Field(
        "auto",
        description="filter that removes code symbols of varying modulus: reciprocal (no data sidelobes), matched "
        "(least noise) or wiener; auto: the smallest loss of SNR with tolerated data sidelobes",
    )
    background: Literal["auto", "none", "median", "mean"] | RunningBackground = Field(
        "auto",
        description="echoes at constant delay (antenna coupling, airframe) removed before range compression: median or "
        "mean of all pulses, or a running median, {running_s: 2.0}; auto: the best of these, if targets gain by it",
    )
    interference: Literal["auto", "none"] = Field(
        "auto",
        description="auto: tones are subtracted, and subcarriers and pulses with radio interference are excluded if "
        "that raises the SNR",
    )
    fusion: Fusion = Field(default_factory=Fusion, description="sum of the images of a flight's pairs")
    autofocus: Literal["auto", "on", "off"] = Field(
        "auto",
        description="track refinement from the images; auto: if the configured position errors cost more than the "
        "tolerated loss",
    )
    autofocus_method: Literal["auto", "tracks", "phase_gradient", "minimum_entropy"] = Field(
        "auto",
        description="refined quantity: tracks, or one phase per pulse and pair by phase_gradient or "
        "minimum_entropy; auto: minimum_entropy if position errors have the same effect on the whole "
        "scene, otherwise tracks",
    )
    radiometry: tuple[Literal["sigma0", "gamma0", "beta0"], ...] = Field(
        ("sigma0",),
        description="backscattering coefficients written for calibrated images, as sigma0_db.tif and so on",
    )
    radiometric_calibration: str | None = Field(
        None,
        description="file of calibration constants, written by `apertura reflectors`, that replaces the radio "
        "configured for the nodes; null: the configured radio",
    )
    multilook: Multilooking | None = Field(
        None,
        description="multilooking, written as multilook_db.tif and so on, such as {spacing_m: 1.0, subtract_noise: "
        "true, speckle_filter: lee}; null: none",
    )
    keep: tuple[Literal["echo"], ...] = Field(
        (),
        description="additional results to keep: echo, the transfer functions of every pulse in transfer.zarr, from "
        "which images can be recomputed without the recording",
    )
    scheduler: str = Field(
        "threads",
        description="scheduler that forms the tiles: threads of the step, or a dask scheduler at tcp://host:port, "
        "which must also be stated in the environment variable DASK_SCHEDULER_ADDRESS",
    )
    false_alarms_per_s: float = Field(
        1e-3, gt=0, description="false alarm rate of the trigger in a continuous recording, per second"
    )

    @property
    def background_method(self) -> str | float:
        """Name of the method, or the length of the running median, s."""
        return self.background if isinstance(self.background, str) else self.background.running_s

    @field_validator("autofocus", mode="before")
    @classmethod
    def _yaml_reads_on_and_off_as_truth(cls, word: object) -> object:
        return {True: "on", False: "off"}[word] if isinstance(word, bool) else word

    @field_validator("scheduler")
    @classmethod
    def _scheduler_is_an_address(cls, text: str) -> str:
        if text != "threads" and not re.fullmatch(r"tcp://[A-Za-z0-9_.-]+:[0-9]{1,5}", text):
            raise ValueError("must be threads or an address tcp://host:port")
        return text


class CalibrationSettings(Section):
    """Calibration flight for path offsets."""

    flight: Name = Field(description="flight of kind calibration whose offsets the imaging flights use")
    reflector_m: Metres3 = Field(description="reflector: easting, northing in scene.crs, ellipsoidal height, m")
    search_m: float = Field(10.0, gt=0, description="largest magnitude of path offsets searched, m")


class BenchSettings(Section):
    """Known electrical paths of a stationary set-up, in flights of kind bench."""

    radar_m: float | None = Field(
        None,
        ge=0,
        description="path of the strongest echo, or length of the cable, from transmitter to receiver, m; null: "
        "unknown",
    )
    sidelink_m: float | None = Field(
        None, ge=0, description="path of the sidelink, or length of its cable, without path_offset_m, m; null: unknown"
    )
    split: bool = Field(False, description="true if one signal is split to the radar channels of all nodes")


# ---- Section `interferometry`: pairs of images for interferograms ---------------------------------------------------

LEAST_WINDOW_PX = 3
"""Smallest side of the coherence window, pixels: the coherence of a single pixel is always 1."""

_PAIR = r"^[A-Za-z0-9_.]+-[A-Za-z0-9_.]+$"
_IMAGE = r"([A-Za-z0-9_.]+)/([A-Za-z0-9_.]+-[A-Za-z0-9_.]+)"


def has_a_middle(side: int) -> int:
    """Return the side of a window, pixels; raise ValueError if it is even."""
    if side % 2 == 0:
        raise ValueError("must be odd, so that the window is centred on a pixel")
    return side


class Interferometry(Section):
    """Interferograms: pairs of images of one scene."""

    pairs: Mapping[Name, tuple[str, str]] = Field(
        default_factory=dict,
        description="name of an interferogram → its two images, such as two_tracks: [f01/uav1-uav1, f02/uav1-uav1]; "
        "none by default",
    )
    window_px: int = Field(
        15,
        ge=LEAST_WINDOW_PX,
        le=255,
        description="side of the averaging window of coherence and phase, odd number of pixels",
    )

    @field_validator("pairs")
    @classmethod
    def _two_images(cls, pairs: Mapping[str, tuple[str, str]]) -> Mapping[str, tuple[str, str]]:
        for name, images in pairs.items():
            for image in images:
                if not re.fullmatch(_IMAGE, image):
                    raise ValueError(f"{name}: {quoted(image)} is not flight/transmitter-receiver")
            if images[0] == images[1]:
                raise ValueError(f"{name}: {images[0]} is named twice; an interferogram requires two different images")
        return pairs

    _has_a_middle = field_validator("window_px")(has_a_middle)

    def images(self, name: str) -> tuple[tuple[str, str], tuple[str, str]]:
        """Return flight and pair of the two images of an interferogram.

        Examples
        --------
        >>> Interferometry(pairs={"two": ("f01/a-a", "f02/a-b")}).images("two")
        (('f01', 'a-a'), ('f02', 'a-b'))
        """
        first, second = ((flight, pair) for flight, _, pair in (image.partition("/") for image in self.pairs[name]))
        return first, second


def check_interferometry(requested: Interferometry, known: Sequence[str], *, where: Path) -> None:
    """Check that the images of all interferograms are images of the campaign; raise CampaignError if not.

    Parameters
    ----------
    requested
        Section `interferometry`.
    known
        Images of the campaign, flight/pair.
    where
        Path of the config.
    """
    for name, images in requested.pairs.items():
        for image in images:
            if image not in known:
                raise CampaignError(
                    f"no image {quoted(image)}",
                    where=f"{where}: interferometry.pairs.{name}",
                    expected=f"two of {', '.join(known)}" if known else "two images; the campaign has none",
                    remedy="Correct the flight or the pair, or add them to flights.tsv.",
                )


# ---- Section `stack`: images of several flights for time series and change detection ---------------------------------


class ChangeSettings(Section):
    """Detection of changes relative to the reference flight of the stack."""

    false_alarm_rate: float = Field(
        1e-4, gt=0, le=0.1, description="probability that a pixel of unchanged terrain is reported as changed"
    )
    smallest_m2: float = Field(0.0, ge=0, description="area below which a changed region is not listed, m²")


class Stack(Section):
    """Stack: images of one pair from several flights, whose phases refer to one reference flight."""

    reference: Name = Field(description="flight to which the phases of all other flights refer")
    flights: tuple[Name, ...] = Field(min_length=1, description="further flights of the stack")
    pair: str = Field(pattern=_PAIR, description="pair whose images are stacked, transmitter-receiver")
    window_px: int = Field(
        15, ge=LEAST_WINDOW_PX, le=255, description="side of the averaging window of coherence, odd number of pixels"
    )

    change: ChangeSettings = Field(default_factory=ChangeSettings, description="detection of changes")

    _has_a_middle = field_validator("window_px")(has_a_middle)

    @model_validator(mode="after")
    def _each_flight_once(self) -> Self:
        if len({*self.all_flights}) < len(self.all_flights):
            raise ValueError(f"flights {', '.join(self.all_flights)}: each flight may be named once")
        return self

    @property
    def all_flights(self) -> tuple[str, ...]:
        """The reference flight, then the further flights.

        Examples
        --------
        >>> Stack(reference="f01", flights=("f02", "f03"), pair="uav1-uav1").all_flights
        ('f01', 'f02', 'f03')
        """
        return (self.reference, *self.flights)


def check_stack(requested: Stack | None, known: Sequence[str], *, where: Path) -> None:
    """Check that the flights of a stack have images of its pair; raise CampaignError if not.

    Parameters
    ----------
    requested
        Section `stack`; None: no stack.
    known, where
        As in `check_interferometry`.
    """
    if requested is None:
        return
    for flight in requested.all_flights:
        if (image := f"{flight}/{requested.pair}") not in known:
            raise CampaignError(
                f"no image {quoted(image)}",
                where=f"{where}: stack",
                expected=f"flights and a pair of the images {', '.join(known)}" if known else "a campaign with images",
                remedy="Correct stack.reference, stack.flights or stack.pair, or add the flight to flights.tsv.",
            )


# ---- Section `scene`: grid of all rasters, and terrain ---------------------------------------------------------------


class KnownPoint(Section):
    """Bright point of known position, which fixes the position of refined tracks."""

    name: Title = Field(description="name")
    position_m: Metres3 = Field(description="easting, northing in scene.crs, ellipsoidal height (z in local), m")
    std_m: float = Field(gt=0, description="standard deviation of each coordinate, m")


_CORNERS = ("trihedral", "dihedral")  # reflectors with a boresight
_SIZES = {"trihedral": "[leg]", "dihedral": "[across the seam, along it]", "sphere": "[radius]"}


class KnownReflector(KnownPoint):
    """Reflector whose radar cross-section follows from its shape."""

    kind: Literal["trihedral", "dihedral", "sphere"] = Field(description="kind of reflector")
    size_m: tuple[Annotated[float, Field(gt=0, le=100)], ...] = Field(
        description="size, m: trihedral [leg of its triangles], dihedral [across the seam, along it], sphere [radius]"
    )
    azimuth_deg: float | None = Field(
        None, ge=-360, le=360, description="azimuth of the boresight, clockwise from the north of scene.crs, deg"
    )
    elevation_deg: float | None = Field(
        None, ge=-90, le=90, description="elevation of the boresight above the horizontal, deg"
    )
    roll_deg: float = Field(
        0.0,
        ge=-360,
        le=360,
        description="roll clockwise about the boresight, seen from behind, deg; 0: seam of a dihedral horizontal, "
        "one seam of a trihedral upwards in the vertical plane of the boresight",
    )
    rcs_std_db: float = Field(
        0.0, ge=0, le=100, description="standard deviation of the cross-section as built and installed, dB"
    )

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if len(self.size_m) != (2 if self.kind == "dihedral" else 1):
            raise ValueError(f"size_m={list(self.size_m)}: a {self.kind} requires {_SIZES[self.kind]}")
        aimed = [value for value in (self.azimuth_deg, self.elevation_deg) if value is not None]
        if len(aimed) != (2 if self.kind in _CORNERS else 0):
            raise ValueError(
                f"a {self.kind} requires azimuth_deg and elevation_deg of its boresight"
                if self.kind in _CORNERS
                else "a sphere has no boresight: azimuth_deg and elevation_deg apply to corner reflectors"
            )
        return self


class Air(Section):
    """Atmosphere at the terrain, instead of the standard atmosphere: measured weather, or refractivity."""

    temperature_c: float | None = Field(None, ge=-60, le=60, description="temperature at the ground, °C")
    pressure_hpa: float | None = Field(
        None, ge=300, le=1100, description="pressure at the ground, not reduced to sea level, hPa"
    )
    relative_humidity: float | None = Field(None, ge=0, le=100, description="relative humidity at the ground, %")
    refractivity_n: float | None = Field(
        None,
        ge=0,
        le=LARGEST_REFRACTIVITY,
        description="refractivity (n - 1)·10⁶ at the ground, instead of the other three",
    )

    @model_validator(mode="after")
    def _weather_or_refractivity(self) -> Self:
        weather = self.temperature_c, self.pressure_hpa, self.relative_humidity
        count = sum(value is not None for value in weather)
        if count != (3 if self.refractivity_n is None else 0):
            raise ValueError(
                f"{count} of temperature_c, pressure_hpa and relative_humidity are stated"
                f"{' in addition to refractivity_n' if self.refractivity_n is not None else ''}: state all three, or "
                "refractivity_n alone"
            )
        return self

    @property
    def weather(self) -> tuple[float, float, float]:
        """Temperature, °C, pressure, hPa, and humidity, %; raises ValueError if refractivity is configured instead."""
        if self.temperature_c is None or self.pressure_hpa is None or self.relative_humidity is None:
            raise ValueError("refractivity is configured instead of weather")
        return self.temperature_c, self.pressure_hpa, self.relative_humidity


HEIGHT_DEFAULT = "no terrain height is configured: scene.height_m is 0 m, the ellipsoid"


class Scene(Section):
    """Output grid of the campaign, terrain and atmosphere."""

    crs: CrsName = Field(
        "auto",
        description="authority and code, such as EPSG:32632; auto (UTM zone of the track) or local (a frame that is "
        "not georeferenced)",
    )
    bounds_m: tuple[float, float, float, float] | Literal["auto"] = Field(
        "auto", description="[xmin, ymin, xmax, ymax], outer pixel edges in crs, or auto"
    )
    spacing_m: float | Literal["auto"] = Field("auto", description="pixel spacing, m, or auto")
    height_m: float = Field(0.0, description="height of flat terrain, m; ignored if dem is set")
    height_std_m: float | None = Field(
        None, ge=0, description="standard deviation of the terrain heights, m; null: not configured"
    )
    height_datum: Literal["ellipsoid", "egm96", "egm2008"] = Field(
        "ellipsoid", description="vertical datum of height_m"
    )
    dem: str | None = Field(None, description="DEM that replaces flat terrain: GeoTIFF of heights, in any CRS")
    dem_datum: Literal["ellipsoid", "egm96", "egm2008", "carried"] | None = Field(
        None, description="vertical datum of dem; carried: as its own CRS states"
    )
    geoid: str | None = Field(
        None,
        description="grid file of the geoid to which heights refer (.gtx, .tif); null: searched for in the folders "
        "of PROJ",
    )
    atmosphere: Literal["auto", "vacuum"] | Air = Field(
        "auto",
        description="atmosphere: auto (standard atmosphere at the terrain height, 50 % humidity), {temperature_c: "
        "x, pressure_hpa: y, relative_humidity: z} measured at the ground, {refractivity_n: 290} at the "
        "ground (0 for recordings simulated in vacuum), or vacuum (an approximation whose error is in "
        "the budget); refractivity decreases with height",
    )
    reference_points: tuple[KnownPoint, ...] = Field(
        (),
        description="bright points at known positions, to which refined tracks are tied: list of name, position_m "
        "[easting, northing, ellipsoidal height] and std_m",
    )

    reflectors: tuple[KnownReflector, ...] = Field(
        (),
        description="reflectors of known cross-section, at which `apertura reflectors` measures calibration "
        "constants: list of name, position_m and std_m as in reference_points, kind (trihedral, "
        "dihedral, sphere), size_m, and for corner reflectors azimuth_deg and elevation_deg",
    )

    @property
    def height_is_default(self) -> bool:
        """True if the height of flat terrain is the 0 m of the template, which is an unlikely height."""
        return self.dem is None and self.height_m == 0

    @model_validator(mode="after")
    def _points_are_somewhere(self) -> Self:
        for key in ("reference_points", "reflectors"):
            names = [point.name for point in getattr(self, key)]
            if names and self.crs == "auto":
                raise ValueError(f"positions of {key} refer to crs, which is auto: state the CRS")
            duplicates = sorted({name for name in names if names.count(name) > 1})
            if duplicates:
                raise ValueError(f"{key}: name {duplicates[0]!r} is used twice")
        return self

    @model_validator(mode="after")
    def _datum_is_stated(self) -> Self:
        if self.dem is not None and self.dem_datum is None:
            raise ValueError(
                "dem is stated without dem_datum, the vertical datum of its heights, which has no default: state "
                "ellipsoid, egm96, egm2008, or carried if the CRS of the DEM defines the datum"
            )
        if self.dem is None and self.dem_datum is not None:
            raise ValueError(f"dem_datum={self.dem_datum} is stated without dem")
        stated = {self.dem_datum, self.height_datum}
        if self.crs == "local" and stated & {"egm96", "egm2008"}:
            raise ValueError(
                "heights in the local frame do not refer to a geoid: use carried for dem_datum, and ellipsoid for "
                "height_datum"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _heights_of_crs_are_those_stated(cls, values: Any) -> Any:
        """Replace a compound CRS by its horizontal part; its vertical part must be the configured datum."""
        crs = values.get("crs") if isinstance(values, dict) else None
        if not isinstance(crs, str) or "+" not in plain_crs(crs):
            return values
        horizontal, _, vertical = crs.partition("+")
        vertical = (vertical if ":" in vertical else f"{horizontal.partition(':')[0]}:{vertical}").upper()
        key = "height_datum" if values.get("dem") is None else "dem_datum"
        stated, carried = values.get(key, "ellipsoid"), VERTICAL_DATUMS.get(vertical, vertical)
        if stated != carried:
            raise ValueError(
                f"crs={crs} has the vertical datum {carried}, but {key} is {quoted(stated)}, which applies to heights: "
                f"state crs={horizontal} and the correct {key}"
            )
        return {**values, "crs": horizontal}

    @model_validator(mode="after")
    def _bounds_are_pixels(self) -> Self:
        if self.spacing_m != "auto" and self.spacing_m <= 0:
            raise ValueError(f"spacing_m={self.spacing_m}: must be positive")
        if self.bounds_m == "auto":
            return self
        xmin, ymin, xmax, ymax = self.bounds_m
        if xmin >= xmax or ymin >= ymax:
            sorted_m = [min(xmin, xmax), min(ymin, ymax), max(xmin, xmax), max(ymin, ymax)]
            raise ValueError(
                f"bounds_m={list(self.bounds_m)}: must be [xmin, ymin, xmax, ymax] with min < max; sorted: {sorted_m}"
            )
        if self.spacing_m != "auto":
            self._divisible(xmin, ymin, xmax, ymax, self.spacing_m)
        return self

    def _divisible(self, xmin: float, ymin: float, xmax: float, ymax: float, spacing: float) -> None:
        counts = ((xmax - xmin) / spacing, (ymax - ymin) / spacing)
        if any(abs(count - round(count)) > 1e-6 * max(count, 1.0) for count in counts):
            columns, rows = (max(1, round(count)) for count in counts)
            degrees = self.crs != "local" and max(map(abs, (xmin, ymin, xmax, ymax))) <= 180 and xmax - xmin < 1
            hint = "; the values look like degrees, but bounds_m is in metres of crs" if degrees else ""
            nearest = [xmin, round(ymax - rows * spacing, 9), round(xmin + columns * spacing, 9), ymax]
            raise ValueError(
                f"bounds_m={list(self.bounds_m)} is {counts[0]:.6g} × {counts[1]:.6g} pixels of {spacing} m; "
                f"the nearest whole grid is {nearest}{hint}"
            )
