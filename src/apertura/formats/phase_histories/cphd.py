"""Compensated phase history data (CPHD 1.0.1 and 1.1.0, NGA.STND.0068-1), monostatic and bistatic.

A file says of each pulse where it was sent and received, in ECEF, and by the reference point to which its samples are
compensated also their reference delay (docs/formats/phase_history.md, "CPHD").
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
from apertura.formats.phase_histories.phase_history import LARGEST, History, joined, largest_by_row, refused

_EXPECTED = "a CPHD file, version 1.0.1 or 1.1.0, of samples over frequency (DomainType FX), not compressed"
_FORMATS = {"CF8": ">c8", "CI4": ">i2", "CI2": "i1"}
"""SignalArrayFormat → dtype of a sample: one complex number, or two integers."""

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
"""Largest parameters of a pulse, s and Hz; 1e8 m for positions."""

_CYCLES = 1e-5
"""By which a pulse's frequencies may turn an echo at the edge of its swath against those of another: -84 dB."""

_NORMAL = 1
"""SIGNAL of a pulse with an echo; 0: none, 2: noise, 3: noise of normal level."""

_ATMOSPHERE_S = 1e-7
"""Seconds, 30 m of path: more than troposphere and ionosphere add to any path, where a file does not state it."""

_REACH = 1e-3  # of a step: FX1 and FX2 are rounded


def read_cphd(paths: Sequence[Path], *, pair: str, described: Mapping[str, Any]) -> xr.Dataset:
    """Return the `echo` stage of CPHD files, joined in the order of their names.

    Of several channels that is read which ``described["channel"]`` names. Frame 'ecef'; what `apertura` wrote of a
    campaign without a place on Earth comes back in its 'local' frame.

    Raises
    ------
    CampaignError
        If a file is not what `_EXPECTED` says, was not taken as the pair says, is cut off, holds NaN, or pulses have
        frequencies of their own.

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
    """Return the fields of one channel: the requested one, or the only one."""
    names = list(map(str, fields["channels"]))
    if names.count(requested or "") != 1 and (requested is not None or len(names) != 1):
        raise CampaignError(
            f"{len(names)} channels, {', '.join(map(quoted, names[:9]))}",
            where=path,
            expected="the one that waveform.channel names" if requested is None else f"one called {quoted(requested)}",
            remedy="Set waveform.channel to one of them.",
        )
    own = f"{0 if requested is None else names.index(requested)}/"
    return {name.removeprefix(own): array for name, array in fields.items() if "/" not in name or name.startswith(own)}


def history(path: Path, fields: dict[str, NDArray[Any]], *, pair: str) -> History:
    """Return a file's pulses, of which `apertura.formats.phase_histories.cphd_fields` has read the parameters.

    Parameters
    ----------
    path
        The file; its samples are mapped.
    fields
        Of one channel, `of_channel`.
    pair
        Transmitter-receiver.

    Raises
    ------
    CampaignError
        As `read_cphd`.
    """
    refuse = partial(_error, path=path)
    _check_pair(str(fields["collect_type"]), pair, path)
    if abs(int(fields["sign"])) != 1:
        raise refuse(f"SGN {int(fields['sign'])}, and neither +1 nor -1")
    samples = _mapped(path, fields)
    normal = fields["SIGNAL"] == _NORMAL if "SIGNAL" in fields else np.ones(len(samples), bool)
    for name in [*PULSE_FIELDS, *(name for name in ("AmpSF",) if name in fields)]:
        largest_by_row(name, fields[name][normal], _LARGEST.get(name, 1e8), refuse)
    if not normal.any():
        raise refuse("no pulse of SIGNAL 1")
    vectors = _Vectors(samples, fields, normal)
    _check_frequencies(vectors.frequency, fields, normal, path)
    silent = normal & (largest_by_row("the signal", vectors, LARGEST, refuse) == 0)
    tx, rx, point = fields["TxPos"], fields["RcvPos"], fields["SRPPos"]
    path_m = np.linalg.norm(tx - point, axis=1) + np.linalg.norm(rx - point, axis=1)
    elapsed = np.where(normal, fields["TxTime"], 0.0)
    dropped = {"not of SIGNAL 1": int((~normal).sum()), "silent": int(silent.sum())}
    return History(
        path,
        fields["start"] + np.round(elapsed * 1e9).astype("timedelta64[ns]"),
        _in_frame(fields, path, tx),
        _in_frame(fields, path, rx),
        vectors,
        vectors.frequency,
        reference_delay=path_m / SPEED_OF_LIGHT_M_S,
        path_limit=fields.get(PATH_LIMIT, np.full(len(tx), np.inf)),
        used=normal & ~silent,
        flags=_flags(fields, path_m / SPEED_OF_LIGHT_M_S, normal),
        frame=str(fields["frame"]),
        dropped={why: count for why, count in dropped.items() if count},
        reference="point",
    )


class _Vectors:
    """Samples of a file as transfer functions, converted lazily: (pulse, subcarrier) complex64."""

    dtype = np.dtype(np.complex64)
    ndim = 2

    def __init__(self, samples: NDArray[Any], fields: dict[str, NDArray[Any]], normal: NDArray[np.bool_]) -> None:
        first = int(np.flatnonzero(normal)[0])
        step = fields["SCSS"][first]
        every = fields["SC0"][first] + step * np.arange(samples.shape[1])
        self._low, self._high = fields["FX1"] - _REACH * step, fields["FX2"] + _REACH * step
        inside = np.flatnonzero((every >= self._low[normal].min()) & (every <= self._high[normal].max()))
        self._columns = slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)
        self.frequency = every[self._columns]
        self._samples, self._scale = samples, fields.get("AmpSF")
        self._conjugate = int(fields["sign"]) > 0
        self.shape = (len(samples), self.frequency.size)

    def __getitem__(self, index: Any) -> NDArray[np.complex64]:
        rows, columns = index if isinstance(index, tuple) else (index, slice(None))
        raw = self._samples[rows][:, self._columns]
        with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, and is refused as such
            values = raw.astype(np.complex64) if raw.ndim == 2 else raw[..., 0] + np.complex64(1j) * raw[..., 1]
            if self._scale is not None:
                values *= self._scale[rows, None].astype(np.float32)
        # beyond its own band a pulse may hold anything
        band = (self.frequency >= self._low[rows, None]) & (self.frequency <= self._high[rows, None])
        values = np.where(band, values.conj() if self._conjugate else values, np.complex64(0))
        return np.asarray(values[:, columns], np.complex64)


def _mapped(path: Path, fields: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the samples as they lie in the file: (pulse, sample), or (pulse, sample, 2) whole numbers."""
    begin, pulses, count = map(int, fields["layout"])
    begin += int(fields["block"])
    name = str(fields["format"])
    if name not in _FORMATS:
        raise _error(f"samples of format {name!r}", path)
    kind = np.dtype(_FORMATS[name])
    shape = (pulses, count) if kind.kind == "c" else (pulses, count, 2)
    if (
        min(begin, pulses, count) < 1
        or begin + int(np.prod([*shape, kind.itemsize], dtype=object)) > path.stat().st_size
    ):
        raise _error(f"{pulses} pulses of {count} samples from byte {begin} on, more than the file holds", path)
    with path.open("rb") as stream:
        return np.memmap(stream, kind, "r", begin, shape)


