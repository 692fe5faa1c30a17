"""Parameters of the pulses of a CPHD file, through sarkit; run by `read_isolated`. Samples stay in the file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PULSE_FIELDS = ("TxTime", "TxPos", "RcvTime", "RcvPos", "SRPPos", "FX1", "FX2", "TOA1", "TOA2", "SC0", "SCSS")
"""Of each pulse, what an image needs."""

_LONGEST_KIND = 64
PATH_LIMIT = "APERTURA_PATH_LIMIT"
"""Parameter of each pulse that our own files add: `path_limit` of stage echo, m."""

FRAME = "APERTURA_FRAME"
"""Parameter of the collection that our own files add: frame of stage echo."""

OPTIONAL_FIELDS = ("AmpSF", "SIGNAL", "TDTropoSRP", "TDIonoSRP", PATH_LIMIT)
"""Optional parameters of each pulse."""


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return the parameters of each pulse, where the samples lie, and what they mean.

    Parameters
    ----------
    path
        CPHD, version 1.0.1 or 1.1.0.

    Returns
    -------
    dict
        ``channels``: their names. Of channel 0, 1 … under ``0/`` …: `PULSE_FIELDS` and those of
        `OPTIONAL_FIELDS` that are there, (pulse,) or (pulse, 3) float64; ``layout``: byte of the block where samples
        begin, pulses, samples of each, int64. Of all: ``block``: byte of the file where that begins; ``start``:
        datetime64[ns], UTC; ``origin`` (3,) and ``axes`` (3, 3) float64 of the image area's plane, zeros where it is
        none; ``sign``; and as text ``format``, ``collect_type``, ``frame``.

    Raises
    ------
    ValueError
        If it is no such file, or one that cannot be imaged from.
    """
    import sarkit.cphd as skcphd
    from lxml import etree

    with path.open("rb") as stream:
        first = stream.readline(_LONGEST_KIND).decode("ascii", errors="replace").strip()
        if not first.startswith("CPHD/"):
            raise ValueError(f"it begins with {first[:20]!r}, not with CPHD/ and a version")
        if not first.startswith("CPHD/1."):
            raise ValueError(f"version {first!r}, and neither 1.0.1 nor 1.1.0")
        stream.seek(0)
        kind, header = skcphd.read_file_header(stream)
        stream.seek(0)
        with skcphd.Reader(stream) as reader:
            tree = reader.metadata.xmltree
            if etree.QName(tree.getroot()).namespace not in skcphd.VERSION_INFO:
                raise ValueError(f"version {kind.strip()!r}, and neither 1.0.1 nor 1.1.0")
            xml = skcphd.XmlHelper(tree)
            _check(tree)
            channels = tree.findall("{*}Data/{*}Channel")
            names = [channel.findtext("{*}Identifier") for channel in channels]
            recorded = [
                _of_channel(channel, reader.read_pvps(channel.findtext("{*}Identifier"))) for channel in channels
            ]
    block = int(header["SIGNAL_BLOCK_BYTE_OFFSET"])
    return {
        **{f"{number}/{name}": array for number, fields in enumerate(recorded) for name, array in fields.items()},
        "channels": np.array(names, str),
        "block": np.array(block),
        "start": np.array(_required(xml, "Global/Timeline/CollectionStart").replace(tzinfo=None), "datetime64[ns]"),
        "sign": np.array(int(_required(xml, "Global/SGN"))),
        "format": np.array(_required(xml, "Data/SignalArrayFormat")),
        "collect_type": np.array(_required(xml, "CollectionID/CollectType")),
        "frame": np.array(tree.findtext(f"{{*}}CollectionID/{{*}}Parameter[@name='{FRAME}']") or "ecef"),
        **_plane(xml),
    }


def _check(tree: Any) -> None:
    """Raise ValueError unless samples are over frequency and as they are."""
    domain = tree.findtext("{*}Global/{*}DomainType")
    if domain != "FX":
        raise ValueError(f"samples over {domain}, and not over frequency (DomainType FX)")
    if tree.find("{*}Data/{*}SignalCompressionID") is not None:
        raise ValueError("compressed samples, by a method that the standard does not describe")


def _of_channel(channel: Any, pulses: NDArray[Any]) -> dict[str, NDArray[Any]]:
    missing = [name for name in PULSE_FIELDS if name not in (pulses.dtype.names or ())]
    if missing:
        raise ValueError(f"no parameter {missing[0]} of pulses")
    named = [*PULSE_FIELDS, *(name for name in OPTIONAL_FIELDS if name in (pulses.dtype.names or ()))]
    layout = [int(channel.findtext(f"{{*}}{name}")) for name in ("SignalArrayByteOffset", "NumVectors", "NumSamples")]
    return {**{name: pulses[name].astype(np.float64) for name in named}, "layout": np.array(layout, np.int64)}


def _plane(xml: Any) -> dict[str, NDArray[np.float64]]:
    """Return the image area's reference point and axes, east, north and up for our own files, ECEF."""
    scene = "SceneCoordinates"
    axes = [_found(xml, f"{scene}/ReferenceSurface/Planar/{name}") for name in ("uIAX", "uIAY")]
    if axes[0] is None or axes[1] is None:
        return {"origin": np.zeros(3), "axes": np.zeros((3, 3))}
    return {
        "origin": np.asarray(_required(xml, f"{scene}/IARP/ECF"), np.float64),
        "axes": np.array([*axes, np.cross(*axes)]),
    }


def _found(xml: Any, path: str) -> Any:
    return xml.load("/".join(f"{{*}}{name}" for name in path.split("/")))


def _required(xml: Any, path: str) -> Any:
    value = _found(xml, path)
    if value is None:
        raise ValueError(f"no {path} in its XML")
    return value
