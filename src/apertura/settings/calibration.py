"""Section `calibration`: path offsets from a flight over a reflector."""

from pydantic import Field

from apertura.settings.names import Name
from apertura.settings.section import Metres3, Section


class Calibration(Section):
    """Which flight the path offsets come from."""

    flight: Name = Field(description="flight of kind calibration whose offsets the imaging flights use")
    reflector_m: Metres3 = Field(description="reflector: easting, northing in scene.crs, ellipsoidal height, m")
    search_m: float = Field(10.0, gt=0, description="offsets of either sign up to this are considered, m")
