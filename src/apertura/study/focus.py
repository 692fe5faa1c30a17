"""What a study wants of an image without forming it: peaks, widths and coherence of known targets."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.echo.demodulate import remove_path
from apertura.focus.engines import numba, reference
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.geometry.aperture import Aperture
from apertura.quality.measures import coherence_factor
from apertura.quality.point_targets import half_power_width
from apertura.study.bench import Bench, Complexes

Floats = NDArray[np.float64]

SWATH_MARGIN_M = 6.0
"""Total path kept beyond the targets on both sides: the patches, and the taps of the engine."""

REACH_M = (0.16, 0.5)
"""How far along and across the track a peak is looked for; five steps of 10 cm across."""

_STEP_M = (0.02, 0.1)


@dataclass(frozen=True)
class History:
    """A pair's corrected transfer functions, and where their antennas were.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64, of the total path tx → target → rx.
    frequency_hz
        (subcarrier,) float64, RF.
    tx_position_m, rx_position_m
        (pulse, 3) float64.
    window
        Key of `apertura.echo.compression.WINDOWS`.
    """

    transfer: Complexes
    frequency_hz: Floats
    tx_position_m: Floats
    rx_position_m: Floats
    window: str = "none"


def history(bench: Bench, transfer: Complexes, *, window: str = "none") -> History:
    """Return transfer functions of total paths with the phase centres of the bench's logs."""
    return History(transfer, bench.frequency_hz, bench.geometry.radar_tx, bench.geometry.radar_rx, window)


def divided_history(bench: Bench, transfer: Complexes, *, pulses: NDArray[np.bool_] | None = None) -> History:
    """Return what a sidelink correction left, brought back to total paths by the logged length of the sidelink.

    Parameters
    ----------
    bench
        Where the logs say the antennas are.
    transfer
        (pulse, subcarrier) complex64 of the kept pulses.
    pulses
        (pulse,) bool, which are kept; None: all.
    """
    kept = np.ones(len(bench.sidelink_m), bool) if pulses is None else pulses
    total = remove_path(transfer, bench.frequency_hz, delay_s=-bench.sidelink_m[kept] / SPEED_OF_LIGHT_M_S)
    geometry = bench.geometry
    return History(total, bench.frequency_hz, geometry.radar_tx[kept], geometry.radar_rx[kept])


def range_tables(observed: History, targets_m: Floats) -> numba.Tables:
    """Return range tables that cover some metres around every target, for `numba.form`."""
    path = total_path(observed, targets_m)
    step, length = range_step(observed.frequency_hz, oversampling=2.0)
    start = path.min(axis=1) - SWATH_MARGIN_M
    count = min(length, int(np.ceil((path.max(axis=1) - start + SWATH_MARGIN_M).max() / step)))
    samples = compress(
        observed.transfer,
        observed.frequency_hz,
        weight=window_weights(observed.window, len(observed.frequency_hz)),
        reference_delay_s=np.zeros(len(start)),
        start_m=start,
        count=count,
    )
    profiles = Profiles(
        samples,
        start,
        step,
        centre_frequency(observed.frequency_hz),
        length / len(observed.frequency_hz),
        Aperture(observed.tx_position_m, observed.rx_position_m),
    )
    return numba.prepare(profiles)


def total_path(observed: History, points_m: Floats) -> Floats:
    """Return (pulse, point) float64 metres tx → point → rx."""
    sides = (observed.tx_position_m, observed.rx_position_m)
    return np.asarray(sum(np.linalg.norm(side[:, None] - points_m, axis=2) for side in sides))


def pixels_around(centre_m: Floats, along_m: Floats, across_m: Floats) -> Floats:
    """Return (along, across, 3) float64 pixels on the ground around a point."""
    along, across = np.meshgrid(along_m, across_m, indexing="ij")
    return np.asarray(centre_m + np.stack([along, across, np.zeros_like(along)], axis=-1))


def mean_image(tables: numba.Tables, pixels_m: Floats) -> Complexes:
    """Return the image at (y, x, 3) pixels, per pulse."""
    return np.asarray(numba.form(tables, pixels_m) / len(tables.start_m), np.complex64)


def find_peaks(
    tables: numba.Tables, targets_m: Floats, *, reach_m: tuple[float, float] = REACH_M
) -> tuple[Floats, Floats]:
    """Return positions (target, 3) and magnitudes (target,) of the maxima near each target.

    The matched filter is evaluated on a coarse grid, then three times on a finer one about the best pixel: no
    image is formed and nothing is interpolated between pixels.
    """
    found = [_find_peak(tables, target, reach_m) for target in targets_m]
    return np.stack([place for place, _ in found]), np.array([level for _, level in found])


def _find_peak(tables: numba.Tables, target_m: Floats, reach_m: tuple[float, float]) -> tuple[Floats, float]:
    place, reach = target_m, reach_m
    counts = [2 * int(np.ceil(far / step)) + 1 for far, step in zip(reach_m, _STEP_M, strict=True)]
    level = 0.0
    for _ in range(4):
        pixels = pixels_around(place, *(np.linspace(-far, far, n) for far, n in zip(reach, counts, strict=True)))
        power = np.abs(mean_image(tables, pixels))
        best = np.unravel_index(int(power.argmax()), power.shape)
        place, level = pixels[best], float(power[best])
        reach = (2 * reach[0] / (counts[0] - 1), 2 * reach[1] / (counts[1] - 1))
        counts = [9, 9]
    return place, level


def half_power_widths(tables: numba.Tables, peak_m: Floats) -> tuple[float, float]:
    """Return the −3 dB widths across (ground range) and along the track (cross-range) through a peak, metres."""
    return widths_of(lambda pixels: mean_image(tables, pixels), peak_m)


def widths_of(image: Callable[[Floats], Complexes], peak_m: Floats) -> tuple[float, float]:
    """Return the −3 dB widths across and along the track of any function of pixels, metres.

    NaN where the main lobe is wider than 1 m (across) or 0.4 m (along) to either side.
    """
    still, across_m, along_m = np.zeros(1), np.linspace(-1, 1, 401), np.linspace(-0.4, 0.4, 401)
    across = np.abs(image(pixels_around(peak_m, still, across_m))).ravel() ** 2
    along = np.abs(image(pixels_around(peak_m, along_m, still))).ravel() ** 2
    across_step_m, along_step_m = across_m[1] - across_m[0], along_m[1] - along_m[0]
    return half_power_width(across, 200) * across_step_m, half_power_width(along, 200) * along_step_m


def coherence_factors(observed: History, points_m: Floats) -> Floats:
    """Return Γ at each of (point, 3), from what each pulse adds there by the double sum."""
    weight = window_weights(observed.window, len(observed.frequency_hz))
    spectra = PhaseHistory(
        observed.transfer,
        observed.frequency_hz,
        weight,
        np.zeros(len(observed.transfer)),
        Aperture(observed.tx_position_m, observed.rx_position_m),
    )
    added = reference.terms(spectra, points_m)
    return np.array([coherence_factor(column) for column in added.T])


def decibels(amplitude_ratio: Floats | float) -> Floats:
    """Return 20·log10, at least −200 dB."""
    return np.asarray(20 * np.log10(np.maximum(np.abs(amplitude_ratio), 1e-10)))
