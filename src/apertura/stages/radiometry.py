"""Radiometric calibration of a pair's image, from the configured radio or from a measured calibration constant."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from apertura.campaign.config import Node, Receiver, SampledWaveform, polarisation_of, radio_of
from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.common.documents import read_json, validated
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import sha256_file
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency
from apertura.core.echo.symbol_filter import SymbolFilter, filter_of
from apertura.core.imaging.noise import PulseNoise, noise_places, sidelink_noise, symbols_noise
from apertura.core.imaging.radiometry import Calibration, Link, Turn, cell_constant, pointing_std_db
from apertura.core.imaging.reflectors import DRIFT_SIGMAS
from apertura.core.quality.bright_points import DEEPEST_DB, SPECKLE, BrightPoint
from apertura.core.quality.budget import ATTITUDE_STD_DEG
from apertura.core.quality.measures import BlockRaster
from apertura.stages.agreement import bright_points_within
from apertura.stages.pair import OpenPair
from apertura.stages.planning import integration_of
from apertura.stages.scene import OpenScene
from apertura.stages.transmitted import transmitted

FILE = "calibration.json"
"""Name of the file of calibration constants, in the campaign folder."""

_TOLERANCE = 1e-3
"""Tolerated relative difference of frequencies and powers; it changes a constant by at most 0.01 dB."""

_REMEDY = "Measure with `apertura reflectors`, or set processing.radiometric_calibration to null."

Decibels = Annotated[float, Field(ge=-1000, le=1000)]
Line = Annotated[str, Field(max_length=400)]
Deviation = Annotated[float, Field(ge=0, le=1000)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AntennaShape(_Part):
    """Pattern of an antenna; calibration constants are referred to its peak."""

    beamwidth_deg: tuple[float, float] | None
    pattern_sha256: str | None


class Radar(_Part):
    """Signal and antennas with which a calibration constant was measured, and for which alone the constant is valid.

    `sent_power` is the mean power of the transmitted signal in the units by which echoes are divided; None for phase
    histories.
    """

    centre_hz: Annotated[float, Field(gt=0)]
    bandwidth_hz: Annotated[float, Field(gt=0)]
    subcarriers: int
    sent_power: float | None
    antennas: Mapping[str, AntennaShape]
    polarisation: Annotated[str, Field(pattern="^[HVLR]{2}$")] | None = None

    @classmethod
    def of(cls, campaign: Campaign, opened: OpenPair) -> "Radar":
        """Return signal and antennas of an open pair."""
        waveform, frequency = campaign.settings.waveform, opened.frequency_hz
        sent = transmitted(campaign, waveform).mean_power if isinstance(waveform, SampledWaveform) else None
        files = campaign.pattern_files(opened.name)
        shapes = {}
        for point, (node, antenna) in campaign.antennas(opened.name).items():
            path = files.get(f"nodes.{node}.antennas.{point}.pattern")
            shapes[point] = AntennaShape(
                beamwidth_deg=antenna.beamwidth_deg, pattern_sha256=None if path is None else sha256_file(path)
            )
        return cls(
            centre_hz=centre_frequency(frequency),
            bandwidth_hz=float(frequency[-1] - frequency[0]),
            subcarriers=len(frequency),
            sent_power=sent,
            antennas=shapes,
            polarisation=polarisation_of(campaign.settings.nodes, opened.name),
        )

    def differs(self, other: "Radar") -> str | None:
        """Return the first difference from another radar as text; None if there is none.

        Examples
        --------
        >>> radar = Radar(centre_hz=1.3e9, bandwidth_hz=2e8, subcarriers=256, sent_power=1.0, antennas={})
        >>> radar.differs(radar), radar.differs(radar.model_copy(update={"centre_hz": 1.4e9}))
        (None, 'centre_hz is 1.4e+09 and was 1.3e+09')
        """
        for name in type(self).model_fields:
            was, now = getattr(self, name), getattr(other, name)
            if name == "polarisation" and None in (was, now):
                continue  # not configured for one of the two radars
            numbers = isinstance(was, float) and isinstance(now, float)
            if not (abs(was - now) <= _TOLERANCE * abs(was) if numbers else was == now):
                new, old = (f"{value:g}" if isinstance(value, float) else str(value) for value in (now, was))
                return f"{name} is {new} and was {old}"
        return None


class PairConstant(_Part):
    """Calibration constant of a pair, and its phase relative to the file's `reference` pair, rad; None if not measured.

    `profile_noise` is the noise power of a pulse divided by Σw² of the window; it changes with the receiver gain.
    """

    radar: Radar
    constant_db: Decibels
    std_db: Deviation
    chance: Annotated[float, Field(ge=0, le=1)]
    reflectors: Annotated[int, Field(ge=1)]
    flights: Annotated[int, Field(ge=1)]
    phase_rad: float | None
    phase_std_rad: Deviation | None
    profile_noise: Annotated[float, Field(gt=0)] | None = None
    flags: Mapping[Annotated[str, Field(pattern="^(constant_drifts|reflectors_disagree)$")], Line]

    @property
    def constant(self) -> float:
        """Calibration constant K, m⁴ per m²."""
        return float(10 ** (self.constant_db / 10))


class Constants(_Part):
    """Content of calibration.json."""

    schema_version: Literal[1] = 1
    software: str
    campaign: str
    flights: Mapping[str, str]
    reference: str
    pairs: Annotated[Mapping[str, PairConstant], Field(min_length=1)]
    measurements: tuple[Mapping[str, Any], ...]
    images: Mapping[str, str]

    @property
    def measured(self) -> str:
        """Source of the constants: campaign and dates, as text."""
        days = sorted({began[:10] for began in self.flights.values()})
        return f"reflectors of campaign {self.campaign}, {', '.join(days)}"


def read_constants(path: Path) -> Constants:
    """Read a file of calibration constants.

    Raises
    ------
    CampaignError
        If the file is missing or invalid.
    """
    expected, remedy = "a file of `apertura reflectors`", "Copy the file from the campaign with the reflectors."
    return validated(Constants, read_json(path, expected=expected, remedy=remedy), where=path, expected=expected)


def constant_of(campaign: Campaign, opened: OpenPair) -> tuple[PairConstant, str] | None:
    """Return the measured calibration constant of an open pair, and its source.

    The result is None if the config names no file, or if the file has only constants of other pairs of the campaign,
    for example because a reflector for monostatic pairs does not calibrate a bistatic pair.

    Raises
    ------
    CampaignError
        If the file contains no pair of the campaign, or its constant was measured with another radar.
    """
    path = campaign.calibration_file
    if path is None:
        return None
    constants = read_constants(path)
    check_pairs(constants, campaign, path)
    if opened.name not in constants.pairs:
        return None
    constant = constants.pairs[opened.name]
    difference = constant.radar.differs(Radar.of(campaign, opened))
    if difference is not None:
        raise CampaignError(
            f"the constant of {opened.name} was measured with another radar: {difference}",
            where=path,
            expected="constants measured with the same band, signal and antennas",
            remedy=_REMEDY,
        )
    return constant, constants.measured


def check_pairs(constants: Constants, campaign: Campaign, path: Path) -> None:
    """Check that a file of constants contains a pair of the campaign; raise CampaignError if not."""
    pairs = list(dict.fromkeys(pair for flight in campaign.image_flights for pair in flight.pairs))
    if constants.pairs.keys().isdisjoint(pairs):
        line = f"constants of {', '.join(constants.pairs)} only, none of {', '.join(pairs)}"
        raise CampaignError(line, path, "a constant of at least one imaged pair", _REMEDY)


LEAST_CONTRAST = 10.0
"""Smallest ratio of peak power to noise and clutter for a cross-section; weaker peaks may be noise or clutter."""

_UNSTATED_STD_DB, _FIGURE_STD_DB = 1.0, 0.5  # assumed, dB: radio without amplitude_std_db; noise figure
_SIDELINK_STD_DB = 0.3  # standard deviation of the predicted noise of sidelink and symbols
_MOST_POINTS = 50  # number of brightest points whose cross-sections are reported

POINTS_LISTED = {
    "most": _MOST_POINTS,
    "below_brightest_db": DEEPEST_DB,
    "above_surroundings_db": round(-decibels(SPECKLE), 1),
}
"""Limits of the list of points in radiometry.json; weaker targets are not listed."""


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """Pair with a configured radio or a measured calibration constant.

    Attributes
    ----------
    calibrated_by
        Source of the constant, as text.
    link
        Configured radio; None if it is not configured.
    std_db
        Standard deviation of the constant; None if it is unknown.
    flags
        Flags of the constant.
    calibration
        Calibration of the image.
    beams
        Weights of the pulses.
    radio_std_db
        Standard deviation of the configured radio; None if it is unknown.
    thermal_noise
        Thermal noise power in a profile for a noise figure of 0 dB; None without a configured radio.
    noise_before
        Noise power of a pulse in the flights that measured the constant; None if it was not measured.
    sidelink_noise
        Noise power that the sidelink adds to a profile; 0 without a sidelink.
    symbols_noise
        Noise power in a profile from symbols of varying modulus, of echoes and noise; 0 for the reciprocal filter.
    self_noise
        Variance κ of the echo amplitude over the data, of `symbols_noise`.
    noise_figure_db
        Configured noise figure; None if it is not configured.
    pointing_std_db
        Standard deviation of the power at the scene centre from attitude errors and the beams.
    """

    calibrated_by: str
    link: Link | None
    std_db: float | None
    flags: Flags
    calibration: Calibration
    beams: Beams | None
    radio_std_db: float | None
    thermal_noise: float | None
    noise_before: float | None
    sidelink_noise: float
    symbols_noise: float
    self_noise: float
    noise_figure_db: float | None
    pointing_std_db: float

    def points(self, bright: list[BrightPoint], scene: OpenScene, pulse_noise: float) -> list[dict[str, Any]]:
        """Return the radar cross-sections of bright points, for radiometry.json.

        Parameters
        ----------
        bright
            Bright points of the image, brightest first.
        scene
            Scene of the image.
        pulse_noise
            Measured noise power of a pulse.
        """
        bright = bright[:_MOST_POINTS]
        rows, columns = (np.array([getattr(point, name) for point in bright]) for name in ("row", "column"))
        if not bright:
            return []
        positions = scene.grid.map_at(rows, columns)
        values = self.cross_sections(
            scene.terrain.positions_at(scene.grid, rows, columns),
            np.array([point.amplitude for point in bright]),
            np.array([point.background for point in bright]),
            pulse_noise,
        )
        return [
            {"x_m": round(float(x), 4), "y_m": round(float(y), 4), **value}
            for (x, y), value in zip(positions, values, strict=True)
        ]

    def cross_sections(
        self,
        points_m: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        background: NDArray[np.float64],
        pulse_noise: float,
    ) -> list[dict[str, Any]]:
        """Return radar cross-sections of peaks of an image, with their standard deviations.

        Parameters
        ----------
        points_m
            (point, 3) float64, in the frame of the aperture.
        amplitude, background
            (point,) float64: amplitude of the peak, and power of its surroundings relative to the peak power.
        pulse_noise
            Measured noise power of a pulse.

        Returns
        -------
        list of dict
            rcs_m2, rcs_dbsm, std_db and scatter_db of each peak; None if its contrast is below `LEAST_CONTRAST`.

        Notes
        -----
        Source: docs/theory/radiometry.md, eq. 4.
        """
        per_m2, share = self.calibration.at(points_m)
        power, noise = amplitude**2, share * (pulse_noise if np.isfinite(pulse_noise) else 0.0)
        sigma = np.maximum(power - noise, 0.0) / np.where(per_m2 > 0, per_m2, np.nan)
        inverse = np.maximum(noise / power, background)
        scatter_db = 10 / np.log(10) * np.sqrt(2 * inverse + inverse**2)
        std_db = np.hypot(scatter_db, self.std_db or 0.0)
        with np.errstate(divide="ignore"):
            sigma_db = 10 * np.log10(sigma)
        return [
            {
                "rcs_m2": float(f"{rcs_m2:.4g}"),
                "rcs_dbsm": round(float(rcs_db), 2),
                "std_db": round(float(std), 2),
                "scatter_db": round(float(scatter), 2),
            }
            if np.isfinite(rcs_db) and LEAST_CONTRAST * background_share <= 1
            else {"rcs_m2": None, "rcs_dbsm": None, "std_db": None, "scatter_db": None}
            for rcs_m2, rcs_db, std, scatter, background_share in zip(
                sigma, sigma_db, std_db, scatter_db, inverse, strict=True
            )
        ]

    def noise_report(self, pulse_noise: PulseNoise, *, bound: bool) -> tuple[dict[str, Any], Flags]:
        """Return the measured noise figure, and a flag if it disagrees with the configured or earlier noise.

        Parameters
        ----------
        pulse_noise
            Measured noise; NaN if it was not measured.
        bound
            True if the measured noise is an upper bound, because it contains aliased echoes.

        Notes
        -----
        Source: docs/theory/radiometry.md, eqs. 8, 8a and 8b.
        """
        added = self.sidelink_noise + self.symbols_noise
        # the factors of `symbols_noise` multiply the receiver noise in the transfer functions, too
        receiver_noise = (pulse_noise.power - added) * (1 + self.self_noise)
        report = {"noise_figure_db": self.noise_figure_db, "noise_figure_measured_db": None, "std_db": None}
        report |= {"sidelink": self.sidelink_noise or None}
        report |= {"symbols": self.symbols_noise} if self.symbols_noise else {}
        differences = list[tuple[str, float, float]]()
        if self.thermal_noise and receiver_noise > 0:  # False for NaN
            figure_db = decibels(receiver_noise / self.thermal_noise)
            measured_std_db = np.hypot(pulse_noise.std_db * pulse_noise.power, _SIDELINK_STD_DB * added) / (
                pulse_noise.power - added
            )
            report |= {"noise_figure_measured_db": round(figure_db, 2), "std_db": round(float(measured_std_db), 2)}
            radio_db = _UNSTATED_STD_DB if self.radio_std_db is None else self.radio_std_db
            std_db = float(np.hypot(measured_std_db, np.hypot(radio_db, _FIGURE_STD_DB)))
            if self.noise_figure_db is not None:
                differences.append(("the configured noise figure", figure_db - self.noise_figure_db, std_db))
            elif figure_db < 0:  # no receiver has a noise figure below 0 dB
                differences.append(("a noise figure of 0 dB", figure_db, std_db))
        if self.noise_before and pulse_noise.power > 0 and not added:
            std_db = float(np.hypot(2**0.5 * pulse_noise.std_db, _FIGURE_STD_DB))
            since_db = decibels(pulse_noise.power / self.noise_before)
            differences.append(("the noise of the reflector flights (receiver gain changed?)", since_db, std_db))
        lines = [
            f"measured noise is {by_db:+.1f} ± {std_db:.1f} dB relative to {reference}"
            for reference, by_db, std_db in differences
            if abs(by_db) > DRIFT_SIGMAS * std_db and not (by_db > 0 and bound)
        ]
        return report, Flags({"noise_disagrees": "; ".join(lines)} if lines else {})


def stated_link(campaign: Campaign, pair: str) -> tuple[Link, float | None, float | None] | None:
    """Return the configured radio of a pair, its standard deviation (None: unknown) and its noise figure, dB.

    The result is None if the radio is not completely configured, which is permitted with measured constants.
    """
    power, transmit, receive, receiver = radio_of(campaign.settings.nodes, pair).values()
    if not isinstance(receiver, Receiver) or None in (power, transmit, receive):
        return None
    nodes: list[Node] = [campaign.settings.nodes[name] for name in dict.fromkeys(pair.split("-"))]
    stds_db = [node.amplitude_std_db for node in nodes]
    std_db = None if None in stds_db else float(np.sqrt(sum((one or 0.0) ** 2 for one in stds_db)))
    power_dbm, transmit_dbi, receive_dbi = (float(str(value)) for value in (power, transmit, receive))
    link = Link(
        power_dbm,
        transmit_dbi,
        receive_dbi,
        receiver.gain_db,
        receiver.at_full_scale_dbm,
        receiver.full_scale_counts,
    )
    return link, std_db, receiver.noise_figure_db


def calibrated_pair(
    campaign: Campaign,
    opened: OpenPair,
    scene: OpenScene,
    *,
    weights: tuple[Beams | None, int] | None = None,
    threads: int = 1,
) -> CalibratedPair | None:
    """Return the calibration of the image of an open pair; None if radio and calibration constant are unknown.

    Parameters
    ----------
    campaign, opened, scene
        Campaign, pair opened from its echo, and scene with grid and terrain.
    weights
        Weights of the pulses and divisor of the image (default: `image_weights`).
    threads
        Number of lattice blocks processed in parallel.
    """
    waveform, frequency = campaign.settings.waveform, opened.frequency_hz
    measured, stated = constant_of(campaign, opened), stated_link(campaign, opened.name)
    sent = transmitted(campaign, waveform) if stated and isinstance(waveform, SampledWaveform) else None
    link, radio_db, figure_db = stated if stated and sent else (None, None, None)
    std_db, constant, source, flags = radio_db, 0.0, "the configured radio", Flags()
    if link and sent:
        wavelength_m = SPEED_OF_LIGHT_M_S / centre_frequency(frequency)
        constant = link.constant(wavelength_m=wavelength_m, sent_power=sent.mean_power)
    if measured:
        of_pair, source = measured
        flags = Flags.merged(of_pair.flags, _disagreement(of_pair, constant, std_db) if link else {})
        constant, std_db = of_pair.constant, of_pair.std_db
    elif not link:
        return None
    beams, count = weights or image_weights(campaign, opened, scene)
    calibration = Calibration.of(
        scene.grid,
        scene.terrain,
        opened.aperture,
        beams,
        constant=constant,
        cell_m2=cell_constant(frequency, opened.weight),
        count=count,
        threads=threads,
    )
    thermal, added, by_symbols, self_noise = None, 0.0, 0.0, 0.0
    symbols = opened.report.get("symbols", {})
    noise = measured[0].profile_noise if measured else None
    before = None if noise is None else noise * float((opened.weight**2).sum())
    if link and sent:
        inverse = sent.inverses.sampled()
        filtered = (filter_of(symbols) or SymbolFilter()).applied(inverse, inverse)
        squares = ((opened.weight * np.abs(filtered)) ** 2).sum(axis=1).mean()
        thermal = link.pulse_noise(0.0, spacing_hz=sent.numerology.spacing_hz, squares=float(squares))
    sidelink = opened.report.get("sidelink")
    if opened.history:
        where = opened.history, scene.grid, scene.terrain, noise_places(scene.grid, scene.terrain)
        if sidelink:
            added = sidelink_noise(*where, beams=beams, method=sidelink["method"], snr_db=sidelink["snr_db"])
        if symbols.get("self_noise") and symbols.get("rows", 1) > 1:  # of equal symbols, the sidelobes are constant
            self_noise = symbols["self_noise"]
            by_symbols = symbols_noise(*where, beams=beams, self_noise=self_noise)
    pointing_db = pointing_std_db(beams, opened.aperture, scene.middle_m, _attitude_errors(campaign, opened, scene))
    return CalibratedPair(
        source,
        link,
        std_db,
        flags,
        calibration,
        beams,
        radio_db,
        thermal,
        before,
        added,
        by_symbols,
        self_noise,
        figure_db,
        pointing_db,
    )


def image_weights(campaign: Campaign, opened: OpenPair, scene: OpenScene) -> tuple[Beams | None, int]:
    """Return the weights of a pair's pulses in its image, and the divisor of the image."""
    integration = integration_of(campaign, opened, scene)
    count = integration.count if integration.sector else None
    return Beams.within(integration.sector, opened.beams, opened.gate), count or len(opened.aperture)


