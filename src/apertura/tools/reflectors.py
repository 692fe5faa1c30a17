"""Measurement of radiometric calibration constants at reflectors, written to a file for later campaigns."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from apertura import __version__
from apertura.campaign.config import KnownReflector
from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.atomic import write_json
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.imaging.radiometry import point_parts
from apertura.core.imaging.reflectors import DRIFT_SIGMAS, Mean, Reflector, together
from apertura.core.quality.bright_points import BrightPoint, bright_point, brightest_near
from apertura.core.quality.point_targets import BandLimitedPatch, carrier_at
from apertura.stages.agreement import opened_layer
from apertura.stages.pair import OpenPair, open_pair
from apertura.stages.planning import gated
from apertura.stages.radiometry import (
    FILE,
    LEAST_CONTRAST,
    Constants,
    PairConstant,
    Radar,
    image_weights,
    read_constants,
)
from apertura.stages.refine import open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.workflow.stale import stale_results

REACH_CELLS = 2.0
"""Search radius about a reflector's position, resolution cells; three standard deviations of the position are added."""

_ODD = {"HH", "VV", "LR", "RL"}
RETURNED = {"trihedral": _ODD, "sphere": _ODD, "dihedral": {"HH", "VV", "LL", "RR"}}
"""Polarisations (transmitted, received) in which each kind returns an echo.

Each reflection reverses the sense of circular polarisation.
"""

_LEAST_CHANCE = 0.0027  # significance level of the test for disagreeing reflectors: three standard deviations
_CONVERGED_PX = 1e-4  # step in pixels at which the search for the focused position of a reflector stops
_ROUNDS = 12
_DB = 10 / np.log(10)  # dB per relative error of a power


@dataclass(frozen=True)
class Measurement:
    """Measurement of a reflector in one image.

    Attributes
    ----------
    flight, pair, reflector
        Names of flight, pair and reflector.
    constant_db, scatter_db, common_db
        10 log10 K, and two standard deviations: of errors independent in each image, and of errors common to all images
        of the reflector.
    phase_rad, phase_scatter_rad
        Phase of the peak relative to that expected from the reflector's position, and its standard deviation.
    gradient
        Gradient of the path with respect to position, mean over the pulses, metres per metre.
    profile_noise
        Noise power of a pulse, divided by Σw² of the window.
    report
        Values for the file.
    """

    flight: str
    pair: str
    reflector: str
    constant_db: float
    scatter_db: float
    common_db: float
    phase_rad: float
    phase_scatter_rad: float
    gradient: NDArray[np.float64]
    profile_noise: float
    report: Mapping[str, Any]


