"""Export of the compensated phase history of a pair (CPHD 1.1.0, NGA.STND.0068-1)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.atomic import replacement
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import geodetic_from_ecef

# ---- Metadata of a CPHD file, and per-vector parameters -------------------------------------------------------------


PATH_LIMIT = "APERTURA_PATH_LIMIT"
"""Per-vector parameter in addition to those of the standard: longest total path within the cyclic prefix, m."""

_OVERSAMPLED = 1.25
"""Oversampling of the frequencies relative to the swath; the standard requires 1.2."""

_RECORD = (
    *(("TxTime", 1), ("TxPos", 3), ("TxVel", 3), ("RcvTime", 1), ("RcvPos", 3), ("RcvVel", 3), ("SRPPos", 3)),
    *((name, 1) for name in ("aFDOP", "aFRR1", "aFRR2", "FX1", "FX2", "TOA1", "TOA2", "TDTropoSRP", "SC0", "SCSS")),
)
"""Per-vector parameters with number of components, in the order of the standard, because sarkit writes by position."""


@dataclass(frozen=True, eq=False)
class CphdCollection:
    """Metadata of the phase history of a pair, without its samples.

    Attributes
    ----------
    name
        Name of the data set.
    pair
        Transmitter-receiver.
    time
        (pulse,) datetime64[ns], UTC.
    tx_m, rx_m
        (pulse, 3) float64: phase centres at `time`, ECEF, metres; both refer to the same instant, as in stage echo.
    frequency_hz
        (subcarrier,) float64, in equal steps.
    path_limit_m
        (pulse,) float64: longest total path within the cyclic prefix; infinite without a prefix.
    point_m
        (3,) float64: reference point of the samples (SRP) at the centre of the scene, ECEF, metres.
    origin_m
        (3,) float64: origin of the scene coordinates (IARP), ECEF, metres.
    axes
        (3, 3) float64, rows: unit vectors east, north and up at the origin, ECEF.
    area_m
        West, south, east and north edge of the scene relative to the origin, metres along the axes.
    spacing_m
        Pixel spacing of the scene.
    wave_speed_m_s
        Propagation speed along the paths.
    parameters
        Name → text of additional collection parameters: provenance.
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
    wave_speed_m_s: float
    parameters: Mapping[str, str]

    @property
    def monostatic(self) -> bool:
        """True if a single node transmits and receives."""
        tx, rx = self.pair.split("-")
        return tx == rx

    @property
    def reference_delay_s(self) -> Floats:
        """Delay of the reference point, to which samples are referred: (pulse,) float64, seconds."""
        return self._point_path_m / self.wave_speed_m_s

    @property
    def troposphere_s(self) -> Floats:
        """Tropospheric part of the reference delay, in excess of the delay in vacuum: (pulse,) float64, seconds."""
        return self.reference_delay_s - self._point_path_m / SPEED_OF_LIGHT_M_S

    @property
    def _point_path_m(self) -> Floats:
        paths = [np.linalg.norm(antenna_m - self.point_m, axis=1) for antenna_m in (self.tx_m, self.rx_m)]
        return np.asarray(sum(paths), np.float64)

    @property
    def swath_s(self) -> tuple[float, float]:
        """First and last delay of echoes in the samples, relative to the delay of the reference point, seconds.

        Both are limited by the frequency spacing and by the cyclic prefix.
        """
        half = 0.5 / (_OVERSAMPLED * self._step_hz)
        latest = float((self.path_limit_m / self.wave_speed_m_s - self.reference_delay_s).min())
        return -half, min(half, latest)

    @property
    def start(self) -> np.datetime64:
        """Time zero: the first pulse, rounded down to a microsecond."""
        return np.datetime64(self.time[0].astype("datetime64[us]"), "ns")

    @property
    def sent_s(self) -> Floats:
        """Transmit times: (pulse,) float64, seconds from `start`."""
        return seconds_since(self.time, self.start)

    @property
    def exposed_s(self) -> Floats:
        """Time at which each pulse reaches the reference point: (pulse,) float64, seconds from `start`."""
        return np.asarray(self.sent_s + np.linalg.norm(self.tx_m - self.point_m, axis=1) / self.wave_speed_m_s)

    @property
    def _step_hz(self) -> float:
        return float(self.frequency_hz[-1] - self.frequency_hz[0]) / (len(self.frequency_hz) - 1)

    def pulses(self) -> NDArray[Any]:
        """Return the per-vector parameters, one record per pulse."""
        limited = bool(np.isfinite(self.path_limit_m).all())
        kind = [(name, "f8", (3,)) if count == 3 else (name, "f8") for name, count in _RECORD]
        table = np.zeros(len(self.time), [*kind, ("SIGNAL", "i8"), *([(PATH_LIMIT, "f8")] if limited else [])])
        sent, delay = self.sent_s, self.reference_delay_s
        table["TDTropoSRP"] = self.troposphere_s
        table["TxTime"], table["RcvTime"] = sent, sent + delay
        path_rate = 0.0
        for end, position in (("Tx", self.tx_m), ("Rcv", self.rx_m)):
            velocity = np.gradient(position, sent, axis=0) if len(sent) > 1 else np.zeros_like(position)
            table[f"{end}Pos"], table[f"{end}Vel"] = position, velocity
            line = position - self.point_m
            path_rate = path_rate + (velocity * line).sum(axis=1) / np.linalg.norm(line, axis=1)
        table["aFDOP"] = -path_rate / self.wave_speed_m_s
        table["SRPPos"], table["SIGNAL"] = self.point_m, 1
        table["FX1"], table["FX2"] = self.frequency_hz[0], self.frequency_hz[-1]
        table["TOA1"], table["TOA2"] = self.swath_s
        table["SC0"], table["SCSS"] = self.frequency_hz[0], self._step_hz
        if limited:
            table[PATH_LIMIT] = self.path_limit_m
        return table


