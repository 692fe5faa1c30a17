"""What the planner is asked and what it answers: a job and a plan, as frozen values."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.antenna.illumination import Illumination
from apertura.focus.inputs import Profiles
from apertura.focus.presum import Presum, thin
from apertura.planning.candidates import Setting, Signal
from apertura.planning.cost import Load
from apertura.planning.models import Decision, GroundModels
from apertura.planning.view import View, look
from apertura.scene.terrain import Terrain

_VIEW_PULSES = 48


@dataclass(frozen=True)
class Job:
    """What is to be imaged, as numbers.

    Attributes
    ----------
    tx_position_m, rx_position_m
        (pulse, 3) float64, phase centres in the frame of the pixels, metres.
    net_m
        (row, column, 3) float64, metres: places evenly spread over the scene, corners included; rows go south.
    shape
        Rows and columns of the image.
    spacing_m
        Of the pixels.
    centre_hz, bandwidth_hz, subcarriers
        Of the waveform.
    signal
        What the profiles hold.
    frame
        'ecef' or 'local'.
    tile_px, threads
        Side of a tile; tiles formed at once.
    ground
        The scene's ground and its cheaper models.
    path_limit_m
        Longest total path inside the cyclic prefix.
    memory_bytes
        What the imaging step may use.
    content_db
        How much weaker the scene's pixels are than the incoherent sum of what the pulses add, from `content_loss_db`:
        errors of tables weigh that much more. None before anything was recorded.
    beams, illumination
        Of the antennas, where they have any, over all pulses.
    """

    tx_position_m: NDArray[np.float64]
    rx_position_m: NDArray[np.float64]
    net_m: NDArray[np.float64]
    shape: tuple[int, int]
    spacing_m: float
    centre_hz: float
    bandwidth_hz: float
    subcarriers: int
    signal: Signal
    frame: str = "ecef"
    tile_px: int = 256
    threads: int = 1
    ground: GroundModels = field(default_factory=GroundModels.level)
    path_limit_m: float = np.inf
    memory_bytes: float = np.inf
    content_db: float | None = None
    beams: Beams | None = None
    illumination: Illumination | None = None

    @property
    def load(self) -> Load:
        """How much there is to do, with every pulse."""
        rows, columns = self.shape
        tiles = -(-rows // self.tile_px) * -(-columns // self.tile_px)
        return Load(rows * columns, len(self.tx_position_m), self.subcarriers, tiles, 0, self.frame)

    @property
    def view(self) -> View:
        """How the scene is seen, from some of the pulses."""
        some = slice(None, None, max(1, len(self.tx_position_m) // _VIEW_PULSES))
        beams = self.beams and self.beams.at(some)
        return look(self.tx_position_m[some], self.rx_position_m[some], self.net_m, self.spacing_m, beams)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency."""
        return (self.centre_hz - self.bandwidth_hz / 2, self.centre_hz + self.bandwidth_hz / 2)

    @property
    def place_m(self) -> NDArray[np.float64]:
        """The net as (place, 3), its middle in the middle."""
        return self.net_m.reshape(-1, 3)


@dataclass(frozen=True)
class Plan:
    """How an image will be formed.

    Attributes
    ----------
    setting
        Engine and options.
    better
        Next better settings, for tiles whose certified error is worse than asked; the last one is `reference`.
    decisions
        Every choice with its reason.
    predicted_error_db
        RMS on random pixels: of the setting and of the models.
    predicted_seconds
        Tables and tiles.
    memory_bytes, disk_bytes
        Peak of the imaging step; what it leaves in the results folder.
    flags
        Edges that the job crosses: name → what was found, in one line.
    presum, midpoint, middle_m
        What `history` applies.
    terrain
        The ground that is imaged on: as it is, a plane through it, or flat.
    cost_source
        Where the costs came from.
    illumination
        Of the job.
    """

    setting: Setting
    better: tuple[Setting, ...]
    decisions: tuple[Decision, ...]
    predicted_error_db: float
    predicted_seconds: float
    memory_bytes: int
    disk_bytes: int
    flags: Mapping[str, str]
    terrain: Terrain
    presum: Presum | None = field(default=None, repr=False)
    midpoint: bool = False
    middle_m: NDArray[np.float64] | None = field(default=None, repr=False)
    cost_source: str = ""
    illumination: Illumination | None = field(default=None, repr=False)

    @property
    def engine(self) -> str:
        """A key of `ENGINES`."""
        return self.setting.engine

    @property
    def options(self) -> dict[str, Any]:
        """Keywords of the engine's `prepare`."""
        return dict(self.setting.options)

    @property
    def form_options(self) -> dict[str, Any]:
        """Keywords of the engine's `form`."""
        return dict(self.setting.form_options)

    @property
    def reasons(self) -> dict[str, str]:
        """Choice → value and reason, in one line."""
        return {decision.name: f"{decision.value}: {decision.reason}" for decision in self.decisions}

    @property
    def choices(self) -> dict[str, Any]:
        """Choice → value: all that the image's pixels depend on, and no prediction."""
        return {decision.name: decision.value for decision in self.decisions} | {"ground": self.terrain.spec}

    def history(self, profiles: Profiles) -> Profiles:
        """Return the profiles that the plan's setting is given: the image's sum over pulses stays the same.

        Settings of `better` are given the profiles as they are.
        """
        if self.midpoint:
            middle = (profiles.tx_position_m + profiles.rx_position_m) / 2
            profiles = replace(profiles, tx_position_m=middle, rx_position_m=middle)
        if self.presum is not None and self.middle_m is not None:
            profiles = thin(profiles, self.presum, self.middle_m)
        return profiles
