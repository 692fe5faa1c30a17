"""What forms the tiles of one pair's image, whichever job does it: history, ground, plan and grid."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.focus.engines import ENGINES
from apertura.focus.tiles import Former, form_blocks
from apertura.load.inputs import profiles_of
from apertura.load.pair import outlook_of
from apertura.load.scene import OpenScene, open_scene
from apertura.planning.candidates import Setting
from apertura.planning.plan import Plan
from apertura.provenance import sha256_file
from apertura.steps.plan import plan_known
from apertura.steps.stamping import stamped
from apertura.store import open_stage


@dataclass(frozen=True)
class Work:
    """Everything that forms a tile.

    Attributes
    ----------
    folder
        Where the stage will lie.
    echo
        The stage that image.json quotes.
    history
        'echo' → `Spectra`, 'profile' → `Profiles`.
    beams
        Of the antennas; None where they look everywhere alike.
    scene
        The campaign's grid and ground.
    plan
        How the image is formed, and on which model of the ground.
    empty
        The stamped stage `image`, without its pixels.
    windows
        Every tile.
    threads
        Tiles in work at once.
    """

    folder: Path
    echo: xr.Dataset
    history: dict[str, Any]
    beams: Beams | None
    scene: OpenScene
    plan: Plan
    empty: xr.Dataset
    windows: list[Window]
    threads: int

    @classmethod
    def of(cls, campaign: Campaign, flight: str, pair: str, *, module: str, threads: int) -> "Work":
        """Open what a pair's image is made from, and plan it; `module` as `apertura.steps.stamping.stamped`."""
        echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
        scene, outlook = open_scene(campaign), outlook_of(campaign, flight, pair, echo=echo)
        history = {"echo": outlook.spectra, "profile": profiles_of(profile)}
        plan = plan_known(campaign, flight, pair, outlook, scene, threads=threads)
        # Blocks of pulses are of the machine, not of the work: jobs with less memory share it all the same.
        choices = {name: value for name, value in plan.choices.items() if name != "pulse_blocks"}
        empty = stamped(
            _empty(scene, pair, echo.attrs["flags"]),
            "image",
            module=module,
            parents=[echo, profile, *scene.parents],
            inputs={name: sha256_file(path) for name, path in campaign.pattern_files(pair).items()},
            settings={**campaign.relevant("image", pair), **scene.spec, "plan": choices},
        )
        folder, windows = (
            campaign.stage("image", flight, pair),
            list(scene.grid.tiles(campaign.settings.processing.tile_px)),
        )
        return cls(folder, echo, history, outlook.beams, scene, plan, empty, windows, threads)

    def form(self, target: Any, setting: Setting, windows: list[Window], *, planned: bool = False) -> None:
        """Form and write tiles with an engine; the image is the mean over the pulses.

        Parameters
        ----------
        target
            (y, x) zarr array of work in progress.
        setting
            Engine and options.
        windows
            Which tiles.
        planned
            Whether the engine is given the profiles as the plan wants them: thinned, or with a pair's midpoint.
        """
        if not windows:
            return
        engine = ENGINES[setting.engine]
        history = self.history[engine.reads]
        if planned and engine.reads == "profile":
            history = self.plan.history(history)
        count = np.float32(len(self.history["echo"].transfer))

        def former(pulses: slice) -> Former:
            prepared = engine.prepare(history.of_pulses(pulses), **setting.options)
            options = {"beams": self.beams and self.beams.at(pulses), **setting.form_options}
            return lambda pixels: np.asarray(engine.form(prepared, pixels, **options) / count, np.complex64)

        form_blocks(
            former,
            len(history.tx_position_m),
            self.scene.grid,
            self.plan.terrain,
            windows,
            blocks=setting.pulse_blocks,
            write=target.__setitem__,
            scratch=self.folder.parent,
            threads=self.threads,
        )

    def form_planned(self, target: Any, windows: list[Window]) -> None:
        """Form tiles as the plan says."""
        print(f"{len(windows)} of {len(self.windows)} tiles to form with {self.plan.setting.line}", flush=True)
        self.form(target, self.plan.setting, windows, planned=True)

    def places(self, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the ground."""
        return self.plan.terrain.positions_at(self.scene.grid, row, column)


def _empty(scene: OpenScene, pair: str, flags: dict[str, str]) -> xr.Dataset:
    return xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), scene.grid.shape))},
        coords=scene.coordinates,
        attrs={"frame": scene.grid.frame, "pair": pair, "flags": flags, "quality": {}},
    )
