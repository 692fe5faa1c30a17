"""Expected outcome of a refinement before a flight: measured limits of docs/theory/autofocus.md, "Where it ends"."""

import math
from collections.abc import Iterable

from apertura.methods.autofocus.inputs import TrackErrors

LARGEST_ERROR_WAVES = 0.19
"""Standard deviation of positions per axis over the wavelength, above which refinements fail: 4 cm at 21 cm."""

SHORTEST_ERROR_S, SHORTEST_ERROR_PULSES = 0.5, 10
"""Correlation time of position errors below which refinements fail, seconds and pulses."""

LEAST_POINTS, LEAST_SNR_DB = 3, 10.0
"""Bright points in the scene, and SNR of each in one pulse, at which refinements succeeded."""

_REMAINDERS_DB = ((0.096, -0.3), (LARGEST_ERROR_WAVES, -0.5))
"""Error over the wavelength → loss that remains at places no fit uses: 2 and 4 cm at 21 cm."""


def expected_remainder(
    errors: Iterable[TrackErrors], *, wavelength_m: float, pulse_interval_s: float
) -> tuple[float, list[str]]:
    """Return the loss that a refinement of tracks is expected to leave, and what prevents the refinement.

    Parameters
    ----------
    errors
        Of the logs of all nodes of a flight.
    wavelength_m
        Of the band centre.
    pulse_interval_s
        Between pulses that make the image.

    Returns
    -------
    loss_db
        By position errors after the refinement, 0 or less; NaN where something prevents it.
    obstacles
        Measured limits that the flight exceeds, one phrase each; empty where none is exceeded.

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
        obstacles.append(f"position errors with a correlation time of {shortest_s:.2g} s, less than {least_s:.2g} s")
    if obstacles:
        return math.nan, obstacles
    return next(db for waves, db in _REMAINDERS_DB if largest_m <= waves * wavelength_m * (1 + 1e-9)), []
