"""What a CPHD file says of a pair besides its samples: where and when, of which scene, and each pulse's parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S

Floats = NDArray[np.float64]

PATH_LIMIT = "APERTURA_PATH_LIMIT"
"""Parameter of each pulse beside those of the standard: total path beyond which an echo leaves the prefix, m."""

_OVERSAMPLED = 1.25
"""Of the frequencies over what the swath needs; the standard wants 1.2."""

_RECORD = (
    *(("TxTime", 1), ("TxPos", 3), ("TxVel", 3), ("RcvTime", 1), ("RcvPos", 3), ("RcvVel", 3), ("SRPPos", 3)),
    *((name, 1) for name in ("aFDOP", "aFRR1", "aFRR2", "FX1", "FX2", "TOA1", "TOA2", "TDTropoSRP", "SC0", "SCSS")),
)
"""Parameters of a pulse, and how many numbers each is, in the order of the standard: sarkit writes them by place."""


@dataclass(frozen=True, eq=False)
class Collection:
    """What a pair recorded, without its samples.

    Attributes
    ----------
    name
        Of the data set.
    pair
        Transmitter-receiver.
    time
        (pulse,) datetime64[ns], UTC.
    tx_m, rx_m
        (pulse, 3) float64, metres, ECEF: phase centres at `time`, both at one instant as in stage echo.
    frequency_hz
        (subcarrier,) float64, in equal steps.
    path_limit_m
        (pulse,) float64, total path beyond which an echo leaves the prefix; infinite where there is none.
    point_m
        (3,) float64, metres, ECEF: the point that samples refer to (SRP), in the middle of the scene.
    origin_m
        (3,) float64, metres, ECEF: where the scene's coordinates count from (IARP).
    axes
        (3, 3) float64, rows: unit vectors east, north and up there, ECEF.
    area_m
        West, south, east and north edge of the scene from the origin, metres along the axes.
    spacing_m
        Of the scene's pixels.
    parameters
        Name → text that goes with the collection: where it comes from.
    """

    name: str
    pair: str
    time: NDArray[np.datetime64]
    tx_m: Floats
    rx_m: Floats
    frequency_hz: Floats
    path_limit_m: Floats
    point_m: Floats
    origin_m: Floats
    axes: Floats
    area_m: tuple[float, float, float, float]
    spacing_m: float
    parameters: Mapping[str, str]

    @property
    def monostatic(self) -> bool:
        """Whether one node sends and receives."""
        tx, rx = self.pair.split("-")
        return tx == rx

    @property
    def reference_delay_s(self) -> Floats:
        """Delay of the reference point, to which samples must be referred: (pulse,) float64, seconds."""
        legs = [np.linalg.norm(leg - self.point_m, axis=1) for leg in (self.tx_m, self.rx_m)]
        return np.asarray(sum(legs) / SPEED_OF_LIGHT_M_S, np.float64)

    @property
    def swath_s(self) -> tuple[float, float]:
        """First and last delay of echoes that the samples hold, from that of the reference point, seconds.

        As much as their frequencies resolve, and no later than what stays inside the prefix.
        """
        half = 0.5 / (_OVERSAMPLED * self._step_hz)
        latest = float((self.path_limit_m / SPEED_OF_LIGHT_M_S - self.reference_delay_s).min())
        return -half, min(half, latest)

    @property
    def start(self) -> np.datetime64:
        """The microsecond at or before the first pulse, from which times count."""
        return np.datetime64(self.time[0].astype("datetime64[us]"), "ns")

    @property
    def sent_s(self) -> Floats:
        """(pulse,) float64, seconds from `start`."""
        return np.asarray((self.time - self.start) / np.timedelta64(1, "s"), np.float64)

    @property
    def seen_s(self) -> Floats:
        """When each pulse is at the reference point: (pulse,) float64, seconds from `start`."""
        return np.asarray(self.sent_s + np.linalg.norm(self.tx_m - self.point_m, axis=1) / SPEED_OF_LIGHT_M_S)

    @property
    def _step_hz(self) -> float:
        return float(self.frequency_hz[-1] - self.frequency_hz[0]) / (len(self.frequency_hz) - 1)

    def pulses(self) -> NDArray[Any]:
        """Return the parameters of each pulse, a record each."""
        limited = bool(np.isfinite(self.path_limit_m).all())
        kind = [(name, "f8", (3,)) if count == 3 else (name, "f8") for name, count in _RECORD]
        table = np.zeros(len(self.time), [*kind, ("SIGNAL", "i8"), *([(PATH_LIMIT, "f8")] if limited else [])])
        sent, delay = self.sent_s, self.reference_delay_s
        table["TxTime"], table["RcvTime"] = sent, sent + delay
        towards = 0.0
        for leg, position in (("Tx", self.tx_m), ("Rcv", self.rx_m)):
            velocity = np.gradient(position, sent, axis=0) if len(sent) > 1 else np.zeros_like(position)
            table[f"{leg}Pos"], table[f"{leg}Vel"] = position, velocity
            line = position - self.point_m
            towards = towards + (velocity * line).sum(axis=1) / np.linalg.norm(line, axis=1)
        table["aFDOP"] = -towards / SPEED_OF_LIGHT_M_S
        table["SRPPos"], table["SIGNAL"] = self.point_m, 1
        table["FX1"], table["FX2"] = self.frequency_hz[0], self.frequency_hz[-1]
        table["TOA1"], table["TOA2"] = self.swath_s
        table["SC0"], table["SCSS"] = self.frequency_hz[0], self._step_hz
        if limited:
            table[PATH_LIMIT] = self.path_limit_m
        return table
