"""Extraction of the per-vector parameters of a CPHD file by sarkit; run by `read_isolated`. Samples are not read."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PULSE_FIELDS = ("TxTime", "TxPos", "RcvTime", "RcvPos", "SRPPos", "FX1", "FX2", "TOA1", "TOA2", "SC0", "SCSS")
"""Per-vector parameters required for image formation."""

_LONGEST_KIND = 64
PATH_LIMIT = "APERTURA_PATH_LIMIT"
"""Per-vector parameter that apertura adds to its files: `path_limit` of stage echo, m."""

FRAME = "APERTURA_FRAME"
"""Collection parameter that apertura adds to its files: frame of stage echo."""

OPTIONAL_FIELDS = ("AmpSF", "SIGNAL", "TDTropoSRP", "TDIonoSRP", PATH_LIMIT)
"""Optional per-vector parameters."""


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read the per-vector parameters, and position and format of the samples.

    Parameters
    ----------
    path
        CPHD, version 1.0.1 or 1.1.0.

    Returns
    -------
    dict
        ``channels``: names of the channels. For channels 0, 1 … under ``0/`` …: `PULSE_FIELDS` and the
        `OPTIONAL_FIELDS` present, (pulse,) or (pulse, 3) float64; ``layout``: offset of the samples in the signal
        block in bytes, number of pulses, samples per pulse, int64. For all channels: ``block``: offset of the signal
        block in the file; ``start``: datetime64[ns], UTC; ``origin`` (3,) and ``axes`` (3, 3) float64 of the plane of
        the image area, zeros without a plane; ``sign``; and ``format``, ``collect_type`` and ``frame`` as text.

    Raises
    ------
    ValueError
        If the file is not CPHD of these versions, or is not suitable for image formation.
    """
    import sarkit.cphd as skcphd
    from lxml import etree

    with path.open("rb") as stream:
        first = stream.readline(_LONGEST_KIND).decode("ascii", errors="replace").strip()
        if not first.startswith("CPHD/"):
            raise ValueError(f"the file starts with {first[:20]!r}, not with CPHD/ and a version")
        if not first.startswith("CPHD/1."):
            raise ValueError(f"version {first!r}, not 1.0.1 or 1.1.0")
        stream.seek(0)
        kind, header = skcphd.read_file_header(stream)
        stream.seek(0)
        with skcphd.Reader(stream) as reader:
            tree = reader.metadata.xmltree
            if etree.QName(tree.getroot()).namespace not in skcphd.VERSION_INFO:
                raise ValueError(f"version {kind.strip()!r}, not 1.0.1 or 1.1.0")
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
    """Raise ValueError unless samples are uncompressed and in the frequency domain."""
    domain = tree.findtext("{*}Global/{*}DomainType")
    if domain != "FX":
        raise ValueError(f"samples in domain {domain}, not in the frequency domain (DomainType FX)")
    if tree.find("{*}Data/{*}SignalCompressionID") is not None:
        raise ValueError("samples compressed by a method that is not part of the standard")


def _of_channel(channel: Any, pulses: NDArray[Any]) -> dict[str, NDArray[Any]]:
    missing = [name for name in PULSE_FIELDS if name not in (pulses.dtype.names or ())]
    if missing:
        raise ValueError(f"no per-vector parameter {missing[0]}")
    present = [*PULSE_FIELDS, *(name for name in OPTIONAL_FIELDS if name in (pulses.dtype.names or ()))]
    layout = [int(channel.findtext(f"{{*}}{name}")) for name in ("SignalArrayByteOffset", "NumVectors", "NumSamples")]
    return {**{name: pulses[name].astype(np.float64) for name in present}, "layout": np.array(layout, np.int64)}


def _plane(xml: Any) -> dict[str, NDArray[np.float64]]:
    """Return reference point and axes of the image area in ECEF; axes of apertura's files are east, north and up."""
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
        raise ValueError(f"no {path} in the XML block")
    return value
