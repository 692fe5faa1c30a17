"""Cross-sections, σ⁰ and NESZ of calibrated images against what was put: `python benchmarks/radiometry.py`.

`points`: 0.1, 1 and 10 m² at five ranges and three squints, mono- and bistatic, through beams, without noise and in
100 noisy draws each; `clutter`: ground of one σ⁰ over incidences of 30° to 70°, level, on slopes and across the edge of
a beam; `looks`: of its mean power, and after the filter; `noise`: the noise figure that the noise of simulated
recordings has. Echoes are those of `apertura.simulation` with a `Radio`.
"""

import argparse
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.antenna.beam import Beam, Beams, antenna_axes, gaussian_cut
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.echo.sidelink import METHODS
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.backproject import backproject
from apertura.core.imaging.multilook import Multilook, Speckle
from apertura.core.imaging.noise import noise_places, noise_power, sidelink_noise
from apertura.core.imaging.radiometry import Calibration, Link, cell_constant
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.quality.bright_points import bright_point
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane, Terrain
from apertura.simulation.impairments import Impairments, Radio, draw_impairments
from apertura.simulation.observation import physical
from apertura.simulation.scatterers import transfer
from apertura.simulation.synthesis import Geometry, receive, transfer_functions
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform, qpsk_codes
from apertura.stages.radiometry import LEAST_CONTRAST

RCS_M2, RANGES_M, SQUINTS_DEG = (0.1, 1.0, 10.0), (14.0, 25.0, 40.0, 70.0, 110.0), (-25.0, 0.0, 25.0)
COUNTS, WIDTH_DEG, STATED_STD_DB = 8192.0, (60.0, 60.0), 0.5
RADIO = Radio(-10.0, 8.0, 9.0, full_scale_dbm=4.0, gain_db=40.0, noise_figure_db=6.0)
LINK = Link(-10.0, 8.0, 9.0, 40.0, 4.0, COUNTS)
HEIGHT_M = 8.0
SLOPED_M = 35.0
"""North of the track where ground on a slope is at height 0."""
UNDETECTABLE_SCATTER_DB = 10 / np.log(10) * np.sqrt(2 / LEAST_CONTRAST + 1 / LEAST_CONTRAST**2)
"""Scatter of a peak that is hardly above its surroundings."""
WAVE = TransmitWaveform(
    qpsk_codes(256, np.random.default_rng(0)), 1.2e9, "band_centre", 1.6e6, 0.625e-6, 1.25e-6, 512e6, 100.0
)


def weights(window: str = "hann") -> NDArray[np.float64]:
    """Return the window over the subcarriers."""
    return window_weights(window, len(WAVE.codes))