# ---- Compensated phase history of a pair (CPHD 1.1.0, NGA.STND.0068-1) ----------------------------------------------
#
# Signals are Σ a·exp(-j2πf(τ-τ_ref)), SGN -1, where τ_ref is the delay of the scene reference point, the same point for
# all pulses (docs/formats/phase_history.md, "CPHD"). sarkit writes metadata and per-vector parameters; samples are
# written in blocks.

_NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_CHANNEL = "1"


def write_cphd(path: Path, collection: CphdCollection, blocks: Iterable[NDArray[np.complex64]]) -> None:
    """Write a CPHD file under a temporary name, and rename it.

    Parameters
    ----------
    path
        ``….cphd``.
    collection
        Metadata.
    blocks
        Transfer functions referred to `CphdCollection.reference_delay_s`, (pulse, subcarrier) complex64, in blocks of
        pulses, in order.

    Raises
    ------
    ValueError
        If blocks have more or fewer pulses than the collection.
    """
    from sarkit import cphd

    pulses = collection.pulses()
    metadata = cphd.Metadata(xmltree=_document(collection, pulses))
    with replacement(path) as temporary, temporary.open("w+b") as stream:
        cphd.Writer(stream, metadata).write_pvp(_CHANNEL, pulses)
        stream.seek(0)
        _, header = cphd.read_file_header(stream)
        stream.seek(int(header["SIGNAL_BLOCK_BYTE_OFFSET"]))
        written = 0
        for block in blocks:
            stream.write(np.ascontiguousarray(block, ">c8").data)
            written += len(block)
        if written != len(pulses):
            raise ValueError(f"{written} pulses, must be {len(pulses)}")


def _document(collection: CphdCollection, pulses: NDArray[Any]) -> Any:
    """Build the XML document, with the reference geometry computed by sarkit."""
    from lxml import etree
    from sarkit import cphd

    element = etree.Element(f"{{{_NAMESPACE}}}CPHD", nsmap={None: _NAMESPACE})
    root = cphd.ElementWrapper(element)
    parts = {
        "CollectionID": _identity(collection),
        "Global": _overall(collection, pulses),
        "SceneCoordinates": _scene(collection),
        "Data": _sizes(collection, pulses),
        "Channel": _channel(collection, pulses),
        "PVP": _layout(pulses),
        "Dwell": _dwell(collection),
    }
    for name, part in parts.items():
        root[name] = part
    tree = element.getroottree()
    root["ReferenceGeometry"] = cphd.compute_reference_geometry(tree, pulses)
    return tree


def _identity(collection: CphdCollection) -> dict[str, Any]:
    tx, rx = collection.pair.split("-")
    return {
        "CollectorName": rx,
        **({} if collection.monostatic else {"IlluminatorName": tx}),
        "CoreName": collection.name,
        "CollectType": "MONOSTATIC" if collection.monostatic else "BISTATIC",
        "RadarMode": {"ModeType": "SPOTLIGHT"},  # one reference point for all pulses
        "Classification": "UNCLASSIFIED",
        "ReleaseInfo": "UNSPECIFIED",
        "Parameter": list(collection.parameters.items()),
    }


