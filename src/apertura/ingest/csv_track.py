"""Flight logs as CSV: time_utc, latitude_deg, longitude_deg, height_m and optionally attitude."""

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from apertura.errors import CampaignError
from apertura.ingest.track import make_track

_POSITION = ["latitude_deg", "longitude_deg", "height_m"]
_ATTITUDE = ["roll_deg", "pitch_deg", "yaw_deg"]


def read_csv_track(path: Path, *, node: str) -> xr.Dataset:
    """Return the `track` stage of a CSV log.

    Its columns are time_utc (ISO 8601), latitude_deg, longitude_deg, height_m (ellipsoidal, WGS 84) and, where
    known, roll_deg, pitch_deg, yaw_deg.

    Raises
    ------
    CampaignError
        If a column is missing or a cell is not a number or a time.
    """
    try:
        table = pd.read_csv(path, skipinitialspace=True)
        missing = [name for name in ("time_utc", *_POSITION) if name not in table.columns]
        if missing:
            raise ValueError(f"no column {missing[0]} among {list(table.columns)}")
        time = pd.to_datetime(table["time_utc"], utc=True, format="ISO8601").dt.tz_localize(None).to_numpy()
        geodetic = table[_POSITION].to_numpy(np.float64)
        attitude = table[_ATTITUDE].to_numpy(np.float64) if set(_ATTITUDE) <= set(table.columns) else None
    except (ValueError, UnicodeDecodeError) as error:
        raise CampaignError(
            str(error).splitlines()[0],
            where=path,
            expected=f"columns time_utc (ISO 8601), {', '.join(_POSITION)}, optionally {', '.join(_ATTITUDE)}",
            remedy="Correct the log or export it again.",
        ) from error
    return make_track(time.astype("datetime64[ns]"), geodetic, attitude_deg=attitude, node=node, where=path)
