"""Radiometric accuracy: cross-sections, σ⁰ and NESZ of calibrated images compared with the simulated values.

`python benchmarks/radiometry.py [PART …]` prints: `points`: 0.1, 1 and 10 m² at five ranges and three squints, mono-
and bistatic, with beams, without noise and in 100 noisy draws each; `clutter`: terrain of constant σ⁰ at incidence
angles of 30° to 70°, level, on slopes and across the edge of a beam; `looks`: number of looks of multilooked terrain,
and after the speckle filter; `noise`: noise figure estimated from the noise of simulated recordings. Echoes are those
of `apertura.simulation` with a `Radio`.
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
"""Distance north of the track at which sloped terrain has height 0."""

UNDETECTABLE_SCATTER_DB = 10 / np.log(10) * np.sqrt(2 / LEAST_CONTRAST + 1 / LEAST_CONTRAST**2)
"""Standard deviation of a peak with the smallest measurable contrast to its surroundings."""

WAVE = TransmitWaveform(
    qpsk_codes(256, np.random.default_rng(0)), 1.2e9, "band_centre", 1.6e6, 0.625e-6, 1.25e-6, 512e6, 100.0
)


def weights(window: str = "hann") -> NDArray[np.float64]:
    """Return the window weights of the subcarriers."""
    return window_weights(window, len(WAVE.codes))


def flown(*, bistatic: bool, length_m: float = 8.0, pulses: int = 160, height_m: float = HEIGHT_M) -> Aperture:
    """Return a straight pass to the east at north 0; a bistatic receiver is ahead, beside and above."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    track = np.stack([along, 0 * along, np.full(pulses, height_m)], -1)
    return Aperture(track, track + ([5.0, -1.5, 1.0] if bistatic else 0.0))


def beams(aperture: Aperture, width_deg: tuple[float, float] = WIDTH_DEG, down_deg: float = -15.0) -> Beams:
    """Return beams of both antennas to the north, directed downwards by `-down_deg`."""
    body = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(aperture), 3, 3))
    limits = np.pi, np.pi / 2
    cuts = (gaussian_cut(width, cutoff_db=-40.0, limit_rad=most) for width, most in zip(width_deg, limits, strict=True))
    one = Beam(antenna_axes(body, (-90.0, down_deg)), *(part for cut in cuts for part in cut))
    return Beams(one, one)


def counts(
    points: Scatterers, aperture: Aperture, gain: NDArray[np.float64], generator: np.random.Generator | None
) -> NDArray[np.complex64]:
    """Simulate transfer functions in the counts that a receiver with `RADIO` records."""
    geometry = Geometry(aperture.tx_m, aperture.rx_m, aperture.tx_m, aperture.rx_m, gain=gain)
    clean = Impairments()
    times = np.arange(len(aperture)) / WAVE.prf_hz
    draw = draw_impairments(clean, times, WAVE.sample_rate_hz, np.random.default_rng(0))
    channel = receive(WAVE, points, geometry, impairments=clean, draw=draw, transmitter=clean, sidelink=False)["radar"]
    channel = physical(channel, transmitter=RADIO, receiver=RADIO)
    scale = COUNTS / float(channel.full_scale or 1.0)
    return np.asarray(transfer_functions(channel, generator) * scale, np.complex64)


def constant() -> float:
    """Return the radar constant K of the link."""
    wavelength_m = C / centre_frequency(WAVE.frequency_hz)
    return LINK.constant(wavelength_m=wavelength_m, sent_power=float((np.abs(WAVE.codes) ** 2).sum()))


def calibration(grid: SceneGrid, aperture: Aperture, weighing: Beams | None, window: str = "hann") -> Calibration:
    """Return the radiometric calibration of an image."""
    cell_m2 = cell_constant(WAVE.frequency_hz, weights(window))
    return Calibration.of(grid, FlatGround(0.0), aperture, weighing, constant=constant(), cell_m2=cell_m2)


def history(echo: NDArray[np.complex64], aperture: Aperture, window: str = "hann") -> PhaseHistory:
    """Return the phase history of transfer functions."""
    return PhaseHistory(echo, WAVE.frequency_hz, weights(window), np.zeros(len(aperture)), aperture)


