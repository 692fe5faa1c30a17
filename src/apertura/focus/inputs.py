"""What an engine is given: the recorded history as plain arrays, without settings or files."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.geometry.aperture import Aperture


@dataclass(frozen=True)
class PhaseHistory:
    """Calibrated transfer functions, as `reference` sums them.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ - reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, RF frequency.
    weight
        (subcarrier,) float64, window over the subcarriers.
    reference_delay_s
        (pulse,) float64, delay already removed from `transfer`.
    aperture
        Phase centres in the frame of the pixels.

    Raises
    ------
    ValueError
        If the shapes do not belong together.
    """

    transfer: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]
    weight: NDArray[np.float64]
    reference_delay_s: NDArray[np.float64]
    aperture: Aperture

    def __post_init__(self) -> None:
        pulses, subcarriers = self.transfer.shape if self.transfer.ndim == 2 else (-1, -1)
        if (len(self.aperture), self.reference_delay_s.shape) != (pulses, (pulses,)):
            raise ValueError(
                f"{self.transfer.shape=}, {self.reference_delay_s.shape=}, {len(self.aperture)=}: must be "
                "(pulse, subcarrier), (pulse,) and as many pulses"
            )
        if not self.frequency_hz.shape == self.weight.shape == (subcarriers,):
            raise ValueError(
                f"{self.transfer.shape=}, {self.frequency_hz.shape=}, {self.weight.shape=}: must be "
                "(pulse, subcarrier) and (subcarrier,) twice"
            )

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.transfer)

    def __getitem__(self, pulses: slice) -> "PhaseHistory":
        """Return the phase history of some pulses, as views."""
        return replace(
            self,
            transfer=self.transfer[pulses],
            reference_delay_s=self.reference_delay_s[pulses],
            aperture=self.aperture[pulses],
        )


@dataclass(frozen=True)
class Profiles:
    """Range profiles of a band-limited signal, cropped to the scene.

    Sample i of pulse p lies at total path ``start_m[p] + i·step_m`` and holds
    Σ_n w_n H_n exp(+j2π(f_n - f_mid)·path/c) (with H_n for absolute delay), so that
    profile·exp(+j2π f_mid·path/c) is in phase at a target.

    Attributes
    ----------
    samples
        (pulse, range) complex64, oversampled by `oversampling` ≥ 2 against c/B of total path.
    start_m
        (pulse,) float64, total path tx → pixel → rx of sample 0, metres.
    step_m
        Total path between samples, metres.
    centre_frequency_hz
        f_mid.
    oversampling
        Nyquist cells per sample inverted: (c/B)/step_m.
    aperture
        Phase centres in the frame of the pixels.

    Raises
    ------
    ValueError
        If the shapes do not belong together, or the step is not positive.
    """

    samples: NDArray[np.complex64]
    start_m: NDArray[np.float64]
    step_m: float
    centre_frequency_hz: float
    oversampling: float
    aperture: Aperture

    def __post_init__(self) -> None:
        pulses = len(self.samples) if self.samples.ndim == 2 else -1
        if (len(self.aperture), self.start_m.shape) != (pulses, (pulses,)):
            raise ValueError(
                f"{self.samples.shape=}, {self.start_m.shape=}, {len(self.aperture)=}: must be (pulse, range), "
                "(pulse,) and as many pulses"
            )
        if not 0 < self.step_m < np.inf:
            raise ValueError(f"{self.step_m=}: must be positive")

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.samples)

    def __getitem__(self, pulses: slice) -> "Profiles":
        """Return the profiles of some pulses, as views; images of pulse blocks add up to the image of all."""
        return replace(
            self,
            samples=self.samples[pulses],
            start_m=self.start_m[pulses],
            aperture=self.aperture[pulses],
        )
