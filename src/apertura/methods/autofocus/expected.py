"""Prediction of a refinement before a flight by measured limits: docs/theory/autofocus.md, "Limits of the method"."""

import math
from collections.abc import Iterable

from apertura.methods.autofocus.inputs import TrackErrors

LARGEST_ERROR_WAVES = 0.19
"""Standard deviation of positions per axis, in wavelengths, above which refinements fail: 4 cm at a wavelength of
21 cm."""

SHORTEST_ERROR_S, SHORTEST_ERROR_PULSES = 0.5, 10
"""Correlation time of position errors below which refinements fail, in seconds and in pulses."""

LEAST_POINTS, LEAST_SNR_DB = 3, 10.0
"""Number of bright points in the scene, and single-pulse SNR of each, at which refinements succeeded."""

_REMAINDERS_DB = ((0.096, -0.3), (LARGEST_ERROR_WAVES, -0.5))
"""Position error in wavelengths → residual loss at points outside the fit; measured with 2 and 4 cm at 21 cm."""


def expected_remainder(
    errors: Iterable[TrackErrors], *, wavelength_m: float, pulse_interval_s: float
) -> tuple[float, list[str]]:
    """Return the expected residual loss after a refinement of tracks, and the limits that prevent a refinement.

    Parameters
    ----------
    errors
        Error statistics of the logs of all nodes of a flight.
    wavelength_m
        Wavelength at the band centre.
    pulse_interval_s
        Interval of the pulses used for the image.

    Returns
    -------
    loss_db
        Loss due to position errors after the refinement, 0 or less; NaN if a limit is exceeded.
    obstacles
        Measured limits that the flight exceeds, one phrase for each limit.

    Examples
    --------
    >>> expected_remainder([TrackErrors((0.02,) * 3, 1.0)], wavelength_m=0.21, pulse_interval_s=0.02)
    (-0.3, [])
    >>> expected_remainder([TrackErrors((0.3,) * 3, 100.0)], wavelength_m=0.21, pulse_interval_s=0.02)
    (nan, ['position errors of 30 cm exceed 4 cm, 0.19 wavelengths'])
    """
    logs = list(errors)
    largest_m = max(max(error.std_m) for error in logs)
    shortest_s = min(error.correlation_s for error in logs)
    obstacles = []
    if largest_m > LARGEST_ERROR_WAVES * wavelength_m:
        most = f"{100 * LARGEST_ERROR_WAVES * wavelength_m:.2g} cm, {LARGEST_ERROR_WAVES:g} wavelengths"
        obstacles.append(f"position errors of {100 * largest_m:.2g} cm exceed {most}")
    least_s = max(SHORTEST_ERROR_S, SHORTEST_ERROR_PULSES * pulse_interval_s)
    if shortest_s < least_s:
        obstacles.append(f"the correlation time of position errors, {shortest_s:.2g} s, is below {least_s:.2g} s")
    if obstacles:
        return math.nan, obstacles
    return next(db for waves, db in _REMAINDERS_DB if largest_m <= waves * wavelength_m * (1 + 1e-9)), []
