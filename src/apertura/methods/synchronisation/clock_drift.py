"""By how much a recorder's clock runs slow against its log's: what offset alone leaves, found on a long recording."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.motion import Logged, Recorded
from apertura.methods.synchronisation.clock_alignment import MOST_PULSES, Alignment, Gathering, offset_step_s

Floats = NDArray[np.float64]

MOST_PPM = 200.0
"""Crystals are better."""


def drifting(time_s: Floats, drift_ppm: float) -> Floats:
    """Return times of a recorder whose clock is slow by `drift_ppm`, as its middle has them.

    Examples
    --------
    >>> drifting(np.array([0.0, 50.0, 100.0]), 20.0).round(6).tolist()
    [-0.001, 50.0, 100.001]
    """
    middle_s = (time_s[0] + time_s[-1]) / 2
    return np.asarray(middle_s + (time_s - middle_s) * (1 + drift_ppm * 1e-6))


def with_drift(found: Alignment, echo: Recorded, log: Logged, point_m: Floats) -> Alignment:
    """Return an alignment with the drift at which echoes add up best at a known point, or that none can be told.

    Parameters
    ----------
    found
        Without drift.
    echo, log
        What was recorded, and flown.
    point_m
        (3,) float64, metres, in the frame of the antennas.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". Drift is taken about the middle of the recording, where it
    does not pull at the offset; what is returned counts from the first pulse, as config/clocks.tsv does. A drift that
    moves no path by an eighth of a wave over half of the recording is not sought.
    """
    from scipy.optimize import minimize  # slow to import

    some = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    time_s = some.time_s
    half_s = float(time_s[-1] - time_s[0]) / 2
    step_ppm = 1e6 * offset_step_s(echo, log) / max(half_s, 1e-12)
    if step_ppm > MOST_PPM:
        return replace(found, report={**found.report, "drift": f"cannot be told: {step_ppm:.0f} ppm move no path"})

    def power(ppm: float, offset_s: float, path_m: float) -> float:
        times_s = drifting(time_s, ppm)
        return Gathering(replace(some, time_s=times_s), log, point_m).power(offset_s, path_m)

    tried = np.arange(-MOST_PPM, MOST_PPM + step_ppm, step_ppm)
    at = found.offset_s, found.path_m
    best = float(tried[int(np.argmax([power(ppm, *at) for ppm in tried]))])
    steps = np.array([found.offset_width_s / 2, max(found.path_width_m, 0.0) / 2, step_ppm])
    free = np.flatnonzero(steps)

    def moved(by: Floats) -> tuple[float, float, float]:
        full = np.zeros(3)
        full[free] = by
        offset_s, path_m, ppm = np.array([*at, best]) + full * steps
        return float(offset_s), float(path_m), float(ppm)

    def falls(by: Floats) -> float:
        offset_s, path_m, ppm = moved(by)
        return -power(ppm, offset_s, path_m)

    simplex = np.vstack([np.zeros(free.size), np.eye(free.size)])
    done = minimize(falls, np.zeros(free.size), method="Nelder-Mead", options={"initial_simplex": simplex})
    offset_s, path_m, ppm = moved(done.x)
    gain_db = 10 * float(np.log10(-done.fun / max(power(0.0, *at), 1e-300)))
    first_s = float(drifting(time_s, ppm)[0] - time_s[0])
    report = {**found.report, "drift": f"{gain_db:.2f} dB better than without"}
    return replace(found, offset_s=offset_s + first_s, path_m=path_m, drift_ppm=ppm, report=report)
