"""The image of profiles by band-limited interpolation in float64: what engines answer to where there is no echo."""

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.focus.inputs import Profiles
from apertura.core.interpolation import kaiser_sinc

_HALF_TAPS = 24
_KAISER_BETA = 22.0  # -190 dB with half the band free for the transition
_PULSES_AT_ONCE = 16


def band_limited_image(
    profiles: Profiles, pixels: NDArray[np.float64], *, beams: Beams | None = None
) -> NDArray[np.complex128]:
    """Return Σ p(ρ)·exp(+j2πf_mid ρ/c) over the pulses at each pixel, p between samples by a long windowed sinc.

    Parameters
    ----------
    profiles
        Twice oversampled or more, with 24 samples or more beyond the scene at both ends; samples beyond count as zero.
    pixels
        (pixel, 3) float64, metres, in the frame of the phase centres.
    beams
        Weight of each pulse at each pixel by its antennas; none by default.

    Returns
    -------
    ndarray
        (pixel,) complex128.

    Notes
    -----
    Source: docs/theory.md, eq. 6.
    """
    k = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
    taps = np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    padded = np.pad(profiles.samples.astype(np.complex128), [(0, 0), (_HALF_TAPS, _HALF_TAPS)])
    image = np.zeros(len(pixels), np.complex128)
    for first in range(0, len(profiles), _PULSES_AT_ONCE):
        part = slice(first, first + _PULSES_AT_ONCE)
        path = profiles.aperture[part].path(pixels)
        place = (path - profiles.start_m[part, None]) / profiles.step_m
        whole = np.floor(place).astype(np.int64)
        distance = (place - whole)[..., None] - taps
        weights = kaiser_sinc(distance, half=_HALF_TAPS, beta=_KAISER_BETA)
        index = np.clip(whole[..., None] + taps + _HALF_TAPS, 0, padded.shape[1] - 1)
        samples = np.take_along_axis(padded[part, None], index, axis=2)
        value = (samples * weights).sum(-1) * np.exp(1j * np.remainder(k * path, 2 * np.pi))
        if beams is not None:
            value *= beams[part].weight(profiles.aperture[part], pixels)
        image += value.sum(axis=0)
    return image
