"""Rules `pictures` and `pictures_fused`: figures of a pair, and figures of the sums of a flight, for the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.config import FUSED, SampledWaveform, is_monostatic
from apertura.campaign.folder import Campaign
from apertura.campaign.store import blocks_of_rows, open_stage, record_files
from apertura.check.times import counted
from apertura.common.arrays import Floats
from apertura.common.progress import progress
from apertura.common.provenance import Provenance
from apertura.common.raster import opened_raster
from apertura.common.units import seconds_since
from apertura.core.backprojection.contributions import block_contributions
from apertura.core.geometry.geodesy import LOCAL, map_from_frame
from apertura.core.imaging.range_profiles import aperture_of, profiles_of
from apertura.formats.export import product
from apertura.formats.export.coverage import footprint
from apertura.formats.export.map_layout import number, round_length
from apertura.formats.export.quicklook import below_peak
from apertura.stages.agreement import assessment_of, averaged, report_of, sum_of
from apertura.stages.coverage import crs_name, few_looks
from apertura.stages.pair import open_pair
from apertura.stages.refine import open_refined
from apertura.stages.scene import OpenScene, open_scene, settled_scene
from apertura.stages.tags import tags_of
from apertura.views.report import PICTURES, SUM_PICTURES
from apertura.views.report.cuts_and_profiles import (
    DrawnCut,
    Measured,
    draw_budget,
    draw_cuts,
    draw_phase,
    drawn_cuts,
    sidelink_error_rad,
)
from apertura.views.report.geometry_and_pulses import (
    FlownGeometry,
    PulseRecord,
    Waterfall,
    draw_geometry,
    draw_pulses,
    draw_waterfall,
)
from apertura.views.report.sheet import GREY, SKY, sheet, thinned
from apertura.workflow.lineage import result_of


def pictures(campaign: Campaign, flight: str, pair: str) -> Sequence[Path]:
    """Write the figures of a pair; return the paths of the files."""
    lineage = result_of(campaign, "pictures", flight, pair).begin(campaign.root)
    shown = Shown(campaign, flight, pair)
    written = [campaign.result(flight, pair, "pictures", f"{name}.png") for name in PICTURES]
    geometry, pulses, phase, cuts, profiles, budget = written
    origin = Provenance.of(lineage.modules, [shown.echo, shown.profile, shown.image], settings=shown.scene.spec)
    drawn: dict[str, Any] = {"title": f"flight {flight}, {pair}", "tags": tags_of(origin, lineage)}
    quality = shown.image.attrs["quality"]
    draw_geometry(geometry, shown.geometry(), **drawn)
    draw_pulses(pulses, shown.record(), **drawn)
    draw_phase(phase, shown.time_s, shown.phasors(), counted=shown.counted, **drawn)
    draw_cuts(cuts, shown.cuts(), **drawn)
    path_m = shown.target_path_m
    draw_waterfall(profiles, shown.waterfall(), shown.time_s, path_m, counted=shown.counted, **drawn)
    measured = Measured(*(quality["focus"].get(name) for name in ("loss_db", "std_db", "expected_db")))
    draw_budget(budget, quality["budget"], measured, **drawn)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


@dataclass(frozen=True)
class Shown:
    """Data for the figures of a pair, opened on first use.

    Attributes
    ----------
    campaign, flight, pair
        Campaign, name of the flight and name of the pair.
    """

    campaign: Campaign
    flight: str
    pair: str

    @cached_property
    def echo(self) -> xr.Dataset:
        """Stage `echo`."""
        return self._stage("echo")

    @cached_property
    def profile(self) -> xr.Dataset:
        """Stage `profile`."""
        return self._stage("profile")

    @cached_property
    def image(self) -> xr.Dataset:
        """Stage `image`."""
        return self._stage("image")

    def _stage(self, name: str) -> xr.Dataset:
        return open_stage(self.campaign.stage(name, self.flight, self.pair), name)

    @cached_property
    def scene(self) -> OpenScene:
        """Grid and terrain."""
        return open_scene(self.campaign)

    @cached_property
    def time_s(self) -> Floats:
        """(pulse,) times of the pulses used in the image, seconds since the first of these pulses."""
        return seconds_since(self.echo.time.values, self.echo.time.values[0])

    @cached_property
    def counted(self) -> bool:
        """True if `time_s` counts pulses, because the recording has no times."""
        return counted(self.echo.time.values)

    @cached_property
    def _target(self) -> tuple[float, float]:
        """Row and column of the brightest target."""
        brightest = self.image.attrs["quality"]["brightest"]
        row, column = self.scene.grid.pixel_of(brightest["x_m"], brightest["y_m"])
        return float(row), float(column)

    @cached_property
    def _target_m(self) -> Floats:
        """(1, 3) position of the brightest target in the frame of the antennas."""
        row, column = (np.array([coordinate]) for coordinate in self._target)
        return np.asarray(self.scene.terrain.positions_at(self.scene.grid, row, column)).reshape(1, 3)

    @cached_property
    def target_path_m(self) -> Floats:
        """(pulse,) total path to the brightest target."""
        return aperture_of(self.profile).path(self._target_m)[:, 0]

    def geometry(self) -> FlownGeometry:
        """Return tracks, scene and footprint in map coordinates."""
        grid, aperture = self.scene.grid, aperture_of(self.echo)
        drawn = thinned(len(aperture), 400)
        legs = dict(zip(("transmitter", "receiver"), aperture[drawn].legs, strict=True))
        if is_monostatic(self.pair):
            del legs["receiver"]  # the transmitter is also the receiver
        step, _, west, _, _, north = grid.transform
        looks = few_looks(self.campaign, self.flight, self.pair)
        down, right = (size * step / dots for size, dots in zip(grid.shape, looks.shape, strict=True))
        rings = footprint(looks, Affine(right, 0, west, 0, -down, north))
        return FlownGeometry(
            self.time_s[drawn],
            {name: map_from_frame(grid.crs, leg) for name, leg in legs.items()},
            grid.bounds_m,
            float(np.array(map_from_frame(grid.crs, self.scene.middle_m))[2]),
            np.array(map_from_frame(grid.crs, self._target_m[0])),
            [ring for polygon in rings for ring in polygon],
            crs_name(grid),
            grid.crs == LOCAL,
            self.counted,
        )

    def record(self) -> PulseRecord:
        """Return the transmitted pulses, the pulses used in the image, and the sidelink measurements."""
        echo, sent = self.echo, self._sent()
        counts = echo.attrs.get("pulses") or {}
        snr_db = echo.sidelink_snr.values if "sidelink_snr" in echo else None
        beyond_m = None
        if "sidelink_delay" in echo and "sidelink_vector" in echo:
            beyond_m = echo.sidelink_delay.values - np.linalg.norm(echo.sidelink_vector.values, axis=1)
            beyond_m = beyond_m - np.nanmedian(beyond_m)
        return PulseRecord(
            seconds_since(sent, sent[0]),
            np.isin(sent, echo.time.values),
            counts.get("reasons") or {},
            seconds_since(echo.time.values, sent[0]),
            snr_db,
            beyond_m,
            self.counted,
        )

    def _sent(self) -> NDArray[np.datetime64]:
        """Return transmission times in UTC; for phase histories, those of the pulses in the file."""
        if not isinstance(self.campaign.settings.waveform, SampledWaveform):
            return np.asarray(self.echo.time.values)
        node = self.pair.split("-")[0]
        raw = open_stage(self.campaign.stage("raw", self.flight, node), "raw")
        return np.asarray(self.campaign.clock(self.flight, node).utc(raw.time.values)).astype("datetime64[ns]")

    def phasors(self) -> dict[str, NDArray[np.complex128]]:
        """Return the contribution of each pulse at the brightest target for each stage of correction."""
        logged, echo = profiles_of(self.profile, lazy=True), self.echo
        every = np.arange(len(logged) + 1)
        phasors = block_contributions(logged, self._target_m, edges=every)[0].astype(np.complex128)
        stages = {}
        if "sidelink_phase" in echo and "sidelink_vector" in echo:
            wavenumber_rad_m = 2 * np.pi * float(echo.frequency.values.mean()) / logged.wave_speed_m_s
            length_m = np.linalg.norm(echo.sidelink_vector.values, axis=1)
            error = sidelink_error_rad(echo.sidelink_phase.values, length_m, wavenumber_rad_m=wavenumber_rad_m)
            stages["without sidelink correction"] = np.nan_to_num(phasors * np.exp(1j * error))
            stages["corrected with the sidelink"] = phasors
        else:
            stages["as recorded, with the logged tracks"] = phasors
        refined = open_refined(self.campaign, self.flight)
        if refined.correction is not None:
            corrected = refined.profiles(open_pair(self.campaign, self.flight, self.pair, echo=echo), logged)
            contributions = block_contributions(corrected, self._target_m, edges=every)[0]
            stages["refined tracks"] = contributions.astype(np.complex128)
        return stages

    def cuts(self) -> list[DrawnCut]:
        """Return the cuts through the brightest target, whose widths are in image.json."""
        return drawn_cuts(self.image.image, self.image.attrs["quality"]["brightest"], self.scene.grid)

    def waterfall(self) -> Waterfall:
        """Return the mean power of the range profiles, read block by block."""
        profile = self.profile
        waterfall = Waterfall(profile.start.values, profile.attrs["step_m"], profile.sizes["range"])
        with progress("pulses", profile.sizes["pulse"]) as done:
            for block in blocks_of_rows(profile, "profile"):
                waterfall.add(block.start, profile.profile[block].values)
                done(block.stop - block.start)
        return waterfall


_RANGE_DB = 40.0
_COLUMNS = 2


def draw_panels(
    path: Path,
    powers: Mapping[str, NDArray[np.float64]],
    *,
    size_m: tuple[float, float],
    target_m: tuple[float, float],
    title: str,
    tags: Mapping[str, str],
    local: bool = False,
) -> None:
    """Plot images of a scene as a PNG, each in dB relative to its peak, with the same dynamic range.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    powers
        Title of a panel → (row, column) float64 mean power, north-up, NaN where no image was formed.
    size_m
        Size of the scene to the east and north, metres.
    target_m
        Position of the brightest target, metres east and north of the lower left corner.
    title
        Title that names the flight.
    tags
        Provenance, stored in the file.
    local
        True if the scene is in a local frame, the axes of which are x and y.
    """
    across, up = ("x", "y") if local else ("east", "north")
    rows = -(-len(powers) // _COLUMNS)
    high = 2.75 * min(1.6, max(0.45, size_m[1] / size_m[0]))
    with sheet(path, 0.5 + rows * (high + 0.45), title=title, tags=tags) as figure:
        grid = GridSpec(rows, _COLUMNS, figure=figure)
        drawn = []
        for panel, (name, power) in enumerate(powers.items()):
            axes = figure.add_subplot(grid[panel // _COLUMNS, panel % _COLUMNS])
            drawn.append((axes, _draw(axes, power, size_m)))
            axes.set_title(f"({'abcdefgh'[panel % 8]}) {name}")
            axes.plot(*target_m, "o", markersize=10, markerfacecolor="none", markeredgecolor=SKY, markeredgewidth=1.2)
            if panel % _COLUMNS == 0:
                axes.set_ylabel(f"{up} from the lower left corner, m")
            if panel >= len(powers) - _COLUMNS:
                axes.set_xlabel(f"{across} from the lower left corner, m")
        _draw_scale(drawn[0][0], size_m, north=not local)
        bar = figure.colorbar(drawn[0][1], ax=[axes for axes, _ in drawn], extend="both", shrink=0.8, pad=0.02)
        bar.set_label("power relative to the peak of the panel, dB")


def _draw(axes: Axes, power: NDArray[np.float64], size_m: tuple[float, float]) -> AxesImage:
    decibel, _ = below_peak(power)
    axes.grid(visible=False)
    axes.set_facecolor("white")
    return axes.imshow(
        np.ma.masked_invalid(decibel),
        extent=(0, size_m[0], 0, size_m[1]),
        cmap="inferno",
        vmin=-_RANGE_DB,
        vmax=0,
        interpolation="nearest",
    )


def _draw_scale(axes: Axes, size_m: tuple[float, float], *, north: bool) -> None:
    metres = round_length(size_m[0] / 4)
    axes.add_patch(
        Rectangle((0.05 * size_m[0], 0.05 * size_m[1]), metres, 0.015 * size_m[1], facecolor="white", edgecolor=GREY)
    )
    at = 0.05 * size_m[0] + metres / 2, 0.085 * size_m[1]
    axes.text(*at, f"{number(metres)} m", color="white", ha="center", fontsize=7)
    if not north:
        return
    arrow = {"arrowstyle": "-|>", "color": "white"}
    axes.annotate("", (0.94, 0.19), (0.94, 0.05), xycoords="axes fraction", arrowprops=arrow)
    axes.text(0.94, 0.2, "N", transform=axes.transAxes, color="white", ha="center", weight="bold")


_DOTS = 480  # longer side of a panel, pixels
_MOST_PANELS = 2  # number of pairs drawn next to the sums


def pictures_fused(campaign: Campaign, flight: str) -> Sequence[Path]:
    """Write figures of the sums and pairs of a flight, and of cuts through the brightest target; return the paths."""
    lineage = result_of(campaign, "pictures_fused", flight).begin(campaign.root)
    written = [campaign.result(flight, FUSED, f"{name}.png") for name in SUM_PICTURES]
    panels, cuts = written
    grid, report = settled_scene(campaign).grid, report_of(campaign, flight, FUSED)
    pairs, assessed = campaign.flight(flight).pairs, assessment_of(campaign, flight)
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    power = product("image", "write_power").file
    files = {pair: campaign.result(flight, pair, power) for pair in pairs[:_MOST_PANELS]}
    for kind in ("coherent", "noncoherent"):
        files[f"{kind} sum"] = campaign.result(flight, FUSED, product(kind, "write_power").file)
    powers = {}
    for name, file in files.items():
        with opened_raster(file, expected="a product of step export", remedy="Run the workflow again.") as raster:
            powers[name] = averaged(raster, _DOTS).astype("f8")
    tags = tags_of(Provenance.of(lineage.modules, images), lineage)
    west, south, east, north = grid.bounds_m
    brightest = report["brightest"]
    target_m = brightest["x_m"] - west, brightest["y_m"] - south
    where: dict[str, Any] = {"size_m": (east - west, north - south), "target_m": target_m, "local": grid.crs == LOCAL}
    draw_panels(panels, powers, title=f"flight {flight}", tags=tags, **where)
    coherent = sum_of(images, assessed, "coherent")
    title = f"flight {flight}, coherent sum of {' + '.join(report['fusion']['phases_rad'])}"
    draw_cuts(cuts, drawn_cuts(coherent, brightest, grid), title=title, tags=tags)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
