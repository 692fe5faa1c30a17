"""What the cube says of each flight and pair: names, time, view, quality."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.cube_variables import QUOTED

Images = Mapping[tuple[str, str], xr.Dataset]
"""Flight and pair → stage `image`."""

_TEXTS = np.dtypes.StringDType()


def labels(images: Images, assessed: Mapping[str, Mapping[str, Any]], pairs: Sequence[str]) -> xr.Dataset:
    """Return coordinates flight, pair, time and what pairs and flights are compared with; values of every image.

    Parameters
    ----------
    images
        Those that were formed.
    assessed
        Flight → what step `assess` wrote of it.
    pairs
        Every pair of the campaign.
    """
    values = {name: _filled(dtype, (len(assessed), len(pairs))) for name, (_, dtype, _, _) in QUOTED.items()}
    for place, (flight, one) in enumerate(assessed.items()):
        for pair in pairs:
            if (flight, pair) in images:
                told = _quoted(images[flight, pair], one, pair)
                for name, value in told.items():
                    if value is not None:
                        values[name][place, pairs.index(pair)] = value
    return xr.Dataset(
        {name: (QUOTED[name][0], array) for name, array in values.items()},
        coords={
            "flight": ("flight", np.array([*assessed], _TEXTS)),
            "pair": ("pair", np.array(pairs, _TEXTS)),
            "time": ("flight", np.array([_middle(images, flight) for flight in assessed]), {"standard_name": "time"}),
            "reference_pair": ("flight", np.array([one["reference"] for one in assessed.values()], _TEXTS)),
            "reference_flight": ("pair", np.array([*reference_flights(images, pairs).values()], _TEXTS)),
        },
    )


def reference_flights(images: Images, pairs: Sequence[str]) -> dict[str, str]:
    """Return pair → the first flight that flew it."""
    return {pair: next(flight for flight, other in images if other == pair) for pair in pairs}


def _filled(dtype: str, shape: tuple[int, int]) -> Any:
    return np.full(shape, "", _TEXTS) if dtype == "T" else np.full(shape, np.nan)


def _middle(images: Images, flight: str) -> Any:
    """Return the middle of the pulses of all pairs of a flight, UTC."""
    views = [image.attrs["quality"]["view"] for (name, _), image in images.items() if name == flight]
    ends = np.array([view[end] for view in views for end in ("first_utc", "last_utc")], "datetime64[ns]")
    return ends.min() + (ends.max() - ends.min()) // 2


def _quoted(image: xr.Dataset, assessed: Mapping[str, Any], pair: str) -> dict[str, float | str | None]:
    """Return what an image and its flight's assessment say: name of a row of `QUOTED` → value; None: nothing."""
    quality = image.attrs["quality"]
    view, focus, pulses = quality["view"], quality["focus"], quality.get("pulses", {})  # phase history tells none
    return {
        "heading": view["heading_deg"],
        "look_direction": view["look_deg"],
        "incidence": view["incidence_deg"],
        "bistatic_angle": view["bistatic_angle_deg"],
        "range": view["range_m"],
        "height": view["height_m"],
        "centre_frequency": view["centre_hz"],
        "bandwidth": view["band_hz"],
        "resolution_cell": focus["cell_m"],
        "loss": focus.get("loss_db"),
        "numerical_error": quality["numerical_error_db"],
        "entropy": quality["entropy"],
        "noise_floor": quality["noise_floor_db"],
        "pulses_used": pulses.get("used"),
        "pulses_dropped": pulses.get("dropped"),
        "peak": quality["brightest"]["amplitude"],
        "phase_removed": assessed["fusion"]["phases_rad"].get(pair),
        "verdict": focus["verdict"],
        "flags": ",".join(sorted({*image.attrs["flags"], *assessed["pairs"][pair]["flags"]})),
    }
