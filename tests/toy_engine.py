"""An engine outside the package: one file and one row of the engine table. It uses the nearest sample."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from apertura.core.backprojection.engines.engine import EngineOptions, Setting
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Job

READS = "profiles"
CALLS: list[str] = []
"""Functions called, in order."""


class Options(EngineOptions):
    """Options of the engine."""

    refine: int | None = None


def available() -> bool:
    return True


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield a setting per refinement, at a cost so low that the planner selects it wherever -20 dB suffices."""
    for refine in (requested.get("refine"),) if requested.get("refine") else (1, 4):
        yield Setting(
            "toy",
            {"refine": refine},
            {},
            -26.0 - 6.0 * np.log2(refine),
            1e-15 * job.pixels * pulses,
            reasons={"refine": "nearest sample of a refined profile"},
        )


def prepare(profiles: Profiles, *, refine: int) -> tuple[Profiles, int]:
    CALLS.append("prepare")
    return profiles, refine


def form(prepared: tuple[Profiles, int], pixels: np.ndarray, *, beams: Any = None) -> np.ndarray:
    """Return the sum over the pulses of the nearest refined samples, with the carrier phase restored."""
    CALLS.append("form")
    profiles, refine = prepared
    length = profiles.samples.shape[1]
    spectrum = np.fft.fft(profiles.samples, axis=1)
    middle = np.zeros((len(profiles), refine * length), complex)
    half = length // 2
    middle[:, :half], middle[:, -(length - half) :] = spectrum[:, :half], spectrum[:, half:]
    fine = refine * np.fft.ifft(middle, axis=1)
    flat, k = pixels.reshape(-1, 3), 2 * np.pi * profiles.centre_frequency_hz / 299792458.0
    path = profiles.aperture.path(flat)
    place = np.rint((path - profiles.start_m[:, None]) / (profiles.step_m / refine)).astype(int)
    values = np.take_along_axis(fine, np.clip(place, 0, fine.shape[1] - 1), axis=1) * np.exp(1j * k * path)
    return values.sum(axis=0).reshape(pixels.shape[:-1])