def cross_section(
    rcs_m2: float, range_m: float, squint_deg: float, *, bistatic: bool, seed: int | None
) -> tuple[float, float]:
    """Return the error of a point's measured cross-section and its estimated standard deviation, dB."""
    aperture = flown(bistatic=bistatic)
    level_m, squint_rad = np.sqrt(range_m**2 - HEIGHT_M**2), np.radians(squint_deg)
    place = np.array([[level_m * np.sin(squint_rad), level_m * np.cos(squint_rad), 0.0]])
    weighing = beams(aperture)
    generator = None if seed is None else np.random.default_rng(seed)
    echo = counts(
        Scatterers(place, np.array([rcs_m2**0.5 + 0j])), aperture, weighing.weight(aperture, place), generator
    )
    spacing_m = 0.12 if range_m < 60 else 0.2
    grid = SceneGrid("local", place[0, 0] - 32 * spacing_m, place[0, 1] + 32 * spacing_m, spacing_m, (64, 64))
    image = reference.form(history(echo, aperture), grid.positions(0.0), beams=weighing) / len(aperture)
    point = bright_point(image.astype(np.complex64), 32, 32)
    per_m2, share = calibration(grid, aperture, weighing).at(grid.positions_at([point.row], [point.column], 0.0))
    pulse = 0.0
    if generator is not None:
        pulse = LINK.pulse_noise(6.0, spacing_hz=WAVE.subcarrier_spacing_hz, squares=float((weights() ** 2).sum()))
    noise = float(share[0]) * pulse
    measured_m2 = max(point.amplitude**2 - noise, 1e-30) / per_m2[0]
    # Without noise, the ring around a point contains only sidelobes of this point, which are not an error.
    inverse = 0.0 if generator is None else max(noise / point.amplitude**2, point.background)
    scatter_db = 10 / np.log(10) * np.sqrt(2 * inverse + inverse**2)
    return 10 * float(np.log10(measured_m2 / rcs_m2)), float(scatter_db)


def points(draws: int) -> None:
    """Print errors of cross-sections without noise, and the coverage of their 95 % intervals with noise."""
    generator = np.random.default_rng(5)
    for bistatic in (False, True):
        cases = list(product(RCS_M2, RANGES_M, SQUINTS_DEG))
        errors = [abs(cross_section(*case, bistatic=bistatic, seed=None)[0]) for case in cases]
        kind = "bistatic" if bistatic else "monostatic"
        print(f"{kind}: {len(cases)} points without noise, largest error {max(errors):.3f} dB", flush=True)
        inside, excluded, scatter, draw = 0, 0, list[float](), 0
        while len(scatter) < draws:
            draw += 1
            case = cases[int(generator.integers(len(cases)))]
            radio_error_db = STATED_STD_DB * generator.standard_normal()  # with the stated standard deviation
            error_db, scatter_db = cross_section(*case, bistatic=bistatic, seed=draw)
            if scatter_db > UNDETECTABLE_SCATTER_DB:
                excluded += 1
                continue
            std_db = float(np.hypot(scatter_db, STATED_STD_DB))
            inside += abs(error_db + radio_error_db) < 1.96 * std_db
            scatter.append(scatter_db)
        print(
            f"{kind}: {inside} of {draws} noisy draws within 1.96 standard deviations "
            f"({min(scatter):.2f} to {max(scatter):.2f} dB; {excluded} draws excluded for an SNR below 10 dB)",
            flush=True,
        )


CLUTTER = SceneGrid("local", -22.0, 70.0, 0.1, (580, 440))
CLUTTER_HEIGHT_M = 25.0
EDGE_WIDTH_DEG, DRAWS = 20.0, 4
SCATTERERS_M = 0.2
"""Side of the square of terrain that a scatterer represents."""

SLOPES = {"level": (0.0, 0.0), "20 % up": (0.0, 0.2), "20 % down": (0.0, -0.2), "20 % along": (0.2, 0.0)}
"""Gradients to the east (along the track) and to the north (away from the track)."""


