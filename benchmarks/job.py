"""Job of the engine benchmarks: a low, wobbling bistatic flight over point scatterers, with its exact image.

512 × 512 pixels of 5 cm, imaged from 10 m height at 5 to 30 m ground range, 1024 pulses over 30 m, 409.6 MHz at
1.2 GHz. This is the geometry of the source paper, and the most demanding geometry for series about a patch, because
aperture, range and scene have the same size.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

SUBCARRIERS, SPACING_HZ, CENTRE_HZ = 4096, 100e3, 1.2e9
GUARD = 16
Surface = Literal["flat", "harsh", "natural"]


@dataclass(frozen=True)
class Job:
    """Profiles, pixels (y, x, 3), and positions and amplitudes of scatterers."""

    profiles: Profiles
    pixels: NDArray[np.float64]
    scatterers: NDArray[np.float64]
    amplitude: NDArray[np.complex128]


def _wobble(generator: np.random.Generator, pulses: int, size_m: float) -> NDArray[np.float64]:
    kernel = np.exp(-0.5 * (np.arange(-200, 201) / 60.0) ** 2)
    track = np.convolve(generator.standard_normal(pulses + 400), kernel, "valid")
    return size_m * track / track.std()


def flight(generator: np.random.Generator, pulses: int, *, bistatic: bool) -> tuple[NDArray, NDArray]:
    """Return transmitter and receiver positions, (pulse, 3) metres."""
    along = np.linspace(-15, 15, pulses)
    wobble = [_wobble(generator, pulses, size) for size in (0.05, 0.02, 0.05, 0.05, 0.02, 0.05)]
    tx = np.stack([wobble[0], along + wobble[1], 10 + wobble[2]], 1)
    rx = np.stack([-1.5 + along / 7.5 + wobble[3], 6 + 0.8 * along + wobble[4], 13 + along / 30 + wobble[5]], 1)
    return tx, rx if bistatic else tx


def grid(
    size: int, spacing_m: float = 0.05, *, turned_deg: float = 0.0, surface: Surface = "flat"
) -> NDArray[np.float64]:
    """Return pixels on a surface, (y, x, 3)."""
    step = spacing_m * (np.arange(size) - (size - 1) / 2)
    across, along = np.meshgrid(step, step)
    angle = np.radians(turned_deg)
    middle = 5 + spacing_m * size / 2
    x, y = middle + across * np.cos(angle) - along * np.sin(angle), across * np.sin(angle) + along * np.cos(angle)
    return np.stack([x, y, height(x, y, surface)], -1)


def height(x: NDArray, y: NDArray, surface: Surface) -> NDArray[np.float64]:
    """Return heights: relief of 10 cm with 1 cm RMS noise per pixel, or relief of 1 m with 1 cm RMS over 25 cm."""
    rough = np.random.default_rng(5).standard_normal(x.shape)
    if surface == "harsh":
        return 0.1 * (np.sin(x / 3) + np.cos(y / 4)) + 0.01 * rough
    if surface == "natural":
        rough = gaussian_filter(rough, 0.25 / abs(np.hypot(x[0, 1] - x[0, 0], y[0, 1] - y[0, 0])))
        return 1.0 * np.sin(x / 8) * np.cos(y / 10) + 0.01 * rough / rough.std()
    return np.zeros_like(x)


def total_path(tx: NDArray, rx: NDArray, place: NDArray) -> NDArray[np.float64]:
    """Return total paths to points, (pulse, point) metres."""
    legs = [np.linalg.norm(place[None] - antenna[:, None], axis=-1) for antenna in (tx, rx)]
    return legs[0] + legs[1]


def response(path_m: NDArray) -> NDArray[np.float64]:
    """Return Σ_n exp(j2π(f_n - f_mid)·path/c) / N in closed form."""
    half_phase = np.pi * SPACING_HZ * path_m / C
    small = np.abs(half_phase) < 1e-12
    safe = np.where(small, 1.0, half_phase)
    return np.where(small, 1.0, np.sin(SUBCARRIERS * safe) / (SUBCARRIERS * np.sin(safe)))


def echoes(tx: NDArray, rx: NDArray, scatterers: NDArray, amplitude: NDArray, at: NDArray) -> NDArray[np.complex64]:
    """Return the band-limited echoes of scatterers at the paths `at`, (pulse, sample)."""
    samples, wavenumber = np.zeros(at.shape, np.complex128), 2 * np.pi * CENTRE_HZ / C
    for place, gain in zip(scatterers, amplitude, strict=True):
        path = total_path(tx, rx, place[None])
        samples += gain * np.exp(-1j * wavenumber * path) * response(at - path)
    return samples.astype(np.complex64)


def build(
    size: int = 512, pulses: int = 1024, *, bistatic: bool = True, surface: Surface = "flat", count: int = 100
) -> Job:
    """Return the job with `count` scatterers; profiles are exact samples of the band-limited echo."""
    generator = np.random.default_rng(1)
    tx, rx = flight(generator, pulses, bistatic=bistatic)
    pixels = grid(size, surface=surface)
    flat = pixels.reshape(-1, 3)
    places = flat[generator.integers(0, len(flat), count)]
    scatterers = places + generator.uniform(-0.025, 0.025, (count, 3)) * [1, 1, 0]
    amplitude = generator.standard_normal(count) + 1j * generator.standard_normal(count)
    step = C / (SUBCARRIERS * SPACING_HZ) / 2
    edge = grid(64, 0.05 * size * 1.45 / 64)  # also covers rotated grids
    coarse = max(8, size // 64)
    paths = total_path(tx, rx, np.concatenate([edge, pixels[::coarse, ::coarse]], axis=None).reshape(-1, 3))
    start = paths.min(1) - GUARD * step
    length = int(np.ceil((paths.max(1) - start).max() / step)) + GUARD
    at = start[:, None] + step * np.arange(length)
    samples = echoes(tx, rx, scatterers, amplitude, at)
    profiles = Profiles(samples, start, step, CENTRE_HZ, 2.0, Aperture(tx, rx))
    return Job(profiles, pixels, scatterers, amplitude)


def turned(job: Job, degrees: float) -> Job:
    """Return the job on a grid rotated about its centre."""
    return replace(job, pixels=grid(len(job.pixels), turned_deg=degrees))


def spectra(job: Job, reference_path_m: NDArray) -> NDArray[np.complex64]:
    """Return phase histories Σ a·exp(-j2πf(path - reference)/c), (pulse, subcarrier), the input of other programs."""
    frequency_hz = CENTRE_HZ + SPACING_HZ * (np.arange(SUBCARRIERS) - (SUBCARRIERS - 1) / 2)
    points = Scatterers(job.scatterers, job.amplitude)
    return transfer(points, job.profiles.aperture, frequency_hz, longer_m=-reference_path_m, spreading=False)


def exact(
    job: Job, places: NDArray[np.float64], *, carrier_hz: float = CENTRE_HZ, beams: Beams | None = None
) -> NDArray[np.complex128]:
    """Compute the double sum at points (point, 3) in float64, with subcarriers summed in closed form."""
    wavenumber, weight = 2 * np.pi * carrier_hz / C, (beams or Beams()).weight(job.profiles.aperture, places)
    path = total_path(*job.profiles.aperture.legs, places)
    image = np.zeros(len(places), np.complex128)
    for place, gain in zip(job.scatterers, job.amplitude, strict=True):
        difference = path - total_path(*job.profiles.aperture.legs, place[None])
        image += gain * (np.exp(1j * wavenumber * difference) * response(difference) * weight).sum(0)
    return image


def error_db(job: Job, image: NDArray[np.complex64], count: int = 300, *, beams: Beams | None = None) -> float:
    """Return the RMS error at random pixels after one complex gain, dB."""
    index = np.random.default_rng(7).integers(0, job.pixels.shape[0], (2, count))
    truth, value = (
        exact(job, job.pixels[index[0], index[1]], beams=beams),
        image[index[0], index[1]].astype(np.complex128),
    )
    gain = np.vdot(value, truth) / np.vdot(value, value)
    return float(10 * np.log10(np.sum(np.abs(gain * value - truth) ** 2) / np.sum(np.abs(truth) ** 2)))
