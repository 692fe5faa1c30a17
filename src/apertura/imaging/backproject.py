"""The front door from Python: one call from profiles or phase history to a planned, certified, lazy image."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from apertura.antenna.beam import Beams
from apertura.antenna.illumination import illuminate
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.focus.job import Job
from apertura.imaging.formation import Formation
from apertura.imaging.job import imaging_job, profiles_job
from apertura.imaging.range_profiles import range_compress
from apertura.imaging.stages import inputs_of
from apertura.planning.planner import make_plan
from apertura.quality.measures import numerical_error
from apertura.scene.clearance import check_antennas
from apertura.scene.grid import SceneGrid
from apertura.scene.ground_models import GroundModels
from apertura.scene.terrain import FlatGround, Terrain

if TYPE_CHECKING:
    import xarray as xr


def backproject(
    profiles: "Profiles | PhaseHistory | xr.Dataset",
    grid: SceneGrid,
    accuracy_db: float = -60.0,
    *,
    terrain: Terrain | None = None,
    engine: str = "auto",
    beams: Beams | None = None,
    tile_px: int = 256,
    certified_pixels: int = 64,
    terrain_model: str = "auto",
    **choices: Any,
) -> "xr.DataArray":
    """Return a focused image over a grid: planned for the accuracy asked, lazy until it is computed.

    Parameters
    ----------
    profiles
        Range profiles; or calibrated transfer functions, which are compressed in range first; or a stage `profile` or
        `echo` of a campaign.
    grid
        Pixels; their frame is that of the phase centres: ECEF, or the local frame of a grid with ``crs="local"``.
    accuracy_db
        Numerical error asked: RMS on random pixels relative to the exact sum, dB.
    terrain
        Heights of the ground; at zero by default.
    engine
        'auto' or a key of `apertura.focus.engines.ENGINES`.
    beams
        Of the antennas; isotropic by default.
    tile_px
        Side of a tile, which is a chunk of the array; a multiple of 16.
    certified_pixels
        Random pixels computed both ways at once, for the certificate; 0 for none.
    terrain_model
        'auto', 'plane', 'tilted_plane' or 'dem': what stands for the ground.
    **choices
        Other choices of the planner: engine_options, presum, pulse_blocks.

    Returns
    -------
    xarray.DataArray
        (y, x) complex64, carrier kept, 1 is the amplitude of an echo seen by every pulse; a dask array on whatever
        scheduler the caller has. Attributes: units, the plan (`setting`, `models`, `flags`, `predicted_error_db`) and
        the certificate (`numerical_error_db`, `numerical_error_std_db`, against the double sum over pulses and
        subcarriers, or from profiles alone against their band-limited interpolation in float64).

    Raises
    ------
    CampaignError
        If there is no pulse, no echo of the scene arrives, an antenna is in the ground, or what is asked cannot run
        here.
    ValueError
        If the scene is deeper than the unambiguous range.

    Notes
    -----
    Source: docs/theory.md, eq. 4 to 6; docs/theory/planner.md.

    Examples
    --------
    >>> import apertura as ap
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> flown = ap.Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * flown.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), flown)
    >>> image = ap.backproject(history, ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100)), tile_px=64)
    >>> image.chunks, image.attrs["numerical_error_db"] < -60
    (((64, 36), (64, 36)), True)
    >>> abs(float(abs(image).max()) - 1) < 0.05
    True
    """
    import xarray as xr

    inputs = inputs_of(profiles)
    ground = terrain if terrain is not None else FlatGround(0.0)
    level = ground if isinstance(ground, FlatGround) else FlatGround(float(np.nanmean(ground.heights(grid.coarse(33)))))
    flags = check_antennas(grid, ground, inputs.aperture, where="backproject")
    models = GroundModels.of(ground, level, grid)
    history = inputs if isinstance(inputs, PhaseHistory) else None
    compressed = range_compress(inputs, grid, ground) if isinstance(inputs, PhaseHistory) else inputs
    job = _job(compressed, history, grid, models, beams, tile_px)
    overrides = {**choices, "engine": engine, "terrain": terrain_model}
    plan = make_plan(job, accuracy_db=accuracy_db, overrides=overrides, where="backproject")
    formation = Formation(history, compressed, grid, plan, tile_px, beams)
    attributes: dict[str, Any] = {
        "units": "1",
        "long_name": "focused scene, carrier kept",
        "grid_mapping": "spatial_ref",
        "setting": plan.setting.line,
        "models": plan.reasons,
        "flags": {**flags, **plan.flags},
        "predicted_error_db": round(plan.predicted_error_db, 2),
    }
    if certified_pixels:
        pixels = np.random.default_rng(0).integers(0, grid.shape, (certified_pixels, 2))
        error = numerical_error(formation.values(pixels), formation.exact(pixels))
        attributes |= {
            "numerical_error_db": round(error.rms_db, 2),
            "numerical_error_std_db": round(error.std_db, 2),
            "certified_pixels": certified_pixels,
        }
    return xr.DataArray(formation.image, grid.coordinates, ("y", "x"), name="image", attrs=attributes)


def _job(
    profiles: Profiles,
    history: PhaseHistory | None,
    grid: SceneGrid,
    ground: GroundModels,
    beams: Beams | None,
    tile_px: int,
) -> Job:
    if history is None:
        job = profiles_job(profiles, grid, ground, beams=beams)
    else:
        job = imaging_job(
            history.aperture, history.frequency_hz, history.weight, grid, ground, history=history, beams=beams
        )
    lit = None if beams is None else illuminate(beams, job.aperture, job.points_m)
    return replace(job, tile_px=tile_px, illumination=lit)