def _attitude_errors(campaign: Campaign, opened: OpenPair, scene: OpenScene) -> list[Turn]:
    """Return the attitude errors of a pair's nodes about east, north and up: configured, or typical of the source."""
    legs, turns = opened.name.split("-"), list[Turn]()
    for name in dict.fromkeys(legs):
        node = campaign.settings.nodes[name]
        if node.attitude != "none":
            tilt, heading = node.attitude_error_deg or ATTITUDE_STD_DEG[node.attitude]
            of = legs[0] == name, legs[1] == name
            turns += [
                (np.radians(size) * axis, of) for size, axis in zip((tilt, tilt, heading), scene.axes, strict=True)
            ]
    return turns


def _disagreement(measured: PairConstant, configured: float, std_db: float | None) -> dict[str, str]:
    """Return the flag of a measured constant that disagrees with the configured radio."""
    difference_db = decibels(configured) - measured.constant_db
    both_db = float(np.hypot(measured.std_db, std_db or 0.0))
    if std_db is None or abs(difference_db) <= DRIFT_SIGMAS * both_db:
        return {}
    return {
        "constant_disagrees": f"constant from the configured radio is {difference_db:+.2f} dB relative to the constant "
        f"measured at reflectors, i.e. {abs(difference_db) / both_db:.1f} standard deviations of the difference"
    }


def points_of(
    image: BlockRaster, quality: dict[str, Any], scene: OpenScene, windows: list[Window]
) -> list[BrightPoint]:
    """Return the bright points of a finished image, brightest first; `quality`: attribute of its stage."""
    focus = quality["focus"]
    spectrum = np.array(focus["spectrum_cycles2_m2"])
    return bright_points_within(image, scene.grid, windows, spectrum, cell_m=focus["cell_m"])
