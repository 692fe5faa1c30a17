"""Echoes of single pulses at single places: how samples make them, and pulses read and laid out for that."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.engines.native_constants import KERNEL
from apertura.core.focus.engines.native_structs import EchoJob
from apertura.core.focus.inputs import Profiles

TAPS, DEGREE = KERNEL.echo_taps, KERNEL.echo_degree

_BYTES_AT_ONCE = 2**25  # of samples
_VALUES_AT_ONCE = 2**17  # pulses × places: of beams, and without the compiled library


@lru_cache
def tap_polynomials() -> NDArray[np.float64]:
    """Return the weight of each sample about a place as a polynomial of where between its neighbours the place is.

    Returns
    -------
    ndarray
        (degree + 1, tap) float64, constant term first; of -½…½ from the middle between taps 3 and 4.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 5: least squares over the band of twice oversampled profiles, value and
    slope steady from one sample to the next.

    Examples
    --------
    >>> weights = 0.25 ** np.arange(DEGREE + 1) @ tap_polynomials()
    >>> tone = np.exp(0.5j * np.pi * 0.9 * np.arange(TAPS))
    >>> bool(abs(weights @ tone - np.exp(0.5j * np.pi * 0.9 * 3.75)) < 1e-3)
    True
    """
    omega = np.pi / 2 * np.cos(np.pi * (np.arange(160) + 0.5) / 160)
    place, share = (part / 2 for part in np.polynomial.legendre.leggauss(24))
    powers = place[:, None] ** np.arange(DEGREE + 1)
    tap = np.arange(TAPS) - (TAPS - 1) / 2
    root = np.sqrt(share)
    given = np.einsum("wt,un,u->wutn", np.exp(1j * omega[:, None] * tap), powers, root).reshape(
        -1, powers[0].size * TAPS
    )
    wanted = (np.exp(1j * omega[:, None] * place) * root).ravel()
    left, right = (np.concatenate([part.real, part.imag]) for part in (given, wanted))
    free = _joined()
    found = free @ np.linalg.lstsq(left @ free, right, rcond=None)[0]
    return np.ascontiguousarray(found.reshape(TAPS, DEGREE + 1).T)


@lru_cache
def _rounded_taps() -> NDArray[np.float32]:
    return tap_polynomials().astype(np.float32)


def _joined() -> NDArray[np.float64]:
    """Return (tap·power, free) the polynomials whose weights and slopes go on where the next sample becomes nearest."""
    power = np.arange(DEGREE + 1)
    joins: list[NDArray[np.float64]] = []
    for end in (0.5**power, power * 0.5 ** (power - 1.0)):
        parity = end * (-1.0) ** (power + len(joins))
        joins.append(np.kron(np.eye(TAPS + 1, TAPS), end) - np.kron(np.eye(TAPS + 1, TAPS, k=-1), parity))
    conditions = np.concatenate(joins)
    return np.linalg.qr(conditions.T, mode="complete")[0][:, len(conditions) :]


@dataclass(frozen=True, eq=False)
class Echoes:
    """Samples of some pulses with zeros around them, as the compiled library reads them.

    Attributes
    ----------
    samples
        (pulse, 2, sample) float32: real and imaginary parts.
    tx_m, rx_m
        (3, pulse) float64, phase centres, metres, in the frame of the places.
    start_m
        (pulse,) float64, total path of sample 0.
    step_m
        Total path between samples.
    turns_per_m
        f_mid/c.
    """

    samples: NDArray[np.float32]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    start_m: NDArray[np.float64]
    step_m: float
    turns_per_m: float

    @classmethod
    def read(cls, profiles: Profiles, parts: list[slice]) -> "Echoes":
        """Return the pulses of some slices one after the other, of which no others are read."""
        read = np.concatenate([np.asarray(profiles.samples[part]) for part in parts])
        samples = np.zeros((len(read), 2, read.shape[1] + 2 * TAPS), np.float32)
        samples[:, 0, TAPS:-TAPS], samples[:, 1, TAPS:-TAPS] = read.real, read.imag
        tx, rx = (np.concatenate([leg[part] for part in parts]).T for leg in profiles.aperture.legs)
        return cls(
            samples,
            np.ascontiguousarray(tx, np.float64),
            np.ascontiguousarray(rx, np.float64),
            np.concatenate([profiles.start_m[part] for part in parts]) - TAPS * profiles.step_m,
            profiles.step_m,
            profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S,
        )

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.samples)

    def at(self, places_m: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return s(R)·exp(j2πf_mid R/c) at some places and its derivative with respect to the path R.

        What the compiled library computes, in float64.

        Parameters
        ----------
        places_m
            (place, 3) float64, metres.

        Returns
        -------
        value, slope
            (pulse, place) complex128; the slope per metre.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 4 and 5.
        """
        tx, rx = (np.linalg.norm(places_m - leg.T[:, None], axis=-1) for leg in (self.tx_m, self.rx_m))
        path = tx + rx
        at = (path - self.start_m[:, None]) / self.step_m
        at = np.clip(at, TAPS / 2 - 0.5, self.samples.shape[-1] - TAPS / 2 - 0.5)
        whole = np.rint(at - 0.5)
        first = np.nan_to_num(whole).astype(np.int64) - (TAPS // 2 - 1)
        near = np.clip(first, 0, None)[..., None] + np.arange(TAPS)
        pulse = np.arange(len(self))[:, None, None]
        samples = self.samples[pulse, 0, near] + 1j * self.samples[pulse, 1, near]
        u, taps = at - 0.5 - whole, tap_polynomials()
        powers = u[..., None] ** np.arange(DEGREE + 1)
        level = np.einsum("pxn,nt,pxt->px", powers, taps, samples)
        rate = np.einsum("pxn,nt,pxt->px", powers[..., :-1], taps[1:] * np.arange(1, DEGREE + 1)[:, None], samples)
        carrier = np.exp(2j * np.pi * np.remainder(self.turns_per_m * path, 1.0))
        return level * carrier, (rate / self.step_m + 2j * np.pi * self.turns_per_m * level) * carrier


def job_of(echoes: Echoes, places_m: NDArray[np.float64], weight: NDArray[np.float32]) -> EchoJob:
    """Return the job of looking at some places, for the compiled library; what it shall give is still to be set.

    Parameters
    ----------
    echoes
        Held by the caller while the job runs, as are the other arrays.
    places_m
        (place, 3) float64, contiguous.
    weight
        (place or 1, pulse) float32, contiguous: of each pulse at each place, or at all.
    """
    arrays = (echoes.samples, _rounded_taps(), echoes.tx_m, echoes.rx_m, echoes.start_m, weight, places_m)
    return EchoJob(
        *(array.ctypes.data for array in arrays),
        pulses=len(echoes),
        length=echoes.samples.shape[2],
        count=len(places_m),
        weight_step=len(echoes) if len(weight) > 1 else 0,
        samples_per_metre=1 / echoes.step_m,
        turns_per_metre=echoes.turns_per_m,
    )


def pulses_at_once(profiles: Profiles) -> int:
    """Return how many pulses are read at once."""
    return max(1, _BYTES_AT_ONCE // (8 * (int(profiles.samples.shape[1]) + 2 * TAPS)))


def tiles(places: int, pulses: int) -> Iterator[slice]:
    """Yield slices of places of which so few are looked at together that memory stays bounded."""
    step = max(1, _VALUES_AT_ONCE // max(1, pulses))
    for first in range(0, places, step):
        yield slice(first, first + step)
