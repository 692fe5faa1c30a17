"""Backprojection by cubic interpolation in oversampled range tables, compiled by numba."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.engine import (
    BEAM_S,
    EngineOptions,
    Setting,
    compiled_for,
    option_values,
    power_sum_db,
)
from apertura.core.backprojection.engines.range_interpolation import BAND, band_error_db
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Job
from apertura.core.geometry.aperture import Aperture
from apertura.core.windowed_sinc import kaiser_sinc

instruction_set = compiled_for
READS: Literal["profiles"] = "profiles"
STANDS_IN_FOR = "native"
"""Engine that this engine replaces in the selection of the planner if that engine is not available."""
OVERSAMPLINGS = (2, 4, 6, 8, 12, 16, 24, 32)

_SAMPLE_S = 3.1e-8  # seconds per pulse and table sample
_PIXEL_S = 3.2e-8  # seconds per pixel and pulse
_REFINED_DB = -98.0  # error of the sinc filter of the table
_HALF_TAPS = 10
_PIXELS_AT_ONCE = 1024  # number of pixels for which weights are in memory at once
_KAISER_BETA = 10.0  # shape parameter of the window for an error of -100 dB, with half of the band as transition


class Options(EngineOptions):
    """Options of the engine."""

    oversampling: Annotated[int, Field(ge=2, le=64)] | None = Field(
        None, description="table samples per resolution cell c/B of total path"
    )


def available() -> bool:
    """Return True, because numba is installed with the package."""
    return True


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield a setting for each oversampling, as described in `apertura.core.backprojection.engines.engine.Engine`.

    Notes
    -----
    Source: docs/theory/planner.md, "Error" and "Cost".
    """
    signal, considered = job.signal, option_values(requested, "oversampling", OVERSAMPLINGS)
    form_s = job.pixels * pulses * job.share * (_PIXEL_S + job.weights * BEAM_S)
    for oversampling in considered:
        if oversampling < signal.oversampling and len(considered) > 1:
            continue
        factor = max(1, round(oversampling / signal.oversampling))
        samples = pulses * signal.samples * factor
        cubic_db = cubic_error_db(signal.oversampling * factor, signal.window)
        reason = (
            f"predicted error {cubic_db:.1f} dB for cubic interpolation in a table with an oversampling of "
            f"{signal.oversampling * factor:.3g}"
        )
        yield Setting(
            "numba",
            {"oversampling": oversampling},
            {},
            power_sum_db(cubic_db, _REFINED_DB),
            form_s,
            table_seconds=samples * _SAMPLE_S,
            table_bytes=8 * samples,
            reasons={"oversampling": reason},
        )


def cubic_error_db(oversampling: float, window: NDArray[np.float64]) -> float:
    """Return the RMS error, dB, of four-point Lagrange interpolation of echoes with a window, (subcarrier,).

    Examples
    --------
    >>> [round(cubic_error_db(n, window)) for window in (np.ones(64), np.hanning(64)) for n in (4, 8)]
    [-54, -78, -72, -95]
    """
    omega = np.pi / oversampling * BAND
    u = np.linspace(0, 1, 41)[:, None]
    weights = (
        -u * (u - 1) * (u - 2) / 6,
        (u + 1) * (u - 1) * (u - 2) / 2,
        -(u + 1) * u * (u - 2) / 2,
        (u + 1) * u * (u - 1) / 6,
    )
    value = sum(weight * np.exp(1j * omega * (n - 1)) for n, weight in enumerate(weights))
    return band_error_db((np.abs(value - np.exp(1j * omega * u)) ** 2).mean(axis=0), window)


@dataclass(frozen=True)
class OversampledTables:
    """Oversampled range profiles.

    Attributes
    ----------
    samples
        (pulse, range) complex64.
    start_m
        (pulse,) float64, total path of sample 0, metres.
    step_m
        Total path between samples, metres.
    wavenumber_rad_m
        2πf_mid/c.
    aperture
        Phase centres in the frame of the pixels.
    """

    samples: NDArray[np.complex64]
    start_m: NDArray[np.float64]
    step_m: float
    wavenumber_rad_m: float
    aperture: Aperture

    def __getitem__(self, pulses: slice) -> "OversampledTables":
        """Return the tables of a slice of pulses, as views."""
        return replace(self, samples=self.samples[pulses], start_m=self.start_m[pulses], aperture=self.aperture[pulses])


