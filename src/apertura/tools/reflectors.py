"""Constants measured at reflectors, written for later campaigns and printed."""

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
from apertura.common.errors import CampaignError
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
"""Search radius about the expected place of a reflector, resolution cells, beside three standard deviations of it."""

_ODD = {"HH", "VV", "LR", "RL"}
RETURNED = {"trihedral": _ODD, "sphere": _ODD, "dihedral": {"HH", "VV", "LL", "RR"}}
"""Polarisations, sent and received, in which the formulas hold: a reflection turns the other way round."""

_LEAST_CHANCE = 0.0027  # of reflectors that differ as much: three standard deviations
_FOLLOWED_M = 1e-4  # pixels: where the place that focuses a reflector above ground is settled
_ROUNDS = 12
_DB = 10 / np.log(10)  # dB per relative error of a power


@dataclass(frozen=True)
class Measurement:
    """Measurement of a reflector in one image.

    Attributes
    ----------
    flight, pair, reflector
        Where.
    constant_db, scatter_db, common_db
        10 lg K, what of its standard deviation differs from image to image, and what that of the reflector is.
    phase_rad, phase_scatter_rad
        Of the peak against that of the reflector's place.
    gradient
        Of the path with the place, mean over the image, metres per metre.
    profile_noise
        Of a pulse, per Σw² of the window.
    report
        For the file.
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
    """Return the constants of a finished campaign's pairs, and why reflectors were left out, a line each.

    Raises
    ------
    CampaignError
        If the config names no reflector, images are not finished, or no reflector stands out in any image.
    """
    stated = campaign.settings.scene.reflectors
    if not stated:
        raise CampaignError(
            "no reflectors",
            where="config/config.yaml: scene.reflectors",
            expected="reflectors of known shape and place",
            remedy="State name, position_m, std_m, kind, size_m and where each looks.",
        )
    scene, left_out = open_scene(campaign), list[str]()
    found, radars, began, images = list[Measurement](), dict[str, Radar](), dict[str, str](), dict[str, str]()
    for flight in campaign.image_flights:
        track = open_refined(campaign, flight.name)
        for pair in flight.pairs:
            opened = track.pair(open_pair(campaign, flight.name, pair))
            radars.setdefault(pair, Radar.of(campaign, opened))
            view, measured = _View.of(campaign, opened, scene), list[Measurement]()
            for one in stated:
                label = radars[pair].polarisation
                if label and label not in RETURNED[one.kind]:
                    result: Measurement | str = f"{label}: such a reflector sends nothing back in it"
                else:
                    result = view.at(one)
                if isinstance(result, str):
                    left_out.append(f"{flight.name} {pair} {one.name}: {result}")
                else:
                    measured.append(result)
            if measured:
                manifest = campaign.manifest("image", flight.name, pair)
                images[manifest] = digest_of(campaign.root, manifest)
                began[flight.name] = str(np.datetime_as_string(opened.began, unit="s")) + "Z"
            found += measured
    if not found:
        raise CampaignError(
            f"no reflector is of use in any image ({'; '.join(left_out[:3])})",
            where=campaign.root,
            expected=f"a peak {decibels(LEAST_CONTRAST):.0f} dB above what lies around it, within "
            f"{REACH_CELLS:g} resolution cells of its place",
            remedy="Check scene.reflectors, or fly closer to them.",
        )
    reference = found[0].pair
    pairs = {
        pair: _of_pair(pair, radars[pair], found, reference, campaign)
        for pair in dict.fromkeys(one.pair for one in found)
    }
    path = campaign.calibration_file
    before = None if path is None else read_constants(path)
    constants = Constants(
        software=__version__,
        campaign=campaign.settings.campaign,
        flights=began,
        reference=reference,
        pairs=dict(_with_drift(pairs, before)) if before else dict(pairs),
        measurements=tuple(one.report for one in found),
        images=images,
    )
    return constants, left_out


# ---- One reflector in one image -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _View:
    """An image with what is needed to say what a reflector should be in it."""

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
        place, axes = self._placed(stated)
        pulses, parts, noise = point_parts(self.opened.aperture, self.beams, place[None], count=self.count)
        part = parts[:, 0]
        if not part.any():
            return "in no pulse's beam"
        reflector = Reflector(stated.kind, stated.size_m, axes)
        to_tx, to_rx = (_unit(leg - place) for leg in pulses.legs)
        rcs_m2, formula_db = reflector.seen(to_tx, to_rx, part, self.opened.frequency_hz)
        bistatic_deg = float(np.degrees(np.arccos(np.clip((to_tx * to_rx).sum(axis=-1), -1, 1))).max())
        if not np.isfinite(rcs_m2):
            return (
                f"its antennas are up to {bistatic_deg:.0f}° apart as it sees them: too much for a {stated.kind} "
                "its size"
            )
        if not rcs_m2 > 0:
            return "turned away"
        path_m = pulses.path(place)
        if stated.kind == "sphere":  # the wave turns back at its surface, as from a convex mirror
            skin_m = stated.size_m[0] * np.sqrt((1 + (to_tx * to_rx).sum(axis=-1)) / 2)
            path_m, part = path_m - 2 * skin_m, part * (1 + 2 * skin_m / path_m)
        row, column = self._focused(pulses, path_m, part, grid.pixel_of(*stated.position_m[:2]))
        cell_m = quality["focus"]["cell_m"]
        reach = (REACH_CELLS * cell_m + 3 * stated.std_m) / grid.spacing_m
        if not all(reach < at < size - 1 - reach for at, size in zip((row, column), grid.shape, strict=True)):
            return "outside the image"
        peak = bright_point(self.image.image, *brightest_near(self.image.image, row, column, reach))
        off_m = float(np.hypot(peak.row - row, peak.column - column)) * grid.spacing_m
        inverse = max(float(noise[0]) * self.pulse_noise / peak.amplitude**2, peak.background)
        if inverse * LEAST_CONTRAST > 1 or off_m > (reach + 1) * grid.spacing_m:
            return f"no peak of its own ({-decibels(inverse):.1f} dB above what lies around it)"
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
            (part[:, None] * pulses.path_gradient(place)).sum(axis=0) / part.sum(),
            self.pulse_noise / float((self.opened.weight**2).sum()),
            report,
        )

    def _placed(self, stated: KnownReflector) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the place of a reflector in the frame of the pulses, and its axes right, up and ahead, as rows."""
        (x, y, z), crs = stated.position_m, self.scene.grid.crs
        place = frame_from_map(crs, x, y, z)
        east, north, up = (
            _unit(frame_from_map(crs, x + dx, y + dy, z + dz) - place)
            for dx, dy, dz in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        )
        azimuth, elevation, roll = (
            np.radians(angle or 0.0) for angle in (stated.azimuth_deg, stated.elevation_deg, stated.roll_deg)
        )
        level = np.sin(azimuth) * east + np.cos(azimuth) * north
        ahead = np.cos(elevation) * level + np.sin(elevation) * up
        right = np.cos(azimuth) * east - np.sin(azimuth) * north
        above = np.cross(right, ahead)
        turned = np.cos(roll) * right - np.sin(roll) * above, np.sin(roll) * right + np.cos(roll) * above
        return place, np.array([*turned, ahead])

    def _ground(self, row: float, column: float) -> NDArray[np.float64]:
        """Return the place of a pixel, (3,) float64; NaN off a DEM."""
        height_m = float(self.scene.terrain.heights_at(self.scene.grid, row, column))
        return self.scene.grid.positions_at(row, column, height_m) if np.isfinite(height_m) else np.full(3, np.nan)

    def _focused(
        self, pulses: Aperture, path_m: NDArray[np.float64], part: NDArray[np.float64], start: tuple[Any, Any]
    ) -> tuple[float, float]:
        """Return the pixel on the ground whose path is closest to a target's over the pulses, by Gauss and Newton.

        NaN where that leads off a DEM.
        """
        at, root = np.array([float(one) for one in start]), np.sqrt(part / part.sum())
        for _ in range(_ROUNDS):
            here, down, right = (pulses.path(self._ground(*(at + step))) for step in ((0, 0), (1, 0), (0, 1)))
            slope = np.stack([down - here, right - here], axis=-1)
            if not np.isfinite(slope).all():
                return np.nan, np.nan
            step = np.linalg.lstsq(root[:, None] * slope, root * (path_m - here), rcond=None)[0]
            at = at + step
            if np.abs(step).max() < _FOLLOWED_M:
                break
        return float(at[0]), float(at[1])

    def _response(
        self, pulses: Aperture, path_m: NDArray[np.float64], part: NDArray[np.float64], row: float, column: float
    ) -> complex:
        """Return the pixel power of a target of 1 m² with these paths where K is 1: eq. 15."""
        k = 2 * np.pi * centre_frequency(self.opened.frequency_hz) / self.opened.wave_speed_m_s
        turned = np.exp(-1j * k * (path_m - pulses.path(self._ground(row, column))))
        return complex((part * turned).sum())

    def _phase(self, expected: complex, peak: BrightPoint) -> float:
        """Return the phase of a peak against what its pixel would show."""
        grid, carriers = self.scene.grid, np.array(self.image.attrs["quality"]["view"]["carriers_cycles_m"])
        east, north = carrier_at(carriers, grid.shape, peak.row, peak.column)
        carrier = (-north * grid.spacing_m, east * grid.spacing_m)
        patch = BandLimitedPatch(self.image.image, round(peak.row), round(peak.column), carrier)
        return float(np.angle(complex(patch.at(peak.row, peak.column)) * np.conj(expected)))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# ---- All reflectors and flights of a pair ---------------------------------------------------------------------------


