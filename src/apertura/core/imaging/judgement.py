"""What an image says of itself: focus, echoes that it does not show, error budget, and the flags of all of them."""

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
_APERTURE_S = 10.0  # taken for the time flown where nobody says it: an error of one second lasts a tenth of it


@dataclass(frozen=True)
class Judgement:
    """What an image says of itself.

    Attributes
    ----------
    verdict
        focused, defocused, or cannot tell.
    why
        One line: the reason for the verdict.
    flags
        Limit crossed → what was measured, as docs/flags.md lists them.
    budget
        Causes of error, each with what is stated or assumed, `loss_db`, `shift_m` and `phase_rad`.
    focus
        Section `focus` of image.json: loss, its deviation, that expected by the budget, bright points one by one.
    """

    verdict: str
    why: str
    flags: Flags
    budget: list[dict[str, Any]]
    focus: dict[str, Any]


def judgement(formation: Formation, target: Any, lines: Sequence[BudgetLine]) -> Judgement:
    """Return what an image says of itself: the step `image` of a campaign and `judge` ask the same.

    Parameters
    ----------
    formation
        Formation of the image.
    target
        (y, x) complex64, the image; read by blocks.
    lines
        Its error budget.
    """
    focus, spoilt = focus_report(formation, target), expected(lines)
    focus |= {"expected_db": round(spoilt.loss_db, 3), "expected_std_db": round(spoilt.loss_std_db, 3)}
    focus |= {"expected_shift_m": round(spoilt.shift_m, 3)}
    still = formation.plan.flags.get("no_aperture")
    if still:  # a range per echo and no place: nothing that points say of focus would be true
        focus = {key: value for key, value in focus.items() if key not in {"loss_db", "std_db", "elsewhere", "points"}}
        focus |= {"verdict": "cannot tell", "why": f"no aperture: {still}", "points": []}
    flags = Flags.merged(antenna_flags(lines), {} if still else focus_flags(focus, spoilt))
    focus = focus_with_flags(focus, flags)
    return Judgement(focus["verdict"], focus["why"], flags, [line.report for line in lines], focus)


def judge(
    image: "xr.DataArray", *, position_std_m: float | None = None, time_s: NDArray[np.float64] | None = None
) -> Judgement:
    """Return what an image of `backproject` says of itself, without truth; forms all of it.

    Parameters
    ----------
    image
        Of `apertura.backproject`, still lazy: its graph holds the echoes, the phase centres and the ground. What was
        selected from it or computed of it, lazily, is judged by the whole image.
    position_std_m
        Standard deviation of the phase centres in each axis, metres: the loss that it explains is then expected. By
        default nothing is stated, and none is.
    time_s
        (pulse,) float64, seconds: when pulses were sent; an error of position lasts a second.

    Returns
    -------
    Judgement
        verdict, why, flags, budget and focus.

    Raises
    ------
    CampaignError
        If the array has no image of `backproject` in its graph, or several; or a deviation is stated without times.

    Notes
    -----
    Source: docs/theory/focus.md.

    Examples
    --------
    >>> import apertura as ap
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> flown, grid = ap.Aperture(track, track), ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100))
    >>> echo = np.exp(-2j * np.pi * frequency * flown.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), flown)
    >>> ap.judge(ap.backproject(history, grid)).verdict
    'focused'
    >>> conjugated = ap.PhaseHistory(echo.conj(), frequency, np.full(256, 1 / 256), np.zeros(128), flown)
    >>> list(ap.judge(ap.backproject(conjugated, grid)).flags)
    ['echo_outside_scene']
    """
    formation = _formation_of(image)
    stated = position_std_m is None or (is_number(position_std_m) and position_std_m >= 0)
    if not stated or (position_std_m is not None and time_s is None):
        raise CampaignError(
            f"position_std_m of {position_std_m!r}{' without times' if time_s is None else ''}",
            where="judge",
            expected="metres, with time_s, when each pulse was sent: errors that change within a flight defocus",
            remedy="Give both, or none.",
        )
    pulses = len(formation.profiles)
    if time_s is not None and np.shape(time_s) != (pulses,):
        raise CampaignError(
            f"shape {np.shape(time_s)}", "judge: time_s", f"seconds of each of {pulses} pulses", "Give one per pulse."
        )
    if time_s is not None:
        times = np.asarray(time_s)
        if times.dtype.kind not in "iuf" or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            found = f"{times.dtype}, or not all finite and rising"
            raise CampaignError(found, "judge: time_s", "seconds of any origin", "Subtract the first time, in seconds.")
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
    """Return the error budget of an image of arrays: nobody states more than positions, and what is measured.

    Parameters
    ----------
    formation
        Formation of the image.
    error_db
        Its numerical error; None: not measured.
    position_std_m, time_s
        As `judge`.
    """
    point_m, (east, north) = ground_axes(formation, *((size - 1) / 2 for size in formation.grid.shape))
    profiles = formation.profiles
    aperture = profiles.aperture
    seconds = np.linspace(0, _APERTURE_S, len(aperture)) if time_s is None else np.asarray(time_s, np.float64)
    axes = np.stack([east, north, np.cross(east, north)])
    paths = PointPaths.of(aperture, seconds, point_m=point_m, axes=axes, wavelength_m=profiles.wavelength_m)
    stated = None if position_std_m is None else (position_std_m,) * 3
    alike = aperture.tx_m is aperture.rx_m or np.array_equal(*aperture.legs)
    nodes = [NodePositions(stated, stated_by="caller")] * (1 if alike else 2)
    cm_of_path = np.full(len(paths.time_s), _CM)
    return [
        *position_lines(paths, nodes, sidelink=False),
        height_line(paths, None),
        offset_line(paths, "calibration", cm_of_path, None, unit="cm of path"),
        _air_line(paths, profiles.wave_speed_m_s),
        *([] if error_db is None else [arithmetic_line(error_db)]),
    ]


_OTHER_N = 20.0
"""N units by which the air of a day differs from a standard atmosphere."""


def _air_line(paths: PointPaths, wave_speed_m_s: float) -> BudgetLine:
    """Return the effect of air where the wave speed is that in vacuum, else of other air than was stated."""
    in_vacuum = math.isclose(wave_speed_m_s, SPEED_OF_LIGHT_M_S, rel_tol=1e-9)
    units = USUAL_N if in_vacuum else _OTHER_N
    path_m = sum(np.linalg.norm(leg - paths.point_m, axis=1) for leg in paths.aperture.legs)
    words = f"air of N = {units:.0f}, where vacuum is assumed," if in_vacuum else f"{units:.0f} N units"
    return BudgetLine("atmosphere", None, paths.of_offset(1e-6 * units * path_m, common=True), unit=words)


def _formation_of(image: Any) -> Formation:
    """Return the formation that the graph of an image holds."""
    graph = getattr(getattr(image, "data", None), "dask", None)
    layers: Iterable[Any] = getattr(graph, "layers", {}).values()
    found = [layer.origin for layer in layers if getattr(layer, "origin", None) is not None]
    if len(found) != 1:
        what = "several images" if found else f"an object of type {type(image).__name__}, without one in its graph"
        raise CampaignError(
            what,
            where="judge",
            expected="an image of apertura.backproject that is not computed: its graph holds what it was formed of",
            remedy="Judge what backproject returns, then compute it.",
        )
    formation: Formation = found[0]
    return formation
