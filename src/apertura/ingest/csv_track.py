"""Flight logs as CSV: time_utc, latitude_deg, longitude_deg, height_m and optionally attitude."""

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from apertura.errors import CampaignError, quoted
from apertura.ingest.log_options import AS_IT_SAYS, LogOptions
from apertura.ingest.tables import numbers, read_table
from apertura.ingest.track import FIXES, make_track

_POSITION = ["latitude_deg", "longitude_deg", "height_m"]
_ATTITUDE = ["roll_deg", "pitch_deg", "yaw_deg"]
_STD = ["std_north_m", "std_east_m", "std_up_m"]


def read_csv_track(path: Path, *, node: str, options: LogOptions = AS_IT_SAYS) -> xr.Dataset:
    """Return the `track` stage of a CSV log.

    Its columns are time_utc (ISO 8601), latitude_deg, longitude_deg, height_m (ellipsoidal, WGS 84) and, where
    known, roll_deg, pitch_deg, yaw_deg; std_north_m, std_east_m, std_up_m (standard deviations); quality (kind of
    solution: a name or number of `FIXES`). Empty cells of the last two are epochs of which the log says nothing.

    Raises
    ------
    CampaignError
        If a column is missing or a cell is not a number or a time.
    """
    try:
        table = read_table(path, ("time_utc", *_POSITION), optional=(*_ATTITUDE, *_STD, "quality"))
        time = (
            pd.to_datetime(table["time_utc"], utc=True, format="ISO8601")
            .dt.tz_localize(None)
            .dt.as_unit("ns")
            .to_numpy()
        )
        geodetic = numbers(table[_POSITION])
        attitude, std = (
            numbers(table[names]) if set(names) <= set(table.columns) else None for names in (_ATTITUDE, _STD)
        )
        fix = _fix(table["quality"]) if "quality" in table else None
    except (ValueError, ArithmeticError) as error:
        raise CampaignError(
            str(error).partition("\n")[0],
            where=path,
            expected=f"columns time_utc (ISO 8601), {', '.join(_POSITION)}, optionally {', '.join(_ATTITUDE)}, "
            f"{', '.join(_STD)}, quality ({', '.join(FIXES)}, or their numbers 1 to 6)",
            remedy="Correct the log or export it again.",
        ) from error
    return make_track(
        time,
        geodetic,
        attitude_deg=attitude,
        position_std_m=std,
        fix=fix,
        node=node,
        where=path,
    )


def _fix(quality: "pd.Series[str]") -> NDArray[np.int8]:
    """Return RTKLIB's numbers of kinds of solution that are named or numbered; 0 where a cell is empty."""
    numbers = {**FIXES, "": 0, **{str(number): number for number in (0, *FIXES.values())}}
    words = quality.map(lambda cell: "" if pd.isna(cell) else str(cell).strip().lower().removesuffix(".0"))
    unknown = words[~words.isin(numbers)]
    if len(unknown):
        raise ValueError(f"quality {quoted(unknown.iloc[0])}")
    return np.array([numbers[word] for word in words], np.int8)
