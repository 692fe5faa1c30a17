"""Quality assessment of an image without ground truth: focus, unfocused echoes, error budget, and their flags."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import is_number
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.core.geometry.atmosphere import USUAL_N
from apertura.core.imaging.focus_check import focus_flags, focus_report
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.view import ground_axes
from apertura.core.quality.budget import (
    BudgetLine,
    NodePositions,
    antenna_flags,
    arithmetic_line,
    expected,
    height_line,
    offset_line,
    position_lines,
)
from apertura.core.quality.focus import focus_with_flags
from apertura.core.quality.path_errors import PointPaths

if TYPE_CHECKING:
    import xarray as xr

_CM = 1e-2
# assumed duration of an aperture without times: ten times the correlation time of position errors, one second
_APERTURE_S = 10.0


@dataclass(frozen=True)
class Judgement:
    """Quality assessment of an image.

    Attributes
    ----------
    verdict
        'focused', 'defocused' or 'inconclusive' (not observable).
    reason
        Reason for the verdict, one line.
    flags
        Exceeded limit → measured value, as listed in docs/flags.md.
    budget
        Error sources, each with its configured or assumed size and its effects `loss_db`, `shift_m` and `phase_rad`.
    focus
        Section `focus` of image.json: loss, its standard deviation, the loss expected from the budget, and each bright
        point.
    """

    verdict: str
    reason: str
    flags: Flags
    budget: list[dict[str, Any]]
    focus: dict[str, Any]


def judgement(formation: Formation, target: Any, lines: Sequence[BudgetLine]) -> Judgement:
    """Assess an image: implementation shared by the step `image` of a campaign and by `judge`.

    Parameters
    ----------
    formation
        Formation of the image.
    target
        (y, x) complex64, the image, which is read by blocks.
    lines
        Error budget of the image.
    """
    focus, effect = focus_report(formation, target), expected(lines)
    focus |= {"expected_db": round(effect.loss_db, 3), "expected_std_db": round(effect.loss_std_db, 3)}
    focus |= {"expected_shift_m": round(effect.shift_m, 3)}
    still = formation.plan.flags.get("no_aperture")
    if still:  # the image has range resolution only: focus measures of points are meaningless
        focus = {key: value for key, value in focus.items() if key not in {"loss_db", "std_db", "elsewhere", "points"}}
        focus |= {"verdict": "inconclusive", "reason": f"no aperture: {still}", "points": []}
    flags = Flags.merged(antenna_flags(lines), {} if still else focus_flags(focus, effect))
    focus = focus_with_flags(focus, flags)
    return Judgement(focus["verdict"], focus["reason"], flags, [line.report for line in lines], focus)


def judge(
    image: "xr.DataArray", *, position_std_m: float | None = None, time_s: NDArray[np.float64] | None = None
) -> Judgement:
    """Assess the quality of an image of `backproject` without ground truth; the whole image is computed.

    Parameters
    ----------
    image
        Lazy result of `apertura.backproject`; the graph of the array contains the echoes, the phase centres and the
        terrain. For a lazy selection or function of this image, the whole image is assessed.
    position_std_m
        Standard deviation of the phase centres in each axis, metres, from which the expected loss is computed
        (default: not stated; no loss is expected).
    time_s
        (pulse,) float64, transmit times of the pulses, seconds; position errors have a correlation time of one second.

    Returns
    -------
    Judgement
        Verdict, reason, flags, budget and focus.

    Raises
    ------
    CampaignError
        If the graph of the array contains no image of `backproject` or several images, or if position_std_m is given
        without time_s.

    Notes
    -----
    Source: docs/theory/focus.md.

    Examples
    --------
    >>> import apertura as ap
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> aperture, grid = ap.Aperture(track, track), ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100))
    >>> echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), aperture)
    >>> ap.judge(ap.backproject(history, grid)).verdict
    'focused'
    >>> conjugated = ap.PhaseHistory(echo.conj(), frequency, np.full(256, 1 / 256), np.zeros(128), aperture)
    >>> list(ap.judge(ap.backproject(conjugated, grid)).flags)
    ['echo_outside_scene']
    """
    formation = _formation_of(image)
    valid = position_std_m is None or (is_number(position_std_m) and position_std_m >= 0)
    if not valid or (position_std_m is not None and time_s is None):
        raise CampaignError(
            f"position_std_m of {position_std_m!r}{' without times' if time_s is None else ''}",
            where="judge",
            expected="a number of metres, with the transmit time of each pulse in time_s",
            remedy="Pass both arguments, or neither.",
        )
    pulses = len(formation.profiles)
    if time_s is not None and np.shape(time_s) != (pulses,):
        raise CampaignError(
            f"shape {np.shape(time_s)}", "judge: time_s", f"times of {pulses} pulses", "Pass one time per pulse."
        )
    if time_s is not None:
        times = np.asarray(time_s)
        if times.dtype.kind not in "iuf" or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            expected = "finite, strictly increasing times in seconds, from any origin"
            found = f"times of type {times.dtype}, or not finite, or not increasing"
            raise CampaignError(found, "judge: time_s", expected, "Subtract the first time, in seconds.")
    error_db = image.attrs.get("numerical_error_db")
    lines = budget_by_hand(formation, error_db=error_db, position_std_m=position_std_m, time_s=time_s)
    return judgement(formation, np.asarray(formation.image), lines)


def budget_by_hand(
    formation: Formation,
    *,
    error_db: float | None,
    position_std_m: float | None = None,
    time_s: NDArray[np.float64] | None = None,
) -> list[BudgetLine]:
    """Return the error budget of an image of arrays, without a campaign configuration.

    Parameters
    ----------
    formation
        Formation of the image.
    error_db
        Numerical error of the image; None: not measured.
    position_std_m, time_s
        As for `judge`.
    """
    point_m, (east, north) = ground_axes(formation, *((size - 1) / 2 for size in formation.grid.shape))
    profiles = formation.profiles
    aperture = profiles.aperture
    seconds = np.linspace(0, _APERTURE_S, len(aperture)) if time_s is None else np.asarray(time_s, np.float64)
    axes = np.stack([east, north, np.cross(east, north)])
    paths = PointPaths.of(aperture, seconds, point_m=point_m, axes=axes, wavelength_m=profiles.wavelength_m)
    stated = None if position_std_m is None else (position_std_m,) * 3
    is_monostatic = aperture.tx_m is aperture.rx_m or np.array_equal(*aperture.legs)
    nodes = [NodePositions(stated, stated_by="caller")] * (1 if is_monostatic else 2)
    cm_of_path = np.full(len(paths.time_s), _CM)
    return [
        *position_lines(paths, nodes, sidelink=False),
        height_line(paths, None),
        offset_line(paths, "calibration", cm_of_path, None, unit="cm", quantity="path error"),
        _air_line(paths, profiles.wave_speed_m_s),
        *([] if error_db is None else [arithmetic_line(error_db)]),
    ]


_OTHER_N = 20.0
"""Typical deviation of the refractivity from the standard atmosphere, N units."""


def _air_line(paths: PointPaths, wave_speed_m_s: float) -> BudgetLine:
    """Return the budget line of the atmosphere: neglected refractivity, or deviation from the assumed refractivity."""
    in_vacuum = math.isclose(wave_speed_m_s, SPEED_OF_LIGHT_M_S, rel_tol=1e-9)
    units = USUAL_N if in_vacuum else _OTHER_N
    path_m = sum(np.linalg.norm(leg - paths.point_m, axis=1) for leg in paths.aperture.legs)
    unit = f"a refractivity of {units:.0f} N units, with vacuum assumed" if in_vacuum else f"{units:.0f} N units"
    return BudgetLine("atmosphere", None, paths.of_offset(1e-6 * units * path_m, common=True), unit=unit)


def _formation_of(image: Any) -> Formation:
    """Return the image formation contained in the graph of an image."""
    graph = getattr(getattr(image, "data", None), "dask", None)
    layers: Iterable[Any] = getattr(graph, "layers", {}).values()
    formations = [layer.origin for layer in layers if getattr(layer, "origin", None) is not None]
    if len(formations) != 1:
        raise CampaignError(
            "a graph with several images"
            if formations
            else f"an object of type {type(image).__name__} without an image",
            where="judge",
            expected="one image of apertura.backproject, not yet computed",
            remedy="Pass the lazy image returned by backproject to judge before computing it.",
        )
    formation: Formation = formations[0]
    return formation
