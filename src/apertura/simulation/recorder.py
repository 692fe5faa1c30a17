"""SigMF recordings as a node's recorder writes them, block by block and hashed on the way."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Segment:
    """Where a capture begins.

    Attributes
    ----------
    sample_start
        Index into the samples of one channel.
    time_utc
        The node's own tag, datetime64[ns].
    frame
        Frame number read from the payload, if there is one.
    """

    sample_start: int
    time_utc: np.datetime64
    frame: int | None = None


def write_recording(
    stem: Path,
    blocks: Iterable[NDArray[np.int16]],
    segments: Sequence[Segment],
    *,
    channels: Sequence[str],
    sample_rate_hz: float,
    frequency_hz: float,
    extra: dict[str, Any],
) -> None:
    """Write `stem`.sigmf-data and `stem`.sigmf-meta.

    Parameters
    ----------
    stem
        raw/<flight>/<node>; the file name is the node's name.
    blocks
        (sample, channel, 2) int16 counts of I and Q, in order; never held all at once.
    segments
        One per trigger.
    channels
        Names, in the order of the samples.
    sample_rate_hz, frequency_hz
        Nominal sampling rate, and the RF frequency at baseband zero.
    extra
        More keys of the `apertura` namespace for the global object.

    Notes
    -----
    Source: SigMF specification 1.2.
    """
    digest = hashlib.sha512()
    with stem.with_name(f"{stem.name}.sigmf-data").open("wb") as stream:
        for block in blocks:
            data = np.ascontiguousarray(block, "<i2").tobytes()
            digest.update(data)
            stream.write(data)
    header = {
        "core:datatype": "ci16_le",
        "core:sample_rate": sample_rate_hz,
        "core:version": "1.2.5",
        "core:num_channels": len(channels),
        "core:sha512": digest.hexdigest(),
        "core:description": f"{stem.parent.name} {stem.name}",
        "core:hw": "simulated direct-RF node",
        "core:extensions": [{"name": "apertura", "version": "0.1.0", "optional": True}],
        "apertura:channels": list(channels),
        "apertura:node": stem.name,
        **extra,
    }
    captures = [_capture(segment, frequency_hz) for segment in segments]
    meta = {"global": header, "captures": captures, "annotations": []}
    stem.with_name(f"{stem.name}.sigmf-meta").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")


def _capture(segment: Segment, frequency_hz: float) -> dict[str, Any]:
    capture: dict[str, Any] = {
        "core:sample_start": segment.sample_start,
        "core:frequency": frequency_hz,
        "core:datetime": f"{np.datetime_as_string(segment.time_utc, 'us')}Z",
    }
    return capture if segment.frame is None else capture | {"apertura:frame": segment.frame}
