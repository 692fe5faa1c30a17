"""Radiometry of a raster: meaning of its values, in words for the band and as JSON for the tag."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import isnan, log10
from typing import Any

from apertura.common.contracts import CF_SIGMA0

TAG = "APERTURA_RADIOMETRY"
CROSS_SECTIONS = "radiometry.json"
"""What the radio of a calibrated pair says of its image, beside the layers."""


@dataclass(frozen=True)
class Radiometry:
    """Meaning of the values of a raster, in any of its files.

    Attributes
    ----------
    amplitude, power
        What its amplitude is called, and its square.
    one_is
        What has the value 1, or 0 dB.
    divided_by
        Pair → largest amplitude of its image, by which it was divided before it was added.
    phases_removed_rad
        Pair → constant phase taken off before it was added; pairs that a coherent sum leaves out are missing.
    peak_db, noise_floor_re_peak_db
        Power of the brightest target, dB re 1; median power against the peak, dB; None where not measured.
    """

    amplitude: str
    power: str
    one_is: str
    divided_by: Mapping[str, float] = field(default_factory=dict)
    phases_removed_rad: Mapping[str, float] = field(default_factory=dict)
    peak_db: float | None = None
    noise_floor_re_peak_db: float | None = None

    def measured(self, amplitude: float, noise_floor_re_peak_db: float) -> "Radiometry":
        """Return it with the largest amplitude of one raster, and its median power against that.

        Examples
        --------
        >>> ECHO.measured(10.0, -49.0).peak_db
        20.0
        """
        return replace(
            self, peak_db=round(20 * log10(amplitude), 2) + 0.0, noise_floor_re_peak_db=noise_floor_re_peak_db
        )

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values, for image.json and for `TAG`."""
        return asdict(self)


ECHO = Radiometry("echo amplitude", "echo power", "the echo of a target that every pulse counted sees")
"""Of the image of a pair (docs/theory.md, eq. 6)."""


_COEFFICIENTS = {
    "sigma0": ("sigma0, radar cross-section per area of ground", "1 m2 per m2 of ground"),
    "beta0": ("beta0, radar cross-section per area of the slant plane", "1 m2 per m2 of the slant plane"),
    "gamma0": ("gamma0, radar cross-section per area across the line of sight", "1 m2 per m2 across the bisector"),
}


def of_coefficient(
    name: str, *, std_db: float | None, polarisation: str | None = None, noise: str = "in it"
) -> dict[str, Any]:
    """Return the radiometry of a calibrated raster, for `TAG`.

    Parameters
    ----------
    name
        sigma0, beta0 or gamma0.
    std_db
        Standard deviation of the calibration; None: not stated.
    polarisation
        Sent and received, such as HV; None: not stated.
    noise
        What became of noise.

    Examples
    --------
    >>> of_coefficient("sigma0", std_db=0.5)["standard_name"]
    'surface_backwards_scattering_coefficient_of_radar_wave'
    """
    power, one_is = _COEFFICIENTS[name]
    standard = {"standard_name": CF_SIGMA0} if name == "sigma0" else {}
    stated: dict[str, Any] = {"calibration_std_db": std_db} if std_db is not None else {"calibration_std": "not stated"}
    stated |= {"polarisation": polarisation or "not stated"}
    return {"amplitude": f"root of {power}", "power": power, "one_is": one_is, "noise": noise, **standard, **stated}


def of_multilooked(
    radiometry: Mapping[str, Any], *, side_px: int, looks: float, found: float, noise: str, speckle: str
) -> dict[str, Any]:
    """Return the radiometry of the mean power of squares of pixels, for `TAG`.

    Parameters
    ----------
    radiometry
        Of the pixels.
    side_px
        Of a square.
    looks, found
        Equivalent number of looks of a square by the correlation of speckle, and that of homogeneous ground as found;
        NaN where not measured.
    noise
        What became of noise.
    speckle
        The filter; none.

    Examples
    --------
    >>> said = of_multilooked(ECHO.report, side_px=4, looks=3.3, found=3.1, noise="in it", speckle="none")
    >>> said["power"], said["equivalent_looks"]
    ('mean echo power of 4 x 4 pixels, 3.3 looks', 3.3)
    """
    measured = {
        name: None if isnan(value) else round(value, 2)
        for name, value in (("equivalent_looks", looks), ("equivalent_looks_found", found))
    }
    words = f"mean {radiometry['power']} of {side_px} x {side_px} pixels"
    words += "" if isnan(looks) else f", {looks:.1f} looks"
    words += "" if speckle == "none" else f", {speckle} filter"
    stated = {"amplitude": f"root of {words}", "power": words, "noise": noise, "speckle_filter": speckle, **measured}
    return {name: value for name, value in radiometry.items() if value is not None} | stated


def of_sums(peaks: Mapping[str, float], phases_rad: Mapping[str, float]) -> dict[str, Radiometry]:
    """Return the radiometry of the sums of a flight's pairs, by their source in `apertura.formats.export.SOURCES`.

    Parameters
    ----------
    peaks
        Pair → largest amplitude of its image.
    phases_rad
        Pair of the coherent sum → phase taken off.

    Examples
    --------
    >>> of_sums({"a-a": 4.0, "a-b": 2.0}, {"a-a": 0.0})["noncoherent"].power
    'mean power of 2 peak-normalised images'
    """
    all_of, added = f"{len(peaks)} peak-normalised images", f"{len(phases_rad)} peak-normalised images"
    in_phase = f"mean of {added}, added with phase"
    shown = {pair: peaks[pair] for pair in phases_rad}
    best = "a place where every image added has its peak"
    return {
        "coherent": Radiometry(in_phase, f"power of the {in_phase}", f"{best}, in phase", shown, phases_rad),
        "noncoherent": Radiometry(f"root mean power of {all_of}", f"mean power of {all_of}", best, peaks),
        "magnitude": Radiometry(f"mean magnitude of {all_of}", f"squared mean magnitude of {all_of}", best, peaks),
    }