def measured_constants(campaign: Campaign) -> tuple[Constants, list[str]]:
    """Measure the constants of a finished campaign's pairs; also return a line for each excluded reflector.

    Raises
    ------
    CampaignError
        If no reflector is configured, images are not finished, or no reflector can be measured in any image.
    """
    stated = campaign.settings.scene.reflectors
    if not stated:
        raise CampaignError(
            "no reflectors",
            where="config/config.yaml: scene.reflectors",
            expected="reflectors of known shape and position",
            remedy="Configure name, position_m, std_m, kind, size_m and orientation of each reflector.",
        )
    scene, excluded = open_scene(campaign), list[str]()
    measurements, radars = list[Measurement](), dict[str, Radar]()
    starts, images = dict[str, str](), dict[str, str]()
    for flight in campaign.image_flights:
        track = open_refined(campaign, flight.name)
        for pair in flight.pairs:
            opened = track.pair(gated(campaign, open_pair(campaign, flight.name, pair), scene))
            radars.setdefault(pair, Radar.of(campaign, opened))
            view, measured = _View.of(campaign, opened, scene), list[Measurement]()
            for reflector in stated:
                polarisation = radars[pair].polarisation
                if polarisation and polarisation not in RETURNED[reflector.kind]:
                    result: Measurement | str = f"a {reflector.kind} returns no echo in polarisation {polarisation}"
                else:
                    result = view.at(reflector)
                if isinstance(result, str):
                    excluded.append(f"{flight.name} {pair} {reflector.name}: {result}")
                else:
                    measured.append(result)
            if measured:
                manifest = campaign.manifest("image", flight.name, pair)
                images[manifest] = digest_of(campaign.root, manifest)
                starts[flight.name] = str(np.datetime_as_string(opened.began, unit="s")) + "Z"
            measurements += measured
    if not measurements:
        raise CampaignError(
            f"no reflector can be measured in any image ({'; '.join(excluded[:3])})",
            where=campaign.root,
            expected=f"a peak {decibels(LEAST_CONTRAST):.0f} dB above its surroundings, within "
            f"{REACH_CELLS:g} resolution cells of a reflector's position",
            remedy="Check scene.reflectors, or fly closer to the reflectors.",
        )
    reference = measurements[0].pair
    pairs = {
        pair: _of_pair(pair, radars[pair], measurements, reference, campaign)
        for pair in dict.fromkeys(measurement.pair for measurement in measurements)
    }
    path = campaign.calibration_file
    previous = None if path is None else read_constants(path)
    constants = Constants(
        software=__version__,
        campaign=campaign.settings.campaign,
        flights=starts,
        reference=reference,
        pairs=dict(_with_drift(pairs, previous)) if previous else dict(pairs),
        measurements=tuple(measurement.report for measurement in measurements),
        images=images,
    )
    return constants, excluded