def prepare(profiles: Profiles, *, oversampling: int = 8) -> OversampledTables:
    """Return tables with `oversampling` samples per resolution cell.

    Parameters
    ----------
    profiles
        Profiles with an oversampling of at least 2, so that half of the band is available for the transition of the
        filter.
    oversampling
        Samples per range cell c/B; with 8 samples per cell, the error of cubic interpolation is about -80 dB
        (docs/theory/planner.md, "Error").
    """
    factor = max(1, round(oversampling / profiles.oversampling))
    fine = refine(profiles.samples, factor)
    return OversampledTables(
        np.ascontiguousarray(fine, np.complex64),
        profiles.start_m,
        profiles.step_m / factor,
        profiles.wavenumber_rad_m,
        profiles.aperture,
    )


def refine(samples: NDArray[np.complex64], factor: int) -> NDArray[np.complex64]:
    """Interpolate samples to `factor` times the sampling rate by a windowed sinc; the first samples coincide.

    Parameters
    ----------
    samples
        (pulse, range) complex64, with an oversampling of at least 2.
    factor
        Number of new samples per original sample.

    Returns
    -------
    ndarray
        (pulse, range·factor) complex64; within ten samples of an end, missing neighbours are assumed to be zero.

    Examples
    --------
    >>> tone = np.exp(0.5j * np.arange(64)).astype(np.complex64)[None]
    >>> exact = np.exp(0.5j * np.arange(256) / 4)
    >>> bool(np.abs(refine(tone, 4)[0] - exact)[64:192].max() < 2e-5)
    True
    """
    padded = np.pad(samples, ((0, 0), (_HALF_TAPS, _HALF_TAPS)))
    near = np.lib.stride_tricks.sliding_window_view(padded, 2 * _HALF_TAPS, axis=1)[:, 1:]
    fine = np.empty((*samples.shape, factor), np.complex64)
    for phase in range(factor):
        distance = phase / factor - np.arange(1.0 - _HALF_TAPS, _HALF_TAPS + 1)
        fine[..., phase] = near @ kaiser_sinc(distance, half=_HALF_TAPS, beta=_KAISER_BETA).astype(np.float32)
    return fine.reshape(len(samples), -1)


def form(
    tables: OversampledTables, pixels: NDArray[np.float64], *, beams: Beams | None = None
) -> NDArray[np.complex64]:
    """Return Σ p(R)·exp(+j2πf_mid·R/c) over the pulses at each pixel, with R the total path.

    Parameters
    ----------
    tables
        Tables from `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres.
    beams
        Antenna weight of each pulse at each pixel (default: 1).

    Returns
    -------
    ndarray
        (y, x) complex64. A pulse does not contribute to a pixel with a path outside the table.

    Notes
    -----
    Source: docs/theory.md, eq. 6, with four-point Lagrange interpolation.
    """
    beams = beams and beams.on_profiles
    flat = np.ascontiguousarray(pixels.reshape(-1, 3))
    image = np.zeros(len(flat), np.complex128)
    none, at_once = np.empty((0, 0)), len(flat) if beams is None else _PIXELS_AT_ONCE
    for first in range(0, len(flat), at_once):
        part = slice(first, first + at_once)
        _accumulate(
            tables.samples,
            tables.start_m,
            tables.step_m,
            tables.wavenumber_rad_m,
            *tables.aperture.legs,
            flat[part],
            none if beams is None else beams.weight(tables.aperture, flat[part]),
            image[part],
        )
    return image.reshape(pixels.shape[:-1]).astype(np.complex64)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(samples, start, step, wavenumber, tx, rx, pixels, weights, image):  # type: ignore[no-untyped-def]  # noqa: PLR0917
    pulses, length = samples.shape
    for i in range(len(pixels)):
        x, y, z = pixels[i, 0], pixels[i, 1], pixels[i, 2]
        total = 0.0 + 0.0j
        for p in range(pulses):
            path = np.sqrt((x - tx[p, 0]) ** 2 + (y - tx[p, 1]) ** 2 + (z - tx[p, 2]) ** 2) + np.sqrt(
                (x - rx[p, 0]) ** 2 + (y - rx[p, 1]) ** 2 + (z - rx[p, 2]) ** 2
            )
            position = (path - start[p]) / step
            k = int(np.floor(position))
            if k < 1 or k > length - 3:
                continue
            u = position - k
            value = (
                samples[p, k - 1] * (-u * (u - 1) * (u - 2) / 6)
                + samples[p, k] * ((u + 1) * (u - 1) * (u - 2) / 2)
                - samples[p, k + 1] * ((u + 1) * u * (u - 2) / 2)
                + samples[p, k + 2] * ((u + 1) * u * (u - 1) / 6)
            )
            phase = wavenumber * path
            if weights.size:
                value *= weights[p, i]
            total += value * (np.cos(phase) + 1j * np.sin(phase))
        image[i] += total