def _overall(collection: CphdCollection, pulses: NDArray[Any]) -> dict[str, Any]:
    first, last = collection.swath_s
    start: datetime = collection.start.astype("datetime64[us]").item()
    return {
        "DomainType": "FX",
        "SGN": -1,
        "Timeline": {"CollectionStart": start, "TxTime1": pulses["TxTime"][0], "TxTime2": pulses["TxTime"][-1]},
        "FxBand": {"FxMin": collection.frequency_hz[0], "FxMax": collection.frequency_hz[-1]},
        "TOASwath": {"TOAMin": first, "TOAMax": last},
    }


def _scene(collection: CphdCollection) -> dict[str, Any]:
    west, south, east, north = collection.area_m
    corners = [(west, south), (west, north), (east, north), (east, south)]  # clockwise
    corners_m = [collection.origin_m + np.array(corner) @ collection.axes[:2] for corner in corners]
    columns, rows = (max(1, round((high - low) / collection.spacing_m)) for low, high in ((west, east), (south, north)))
    return {
        "EarthModel": "WGS_84",
        "IARP": {"ECF": collection.origin_m, "LLH": geodetic_from_ecef(collection.origin_m)},
        "ReferenceSurface": {"Planar": {"uIAX": collection.axes[0], "uIAY": collection.axes[1]}},
        "ImageArea": {"X1Y1": (west, south), "X2Y2": (east, north)},
        "ImageAreaCornerPoints": [geodetic_from_ecef(corner_m)[:2] for corner_m in corners_m],
        "ImageGrid": {
            "IARPLocation": (-west / collection.spacing_m - 0.5, -south / collection.spacing_m - 0.5),
            "IAXExtent": {"LineSpacing": collection.spacing_m, "FirstLine": 0, "NumLines": columns},
            "IAYExtent": {"SampleSpacing": collection.spacing_m, "FirstSample": 0, "NumSamples": rows},
        },
    }


def _sizes(collection: CphdCollection, pulses: NDArray[Any]) -> dict[str, Any]:
    return {
        "SignalArrayFormat": "CF8",
        "NumBytesPVP": pulses.itemsize,
        "NumCPHDChannels": 1,
        "Channel": [
            {
                "Identifier": _CHANNEL,
                "NumVectors": len(pulses),
                "NumSamples": len(collection.frequency_hz),
                "SignalArrayByteOffset": 0,
                "PVPArrayByteOffset": 0,
            }
        ],
        "NumSupportArrays": 0,
    }


def _channel(collection: CphdCollection, pulses: NDArray[Any]) -> dict[str, Any]:
    (first, last), frequency = collection.swath_s, collection.frequency_hz
    parameters = {
        "Identifier": _CHANNEL,
        "RefVectorIndex": len(pulses) // 2,
        "FXFixed": True,
        "TOAFixed": True,
        "SRPFixed": True,
        "SignalNormal": True,
        "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": "UNSPECIFIED"},
        "FxC": (frequency[0] + frequency[-1]) / 2,
        "FxBW": frequency[-1] - frequency[0],
        "TOASaved": last - first,
        "DwellTimes": {"CODId": _CHANNEL, "DwellId": _CHANNEL},
    }
    fixed = {f"{name}FixedCPHD": True for name in ("FX", "TOA", "SRP")}
    return {"RefChId": _CHANNEL, **fixed, "Parameters": [parameters]}


def _layout(pulses: NDArray[Any]) -> dict[str, Any]:
    """Return offset and size of each per-vector parameter, in words of 8 bytes."""
    fields = {
        name: {"Offset": offset // 8, "Size": kind.itemsize // 8, "dtype": kind}
        for name, (kind, offset, *_) in (pulses.dtype.fields or {}).items()
    }
    added = [{"Name": name, **fields.pop(name)} for name in (PATH_LIMIT,) if name in fields]
    return {**fields, **({"AddedPVP": added} if added else {})}


def _dwell(collection: CphdCollection) -> dict[str, Any]:
    """Return centre time and dwell time of the scene; all pulses are assumed to illuminate the whole scene."""
    exposed_s = collection.exposed_s
    return {
        "NumCODTimes": 1,
        "CODTime": [{"Identifier": _CHANNEL, "CODTimePoly": np.array([[(exposed_s[0] + exposed_s[-1]) / 2]])}],
        "NumDwellTimes": 1,
        "DwellTime": [{"Identifier": _CHANNEL, "DwellTimePoly": np.array([[exposed_s[-1] - exposed_s[0]]])}],
    }
