"""Writers of the files of a campaign folder: config, flights, codes, SigMF recordings, flight logs."""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from apertura.common.atomic import replacement
from apertura.common.errors import CampaignError

DATATYPES = {"int8": "ci8", "int16": "ci16_le", "int32": "ci32_le", "float32": "cf32_le"}
"""dtype of I and Q → SigMF datatype."""


@contextmanager
def new_folder(directory: Path) -> Iterator[Path]:
    """Yield a temporary folder for a new campaign; it is renamed to `directory` when complete.

    Raises
    ------
    CampaignError
        If `directory` exists and is not an empty folder.
    """
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise CampaignError(
            "the path already exists and is not an empty folder",
            where=directory,
            expected="a new or empty folder for the campaign",
            remedy="Remove the existing path or choose another name.",
        )
    with replacement(directory) as root:
        (root / "config").mkdir(parents=True)
        (root / "raw").mkdir()
        yield root


def write_config(
    root: Path, document: Mapping[str, Any], flights: Iterable[tuple[str, str, str, Iterable[str]]]
) -> None:
    """Write config/config.yaml and config/flights.tsv.

    Parameters
    ----------
    root
        The campaign folder.
    document
        The config, as plain values.
    flights
        Name, kind, transmitter and nodes of each flight.
    """
    text = yaml.safe_dump(dict(document), sort_keys=False)
    (root / "config" / "config.yaml").write_text(text, encoding="utf-8")
    write_flights(root, flights)


def write_flights(root: Path, flights: Iterable[tuple[str, str, str, Iterable[str]]]) -> None:
    """Write config/flights.tsv: name, kind, transmitter and nodes of each flight."""
    rows = ["\t".join((name, kind, transmitter, ",".join(nodes))) for name, kind, transmitter, nodes in flights]
    table = "\n".join(("flight\tkind\ttransmitter\tnodes", *rows)) + "\n"
    (root / "config" / "flights.tsv").write_text(table, encoding="utf-8")


def write_recording(
    stem: Path,
    blocks: Iterable[NDArray[Any]],
    captures: Iterable[tuple[int, np.datetime64, int | None]],
    *,
    channels: Sequence[str],
    sample_rate_hz: float,
    frequency_hz: float,
    extra: Mapping[str, Any],
) -> None:
    """Write `stem`.sigmf-data and `stem`.sigmf-meta.

    Parameters
    ----------
    stem
        raw/<flight>/<node>; the file name is the node's name.
    blocks
        (sample, channel, 2), I and Q with a dtype of `DATATYPES`; blocks in temporal order, written one by one.
    captures
        First sample, UTC time tag of the node's clock (datetime64, written in its unit) and, if available, transmitted
        frame number of each capture.
    frequency_hz
        RF frequency at zero baseband frequency.
    extra
        Additional keys of the global object.

    Notes
    -----
    Source: SigMF specification 1.2.
    """
    digest, dtype = hashlib.sha512(), "int16"
    with stem.with_name(f"{stem.name}.sigmf-data").open("wb") as stream:
        for block in blocks:
            dtype = block.dtype.name
            data = np.ascontiguousarray(block, block.dtype.newbyteorder("<")).tobytes()
            digest.update(data)
            stream.write(data)
    write_meta(
        stem,
        captures,
        channels=channels,
        dtype=dtype,
        sha512=digest.hexdigest(),
        sample_rate_hz=sample_rate_hz,
        frequency_hz=frequency_hz,
        extra=extra,
    )


def write_meta(
    stem: Path,
    captures: Iterable[tuple[int, np.datetime64, int | None]],
    *,
    channels: Sequence[str],
    dtype: str,
    sha512: str,
    sample_rate_hz: float,
    frequency_hz: float | None,
    extra: Mapping[str, Any],
    header_bytes: int = 0,
) -> None:
    """Write `stem`.sigmf-meta for existing samples.

    Parameters
    ----------
    stem, captures, channels, extra
        As for `write_recording`.
    dtype
        Type of I and Q, a key of `DATATYPES`.
    sha512
        Hash of the samples.
    frequency_hz
        RF frequency at zero baseband frequency; None: not stated.
    header_bytes
        Bytes at the start of the file that are not samples.
    """
    header = {
        "core:datatype": DATATYPES[dtype],
        "core:sample_rate": sample_rate_hz,
        "core:version": "1.2.5",
        "core:num_channels": len(channels),
        "core:sha512": sha512,
        "core:description": f"{stem.parent.name} {stem.name}",
        "core:extensions": [{"name": "apertura", "version": "0.1.0", "optional": True}],
        "apertura:channels": list(channels),
        "apertura:node": stem.name,
        **extra,
    }
    stated = {} if frequency_hz is None else {"core:frequency": frequency_hz}
    segments = [
        {
            "core:sample_start": start,
            **stated,
            "core:datetime": f"{np.datetime_as_string(time_utc)}Z",
            **({} if frame is None else {"apertura:frame": frame}),
        }
        for start, time_utc, frame in captures
    ]
    if header_bytes:
        segments[0]["core:header_bytes"] = header_bytes
    meta = {"global": header, "captures": segments, "annotations": []}
    stem.with_name(f"{stem.name}.sigmf-meta").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")


def write_csv_log(
    path: Path,
    time_utc: NDArray[np.datetime64],
    position: NDArray[np.float64],
    attitude_rad: NDArray[np.float64] | None,
    *,
    local: bool = False,
    extra_columns: Mapping[str, NDArray[Any]] = MappingProxyType({}),
) -> None:
    """Write a flight log as .csv with the column names of `read_csv_track`.

    Parameters
    ----------
    time_utc
        (epoch,) datetime64, UTC, written in its unit.
    position
        (epoch, 3) float64: latitude and longitude (degrees), metres above the ellipsoid.
    attitude_rad
        (epoch, 3) float64: roll, pitch, yaw (clockwise from north); None: no attitude columns. NaN becomes an empty
        cell.
    local
        True if positions are metres to east, north and up in the campaign's local frame.
    extra_columns
        Additional columns: name → (epoch,); integers and text are written unchanged, floats to 10 µm, NaN as an empty
        cell.
    """
    axes = ("east_m", "north_m", "up_m") if local else ("latitude_deg", "longitude_deg", "height_m")
    columns = ["time_utc", *axes]
    cells = [[f"{text}Z" for text in np.datetime_as_string(time_utc)]]
    digits = (5, 5, 5) if local else (11, 11, 5)
    cells += [
        [f"{value:.{decimals}f}" for value in column] for column, decimals in zip(position.T, digits, strict=True)
    ]
    if attitude_rad is not None:
        columns += ["roll_deg", "pitch_deg", "yaw_deg"]
        attitude_deg = np.degrees(attitude_rad)
        attitude_deg[:, 2] %= 360
        cells += [[_cell(value, 4) for value in column] for column in attitude_deg.T]
    columns += extra_columns
    cells += [[_cell(value, 5) for value in column.tolist()] for column in extra_columns.values()]
    lines = [",".join(columns), *map(",".join, zip(*cells, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cell(value: float | str, digits: int) -> str:
    if isinstance(value, int | str):
        return str(value)
    return "" if math.isnan(value) else f"{value:.{digits}f}"