def _check_pair(collect_type: str, pair: str, path: Path) -> None:
    tx, rx = pair.split("-")
    if collect_type != ("MONOSTATIC" if tx == rx else "BISTATIC"):
        raise CampaignError(
            f"CollectType {collect_type} for pair {pair}",
            where=path,
            expected="MONOSTATIC where one node sends and receives, BISTATIC where two do",
            remedy="Correct transmitter and nodes of the flight, or put the file under the receiver's name.",
        )


def _check_frequencies(
    frequency: NDArray[np.float64], fields: dict[str, NDArray[Any]], normal: NDArray[np.bool_], path: Path
) -> None:
    if frequency.size < 2:
        raise _error("no two samples between FX1 and FX2", path)
    first, last = (fields["SC0"] + number * fields["SCSS"] for number in (0, int(fields["layout"][2]) - 1))
    swath_s = np.abs([fields["TOA1"][normal], fields["TOA2"][normal]]).max()
    away = np.maximum(np.abs(first - first[normal][0]), np.abs(last - last[normal][0]))
    turned = np.where(normal, away, 0.0) * swath_s
    if turned.max() > _CYCLES:
        worst = int(turned.argmax())
        raise CampaignError(
            f"frequencies (SC0, SCSS) of pulse {worst} are {away[worst]:.6g} Hz from those of the first",
            where=path,
            expected=f"one set of frequencies for all pulses, to within {_CYCLES / max(swath_s, 1e-300):.3g} Hz",
            remedy="Resample the pulses to common frequencies.",
        )


def _flags(fields: dict[str, NDArray[Any]], delay_s: NDArray[np.float64], normal: NDArray[np.bool_]) -> dict[str, str]:
    """Return a flag where a file's times contradict its positions: the one redundancy that it has."""
    known = sum(np.nan_to_num(fields[name]) for name in ("TDTropoSRP", "TDIonoSRP") if name in fields)
    error_s = np.abs(fields["RcvTime"] - fields["TxTime"] - delay_s - known)[normal]
    worst, number = int(error_s.argmax()), np.flatnonzero(normal)
    if error_s[worst] <= _ATMOSPHERE_S:
        return {}
    return {
        "reference_point": f"RcvTime - TxTime of pulse {number[worst]} is {error_s[worst]:.3g} s from the "
        f"delay of its reference point, {error_s[worst] * SPEED_OF_LIGHT_M_S:.3g} m of path "
        f"({int((error_s > _ATMOSPHERE_S).sum())} of {len(error_s)} pulses)"
    }


def _in_frame(fields: dict[str, NDArray[Any]], path: Path, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ECEF positions unchanged, or in the local frame stated by the file."""
    frame, axes = str(fields["frame"]), fields["axes"]
    if frame == "ecef":
        return position
    if frame != LOCAL or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9):
        raise _error(f"frame {quoted(frame)} without axes to return to", path)
    return np.asarray((position - fields["origin"]) @ axes.T)


def _error(found: str, path: Path) -> CampaignError:
    return refused(found, path, _EXPECTED)
