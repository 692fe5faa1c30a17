"""Compensated phase history data (CPHD 1.0.1 and 1.1.0, NGA.STND.0068-1), monostatic and bistatic.

A file contains the ECEF positions of both antennas for each pulse, and the reference point to which the samples are
compensated. This point determines the reference delay of the samples (docs/formats/phase_history.md, "CPHD").
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, quoted
from apertura.core.geometry.geodesy import LOCAL
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.phase_histories import cphd_fields
from apertura.formats.phase_histories.cphd_fields import PATH_LIMIT, PULSE_FIELDS
from apertura.formats.phase_histories.phase_history import LARGEST, LEAST, History, joined, largest_by_row, refused

_EXPECTED = "a CPHD file, version 1.0.1 or 1.1.0, with uncompressed samples in the frequency domain (DomainType FX)"
_FORMATS = {"CF8": ">c8", "CI4": ">i2", "CI2": "i1"}
"""SignalArrayFormat → dtype of a sample: a complex number, or two integers."""

_LARGEST = {
    "TxTime": 1e7,
    "RcvTime": 1e7,
    "SC0": 1e12,
    "SCSS": 1e12,
    "FX1": 1e12,
    "FX2": 1e12,
    "TOA1": 1.0,
    "TOA2": 1.0,
}
"""Largest accepted value of each per-vector parameter, s and Hz; 1e8 m for positions."""

_CYCLES = 1e-5
"""Tolerated phase error at the edge of the swath due to frequency differences between pulses, cycles (-84 dB)."""

_NORMAL = 1
"""SIGNAL of a pulse with an echo; 0: none, 2: noise, 3: noise of normal level."""

_ATMOSPHERE_S = 1e-7
"""Tolerance of delays, s (30 m of path), which allows for an unstated delay of troposphere and ionosphere."""

_REACH = 1e-3  # tolerance for rounding of FX1 and FX2, in frequency steps


def read_cphd(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Read CPHD files, concatenated in the order of their names, as `echo` stage.

    ``described["channel"]`` selects one of several channels. The frame is 'ecef'; files that apertura wrote for a
    campaign that is not georeferenced are converted back to the 'local' frame.

    Raises
    ------
    CampaignError
        If a file violates `_EXPECTED`, has a CollectType that contradicts the pair, is truncated or contains NaN, or
        frequencies differ between pulses.

    Notes
    -----
    Source: NGA.STND.0068-1, "Compensated Phase History Data (CPHD) Design & Implementation Description Document".
    """
    paths = sorted(paths)
    try:
        files = read_isolated(cphd_fields.read_fields, paths)
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error
    histories = [
        history(path, of_channel(path, fields, described.get("channel")), pair=pair)
        for path, fields in zip(paths, files, strict=True)
    ]
    return joined(histories, pair=pair, expected=_EXPECTED)


def of_channel(path: Path, fields: dict[str, NDArray[Any]], requested: str | None) -> dict[str, NDArray[Any]]:
    """Select the fields of the requested channel, or of the only channel."""
    names = list(map(str, fields["channels"]))
    if names.count(requested or "") != 1 and (requested is not None or len(names) != 1):
        raise CampaignError(
            f"{len(names)} channels, {', '.join(map(quoted, names[:9]))}",
            where=path,
            expected="a channel selected by waveform.channel" if requested is None else f"channel {quoted(requested)}",
            remedy="Set waveform.channel to one of these channels.",
        )
    own = f"{0 if requested is None else names.index(requested)}/"
    return {name.removeprefix(own): array for name, array in fields.items() if "/" not in name or name.startswith(own)}


