"""Compensated phase history (CPHD 1.1.0, NGA.STND.0068-1) of one pair, for other processors and for `apertura` itself.

Signals are Σ a·exp(-j2πf(τ-τ_ref)), SGN -1, where τ_ref is the delay of the reference point of the scene, one for all
pulses (docs/formats/phase_history.md, "CPHD"). Metadata and pulse parameters are written by sarkit, samples in blocks.
"""

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.atomic import replacement
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.formats.export.cphd_collection import PATH_LIMIT, Collection

_NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_CHANNEL = "1"


def write_cphd(path: Path, collection: Collection, blocks: Iterable[NDArray[np.complex64]]) -> None:
    """Write a CPHD file, beside and renamed.

    Parameters
    ----------
    path
        ``….cphd``.
    collection
        All but the samples.
    blocks
        Transfer functions referred to `Collection.reference_delay_s`, (pulse, subcarrier) complex64, some pulses at a
        time, in order.

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
            raise ValueError(f"{written} pulses: must be {len(pulses)}")


def _document(collection: Collection, pulses: NDArray[Any]) -> Any:
    """Return the XML, whose reference geometry sarkit works out."""
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


def _identity(collection: Collection) -> dict[str, Any]:
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


def _overall(collection: Collection, pulses: NDArray[Any]) -> dict[str, Any]:
    first, last = collection.swath_s
    began: datetime = collection.start.astype("datetime64[us]").item()
    return {
        "DomainType": "FX",
        "SGN": -1,
        "Timeline": {"CollectionStart": began, "TxTime1": pulses["TxTime"][0], "TxTime2": pulses["TxTime"][-1]},
        "FxBand": {"FxMin": collection.frequency_hz[0], "FxMax": collection.frequency_hz[-1]},
        "TOASwath": {"TOAMin": first, "TOAMax": last},
    }


def _scene(collection: Collection) -> dict[str, Any]:
    west, south, east, north = collection.area_m
    corners = [(west, south), (west, north), (east, north), (east, south)]  # clockwise
    places = [collection.origin_m + np.array(corner) @ collection.axes[:2] for corner in corners]
    columns, rows = (max(1, round((high - low) / collection.spacing_m)) for low, high in ((west, east), (south, north)))
    return {
        "EarthModel": "WGS_84",
        "IARP": {"ECF": collection.origin_m, "LLH": geodetic_from_ecef(collection.origin_m)},
        "ReferenceSurface": {"Planar": {"uIAX": collection.axes[0], "uIAY": collection.axes[1]}},
        "ImageArea": {"X1Y1": (west, south), "X2Y2": (east, north)},
        "ImageAreaCornerPoints": [geodetic_from_ecef(place)[:2] for place in places],
        "ImageGrid": {
            "IARPLocation": (-west / collection.spacing_m - 0.5, -south / collection.spacing_m - 0.5),
            "IAXExtent": {"LineSpacing": collection.spacing_m, "FirstLine": 0, "NumLines": columns},
            "IAYExtent": {"SampleSpacing": collection.spacing_m, "FirstSample": 0, "NumSamples": rows},
        },
    }


def _sizes(collection: Collection, pulses: NDArray[Any]) -> dict[str, Any]:
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


def _channel(collection: Collection, pulses: NDArray[Any]) -> dict[str, Any]:
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
    """Return where each parameter lies in a pulse's record, in words of 8 bytes."""
    fields = {
        name: {"Offset": place // 8, "Size": kind.itemsize // 8, "dtype": kind}
        for name, (kind, place, *_) in (pulses.dtype.fields or {}).items()
    }
    added = [{"Name": name, **fields.pop(name)} for name in (PATH_LIMIT,) if name in fields]
    return {**fields, **({"AddedPVP": added} if added else {})}


def _dwell(collection: Collection) -> dict[str, Any]:
    """Return when and how long a place of the scene is seen: by all pulses."""
    seen = collection.seen_s
    return {
        "NumCODTimes": 1,
        "CODTime": [{"Identifier": _CHANNEL, "CODTimePoly": np.array([[(seen[0] + seen[-1]) / 2]])}],
        "NumDwellTimes": 1,
        "DwellTime": [{"Identifier": _CHANNEL, "DwellTimePoly": np.array([[seen[-1] - seen[0]]])}],
    }
