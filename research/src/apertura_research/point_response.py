"""Response to known targets without image formation: peaks, widths, coherence and error floor."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.engines import numba, reference
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.core.echo.demodulate import remove_path
from apertura.core.geometry.aperture import Aperture
from apertura.core.quality.measures import coherence_factor
from apertura.core.quality.point_targets import half_power_width, locate_maximum
from apertura_research.paper_scene import PaperScene, receive_undisturbed

SWATH_MARGIN_M = 6.0
"""Total path beyond the targets on both sides, for the neighbourhoods of the peaks and the taps of the engine."""

REACH_M = (0.16, 0.5)
"""Half widths, along and across the track, of the area in which a peak is searched; five steps of 10 cm across."""

_STEP_M = (0.02, 0.1)
_REFINEMENTS = 4


def phase_history(
    scene: PaperScene,
    transfer: Complexes,
    *,
    divided: bool = False,
    pulses: NDArray[np.bool_] | None = None,
    window: str = "none",
) -> PhaseHistory:
    """Return the phase history of total paths tx → target → rx with the logged phase centres of the scene.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64 of the kept pulses.
    divided
        True if the echoes were divided by the sidelink; its logged length is then restored.
    pulses
        (pulse,) bool, mask of the scene's pulses to keep; None: all.
    window
        Key of `apertura.core.echo.compression.WINDOWS`.
    """
    kept = slice(None) if pulses is None else pulses
    frequency_hz, geometry = scene.waveform.frequency_hz, scene.geometry
    if divided:
        sidelink_m = np.linalg.norm(geometry.sidelink_tx - geometry.sidelink_rx, axis=1)[kept]
        transfer = remove_path(transfer, frequency_hz, delay_s=-sidelink_m / SPEED_OF_LIGHT_M_S)
    weight = window_weights(window, len(frequency_hz))
    aperture = Aperture(geometry.radar_tx[kept], geometry.radar_rx[kept])
    return PhaseHistory(transfer, frequency_hz, weight, np.zeros(len(transfer)), aperture)


def range_tables(history: PhaseHistory, targets_m: Floats) -> numba.OversampledTables:
    """Return range tables for `numba.form` that cover the surroundings of every target, (target, 3) float64."""
    path_m = history.aperture.path(targets_m)
    step_m, length = range_step(history.frequency_hz, oversampling=2.0)
    start_m = path_m.min(axis=1) - SWATH_MARGIN_M
    swath_m = (path_m.max(axis=1) - start_m + SWATH_MARGIN_M).max()
    samples = compress(
        history.transfer,
        history.frequency_hz,
        weight=history.weight,
        reference_delay_s=history.reference_delay_s,
        start_m=start_m,
        count=min(length, int(np.ceil(swath_m / step_m))),
    )
    centre_hz, oversampling = centre_frequency(history.frequency_hz), length / len(history.frequency_hz)
    return numba.prepare(Profiles(samples, start_m, step_m, centre_hz, oversampling, history.aperture))


def undisturbed_tables(scene: PaperScene, *, window: str = "none") -> numba.OversampledTables:
    """Return the range tables of a scene without errors or noise."""
    history = phase_history(scene, receive_undisturbed(scene), window=window)
    return range_tables(history, scene.scatterers.position_m)


def pixels_around(centre_m: Floats, along_m: Floats, across_m: Floats) -> Floats:
    """Return pixels around a point at its height, (along, across, 3) float64."""
    along, across = np.meshgrid(along_m, across_m, indexing="ij")
    return np.asarray(centre_m + np.stack([along, across, np.zeros_like(along)], axis=-1))


def random_pixels(generator: Generator) -> Floats:
    """Draw uniformly distributed pixels in the area of the five targets, (1, 256, 3) float64."""
    along_m, across_m = generator.uniform(-6, 6, 256), generator.uniform(5, 25, 256)
    return np.column_stack([along_m, across_m, np.zeros(256)])[None]


def mean_image(tables: numba.OversampledTables, pixels_m: Floats) -> Complexes:
    """Return the image at pixels (y, x, 3), divided by the number of pulses."""
    return np.asarray(numba.form(tables, pixels_m) / len(tables.start_m), np.complex64)


def find_peaks(
    tables: numba.OversampledTables, targets_m: Floats, *, reach_m: tuple[float, float] = REACH_M
) -> tuple[Floats, Floats]:
    """Return positions (target, 3) and magnitudes (target,) of the maximum near each target.

    The matched filter is evaluated on a coarse grid, `reach_m` along and across the track, then three times on a
    finer grid about the highest pixel, so that no interpolation between pixels is needed.
    """
    peaks = [_find_peak(tables, target, reach_m) for target in targets_m]
    return np.stack([position for position, _ in peaks]), np.array([level for _, level in peaks])


def _find_peak(tables: numba.OversampledTables, target_m: Floats, reach_m: tuple[float, float]) -> tuple[Floats, float]:
    def level(along_m: Floats, across_m: Floats) -> Floats:
        return np.abs(mean_image(tables, np.stack([along_m, across_m, np.full_like(along_m, target_m[2])], axis=-1)))

    counts = tuple(2 * int(np.ceil(reach / step)) + 1 for reach, step in zip(reach_m, _STEP_M, strict=True))
    (along_m, across_m), highest = locate_maximum(
        level, (target_m[0], target_m[1]), reach_m, counts=(counts[0], counts[1]), rounds=_REFINEMENTS
    )
    return np.array([along_m, across_m, target_m[2]]), highest


def half_power_widths(image: Callable[[Floats], Complexes], peak_m: Floats) -> tuple[float, float]:
    """Return the −3 dB widths across (ground range) and along the track (cross-range) through a peak, metres.

    `image` returns values (y, x) complex64 at pixels (y, x, 3). A width is NaN if the main lobe extends beyond 1 m
    (across) or 0.4 m (along) on either side.
    """
    centre, across_m, along_m = np.zeros(1), np.linspace(-1, 1, 401), np.linspace(-0.4, 0.4, 401)
    across = np.abs(image(pixels_around(peak_m, centre, across_m))).ravel() ** 2
    along = np.abs(image(pixels_around(peak_m, along_m, centre))).ravel() ** 2
    across_step_m, along_step_m = across_m[1] - across_m[0], along_m[1] - along_m[0]
    return half_power_width(across, 200) * across_step_m, half_power_width(along, 200) * along_step_m


def coherence_factors(history: PhaseHistory, points_m: Floats) -> Floats:
    """Return the coherence factor Γ at each point (point, 3), from the pulse contributions to the double sum."""
    return np.array([coherence_factor(column) for column in reference.terms(history, points_m).T])


def error_floor_db(values: Complexes, ideal: Complexes, peaks: Floats) -> float:
    """Return the RMS error of an image after one complex gain, relative to its mean peak, dB.

    Parameters
    ----------
    values, ideal
        The image and the undisturbed image, complex64 of equal shape.
    peaks
        (target,) float64, magnitudes of the peaks.
    """
    gain = np.vdot(ideal, values) / np.vdot(ideal, ideal).real
    return float(amplitude_db(np.sqrt(np.mean(np.abs(values - gain * ideal) ** 2)) / peaks.mean()))


def amplitude_db(ratio: Floats | float) -> Floats:
    """Return 20·log10 of amplitude ratios, at least −200 dB."""
    return np.asarray(20 * np.log10(np.maximum(np.abs(ratio), 1e-10)))
