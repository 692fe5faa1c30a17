"""Patterns of antennas: a Gaussian beam of given width or sampled cuts, and the axes they are counted from."""

import numpy as np
from numpy.typing import NDArray

Cut = tuple[NDArray[np.float64], NDArray[np.float64]]
"""One cut through a pattern: equally spaced angles (rad) and field relative to its peak."""

LIMITS_RAD = {"azimuth": np.pi, "elevation": np.pi / 2}
"""How far from the boresight each cut may reach."""

_SAMPLES = 513  # linear between them errs by -100 dB with a cutoff of -20 dB
_FINE = 4097  # 0.09° of a whole turn


def antenna_axes(body_axes: NDArray[np.float64], boresight_deg: tuple[float, float]) -> NDArray[np.float64]:
    """Return the axes of an antenna as `Beam` counts them.

    Parameters
    ----------
    body_axes
        (pulse, 3, 3) float64; columns are the body's forward, right and down unit vectors in the frame of the pixels.
    boresight_deg
        Azimuth clockwise from forward and elevation above the forward-right plane, degrees.

    Returns
    -------
    ndarray
        (pulse, 3, 3) float64; rows are unit vectors along boresight, growing azimuth (in the forward-right plane) and
        growing elevation.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas".

    Examples
    --------
    >>> antenna_axes(np.eye(3)[None], (90.0, -30.0)).round(3)[0] + 0.0  # to the right and down
    array([[ 0.   ,  0.866,  0.5  ],
           [-1.   ,  0.   ,  0.   ],
           [ 0.   ,  0.5  , -0.866]])
    """
    azimuth, elevation = np.radians(boresight_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    below = np.array([0.0, 0.0, 1.0])
    axes = np.stack(
        [
            np.cos(elevation) * ahead - np.sin(elevation) * below,
            np.array([-ahead[1], ahead[0], 0.0]),
            -np.sin(elevation) * ahead - np.cos(elevation) * below,
        ]
    )
    return np.asarray(np.einsum("pij,aj->pai", body_axes, axes))


def gaussian_cut(width_deg: float, *, cutoff_db: float, limit_rad: float) -> Cut:
    """Return a Gaussian cut: -12.04 (angle/width)² dB, out to where that is `cutoff_db`.

    Parameters
    ----------
    width_deg
        Full width at half power, degrees.
    cutoff_db
        Gain at which the cut ends, dB relative to its peak.
    limit_rad
        Where it ends at the latest.

    Examples
    --------
    >>> angle, gain = gaussian_cut(20.0, cutoff_db=-20.0, limit_rad=np.pi)
    >>> round(float(np.interp(np.radians(10.0), angle, gain)) ** 2, 4), np.degrees(angle[-1]).round(1)
    (0.5, np.float64(25.8))
    """
    steepness = np.log(4) / np.radians(width_deg) ** 2
    reach = min(limit_rad, float(np.sqrt(-cutoff_db / 20 * np.log(10) / steepness)))
    angle = np.linspace(-reach, reach, _SAMPLES)
    return angle, np.exp(-steepness * angle**2)


def sampled_cut(angle_deg: NDArray[np.float64], gain_db: NDArray[np.float64], *, cutoff_db: float) -> Cut:
    """Return the main lobe of a sampled cut: about its peak, as far as its gain stays at or above `cutoff_db`.

    Parameters
    ----------
    angle_deg
        (sample,) float64, growing, degrees from boresight.
    gain_db
        (sample,) float64, dB, whatever it is relative to; linear between samples.
    cutoff_db
        Gain at which the cut ends, dB relative to its peak.

    Notes
    -----
    The sign of the field changes behind a null and a gain in dB does not tell it: what lies there is left out.

    Examples
    --------
    >>> angle, gain = sampled_cut(np.array([-30.0, 0, 10, 20, 30]), np.array([-30.0, 5, 2, -25, -5]), cutoff_db=-10)
    >>> np.degrees(angle[[0, -1]]).round(1), gain.max().round(3)
    (array([-8.6, 12.6]), np.float64(1.0))
    """
    fine = np.linspace(angle_deg[0], angle_deg[-1], _FINE)
    level = np.interp(fine, angle_deg, gain_db - gain_db.max())
    peak, low = int(level.argmax()), np.flatnonzero(level < cutoff_db)
    first = int(low[low < peak].max(initial=-1)) + 1
    last = int(low[low > peak].min(initial=_FINE))
    return np.radians(fine[first:last]), 10 ** (level[first:last] / 20)
