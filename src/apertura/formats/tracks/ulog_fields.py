"""Positions, attitude and what places them in time in a PX4 ULog; run by `read_isolated`."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

RECEIVERS, FUSED, ATTITUDE = ("vehicle_gps_position", "sensor_gps"), "vehicle_global_position", "vehicle_attitude"

DELAY = "EKF2_GPS_DELAY"
"""Parameter: by how many milliseconds the autopilot takes its receiver to be late."""


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return ``topic:instance/field`` → values of every message, and `DELAY` where it is logged.

    Parameters
    ----------
    path
        A ULog.

    Raises
    ------
    ValueError
        If fields of a topic do not belong together.
    """
    from pyulog import ULog

    log = ULog(str(path), message_name_filter_list=[*RECEIVERS, FUSED, ATTITUDE])
    fields: dict[str, list[NDArray[Any]]] = {}
    for topic in log.data_list:
        for name, values in topic.data.items():
            fields.setdefault(f"{topic.name}:{topic.multi_id}/{name}", []).append(values)
    arrays = {name: np.concatenate(parts) for name, parts in fields.items()}
    for name, values in arrays.items():
        if values.size != arrays.get(f"{name.partition('/')[0]}/timestamp", values[:0]).size:
            raise ValueError(f"{name} has {values.size} values, its topic's timestamp another number")
    delay = log.initial_parameters.get(DELAY)
    return {**arrays, **({DELAY: np.array([delay], np.float64)} if isinstance(delay, float) else {})}
