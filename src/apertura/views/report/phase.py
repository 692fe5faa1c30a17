"""Phase of the brightest target from pulse to pulse, before and after what corrects it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.views.report.sheet import BLUE, GREEN, GREY, ORANGE, column_of, sheet, thinned

_COLOURS = (ORANGE, BLUE, GREEN)


def sidelink_error_rad(
    phase_rad: NDArray[np.float64], length_m: NDArray[np.float64], *, wavenumber_rad_m: float
) -> NDArray[np.float64]:
    """Return by how much clocks and triggers turn each pulse, as its sidelink tells.

    Parameters
    ----------
    phase_rad
        (pulse,) float64, of the sidelink at mid-band, radians.
    length_m
        (pulse,) float64, of the sidelink by the logs, metres.
    wavenumber_rad_m
        2π f_mid/c, radians per metre.

    Returns
    -------
    ndarray
        (pulse,) float64, radians, not wrapped.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "What the sidelink takes out".

    Examples
    --------
    >>> sidelink_error_rad(np.array([0.3 - 4.0]), np.array([2.0]), wavenumber_rad_m=2.0).round(6)
    array([0.3])
    """
    return phase_rad + wavenumber_rad_m * length_m


def steadiness(phasors: NDArray[np.complex128]) -> tuple[float, float]:
    """Return how far a target's phase scatters, rms radians about its mean, and |Σz|/Σ|z|; NaN without an echo.

    Parameters
    ----------
    phasors
        (pulse,) complex, what each pulse adds at the target.

    Examples
    --------
    >>> steadiness(np.array([1, 1, 1], complex)), round(steadiness(np.exp(1j * np.array([-0.1, 0.1])))[0], 3)
    ((0.0, 1.0), 0.1)
    """
    size = np.abs(phasors)
    if not size.sum() > 0:
        return float("nan"), float("nan")
    mean = phasors.sum()
    off = np.angle(phasors * np.conj(mean)) if abs(mean) > 0 else np.angle(phasors)
    return float(np.sqrt((size * off**2).sum() / size.sum())), float(abs(mean) / size.sum())


def draw_phase(
    path: Path,
    time_s: NDArray[np.float64],
    phasors: Mapping[str, NDArray[np.complex128]],
    *,
    title: str,
    tags: Mapping[str, str],
) -> None:
    """Draw the phase of a target in each pulse, one drawing below the other for each stage of correction, as a PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    time_s
        (pulse,) float64, seconds from the first pulse.
    phasors
        What was corrected so far → (pulse,) complex, what each pulse adds at the target.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    some = thinned(len(time_s))
    with sheet(path, 0.6 + 1.55 * len(phasors), title=title, tags=tags) as figure:
        drawn = column_of(figure, len(phasors))
        for axes, colour, (name, values) in zip(drawn, _COLOURS, phasors.items(), strict=False):
            rms, together = steadiness(values)
            turned = np.angle(values[some] * np.conj(values.sum() or 1))
            axes.plot(time_s[some], turned, ".", color=colour, markersize=2)
            axes.axhline(0, color=GREY, linewidth=0.6)
            axes.set(
                title=f"{name}: {rms:.2f} rad rms, {100 * together:.0f} % add up",
                ylabel="phase, rad",
                ylim=(-1.05 * np.pi, 1.05 * np.pi),
                yticks=[-np.pi, 0, np.pi],
                yticklabels=["−π", "0", "π"],
            )
            axes.margins(x=0)
        drawn[-1].set_xlabel("time from the first pulse, s")