# ---- One reflector in one image -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _View:
    """An image with the data for predicting the response of a reflector in it."""

    opened: OpenPair
    scene: OpenScene
    image: xr.Dataset
    beams: Beams | None
    count: int
    pulse_noise: float

    @classmethod
    def of(cls, campaign: Campaign, opened: OpenPair, scene: OpenScene) -> "_View":
        with opened_layer(campaign, opened.flight, opened.name, "nesz.tif") as raster:
            noise = float(raster.tags()["APERTURA_PULSE_NOISE"])
        image = open_stage(campaign.stage("image", opened.flight, opened.name), "image")
        return cls(opened, scene, image, *image_weights(campaign, opened, scene), noise if np.isfinite(noise) else 0.0)

    def at(self, stated: KnownReflector) -> Measurement | str:
        """Measure a reflector, or return the reason why it cannot be measured."""
        grid, quality = self.scene.grid, self.image.attrs["quality"]
        position, axes = self._position_and_axes(stated)
        pulses, parts, noise = point_parts(self.opened.aperture, self.beams, position[None], count=self.count)
        part = parts[:, 0]
        if not part.any():
            return "outside the beams of all pulses"
        reflector = Reflector(stated.kind, stated.size_m, axes)
        to_tx, to_rx = (_unit(leg - position) for leg in pulses.legs)
        rcs_m2, formula_db = reflector.seen(to_tx, to_rx, part, self.opened.frequency_hz)
        bistatic_deg = float(np.degrees(np.arccos(np.clip((to_tx * to_rx).sum(axis=-1), -1, 1))).max())
        if not np.isfinite(rcs_m2):
            return f"bistatic angle up to {bistatic_deg:.0f}°, too large for a {stated.kind} of this size"
        if not rcs_m2 > 0:
            return "not oriented towards the antennas"
        path_m = pulses.path(position)
        if stated.kind == "sphere":  # specular reflection at the surface: shorter path, divergence of a convex mirror
            surface_m = stated.size_m[0] * np.sqrt((1 + (to_tx * to_rx).sum(axis=-1)) / 2)
            path_m, part = path_m - 2 * surface_m, part * (1 + 2 * surface_m / path_m)
        row, column = self._focused(pulses, path_m, part, grid.pixel_of(*stated.position_m[:2]))
        cell_m = quality["focus"]["cell_m"]
        reach = (REACH_CELLS * cell_m + 3 * stated.std_m) / grid.spacing_m
        if not all(reach < index < size - 1 - reach for index, size in zip((row, column), grid.shape, strict=True)):
            return "outside the image"
        peak = bright_point(self.image.image, *brightest_near(self.image.image, row, column, reach))
        off_m = float(np.hypot(peak.row - row, peak.column - column)) * grid.spacing_m
        inverse = max(float(noise[0]) * self.pulse_noise / peak.amplitude**2, peak.background)
        if inverse * LEAST_CONTRAST > 1 or off_m > (reach + 1) * grid.spacing_m:
            return f"no separate peak ({-decibels(inverse):.1f} dB above its surroundings)"
        power = peak.amplitude**2 - float(noise[0]) * self.pulse_noise
        amplitude = abs(self._response(pulses, path_m, part, row, column))
        constant_db = decibels(power / (rcs_m2 * amplitude**2))
        numerical = 10 ** (quality["numerical_error_db"] / 20)
        lost_db = abs(float(quality["focus"].get("loss_db", 0.0)))
        scatter_db = float(np.hypot(_DB * np.hypot(np.sqrt(2 * inverse + inverse**2), 2 * numerical), lost_db))
        common_db = float(np.hypot(formula_db, stated.rcs_std_db))
        phase = self._phase(self._response(pulses, path_m, part, peak.row, peak.column), peak)
        report = {
            "flight": self.opened.flight,
            "pair": self.opened.name,
            "reflector": stated.name,
            "constant_db": round(constant_db, 3),
            "scatter_db": round(scatter_db, 3),
            "rcs_dbsm": round(decibels(rcs_m2), 3),
            "rcs_std_db": round(common_db, 3),
            "antennas_apart_deg": round(bistatic_deg, 2),
            "contrast_db": round(-decibels(inverse), 1),
            "off_m": round(off_m, 4),
            "phase_rad": round(phase, 4),
        }
        return Measurement(
            self.opened.flight,
            self.opened.name,
            stated.name,
            constant_db,
            scatter_db,
            common_db,
            phase,
            float(np.hypot(np.sqrt(inverse / 2), numerical)),
            (part[:, None] * pulses.path_gradient(position)).sum(axis=0) / part.sum(),
            self.pulse_noise / float((self.opened.weight**2).sum()),
            report,
        )

    def _position_and_axes(self, stated: KnownReflector) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a reflector's position in the frame of the pulses, and its axes right, up and ahead, as rows."""
        (x, y, z), crs = stated.position_m, self.scene.grid.crs
        position = frame_from_map(crs, x, y, z)
        east, north, up = (
            _unit(frame_from_map(crs, x + dx, y + dy, z + dz) - position)
            for dx, dy, dz in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        )
        azimuth, elevation, roll = (
            np.radians(angle or 0.0) for angle in (stated.azimuth_deg, stated.elevation_deg, stated.roll_deg)
        )
        level = np.sin(azimuth) * east + np.cos(azimuth) * north
        ahead = np.cos(elevation) * level + np.sin(elevation) * up
        right = np.cos(azimuth) * east - np.sin(azimuth) * north
        above = np.cross(right, ahead)
        rolled = np.cos(roll) * right - np.sin(roll) * above, np.sin(roll) * right + np.cos(roll) * above
        return position, np.array([*rolled, ahead])

    def _pixel_position(self, row: float, column: float) -> NDArray[np.float64]:
        """Return the position of a pixel on the terrain, (3,) float64; NaN outside the DEM."""
        height_m = float(self.scene.terrain.heights_at(self.scene.grid, row, column))
        return self.scene.grid.positions_at(row, column, height_m) if np.isfinite(height_m) else np.full(3, np.nan)

    def _focused(
        self, pulses: Aperture, path_m: NDArray[np.float64], part: NDArray[np.float64], start: tuple[Any, Any]
    ) -> tuple[float, float]:
        """Return the pixel whose path over the pulses best fits the target's path, by Gauss-Newton iteration.

        The result is NaN if the iteration leaves the DEM.
        """
        pixel, root = np.array([float(index) for index in start]), np.sqrt(part / part.sum())
        for _ in range(_ROUNDS):
            current_m, down_m, right_m = (
                pulses.path(self._pixel_position(*(pixel + step))) for step in ((0, 0), (1, 0), (0, 1))
            )
            slope = np.stack([down_m - current_m, right_m - current_m], axis=-1)
            if not np.isfinite(slope).all():
                return np.nan, np.nan
            step = np.linalg.lstsq(root[:, None] * slope, root * (path_m - current_m), rcond=None)[0]
            pixel = pixel + step
            if np.abs(step).max() < _CONVERGED_PX:
                break
        return float(pixel[0]), float(pixel[1])

    def _response(
        self, pulses: Aperture, path_m: NDArray[np.float64], part: NDArray[np.float64], row: float, column: float
    ) -> complex:
        """Return the complex pixel amplitude of a target of 1 m² with the given paths, for K = 1.

        Source: docs/theory/radiometry.md, eq. 15.
        """
        k = 2 * np.pi * centre_frequency(self.opened.frequency_hz) / self.opened.wave_speed_m_s
        phasors = np.exp(-1j * k * (path_m - pulses.path(self._pixel_position(row, column))))
        return complex((part * phasors).sum())

    def _phase(self, expected: complex, peak: BrightPoint) -> float:
        """Return the phase of a peak relative to the expected pixel amplitude."""
        grid, carriers = self.scene.grid, np.array(self.image.attrs["quality"]["view"]["carriers_cycles_m"])
        east, north = carrier_at(carriers, grid.shape, peak.row, peak.column)
        carrier = (-north * grid.spacing_m, east * grid.spacing_m)
        patch = BandLimitedPatch(self.image.image, round(peak.row), round(peak.column), carrier)
        return float(np.angle(complex(patch.at(peak.row, peak.column)) * np.conj(expected)))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# ---- All reflectors and flights of a pair ---------------------------------------------------------------------------