def flown(*, apart: bool, length_m: float = 8.0, pulses: int = 160, height_m: float = HEIGHT_M) -> Aperture:
    """Return a straight pass eastward at north 0; the receiver ahead, aside and above."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    track = np.stack([along, 0 * along, np.full(pulses, height_m)], -1)
    return Aperture(track, track + ([5.0, -1.5, 1.0] if apart else 0.0))


def beams(aperture: Aperture, width_deg: tuple[float, float] = WIDTH_DEG, down_deg: float = -15.0) -> Beams:
    """Return beams of both antennas to the north, a little down."""
    body = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(aperture), 3, 3))
    limits = np.pi, np.pi / 2
    cuts = (gaussian_cut(width, cutoff_db=-40.0, limit_rad=most) for width, most in zip(width_deg, limits, strict=True))
    one = Beam(antenna_axes(body, (-90.0, down_deg)), *(part for cut in cuts for part in cut))
    return Beams(one, one)


def counts(
    points: Scatterers, aperture: Aperture, gain: NDArray[np.float64], generator: np.random.Generator | None
) -> NDArray[np.complex64]:
    """Return transfer functions in the numbers that a receiver with `RADIO` records."""
    geometry = Geometry(aperture.tx_m, aperture.rx_m, aperture.tx_m, aperture.rx_m, gain=gain)
    clean = Impairments()
    times = np.arange(len(aperture)) / WAVE.prf_hz
    draw = draw_impairments(clean, times, WAVE.sample_rate_hz, np.random.default_rng(0))
    channel = receive(WAVE, points, geometry, impairments=clean, draw=draw, transmitter=clean, sidelink=False)["radar"]
    channel = physical(channel, transmitter=RADIO, receiver=RADIO)
    scale = COUNTS / float(channel.full_scale or 1.0)
    return np.asarray(transfer_functions(channel, generator) * scale, np.complex64)


def constant() -> float:
    """Return K of the link."""
    wavelength_m = C / centre_frequency(WAVE.frequency_hz)
    return LINK.constant(wavelength_m=wavelength_m, sent_power=float((np.abs(WAVE.codes) ** 2).sum()))


def calibration(grid: SceneGrid, aperture: Aperture, weighing: Beams | None, window: str = "hann") -> Calibration:
    """Return the calibration of an image."""
    cell_m2 = cell_constant(WAVE.frequency_hz, weights(window))
    return Calibration.of(grid, FlatGround(0.0), aperture, weighing, constant=constant(), cell_m2=cell_m2)


def history(echo: NDArray[np.complex64], aperture: Aperture, window: str = "hann") -> PhaseHistory:
    """Return transfer functions as an engine takes them."""
    return PhaseHistory(echo, WAVE.frequency_hz, weights(window), np.zeros(len(aperture)), aperture)


def cross_section(
    rcs_m2: float, range_m: float, squint_deg: float, *, apart: bool, seed: int | None
) -> tuple[float, float]:
    """Return the error of a point's cross-section in its image and what it scatters by as told, dB."""
    aperture = flown(apart=apart)
    level_m, turn = np.sqrt(range_m**2 - HEIGHT_M**2), np.radians(squint_deg)
    place = np.array([[level_m * np.sin(turn), level_m * np.cos(turn), 0.0]])
    weighing = beams(aperture)
    generator = None if seed is None else np.random.default_rng(seed)
    echo = counts(
        Scatterers(place, np.array([rcs_m2**0.5 + 0j])), aperture, weighing.weight(aperture, place), generator
    )
    spacing_m = 0.12 if range_m < 60 else 0.2
    grid = SceneGrid("local", place[0, 0] - 32 * spacing_m, place[0, 1] + 32 * spacing_m, spacing_m, (64, 64))
    given = history(echo, aperture)
    image = reference.form(given, grid.positions(0.0), beams=weighing) / len(aperture)
    point = bright_point(image.astype(np.complex64), 32, 32)
    per_m2, share = calibration(grid, aperture, weighing).at(grid.positions_at([point.row], [point.column], 0.0))
    pulse = 0.0
    if generator is not None:
        pulse = LINK.pulse_noise(6.0, spacing_hz=WAVE.subcarrier_spacing_hz, squares=float((weights() ** 2).sum()))
    noise = float(share[0]) * pulse
    found = max(point.amplitude**2 - noise, 1e-30) / per_m2[0]
    # the ring around a point without noise holds its own sidelobes: they are no error of it
    inverse = 0.0 if generator is None else max(noise / point.amplitude**2, point.background)
    scatter_db = 10 / np.log(10) * np.sqrt(2 * inverse + inverse**2)
    return 10 * float(np.log10(found / rcs_m2)), float(scatter_db)


def points(draws: int) -> None:
    """Print errors of cross-sections without noise, and how often noisy ones lie within two standard deviations."""
    generator = np.random.default_rng(5)
    for apart in (False, True):
        cases = list(product(RCS_M2, RANGES_M, SQUINTS_DEG))
        errors = [abs(cross_section(*case, apart=apart, seed=None)[0]) for case in cases]
        kind = "bistatic" if apart else "monostatic"
        print(f"{kind}: {len(cases)} points without noise: off by {max(errors):.3f} dB at most", flush=True)
        inside, lost, scatter, draw = 0, 0, list[float](), 0
        while len(scatter) < draws:
            draw += 1
            case = cases[int(generator.integers(len(cases)))]
            wrong_db = STATED_STD_DB * generator.standard_normal()  # of the radio, as stated
            error_db, scatter_db = cross_section(*case, apart=apart, seed=draw)
            if scatter_db > UNDETECTABLE_SCATTER_DB:
                lost += 1
                continue
            std_db = float(np.hypot(scatter_db, STATED_STD_DB))
            inside += abs(error_db + wrong_db) < 1.96 * std_db
            scatter.append(scatter_db)
        print(
            f"{kind}: {inside} of {draws} noisy draws within 1.96 of their standard deviation "
            f"(scatter {min(scatter):.2f} to {max(scatter):.2f} dB; {lost} more below 10 dB above noise)",
            flush=True,
        )


CLUTTER = SceneGrid("local", -22.0, 70.0, 0.1, (580, 440))
CLUTTER_HEIGHT_M = 25.0
EDGE_WIDTH_DEG, DRAWS = 20.0, 4
SCATTERERS_M = 0.2
"""Side of the square of ground that a scatterer stands for."""
SLOPES = {"level": (0.0, 0.0), "20 % up": (0.0, 0.2), "20 % down": (0.0, -0.2), "20 % along": (0.2, 0.0)}
"""Rise eastward, along the track, and northward, away from it."""


