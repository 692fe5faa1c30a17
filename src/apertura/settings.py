"""The campaign folder's config: one model generates the defaults, the JSON schema and the validation.

Only `steps` and the command line see these objects; wings get plain arrays and numbers.
"""

import re
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

Metres3 = tuple[float, float, float]
Beamwidth = Annotated[float, Field(gt=0, le=180)]
RESERVED_NAMES = frozenset({"fused", "layers", "stac", "map", "study", "logs", "benchmarks", "cube.zarr"})


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.]+", name) or name.startswith("."):
        raise ValueError(f"name {name!r}: only letters, digits, '_' and '.' may be used")
    if name in RESERVED_NAMES:
        raise ValueError(f"name {name!r} is taken by the results folder; choose another")
    return name


Name = Annotated[str, AfterValidator(_plain_name)]


class Section(BaseModel):
    """A part of the config; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class OfdmWaveform(Section):
    """One OFDM symbol per pulse."""

    kind: Literal["ofdm"] = Field(description="ofdm, or phase_history for recorded frequency-domain samples")
    codes: str = Field("raw/codes.npy", description="transmitted code symbols, complex64 (subcarriers,)")
    carrier_hz: float = Field(gt=0, description="RF carrier, Hz", examples=[1.2e9])
    carrier_is: Literal["band_start", "band_centre"] = Field(
        "band_start", description="which subcarrier the carrier is: n = 0…N-1 (band_start) or -N/2…N/2-1 (band_centre)"
    )
    subcarriers: int = Field(gt=1, description="number of subcarriers N", examples=[4096])
    subcarrier_spacing_hz: float = Field(gt=0, description="subcarrier spacing Δf, Hz", examples=[100e3])
    symbol_s: float = Field(gt=0, description="transmitted symbol T without prefix, s", examples=[12.5e-6])
    cyclic_prefix_s: float = Field(ge=0, description="cyclic prefix T_cp, s", examples=[3.125e-6])
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz", examples=[1.024e9])
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz", examples=[100.0])

    @model_validator(mode="after")
    def _dft_fits(self) -> Self:
        length = self.sample_rate_hz / self.subcarrier_spacing_hz
        if abs(length - round(length)) > 1e-6 * length:
            raise ValueError(
                f"sample_rate_hz/subcarrier_spacing_hz = {length:.6f} must be an integer: it is the DFT length"
            )
        if self.subcarriers > round(length):
            raise ValueError(f"subcarriers={self.subcarriers} exceed the DFT length {round(length)}")
        if self.symbol_s < (1 - 1e-9) / self.subcarrier_spacing_hz:
            raise ValueError(
                f"symbol_s={self.symbol_s:g} is shorter than the DFT window 1/subcarrier_spacing_hz = "
                f"{1 / self.subcarrier_spacing_hz:g} s"
            )
        return self


class PhaseHistoryWaveform(Section):
    """Frequency-domain samples with antenna positions, recorded by another radar."""

    kind: Literal["phase_history"] = Field(description="recorded frequency-domain samples with antenna positions")
    format: Literal["afrl_mat"] = Field(description="afrl_mat: AFRL Gotcha .mat files raw/<flight>/<node>.*.mat")


Waveform = Annotated[OfdmWaveform | PhaseHistoryWaveform, Field(discriminator="kind")]


class LeverArms(Section):
    """From the logged point to each phase centre, body axes forward-right-down."""

    radar_tx: Metres3 = Field((0.0, 0.0, 0.0), description="transmitting radar antenna, m")
    radar_rx: Metres3 = Field((0.0, 0.0, 0.0), description="receiving radar antenna, m")
    sidelink: Metres3 = Field((0.0, 0.0, 0.0), description="sidelink antenna, m")

    def any(self) -> bool:
        """Return whether one of them is not zero."""
        return any(any(arm) for arm in (self.radar_tx, self.radar_rx, self.sidelink))


class Antenna(Section):
    """Where one antenna looks and how widely; its horizontal axis lies in the body's forward-right plane."""

    boresight_deg: tuple[Annotated[float, Field(ge=-180, le=360)], Annotated[float, Field(ge=-90, le=90)]] = Field(
        description="azimuth clockwise from forward, elevation above the forward-right plane (down is negative), deg"
    )
    beamwidth_deg: tuple[Beamwidth, Beamwidth] | None = Field(
        None, description="full width at -3 dB (one way) in azimuth and elevation of a Gaussian beam, deg"
    )
    pattern: str | None = Field(
        None,
        description="instead of beamwidth_deg a CSV of both cuts: columns cut (azimuth, elevation), angle_deg, gain_db",
    )
    cutoff_db: float = Field(
        -20.0, ge=-80, le=-3, description="gain below which a cut ends: pulses beyond are left out, dB under its peak"
    )

    @model_validator(mode="after")
    def _one_pattern(self) -> Self:
        if (self.beamwidth_deg is None) == (self.pattern is None):
            raise ValueError("give either beamwidth_deg, [azimuth, elevation], or pattern, a CSV file")
        return self