def _of_pair(
    pair: str, radar: Radar, measurements: list[Measurement], reference: str, campaign: Campaign
) -> PairConstant:
    """Return the constant of a pair, and its phase relative to the reference pair."""
    of_pair = [measurement for measurement in measurements if measurement.pair == pair]
    mean = together(
        np.array([measurement.constant_db for measurement in of_pair]),
        np.array([measurement.scatter_db for measurement in of_pair]),
        np.array([measurement.common_db for measurement in of_pair]),
        [measurement.reflector for measurement in of_pair],
        [measurement.flight for measurement in of_pair],
    )
    references = {
        (measurement.flight, measurement.reflector): measurement
        for measurement in measurements
        if measurement.pair == reference
    }
    common = [
        (measurement, references[key])
        for measurement in of_pair
        if (key := (measurement.flight, measurement.reflector)) in references
    ]
    phase = _phase_of(common, radar.centre_hz, campaign) if common else None
    flags = Flags.merged(_flags(mean, "dB"), {} if phase is None else _flags(phase, "rad"))
    noise = float(np.mean([measurement.profile_noise for measurement in of_pair]))
    return PairConstant(
        radar=radar,
        constant_db=round(mean.value, 3),
        std_db=round(mean.std, 3),
        chance=round(mean.chance, 4),
        reflectors=len({measurement.reflector for measurement in of_pair}),
        flights=len({measurement.flight for measurement in of_pair}),
        phase_rad=None if phase is None else round(float(np.angle(np.exp(1j * phase.value))), 4),
        phase_std_rad=None if phase is None else round(phase.std, 4),
        profile_noise=float(f"{noise:.4g}") or None,
        flags=flags,
    )


