"""Clock offset and path offset of a recorder without a known point, by maximum sharpness of the terrain image."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.backprojection.engines import load_engine
from apertura.core.backprojection.inputs import Profiles
from apertura.core.echo.compression import centre_frequency, compress, range_step
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.alignment.on_point import (
    MOST_PULSES,
    Alignment,
    alignment_flags,
    offset_steps,
    peak_widths,
    refine_maximum,
)
from apertura.methods.autofocus.motion import Logged, Recorded, plausible_offsets

MOST_PIXELS = 96
"""Maximum pixels along a side of the coarse image on which offsets are tried."""

_OVERSAMPLING = 2.0  # oversampling of range profiles
_ABOUT_CELLS = 8  # half a side of the fine image about the brightest point, range cells
_FINE = 4  # pixels per range cell of the fine image
_MAXIMA = 3  # number of maxima of the coarse search that are refined


@dataclass(frozen=True, eq=False)
class SceneSharpness:
    """Sharpness of an image as a function of clock offset and path.

    Attributes
    ----------
    profiles
        Range profiles of the recorder over the whole range, (pulse, range), with a placeholder as aperture.
    time_s
        (pulse,) float64, seconds of the recorder's clock.
    log
        Antenna positions on the log's clock.
    places_m
        (y, x, 3) float64, pixel positions in metres, in the frame of the antennas.
    """

    profiles: Profiles
    time_s: Floats
    log: Logged
    places_m: Floats

    @classmethod
    def of(cls, echo: Recorded, log: Logged, places_m: Floats) -> "SceneSharpness":
        """Return the sharpness function of echoes; the pulses are range compressed once."""
        frequency = echo.frequency_hz
        speed = echo.wave_speed_m_s
        step_m, length = range_step(frequency, oversampling=_OVERSAMPLING, wave_speed_m_s=speed)
        taper = np.hanning(frequency.size + 2)[1:-1]
        start_m = echo.reference_delay_s * speed
        samples = compress(
            echo.transfer,
            frequency,
            weight=taper / taper.sum(),
            reference_delay_s=echo.reference_delay_s,
            start_m=start_m,
            count=length,
            oversampling=_OVERSAMPLING,
            wave_speed_m_s=speed,
        )
        placeholder = log.phase_centres(np.full(len(echo), log.first_s))
        profiles = Profiles(samples, start_m, step_m, centre_frequency(frequency), _OVERSAMPLING, placeholder, speed)
        return cls(profiles, echo.time_s, log, places_m)

    def image(self, offset_s: float, path_m: float) -> NDArray[np.complex64]:
        """Return the image at the pixels; each pulse is weighted by the distance flown between pulses."""
        at_s = self.time_s + offset_s
        kept = self.log.inside(at_s)
        speed = self.log.speeds_m_s(at_s)[kept]
        weight = (speed / max(float(speed.sum()), 1e-30)).astype(np.float32)
        engine = load_engine("native")
        if not engine.available():
            engine = load_engine("numba")
        at_offset = replace(
            self.profiles,
            samples=self.profiles.samples[kept] * weight[:, None],
            start_m=self.profiles.start_m[kept] - path_m,
            aperture=self.log.phase_centres(at_s[kept]),
        )
        return np.asarray(np.nan_to_num(engine.form(engine.prepare(at_offset), self.places_m)))

    def value(self, offset_s: float, path_m: float) -> float:
        """Return the sharpness: mean squared power over squared mean power; 2 for speckle, more for points."""
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
    """Estimate the clock offset and path at which the image of the terrain is sharpest, without a known point.

    Parameters
    ----------
    echo, log
        Echoes on the recorder's clock; antenna positions on the log's clock.
    grid, terrain
        Grid and terrain of the scene, which must contain bright points.
    within_s
        Smallest and largest offset to search, seconds.
    search_m
        Largest magnitude of the searched path offsets, metres; 0 keeps the path offset fixed.

    Raises
    ------
    ValueError
        If no offset puts half of the pulses inside the log.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". Only the curvature of a point's phase history separates the
    path offset, the clock offset and the position of the point; therefore, the aperture must not be short compared with
    the distance.
    """
    pulses = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    low, high = plausible_offsets(echo, log, within_s)
    bandwidth_hz = float(echo.frequency_hz[-1] - echo.frequency_hz[0])
    cell_m = echo.wave_speed_m_s / (2 * bandwidth_hz)
    # Sharpness of a coarse image of the scene over offsets and paths.
    coarse = SceneSharpness.of(pulses, log, _coarse(grid, terrain, cell_m))
    offsets_s = offset_steps(pulses, log, low, high)[::2]
    paths_m = np.arange(-search_m, search_m + cell_m, 2 * cell_m) if search_m > 0 else np.zeros(1)
    values = np.array([[coarse.value(offset_s, path_m) for path_m in paths_m] for offset_s in offsets_s])
    steps = float(offsets_s[1] - offsets_s[0]), 2 * cell_m if search_m > 0 else 0.0
    # Best maxima of the coarse search, each refined about the brightest point of its image; the highest peak is kept.
    maxima = []
    for index in np.argsort(-values, axis=None)[:_MAXIMA]:
        row, column = np.unravel_index(int(index), values.shape)
        start = refine_maximum(coarse.value, float(offsets_s[row]), float(paths_m[column]), steps)
        fine = replace(coarse, places_m=_about(coarse, start, grid, terrain, cell_m))
        refined = refine_maximum(fine.value, *start, (steps[0] / 2, steps[1] / 2))
        maxima.append((float(np.abs(fine.image(*refined)).max()), fine, refined))
    peak, fine, refined = max(maxima, key=lambda maximum: maximum[0])
    widths = peak_widths(fine.value, *refined, steps)
    image = np.abs(fine.image(*refined))
    contrast_db = 20 * float(np.log10(peak / max(float(np.median(np.abs(coarse.image(*refined)))), 1e-300)))
    brightest = fine.places_m[np.unravel_index(int(image.argmax()), image.shape)]
    report = {"method": "sharpness", "plausible_s": [round(low, 3), round(high, 3)], "pulses": len(pulses)}
    flags = alignment_flags(values.max(axis=1), offsets_s, refined[0], widths[0], contrast_db)
    return Alignment(*refined, *widths, contrast_db, report | {"brightest_m": brightest.tolist()}, flags=flags)


def _coarse(grid: SceneGrid, terrain: Terrain, cell_m: float) -> Floats:
    """Return pixels (y, x, 3) spaced by at least one range cell, at most `MOST_PIXELS` on a side."""
    step = max(1, round(cell_m / grid.spacing_m), -(-max(grid.shape) // MOST_PIXELS))
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    return terrain.positions_at(grid, *np.meshgrid(rows, columns, indexing="ij"))


def _about(
    coarse: SceneSharpness, start: tuple[float, float], grid: SceneGrid, terrain: Terrain, cell_m: float
) -> Floats:
    """Return fine pixels about the brightest point of the coarse image."""
    image = np.abs(coarse.image(*start))
    down, right = np.unravel_index(int(image.argmax()), image.shape)
    step = max(1, round(cell_m / grid.spacing_m), -(-max(grid.shape) // MOST_PIXELS))
    step_px = cell_m / (_FINE * grid.spacing_m)
    around = np.arange(-_ABOUT_CELLS * _FINE, _ABOUT_CELLS * _FINE + 1) * step_px
    row, column = (step // 2 + step * index for index in (down, right))
    return terrain.positions_at(grid, *np.meshgrid(row + around, column + around, indexing="ij"))
