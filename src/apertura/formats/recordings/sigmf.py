"""SigMF recordings: one capture segment per trigger, channels interleaved per sample."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.formats.recordings.real_samples import SETTLING, Mixing
from apertura.formats.recordings.recording import Captures, Recording
from apertura.formats.recordings.sample_file import SampleFile
from apertura.formats.recordings.sample_layout import DATATYPES, SampleLayout
from apertura.formats.recordings.sigmf_collection import check_listed
from apertura.formats.recordings.sigmf_meta import Global, StatedCaptures, read_meta


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording after checking its metadata, the collections that list it, and its size.

    Raises
    ------
    CampaignError
        If the metadata are not SigMF, the data are truncated, or a capture lies past their end.

    Notes
    -----
    Source: SigMF specification 1.2, sections "Captures Array" and "Dataset Format".
    """
    header, captures = read_meta(meta_path)
    check_listed(meta_path)
    if header.dataset not in (None, data_path.name):
        raise CampaignError(
            f"core:dataset {header.dataset}",
            meta_path,
            f"{data_path.name}, which lies beside it",
            "Remove one of them.",
        )
    channels, layout = _channels(header, meta_path), _layout(header, captures, meta_path)
    samples = _samples(SampleFile(data_path, len(channels), layout), captures, meta_path)
    return Recording(
        samples=samples,
        channels=channels,
        sample_rate_hz=header.sample_rate_hz,
        frequency_hz=_frequency_hz(captures, meta_path),
        captures=Captures(
            captures.start,
            _usable(_length(captures, len(samples), meta_path), layout, meta_path),
            _checked(captures.time, meta_path),
            captures.frame,
        ),
        framing=header.framing.model_dump() if header.framing and len(captures.start) == 1 else None,
        files=(meta_path, data_path),
        sha512=header.sha512 and header.sha512.lower(),
    )


def _layout(header: Global, captures: StatedCaptures, path: Path) -> SampleLayout:
    """Return how the samples lie in their file."""
    real, continuous = header.datatype.startswith("r"), header.framing is not None and len(captures.start) == 1
    mixing = None
    if header.if_hz is not None:
        mixing = Mixing(header.if_hz, header.sample_rate_hz, restarts=not continuous)
    skipped = np.cumsum(captures.header_bytes)
    start, skipped = (captures.start, skipped) if skipped[-1] else (skipped[:0], skipped[:0])
    layout = SampleLayout(header.datatype, header.trailing_bytes, start, skipped, mixing)
    try:
        _ = layout.stored
    except ValueError:
        found = f"core:datatype {quoted(header.datatype)}"
        raise CampaignError(found, path, DATATYPES, "Convert the recording.") from None
    if real is (mixing is None):
        raise CampaignError(
            f"core:datatype {header.datatype} {'without' if real else 'with'} apertura:if_hz",
            path,
            "the intermediate frequency at which baseband zero lies with real samples, and only there",
            "Add apertura:if_hz, Hz, to the global object." if real else "Remove it, or correct core:datatype.",
        )
    return layout


def _frequency_hz(captures: StatedCaptures, path: Path) -> float:
    """Return the RF frequency at baseband zero, which all captures share; 0 where none says."""
    stated = np.flatnonzero(~np.isnan(captures.frequency_hz))
    if not stated.size:
        return 0.0
    hz = captures.frequency_hz[stated]
    other = np.flatnonzero(hz != hz[0])
    if other.size:
        raise CampaignError(
            f"capture {stated[other[0]]}: core:frequency {hz[other[0]]:.6f}",
            path,
            f"{hz[0]:.6f}, as capture {stated[0]} says: one carrier for the whole recording",
            "Correct the metadata, or split the recording.",
        )
    return float(hz[0])


def _channels(header: Global, path: Path) -> list[str]:
    names = ["radar", "sidelink"][: header.num_channels] if header.channels is None else header.channels
    if len(names) != header.num_channels or "radar" not in names or len(set(names)) < len(names):
        raise CampaignError(
            f"apertura:channels {names} for core:num_channels {header.num_channels}",
            path,
            "one name per channel, each its own, 'radar' among them",
            "Correct the metadata.",
        )
    return names


def _samples(samples: SampleFile, captures: StatedCaptures, meta_path: Path) -> SampleFile:
    """Return samples that are there, whole, and reach to the last capture."""
    path, frame = samples.path, samples.sample_bytes
    if not path.is_file():
        raise CampaignError("no such file", path, f"the samples of {meta_path.name}", "Copy it there.")
    size = path.stat().st_size - samples.other_bytes
    if size % frame or size <= 0:
        other = f" less {samples.other_bytes} of core:header_bytes and core:trailing_bytes" * bool(samples.other_bytes)
        raise CampaignError(
            f"{path.stat().st_size} bytes{other}, not a multiple of {samples.channels}-channel samples",
            path,
            f"a multiple of {frame} bytes",
            "The file is truncated; copy it again.",
        )
    if captures.start[-1] >= size // frame:
        raise CampaignError(
            f"capture {len(captures.start) - 1} starts at sample {captures.start[-1]}, the data end at {size // frame}",
            meta_path,
            f"captures inside {path.name}",
            "The data are truncated or the metadata belong to another file; copy both again.",
        )
    return samples


def _length(captures: StatedCaptures, total: int, path: Path) -> int:
    lengths = np.diff(captures.start, append=total)
    length = int(np.median(lengths))
    short = np.flatnonzero((lengths < length) | (lengths < 1))
    if short.size:
        pulse = int(short[0])
        raise CampaignError(
            f"capture {pulse} holds {lengths[pulse]} samples (the data end at sample {total})",
            path,
            f"{max(length, 1)}, as most captures do",
            "The data are truncated (copy them again) or core:sample_start is wrong.",
        )
    return length


def _usable(length: int, layout: SampleLayout, path: Path) -> int:
    """Return the samples of each capture that can be had: the filter of real ones runs over their end."""
    if layout.mixing is None or not layout.mixing.restarts:
        return length
    if length <= 2 * SETTLING:
        found = f"captures of {length} real samples"
        raise CampaignError(found, path, f"more than {2 * SETTLING}: a filter needs them", "Record longer captures.")
    return length - SETTLING


def _checked(tags: NDArray[np.datetime64], path: Path) -> NDArray[np.datetime64]:
    backwards = np.flatnonzero(np.diff(tags) <= np.timedelta64(0, "ns"))
    if backwards.size:
        raise CampaignError(
            f"capture {int(backwards[0]) + 1} is tagged {tags[backwards[0] + 1]}, not after the one before",
            path,
            "increasing core:datetime",
            "Sort the captures or correct the tags.",
        )
    return tags
