"""Resolutions of the paper's scene and flight, measured in simulated images and compared with closed forms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from apertura.common.arrays import Complexes, Floats
from apertura.simulation.synthesis import straight_pair
from apertura.simulation.targets import Scatterers
from apertura_research.paper.claims import Claim, compare, fitted_to
from apertura_research.paper.parameters import (
    HALF_POWER_OF_HANN,
    cross_range_resolution_m,
    ground_range_resolution_m,
)
from apertura_research.paper_scene import PaperScene, reduced_scene
from apertura_research.point_response import find_peaks, half_power_widths, mean_image, undisturbed_tables

WITHIN = 0.05
"""Relative tolerance of widths."""

GROUND_CM = (43.7, 30.2, 32.0, 30.7, 33.4)
CROSS_CM = (5.51, 6.34, 7.12, 8.45, 9.51)
"""Widths of the five targets in an independent model."""

UAV_TARGET_M = np.array([[0.0, 11.5, 0.0]])
UAV_HEIGHT_M = 4.8
"""Height of the simulated tracks; the flight was at 4.5 to 5 m."""

UAV_APERTURE_M = 3.4
MONO_SEGMENT_M, BISTATIC_MIDPOINT_M, SEGMENT_LENGTH_M = -1.88, 4.38, 4.7
"""Fitted to the paper's fused widths; the paper states none of the three."""

SEPARATION_M = 4.7


def simulated_table(*, pulses: int = 600) -> list[Claim]:
    """Compare the ground- and cross-range widths of the five targets with an independent model and closed forms.

    The widths converge with 150 of the paper's 3000 pulses.
    """
    scene = reduced_scene(pulses=pulses, subcarriers=256)
    targets = scene.scatterers.position_m
    tables = undisturbed_tables(scene)
    peaks, _ = find_peaks(tables, targets)
    height_m, aperture_m = scene.geometry.radar_tx[0, 2], float(np.ptp(scene.geometry.radar_tx[:, 0]))
    middle_hz = float(scene.waveform.frequency_hz.mean())
    rows, closed_cm, crosses_cm = [], [], []
    for peak, ground_cm, cross_cm in zip(peaks, GROUND_CM, CROSS_CM, strict=True):
        ground, cross = (100 * width for width in half_power_widths(lambda at: mean_image(tables, at), peak))
        title = f"target at ({peak[0]:.0f}, {peak[1]:.0f}) m"
        closed = 100 * ground_range_resolution_m(_bandwidth_hz(scene), peak[1], height_m)
        closed_cm.append(closed)
        crosses_cm.append(cross)
        note = f"closed form 0.886·c/2B·R/r_g {closed:.1f} cm: longer apertures resolve more finely"
        name = f"{title}: ground-range width"
        rows.append(compare(name, ground, "cm", independent_model=ground_cm, within=WITHIN, note=note))
        closed = 100 * cross_range_resolution_m(middle_hz, float(np.hypot(peak[1], height_m)), aperture_m)
        note = f"closed form 0.886·λR/2L {closed:.2f} cm holds for short apertures"
        name = f"{title}: cross-range width"
        rows.append(compare(name, cross, "cm", independent_model=cross_cm, within=WITHIN, note=note))
    return [*_printed_table(closed_cm, crosses_cm), *rows]


