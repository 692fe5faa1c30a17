"""Prediction of image quality before a flight, with the functions that also assess processed images.

`design` returns layers of every image of a plan, the cost of recording and processing, and a verdict on each
requirement; `requirements` finds the main cause of a shortfall and the most helpful change, and searches for tracks
within bounds. Quantities that the pipeline also reports for images are computed by the pipeline's own functions.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.documents import validated
from apertura.common.errors import CampaignError, quoted
from apertura.tools.design.expected_images import Design, designed
from apertura.tools.design.flight_plan import FlightPlan, read_flight_plan
from apertura.tools.design.layers import UNITS
from apertura.tools.design.requirements import report_of


def design(
    plan: FlightPlan | Mapping[str, Any] | str | Path, *, root: Path | None = None, threads: int = 1
) -> xr.Dataset:
    """Predict the images of a planned flight, pixel by pixel, for each pair and for the sums of flights.

    Parameters
    ----------
    plan
        A YAML file, its parsed contents, or a `FlightPlan`. A plan has the keys of config/config.yaml, and flights with
        tracks; see docs/howto/design.md.
    root
        Folder of the files named in the plan; default: the folder of the YAML file, or, without a YAML file, the
        current folder.
    threads
        Number of tiles computed in parallel.

    Returns
    -------
    xarray.Dataset
        Layers of `UNITS` over (image, y, x), float32, on the grid of the later campaign; NaN if a layer does not apply
        to an image. `coherence` and `height_ambiguity` are over (interferogram, y, x). Attributes: `judgement` of each
        requirement, `recording`, and `budget` and `flags` of each image.

    Raises
    ------
    CampaignError
        If a key is unknown, a track passes below the terrain or beyond the DEM, nodes collide, or the pulse rate is
        too low for the scene.

    Examples
    --------
    >>> import apertura as ap
    >>> node = {"attitude": "log"}
    >>> design = ap.design({
    ...     "campaign": "meadow",
    ...     "waveform": {"kind": "ofdm", "subcarriers": 512, "subcarrier_spacing_hz": 4e5, "symbol_s": 2.5e-6,
    ...                  "cyclic_prefix_s": 1e-6, "carrier_hz": 1.3e9, "sample_rate_hz": 2.56e8, "prf_hz": 100.0},
    ...     "nodes": {"uav1": node},
    ...     "scene": {"crs": "local", "bounds_m": [-10, 20, 10, 40], "spacing_m": 1.0},
    ...     "flights": {"f01": {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": {
    ...         "kind": "line", "start_m": [-20, 0], "end_m": [20, 0], "height_m": 30.0, "speed_m_s": 5.0}}}},
    ...     "require": {"resolution_m": 2.0, "coverage": 0.95}})
    >>> design.sizes["image"], [line["met"] for line in design.attrs["judgement"]]
    (1, [True, True])
    """
    return dataset_of(designed(*as_plan(plan, root), threads=threads))


def as_plan(plan: FlightPlan | Mapping[str, Any] | str | Path, root: Path | None) -> tuple[FlightPlan, Path]:
    """Return a plan, which is read first if given as a file, and the folder of the files named in the plan."""
    if isinstance(plan, str | Path):
        return read_flight_plan(Path(plan)), root or Path(plan).absolute().parent
    if not isinstance(plan, FlightPlan):
        if not isinstance(plan, Mapping):
            expected = "a flight plan: a YAML file, its keys as a mapping, or a FlightPlan"
            remedy = "Start from the plan in docs/howto/design.md."
            raise CampaignError(quoted(plan), "design: plan", expected, remedy)
        plan = validated(FlightPlan, dict(plan), where="plan", expected="keys of a flight plan, docs/howto/design.md")
    return plan, root or Path.cwd()


def dataset_of(design: Design) -> xr.Dataset:
    """Return a design as a dataset; see `design`."""
    grid = design.opened.scene.grid
    images, shape = list(design.images), grid.shape
    names = [name for name in UNITS if any(name in image.layers for image in design.images.values())]

    def stacked(layers: list[Mapping[str, Any]], name: str) -> np.ndarray:
        dtype = np.uint8 if name == "mask" else np.float32
        values = np.empty((len(layers), *shape), dtype)
        for index, layers_of_image in enumerate(layers):
            values[index] = layers_of_image.get(name, np.nan)
        return values

    each = [image.layers for image in design.images.values()]
    variables: dict[str, Any] = {name: (("image", "y", "x"), stacked(each, name)) for name in names}
    between = list(design.interferograms.values())
    variables |= {
        name: (("interferogram", "y", "x"), stacked(between, name)) for name in (between[0] if between else ())
    }
    data = xr.Dataset(
        variables,
        coords={"image": images, "x": grid.x_m, "y": grid.y_m}
        | ({"interferogram": list(design.interferograms)} if between else {}),
        attrs={"campaign": design.opened.campaign.settings.campaign, "crs": grid.crs, **report_of(design)},
    )
    for name in data.data_vars:
        unit, meaning = UNITS[str(name)]
        data[name].attrs |= {"units": unit, "long_name": meaning}
    return data
