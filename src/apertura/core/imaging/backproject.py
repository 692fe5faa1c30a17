"""Backprojection from Python: one call from profiles or phase history to a planned, certified, lazy image."""

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


def backproject(  # noqa: PLR0913 - each choice is a keyword, so that an editor completes it
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
    """Return a focused image over a grid: planned for the requested accuracy, lazy until it is computed.

    Parameters
    ----------
    profiles
        Range profiles; or calibrated transfer functions, which are compressed in range first; or a stage `profile` or
        `echo` of a campaign. They carry the speed of the wave: that in vacuum unless stated, ``ap.wave_speed(285)`` in
        air of so many N units, that of its config's air in a stage.
    grid
        Pixels; their frame is that of the phase centres: ECEF, or the local frame of a grid with ``crs="local"``.
    accuracy_db
        Requested numerical error: RMS over all pixels relative to the exact sum, dB, -120 to -10.
    terrain
        Heights of the ground, or one height (m): above the ellipsoid of the grid's CRS; in a local frame z, and 0 by
        default.
    engine
        'auto' or a key of `apertura.core.backprojection.engines.ENGINES`.
    beams
        Of the antennas; isotropic by default.
    atmosphere
        Air that the waves flew in, instead of the speed that `profiles` carry: 'auto', the standard atmosphere over the
        ground; an `Atmosphere`; N units at the ground; 'vacuum'. One speed for the flight, by its heights.
    calibration
        K, |H|² of a target of 1 m² whose distances from both antennas multiply to 1 m², on both boresights:
        ``ap.Link(...).constant(...)``, or measured on a reflector. The image then has coordinates `sigma0` and `rcs`.
    certified_pixels
        Random pixels also computed exactly at once, for the certificate; 0 for none. Their bound is no lower than the
        error predicted. A setting that misses the accuracy on them is replaced by the plan's next.
    judge
        Whether the image is formed at once, beside the lazy one, and judged by its focus and by echoes that it does not
        show, as `apertura.judge` does at any time. 'auto': where the plan takes no more than ten seconds for it.
    terrain_model
        'auto', 'plane', 'tilted_plane' or 'dem': model of the ground.
    window
        Weighting over the subcarriers of transfer functions; profiles have theirs.
    integration
        How much of a pass a pixel is integrated over: 'auto', as much as the pixel spacing can represent; 'all';
        ``{"degrees": x}`` of a straight pass; ``{"resolution_m": x}`` along the flight.
    presum
        Pulses that a low-pass sum combines into one, where the aperture is oversampled; 1 keeps all.
    pulse_blocks
        Blocks of pulses whose tables are in memory at once, one after the other; 1 takes them all.
    tile_px
        Side of a tile, pixels: a chunk of the array.
    engine_options
        Options of engines fixed by the caller: engine → option → value.

    Returns
    -------
    xarray.DataArray
        (y, x) complex64, carrier kept, 1 is the amplitude of an echo in every pulse; a dask array on whatever
        scheduler the caller has. Attributes: units; `wave_speed_m_s`; the plan: `setting`, `predicted_error_db`, and
        as JSON `models` (choice → value and reason) and `flags` (limit crossed → what was measured); the judgement:
        `verdict`, 'not judged' where it was left for later, `verdict_why`, and as JSON `budget`; the certificate:
        `numerical_error_db`, an upper bound at `numerical_error_confidence` for the whole image, and
        `numerical_error_estimate_db`, against the double sum over pulses and subcarriers, or from profiles alone
        against their band-limited interpolation in float64. With `calibration` lazy coordinates (y, x) float32:
        `sigma0`, of ground, noise included, and `rcs`, the cross-section (m²) of a point at the pixel; NaN where no
        pulse sees it.

    Raises
    ------
    CampaignError
        If a choice is not one, positions, samples or heights are not finite, an antenna is in the ground, no echo of
        the scene arrives, the scene is deeper than the unambiguous range, or what is asked cannot run here.

    Notes
    -----
    Source: docs/theory.md, eq. 4 to 6; docs/theory/planner.md; docs/theory/atmosphere.md, eq. 4;
    docs/theory/radiometry.md, eq. 4 and 6.

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
    >>> image.attrs["verdict"], image.attrs["flags"]
    ('focused', '{}')
    >>> abs(float(abs(image).max()) - 1) < 0.05
    True
    >>> seen = ap.backproject(history, ap.SceneGrid("local", -1.0, 1.0, 0.1, (20, 20)), calibration=1.0)
    >>> 0.8 < float(seen.rcs.max()) / 500**2 < 1.1  # K = 1: an amplitude of 1 where R_tx·R_rx is 500 m²
    True
    """
    import xarray as xr

    if not is_number(accuracy_db):
        raise CampaignError(
            quoted(accuracy_db),
            "backproject: accuracy_db",
            "a number, dB relative to the RMS of the exact sum",
            "Give -60, say.",
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
        expected="choices of ImagingChoices",
    )
    # Inputs and scene, checked.
    inputs = inputs_of(profiles, choices.window)
    inputs = replace(inputs, aperture=inputs.aperture.copied())  # the image is lazy, and the caller's arrays may change
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
    # Certificate: random pixels against the exact sum, the plan's next setting where they miss the accuracy.
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
            sure = f"up to {error.bound_db:.1f} dB ({CONFIDENCE:.0%} sure)"
            flags["accuracy_not_met"] = f"{sure}, {accuracy_db:g} dB asked"
    # Judgement of focus, and attributes.
    error_db = attributes.get("numerical_error_db")
    judged = _judged(formation, judge, error_db=error_db)
    flags = Flags.merged(flags, plan.flags, judged.flags)
    focus = focus_with_flags({"verdict": judged.verdict, "why": judged.why}, flags, error_db=error_db)
    attributes |= {
        "units": "1",
        "wave_speed_m_s": inputs.wave_speed_m_s,
        "long_name": "focused scene, carrier kept",
        "grid_mapping": "spatial_ref",
        "setting": formation.plan.setting.line,
        "predicted_error_db": round(formation.plan.predicted_error_db, 2),
        "models": json.dumps(formation.plan.reasons, ensure_ascii=False),
        "flags": json.dumps(flags, ensure_ascii=False),
        "verdict": focus["verdict"],
        "verdict_why": focus["why"],
        "budget": json.dumps(judged.budget, ensure_ascii=False),
    }
    lazy = formation.image
    lazy.dask.layers[lazy.name].origin = formation  # for apertura.judge
    image = xr.DataArray(lazy, grid.coordinates, ("y", "x"), name="image", attrs=attributes)
    if calibration is None or history is None:
        return image
    return image.assign_coords(_calibrated(image.data, formation, history, ground, calibration))


def _check_kinds(inputs: PhaseHistory | Profiles, beams: Any, certified_pixels: Any) -> None:
    """Raise CampaignError unless beams and number of pixels are such."""
    counted = isinstance(certified_pixels, Integral) and not isinstance(certified_pixels, bool)
    if not counted or not 0 <= certified_pixels <= _MOST_CERTIFIED:
        raise CampaignError(
            quoted(certified_pixels),
            "backproject: certified_pixels",
            f"a number of pixels, 0 to {_MOST_CERTIFIED}",
            "Give 0 for none.",
        )
    if beams is None:
        return
    if not isinstance(beams, Beams):
        raise CampaignError(
            f"an object of type {type(beams).__name__}", "backproject: beams", "Beams", "Leave it out, or make one."
        )
    for name, beam in (("transmit", beams.transmit), ("receive", beams.receive)):
        if beam is not None and len(beam.axes) != len(inputs):
            raise CampaignError(
                f"{len(beam.axes)} pulses",
                where=f"backproject: Beams.{name}",
                expected=f"the {len(inputs)} of the echo",
                remedy="Give one set of axes for each pulse.",
            )


_MOST_CERTIFIED = 1_000_000
"""Pixels that may be compared with the exact sum: a hundredth of them bounds the error as well."""

_SUM = 1e-3
"""Of 1, by which the sum of weights may be off: a hundredth of a decibel."""

_AT_ONCE_S = 10.0
"""Seconds that the plan may take for an image that is formed to be judged, where the caller does not say."""


def _judged(formation: Formation, asked: bool | str, *, error_db: float | None) -> Judgement:
    """Return the judgement of an image, or why there is none yet."""
    if not (isinstance(asked, bool) or asked == "auto"):
        raise CampaignError(quoted(asked), "backproject: judge", "True, False or 'auto'", "Take one of these.")
    lines = budget_by_hand(formation, error_db=error_db)
    seconds = formation.plan.predicted_seconds
    if asked is True or (asked == "auto" and seconds <= _AT_ONCE_S):
        return judgement(formation, np.asarray(formation.image), lines)
    why = "not asked for" if asked is False else f"the image takes {seconds:.2g} s"
    return Judgement("not judged", f"{why}: apertura.judge forms it", Flags(), [line.report for line in lines], {})


def _wave_speed(
    atmosphere: "Atmosphere | float | Literal['auto', 'vacuum']", grid: SceneGrid, ground: Terrain, aperture: Aperture
) -> float:
    """Return the speed of waves between the middle of a scene and the antennas."""
    middle_m = ground.positions_at(grid, *(np.array([size // 2]) for size in grid.shape))[0]
    frame = LOCAL if grid.crs == LOCAL else "ecef"
    ground_m = float(middle_m[2] if frame == LOCAL else geodetic_from_ecef(middle_m)[2])
    if not (is_number(atmosphere) or isinstance(atmosphere, Atmosphere)) and atmosphere not in ("auto", "vacuum"):
        raise CampaignError(
            quoted(atmosphere),
            where="backproject: atmosphere",
            expected="auto, vacuum, an Atmosphere, or N units at the ground",
            remedy="Take one of these.",
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
            remedy="Take that of Link.constant, or measure it on a reflector.",
        )
    if isinstance(inputs, PhaseHistory) and abs(float(inputs.weight.sum()) - 1) > _SUM:
        raise CampaignError(
            f"weights of the subcarriers whose sum is {float(inputs.weight.sum()):.4g}",
            where="backproject: calibration",
            expected="a sum of 1: a profile then peaks at the echo's amplitude, to which the constant refers",
            remedy="Divide PhaseHistory.weight by its sum.",
        )
    if isinstance(inputs, Profiles):
        raise CampaignError(
            "range profiles, whose window over the subcarriers is not known",
            where="backproject: calibration",
            expected="a PhaseHistory, or a stage echo",
            remedy="Leave the compression in range to backproject.",
        )


def _calibrated(
    image: Any, formation: Formation, history: PhaseHistory, ground: Terrain, constant: float
) -> dict[str, tuple[tuple[str, str], Any, dict[str, str]]]:
    """Return lazy σ⁰ and radar cross-section of an image, as coordinates."""
    grid, level = formation.grid, isinstance(ground, FlatGround)
    found = Calibration.of(
        grid,
        ground,
        history.aperture,
        formation.beams,
        constant=constant,
        cell_m2=cell_constant(history.frequency_hz, history.weight),
        count=formation.count,
    )

    def sigma0(window: Window) -> NDArray[np.float64]:
        return found.power(window, "sigma0", None if level else surface(grid, ground, window)[1])

    def scaled(block: NDArray[np.complex64], per_one: Any, block_info: Any) -> NDArray[np.float32]:
        rows, columns = (slice(*ends) for ends in block_info[0]["array-location"])
        return np.asarray(np.abs(block) ** 2 / per_one((rows, columns)), np.float32)

    meaning = {
        "sigma0": {
            "standard_name": CF_SIGMA0,
            "units": "1",
            "long_name": "radar cross-section of ground per area of ground, with noise",
        },
        "rcs": {"units": "m2", "long_name": "radar cross-section of a point at the pixel"},
    }
    return {
        name: (
            ("y", "x"),
            image.map_blocks(scaled, per_one, dtype=np.float32, meta=np.empty((0, 0), np.float32)),
            {**meaning[name], "grid_mapping": "spatial_ref"},
        )
        for name, per_one in (("sigma0", sigma0), ("rcs", found.rcs_power))
    }


def _certified(formation: Formation, accuracy_db: float, count: int) -> tuple[Formation, ErrorBound]:
    """Return the formation by the plan's first setting whose error bound meets the accuracy, or by the last."""
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
    """Return the error at pixels drawn blindly: they may miss what is bright, so it is no lower than predicted."""
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
    illumination = None if job.beams is None else illuminate(job.beams, job.aperture, job.points_m)
    return replace(job, illumination=illumination, memory_bytes=memory_limit())
