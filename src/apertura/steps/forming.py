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
from apertura.focus.engines import load_engine
from apertura.focus.engines.engine import Setting
from apertura.focus.tiles import Former, form_blocks
from apertura.load.inputs import profiles_of
from apertura.load.pair import open_pair
from apertura.planning.plan import Plan
from apertura.provenance import sha256_file
from apertura.scene.grid import LOCAL, SceneGrid
from apertura.steps.plan import plan_known, planned_heights
from apertura.steps.scene import grid_coordinates, grid_spec, scene_grid
from apertura.steps.stamping import stamped
from apertura.steps.terrain import Heights, open_heights
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
        'phase_history' → `PhaseHistory`, 'profiles' → `Profiles`.
    beams
        Of the antennas; None where they look everywhere alike.
    grid, heights
        The campaign's grid, and the ground as the plan models it.
    plan
        How the image is formed.
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
    grid: SceneGrid
    heights: Heights
    plan: Plan
    empty: xr.Dataset
    windows: list[Window]
    threads: int

    @classmethod
    def of(cls, campaign: Campaign, flight: str, pair: str, *, module: str, threads: int) -> "Work":
        """Open what a pair's image is made from, and plan it; `module` as `apertura.steps.stamping.stamped`."""
        echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
        grid, heights, opened = (
            scene_grid(campaign),
            open_heights(campaign),
            open_pair(campaign, flight, pair, echo=echo),
        )
        history = {"phase_history": opened.history, "profiles": profiles_of(profile)}
        plan = plan_known(campaign, flight, pair, opened, grid, heights, threads=threads)
        heights = planned_heights(plan, heights, grid)
        # Blocks of pulses are of the machine, not of the work: jobs with less memory share it all the same.
        choices = {name: value for name, value in plan.choices.items() if name != "pulse_blocks"}
        empty = stamped(
            _empty(grid, pair, echo.attrs["flags"], campaign.settings.campaign),
            "image",
            module=module,
            parents=[echo, profile, *heights.parents],
            inputs={name: sha256_file(path) for name, path in campaign.pattern_files(pair).items()},
            settings={**campaign.relevant("image", pair), "grid": grid_spec(grid), "plan": choices},
        )
        folder, windows = campaign.stage("image", flight, pair), list(grid.tiles(campaign.settings.processing.tile_px))
        return cls(folder, echo, history, opened.beams, grid, heights, plan, empty, windows, threads)

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
        engine = load_engine(setting.engine)
        history = self.history[engine.READS]
        if planned and engine.READS == "profiles":
            history = self.plan.inputs(history)
        count = np.float32(len(self.history["phase_history"]))

        def former(pulses: slice) -> Former:
            prepared = engine.prepare(history[pulses], **setting.options)
            options = {"beams": self.beams and self.beams[pulses], **setting.form_options}
            return lambda pixels: np.asarray(engine.form(prepared, pixels, **options) / count, np.complex64)

        form_blocks(
            former,
            len(history),
            self.grid,
            windows,
            blocks=setting.pulse_blocks,
            write=target.__setitem__,
            scratch=self.folder.parent,
            threads=self.threads,
            heights=self.heights.of,
        )

    def form_planned(self, target: Any, windows: list[Window]) -> None:
        """Form tiles as the plan says."""
        print(f"{len(windows)} of {len(self.windows)} tiles to form with {self.plan.setting.line}", flush=True)
        self.form(target, self.plan.setting, windows, planned=True)

    def places(self, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the ground."""
        return self.grid.positions_at(row, column, self.heights.at(row, column))


def _empty(grid: SceneGrid, pair: str, flags: dict[str, str], name: str) -> xr.Dataset:
    return xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), grid.shape))},
        coords=grid_coordinates(grid, name),
        attrs={"frame": "local" if grid.crs == LOCAL else "ecef", "pair": pair, "flags": flags, "quality": {}},
    )
