"""Wave speed in the atmosphere: refractivity at the terrain, profile over height, and mean along a path."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef

SCALE_HEIGHT_M = 7350.0
"""Height over which the refractivity of air decreases to 1/e, metres: global mean profile of ITU-R P.453."""

STANDARD_HUMIDITY_PERCENT = 50.0
"""Relative humidity that is assumed if none is configured, percent; the standard atmosphere itself is dry."""

USUAL_N = 300.0
"""Typical refractivity at the terrain, N units; equal to the error if vacuum is assumed for a recorded flight."""

_STANDARD_K, _STANDARD_HPA, _LAPSE_K_M, _BAROMETRIC = 288.15, 1013.25, 6.5e-3, 5.2559  # ISO 2533, below 11 km
_HIGHEST_M = 11_000.0  # upper height limit of this lapse rate
_UNKNOWN = 10.0, 20.0, 100 / np.sqrt(12)  # K, hPa, % (uniform): standard deviations about the standard atmosphere
_MEASURED = 1.0, 1.0, 5.0  # K, hPa, %: accuracy of thermometer, barometer and hygrometer in the field
_STATED_N = 1.0  # N units: accuracy of a configured refractivity
_LEAST_N, _MOST_N = 20.0, 1000.0  # N units: 20 at an altitude of 20 km, 500 in the hottest and wettest air at sea level
# relative error of the decrease from the terrain to the mean along the path, for scale heights of 6.5 to 8.2 km
_PROFILE = 0.1


def refractivity(temperature_c: float, pressure_hpa: float, relative_humidity: float) -> float:
    """Return N = (n - 1)·10⁶ of air at radio frequencies.

    Parameters
    ----------
    temperature_c
        Degrees Celsius, -50 to 60.
    pressure_hpa
        Total pressure at the site (not reduced to sea level), hPa.
    relative_humidity
        Percent, over water.

    Notes
    -----
    Source: ITU-R P.453, N = 77.6/T·(P + 4810·e/T), accurate to 0.1 % up to 100 GHz and non-dispersive, with the
    saturation vapour pressure over water of the same recommendation; docs/theory/atmosphere.md, eq. 1.

    Examples
    --------
    >>> round(refractivity(15.0, 1013.25, 0.0), 1), round(refractivity(15.0, 1013.25, 50.0), 1)
    (272.9, 311.4)
    """
    kelvin, t = temperature_c + 273.15, temperature_c
    enhanced = 1 + 1e-4 * (7.2 + pressure_hpa * (0.0320 + 5.9e-6 * t**2))
    saturated_hpa = enhanced * 6.1121 * np.exp((18.678 - t / 234.5) * t / (t + 257.14))
    vapour_hpa = relative_humidity / 100 * saturated_hpa
    return float(77.6 / kelvin * (pressure_hpa + 4810 * vapour_hpa / kelvin))


def standard_weather(height_m: float) -> tuple[float, float, float]:
    """Return temperature (°C), pressure (hPa) and humidity (%) of the standard atmosphere at a height above sea level.

    Examples
    --------
    >>> [round(value, 2) for value in standard_weather(1000.0)]
    [8.5, 898.75, 50.0]
    """
    kelvin = _STANDARD_K - _LAPSE_K_M * float(np.clip(height_m, -1000.0, _HIGHEST_M))
    pressure_hpa = _STANDARD_HPA * (kelvin / _STANDARD_K) ** _BAROMETRIC
    return kelvin - 273.15, float(pressure_hpa), STANDARD_HUMIDITY_PERCENT


def wave_speed(refractivity_n: float) -> float:
    """Return the wave speed in a medium of given refractivity, m/s; for 0, exactly the speed of light in vacuum.

    Parameters
    ----------
    refractivity_n
        (n - 1)·10⁶, such as `Atmosphere.mean_n` of a path.

    Examples
    --------
    >>> import apertura as ap
    >>> air = ap.Atmosphere.standard(620.0)  # terrain height; the antenna is 300 m above it
    >>> round(ap.wave_speed(float(air.mean_n(920.0, 620.0))), -3)
    299708000.0
    """
    return SPEED_OF_LIGHT_M_S / (1 + 1e-6 * refractivity_n)


@dataclass(frozen=True)
class Atmosphere:
    """Atmosphere over a scene: refractivity at the terrain, decreasing exponentially with height.

    Attributes
    ----------
    refractivity_n
        Refractivity at `ground_m`, N units; 0: vacuum.
    ground_m
        Terrain height, metres. All heights refer to the same datum and are used as heights above sea level.
    source
        Source of the refractivity, a short phrase.
    std_n
        Standard deviation of the refractivity at the terrain, N units.

    Examples
    --------
    >>> air = Atmosphere.standard(0.0)
    >>> round(air.refractivity_n, 1), round(float(air.mean_n(3000.0, 0.0)), 1)
    (311.4, 255.6)
    """

    refractivity_n: float
    ground_m: float
    source: str
    std_n: float = 0.0

    @classmethod
    def vacuum(cls) -> "Atmosphere":
        """Return vacuum as an approximation of an unknown atmosphere, with the refractivity of air as its error.

        `stated(0.0)` is vacuum without an error, for recordings simulated in vacuum or corrected for the atmosphere.
        """
        return cls(0.0, 0.0, f"vacuum assumed, although air has about N = {USUAL_N:.0f}", USUAL_N)

    @classmethod
    def standard(cls, ground_m: float) -> "Atmosphere":
        """Return the standard atmosphere for a terrain height above sea level (m), with a humidity of 50 %."""
        weather = standard_weather(ground_m)
        source = f"standard atmosphere, terrain height {ground_m:.0f} m, humidity {STANDARD_HUMIDITY_PERCENT:.0f} %"
        return cls(refractivity(*weather), ground_m, source, _spread(weather, _UNKNOWN))

    @classmethod
    def of_weather(
        cls, temperature_c: float, pressure_hpa: float, relative_humidity: float, *, ground_m: float
    ) -> "Atmosphere":
        """Return the atmosphere for weather measured at the terrain; parameters as for `refractivity`."""
        weather = temperature_c, pressure_hpa, relative_humidity
        source = f"configured: {temperature_c:g} °C, {pressure_hpa:g} hPa, {relative_humidity:g} % at the terrain"
        return cls(refractivity(*weather), ground_m, source, _spread(weather, _MEASURED))

    @classmethod
    def stated(cls, refractivity_n: float, *, ground_m: float) -> "Atmosphere":
        """Return the atmosphere for a given refractivity at the terrain, N units."""
        if not (refractivity_n == 0 or _LEAST_N <= refractivity_n <= _MOST_N):
            raise CampaignError(
                f"a refractivity of {refractivity_n:g}",
                where="atmosphere",
                expected=f"N units, (n - 1)·10⁶: {_LEAST_N:g} to {_MOST_N:g}, or 0 for vacuum",
                remedy="Convert a refractive index n to (n - 1)·10⁶.",
            )
        std_n = _STATED_N if refractivity_n else 0.0  # a refractivity of 0 is exact: simulated in vacuum
        return cls(refractivity_n, ground_m, f"configured: N = {refractivity_n:g} at the terrain", std_n)

    def at_n(self, height_m: Any) -> Floats:
        """Return N at heights (m), in the shape of `height_m`."""
        return np.asarray(self.refractivity_n * np.exp((self.ground_m - np.asarray(height_m)) / SCALE_HEIGHT_M))

    def mean_n(self, one_m: Any, other_m: Any) -> Floats:
        """Return the mean of N along straight paths between two heights.

        Parameters
        ----------
        one_m, other_m
            Heights of both ends, metres, in shapes that broadcast.

        Notes
        -----
        Source: docs/theory/atmosphere.md, eq. 3. The height is linear along a path, so that the mean does not depend on
        the length of the path.

        Examples
        --------
        >>> air = Atmosphere(300.0, 0.0, "an example")
        >>> air.mean_n(0.0, 0.0), air.mean_n(np.array([735.0]), 0.0).round(2)
        (array(300.), array([285.49]))
        """
        low, high = np.minimum(one_m, other_m), np.maximum(one_m, other_m)
        scale = (high - low) / SCALE_HEIGHT_M
        mean_over_lowest = np.where(scale > 1e-9, -np.expm1(-scale) / np.maximum(scale, 1e-9), 1.0)
        return np.asarray(self.at_n(low) * mean_over_lowest)

    def over(self, tx_m: Floats, rx_m: Floats, range_m: tuple[Floats, Floats]) -> "FlightAir":
        """Return the constant refractivity for the flight of a pair.

        Parameters
        ----------
        tx_m, rx_m
            (pulse,) float64, heights of the antennas, metres.
        range_m
            (pulse,) float64 each, distances of both antennas from the scene, metres; used as weights of the one-way
            paths.
        """
        legs = np.stack([self.mean_n(tx_m, self.ground_m), self.mean_n(rx_m, self.ground_m)])
        length_m = np.stack(range_m)
        of_pulses = (legs * length_m).sum(axis=0) / np.maximum(length_m.sum(axis=0), 1e-9)
        mean = float(of_pulses.mean())
        decrease = abs(self.refractivity_n - mean)
        std_n = self.std_n * (mean / self.refractivity_n if self.refractivity_n else 1.0)
        residual_m = length_m.sum(axis=0) * 1e-6 * (of_pulses - mean)
        return FlightAir(
            mean,
            float(np.hypot(std_n, _PROFILE * decrease)),
            self,
            float(np.mean([tx_m.mean(), rx_m.mean()])),
            float(length_m.sum(axis=0).mean()),
            float(np.abs(residual_m).max()),
        )


@dataclass(frozen=True)
class FlightAir:
    """Atmosphere of the flight of a pair: a constant refractivity for all paths.

    Attributes
    ----------
    refractivity_n
        Mean of N along both one-way paths and over the pulses.
    std_n
        Standard deviation of `refractivity_n`, N units.
    atmosphere
        Atmosphere from which the mean is computed.
    antennas_m
        Mean height of the antennas, metres.
    path_m
        Mean total path to the scene, metres.
    left_m
        Largest error of a total path due to the constant refractivity, metres.
    """

    refractivity_n: float
    std_n: float
    atmosphere: Atmosphere
    antennas_m: float
    path_m: float
    left_m: float

    @property
    def wave_speed_m_s(self) -> float:
        """Wave speed along the paths, m/s."""
        return wave_speed(self.refractivity_n)

    @property
    def report(self) -> dict[str, Any]:
        """The refractivity as JSON values, for stages and image.json."""
        air = self.atmosphere
        return {
            "refractivity_n": round(self.refractivity_n, 3),
            "std_n": round(self.std_n, 2),
            "source": air.source,
            "ground_n": round(air.refractivity_n, 3),
            "ground_m": round(air.ground_m, 1),
            "antennas_m": round(self.antennas_m, 1),
            "range_m": round(self.path_m / 2, 2),
            "vacuum_shift_m": round(1e-6 * self.refractivity_n * self.path_m / 2, 4),
            "constant_refractivity_error_m": float(f"{self.left_m:.2g}"),
        }


@dataclass(frozen=True, eq=False)
class SceneAir:
    """Atmosphere over a scene at a known position.

    Attributes
    ----------
    atmosphere
        Refractivity as a function of height.
    middle_m
        (3,) float64, metres, in the frame of the antennas: the scene centre.
    frame
        'ecef' (heights above the ellipsoid) or 'local' (heights are z).
    """

    atmosphere: Atmosphere
    middle_m: Floats
    frame: str

    def over(self, aperture: Aperture) -> FlightAir:
        """Return the constant refractivity of the paths of a pair to the scene."""
        tx_m, rx_m = (self._heights(position_m) for position_m in aperture.legs)
        ranges = tuple(np.linalg.norm(position_m - self.middle_m, axis=1) for position_m in aperture.legs)
        return self.atmosphere.over(tx_m, rx_m, (ranges[0], ranges[1]))

    def electrical_m(self, one_m: Floats, other_m: Floats) -> Floats:
        """Return the electrical lengths (c times delay) of straight paths between antennas (pulse, 3), (pulse,) metres.

        The refractivity at the height of the antennas is used, which is lower than the refractivity along paths to the
        scene.
        """
        length_m = np.linalg.norm(one_m - other_m, axis=1)
        mean_n = self.atmosphere.mean_n(self._heights(one_m), self._heights(other_m))
        return np.asarray(length_m * (1 + 1e-6 * mean_n))

    def _heights(self, position_m: Floats) -> Floats:
        return position_m[:, 2] if self.frame == LOCAL else geodetic_from_ecef(position_m)[:, 2]


def _spread(weather: tuple[float, float, float], std: tuple[float, float, float]) -> float:
    """Return the standard deviation of N for independent errors of temperature, pressure and humidity."""
    nominal, changes = refractivity(*weather), []
    for number, error in enumerate(std):
        changed = list(weather)
        changed[number] += error
        changes.append(refractivity(*changed) - nominal)
    return float(np.hypot.reduce(changes))
