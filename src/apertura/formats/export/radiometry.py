"""Radiometry of a raster: meaning of its values, as description of the band and as JSON for the tag."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import isnan, log10
from typing import Any

from apertura.common.contracts import CF_SIGMA0

TAG = "APERTURA_RADIOMETRY"
"""Name of the tag that contains the meaning of a raster's values as JSON."""

CROSS_SECTIONS = "radiometry.json"
"""File name of the report of a pair's radiometric calibration, in the folder of the layers."""


@dataclass(frozen=True)
class Radiometry:
    """Meaning of the values of a raster, common to its files.

    Attributes
    ----------
    amplitude, power
        Names of the amplitude and of its square.
    one_is
        Reference to which the value 1, or 0 dB, corresponds.
    divided_by
        Pair → largest amplitude of its image, by which the image was divided before summation.
    phases_removed_rad
        Pair → constant phase removed before summation; pairs excluded from the coherent sum are omitted.
    peak_db, noise_floor_re_peak_db
        Power of the brightest target, dB re 1; median power relative to the peak, dB; None: not measured.
    """

    amplitude: str
    power: str
    one_is: str
    divided_by: Mapping[str, float] = field(default_factory=dict)
    phases_removed_rad: Mapping[str, float] = field(default_factory=dict)
    peak_db: float | None = None
    noise_floor_re_peak_db: float | None = None

    def measured(self, amplitude: float, noise_floor_re_peak_db: float) -> "Radiometry":
        """Add the peak power of a raster, from its largest amplitude, and its median power relative to the peak.

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
        """Fields as JSON values, for image.json and for `TAG`."""
        return asdict(self)


ECHO = Radiometry(
    "echo amplitude",
    "echo power",
    "an echo with a transfer function of magnitude 1 in every pulse used; not calibrated",
)
"""Radiometry of the image of a pair (docs/theory.md, eq. 6)."""


_COEFFICIENTS = {
    "sigma0": ("sigma0, radar cross-section per ground area", "1 m2 per m2 of ground area"),
    "beta0": ("beta0, radar cross-section per slant-plane area", "1 m2 per m2 of slant-plane area"),
    "gamma0": (
        "gamma0, radar cross-section per area normal to the line of sight",
        "1 m2 per m2 normal to the bisector",
    ),
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
        Transmit and receive polarisation, such as HV; None: not stated.
    noise
        Treatment of noise power: 'in it' (included), 'subtracted', or 'alone' for a raster of noise.

    Examples
    --------
    >>> of_coefficient("sigma0", std_db=0.5)["standard_name"]
    'surface_backwards_scattering_coefficient_of_radar_wave'
    """
    power, one_is = _COEFFICIENTS[name]
    standard = {"standard_name": CF_SIGMA0} if name == "sigma0" else {}
    calibration: dict[str, Any] = (
        {"calibration_std_db": std_db} if std_db is not None else {"calibration_std": "not stated"}
    )
    calibration |= {"polarisation": polarisation or "not stated"}
    meaning = {"amplitude": f"root of {power}", "power": power, "one_is": one_is, "noise": noise}
    return {**meaning, **standard, **calibration}


def of_multilooked(
    radiometry: Mapping[str, Any], *, side_px: int, looks: float, found: float, noise: str, speckle: str
) -> dict[str, Any]:
    """Return the radiometry of a multilooked power, for `TAG`.

    Parameters
    ----------
    radiometry
        Radiometry of the pixels.
    side_px
        Side of a square block, pixels.
    looks, found
        Equivalent number of looks of a block predicted from the speckle correlation, and measured on homogeneous
        terrain; NaN: not measured.
    noise
        Treatment of noise power, see `of_coefficient`.
    speckle
        Name of the speckle filter, or 'none'.

    Examples
    --------
    >>> report = of_multilooked(ECHO.report, side_px=4, looks=3.3, found=3.1, noise="in it", speckle="none")
    >>> report["power"], report["equivalent_looks"]
    ('mean echo power of 4 x 4 pixels, 3.3 looks', 3.3)
    """
    measured = {
        name: None if isnan(value) else round(value, 2)
        for name, value in (("equivalent_looks", looks), ("equivalent_looks_found", found))
    }
    power = f"mean {radiometry['power']} of {side_px} x {side_px} pixels"
    power += "" if isnan(looks) else f", {looks:.1f} looks"
    power += "" if speckle == "none" else f", {speckle} filter"
    report = {"amplitude": f"root of {power}", "power": power, "noise": noise, "speckle_filter": speckle, **measured}
    return {name: value for name, value in radiometry.items() if value is not None} | report


def of_sums(peaks: Mapping[str, float], phases_rad: Mapping[str, float]) -> dict[str, Radiometry]:
    """Return the radiometry of the sums of a flight's pairs, by their source in `apertura.formats.export.SOURCES`.

    Parameters
    ----------
    peaks
        Pair → largest amplitude of its image.
    phases_rad
        Pair of the coherent sum → phase removed.

    Examples
    --------
    >>> of_sums({"a-a": 4.0, "a-b": 2.0}, {"a-a": 0.0})["noncoherent"].power
    'mean power of 2 peak-normalised images'
    """
    all_images, coherent_images = (f"{len(pairs)} peak-normalised images" for pairs in (peaks, phases_rad))
    coherent = f"coherent mean of {coherent_images}"
    coherent_peaks = {pair: peaks[pair] for pair in phases_rad}
    one_is = "a point at which all summed images have their peak"
    return {
        "coherent": Radiometry(coherent, f"power of the {coherent}", f"{one_is}, in phase", coherent_peaks, phases_rad),
        "noncoherent": Radiometry(f"root mean power of {all_images}", f"mean power of {all_images}", one_is, peaks),
        "magnitude": Radiometry(
            f"mean magnitude of {all_images}", f"squared mean magnitude of {all_images}", one_is, peaks
        ),
    }