def clutter_power(
    terrain: Terrain,
    slope: tuple[float, float],
    *,
    apart: bool,
    window: str = "hann",
    width_deg: float | None = None,
    seed: int = 8,
    sigma0: float = 0.02,
) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Return the image of ground of one σ⁰ over `CLUTTER`, divided so that its mean power should be 1, and places.

    Through beams of a width of `width_deg` in elevation, or none.
    """
    grid, level = CLUTTER, flown(apart=apart, length_m=10.0, pulses=220, height_m=CLUTTER_HEIGHT_M)
    aperture, generator = level, np.random.default_rng(seed)
    # one at random in each square: of places all at random the density would add to speckle
    east, north = np.meshgrid(np.arange(-45.0, 45.0, SCATTERERS_M), np.arange(6.0, 85.0, SCATTERERS_M))
    x, y = ((low + SCATTERERS_M * generator.uniform(size=low.shape)).ravel() for low in (east, north))
    place = np.column_stack([x, y, slope[0] * x + slope[1] * (y - SLOPED_M)])
    steep = np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    amplitude = generator.standard_normal((x.size, 2)) @ [1, 1j] * np.sqrt(sigma0 * steep / 2) * SCATTERERS_M
    weighing = None if width_deg is None else beams(aperture, (WIDTH_DEG[0], width_deg), -45.0)
    if weighing is None:
        echo = transfer(Scatterers(place, amplitude), aperture, WAVE.frequency_hz, gridded=True)
    else:
        echo = np.concatenate(
            [
                transfer(
                    Scatterers(place, amplitude * weighing[one].weight(aperture[one], place)[0]),
                    aperture[one],
                    WAVE.frequency_hz,
                    gridded=True,
                )
                for one in (slice(pulse, pulse + 1) for pulse in range(len(aperture)))
            ]
        )
    profiles = range_compress(history(np.asarray(echo, np.complex64), aperture, window), grid, terrain)
    image = np.asarray(backproject(profiles, grid, terrain=terrain, beams=weighing, integration="all"))
    normal = np.broadcast_to(np.array([-slope[0], -slope[1], 1.0]) / steep, (*grid.shape, 3))
    whole, cell_m2 = (
        (slice(0, grid.shape[0]), slice(0, grid.shape[1])),
        cell_constant(WAVE.frequency_hz, weights(window)),
    )
    known = Calibration.of(grid, terrain, aperture, weighing, constant=1.0, cell_m2=cell_m2)
    return np.asarray(image / np.sqrt(known.power(whole, "sigma0", normal) * sigma0), np.complex64), terrain.positions(
        grid
    )


def clutter() -> None:
    """Print the mean σ⁰ of ground over incidence, against what was put: level, on slopes, and across a beam's edge."""
    for apart, (name, slope) in product((False, True), SLOPES.items()):
        for window in ("hann", "none") if name == "level" else ("hann",):
            terrain = FlatGround(0.0) if name == "level" else Plane(0.0, SLOPED_M, 0.0, *slope)
            drawn = [clutter_power(terrain, slope, apart=apart, window=window, seed=seed) for seed in range(DRAWS)]
            power = np.mean([np.abs(image) ** 2 for image, _ in drawn], axis=0)
            image, places = drawn[0]
            incidence = np.degrees(np.arctan2(places[..., 1], CLUTTER_HEIGHT_M - places[..., 2]))
            starts = product(*(range(0, size - 127, 64) for size in image.shape))
            cell_px = Speckle.of(image[row : row + 128, column : column + 128] for row, column in starts).area_px
            rows = []
            for low, high in (*((low, low + 10) for low in range(30, 70, 10)), (30, 70)):
                inside = (incidence >= low) & (incidence < high)
                scatter_db = 10 / np.log(10) * np.sqrt(cell_px / inside.sum() / DRAWS)
                rows.append(f"{low}-{high}°: {10 * np.log10(power[inside].mean()):+.2f} ± {scatter_db:.2f}")
            kind = "bistatic" if apart else "monostatic"
            print(f"{kind}, {window}, {name}: σ⁰ off by (dB, speckle) {', '.join(rows)}", flush=True)
    for apart in (False, True):
        drawn = [
            clutter_power(FlatGround(0.0), SLOPES["level"], apart=apart, width_deg=EDGE_WIDTH_DEG, seed=seed)
            for seed in range(DRAWS)
        ]
        power, places = np.mean([np.abs(image) ** 2 for image, _ in drawn], axis=0), drawn[0][1]
        aperture = flown(apart=apart, length_m=10.0, pulses=2, height_m=CLUTTER_HEIGHT_M)
        middle = places[:, places.shape[1] // 2]
        weighing = beams(aperture, (WIDTH_DEG[0], EDGE_WIDTH_DEG), -45.0)
        below_db, rows = 20 * np.log10(weighing.weight(aperture, middle).mean(axis=0)), []
        for low in range(-24, 0, 6):
            inside = (below_db >= low) & (below_db < low + 6) & (middle[:, 1] > CLUTTER_HEIGHT_M)
            if inside.any():
                rows.append(f"{low} to {low + 6} dB: {10 * np.log10(np.nanmean(power[inside])):+.2f}")
        kind = "bistatic" if apart else "monostatic"
        print(f"{kind}, far side of a beam, both ways: σ⁰ off by (dB) {', '.join(rows)}", flush=True)


def looks() -> None:
    """Print the looks of mean power of ground of one σ⁰, stated and counted, and what the filter does to it."""
    for apart, window in product((False, True), ("hann", "none")):
        image, _ = clutter_power(FlatGround(0.0), SLOPES["level"], apart=apart, window=window)
        for side in (2, 4, 8):
            plain = Multilook.of(image.__getitem__, CLUTTER.shape, side)
            means = [
                one.mean((slice(0, one.shape[0]), slice(0, one.shape[1])))
                for one in (plain, replace(plain, filtered=True))
            ]
            counted = [one.mean() ** 2 / one.var() for one in means]
            moved_db = 10 * np.log10(means[1].mean() / means[0].mean())
            kind = "bistatic" if apart else "monostatic"
            print(
                f"{kind}, {window}, {side} × {side} pixels: {plain.looks:.2f} looks by "
                f"correlation, {plain.found:.2f} found, {counted[0]:.2f} counted; filtered {counted[1]:.0f}, mean "
                f"{moved_db:+.3f} dB",
                flush=True,
            )


SIDELINK_DB, MISSED = 30.0, 0.05


def noise(draws: int = 8) -> None:
    """Print the noise figure that profiles of echoes and thermal noise have, against that put.

    Some pulses are missing; a bistatic pair is divided by a sidelink with noise of its own, which is taken off.
    """
    grid, ground = SceneGrid("local", -8.0, 36.0, 0.1, (160, 160)), FlatGround(0.0)
    points = Scatterers(np.array([[2.0, 25.0, 0.0], [-5.0, 30.0, 0.0]]), np.array([30.0, 100.0 + 0j]))
    thermal = LINK.pulse_noise(0.0, spacing_hz=WAVE.subcarrier_spacing_hz, squares=float((weights() ** 2).sum()))
    for apart in (False, True):
        told, stated, share = list[float](), list[float](), list[float]()
        for draw in range(draws):
            generator = np.random.default_rng(draw)
            kept = np.flatnonzero(generator.random(2048) >= MISSED)
            aperture = flown(apart=apart, length_m=20.0, pulses=2048, height_m=10.0)[kept]
            weighing, where = beams(aperture), noise_places(grid, ground)
            echo, added = counts(points, aperture, weighing.weight(aperture, points.position_m), generator), 0.0
            if apart:
                parts = generator.standard_normal((*echo.shape, 2)) @ [1, 1j] * np.sqrt(0.5) * 10 ** (-SIDELINK_DB / 20)
                echo = METHODS["divide"](echo, np.asarray(1 + parts, np.complex64))
            formed = history(echo, aperture)
            if apart:
                added = sidelink_noise(formed, grid, ground, where, beams=weighing, method="divide", snr_db=SIDELINK_DB)
            profiles = range_compress(formed, grid, ground)
            measured = noise_power(profiles, where, time_s=kept / WAVE.prf_hz, beams=weighing)
            own = measured.power - added
            told.append(10 * float(np.log10(own / thermal)))
            stated.append(measured.std_db * measured.power / own)
            share.append(10 * float(np.log10(measured.power / own)))
        print(
            f"{'bistatic' if apart else 'monostatic'}: noise figure of 6 dB measured below echoes: {min(told):.2f} to "
            f"{max(told):.2f} dB, mean {np.mean(told):.2f} dB in {draws} draws, {np.mean(stated):.2f} dB stated; the "
            f"sidelink's noise was {np.mean(share):.1f} dB of it",
            flush=True,
        )


PARTS = {"points": points, "clutter": lambda _: clutter(), "looks": lambda _: looks(), "noise": lambda _: noise()}


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="all by default")
    parser.add_argument("--draws", type=int, default=100)
    given = parser.parse_args()
    for name in given.parts or PARTS:
        PARTS[name](given.draws)


if __name__ == "__main__":
    main()
