"""From what is known of a pair and a scene to the planner's job."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency
from apertura.core.focus.engines import reference
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.focus.job import Integration, Job, Signal
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import RangeWindow
from apertura.core.planning.integration import integrate
from apertura.core.quality.measures import content_loss_db
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.ground_models import GroundModels
from apertura.core.scene.terrain import FlatGround, Terrain

_POINTS = 9
_PATCH_PX = 256
_CONTENT_PIXELS = 128
_CONTENT_PULSES = 16384  # of which the terms of so many pixels take 32 MB


def settle(
    aperture: Aperture,
    centre_hz: float,
    grid: SceneGrid,
    level: FlatGround,
    *,
    antennas: Beams | None = None,
    asked: Any = "auto",
) -> Integration:
    """Return over how much of a flight the pixels of a scene are integrated.

    Parameters
    ----------
    aperture, centre_hz
        Phase centres in the frame of the pixels; middle of the band.
    grid, level
        The scene, on level ground.
    antennas, asked
        As of `apertura.core.planning.integration.integrate`.
    """
    points_m = grid.sample_points(_POINTS, level.height_m)
    geometry: dict[str, Any] = {"spacing_m": grid.spacing_m, "wavelength_m": SPEED_OF_LIGHT_M_S / centre_hz}
    return integrate(aperture, points_m, **geometry, antennas=antennas, asked=asked)


def imaging_job(
    aperture: Aperture,
    frequency_hz: NDArray[np.float64],
    weight: NDArray[np.float64],
    grid: SceneGrid,
    ground: GroundModels,
    *,
    history: PhaseHistory | None = None,
    beams: Beams | None = None,
    integration: Any = "auto",
) -> Job:
    """Return the planner's job.

    Parameters
    ----------
    aperture
        Phase centres in the frame of the pixels.
    frequency_hz, weight
        (subcarrier,) float64, RF frequency and window.
    grid, ground
        The scene: its pixels, its ground and that one's cheaper models.
    history
        What was recorded, where it is there: it tells how much errors weigh between the scene's targets.
    beams
        Of the antennas, where they have any.
    integration
        As `apertura.core.planning.integration.integrate` is asked.

    Returns
    -------
    Job
        With no limit of path or memory, and defaults of tiles and threads, to be replaced.
    """
    centre, count = centre_frequency(frequency_hz), len(frequency_hz)
    ground_m = grid.sample_points(_POINTS, ground.level.height_m)
    settled = settle(aperture, centre, grid, ground.level, antennas=beams, asked=integration)
    beams = Beams.within(settled.sector, beams)
    window = RangeWindow.of(aperture, grid, ground.full, frequency_hz, beams=beams)
    return Job(
        aperture=aperture,
        ground_m=ground_m,
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre,
        bandwidth_hz=float(frequency_hz[-1] - frequency_hz[0]) * count / (count - 1),
        subcarriers=count,
        signal=Signal(centre, window.unambiguous / count, window.step_m, window.samples, weight),
        frame=grid.frame,
        terrain=ground,
        patches_on=partial(_patches, grid),
        content_db=None if history is None else _content_db(history, grid, ground.full, beams),
        beams=beams,
        integration=settled,
    )


def profiles_job(
    profiles: Profiles, grid: SceneGrid, ground: GroundModels, *, beams: Beams | None = None, integration: Any = "auto"
) -> Job:
    """Return the planner's job of range profiles alone: their band is taken as full and flat, their echo as unseen.

    Parameters
    ----------
    profiles
        In the frame of the pixels.
    grid, ground, beams, integration
        As `imaging_job`.
    """
    bandwidth_hz = SPEED_OF_LIGHT_M_S / (profiles.step_m * profiles.oversampling)
    centre, samples = profiles.centre_frequency_hz, profiles.samples.shape[1]
    ground_m = grid.sample_points(_POINTS, ground.level.height_m)
    settled = settle(profiles.aperture, centre, grid, ground.level, antennas=beams, asked=integration)
    return Job(
        aperture=profiles.aperture,
        ground_m=ground_m,
        shape=grid.shape,
        spacing_m=grid.spacing_m,
        centre_hz=centre,
        bandwidth_hz=bandwidth_hz,
        subcarriers=samples,
        signal=Signal(centre, profiles.oversampling, profiles.step_m, samples),
        frame=grid.frame,
        terrain=ground,
        patches_on=partial(_patches, grid),
        beams=Beams.within(settled.sector, beams),
        integration=settled,
        recorded=False,
    )


def _patches(grid: SceneGrid, ground: Terrain) -> tuple[NDArray[np.float64], ...]:
    """Return the places of the pixels of some windows: in the corners of a scene and in its middle."""
    sides = [min(_PATCH_PX, size) for size in grid.shape]
    ends = [(0, (size - side) // 2, size - side) for size, side in zip(grid.shape, sides, strict=True)]
    corners = {(ends[0][row], ends[1][column]) for row, column in ((0, 0), (0, 2), (1, 1), (2, 0), (2, 2))}
    windows = [
        tuple(slice(at, at + side) for at, side in zip(corner, sides, strict=True)) for corner in sorted(corners)
    ]
    return tuple(ground.positions(grid[rows, columns]) for rows, columns in windows)


def _content_db(history: PhaseHistory, grid: SceneGrid, terrain: Terrain, beams: Beams | None) -> float | None:
    """Return how much errors weigh at some random pixels of the scene; None where a flight is too long to be read."""
    if len(history) > _CONTENT_PULSES:
        return None
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (_CONTENT_PIXELS, 2)).T
    places = terrain.positions_at(grid, rows, columns)
    parts = [slice(first, first + 64) for first in range(0, len(history), 64)]
    return content_loss_db(
        np.concatenate([reference.terms(history[part], places, beams and beams[part]) for part in parts])
    )
