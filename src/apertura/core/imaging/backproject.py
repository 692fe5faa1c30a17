"""Backprojection from Python: planned, certified, lazy images of range profiles or of a phase history."""

import json
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import is_number
from apertura.common.contracts import CF_SIGMA0, Window
from apertura.common.documents import validated
from apertura.common.errors import CampaignError, quoted
from apertura.common.flags import Flags
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illuminate
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.job import Job
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.atmosphere import Atmosphere, SceneAir
from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import check_inputs, imaging_job, profiles_job
from apertura.core.imaging.judgement import Judgement, budget_by_hand, judgement
from apertura.core.imaging.options import ImagingChoices, IntegrationAngle, IntegrationResolution
from apertura.core.imaging.radiometry import Calibration, cell_constant
from apertura.core.imaging.range_profiles import RangeWindow, inputs_of, range_compress
from apertura.core.planning.plan import memory_limit
from apertura.core.planning.planner import make_plan
from apertura.core.quality.budget import MOST_ACCURACY_DB
from apertura.core.quality.error_check import CONFIDENCE, ErrorBound, error_bound
from apertura.core.quality.focus import focus_with_flags
from apertura.core.scene.angles import surface
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GroundModels, Terrain, ground_of

if TYPE_CHECKING:
    import xarray as xr