def _phase_of(common: list[tuple[Measurement, Measurement]], centre_hz: float, campaign: Campaign) -> Mean | None:
    """Return the mean phase difference of two pairs at common reflectors; None for the reference pair itself."""
    if all(measured is reference for measured, reference in common):
        return None
    std_m = {reflector.name: reflector.std_m for reflector in campaign.settings.scene.reflectors}
    phases_rad = np.array([measured.phase_rad - reference.phase_rad for measured, reference in common])
    middle = np.angle(np.exp(1j * phases_rad).mean())
    return together(
        middle + np.angle(np.exp(1j * (phases_rad - middle))),
        np.array([np.hypot(measured.phase_scatter_rad, reference.phase_scatter_rad) for measured, reference in common]),
        np.array(
            [
                2
                * np.pi
                * centre_hz
                / SPEED_OF_LIGHT_M_S
                * np.linalg.norm(measured.gradient - reference.gradient)
                * std_m[measured.reflector]
                for measured, reference in common
            ]
        ),
        [measured.reflector for measured, _ in common],
        [measured.flight for measured, _ in common],
    )


def _flags(mean: Mean, unit: str) -> dict[str, str]:
    """Return the flags of a mean over reflectors and flights."""
    flags = {}
    if mean.chance < _LEAST_CHANCE:
        flags["reflectors_disagree"] = (
            f"{mean.freedom + 1} reflectors disagree in {unit}: χ² {mean.chi2:.1f} with "
            f"{number_of(mean.freedom, 'degree')} of freedom, p-value {mean.chance:.1g}"
        )
    if mean.drift is not None and mean.drifts:
        first, second, difference, std = mean.drift
        flags["constant_drifts"] = f"{difference:+.2f} ± {std:.2f} {unit} from {first} to {second}"
    return flags


def _with_drift(pairs: Mapping[str, PairConstant], previous: Constants) -> Iterator[tuple[str, PairConstant]]:
    """Yield the constants of pairs, flagged if they differ significantly from the constants used by the campaign."""
    for pair, constant in pairs.items():
        earlier = previous.pairs.get(pair)
        if earlier is None or earlier.radar.differs(constant.radar):
            yield pair, constant
            continue
        drift_db = constant.constant_db - earlier.constant_db
        std_db = float(np.hypot(constant.std_db, earlier.std_db))
        drifted = abs(drift_db) > DRIFT_SIGMAS * std_db
        line = {"constant_drifts": f"{drift_db:+.2f} ± {std_db:.2f} dB since {previous.measured}"} if drifted else {}
        yield pair, constant.model_copy(update={"flags": Flags.merged(constant.flags, line)})


def write_constants(campaign: Campaign, to: Path | None = None) -> Path:
    """Measure the constants of a finished campaign at its reflectors, print them, and write them; return the file.

    Raises
    ------
    CampaignError
        If no reflector can be measured, images are out of date, or the campaign itself uses the file.
    """
    path = campaign.root / FILE if to is None else to
    used = campaign.calibration_file
    if used is not None and path.resolve() == used.real():
        raise CampaignError(
            "the file used by processing.radiometric_calibration",
            where=path,
            expected="a different file, because the measured constants are compared with it",
            remedy="Specify a different file with --to.",
        )
    images = {
        campaign.manifest("image", flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs
    }
    outdated = [manifest for manifest in stale_results(campaign) if manifest in images]
    if outdated:
        raise CampaignError(
            f"{len(outdated)} of {len(images)} images out of date, for example {outdated[0]}",
            where=campaign.root,
            expected="images that are up to date with files and settings",
            remedy="Run the workflow first.",
        )
    constants, excluded = measured_constants(campaign)
    write_json(path, constants.model_dump(mode="json"))
    console = Console(width=120)
    table = Table(title=f"{constants.campaign}: calibration constants from reflectors", title_justify="left")
    for heading in ("pair", "constant, dB", "reflectors", "flights", f"phase relative to {constants.reference}, rad"):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for pair, constant in constants.pairs.items():
        phase = "" if constant.phase_rad is None else f"{constant.phase_rad:+.3f} ± {constant.phase_std_rad:.3f}"
        counts = str(constant.reflectors), str(constant.flights)
        table.add_row(pair, f"{constant.constant_db:.2f} ± {constant.std_db:.2f}", *counts, phase)
    console.print(table)
    for pair, constant in constants.pairs.items():
        for name, line in constant.flags.items():
            print(f"{pair}: {name}: {line}")
    for line in excluded:
        print(f"excluded: {line}")
    return path
