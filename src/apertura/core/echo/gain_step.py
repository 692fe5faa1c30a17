"""Persistent steps of the power of pulses by changes of the gain: docs/theory/recordings.md, eq. 10."""

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.errors import number_of
from apertura.common.flags import Flags

LEAST_STEP_DB = 3.0
"""Minimum step of the power between adjacent pulses, dB."""

_NEAR_PULSES, _FAR_PULSES = 5, 32  # pulses before and after a step whose medians are compared
_FEWEST_PULSES = 8  # fewest pulses on each side
_SIGMAS = 6.0  # steps relative to the fluctuation of the power from pulse to pulse
_NEIGHBOURS = 2.0  # steps relative to the largest change of the surrounding pulses: fades change many pulses
_GAP = 1.5  # interval relative to the median interval, above which pulses are not adjacent


def gain_step_flags(power: Floats, time_s: Floats) -> Flags:
    """Detect persistent steps of the power of pulses, and raise the flag `gain_step`.

    Parameters
    ----------
    power
        (pulse,) float64, mean power of each pulse; 0 for pulses without data.
    time_s
        (pulse,) float64, ascending times of the pulses, seconds.

    Notes
    -----
    Source: docs/theory/recordings.md, eq. 10. The power of echoes changes slowly, because the antenna moves by a
    fraction of its length between pulses; a short disturbance does not change the medians of the pulses after it.

    Examples
    --------
    >>> gain_step_flags(np.where(np.arange(200) < 120, 1.0, 16.0), 0.01 * np.arange(200))["gain_step"]
    'power +12.0 dB from pulse 121 of 200 on, 1.200 s after the first pulse, in 1 step'
    """
    numbers = np.flatnonzero(power > 0)
    if len(numbers) < 2 * _FEWEST_PULSES:
        return Flags()
    level_db, interval_s = 10 * np.log10(power[numbers]), np.diff(time_s[numbers])
    change_db = np.diff(level_db)
    fluctuation_db = 1.4826 * float(np.median(np.abs(change_db - np.median(change_db))))
    limit_db = max(LEAST_STEP_DB, _SIGMAS * fluctuation_db)
    adjacent = interval_s < _GAP * np.median(interval_s)
    steps = dict[int, float]()
    for first in (np.flatnonzero((np.abs(change_db) >= limit_db) & adjacent) + 1).tolist():
        is_at_end = min(first, len(level_db) - first) < _FEWEST_PULSES
        if is_at_end or any(first - earlier < _NEAR_PULSES for earlier in steps):
            continue
        # Changes of the surrounding pulses, without those next to the step, over which a step may be divided.
        before, after = max(0, first - 2 - _NEAR_PULSES), first + 1
        around_db = np.concatenate([change_db[before : first - 2], change_db[after : after + _NEAR_PULSES]])
        if abs(change_db[first - 1]) < _NEIGHBOURS * np.abs(around_db).max():
            continue
        # Eq. 10: change between adjacent pulses, and between the medians of few and of many pulses.
        changes_db = np.array(
            [change_db[first - 1]]
            + [
                np.median(level_db[first : first + count]) - np.median(level_db[max(0, first - count) : first])
                for count in (_NEAR_PULSES, _FAR_PULSES)
            ]
        )
        if (np.sign(change_db[first - 1]) * changes_db).min() >= limit_db:
            steps[first] = float(changes_db[-1])
    if not steps:
        return Flags()
    first, step_db = max(steps.items(), key=lambda step: abs(step[1]))
    pulse = int(numbers[first])
    line = (
        f"power {step_db:+.1f} dB from pulse {pulse + 1} of {len(power)} on, {time_s[pulse] - time_s[0]:.3f} s after "
        f"the first pulse, in {number_of(len(steps), 'step')}"
    )
    return Flags({"gain_step": line})
