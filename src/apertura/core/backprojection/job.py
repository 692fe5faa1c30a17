"""Numerical description of an imaging job, which is the input of the planner and of the predictions of engines."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import Illumination
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector
from apertura.core.scene.terrain import GroundModels, Terrain


@dataclass(frozen=True, eq=False)
class Signal:
    """Signal of the profiles.

    Attributes
    ----------
    centre_hz
        Centre frequency f_mid, Hz.
    oversampling
        Samples per range cell c/B.
    step_m
        Total path between samples.
    samples
        Number of samples per pulse.
    window
        (subcarrier,) float64, weights over the band with an arbitrary scale (default: flat).
    wave_speed_m_s
        As in `Profiles`.
    """

    centre_hz: float
    oversampling: float
    step_m: float
    samples: int
    window: NDArray[np.float64] = field(default_factory=lambda: np.ones(1), repr=False)
    wave_speed_m_s: float = SPEED_OF_LIGHT_M_S

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/v."""
        return 2 * np.pi * self.centre_hz / self.wave_speed_m_s


@dataclass(frozen=True, eq=False)
class Integration:
    """Part of a flight that is integrated for the pixels of an image.

    Attributes
    ----------
    sector
        Integrated sector; None if every pulse contributes to every pixel.
    count
        Divisor of the sum: number of all pulses, or largest number of pulses inside the sector at any point of the
        scene.
    value, reason
        Selected integration, and reason for the selection, one phrase each.
    share
        Fraction of pixel-pulse pairs that is summed.
    report
        Section of image.json.
    flags
        Flag → measured values, for exceeded limits.
    """

    sector: Sector | None
    count: int
    value: str
    reason: str
    share: float = 1.0
    report: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Job:
    """Imaging job.

    Attributes
    ----------
    aperture
        Phase centres in the frame of the pixels.
    ground_m
        (row, column, 3) float64, points evenly distributed over the scene, including corners, metres; rows go south.
    shape
        Rows and columns of the image.
    spacing_m
        Pixel spacing.
    centre_hz, bandwidth_hz, subcarriers
        Centre frequency, bandwidth and number of subcarriers of the waveform.
    signal
        Signal of the profiles.
    frame
        'ecef' or 'local'.
    tile_px, threads
        Side of a tile, pixels; and number of tiles formed concurrently.
    terrain
        Terrain of the scene, with simplified models.
    memory_bytes
        Memory limit of the imaging step.
    beams, illumination
        Weights of all pulses from antenna beams, the integrated sector and the recorded paths; and illumination by
        beams and sector. None without them.
    integration
        Integrated part of the flight; None for the whole flight.
    recorded
        True if a phase history is available, which is required for the double sum.
    patches_on
        Function of a terrain that returns pixel positions in windows of the scene, (y, x, 3) float64 each, metres; None
        if pixel positions are not known.
    patches_m
        Pixel positions in these windows on the selected terrain model; if empty, planes about points of `ground_m` are
        used.
    """

    aperture: Aperture
    ground_m: NDArray[np.float64]
    shape: tuple[int, int]
    spacing_m: float
    centre_hz: float
    bandwidth_hz: float
    subcarriers: int
    signal: Signal
    frame: str = "ecef"
    tile_px: int = 256
    threads: int = 1
    terrain: GroundModels = field(default_factory=GroundModels.flat)
    memory_bytes: float = np.inf
    beams: Beams | None = None
    illumination: Illumination | None = None
    integration: Integration | None = None
    recorded: bool = True
    patches_on: Callable[[Terrain], tuple[NDArray[np.float64], ...]] | None = None
    patches_m: tuple[NDArray[np.float64], ...] = ()

    @property
    def pixels(self) -> int:
        """Number of pixels of the image."""
        return self.shape[0] * self.shape[1]

    @property
    def tiles(self) -> int:
        """Number of tiles of the image."""
        return -(-self.shape[0] // self.tile_px) * -(-self.shape[1] // self.tile_px)

    @property
    def antennas(self) -> int:
        """Number of antennas with a beam, 0 to 2."""
        return 0 if self.beams is None else sum(beam is not None for beam in (self.beams.transmit, self.beams.receive))

    @property
    def weights(self) -> int:
        """Number of weight factors of a pulse at a pixel."""
        return self.antennas + (self.sector is not None)

    @property
    def sector(self) -> Sector | None:
        """Integrated sector; None if every pulse contributes to every pixel."""
        return None if self.beams is None else self.beams.sector

    @property
    def share(self) -> float:
        """Fraction of pixel-pulse pairs that is summed."""
        return 1.0 if self.integration is None else self.integration.share

    @property
    def count(self) -> int:
        """Number of pulses by which the sum is divided."""
        return len(self.aperture) if self.integration is None else self.integration.count

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency."""
        return (self.centre_hz - self.bandwidth_hz / 2, self.centre_hz + self.bandwidth_hz / 2)

    @property
    def wavelength_m(self) -> float:
        """Wavelength at band centre."""
        return self.signal.wave_speed_m_s / self.centre_hz

    @property
    def points_m(self) -> NDArray[np.float64]:
        """`ground_m` as (point, 3); the central element is the scene centre."""
        return self.ground_m.reshape(-1, 3)