def clutter_power(
    terrain: Terrain,
    slope: tuple[float, float],
    *,
    bistatic: bool,
    window: str = "hann",
    width_deg: float | None = None,
    seed: int = 8,
    sigma0: float = 0.02,
) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Simulate the image of terrain of constant σ⁰ over `CLUTTER`, normalised to an expected power of 1, and positions.

    With beams of width `width_deg` in elevation, or without beams.
    """
    grid = CLUTTER
    aperture = flown(bistatic=bistatic, length_m=10.0, pulses=220, height_m=CLUTTER_HEIGHT_M)
    generator = np.random.default_rng(seed)
    # One random scatterer per square: with positions uniform over the area, variations of the density would add to the
    # speckle.
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
    calibrated = Calibration.of(grid, terrain, aperture, weighing, constant=1.0, cell_m2=cell_m2)
    expected = calibrated.power(whole, "sigma0", normal) * sigma0
    return np.asarray(image / np.sqrt(expected), np.complex64), terrain.positions(grid)


def clutter() -> None:
    """Print the error of mean σ⁰ against incidence angle: on level terrain, on slopes, and across a beam's edge."""
    for bistatic, (name, slope) in product((False, True), SLOPES.items()):
        for window in ("hann", "none") if name == "level" else ("hann",):
            terrain = FlatGround(0.0) if name == "level" else Plane(0.0, SLOPED_M, 0.0, *slope)
            drawn = [
                clutter_power(terrain, slope, bistatic=bistatic, window=window, seed=seed) for seed in range(DRAWS)
            ]
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
            kind = "bistatic" if bistatic else "monostatic"
            print(f"{kind}, {window}, {name}: σ⁰ error ± speckle, dB: {', '.join(rows)}", flush=True)
    for bistatic in (False, True):
        drawn = [
            clutter_power(FlatGround(0.0), SLOPES["level"], bistatic=bistatic, width_deg=EDGE_WIDTH_DEG, seed=seed)
            for seed in range(DRAWS)
        ]
        power, places = np.mean([np.abs(image) ** 2 for image, _ in drawn], axis=0), drawn[0][1]
        aperture = flown(bistatic=bistatic, length_m=10.0, pulses=2, height_m=CLUTTER_HEIGHT_M)
        middle = places[:, places.shape[1] // 2]
        weighing = beams(aperture, (WIDTH_DEG[0], EDGE_WIDTH_DEG), -45.0)
        below_db, rows = 20 * np.log10(weighing.weight(aperture, middle).mean(axis=0)), []
        for low in range(-24, 0, 6):
            inside = (below_db >= low) & (below_db < low + 6) & (middle[:, 1] > CLUTTER_HEIGHT_M)
            if inside.any():
                rows.append(f"{low} to {low + 6} dB: {10 * np.log10(np.nanmean(power[inside])):+.2f}")
        kind = "bistatic" if bistatic else "monostatic"
        print(f"{kind}, far side of a beam, by two-way gain: σ⁰ error, dB: {', '.join(rows)}", flush=True)


def looks() -> None:
    """Print estimated and measured numbers of looks of terrain of constant σ⁰, and the effect of the speckle filter."""
    for bistatic, window in product((False, True), ("hann", "none")):
        image, _ = clutter_power(FlatGround(0.0), SLOPES["level"], bistatic=bistatic, window=window)
        for side in (2, 4, 8):
            plain = Multilook.of(image.__getitem__, CLUTTER.shape, side)
            means = [
                one.mean((slice(0, one.shape[0]), slice(0, one.shape[1])))
                for one in (plain, replace(plain, filtered=True))
            ]
            measured = [one.mean() ** 2 / one.var() for one in means]
            bias_db = 10 * np.log10(means[1].mean() / means[0].mean())
            kind = "bistatic" if bistatic else "monostatic"
            print(
                f"{kind}, {window}, {side} × {side} pixels: {plain.looks:.2f} looks by correlation, "
                f"{plain.found:.2f} estimated in the image, {measured[0]:.2f} measured; filtered {measured[1]:.0f}, "
                f"change of the mean {bias_db:+.3f} dB",
                flush=True,
            )


SIDELINK_DB, MISSED = 30.0, 0.05


def noise(draws: int = 8) -> None:
    """Print the noise figure estimated from profiles with echoes and thermal noise, simulated as 6 dB.

    Some pulses are missing; the echo of a bistatic pair is divided by a noisy sidelink, whose noise is subtracted.
    """
    grid, ground = SceneGrid("local", -8.0, 36.0, 0.1, (160, 160)), FlatGround(0.0)
    points = Scatterers(np.array([[2.0, 25.0, 0.0], [-5.0, 30.0, 0.0]]), np.array([30.0, 100.0 + 0j]))
    thermal = LINK.pulse_noise(0.0, spacing_hz=WAVE.subcarrier_spacing_hz, squares=float((weights() ** 2).sum()))
    for bistatic in (False, True):
        estimates_db, stated, share = list[float](), list[float](), list[float]()
        for draw in range(draws):
            generator = np.random.default_rng(draw)
            kept = np.flatnonzero(generator.random(2048) >= MISSED)
            aperture = flown(bistatic=bistatic, length_m=20.0, pulses=2048, height_m=10.0)[kept]
            weighing, where = beams(aperture), noise_places(grid, ground)
            echo, added = counts(points, aperture, weighing.weight(aperture, points.position_m), generator), 0.0
            if bistatic:
                parts = generator.standard_normal((*echo.shape, 2)) @ [1, 1j] * np.sqrt(0.5) * 10 ** (-SIDELINK_DB / 20)
                echo = METHODS["divide"](echo, np.asarray(1 + parts, np.complex64))
            formed = history(echo, aperture)
            if bistatic:
                added = sidelink_noise(formed, grid, ground, where, beams=weighing, method="divide", snr_db=SIDELINK_DB)
            profiles = range_compress(formed, grid, ground)
            measured = noise_power(profiles, where, time_s=kept / WAVE.prf_hz, beams=weighing)
            own = measured.power - added
            estimates_db.append(10 * float(np.log10(own / thermal)))
            stated.append(measured.std_db * measured.power / own)
            share.append(10 * float(np.log10(measured.power / own)))
        print(
            f"{'bistatic' if bistatic else 'monostatic'}: noise figure of 6 dB, estimated {min(estimates_db):.2f} to "
            f"{max(estimates_db):.2f} dB, mean {np.mean(estimates_db):.2f} dB in {draws} draws, reported standard "
            f"deviation {np.mean(stated):.2f} dB; sidelink noise increased it by {np.mean(share):.1f} dB",
            flush=True,
        )


PARTS = {"points": points, "clutter": lambda _: clutter(), "looks": lambda _: looks(), "noise": lambda _: noise()}


def main() -> None:
    """Run the requested parts and print their results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="parts to run (default: all)")
    parser.add_argument("--draws", type=int, default=100)
    options = parser.parse_args()
    for name in options.parts or PARTS:
        PARTS[name](options.draws)


if __name__ == "__main__":
    main()
