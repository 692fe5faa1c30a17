"""Resolutions of the paper's tables, measured in simulated images beside their closed forms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from apertura.simulation.recording import Geometry
from apertura.simulation.scene import Scatterers
from apertura.study.bench import Bench, Case, Complexes, paper_bench, receive_pair
from apertura.study.focus import Floats, find_peaks, half_power_widths, history, mean_image, range_tables, widths_of
from apertura.study.paper.claims import Claim, compare
from apertura.study.paper.formulas import HALF_POWER_OF_HANN, cross_range_resolution_m, ground_range_resolution_m

GROUND_CM = (43.7, 30.2, 32.0, 30.7, 33.4)
CROSS_CM = (5.51, 6.34, 7.12, 8.45, 9.51)
UAV_TARGET_M = np.array([[0.0, 11.5, 0.0]])
UAV_HEIGHT_M = 4.8
"""Within the 4.5 to 5 m of the flight."""

UAV_APERTURE_M = 3.4
MONO_SEGMENT_M, BISTATIC_MIDPOINT_M, SEGMENT_LENGTH_M, SEPARATION_M = -1.88, 4.38, 4.7, 4.7


def simulated_table(*, pulses: int = 600) -> list[Claim]:
    """Return ground-range and cross-range widths of the five targets, closed forms beside.

    Parameters
    ----------
    pulses
        Of the 3000; widths do not change from 150 on.
    """
    bench = paper_bench(pulses=pulses, subcarriers=256)
    radar, _, _ = receive_pair(bench, Case(), np.random.default_rng(0))
    targets = bench.scatterers.position_m
    tables = range_tables(history(bench, radar), targets)
    peaks, _ = find_peaks(tables, targets)
    band_hz = len(bench.frequency_hz) * bench.waveform.subcarrier_spacing_hz
    height_m, aperture_m = bench.geometry.radar_tx[0, 2], float(np.ptp(bench.geometry.radar_tx[:, 0]))
    rows = []
    for peak, ground_cm, cross_cm in zip(peaks, GROUND_CM, CROSS_CM, strict=True):
        ground, cross = (100 * width for width in half_power_widths(tables, peak))
        place = f"target at ({peak[0]:.0f}, {peak[1]:.0f}) m"
        closed = 100 * ground_range_resolution_m(band_hz, peak[1], height_m)
        note = f"closed form 0.886·c/2B·R/r_g {closed:.1f} cm: a long aperture is finer, as it adds look angles"
        rows.append(compare(f"{place}: ground-range width", ground_cm, ground, "cm", within=0.05, note=note))
        slant = float(np.hypot(peak[1], height_m))
        closed = 100 * cross_range_resolution_m(float(bench.frequency_hz.mean()), slant, aperture_m)
        note = f"closed form 0.886·λR/2L {closed:.2f} cm holds for short apertures"
        rows.append(compare(f"{place}: cross-range width", cross_cm, cross, "cm", within=0.05, note=note))
    return rows


def uav_table(*, pulses: int = 200) -> list[Claim]:
    """Return the widths of the UAV flight with a Hann window, mono and fused.

    Parameters
    ----------
    pulses
        Per segment.
    """
    slant = float(np.hypot(UAV_TARGET_M[0, 1], UAV_HEIGHT_M))
    bench = paper_bench(pulses=pulses, subcarriers=512)
    band_hz = len(bench.frequency_hz) * bench.waveform.subcarrier_spacing_hz
    middle_hz = float(bench.frequency_hz.mean())
    ground, cross = (100 * width for width in _uav_widths([_segment(bench, 0.0, UAV_APERTURE_M)]))
    closed = 100 * ground_range_resolution_m(band_hz, UAV_TARGET_M[0, 1], UAV_HEIGHT_M, half_power=HALF_POWER_OF_HANN)
    whole = 100 * cross_range_resolution_m(middle_hz, slant, UAV_APERTURE_M)
    other = 100 * cross_range_resolution_m(middle_hz, slant, SEGMENT_LENGTH_M)
    contradiction = (
        f"the paper contradicts itself: its table's L = 3.4 m gives {whole:.1f} cm by the closed form; "
        f"{other:.1f} cm would be L = 4.7 m"
    )
    fused = _uav_widths(
        [
            _segment(bench, MONO_SEGMENT_M, SEGMENT_LENGTH_M),
            _segment(bench, BISTATIC_MIDPOINT_M - SEPARATION_M / 2, SEGMENT_LENGTH_M, rx_ahead_m=SEPARATION_M),
        ]
    )
    where = "mono segment at −1.88 m, bistatic midpoint at +4.38 m, L = 4.7 m, coherent sum"
    return [
        compare(
            "UAV flight: ground-range width, Hann, mono",
            57.6,
            ground,
            "cm",
            within=0.05,
            note=f"closed form {closed:.1f} cm",
        ),
        compare("UAV flight: cross-range width of L = 3.4 m", 34.8, cross, "cm", within=0.05, note=contradiction),
        compare("UAV flight: cross-range width as printed", 25, cross, "cm", within=0.05, note=contradiction),
        compare("UAV flight: fused cross-range width", 11, 100 * fused[1], "cm", within=0.05, note=where),
        compare("UAV flight: fused ground-range width", 49, 100 * fused[0], "cm", within=0.05, note=where),
    ]


def _segment(bench: Bench, middle_m: float, length_m: float, *, rx_ahead_m: float = 0.0) -> Bench:
    along = middle_m + np.linspace(-length_m / 2, length_m / 2, len(bench.geometry.radar_tx))
    sender = np.column_stack([along, np.zeros_like(along), np.full_like(along, UAV_HEIGHT_M)])
    receiver = sender + [rx_ahead_m, 0.0, 0.0]
    target = Scatterers(UAV_TARGET_M, np.ones(1, np.complex128))
    return replace(bench, scatterers=target, geometry=Geometry(sender, receiver, sender, receiver))


def _uav_widths(segments: list[Bench]) -> tuple[float, float]:
    """Return the widths of the coherent sum of peak-normalised images."""
    images = [_normalised(segment) for segment in segments]
    return widths_of(lambda pixels: np.asarray(sum(image(pixels) for image in images)), UAV_TARGET_M[0])


def _normalised(bench: Bench) -> Callable[[Floats], Complexes]:
    radar, _, _ = receive_pair(bench, Case(), np.random.default_rng(0))
    tables = range_tables(history(bench, radar, window="hann"), UAV_TARGET_M)
    peak = np.abs(mean_image(tables, UAV_TARGET_M[None]))[0, 0]
    return lambda pixels: np.asarray(mean_image(tables, pixels) / peak)
