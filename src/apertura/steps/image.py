"""Rules of the image wing: a focused image of one pair, with its measured error."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.image.beam import Beams
from apertura.image.candidates import Setting
from apertura.image.certificate import Certificate, certified_pixels
from apertura.image.engines import ENGINES, reference
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.history import Spectra
from apertura.image.peaks import cut_through, find_peak, ground_position
from apertura.image.plan import Plan
from apertura.image.planner import ladder
from apertura.image.quality import coherence_factor, survey
from apertura.image.tiles import form_tiles
from apertura.provenance import sha256_file
from apertura.steps.antennas import antennas_report, beams_of, body_axes
from apertura.steps.history import profiles_of, spectra_of
from apertura.steps.plan import plan_pair, planned_heights
from apertura.steps.scene import grid_coordinates, grid_spec, scene_grid
from apertura.steps.stamping import stamped
from apertura.steps.terrain import Heights, open_heights
from apertura.store import finish, open_stage, tiles_missing, write_json, writing

CERTIFIED_PIXELS = 256

CUT_REACH_M = 3.0
"""How far the cuts through the brightest target go to both sides."""


def image(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Path:
    """Write results/<flight>/<pair>/image.zarr and image.json, tile by tile; finished tiles are kept after a kill."""
    folder = campaign.stage("image", flight, pair)
    echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
    grid, heights, processing = scene_grid(campaign), open_heights(campaign), campaign.settings.processing
    history = {"echo": spectra_of(echo, processing.window), "profile": profiles_of(profile)}
    plan = plan_pair(campaign, flight, pair, threads=threads)
    heights = planned_heights(plan, heights, grid)
    empty = stamped(
        _empty(grid, pair, echo.attrs["flags"], campaign.settings.campaign),
        "image",
        module=__name__,
        parents=[echo, profile, *heights.parents],
        inputs={name: sha256_file(path) for name, path in campaign.pattern_files(pair).items()},
        settings={**campaign.relevant("image", pair), "grid": grid_spec(grid), "plan": plan.choices},
    )
    windows = list(grid.tiles(processing.tile_px))
    with writing(folder) as wip:
        missing = tiles_missing(wip, empty, "image", windows)
        print(f"{pair}: {len(missing)} of {len(windows)} tiles to form with {plan.setting.line}", flush=True)
        target = zarr.open_array(wip / "image", mode="r+")
        beams = beams_of(campaign, pair, body_axes(echo))
        work = Work(history, grid, heights, target, threads, beams)
        work.form(plan.setting, missing, prepared_for=plan)
        quality = {
            "engine": plan.engine,
            "models": plan.reasons,
            "predicted_error_db": round(plan.predicted_error_db, 2),
            **_certified(work, windows, ladder(plan), processing.accuracy_db),
            **_measures(work, windows),
            **{name: echo.attrs[name] for name in ("pulses", "sidelink", "clock", "calibration") if name in echo.attrs},
            **heights.report,
            **antennas_report(campaign, pair, plan.illumination),
        }
        quality["flags"] = {**echo.attrs["flags"], **plan.flags, **quality.pop("crossed")}
        zarr.open_group(wip, mode="r+").attrs.update({"quality": quality, "flags": quality["flags"]})
        write_json(folder.with_name("image.json"), {"flight": flight, "pair": pair, **quality})
        finish(wip, folder)
    return folder


@dataclass(frozen=True)
class Work:
    """Everything that forms a tile."""

    history: dict[str, Any]
    grid: SceneGrid
    heights: Heights
    target: Any
    threads: int
    beams: Beams | None = None

    def form(self, setting: Setting, windows: list[Window], *, prepared_for: Plan | None = None) -> None:
        """Form and write tiles with an engine; the image is the mean over the pulses.

        A plan's own setting is given the profiles as the plan wants them: thinned, or with a pair's midpoint.
        """
        if not windows:
            return
        engine, history = ENGINES[setting.engine], dict(self.history)
        if prepared_for is not None:
            history["profile"] = prepared_for.history(history["profile"])
        prepared = engine.prepare(history[engine.reads], **setting.options)
        pulses = np.float32(len(self.history["echo"].transfer))

        def mean(pixels: NDArray[np.float64]) -> NDArray[np.complex64]:
            return np.asarray(
                engine.form(prepared, pixels, beams=self.beams, **setting.form_options) / pulses, np.complex64
            )

        form_tiles(
            mean, self.grid, windows, write=self.target.__setitem__, threads=self.threads, heights=self.heights.of
        )

    def places(self, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the ground."""
        return self.grid.positions_at(row, column, self.heights.at(row, column))


def _certified(work: Work, windows: list[Window], better: tuple[Setting, ...], accuracy_db: float) -> dict[str, Any]:
    """Measure the error; redo tiles that are worse than asked with the next better settings."""
    spectra = work.history["echo"]
    pixels = certified_pixels(work.target, windows, CERTIFIED_PIXELS, np.random.default_rng(0))
    exact = reference.form(spectra, work.places(*pixels.T), beams=work.beams) / len(spectra.transfer)
    certificate = Certificate(pixels, exact, CERTIFIED_PIXELS)
    redone: list[dict[str, Any]] = []
    for choice in better:
        uncertified, worse = certificate.failing(work.target, windows, accuracy_db)
        if not worse:
            break
        print(f"{len(worse)} tiles are worse than {accuracy_db} dB: again with {choice.line}", flush=True)
        work.form(choice, uncertified)
        work.form(choice, worse)  # last: as long as one fails, a run that was killed here does all of it again
        redone.append({"tiles": len(worse) + len(uncertified), "with": choice.line})
    error = certificate.error(work.target)
    missed = error.rms_db > accuracy_db
    line = f"numerical error {error.rms_db:.1f} dB, {accuracy_db:.1f} dB asked"
    return {
        "numerical_error_db": round(error.rms_db, 2),
        "peak_error_db": round(error.peak_db, 2),
        "certified_pixels": len(pixels),
        "redone": redone,
        "crossed": {"accuracy_missed": line} if missed else {},
    }


def _measures(work: Work, windows: list[Window]) -> dict[str, Any]:
    """Return what one pass over the pixels and a close look at the brightest target tell."""
    found, grid = survey(work.target, windows), work.grid
    peak = find_peak(work.target, found.row, found.column)
    x, y = ground_position(grid, peak)
    spectra: Spectra = work.history["echo"]
    terms = reference.terms(spectra, work.places(np.array([peak.row]), np.array([peak.column])), work.beams)
    along = grid.direction(spectra.tx_position_m[-1] - spectra.tx_position_m[0], peak.row, peak.column)
    cuts = {
        name: cut_through(work.target, peak, direction=way, spacing_m=grid.spacing_m, reach_m=CUT_REACH_M)
        for name, way in (("cross_range", along), ("ground_range", (along[1], -along[0])))
    }
    return {
        "entropy": round(found.entropy, 6),
        "noise_floor_db": found.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(terms[terms[:, 0] != 0, 0]),
            **{
                f"{name}_{measure}": None if np.isnan(value) else round(value, 4)
                for name, cut in cuts.items()
                for measure, value in asdict(cut).items()
            },
        },
    }


def _empty(grid: SceneGrid, pair: str, flags: dict[str, str], name: str) -> xr.Dataset:
    return xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), grid.shape))},
        coords=grid_coordinates(grid, name),
        attrs={"frame": "local" if grid.crs == LOCAL else "ecef", "pair": pair, "flags": flags, "quality": {}},
    )