def uav_table(*, pulses: int = 200) -> list[Claim]:
    """Return the widths of the UAV flight with a Hann window, monostatic and fused, from `pulses` per segment."""
    scene = reduced_scene(pulses=pulses, subcarriers=512)
    ground_m, slant_m = UAV_TARGET_M[0, 1], float(np.hypot(UAV_TARGET_M[0, 1], UAV_HEIGHT_M))
    closed_m = ground_range_resolution_m(_bandwidth_hz(scene), ground_m, UAV_HEIGHT_M, half_power=HALF_POWER_OF_HANN)
    closed = f"closed form {100 * closed_m:.1f} cm"
    short_m, long_m = (
        cross_range_resolution_m(float(scene.waveform.frequency_hz.mean()), slant_m, length_m)
        for length_m in (UAV_APERTURE_M, SEGMENT_LENGTH_M)
    )
    other_length = (
        f"the paper contradicts itself: its table's L = 3.4 m gives {100 * short_m:.1f} cm by the closed form; "
        f"L = 4.7 m, which it prints as R_sl, gives {100 * long_m:.1f} cm"
    )
    fitted = (
        "mono segment at −1.88 m, bistatic midpoint at +4.38 m and L = 4.7 m were fitted to 11 cm × 49 cm, because the "
        "paper does not state them; other plausible segments give 11–24 cm × 48–57 cm"
    )
    middle_m = BISTATIC_MIDPOINT_M - SEPARATION_M / 2
    mono = _uav_widths_cm([_segment(scene, 0.0, UAV_APERTURE_M)])
    bistatic = _segment(scene, middle_m, SEGMENT_LENGTH_M, rx_ahead_m=SEPARATION_M)
    fused = _uav_widths_cm([_segment(scene, MONO_SEGMENT_M, SEGMENT_LENGTH_M), bistatic])
    across, along = "UAV flight: ground-range width", "UAV flight: cross-range width"
    return [
        compare(f"{across}, Hann, mono", mono[0], "cm", paper="58", within=WITHIN, note=closed),
        compare(f"{along} of L = 3.4 m", mono[1], "cm", independent_model=100 * short_m, within=WITHIN),
        compare(f"{along} as printed", mono[1], "cm", paper="25", within=WITHIN, reason=other_length),
        fitted_to(compare(f"{along}, fused, fitted segments", fused[1], "cm", paper="11", within=WITHIN, note=fitted)),
        fitted_to(compare(f"{across}, fused, fitted segments", fused[0], "cm", paper="49", within=WITHIN, note=fitted)),
    ]  # fmt: skip


def _printed_table(ground_cm: list[float], cross_cm: list[float]) -> list[Claim]:
    """Compare the widths that the paper prints for its simulated scene with closed forms."""
    far = (
        f"farthest target, which is the widest; the widths of the five targets are {min(cross_cm):.1f} to "
        f"{max(cross_cm):.1f} cm; the paper does not state which target its 9 cm refer to"
    )
    return [
        compare("ground-range width, closed form, farthest target", ground_cm[-1], "cm", paper="35", within=WITHIN),
        compare("ground-range width, closed form, nearest target", ground_cm[0], "cm", paper="73", within=WITHIN),
        compare("cross-range width", cross_cm[-1], "cm", paper="9", within=WITHIN, style=".3g", reason=far),
    ]  # fmt: skip


def _bandwidth_hz(scene: PaperScene) -> float:
    return len(scene.waveform.frequency_hz) * scene.waveform.subcarrier_spacing_hz


def _segment(scene: PaperScene, middle_m: float, length_m: float, *, rx_ahead_m: float = 0.0) -> PaperScene:
    along = middle_m + np.linspace(-length_m / 2, length_m / 2, len(scene.geometry.radar_tx))
    target = Scatterers(UAV_TARGET_M, np.ones(1, np.complex128))
    return replace(scene, scatterers=target, geometry=straight_pair(along, UAV_HEIGHT_M, rx_ahead_m=rx_ahead_m))


def _uav_widths_cm(segments: list[PaperScene]) -> tuple[float, float]:
    """Return the widths across and along the track of the coherent sum of images with equal peaks."""
    images = [_normalised(segment) for segment in segments]
    width_m = half_power_widths(lambda pixels: np.asarray(sum(image(pixels) for image in images)), UAV_TARGET_M[0])
    return 100 * width_m[0], 100 * width_m[1]


def _normalised(scene: PaperScene) -> Callable[[Floats], Complexes]:
    tables = undisturbed_tables(scene, window="hann")
    peak = np.abs(mean_image(tables, UAV_TARGET_M[None]))[0, 0]
    return lambda pixels: np.asarray(mean_image(tables, pixels) / peak)