def _of_pair(pair: str, radar: Radar, found: list[Measurement], reference: str, campaign: Campaign) -> PairConstant:
    """Return the constant of a pair, and its phase against the reference."""
    own = [one for one in found if one.pair == pair]
    mean = together(
        np.array([one.constant_db for one in own]),
        np.array([one.scatter_db for one in own]),
        np.array([one.common_db for one in own]),
        [one.reflector for one in own],
        [one.flight for one in own],
    )
    against = {(one.flight, one.reflector): one for one in found if one.pair == reference}
    both = [(one, against[at]) for one in own if (at := (one.flight, one.reflector)) in against]
    phase = _phase_of(both, radar.centre_hz, campaign) if both else None
    flags = Flags.merged(_flags(mean, "dB"), {} if phase is None else _flags(phase, "rad"))
    noise = float(np.mean([one.profile_noise for one in own]))
    return PairConstant(
        radar=radar,
        constant_db=round(mean.value, 3),
        std_db=round(mean.std, 3),
        chance=round(mean.chance, 4),
        reflectors=len({one.reflector for one in own}),
        flights=len({one.flight for one in own}),
        phase_rad=None if phase is None else round(float(np.angle(np.exp(1j * phase.value))), 4),
        phase_std_rad=None if phase is None else round(phase.std, 4),
        profile_noise=float(f"{noise:.4g}") or None,
        flags=flags,
    )


