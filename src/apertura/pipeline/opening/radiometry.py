"""Radiometry of a pair as the config states it: from power, gains and receiver to the calibration of its image."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency
from apertura.core.imaging.radiometry import Calibration, Link, Turn, cell_constant, pointing_std_db
from apertura.core.quality.bright_points import BrightPoint
from apertura.core.quality.budget import ATTITUDE_STD_DEG
from apertura.core.quality.measures import BlockRaster
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import Node, Receiver, SampledWaveform, radio_of
from apertura.pipeline.opening.images import bright_places
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.plan import integration_of
from apertura.pipeline.opening.scene import OpenScene
from apertura.pipeline.opening.transmitted import transmitted

LEAST_CONTRAST = 10.0
"""Power of a peak against noise and clutter around it, below which it is as likely one of theirs: no cross-section."""

_MOST_POINTS = 50  # whose cross-section is stated, the brightest


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """A pair whose radio is stated.

    Attributes
    ----------
    link
        Its radio.
    stated_std_db
        Error of what is stated of it; None where nobody knows.
    calibration
        Of its image.
    beams
        Weights of its pulses.
    thermal_noise
        Power that thermal noise alone would have in a profile; None where no noise figure is stated.
    noise_figure_db
        Stated; None: unknown.
    pointing_std_db
        What errors of attitude do to a point in the middle of the scene, by the beams.
    """

    link: Link
    stated_std_db: float | None
    calibration: Calibration
    beams: Beams | None
    thermal_noise: float | None
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
        std_db = np.hypot(scatter_db, self.stated_std_db or 0.0)
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

    def noise_report(self, pulse_noise: float) -> dict[str, Any]:
        """Return the noise measured against what the receiver alone would have."""
        measured = None
        if self.thermal_noise and self.noise_figure_db is not None and pulse_noise > 0:  # NaN is not
            measured = round(self.noise_figure_db + 10 * float(np.log10(pulse_noise / self.thermal_noise)), 2)
        return {"noise_figure_db": self.noise_figure_db, "noise_figure_measured_db": measured}


def stated_link(campaign: Campaign, pair: str) -> tuple[Link, float | None, float | None]:
    """Return the radio of a calibrated pair, the error of what is stated, None unknown, and the noise figure, dB."""
    power, transmit, receive, receiver = radio_of(campaign.settings.nodes, pair).values()
    if not isinstance(receiver, Receiver):
        raise TypeError("a calibrated campaign states the receivers of its pairs")
    nodes: list[Node] = [campaign.settings.nodes[name] for name in dict.fromkeys(pair.split("-"))]
    known = [node.amplitude_std_db for node in nodes]
    std_db = None if None in known else float(np.sqrt(sum((one or 0.0) ** 2 for one in known)))
    sent, outward, back = (float(str(value)) for value in (power, transmit, receive))
    link = Link(sent, outward, back, receiver.gain_db, receiver.at_full_scale_dbm, receiver.full_scale_counts)
    return link, std_db, receiver.noise_figure_db


def calibrated_pair(
    campaign: Campaign, opened: OpenPair, scene: OpenScene, *, threads: int = 1
) -> CalibratedPair | None:
    """Return the calibration of an open pair's image; None where its radio is not stated.

    Parameters
    ----------
    campaign, opened, scene
        Settings, the pair by its echo, and the campaign's grid and ground.
    threads
        Blocks of the lattice in work at once.
    """
    waveform = campaign.settings.waveform
    if not campaign.calibrated or not isinstance(waveform, SampledWaveform):
        return None
    link, std_db, figure_db = stated_link(campaign, opened.name)
    sent, frequency = transmitted(campaign, waveform), opened.frequency_hz
    integration = integration_of(campaign, opened, scene)
    beams = Beams.within(integration.sector, opened.beams)
    constant = link.constant(wavelength_m=SPEED_OF_LIGHT_M_S / centre_frequency(frequency), sent_power=sent.mean_power)
    calibration = Calibration.of(
        scene.grid,
        scene.terrain,
        opened.aperture,
        beams,
        constant=constant,
        cell_m2=cell_constant(frequency, opened.weight),
        count=integration.count if integration.sector else None,
        threads=threads,
    )
    thermal = None
    if figure_db is not None:
        filtered = (opened.weight * np.abs(sent.inverse)) ** 2
        thermal = link.pulse_noise(figure_db, spacing_hz=sent.numerology.spacing_hz, squares=float(filtered.sum()))
    pointing_db = pointing_std_db(beams, opened.aperture, scene.middle_m, _turns(campaign, opened, scene))
    return CalibratedPair(link, std_db, calibration, beams, thermal, figure_db, pointing_db)


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


def points_of(
    image: BlockRaster, quality: dict[str, Any], scene: OpenScene, windows: list[Window]
) -> list[BrightPoint]:
    """Return the bright points of a finished image, brightest first; `quality` is that of its stage."""
    focus = quality["focus"]
    spectrum = np.array(focus["spectrum_cycles2_m2"])
    return bright_places(image, scene.grid, windows, spectrum, cell_m=focus["cell_m"])