_BEAM = "null (alike in all directions), or boresight_deg with beamwidth_deg or pattern, and cutoff_db"


class Antennas(Section):
    """The beams of a node."""

    radar_tx: Antenna | None = Field(None, description=f"transmitting radar antenna: {_BEAM}")
    radar_rx: Antenna | None = Field(None, description=f"receiving radar antenna: {_BEAM}")

    def any(self) -> bool:
        """Return whether one of them is stated."""
        return self.radar_tx is not None or self.radar_rx is not None


class PathOffsets(Section):
    """Electrical path beyond geometry, metres of total path, of the receiving node."""

    radar: float = Field(0.0, description="radar channel, m")
    sidelink: float = Field(0.0, description="sidelink channel, m")


class Node(Section):
    """One UAV."""

    lever_arms_m: LeverArms = Field(default_factory=LeverArms, description="logged point → phase centres, body axes")
    antennas: Antennas = Field(default_factory=Antennas, description="beams: where the antennas look, in body axes")
    path_offset_m: PathOffsets = Field(
        default_factory=PathOffsets, description="electrical path beyond geometry, as receiver"
    )
    attitude: Literal["log", "course", "none"] = Field(
        "none", description="where attitude comes from: the log, the course over ground, or none"
    )

    @model_validator(mode="after")
    def _lever_arm_needs_attitude(self) -> Self:
        if self.attitude == "none" and self.lever_arms_m.any():
            raise ValueError(
                "lever_arms_m is not zero but attitude is none: body axes cannot be turned to north-east-down; "
                "set attitude to log or course, or the lever arms to zero"
            )
        if self.attitude == "none" and self.antennas.any():
            raise ValueError(
                "antennas has a beam but attitude is none: body axes cannot be turned to north-east-down; "
                "set attitude to log or course, or the beam to null"
            )
        return self


class Scene(Section):
    """The campaign's output grid."""

    crs: str = Field(
        "auto", description="EPSG code, auto (UTM zone of the track) or local (a frame without a place on Earth)"
    )
    bounds_m: tuple[float, float, float, float] | Literal["auto"] = Field(
        "auto", description="[xmin, ymin, xmax, ymax], outer pixel edges in crs, or auto"
    )
    spacing_m: float | Literal["auto"] = Field("auto", description="pixel spacing, m, or auto")
    height_m: float = Field(0.0, description="height of flat ground, m; not used where there is a dem")
    height_datum: Literal["ellipsoid", "egm96", "egm2008"] = Field("ellipsoid", description="what height_m counts from")
    dem: str | None = Field(None, description="terrain instead of flat ground: a GeoTIFF of heights, in any CRS")
    dem_datum: Literal["ellipsoid", "egm96", "egm2008", "carried"] | None = Field(
        None, description="what the heights of dem count from; carried: its own CRS says it"
    )
    geoid: str | None = Field(
        None, description="grid file of the geoid heights count from (.gtx, .tif); null: looked for where PROJ looks"
    )

    @model_validator(mode="after")
    def _datum_is_stated(self) -> Self:
        if self.dem is not None and self.dem_datum is None:
            raise ValueError(
                "dem is given without dem_datum: state what its heights count from "
                "(ellipsoid, egm96, egm2008, or carried where its CRS says it); it is never guessed"
            )
        if self.dem is None and self.dem_datum is not None:
            raise ValueError(f"dem_datum={self.dem_datum} is given without dem")
        stated = {self.dem_datum, self.height_datum}
        if self.crs == "local" and stated & {"egm96", "egm2008"}:
            raise ValueError(
                "heights in the local frame count from no geoid: take carried for dem_datum, and ellipsoid"
            )
        return self

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
                f"bounds_m={list(self.bounds_m)}: must be [xmin, ymin, xmax, ymax] with min < max, in order {sorted_m}"
            )
        if self.spacing_m != "auto":
            self._divisible(xmin, ymin, xmax, ymax, self.spacing_m)
        return self

    def _divisible(self, xmin: float, ymin: float, xmax: float, ymax: float, spacing: float) -> None:
        counts = ((xmax - xmin) / spacing, (ymax - ymin) / spacing)
        if any(abs(count - round(count)) > 1e-6 * max(count, 1.0) for count in counts):
            columns, rows = (max(1, round(count)) for count in counts)
            nearest = [xmin, round(ymax - rows * spacing, 9), round(xmin + columns * spacing, 9), ymax]
            raise ValueError(
                f"bounds_m={list(self.bounds_m)} is {counts[0]:.6g} × {counts[1]:.6g} pixels of {spacing} m; "
                f"the nearest whole grid is {nearest}"
            )