def _phase_of(both: list[tuple[Measurement, Measurement]], centre_hz: float, campaign: Campaign) -> Mean | None:
    """Return the mean phase between two pairs; None for the pair itself."""
    if all(one is other for one, other in both):
        return None
    std_m = {one.name: one.std_m for one in campaign.settings.scene.reflectors}
    turns = np.array([one.phase_rad - other.phase_rad for one, other in both])
    middle = np.angle(np.exp(1j * turns).mean())
    return together(
        middle + np.angle(np.exp(1j * (turns - middle))),
        np.array([np.hypot(one.phase_scatter_rad, other.phase_scatter_rad) for one, other in both]),
        np.array(
            [
                2
                * np.pi
                * centre_hz
                / SPEED_OF_LIGHT_M_S
                * np.linalg.norm(one.gradient - other.gradient)
                * std_m[one.reflector]
                for one, other in both
            ]
        ),
        [one.reflector for one, _ in both],
        [one.flight for one, _ in both],
    )


def _flags(mean: Mean, unit: str) -> dict[str, str]:
    """Return the flags of what reflectors and flights say together."""
    flags = {}
    if mean.chance < _LEAST_CHANCE:
        flags["reflectors_disagree"] = (
            f"{mean.freedom + 1} reflectors differ in {unit} by a sum of squares of {mean.chi2:.1f}, which chance does "
            f"{mean.chance:.1g} of the times"
        )
    if mean.drift is not None and mean.drifts:
        first, second, difference, std = mean.drift
        flags["constant_drifts"] = f"{difference:+.2f} ± {std:.2f} {unit} from {first} to {second}"
    return flags


