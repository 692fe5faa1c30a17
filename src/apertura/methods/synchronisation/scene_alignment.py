"""A recorder's clock and path where no point is known: offset and path at which the image of the ground is sharpest."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import centre_frequency, compress, range_step
from apertura.core.focus.engines import load_engine
from apertura.core.focus.inputs import Profiles
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.motion import Logged, Recorded, plausible_offsets
from apertura.methods.synchronisation.clock_alignment import (
    MOST_PULSES,
    Alignment,
    doubts,
    offset_steps,
    polished,
    widths,
)

MOST_PIXELS = 96
"""Along a side of the image that offsets are tried on."""

_OVERSAMPLING = 2.0
_ABOUT_CELLS = 8  # of range, about the brightest place, that decide in the end
_FINE = 4  # pixels in a cell there
_BEST = 3  # places of the search that are followed to their tops


@dataclass(frozen=True, eq=False)
class SceneSharpness:
    """How sharp an image of some places is, by offset and path.

    Attributes
    ----------
    profiles
        Of the recorder, (pulse, range), over all of its range; their aperture means nothing yet.
    time_s
        (pulse,) float64, seconds by the recorder.
    log
        What was flown.
    places_m
        (y, x, 3) float64, metres in the frame of the antennas.
    """

    profiles: Profiles
    time_s: Floats
    log: Logged
    places_m: Floats

    @classmethod
    def of(cls, echo: Recorded, log: Logged, places_m: Floats) -> "SceneSharpness":
        """Return it for echoes; pulses are compressed once."""
        frequency = echo.frequency_hz
        step_m, length = range_step(frequency, oversampling=_OVERSAMPLING)
        taper = np.hanning(frequency.size + 2)[1:-1]
        start_m = echo.reference_delay_s * SPEED_OF_LIGHT_M_S
        samples = compress(
            echo.transfer,
            frequency,
            weight=taper / taper.sum(),
            reference_delay_s=echo.reference_delay_s,
            start_m=start_m,
            count=length,
            oversampling=_OVERSAMPLING,
        )
        anywhere = log.placed(np.full(len(echo), log.first_s))
        profiles = Profiles(samples, start_m, step_m, centre_frequency(frequency), _OVERSAMPLING, anywhere)
        return cls(profiles, echo.time_s, log, places_m)

    def image(self, offset_s: float, path_m: float) -> NDArray[np.complex64]:
        """Return the image of the places, pulses weighed by the way flown."""
        at_s = self.time_s + offset_s
        kept = self.log.inside(at_s)
        speed = self.log.speeds_m_s(at_s)[kept]
        weight = (speed / max(float(speed.sum()), 1e-30)).astype(np.float32)
        engine = load_engine("native")
        if not engine.available():
            engine = load_engine("numba")
        seen = replace(
            self.profiles,
            samples=self.profiles.samples[kept] * weight[:, None],
            start_m=self.profiles.start_m[kept] - path_m,
            aperture=self.log.placed(at_s[kept]),
        )
        return np.asarray(np.nan_to_num(engine.form(engine.prepare(seen), self.places_m)))

    def value(self, offset_s: float, path_m: float) -> float:
        """Return the sharpness: mean square power over the mean power squared; 2 for speckle, more for points."""
        power = np.abs(self.image(offset_s, path_m)).astype(np.float64) ** 2
        return float((power**2).mean() / max(float(power.mean()) ** 2, 1e-300))


def align_on_scene(
    echo: Recorded,
    log: Logged,
    grid: SceneGrid,
    terrain: Terrain,
    *,
    within_s: tuple[float, float],
    search_m: float,
) -> Alignment:
    """Return the offset and the path at which the image of the ground is sharpest; no place in it is known.

    Parameters
    ----------
    echo, log
        What was recorded, and flown.
    grid, terrain
        The scene, which holds what is bright.
    within_s
        Offsets that are thought possible.
    search_m
        Paths of either sign up to this are considered, metres; 0: none is sought.

    Raises
    ------
    ValueError
        If no offset puts half of the pulses inside the log.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". Paths are told from offsets, and places from paths, by the
    curvature of a point's history alone: the aperture must not be short against the distance.
    """
    some = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    low, high = plausible_offsets(echo, log, within_s)
    bandwidth_hz = float(echo.frequency_hz[-1] - echo.frequency_hz[0])
    cell_m = SPEED_OF_LIGHT_M_S / (2 * bandwidth_hz)
    coarse = SceneSharpness.of(some, log, _coarse(grid, terrain, cell_m))
    offsets_s = offset_steps(some, log, low, high)[::2]
    paths_m = np.arange(-search_m, search_m + cell_m, 2 * cell_m) if search_m > 0 else np.zeros(1)
    values = np.array([[coarse.value(offset_s, path_m) for path_m in paths_m] for offset_s in offsets_s])
    steps = float(offsets_s[1] - offsets_s[0]), 2 * cell_m if search_m > 0 else 0.0
    tops = []
    for place in np.argsort(-values, axis=None)[:_BEST]:
        row, column = np.unravel_index(int(place), values.shape)
        start = polished(coarse.value, float(offsets_s[row]), float(paths_m[column]), steps)
        fine = replace(coarse, places_m=_about(coarse, start, grid, terrain, cell_m))
        found = polished(fine.value, *start, (steps[0] / 2, steps[1] / 2))
        tops.append((float(np.abs(fine.image(*found)).max()), fine, found))
    peak, fine, found = max(tops, key=lambda top: top[0])
    apart = widths(fine.value, *found, steps)
    image = np.abs(fine.image(*found))
    contrast_db = 20 * float(np.log10(peak / max(float(np.median(np.abs(coarse.image(*found)))), 1e-300)))
    brightest = fine.places_m[np.unravel_index(int(image.argmax()), image.shape)]
    report = {"method": "sharpness", "plausible_s": [round(low, 3), round(high, 3)], "pulses": len(some)}
    flags = doubts(values.max(axis=1), offsets_s, found[0], apart[0], contrast_db)
    return Alignment(*found, *apart, contrast_db, report | {"brightest_m": brightest.tolist()}, flags=flags)


def _coarse(grid: SceneGrid, terrain: Terrain, cell_m: float) -> Floats:
    """Return places (y, x, 3) a cell apart, or farther where the scene has more of them than are tried."""
    step = max(1, round(cell_m / grid.spacing_m), -(-max(grid.shape) // MOST_PIXELS))
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    return terrain.positions_at(grid, *np.meshgrid(rows, columns, indexing="ij"))


def _about(
    coarse: SceneSharpness, start: tuple[float, float], grid: SceneGrid, terrain: Terrain, cell_m: float
) -> Floats:
    """Return fine places about the brightest of an image."""
    image = np.abs(coarse.image(*start))
    down, right = np.unravel_index(int(image.argmax()), image.shape)
    step = max(1, round(cell_m / grid.spacing_m), -(-max(grid.shape) // MOST_PIXELS))
    apart = cell_m / (_FINE * grid.spacing_m)
    around = np.arange(-_ABOUT_CELLS * _FINE, _ABOUT_CELLS * _FINE + 1) * apart
    row, column = (step // 2 + step * place for place in (down, right))
    return terrain.positions_at(grid, *np.meshgrid(row + around, column + around, indexing="ij"))