class Processing(Section):
    """How to compute; every key has a default."""

    window: Literal["hann", "none"] = Field("hann", description="weighting over the subcarriers")
    accuracy_db: float = Field(-60.0, le=-10, ge=-120, description="numerical error asked of the image, dB")
    engine: Literal["auto", "native", "numba", "reference"] = Field("auto", description="backprojection engine")
    sidelink: Literal["auto", "divide", "wiener", "gated", "two_parameter"] = Field(
        "auto", description="correction of a secondary node by its sidelink; auto takes the cheapest adequate"
    )
    false_alarms_per_s: float = Field(
        1e-3, gt=0, description="how often noise alone may trigger in a continuous recording, per second"
    )
    tile_px: int = Field(256, ge=16, multiple_of=16, description="side of a tile, pixels")
    table_degree: Annotated[int, Field(ge=1, le=2)] | Literal["auto"] = Field(
        "auto", description="native: degree of the polynomials in a table cell, 1 or 2"
    )
    table_oversampling: Annotated[int, Field(ge=2, le=64)] | Literal["auto"] = Field(
        "auto", description="native and numba: table cells per resolution cell c/B of total path"
    )
    phase_tolerance_rad: Annotated[float, Field(gt=0, le=0.1)] | Literal["auto"] = Field(
        "auto", description="native: largest phase error its fast forms may make, rad"
    )
    accumulate: Literal["auto", "complex64", "complex128"] = Field(
        "auto", description="native: type of sums over pulses"
    )
    pulse_thinning: Annotated[int, Field(ge=1, le=64)] | Literal["auto"] = Field(
        "auto", description="pulses that a low-pass sum makes one, where the aperture is oversampled; 1 keeps all"
    )
    pulse_blocks: Annotated[int, Field(ge=1, le=1024)] | Literal["auto"] = Field(
        "auto", description="blocks of pulses whose tables are in memory at once, one after the other; 1 takes them all"
    )
    midpoint: bool | Literal["auto"] = Field(
        "auto", description="image a bistatic pair as if both antennas were at their midpoint: true, false or auto"
    )
    terrain: Literal["auto", "plane", "tilted_plane", "dem"] = Field(
        "auto", description="what stands for the ground; auto takes the simplest that keeps focus and place"
    )


class Calibration(Section):
    """Which flight the path offsets come from."""

    flight: Name = Field(description="flight of kind calibration whose offsets the imaging flights use")
    reflector_m: Metres3 = Field(description="reflector: easting, northing in scene.crs, ellipsoidal height, m")
    search_m: float = Field(10.0, gt=0, description="offsets of either sign up to this are considered, m")


class Settings(Section):
    """config/config.yaml."""

    campaign: str = Field(description="name of the campaign", examples=["my_campaign"])
    waveform: Waveform = Field(description="what was transmitted")
    nodes: dict[Name, Node] = Field(min_length=1, description="one section per UAV, named as in flights.tsv")
    scene: Scene = Field(default_factory=Scene, description="the grid of every raster of the campaign")
    processing: Processing = Field(default_factory=Processing, description="how to compute")
    calibration: Calibration | None = Field(
        None, description="path offsets from a calibration flight: flight, reflector_m, search_m; null: as stated above"
    )

    @model_validator(mode="after")
    def _calibration_needs_a_place(self) -> Self:
        if self.calibration is not None and self.scene.crs == "auto":
            raise ValueError("calibration.reflector_m is in scene.crs, which is auto: give the CRS")
        return self

    @model_validator(mode="after")
    def _beams_need_a_log(self) -> Self:
        named = [name for name, node in self.nodes.items() if node.antennas.any()]
        if named and isinstance(self.waveform, PhaseHistoryWaveform):
            raise ValueError(
                f"nodes.{named[0]}.antennas has a beam, but phase history carries no attitude: set it to null"
            )
        return self
