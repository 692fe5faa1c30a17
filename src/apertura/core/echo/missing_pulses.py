"""What pulses that are missing inside an aperture do to its image."""

import numpy as np

from apertura.core.echo.time_tags import Integers

LARGEST_SIDELOBE = 0.1
"""Of the peak, what missing pulses may add anywhere along the track: -20 dB, of a tenth of the aperture in a row."""


def missing_pulses(time_ns: Integers) -> tuple[int, float]:
    """Return how many pulses are missing between the first and the last, and the highest sidelobe that they add.

    Parameters
    ----------
    time_ns
        (pulse,) int64, ascending tags of the pulses that there are; most are one interval apart.

    Returns
    -------
    tuple
        Number of missing pulses; amplitude of the sidelobe relative to the peak.

    Notes
    -----
    The response of the aperture is that of all pulses less that of the missing ones:
    |Σ_missing exp(j2πkm/M)|/used at a cell or more from the peak, k ≥ 1. Source: docs/theory/planner.md, "Pulses".

    Examples
    --------
    >>> sent = np.arange(1000) * 50_000_000
    >>> missing_pulses(sent), missing_pulses(np.delete(sent, np.arange(400, 500)))
    ((0, 0.0), (100, 0.109...))
    """
    if time_ns.size < 3:
        return 0, 0.0
    steps = np.diff(time_ns)
    single = steps[np.abs(steps / np.median(steps) - 1) < 0.25].mean()
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / single), 1).astype(np.int64))])
    absent = np.ones(number[-1] + 1)
    absent[number] = 0
    response = np.abs(np.fft.rfft(absent, 4 * absent.size))[4:]
    return int(absent.sum()), float(response.max()) / time_ns.size


def missing_flags(time_ns: Integers) -> dict[str, str]:
    """Return a flag where missing pulses add sidelobes above `LARGEST_SIDELOBE`; parameters as `missing_pulses`."""
    flags = {}
    missing, sidelobe = missing_pulses(time_ns)
    if sidelobe > LARGEST_SIDELOBE:
        flags["pulses_missing"] = (
            f"{missing} of {missing + time_ns.size} pulses inside the aperture are missing: "
            f"sidelobes of up to {20 * np.log10(sidelobe):.0f} dB along the track"
        )
    return flags
