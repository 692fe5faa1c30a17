"""Flights imaged by the tree engine: predictions, images, and the fraction of each summation method."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from scenes import BANDWIDTH_HZ, SUBCARRIERS, ecef, fly, scatter

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import tree
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.engines.tree_geometry import subaperture_sizes, surfaces_of
from apertura.core.backprojection.engines.tree_prediction import counts_of, view_of_tile
from apertura.core.backprojection.job import Job, Signal
from apertura.core.geometry.aperture import Aperture

STEP_M = C / BANDWIDTH_HZ / 2
WAVENUMBERS = {"wavenumber_rad_m": 2 * np.pi * 1.2e9 / C, "band_rad_m": np.pi * BANDWIDTH_HZ / C}


def seen(scene, pixels):
    """Return a flight with profiles that extend beyond its pixels, because the filters of trees are long."""
    around = [pixels[::9, ::9].reshape(-1, 3) + [east, north, 0] for east in (-5, 5) for north in (-5, 5)]
    wide = scene.profiles(ecef(np.concatenate(around)))
    return SimpleNamespace(scene=scene, pixels=pixels, profiles=wide, aperture=Aperture(scene.tx, scene.rx))


def flown(pixels, **options):
    """Return a flight over pixels with scatterers on them."""
    return seen(fly(scatter(pixels), **options), pixels)


def setting(flight, **requested) -> Setting:
    """Return the setting that the tree predicts for a flight with these options."""
    places, shape = ecef(flight.pixels), flight.pixels.shape[:2]
    corners = places[np.ix_(*(np.linspace(0, size - 1, 3).astype(int) for size in shape))]
    signal = Signal(flight.scene.carrier_hz, 2.0, STEP_M, flight.profiles.samples.shape[1])
    job = Job(flight.aperture, corners, shape, 0.05, flight.scene.carrier_hz, BANDWIDTH_HZ, SUBCARRIERS, signal)
    requested = {"side_px": 64, "chunk": 256} | requested
    return next(iter(tree.candidates(job, pulses=len(flight.aperture), requested=requested)))


def shaken(flight, jitter_m, *, together=False):
    """Return the flight with white noise on its track, common to both nodes or independent, and without echoes."""
    white = jitter_m * np.random.default_rng(8).standard_normal((2, *flight.scene.tx.shape))
    scene = replace(flight.scene, tx=flight.scene.tx + white[0], rx=flight.scene.rx + white[0 if together else 1])
    silent = replace(scene, transfer=np.zeros_like(scene.transfer))
    return seen(silent, flight.pixels)


def heard(flight):
    """Return the flight with profiles that contain only band-limited noise."""
    shape, generator = flight.profiles.samples.shape, np.random.default_rng(9)
    lines = np.fft.fft(generator.standard_normal((*shape, 2)).view(complex)[..., 0], axis=1)
    lines[:, shape[1] // 4 : -(shape[1] // 4)] = 0
    noise = np.fft.ifft(lines, axis=1).astype(np.complex64)
    return SimpleNamespace(**vars(flight) | {"profiles": replace(flight.profiles, samples=noise)})


def formed(flight, pixels=None, *, beams=None, **requested):
    """Return the image, and the fractions summed by tree, summed directly, and skipped."""
    chosen, counts = setting(flight, **{"nodes_db": -74} | requested), np.zeros(3, np.int64)
    places = ecef(flight.pixels if pixels is None else pixels)
    trees = tree.prepare(flight.profiles, **chosen.options)
    image = tree.form(trees, places, beams=beams, counts=counts, **chosen.form_options)
    assert counts.sum() == image.size * len(flight.aperture)
    return image, counts / counts.sum()


def counted(aperture, pixels, nodes_db=-74, *, presum_db=-74, carrier_hz=1.2e9):
    """Return the numbers of nodes and of virtual pulses of a leaf on one tile of pixels, for one chunk of pulses."""
    (surface,) = surfaces_of(np.ascontiguousarray(pixels), [tuple(slice(0, size) for size in pixels.shape[:2])])
    view = view_of_tile(
        aperture, surface, subaperture_sizes(256), **WAVENUMBERS | {"wavenumber_rad_m": 2 * np.pi * carrier_hz / C}
    )
    return counts_of(view, nodes_db=nodes_db, presum_db=presum_db, weighted=False)
