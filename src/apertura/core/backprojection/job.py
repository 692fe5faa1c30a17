"""An imaging job as numbers: the input of the planner and of the engines' predictions."""

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
        f_mid.
    oversampling
        Samples per cell c/B.
    step_m
        Total path between samples.
    samples
        Per pulse.
    window
        (subcarrier,) float64, weights over the band, of any scale; flat by default.
    wave_speed_m_s
        As of `Profiles`.
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
    """Over how much of a flight pixels are integrated.

    Attributes
    ----------
    sector
        None: every pulse counts for every pixel.
    count
        Pulses that the sum is divided by: all, or the most that a place of the scene takes inside the sector.
    value, reason
        What was chosen, and why, in a few words.
    share
        Of pixels × pulses that are summed.
    report
        Section of image.json.
    flags
        Limits crossed → what was measured.
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
    """What is to be imaged.

    Attributes
    ----------
    aperture
        Phase centres in the frame of the pixels.
    ground_m
        (row, column, 3) float64, metres: points spread evenly over the scene, corners included; rows go south.
    shape
        Rows and columns of the image.
    spacing_m
        Of the pixels.
    centre_hz, bandwidth_hz, subcarriers
        Of the waveform.
    signal
        Signal of the profiles.
    frame
        'ecef' or 'local'.
    tile_px, threads
        Side of a tile; tiles formed at once.
    terrain
        The scene's ground and its cheaper models.
    path_limit_m
        Longest total path inside the cyclic prefix.
    memory_bytes
        What the imaging step may use.
    beams, illumination
        Of the antennas, where they have any, and of the sector integrated; over all pulses.
    integration
        Over how much of the flight; None: all of it.
    recorded
        Whether there is a phase history, which the double sum needs.
    patches_on
        Ground → places of the pixels of some windows of the scene, each (y, x, 3) float64, metres; None: unknown.
    patches_m
        The same on the decided model of the ground; none: planes about points of `ground_m`.
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
    path_limit_m: float = np.inf
    memory_bytes: float = np.inf
    beams: Beams | None = None
    illumination: Illumination | None = None
    integration: Integration | None = None
    recorded: bool = True
    patches_on: Callable[[Terrain], tuple[NDArray[np.float64], ...]] | None = None
    patches_m: tuple[NDArray[np.float64], ...] = ()

    @property
    def pixels(self) -> int:
        """How many the image has."""
        return self.shape[0] * self.shape[1]

    @property
    def tiles(self) -> int:
        """How many the image is formed by."""
        return -(-self.shape[0] // self.tile_px) * -(-self.shape[1] // self.tile_px)

    @property
    def antennas(self) -> int:
        """How many of both antennas have a beam."""
        return 0 if self.beams is None else sum(beam is not None for beam in (self.beams.transmit, self.beams.receive))

    @property
    def weights(self) -> int:
        """How many weights a pulse has at a pixel."""
        return self.antennas + (self.sector is not None)

    @property
    def sector(self) -> Sector | None:
        """Inside which pulses count; None: all of them."""
        return None if self.beams is None else self.beams.sector

    @property
    def share(self) -> float:
        """Of pixels × pulses that are summed."""
        return 1.0 if self.integration is None else self.integration.share

    @property
    def count(self) -> int:
        """Pulses that the sum is divided by."""
        return len(self.aperture) if self.integration is None else self.integration.count

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency."""
        return (self.centre_hz - self.bandwidth_hz / 2, self.centre_hz + self.bandwidth_hz / 2)

    @property
    def wavelength_m(self) -> float:
        """Of the band centre."""
        return self.signal.wave_speed_m_s / self.centre_hz

    @property
    def points_m(self) -> NDArray[np.float64]:
        """`ground_m` as (point, 3), its middle in the middle."""
        return self.ground_m.reshape(-1, 3)