def backproject(  # noqa: PLR0913 - each choice is a keyword, for completion in editors
    profiles: "Profiles | PhaseHistory | xr.Dataset",
    grid: SceneGrid,
    accuracy_db: float = MOST_ACCURACY_DB,
    *,
    terrain: Terrain | float | None = None,
    engine: str = "auto",
    beams: Beams | None = None,
    atmosphere: "Atmosphere | float | Literal['auto', 'vacuum'] | None" = None,
    calibration: float | None = None,
    certified_pixels: int = 64,
    judge: bool | Literal["auto"] = "auto",
    terrain_model: Literal["auto", "plane", "tilted_plane", "dem"] = "auto",
    window: Literal["hann", "none"] = "hann",
    integration: "Literal['auto', 'all'] | IntegrationAngle | IntegrationResolution | Mapping[str, float]" = "auto",
    presum: int | Literal["auto"] = "auto",
    pulse_blocks: int | Literal["auto"] = "auto",
    tile_px: int = 256,
    engine_options: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> "xr.DataArray":
    """Form a lazy focused image over a grid, planned for the requested accuracy.

    Parameters
    ----------
    profiles
        Range profiles; or calibrated transfer functions, which are compressed in range first; or the dataset of the
        stage `profile` or `echo` of a campaign. The wave speed is part of these inputs. In arrays, the default is the
        wave speed in vacuum; use ``ap.wave_speed(285)`` for a refractivity of 285 N units. In the dataset of a stage,
        it is the wave speed in the configured atmosphere.
    grid
        Pixels, in the same frame as the phase centres: ECEF, or the local frame of a grid with ``crs="local"``.
    accuracy_db
        Requested numerical error: RMS over all pixels relative to the exact sum, dB, -120 to -10.
    terrain
        Heights of the terrain, or a single height, metres: above the ellipsoid of the grid's CRS, or z in a local frame
        (default in a local frame: 0).
    engine
        'auto' or a key of `apertura.core.backprojection.engines.ENGINES`.
    beams
        Antenna beams (default: isotropic).
    atmosphere
        Atmosphere that replaces the wave speed in `profiles`: 'auto' for the standard atmosphere over the terrain, an
        `Atmosphere`, the refractivity at the terrain in N units, or 'vacuum'. The wave speed is constant over the
        flight and is computed from the heights of the flight.
    calibration
        Calibration constant K, |H|² of a target of 1 m² on both boresights with R_tx·R_rx = 1 m², from
        ``ap.Link(...).constant(...)`` or measured on a reflector. If K is given, the image has the coordinates `sigma0`
        and `rcs`.
    certified_pixels
        Number of random pixels that are computed exactly for the certificate, at once; 0 for no certificate. The error
        bound is no lower than the predicted error. If a setting does not meet the requested accuracy at these pixels,
        it is replaced by the next setting of the plan.
    judge
        If True, the image is formed at once, in addition to the lazy image, and its focus and unfocused echoes are
        assessed as by `apertura.judge`. 'auto': this is done if the predicted run time is at most ten seconds.
    terrain_model
        Terrain model: 'auto', 'plane', 'tilted_plane' or 'dem'.
    window
        Window over the subcarriers of transfer functions; profiles are already windowed.
    integration
        Extent of the pass over which a pixel is integrated: 'auto' for the finest resolution that the pixel spacing can
        represent, 'all' for the whole pass, ``{"degrees": x}`` for an integration angle of a straight pass, or
        ``{"resolution_m": x}`` for a resolution along the flight.
    presum
        Number of pulses that a low-pass sum combines into one virtual pulse if the aperture is oversampled; 1: no
        presumming.
    pulse_blocks
        Number of pulse blocks, which are processed sequentially to limit the memory for tables; 1: all pulses at once.
    tile_px
        Side of a tile, pixels; each tile is a chunk of the array.
    engine_options
        Engine options fixed by the caller: engine → option → value.

    Returns
    -------
    xarray.DataArray
        (y, x) complex64 with the carrier phase, in units of the amplitude of an echo present in every pulse. The data
        is a dask array, which is computed by the caller's scheduler. Attributes of the image are units and
        `wave_speed_m_s`. Attributes of the plan are `setting`, `predicted_error_db`, and, as JSON, `models` (choice →
        value and reason) and `flags` (exceeded limit → measured value). Attributes of the judgement are `verdict` ('not
        judged' if deferred), `verdict_reason`, and, as JSON, `budget`. Attributes of the certificate are
        `numerical_error_db`, an upper bound for the whole image at `numerical_error_confidence`, and
        `numerical_error_estimate_db`. Errors are relative to the double sum over pulses and subcarriers, or, if only
        profiles are given, to the band-limited interpolation of the profiles in float64. With `calibration`, there are
        also lazy coordinates (y, x) float32: `sigma0` of terrain, including noise, and `rcs`, the radar cross-section
        (m²) of a point at the pixel; both are NaN where no pulse illuminates the pixel.

    Raises
    ------
    CampaignError
        If an argument is invalid; positions, samples or heights are not finite; an antenna is below the terrain; the
        samples contain no echo of the scene; the scene is deeper than the unambiguous range; or no requested setting is
        available on this machine.

    Notes
    -----
    Source: docs/theory.md, eq. 4 to 6; docs/theory/planner.md; docs/theory/atmosphere.md, eq. 4;
    docs/theory/radiometry.md, eq. 4 and 6.

    Examples
    --------
    >>> import apertura as ap
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> aperture = ap.Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), aperture)
    >>> image = ap.backproject(history, ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100)), tile_px=64)
    >>> image.chunks, image.attrs["numerical_error_db"] < -60
    (((64, 36), (64, 36)), True)
    >>> image.attrs["verdict"], image.attrs["flags"]
    ('focused', '{}')
    >>> abs(float(abs(image).max()) - 1) < 0.05
    True
    >>> image = ap.backproject(history, ap.SceneGrid("local", -1.0, 1.0, 0.1, (20, 20)), calibration=1.0)
    >>> 0.8 < float(image.rcs.max()) / 500**2 < 1.1  # K = 1: an amplitude of 1 where R_tx·R_rx is 500 m²
    True
    """
    import xarray as xr

    if not is_number(accuracy_db):
        raise CampaignError(
            quoted(accuracy_db),
            "backproject: accuracy_db",
            "a number, dB relative to the RMS of the exact sum",
            "Pass a number, such as -60.",
        )
    choices = validated(
        ImagingChoices,
        {
            "accuracy_db": accuracy_db,
            "engine": engine,
            "terrain": terrain_model,
            "window": window,
            "integration": integration,
            "presum": presum,
            "pulse_blocks": pulse_blocks,
            "tile_px": tile_px,
            "engine_options": engine_options,
        },
        where="backproject",
        expected="valid values of ImagingChoices",
    )
    # Check inputs and scene.
    inputs = inputs_of(profiles, choices.window)
    inputs = replace(inputs, aperture=inputs.aperture.copied())  # the caller may change arrays before computing tiles
    ground = ground_of(terrain, grid)
    _check_kinds(inputs, beams, certified_pixels)
    if atmosphere is not None:
        inputs = inputs.at_speed(_wave_speed(atmosphere, grid, ground, inputs.aperture))
    _check_calibration(calibration, inputs)
    flags = check_inputs(inputs, grid, ground)
    history = inputs if isinstance(inputs, PhaseHistory) else None
    # Plan.
    models = GroundModels.of(ground, None, grid)
    job = replace(_job(inputs, grid, models, beams, choices.integrated), tile_px=choices.tile_px)
    compressed = _compressed(inputs, grid, ground, job.beams)
    plan = make_plan(job, accuracy_db=accuracy_db, overrides=choices.planned, where="backproject")
    formation = Formation(history, compressed, grid, plan, choices.tile_px)
    # Certificate: compare random pixels with the exact sum; use the next setting if these do not meet the accuracy.
    attributes: dict[str, Any] = {}
    if certified_pixels:
        formation, error = _certified(formation, accuracy_db, certified_pixels)
        attributes = {
            "numerical_error_db": round(error.bound_db, 2),
            "numerical_error_confidence": CONFIDENCE,
            "numerical_error_estimate_db": round(error.estimate_db, 2),
            "certified_pixels": int(certified_pixels),
        }
        flags = Flags.merged(flags, plan.replaced_by(formation.plan.setting, "the image"))
        if error.bound_db > accuracy_db:
            bound = f"numerical error up to {error.bound_db:.1f} dB ({CONFIDENCE:.0%} confidence)"
            flags["accuracy_not_met"] = f"{bound}, {accuracy_db:g} dB requested"
    # Judgement of focus, and attributes.
    error_db = attributes.get("numerical_error_db")
    judged = _judged(formation, judge, error_db=error_db)
    flags = Flags.merged(flags, plan.flags, judged.flags)
    focus = focus_with_flags({"verdict": judged.verdict, "reason": judged.reason}, flags, error_db=error_db)
    attributes |= {
        "units": "1",
        "wave_speed_m_s": inputs.wave_speed_m_s,
        "long_name": "focused image, carrier phase preserved",
        "grid_mapping": "spatial_ref",
        "setting": formation.plan.setting.line,
        "predicted_error_db": round(formation.plan.predicted_error_db, 2),
        "models": json.dumps(formation.plan.reasons, ensure_ascii=False),
        "flags": json.dumps(flags, ensure_ascii=False),
        "verdict": focus["verdict"],
        "verdict_reason": focus["reason"],
        "budget": json.dumps(judged.budget, ensure_ascii=False),
    }
    lazy = formation.image
    lazy.dask.layers[lazy.name].origin = formation  # for apertura.judge
    image = xr.DataArray(lazy, grid.coordinates, ("y", "x"), name="image", attrs=attributes)
    if calibration is None or history is None:
        return image
    return image.assign_coords(_calibrated(image.data, formation, history, ground, calibration))


def _check_kinds(inputs: PhaseHistory | Profiles, beams: Any, certified_pixels: Any) -> None:
    """Raise CampaignError if the type or size of `beams` or `certified_pixels` is invalid."""
    counted = isinstance(certified_pixels, Integral) and not isinstance(certified_pixels, bool)
    if not counted or not 0 <= certified_pixels <= _MOST_CERTIFIED:
        raise CampaignError(
            quoted(certified_pixels),
            "backproject: certified_pixels",
            f"a number of pixels, 0 to {_MOST_CERTIFIED}",
            "Pass a number in this interval; 0 means no certificate.",
        )
    if beams is None:
        return
    if not isinstance(beams, Beams):
        raise CampaignError(
            f"an object of type {type(beams).__name__}", "backproject: beams", "Beams", "Pass Beams, or omit beams."
        )
    for name, beam in (("transmit", beams.transmit), ("receive", beams.receive)):
        if beam is not None and len(beam.axes) != len(inputs):
            raise CampaignError(
                f"{len(beam.axes)} pulses",
                where=f"backproject: Beams.{name}",
                expected=f"{len(inputs)} pulses, the number of pulses of the input",
                remedy="Provide one set of antenna axes per pulse.",
            )


_MOST_CERTIFIED = 1_000_000
"""Largest number of pixels compared with the exact sum: a hundredth of this number yields nearly the same bound."""

_SUM = 1e-3
"""Tolerated deviation of the sum of weights from 1: a hundredth of a decibel."""

_AT_ONCE_S = 10.0
"""Longest predicted run time (s) at which the image is formed and assessed at once for judge='auto'."""


def _judged(formation: Formation, judge: bool | str, *, error_db: float | None) -> Judgement:
    """Return the judgement of an image, or the reason for deferring the judgement."""
    if not (isinstance(judge, bool) or judge == "auto"):
        raise CampaignError(quoted(judge), "backproject: judge", "True, False or 'auto'", "Use one of these values.")
    lines = budget_by_hand(formation, error_db=error_db)
    seconds = formation.plan.predicted_seconds
    if judge is True or (judge == "auto" and seconds <= _AT_ONCE_S):
        return judgement(formation, np.asarray(formation.image), lines)
    reason = "judgement not requested" if judge is False else f"predicted run time of the image {seconds:.2g} s"
    reason = f"{reason}; apertura.judge forms and judges the image"
    return Judgement("not judged", reason, Flags(), [line.report for line in lines], {})


def _wave_speed(
    atmosphere: "Atmosphere | float | Literal['auto', 'vacuum']", grid: SceneGrid, ground: Terrain, aperture: Aperture
) -> float:
    """Return the mean wave speed between the scene centre and the antennas."""
    middle_m = ground.positions_at(grid, *(np.array([size // 2]) for size in grid.shape))[0]
    frame = LOCAL if grid.crs == LOCAL else "ecef"
    ground_m = float(middle_m[2] if frame == LOCAL else geodetic_from_ecef(middle_m)[2])
    if not (is_number(atmosphere) or isinstance(atmosphere, Atmosphere)) and atmosphere not in ("auto", "vacuum"):
        raise CampaignError(
            quoted(atmosphere),
            where="backproject: atmosphere",
            expected="auto, vacuum, an Atmosphere, or the refractivity at the terrain in N units",
            remedy="Use one of these values.",
        )
    if atmosphere == "auto":
        air = Atmosphere.standard(ground_m)
    elif atmosphere == "vacuum":
        air = Atmosphere.vacuum()
    else:
        air = (
            atmosphere
            if isinstance(atmosphere, Atmosphere)
            else Atmosphere.stated(float(atmosphere), ground_m=ground_m)
        )
    return SceneAir(air, middle_m, frame).over(aperture).wave_speed_m_s


def _check_calibration(constant: float | None, inputs: PhaseHistory | Profiles) -> None:
    if constant is None:
        return
    if not (is_number(constant) and constant > 0):
        raise CampaignError(
            f"a constant of {quoted(constant)}",
            where="backproject: calibration",
            expected="a positive number: |H|² of 1 m² at R_tx·R_rx = 1 m²",
            remedy="Use the value of Link.constant, or a constant measured on a reflector.",
        )
    if isinstance(inputs, PhaseHistory) and abs(float(inputs.weight.sum()) - 1) > _SUM:
        raise CampaignError(
            f"the subcarrier weights sum to {float(inputs.weight.sum()):.4g}",
            where="backproject: calibration",
            expected="a sum of 1, so that the peak of a profile is the echo amplitude to which the constant refers",
            remedy="Divide PhaseHistory.weight by its sum.",
        )
    if isinstance(inputs, Profiles):
        raise CampaignError(
            "range profiles with an unknown window over the subcarriers",
            where="backproject: calibration",
            expected="a PhaseHistory, or the dataset of stage echo",
            remedy="Pass the phase history; backproject compresses it in range.",
        )


def _calibrated(
    image: Any, formation: Formation, history: PhaseHistory, ground: Terrain, constant: float
) -> dict[str, tuple[tuple[str, str], Any, dict[str, str]]]:
    """Return the lazy σ⁰ and radar cross-section of an image as coordinates."""
    grid, level = formation.grid, isinstance(ground, FlatGround)
    calibration = Calibration.of(
        grid,
        ground,
        history.aperture,
        formation.beams,
        constant=constant,
        cell_m2=cell_constant(history.frequency_hz, history.weight),
        count=formation.count,
    )

    def sigma0(window: Window) -> NDArray[np.float64]:
        return calibration.power(window, "sigma0", None if level else surface(grid, ground, window)[1])

    def scaled(block: NDArray[np.complex64], per_one: Any, block_info: Any) -> NDArray[np.float32]:
        rows, columns = (slice(*ends) for ends in block_info[0]["array-location"])
        return np.asarray(np.abs(block) ** 2 / per_one((rows, columns)), np.float32)

    attributes = {
        "sigma0": {
            "standard_name": CF_SIGMA0,
            "units": "1",
            "long_name": "radar cross-section of terrain per terrain area, including noise",
        },
        "rcs": {"units": "m2", "long_name": "radar cross-section of a point at the pixel"},
    }
    return {
        name: (
            ("y", "x"),
            image.map_blocks(scaled, per_one, dtype=np.float32, meta=np.empty((0, 0), np.float32)),
            {**attributes[name], "grid_mapping": "spatial_ref"},
        )
        for name, per_one in (("sigma0", sigma0), ("rcs", calibration.rcs_power))
    }


def _certified(formation: Formation, accuracy_db: float, count: int) -> tuple[Formation, ErrorBound]:
    """Return the image formation with the first setting of the plan that meets the accuracy, or with the last one."""
    pixels = np.random.default_rng(0).integers(0, formation.grid.shape, (count, 2))
    exact = formation.exact(pixels)
    error = _error(formation, pixels, exact)
    for setting in formation.plan.fallbacks:
        if error.bound_db <= accuracy_db:
            break
        formation = replace(formation, plan=formation.plan.fallen_back(setting))
        error = _error(formation, pixels, exact)
    return formation, error


def _error(formation: Formation, pixels: NDArray[np.int64], exact: NDArray[np.complex128]) -> ErrorBound:
    """Return the error bound from uniformly drawn pixels; it is at least the predicted error."""
    values, power = formation.values(pixels)
    error = error_bound(values, exact, np.ones(len(pixels)), power=power)
    return replace(error, bound_db=max(error.bound_db, formation.plan.predicted_error_db))


def _compressed(inputs: PhaseHistory | Profiles, grid: SceneGrid, ground: Terrain, beams: Beams | None) -> Profiles:
    if isinstance(inputs, Profiles):
        return inputs
    window = RangeWindow.of(
        inputs.aperture, grid, ground, inputs.frequency_hz, beams=beams, wave_speed_m_s=inputs.wave_speed_m_s
    )
    return range_compress(inputs, grid, ground, window=window)


def _job(
    inputs: PhaseHistory | Profiles, grid: SceneGrid, ground: GroundModels, beams: Beams | None, integration: Any
) -> Job:
    weighed: dict[str, Any] = {"beams": beams, "integration": integration}
    if isinstance(inputs, Profiles):
        job = profiles_job(inputs, grid, ground, **weighed)
    else:
        known = (inputs.aperture, inputs.frequency_hz, inputs.weight)
        job = imaging_job(*known, grid, ground, wave_speed_m_s=inputs.wave_speed_m_s, **weighed)
    applied = job.beams and job.beams.on_profiles
    illumination = None if applied is None else illuminate(applied, job.aperture, job.points_m)
    return replace(job, illumination=illumination, memory_bytes=memory_limit())
