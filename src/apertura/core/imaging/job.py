"""Construction of the planner's job from a scene and the inputs of a pair, and checks before planning."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.job import Integration, Job, Signal
from apertura.core.echo.compression import centre_frequency, range_step
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.imaging.range_profiles import RangeWindow
from apertura.core.planning.decisions import integrate
from apertura.core.planning.plan import check_positions
from apertura.core.scene.clearance import check_antennas
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.map_crs import check_crs
from apertura.core.scene.terrain import FlatGround, GroundModels, Terrain

# ---- Checks of inputs against the scene

_POINTS = 9  # sample points along a side of the scene
_PULSES = 256  # pulses sampled for total paths
_RADIO_HZ = (1e5, 1e12)  # accepted radio frequencies, wider than any radar band
_USUAL_HZ = (1e7, 1e12)  # a wrong unit of frequencies is recognised if the converted values lie in this interval


def check_inputs(inputs: PhaseHistory | Profiles, grid: SceneGrid, terrain: Terrain) -> dict[str, str]:
    """Check inputs against a scene and return flags: name of the exceeded limit → measured value, in one line.

    Parameters
    ----------
    inputs
        Phase history or profiles, with phase centres in the frame of the pixels.
    grid, terrain
        The scene.

    Raises
    ------
    CampaignError
        If the CRS of the grid is not suitable for a scene; frequencies are not radio frequencies; a weight is negative;
        a position, delay, weight, sample or height is not finite; an antenna is below the terrain; all weights or all
        samples are zero; or the scene lies beyond the samples of all pulses.
    """
    if grid.crs != LOCAL:
        check_crs(grid.crs, grid.bounds_m)
    check_positions(inputs.aperture)
    _check_band(inputs)
    _check_samples(inputs)
    if isinstance(inputs, PhaseHistory):
        _check_spectrum(inputs)
    points = terrain.positions_at(grid, *grid.sample_pixels(_POINTS)).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise CampaignError(
            "heights of the terrain are not finite",
            where="backproject: terrain",
            expected="a height in metres at every pixel",
            remedy="Fill the voids of the terrain model, or reduce the extent of the grid.",
        )
    outside = _outside(inputs, points)
    if outside == 1:
        raise CampaignError(
            "the samples contain no echo of the scene: at every pulse, the total paths to the scene lie beyond the "
            "samples",
            where="backproject: grid",
            expected="phase centres and pixels in one frame, in metres, within the recorded range",
            remedy="Check the CRS and the corner of the grid, the height of the terrain, and the frame of the "
            "positions, and that delays are in seconds.",
        )
    flags = check_antennas(grid, terrain, inputs.aperture, where="backproject")
    if outside:
        flags["scene_beyond_samples"] = f"{100 * outside:.1f} % of the total paths to the scene lie beyond the samples"
    return flags


def _check_band(inputs: PhaseHistory | Profiles) -> None:
    """Raise CampaignError if frequencies are not radio frequencies, or if a weight or delay is not finite."""
    if isinstance(inputs, Profiles):
        frequency, name = np.array([inputs.centre_frequency_hz]), "centre_frequency_hz"
        finite = {"start_m": inputs.start_m}
    else:
        frequency, name = inputs.frequency_hz, "frequency_hz"
        finite = {"weight": inputs.weight, "reference_delay_s": inputs.reference_delay_s}
    low, high = (float(edge(frequency)) for edge in (np.min, np.max))
    if not (_RADIO_HZ[0] <= low and high <= _RADIO_HZ[1]):  # also raised for NaN
        units = {"GHz": 1e9, "MHz": 1e6, "kHz": 1e3}
        likely = [unit for unit, hz in units.items() if _USUAL_HZ[0] <= low * hz and high * hz <= _USUAL_HZ[1]]
        raise CampaignError(
            f"{low:.6g} to {high:.6g}" if low != high else f"{low:.6g}",
            where=f"backproject: {name}",
            expected=f"radio frequencies in Hz, {_RADIO_HZ[0]:g} to {_RADIO_HZ[1]:g}",
            remedy=f"If the values are in {likely[0]}, multiply them by {units[likely[0]]:g}."
            if likely
            else "Pass frequencies in Hz.",
        )
    for name, values in finite.items():
        lost = np.flatnonzero(~np.isfinite(values))
        if lost.size:
            raise CampaignError(
                f"{lost.size} of {values.size} values not finite, first at index {int(lost[0])}",
                where=f"backproject: {name}",
                expected="finite numbers",
                remedy="Exclude these pulses or subcarriers.",
            )
    if isinstance(inputs, PhaseHistory):
        range_step(inputs.frequency_hz, oversampling=1.0)
    if isinstance(inputs, PhaseHistory) and not (inputs.weight.min() >= 0 < inputs.weight.max()):
        raise CampaignError(
            f"{inputs.weight.min():.6g} to {inputs.weight.max():.6g}",
            where="backproject: weight",
            expected="a window over the subcarriers: no negative weights, and at least one positive weight",
            remedy="Use window='hann', or correct the weights.",
        )


def _check_samples(inputs: PhaseHistory | Profiles) -> None:
    samples = inputs.transfer if isinstance(inputs, PhaseHistory) else inputs.samples
    lost = np.array([not np.isfinite(row).all() for row in samples])
    if lost.any() or not any(row.any() for row in samples):
        raise CampaignError(
            f"samples of {int(lost.sum())} of {len(lost)} pulses are not finite, first at pulse {int(lost.argmax())}"
            if lost.any()
            else "all samples are zero",
            where="backproject",
            expected="finite samples that contain an echo",
            remedy="Exclude these pulses.",
        )


_LEAST_BAND = 0.05
"""Minimum fraction of subcarriers that contain the energy of a pulse: in frequency, an echo occupies the whole band; in
time, it occupies few samples."""


def _check_spectrum(history: PhaseHistory) -> None:
    """Raise CampaignError if samples appear to be in the time domain: few samples contain the energy of a pulse."""
    transfer = np.asarray(history[history.aperture.sample(_PULSES)].transfer)
    power = np.abs(transfer).astype(np.float64) ** 2
    total = power.sum(axis=1)
    used = total**2 / np.maximum((power**2).sum(axis=1), 1e-300)
    filled = float(np.median(used[total > 0])) if (total > 0).any() else 0.0
    if filled < _LEAST_BAND * power.shape[1]:
        raise CampaignError(
            f"the energy of a pulse lies in {filled:.1f} of {power.shape[1]} subcarriers",
            where="backproject: transfer",
            expected="transfer functions over frequency, with energy in the whole band",
            remedy="If the samples are over time or range, pass their DFT (numpy.fft.fft), or pass Profiles.",
        )


def _outside(inputs: PhaseHistory | Profiles, points: np.ndarray) -> float:
    """Return the fraction of total paths, from sampled pulses to sampled points, that lie beyond the samples.

    A phase history has the period c/Δf: a total path lies beyond the samples if it differs from the reference of the
    history by more than this period.
    """
    sampled = inputs[inputs.aperture.sample(_PULSES)]
    path_m = sampled.aperture.path(points)
    if isinstance(sampled, PhaseHistory):
        unambiguous_m = sampled.wave_speed_m_s / float(np.abs(np.diff(sampled.frequency_hz)).mean())
        reference_m = sampled.wave_speed_m_s * sampled.reference_delay_s[:, None]
        return float((np.abs(path_m - reference_m) > unambiguous_m).mean())
    at = (path_m - sampled.start_m[:, None]) / sampled.step_m
    return float(((at < 0) | (at > sampled.samples.shape[1] - 1)).mean())


# ---- Planner's job for a pair and a scene

_PATCH_PX = 256  # side of the windows at the pixels of which the errors of the engines are predicted


def decide_integration(
    aperture: Aperture,
    centre_hz: float,
    grid: SceneGrid,
    level: FlatGround,
    *,
    antennas: Beams | None = None,
    requested: Any = "auto",
) -> Integration:
    """Decide the integration of the pixels of a scene: the sector of the flight that contributes to each pixel.

    Parameters
    ----------
    aperture, centre_hz
        Phase centres in the frame of the pixels; centre frequency of the band.
    grid, level
        The scene, on level ground.
    antennas, requested
        As for `apertura.core.planning.decisions.integrate`.
    """
    points_m = grid.sample_points(_POINTS, level.height_m)
    geometry: dict[str, Any] = {"spacing_m": grid.spacing_m, "wavelength_m": SPEED_OF_LIGHT_M_S / centre_hz}
    return integrate(aperture, points_m, **geometry, antennas=antennas, requested=requested)


def imaging_job(
    aperture: Aperture,
    frequency_hz: NDArray[np.float64],
    weight: NDArray[np.float64],
    grid: SceneGrid,
    ground: GroundModels,
    *,
    beams: Beams | None = None,
    integration: Any = "auto",
    wave_speed_m_s: float = SPEED_OF_LIGHT_M_S,
) -> Job:
    """Return the planner's job for a phase history.

    Parameters
    ----------
    aperture
        Phase centres in the frame of the pixels.
    frequency_hz, weight
        (subcarrier,) float64, RF frequency and window.
    grid, ground
        The scene: its pixels, its terrain and simpler terrain models.
    beams
        Antenna beams and gate; None: isotropic, all echoes recorded.
    integration
        As `requested` of `apertura.core.planning.decisions.integrate`.
    wave_speed_m_s
        Speed of the wave along the paths.

    Returns
    -------
    Job
        Job without a memory limit, and with default numbers of tile pixels and threads. The caller sets these values.
    """
    centre, count = centre_frequency(frequency_hz), len(frequency_hz)
    ground_m = grid.sample_points(_POINTS, ground.level.height_m)
    antennas, gate = (beams.antennas, beams.gate) if beams else (None, None)
    decided = decide_integration(aperture, centre, grid, ground.level, antennas=antennas, requested=integration)
    beams = Beams.within(decided.sector, antennas, gate)
    window = RangeWindow.of(aperture, grid, ground.full, frequency_hz, beams=beams, wave_speed_m_s=wave_speed_m_s)
    return Job(
        aperture=aperture,
        ground_m=ground_m,
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre,
        bandwidth_hz=float(frequency_hz[-1] - frequency_hz[0]) * count / (count - 1),
        subcarriers=count,
        signal=Signal(centre, window.unambiguous / count, window.step_m, window.samples, weight, wave_speed_m_s),
        frame=grid.frame,
        terrain=ground,
        patches_on=partial(_patches, grid),
        beams=beams,
        integration=decided,
    )


def profiles_job(
    profiles: Profiles, grid: SceneGrid, ground: GroundModels, *, beams: Beams | None = None, integration: Any = "auto"
) -> Job:
    """Return the planner's job for range profiles without a phase history; the band is assumed full and flat.

    Parameters
    ----------
    profiles
        Range profiles, with phase centres in the frame of the pixels.
    grid, ground, beams, integration
        As for `imaging_job`.
    """
    centre, samples = profiles.centre_frequency_hz, profiles.samples.shape[1]
    ground_m = grid.sample_points(_POINTS, ground.level.height_m)
    antennas, gate = (beams.antennas, beams.gate) if beams else (None, None)
    decided = decide_integration(
        profiles.aperture, centre, grid, ground.level, antennas=antennas, requested=integration
    )
    return Job(
        aperture=profiles.aperture,
        ground_m=ground_m,
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre,
        bandwidth_hz=profiles.bandwidth_hz,
        subcarriers=samples,
        signal=Signal(centre, profiles.oversampling, profiles.step_m, samples, wave_speed_m_s=profiles.wave_speed_m_s),
        frame=grid.frame,
        terrain=ground,
        patches_on=partial(_patches, grid),
        beams=Beams.within(decided.sector, antennas, gate),
        integration=decided,
        recorded=False,
    )


def _patches(grid: SceneGrid, ground: Terrain) -> tuple[NDArray[np.float64], ...]:
    """Return the pixel positions of windows in the corners and at the centre of a scene."""
    sides = [min(_PATCH_PX, size) for size in grid.shape]
    ends = [(0, (size - side) // 2, size - side) for size, side in zip(grid.shape, sides, strict=True)]
    corners = {(ends[0][row], ends[1][column]) for row, column in ((0, 0), (0, 2), (1, 1), (2, 0), (2, 2))}
    windows = [
        tuple(slice(at, at + side) for at, side in zip(corner, sides, strict=True)) for corner in sorted(corners)
    ]
    return tuple(ground.positions(grid[rows, columns]) for rows, columns in windows)