def _with_drift(pairs: Mapping[str, PairConstant], before: Constants) -> Iterator[tuple[str, PairConstant]]:
    """Yield the constants of pairs, with a flag where they drifted since those that the campaign uses."""
    for pair, now in pairs.items():
        was = before.pairs.get(pair)
        if was is None or was.radar.differs(now.radar):
            yield pair, now
            continue
        drift_db, std_db = now.constant_db - was.constant_db, float(np.hypot(now.std_db, was.std_db))
        drifted = abs(drift_db) > DRIFT_SIGMAS * std_db
        line = {"constant_drifts": f"{drift_db:+.2f} ± {std_db:.2f} dB since {before.measured}"} if drifted else {}
        yield pair, now.model_copy(update={"flags": Flags.merged(now.flags, line)})


def write_constants(campaign: Campaign, to: Path | None = None) -> Path:
    """Measure the constants of a finished campaign at its reflectors, print them, and write them; return the file.

    Raises
    ------
    CampaignError
        If nothing can be measured, images are overtaken, or the file is the one that the campaign itself takes up.
    """
    path = campaign.root / FILE if to is None else to
    used = campaign.calibration_file
    if used is not None and path.resolve() == used.real():
        raise CampaignError(
            "is what processing.radiometric_calibration takes up",
            where=path,
            expected="another file: what is measured is compared with it",
            remedy="Name one with --to.",
        )
    images = {campaign.manifest("image", one.name, pair) for one in campaign.image_flights for pair in one.pairs}
    overtaken = [manifest for manifest in stale_results(campaign) if manifest in images]
    if overtaken:
        raise CampaignError(
            f"{len(overtaken)} of {len(images)} images are overtaken, {overtaken[0]} among them",
            where=campaign.root,
            expected="images made from the files and settings of now",
            remedy="Run the workflow first.",
        )
    constants, left_out = measured_constants(campaign)
    write_json(path, constants.model_dump(mode="json"))
    console = Console(width=120)
    table = Table(title=f"{constants.campaign}: constants at reflectors", title_justify="left")
    for heading in ("pair", "constant, dB", "reflectors", "flights", f"phase against {constants.reference}, rad"):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for pair, one in constants.pairs.items():
        phase = "" if one.phase_rad is None else f"{one.phase_rad:+.3f} ± {one.phase_std_rad:.3f}"
        counts = str(one.reflectors), str(one.flights)
        table.add_row(pair, f"{one.constant_db:.2f} ± {one.std_db:.2f}", *counts, phase)
    console.print(table)
    for pair, one in constants.pairs.items():
        for name, line in one.flags.items():
            print(f"{pair}: {name}: {line}")
    for line in left_out:
        print(f"left out: {line}")
    return path