def history(path: Path, fields: dict[str, NDArray[Any]], *, pair: str) -> History:
    """Build the phase history of a file from its per-vector parameters.

    Parameters
    ----------
    path
        The file; its samples are memory-mapped.
    fields
        Fields of one channel, see `of_channel`.
    pair
        Transmitter-receiver.

    Raises
    ------
    CampaignError
        See `read_cphd`.
    """
    refuse = partial(_error, path=path)
    _check_pair(str(fields["collect_type"]), pair, path)
    if abs(int(fields["sign"])) != 1:
        raise refuse(f"SGN {int(fields['sign'])}, not +1 or -1")
    samples = _mapped(path, fields)
    normal = fields["SIGNAL"] == _NORMAL if "SIGNAL" in fields else np.ones(len(samples), bool)
    for name in [*PULSE_FIELDS, *(name for name in ("AmpSF",) if name in fields)]:
        largest_by_row(name, fields[name][normal], _LARGEST.get(name, 1e8), refuse)
    if not normal.any():
        raise refuse("no pulse with SIGNAL 1")
    vectors = _Vectors(samples, fields, normal)
    _check_frequencies(vectors.frequency, fields, normal, path)
    is_zero = normal & (largest_by_row("the signal", vectors, LARGEST, refuse, least=LEAST) == 0)
    tx, rx, point = fields["TxPos"], fields["RcvPos"], fields["SRPPos"]
    path_m = np.linalg.norm(tx - point, axis=1) + np.linalg.norm(rx - point, axis=1)
    elapsed = np.where(normal, fields["TxTime"], 0.0)
    dropped = {"SIGNAL other than 1": int((~normal).sum()), "all samples zero": int(is_zero.sum())}
    return History(
        path,
        fields["start"] + np.round(elapsed * 1e9).astype("timedelta64[ns]"),
        _in_frame(fields, path, tx),
        _in_frame(fields, path, rx),
        vectors,
        vectors.frequency,
        reference_delay=path_m / SPEED_OF_LIGHT_M_S,
        path_limit=fields.get(PATH_LIMIT, np.full(len(tx), np.inf)),
        used=normal & ~is_zero,
        flags=_flags(fields, path_m / SPEED_OF_LIGHT_M_S, normal),
        frame=str(fields["frame"]),
        dropped={reason: count for reason, count in dropped.items() if count},
        reference="point",
    )


class _Vectors:
    """Samples of a file as transfer functions, converted lazily: (pulse, subcarrier) complex64."""

    dtype = np.dtype(np.complex64)
    ndim = 2

    def __init__(self, samples: NDArray[Any], fields: dict[str, NDArray[Any]], normal: NDArray[np.bool_]) -> None:
        first = int(np.flatnonzero(normal)[0])
        step = fields["SCSS"][first]
        all_hz = fields["SC0"][first] + step * np.arange(samples.shape[1])
        self._low, self._high = fields["FX1"] - _REACH * step, fields["FX2"] + _REACH * step
        inside = np.flatnonzero((all_hz >= self._low[normal].min()) & (all_hz <= self._high[normal].max()))
        self._columns = slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)
        self.frequency = all_hz[self._columns]
        self._samples, self._scale = samples, fields.get("AmpSF")
        self._conjugate = int(fields["sign"]) > 0
        self.shape = (len(samples), self.frequency.size)

    def __getitem__(self, index: Any) -> NDArray[np.complex64]:
        rows, columns = index if isinstance(index, tuple) else (index, slice(None))
        raw, frequency = self._samples[rows][:, self._columns][:, columns], self.frequency[columns]
        with np.errstate(over="ignore", invalid="ignore"):  # overflow becomes infinity and is rejected later
            values = raw.astype(np.complex64) if raw.ndim == 2 else raw[..., 0] + np.complex64(1j) * raw[..., 1]
            if self._scale is not None:
                values *= self._scale[rows, None].astype(np.float32)
        # samples of a pulse outside its band are undefined
        band = (frequency >= self._low[rows, None]) & (frequency <= self._high[rows, None])
        values = np.where(band, values.conj() if self._conjugate else values, np.complex64(0))
        return np.asarray(values, np.complex64)


