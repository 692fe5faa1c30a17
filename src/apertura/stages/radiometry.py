"""Radiometry of a pair: from its radio as stated, or its constant as measured, to the calibration of its image."""

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
from apertura.core.imaging.noise import PulseNoise, noise_places, sidelink_noise
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
"""Name of the file, in the campaign folder."""

_SAME = 1e-3  # relative: of frequencies and powers that are stated alike, which moves a constant by 0.01 dB at most

_REMEDY = "Measure with `apertura reflectors`, or set processing.radiometric_calibration to null."

Decibels = Annotated[float, Field(ge=-1000, le=1000)]
Line = Annotated[str, Field(max_length=400)]
Deviation = Annotated[float, Field(ge=0, le=1000)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AntennaShape(_Part):
    """Pattern of an antenna, to whose peak a constant is referred."""

    beamwidth_deg: tuple[float, float] | None
    pattern_sha256: str | None


class Radar(_Part):
    """Conditions of a constant beside the radio: it holds under the same ones alone.

    `sent_power` is the mean power of the signal in the units that echoes are divided by; None of phase histories.
    """

    centre_hz: Annotated[float, Field(gt=0)]
    bandwidth_hz: Annotated[float, Field(gt=0)]
    subcarriers: int
    sent_power: float | None
    antennas: Mapping[str, AntennaShape]
    polarisation: Annotated[str, Field(pattern="^[HVLR]{2}$")] | None = None

    @classmethod
    def of(cls, campaign: Campaign, opened: OpenPair) -> "Radar":
        """Return the conditions of the constant of an open pair."""
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
        """Return in what another radar is another, in words; None where they are the same.

        Examples
        --------
        >>> one = Radar(centre_hz=1.3e9, bandwidth_hz=2e8, subcarriers=256, sent_power=1.0, antennas={})
        >>> one.differs(one), one.differs(one.model_copy(update={"centre_hz": 1.4e9}))
        (None, 'centre_hz is 1.4e+09 and was 1.3e+09')
        """
        for name in type(self).model_fields:
            was, now = getattr(self, name), getattr(other, name)
            if name == "polarisation" and None in (was, now):
                continue  # no other set-up is stated
            numbers = isinstance(was, float) and isinstance(now, float)
            if not (abs(was - now) <= _SAME * abs(was) if numbers else was == now):
                words = [f"{one:g}" if isinstance(one, float) else str(one) for one in (now, was)]
                return f"{name} is {words[0]} and was {words[1]}"
        return None


class PairConstant(_Part):
    """Constant of a pair, and its phase against `reference` of the file, rad; None where they share no image.

    `profile_noise` is the noise of a pulse per Σw² of the window: of another gain of the receiver it is another.
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
        """K, m⁴ per m²."""
        return float(10 ** (self.constant_db / 10))


class Constants(_Part):
    """calibration.json."""

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
        """When and where from, in words."""
        days = sorted({began[:10] for began in self.flights.values()})
        return f"reflectors of campaign {self.campaign}, {', '.join(days)}"


def read_constants(path: Path) -> Constants:
    """Return a file of constants.

    Raises
    ------
    CampaignError
        If it is not there, or is no such file.
    """
    expected, remedy = "what `apertura reflectors` writes", "Copy it from the campaign that measured it."
    return validated(Constants, read_json(path, expected=expected, remedy=remedy), where=path, expected=expected)


def constant_of(campaign: Campaign, opened: OpenPair) -> tuple[PairConstant, str] | None:
    """Return the measured constant of an open pair and where it comes from.

    None where the config names no file, or where that holds constants of other pairs of the campaign alone: a
    reflector that serves monostatic pairs calibrates no bistatic one.

    Raises
    ------
    CampaignError
        If the file holds no pair of the campaign, or was measured with another radar.
    """
    path = campaign.calibration_file
    if path is None:
        return None
    constants = read_constants(path)
    check_pairs(constants, campaign, path)
    if opened.name not in constants.pairs:
        return None
    found = constants.pairs[opened.name]
    other = found.radar.differs(Radar.of(campaign, opened))
    if other is not None:
        raise CampaignError(
            f"measured with another radar than {opened.name} now: {other}",
            where=path,
            expected="constants of the same band, signal and antennas",
            remedy=_REMEDY,
        )
    return found, constants.measured


def check_pairs(constants: Constants, campaign: Campaign, path: Path) -> None:
    """Raise CampaignError where a file of constants holds none of a campaign's pairs."""
    pairs = list(dict.fromkeys(pair for flight in campaign.image_flights for pair in flight.pairs))
    if constants.pairs.keys().isdisjoint(pairs):
        found = f"no constant of {', '.join(pairs)}, but of {', '.join(constants.pairs)}"
        raise CampaignError(found, path, "a constant of one of the pairs that are imaged", _REMEDY)


LEAST_CONTRAST = 10.0
"""Power of a peak against noise and clutter around it, below which it is as likely one of theirs: no cross-section."""

_UNSTATED_STD_DB, _FIGURE_STD_DB = 1.0, 0.5  # of a radio without amplitude_std_db; of a noise figure
_SIDELINK_STD_DB = 0.3  # of the noise that a sidelink adds, by its mean SNR
_MOST_POINTS = 50  # whose cross-section is stated, the brightest

POINTS_LISTED = {
    "most": _MOST_POINTS,
    "below_brightest_db": DEEPEST_DB,
    "above_surroundings_db": round(-decibels(SPECKLE), 1),
}
"""Limits of the list of points in radiometry.json: a weaker target has no cross-section there."""


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """A pair whose radio is stated, or whose constant was measured.

    Attributes
    ----------
    calibrated_by
        Where its constant comes from, in words.
    link
        Its radio; None where it is not stated.
    std_db
        Standard deviation of its constant; None where it is unknown.
    flags
        Of its constant.
    calibration
        Of its image.
    beams
        Weights of its pulses.
    radio_std_db
        Standard deviation of the radio as stated; None where it is unknown.
    thermal_noise
        Power that thermal noise would have in a profile by a receiver of 0 dB; None where no radio is stated.
    noise_before
        Noise of a pulse in the flights that measured the constant; None where it is stated, or not measured.
    sidelink_noise
        Power that the noise of the sidelink has in a profile; 0 without one.
    noise_figure_db
        Stated; None: unknown.
    pointing_std_db
        What errors of attitude do to a point in the middle of the scene, by the beams.
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
    noise_figure_db: float | None
    pointing_std_db: float

    def points(self, found: list[BrightPoint], scene: OpenScene, pulse_noise: float) -> list[dict[str, Any]]:
        """Return the radar cross-sections of bright points, for radiometry.json.

        Parameters
        ----------
        found
            Of the image, brightest first.
        scene
            Of the image.
        pulse_noise
            Noise of a pulse, measured.
        """
        found = found[:_MOST_POINTS]
        rows, columns = (np.array([getattr(one, name) for one in found]) for name in ("row", "column"))
        if not found:
            return []
        places = scene.grid.map_at(rows, columns)
        values = self.cross_sections(
            scene.terrain.positions_at(scene.grid, rows, columns),
            np.array([one.amplitude for one in found]),
            np.array([one.background for one in found]),
            pulse_noise,
        )
        return [
            {"x_m": round(float(x), 4), "y_m": round(float(y), 4), **value}
            for (x, y), value in zip(places, values, strict=True)
        ]

    def cross_sections(
        self,
        places_m: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        background: NDArray[np.float64],
        pulse_noise: float,
    ) -> list[dict[str, Any]]:
        """Return radar cross-sections with their standard deviation from peaks of an image.

        Parameters
        ----------
        places_m
            (point, 3) float64, in the frame of the aperture.
        amplitude, background
            (point,) float64: of the peak; power around it relative to its own.
        pulse_noise
            Noise of a pulse, measured.

        Returns
        -------
        list of dict
            rcs_m2, rcs_dbsm, std_db and scatter_db of each; None where a peak is no point of its own.

        Notes
        -----
        Source: docs/theory/radiometry.md, eq. 4.
        """
        per_m2, share = self.calibration.at(places_m)
        power, noise = amplitude**2, share * (pulse_noise if np.isfinite(pulse_noise) else 0.0)
        sigma = np.maximum(power - noise, 0.0) / np.where(per_m2 > 0, per_m2, np.nan)
        inverse = np.maximum(noise / power, background)
        scatter_db = 10 / np.log(10) * np.sqrt(2 * inverse + inverse**2)
        std_db = np.hypot(scatter_db, self.std_db or 0.0)
        with np.errstate(divide="ignore"):
            sigma_db = 10 * np.log10(sigma)
        return [
            {
                "rcs_m2": float(f"{one:.4g}"),
                "rcs_dbsm": round(float(one_db), 2),
                "std_db": round(float(std), 2),
                "scatter_db": round(float(scatter), 2),
            }
            if np.isfinite(one_db) and LEAST_CONTRAST * doubt <= 1
            else {"rcs_m2": None, "rcs_dbsm": None, "std_db": None, "scatter_db": None}
            for one, one_db, std, scatter, doubt in zip(sigma, sigma_db, std_db, scatter_db, inverse, strict=True)
        ]

    def noise_report(self, pulse_noise: PulseNoise, *, bound: bool) -> tuple[dict[str, Any], Flags]:
        """Return the noise measured against what the receiver alone would have, and the flag where they disagree.

        Parameters
        ----------
        pulse_noise
            Measured; NaN where it was not.
        bound
            Whether it is an upper bound, since echoes alias into it.

        Notes
        -----
        Source: docs/theory/radiometry.md, eqs. 8, 8a and 8b.
        """
        own = pulse_noise.power - self.sidelink_noise
        report = {"noise_figure_db": self.noise_figure_db, "noise_figure_measured_db": None, "std_db": None}
        report |= {"sidelink": self.sidelink_noise or None}
        differences = list[tuple[str, float, float]]()
        if self.thermal_noise and own > 0:  # NaN is not
            figure_db = decibels(own / self.thermal_noise)
            of_own_db = np.hypot(pulse_noise.std_db * pulse_noise.power, _SIDELINK_STD_DB * self.sidelink_noise) / own
            report |= {"noise_figure_measured_db": round(figure_db, 2), "std_db": round(float(of_own_db), 2)}
            radio_db = _UNSTATED_STD_DB if self.radio_std_db is None else self.radio_std_db
            std_db = float(np.hypot(of_own_db, np.hypot(radio_db, _FIGURE_STD_DB)))
            if self.noise_figure_db is not None:
                differences.append(("the noise figure stated", figure_db - self.noise_figure_db, std_db))
            elif figure_db < 0:  # no receiver has a noise figure below 0 dB
                differences.append(("a receiver of 0 dB", figure_db, std_db))
        if self.noise_before and pulse_noise.power > 0 and not self.sidelink_noise:
            std_db = float(np.hypot(2**0.5 * pulse_noise.std_db, _FIGURE_STD_DB))
            since_db = decibels(pulse_noise.power / self.noise_before)
            differences.append(("that over the reflectors, of another gain?", since_db, std_db))
        lines = [
            f"the noise measured is {by_db:+.1f} dB of {than}, ± {std_db:.1f} dB"
            for than, by_db, std_db in differences
            if abs(by_db) > DRIFT_SIGMAS * std_db and not (by_db > 0 and bound)
        ]
        return report, Flags({"noise_disagrees": "; ".join(lines)} if lines else {})


def stated_link(campaign: Campaign, pair: str) -> tuple[Link, float | None, float | None] | None:
    """Return the radio of a pair, the error of what is stated, None unknown, and the noise figure, dB; None: no radio.

    Where constants were measured a radio may be stated in parts, which is none.
    """
    power, transmit, receive, receiver = radio_of(campaign.settings.nodes, pair).values()
    if not isinstance(receiver, Receiver) or None in (power, transmit, receive):
        return None
    nodes: list[Node] = [campaign.settings.nodes[name] for name in dict.fromkeys(pair.split("-"))]
    known = [node.amplitude_std_db for node in nodes]
    std_db = None if None in known else float(np.sqrt(sum((one or 0.0) ** 2 for one in known)))
    sent, outward, back = (float(str(value)) for value in (power, transmit, receive))
    link = Link(sent, outward, back, receiver.gain_db, receiver.at_full_scale_dbm, receiver.full_scale_counts)
    return link, std_db, receiver.noise_figure_db


def calibrated_pair(
    campaign: Campaign,
    opened: OpenPair,
    scene: OpenScene,
    *,
    weights: tuple[Beams | None, int] | None = None,
    threads: int = 1,
) -> CalibratedPair | None:
    """Return the calibration of an open pair's image; None where neither radio nor constant is known.

    Parameters
    ----------
    campaign, opened, scene
        Settings, the pair by its echo, and the campaign's grid and ground.
    weights
        As of `image_weights`, which by default says them.
    threads
        Blocks of the lattice in work at once.
    """
    waveform, frequency = campaign.settings.waveform, opened.frequency_hz
    measured, stated = constant_of(campaign, opened), stated_link(campaign, opened.name)
    sent = transmitted(campaign, waveform) if stated and isinstance(waveform, SampledWaveform) else None
    link, radio_db, figure_db = stated if stated and sent else (None, None, None)
    std_db, constant, by, flags = radio_db, 0.0, "the radio that the config states", Flags()
    if link and sent:
        wavelength_m = SPEED_OF_LIGHT_M_S / centre_frequency(frequency)
        constant = link.constant(wavelength_m=wavelength_m, sent_power=sent.mean_power)
    if measured:
        found, by = measured
        flags = Flags.merged(found.flags, _disagreement(found, constant, std_db) if link else {})
        constant, std_db = found.constant, found.std_db
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
    thermal, added = None, 0.0
    noise = measured[0].profile_noise if measured else None
    before = None if noise is None else noise * float((opened.weight**2).sum())
    if link and sent:
        filtered = (opened.weight * np.abs(sent.inverse)) ** 2
        thermal = link.pulse_noise(0.0, spacing_hz=sent.numerology.spacing_hz, squares=float(filtered.sum()))
    sidelink = opened.report.get("sidelink")
    if sidelink and opened.history:
        added = sidelink_noise(
            opened.history,
            scene.grid,
            scene.terrain,
            noise_places(scene.grid, scene.terrain),
            beams=beams,
            method=sidelink["method"],
            snr_db=sidelink["snr_db"],
        )
    pointing_db = pointing_std_db(beams, opened.aperture, scene.middle_m, _turns(campaign, opened, scene))
    return CalibratedPair(
        by, link, std_db, flags, calibration, beams, radio_db, thermal, before, added, figure_db, pointing_db
    )


def image_weights(campaign: Campaign, opened: OpenPair, scene: OpenScene) -> tuple[Beams | None, int]:
    """Return the weights of a pair's pulses in its image, and the number that the image was divided by."""
    integration = integration_of(campaign, opened, scene)
    count = integration.count if integration.sector else None
    return Beams.within(integration.sector, opened.beams), count or len(opened.aperture)


def _turns(campaign: Campaign, opened: OpenPair, scene: OpenScene) -> list[Turn]:
    """Return the errors of attitude of a pair's nodes about east, north and up, as stated or of their source."""
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


def _disagreement(found: PairConstant, stated: float, std_db: float | None) -> dict[str, str]:
    """Return the flag of a constant that was measured and is not what the config's radio says."""
    difference_db = decibels(stated) - found.constant_db
    both_db = float(np.hypot(found.std_db, std_db or 0.0))
    if std_db is None or abs(difference_db) <= DRIFT_SIGMAS * both_db:
        return {}
    return {
        "constant_disagrees": f"the radio that the config states makes it {difference_db:+.2f} dB of what "
        f"reflectors said, {abs(difference_db) / both_db:.1f} standard deviations of both"
    }


def points_of(
    image: BlockRaster, quality: dict[str, Any], scene: OpenScene, windows: list[Window]
) -> list[BrightPoint]:
    """Return the bright points of a finished image, brightest first; `quality` is that of its stage."""
    focus = quality["focus"]
    spectrum = np.array(focus["spectrum_cycles2_m2"])
    return bright_points_within(image, scene.grid, windows, spectrum, cell_m=focus["cell_m"])
