"""Section `scene`: the grid of every raster, and the ground under it."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from apertura.common.constants import VERTICAL_DATUMS
from apertura.common.errors import quoted
from apertura.pipeline.config.section import CrsName, Metres3, Section, Title, plain_crs


class KnownPoint(Section):
    """A point that shows in the images and whose place is known: refined tracks are tied to it."""

    name: Title = Field(description="what it is called")
    position_m: Metres3 = Field(description="easting, northing in scene.crs, ellipsoidal height (z in local), m")
    std_m: float = Field(gt=0, description="standard deviation of each coordinate, m")


class Scene(Section):
    """The campaign's output grid."""

    crs: CrsName = Field(
        "auto",
        description="authority and code, such as EPSG:32632, auto (UTM zone of the track) or local (a frame without a "
        "place on Earth)",
    )
    bounds_m: tuple[float, float, float, float] | Literal["auto"] = Field(
        "auto", description="[xmin, ymin, xmax, ymax], outer pixel edges in crs, or auto"
    )
    spacing_m: float | Literal["auto"] = Field("auto", description="pixel spacing, m, or auto")
    height_m: float = Field(0.0, description="height of flat ground, m; not used where there is a dem")
    height_std_m: float | None = Field(
        None, ge=0, description="standard deviation of the ground's heights, m; null: nobody said"
    )
    height_datum: Literal["ellipsoid", "egm96", "egm2008"] = Field("ellipsoid", description="what height_m counts from")
    dem: str | None = Field(None, description="terrain instead of flat ground: a GeoTIFF of heights, in any CRS")
    dem_datum: Literal["ellipsoid", "egm96", "egm2008", "carried"] | None = Field(
        None, description="what the heights of dem count from; carried: its own CRS says it"
    )
    geoid: str | None = Field(
        None, description="grid file of the geoid heights count from (.gtx, .tif); null: looked for where PROJ looks"
    )
    reference_points: tuple[KnownPoint, ...] = Field(
        (),
        description="bright points whose places are known, which tracks refined are tied to: a list of name, "
        "position_m [easting, northing, ellipsoidal height] and std_m",
    )

    @model_validator(mode="after")
    def _points_are_somewhere(self) -> Self:
        if self.reference_points and self.crs == "auto":
            raise ValueError("reference_points are in crs, which is auto: give the CRS")
        names = [point.name for point in self.reference_points]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"reference_points: two are called {twice[0]!r}")
        return self

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

    @model_validator(mode="before")
    @classmethod
    def _heights_of_crs_are_those_stated(cls, values: Any) -> Any:
        """Take the horizontal part of a compound CRS, whose heights must be those that the datum states."""
        crs = values.get("crs") if isinstance(values, dict) else None
        if not isinstance(crs, str) or "+" not in plain_crs(crs):
            return values
        horizontal, _, vertical = crs.partition("+")
        vertical = (vertical if ":" in vertical else f"{horizontal.partition(':')[0]}:{vertical}").upper()
        key = "height_datum" if values.get("dem") is None else "dem_datum"
        stated, carried = values.get(key, "ellipsoid"), VERTICAL_DATUMS.get(vertical, vertical)
        if stated != carried:
            raise ValueError(
                f"crs={crs} says heights of {carried}, {key} says {quoted(stated)}: "
                f"heights count from what {key} says; give crs={horizontal}, and {key} as it is"
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
                f"bounds_m={list(self.bounds_m)}: must be [xmin, ymin, xmax, ymax] with min < max, in order {sorted_m}"
            )
        if self.spacing_m != "auto":
            self._divisible(xmin, ymin, xmax, ymax, self.spacing_m)
        return self

    def _divisible(self, xmin: float, ymin: float, xmax: float, ymax: float, spacing: float) -> None:
        counts = ((xmax - xmin) / spacing, (ymax - ymin) / spacing)
        if any(abs(count - round(count)) > 1e-6 * max(count, 1.0) for count in counts):
            columns, rows = (max(1, round(count)) for count in counts)
            degrees = self.crs != "local" and max(map(abs, (xmin, ymin, xmax, ymax))) <= 180 and xmax - xmin < 1
            hint = ": these look like degrees, bounds_m is in metres of crs" if degrees else ""
            nearest = [xmin, round(ymax - rows * spacing, 9), round(xmin + columns * spacing, 9), ymax]
            raise ValueError(
                f"bounds_m={list(self.bounds_m)} is {counts[0]:.6g} × {counts[1]:.6g} pixels of {spacing} m; "
                f"the nearest whole grid is {nearest}{hint}"
            )