def _mapped(path: Path, fields: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Map the samples of the file: (pulse, sample) complex, or (pulse, sample, 2) integers."""
    start, pulses, count = map(int, fields["layout"])
    start += int(fields["block"])
    name = str(fields["format"])
    if name not in _FORMATS:
        raise _error(f"samples of format {name!r}, not {', '.join(_FORMATS)}", path)
    kind = np.dtype(_FORMATS[name])
    shape = (pulses, count) if kind.kind == "c" else (pulses, count, 2)
    if (
        min(start, pulses, count) < 1
        or start + int(np.prod([*shape, kind.itemsize], dtype=object)) > path.stat().st_size
    ):
        raise _error(f"{pulses} pulses of {count} samples from byte {start} on exceed the size of the file", path)
    with path.open("rb") as stream:
        return np.memmap(stream, kind, "r", start, shape)


def _check_pair(collect_type: str, pair: str, path: Path) -> None:
    tx, rx = pair.split("-")
    if collect_type != ("MONOSTATIC" if tx == rx else "BISTATIC"):
        raise CampaignError(
            f"CollectType {collect_type} for pair {pair}",
            where=path,
            expected="MONOSTATIC for a single node, BISTATIC for two nodes",
            remedy="Correct transmitter and nodes of the flight, or name the file after the receiver.",
        )


def _check_frequencies(
    frequency: NDArray[np.float64], fields: dict[str, NDArray[Any]], normal: NDArray[np.bool_], path: Path
) -> None:
    if frequency.size < 2:
        raise _error("fewer than two samples between FX1 and FX2", path)
    first, last = (fields["SC0"] + number * fields["SCSS"] for number in (0, int(fields["layout"][2]) - 1))
    swath_s = np.abs([fields["TOA1"][normal], fields["TOA2"][normal]]).max()
    difference_hz = np.maximum(np.abs(first - first[normal][0]), np.abs(last - last[normal][0]))
    error_cycles = np.where(normal, difference_hz, 0.0) * swath_s
    if error_cycles.max() > _CYCLES:
        worst = int(error_cycles.argmax())
        raise CampaignError(
            f"frequencies (SC0, SCSS) of pulse {worst} differ by {difference_hz[worst]:.6g} Hz from the first pulse",
            where=path,
            expected=f"the same frequencies for all pulses, to within {_CYCLES / max(swath_s, 1e-300):.3g} Hz",
            remedy="Resample the pulses to common frequencies.",
        )


def _flags(fields: dict[str, NDArray[Any]], delay_s: NDArray[np.float64], normal: NDArray[np.bool_]) -> dict[str, str]:
    """Return a flag if the times of a file contradict its positions; a file contains no other redundant values."""
    known = sum(np.nan_to_num(fields[name]) for name in ("TDTropoSRP", "TDIonoSRP") if name in fields)
    error_s = np.abs(fields["RcvTime"] - fields["TxTime"] - delay_s - known)[normal]
    worst, number = int(error_s.argmax()), np.flatnonzero(normal)
    if error_s[worst] <= _ATMOSPHERE_S:
        return {}
    return {
        "reference_point": f"RcvTime - TxTime of pulse {number[worst]} differs by {error_s[worst]:.3g} s from the "
        f"delay of its reference point, {error_s[worst] * SPEED_OF_LIGHT_M_S:.3g} m of path "
        f"({int((error_s > _ATMOSPHERE_S).sum())} of {len(error_s)} pulses)"
    }


def _in_frame(fields: dict[str, NDArray[Any]], path: Path, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert ECEF positions to the frame stated in the file."""
    frame, axes = str(fields["frame"]), fields["axes"]
    if frame == "ecef":
        return position
    if frame != LOCAL or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9):
        raise _error(f"frame {quoted(frame)} without the axes of a local frame", path)
    return np.asarray((position - fields["origin"]) @ axes.T)


def _error(found: str, path: Path) -> CampaignError:
    return refused(found, path, _EXPECTED)
