"""Range profiles of a scene: where each pulse's begins, how many samples it needs, and how they are computed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import centre_frequency, compress, range_step
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import Terrain

GUARD_SAMPLES = 32
"""Samples beyond the swath on both sides, for the filters of the engines."""

OVERSAMPLING = 2.0
"""Of the profiles: half the band is free for the transition of whatever filter an engine refines them with."""


@dataclass(frozen=True, eq=False)
class RangeWindow:
    """The total paths that profiles must cover.

    Attributes
    ----------
    start_m
        (pulse,) float64, total path of sample 0, metres.
    samples
        Of every pulse.
    step_m
        Total path between samples.
    unambiguous
        Samples after which the profile repeats itself.
    farthest_m
        (pulse,) float64, longest total path to what the pulse may add to, metres; -inf where that is nothing.
    """

    start_m: NDArray[np.float64]
    samples: int
    step_m: float
    unambiguous: int
    farthest_m: NDArray[np.float64]

    @property
    def contributing(self) -> NDArray[np.bool_]:
        """(pulse,) bool: whether a pulse may add to anything; the profile of one that does not is never looked at."""
        return np.isfinite(self.farthest_m)

    @classmethod
    def of(
        cls,
        aperture: Aperture,
        grid: SceneGrid,
        terrain: Terrain,
        frequency_hz: NDArray[np.float64],
        *,
        beams: Beams | None = None,
    ) -> "RangeWindow":
        """Return the window that a scene needs.

        Parameters
        ----------
        aperture
            Phase centres in the frame of the pixels.
        grid, terrain
            The scene.
        frequency_hz
            (subcarrier,) float64, ascending in equal steps.
        beams
            What weighs pulses: each pulse's window covers what it may add to. By default it covers all of the scene.

        Notes
        -----
        Source: docs/theory.md, eq. 4.
        """
        nearest, farthest = swath(grid, terrain, aperture, beams=beams)
        step, length = range_step(frequency_hz, oversampling=OVERSAMPLING)
        spans = farthest - nearest
        samples = int(np.ceil(spans.max(initial=0.0, where=np.isfinite(spans)) / step)) + 2 * GUARD_SAMPLES + 1
        nearest = np.where(np.isfinite(nearest), nearest, 0.0)
        return cls(nearest - GUARD_SAMPLES * step, samples, step, length, farthest)


def range_compress(
    history: PhaseHistory, grid: SceneGrid, terrain: Terrain, *, window: RangeWindow | None = None
) -> Profiles:
    """Return range profiles of calibrated transfer functions, cropped to a scene.

    Parameters
    ----------
    history
        Transfer functions with their window over the subcarriers.
    grid, terrain
        The scene.
    window
        Total paths to cover; those of the scene by default.

    Returns
    -------
    Profiles
        Twice oversampled, with 32 guard samples on both sides of the swath.

    Raises
    ------
    ValueError
        If the scene is deeper than the unambiguous range.

    Notes
    -----
    Source: docs/theory.md, eq. 4 and 4a.

    Examples
    --------
    >>> from apertura.core.scene.terrain import FlatGround
    >>> frequency = 1.2e9 + 1e6 * np.arange(128)
    >>> track = np.stack([np.linspace(-1, 1, 8), np.full(8, -20.0), np.full(8, 10.0)], -1)
    >>> flown = Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * flown.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(8), flown)
    >>> profiles = range_compress(history, SceneGrid("local", -5.0, 5.0, 0.5, (20, 20)), FlatGround(0.0))
    >>> len(profiles), round(float(np.abs(profiles.samples).max()), 1)
    (8, 1.0)
    """
    frequency = history.frequency_hz
    window = window or RangeWindow.of(history.aperture, grid, terrain, frequency)
    if window.samples > window.unambiguous:
        raise ValueError(
            f"the scene spans {window.samples} samples of range: must be at most the {window.unambiguous} unambiguous"
        )
    samples = compress(
        history.transfer,
        frequency,
        weight=history.weight,
        reference_delay_s=history.reference_delay_s,
        start_m=window.start_m,
        count=window.samples,
        oversampling=OVERSAMPLING,
    )
    return Profiles(
        samples,
        window.start_m,
        window.step_m,
        centre_frequency(frequency),
        window.unambiguous / len(frequency),
        history.aperture,
    )
