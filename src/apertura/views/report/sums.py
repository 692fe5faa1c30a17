"""Rule `pictures_fused`: what the report shows of the sums of a flight's pairs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.provenance import Provenance
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import LOCAL
from apertura.formats.export import product
from apertura.stages.agreement import averaged, report_of
from apertura.stages.scene import settled_scene
from apertura.stages.stamping import tags_of
from apertura.views.report import SUM_PICTURES
from apertura.views.report.image_drawings import draw_cuts, drawn_cuts
from apertura.views.report.panels import draw_panels
from apertura.workflow.lineage import result_of

_DOTS = 480  # of the longer side of a panel
_MOST_PANELS = 2  # pairs beside their sums


def pictures_fused(campaign: Campaign, flight: str) -> Sequence[Path]:
    """Write the sums of a flight beside its pairs, and cuts through the brightest target; return their paths."""
    lineage = result_of(campaign, "pictures_fused", flight).begin(campaign.root)
    written = [campaign.result(flight, FUSED, f"{name}.png") for name in SUM_PICTURES]
    panels, cuts = written
    grid, report = settled_scene(campaign).grid, report_of(campaign, flight, FUSED)
    files = {
        pair: campaign.result(flight, pair, product("image", "write_power").file)
        for pair in campaign.flight(flight).pairs[:_MOST_PANELS]
    }
    images = [open_stage(campaign.stage("image", flight, pair), "image") for pair in files]
    for kind in ("coherent", "noncoherent"):
        files[f"{kind} sum"] = campaign.result(flight, FUSED, product(kind, "write_power").file)
    powers = {}
    for name, file in files.items():
        with opened_raster(file, expected="what step export writes", remedy="Run the workflow again.") as raster:
            powers[name] = averaged(raster, _DOTS).astype("f8")
    cube = open_stage(campaign.stage("cube"), "cube")
    tags = tags_of(Provenance.of(lineage.modules, [*images, cube]), lineage)
    west, south, east, north = grid.bounds_m
    brightest = report["brightest"]
    target_m = brightest["x_m"] - west, brightest["y_m"] - south
    where: dict[str, Any] = {"size_m": (east - west, north - south), "target_m": target_m, "local": grid.crs == LOCAL}
    draw_panels(panels, powers, title=f"flight {flight}", tags=tags, **where)
    coherent = cube.coherent[cube.attrs["flights"].index(flight)]
    title = f"flight {flight}, coherent sum of {' + '.join(report['fusion']['phases_rad'])}"
    draw_cuts(cuts, drawn_cuts(coherent, brightest, grid), title=title, tags=tags)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
