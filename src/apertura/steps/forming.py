"""What forms the tiles of one pair's image, whichever job does it: history, ground, plan and grid."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.image.candidates import Setting
from apertura.image.engines import ENGINES
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.plan import Plan
from apertura.image.tiles import form_tiles
from apertura.steps.history import profiles_of, spectra_of
from apertura.steps.plan import plan_pair, planned_heights
from apertura.steps.scene import grid_coordinates, grid_spec, scene_grid
from apertura.steps.stamping import stamped
from apertura.steps.terrain import Heights, open_heights
from apertura.store import open_stage


@dataclass(frozen=True)
class Work:
    """Everything that forms a tile.

    Attributes
    ----------
    echo
        The stage that image.json quotes.
    history
        'echo' → `Spectra`, 'profile' → `Profiles`.
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

    echo: xr.Dataset
    history: dict[str, Any]
    grid: SceneGrid
    heights: Heights
    plan: Plan
    empty: xr.Dataset
    windows: list[Window]
    threads: int

    @classmethod
    def of(cls, campaign: Campaign, flight: str, pair: str, *, threads: int) -> "Work":
        """Open what a pair's image is made from, and plan it."""
        echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
        grid, processing = scene_grid(campaign), campaign.settings.processing
        history = {"echo": spectra_of(echo, processing.window), "profile": profiles_of(profile)}
        plan = plan_pair(campaign, flight, pair, threads=threads)
        heights = planned_heights(plan, open_heights(campaign), grid)
        empty = stamped(
            _empty(grid, pair, echo.attrs["flags"], campaign.settings.campaign),
            "image",
            module=__name__,
            parents=[echo, profile, *heights.parents],
            settings={**campaign.relevant("image"), "grid": grid_spec(grid), "plan": plan.choices},
        )
        return cls(echo, history, grid, heights, plan, empty, list(grid.tiles(processing.tile_px)), threads)

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
        engine, history = ENGINES[setting.engine], dict(self.history)
        if planned:
            history["profile"] = self.plan.history(history["profile"])
        prepared = engine.prepare(history[engine.reads], **setting.options)
        pulses = np.float32(len(self.history["echo"].transfer))

        def mean(pixels: NDArray[np.float64]) -> NDArray[np.complex64]:
            return np.asarray(engine.form(prepared, pixels, **setting.form_options) / pulses, np.complex64)

        form_tiles(mean, self.grid, windows, write=target.__setitem__, threads=self.threads, heights=self.heights.of)

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
