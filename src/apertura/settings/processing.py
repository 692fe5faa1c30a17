"""Sections `processing`, how to compute, and `calibration`, path offsets from a flight over a reflector."""

from typing import Annotated, Literal

from pydantic import Field

from apertura.settings.section import Metres3, Name, Section


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
