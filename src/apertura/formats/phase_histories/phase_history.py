"""Phase histories of other radars: content required from any format, and concatenation of files to stage `echo`."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import nanoseconds
from apertura.core.echo.captures import HEAD, repeat_flags, repeated

if TYPE_CHECKING:
    import xarray as xr

LARGEST, LEAST = 1e15, 1e-12
"""Limits of the largest sample: powers of samples and of noise 60 dB below are within the range of float32."""

LOWEST_HZ = 1e6
"""Lowest frequency of an imaging radar, Hz; smaller numbers are in MHz or GHz."""

_BLOCK_BYTES = 8 << 20
_EARTH_M = (6.3e6, 1e8)
"""Accepted distances of an antenna from the Earth's centre, m: from below the terrain to beyond imaging orbits."""


class Samples(Protocol):
    """Transfer functions, (pulse, subcarrier), as an array or a lazily read array-like."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""

    def __getitem__(self, index: Any) -> NDArray[Any]: ...


@dataclass(frozen=True, eq=False)
class History:
    """Phase history of a file.

    Attributes
    ----------
    path
        The file, for messages.
    time
        (pulse,) datetime64[ns], UTC.
    tx_position, rx_position
        (pulse, 3) float64, metres in `frame`; None if positions come from flight logs.
    transfer
        (pulse, subcarrier), Σ a·exp(-j2πf(τ-τ_ref)).
    frequency
        (subcarrier,) float64, Hz.
    reference_delay
        (pulse,) float64, seconds: τ_ref.
    path_limit
        (pulse,) float64: total path, m, beyond which there are no echoes; infinite where unknown.
    used
        (pulse,) bool: mask of the pulses with echoes.
    frame
        'ecef' or 'local'; empty without positions.
    dropped
        Reason → number of pulses excluded by `used`.
    flags
        Flag name → one-line text with the measured values.
    reference
        Reference of the samples: a measured delay, or a point, for which τ_ref is the path to the point divided by the
        speed of light in vacuum.
    """

    path: Path
    time: NDArray[np.datetime64]
    tx_position: Floats | None
    rx_position: Floats | None
    transfer: Samples
    frequency: Floats
    reference_delay: Floats
    path_limit: Floats
    used: NDArray[np.bool_]
    frame: str
    dropped: Mapping[str, int] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)
    reference: Literal["delay", "point"] = "delay"


def largest_by_row(
    name: str, values: Samples, largest: float, refuse: Callable[[str], CampaignError], *, least: float = 0.0
) -> NDArray[np.float64]:
    """Return the largest magnitude of each row of an array, read in blocks.

    Parameters
    ----------
    name
        Name of the array in the file.
    values
        (row, …) numbers.
    largest
        Largest accepted magnitude.
    refuse
        Function that returns the error to raise from a description of the fault.
    least
        Smallest accepted magnitude of the largest value, unless all values are zero.

    Raises
    ------
    CampaignError
        If a value is not finite or exceeds `largest`, or the largest value is below `least`.

    Examples
    --------
    >>> largest_by_row("fp", np.array([[1j, -2.0], [0.0, 0.5]]), 10.0, ValueError)
    array([2. , 0.5])
    """
    rows, maxima = values.shape[0], np.zeros(values.shape[0])
    step = max(1, _BLOCK_BYTES // max(1, values.dtype.itemsize * int(np.prod(values.shape[1:], dtype=int))))
    for first in range(0, rows, step):
        block = np.asarray(values[first : first + step])
        bad = np.argwhere(~np.isfinite(block))
        if bad.size:
            index = [int(bad[0][0]) + first, *bad[0][1:].tolist()]
            raise refuse(f"{name} is not a number at index {index}")
        maxima[first : first + step] = np.abs(block).reshape(len(block), -1).max(axis=1)
    if rows and maxima.max() > largest:
        raise refuse(f"{name} reaches {maxima.max():.3g}, at most {largest:g} is accepted")
    if rows and 0 < maxima.max() < least:
        raise refuse(
            f"{name} reaches only {maxima.max():.3g}, at least {least:g} is accepted (multiply it by a constant)"
        )
    return maxima


def joined(histories: Sequence[History], *, pair: str, expected: str) -> "xr.Dataset":
    """Concatenate files to an `echo` stage with the propagation speed of vacuum; samples are read lazily.

    Parameters
    ----------
    histories
        Phase histories of the files, in the order of their pulses.
    pair
        Transmitter-receiver.
    expected
        Description of a valid file, for messages.

    Raises
    ------
    CampaignError
        If a file contains no pulse, an antenna position far from the Earth, frequencies that do not increase in equal
        steps, or times that do not increase; if its frequencies or frame differ from those of the first file; or if
        the samples of all files have no imaginary part.
    """
    import dask.array as da
    import xarray as xr

    from apertura.core.echo.association import missing_flags

    first = histories[0]
    frequency = _even(first, expected)
    for history in histories:
        _check(history, first, expected)
    _check_times(histories, expected)
    _check_phase(histories)
    node = pair.rpartition("-")[2]
    kept, repeat_flag, repeats = distinct(
        [history.transfer for history in histories], [history.used for history in histories], node=node
    )
    parts = [
        da.from_array(history.transfer, chunks=(_rows(history.transfer), -1), name=False, asarray=True)[used]
        for history, used in zip(histories, kept, strict=True)
    ]
    positions = ("tx_position", "rx_position") if first.frame else ()
    dims = {
        **dict.fromkeys(positions, ("pulse", "axis")),
        **dict.fromkeys(("time", "reference_delay", "path_limit"), "pulse"),
    }
    arrays = {
        name: (
            dims[name],
            np.concatenate([getattr(history, name)[used] for history, used in zip(histories, kept, strict=True)]),
        )
        for name in dims
    }
    attrs: dict[str, Any] = {"frame": first.frame} if first.frame else {}
    missing = missing_flags(nanoseconds(arrays["time"][1]))
    flags = Flags.merged(missing, repeat_flag, *(history.flags for history in histories))
    attrs |= {"pair": pair, "flags": flags, "reference": first.reference, "wave_speed_m_s": SPEED_OF_LIGHT_M_S}
    reasons = Counter[str](repeats)
    for history in histories:
        reasons.update(history.dropped)
    if reasons:
        attrs["pulses"] = {"used": len(arrays["time"][1]), "dropped": reasons.total(), "reasons": dict(reasons)}
    samples = ("pulse", "subcarrier"), da.concatenate(parts)
    return xr.Dataset({**arrays, "transfer": samples, "frequency": ("subcarrier", frequency)}, attrs=attrs)


def distinct(
    parts: Sequence[Samples], used: Sequence[NDArray[np.bool_]], *, node: str
) -> tuple[list[NDArray[np.bool_]], Flags, dict[str, int]]:
    """Exclude pulses that are bit-identical to earlier ones, in all files of a node.

    Pulses that are all identical are not excluded: a simulated echo of the reference point without noise.

    Parameters
    ----------
    parts
        Samples of each file, (pulse, sample).
    used
        Masks of the pulses with echoes.
    node
        Receiving node.

    Returns
    -------
    kept
        Masks of the pulses that remain.
    flags
        Flag `captures_repeated`.
    dropped
        Number of excluded pulses by reason.
    """
    places = [(part, int(row)) for part, mask in zip(parts, used, strict=True) for row in np.flatnonzero(mask)]

    def heads() -> Iterator[NDArray[Any]]:
        for part, mask in zip(parts, used, strict=True):
            middle, step = max(0, part.shape[1] - HEAD) // 2, _rows(part)
            for first in range(0, len(mask), step):
                block = np.asarray(part[first : first + step, middle : middle + HEAD])
                yield from block[mask[first : first + step]]

    def whole(number: int) -> NDArray[Any]:
        part, row = places[number]
        return np.asarray(part[row : row + 1])

    repeats = repeated(heads(), whole)
    if not repeats.any():
        return list(used), Flags(), {}
    identical = repeats.sum() == len(repeats) - 1
    remark = "; not excluded, because all are identical" if identical else ""
    flags = repeat_flags(repeats, node, first=int(repeats.argmax()), remark=remark)
    if identical:
        return list(used), flags, {}
    kept, begin = [mask.copy() for mask in used], 0
    for mask in kept:
        end = begin + int(mask.sum())
        mask[mask] = ~repeats[begin:end]
        begin = end
    return kept, flags, {"captures_repeated": int(repeats.sum())}


def _rows(samples: Samples) -> int:
    return max(1, _BLOCK_BYTES // max(1, samples.dtype.itemsize * samples.shape[1]))


def _check(history: History, first: History, expected: str) -> None:
    frequency = history.frequency
    if not history.used.any():
        raise refused("no pulse contains an echo", history.path, expected)
    if frequency.shape != first.frequency.shape or np.abs(frequency - first.frequency).max() > 1e-6 * frequency[0]:
        raise refused("frequencies differ from those of the first file", history.path, expected)
    if history.frame != first.frame:
        frames = [f"frame {file.frame}" if file.frame else "no positions" for file in (history, first)]
        raise refused(f"{frames[0]}, but {frames[1]} in the first file", history.path, expected)
    for name in ("tx_position", "rx_position") if history.frame == "ecef" else ():
        radius = np.linalg.norm(getattr(history, name), axis=1)
        bad = np.flatnonzero(history.used & ((radius < _EARTH_M[0]) | (radius > _EARTH_M[1])))
        if bad.size:
            found = (
                f"{name} of pulse {bad[0]} is {radius[bad[0]]:.0f} m from the Earth's centre ({bad.size} such pulses)"
            )
            raise refused(found, history.path, expected)


def _check_phase(histories: Sequence[History]) -> None:
    """Raise CampaignError if all samples are real and vary with frequency: each echo would appear at -τ as well."""
    varies = False
    for history in histories:
        for first in range(0, len(history.used), _rows(history.transfer)):
            block = np.asarray(history.transfer[first : first + _rows(history.transfer)])
            if block.imag.any():
                return
            varies |= bool((block != block[:, :1]).any())
    if varies:
        raise CampaignError(
            "the imaginary parts of all samples are zero",
            histories[0].path,
            "complex transfer functions",
            "Save real and imaginary parts; from real samples, echoes before and behind the reference delay cannot be "
            "distinguished.",
        )


def _check_times(histories: Sequence[History], expected: str) -> None:
    last = None
    for history in histories:
        time = history.time[history.used]
        back = np.flatnonzero(np.diff(time) <= np.timedelta64(0, "ns"))
        if back.size:
            raise refused(f"pulse {back[0] + 1} is not later than the previous pulse", history.path, expected)
        if last is not None and time[0] <= last:
            raise refused("pulses that are not later than those of the previous file", history.path, expected)
        last = time[-1]


def _even(history: History, expected: str) -> Floats:
    """Return equally spaced frequencies, without the rounding error of files that contain float32."""
    frequency = history.frequency
    if frequency.size and 0 < frequency[-1] < LOWEST_HZ:
        found = f"frequencies of {frequency[0]:g} to {frequency[-1]:g}, probably not in Hz"
        raise CampaignError(found, history.path, f"Hz, above {LOWEST_HZ:g}", "Convert frequencies to Hz.")
    even = np.linspace(frequency[0], frequency[-1], frequency.size)
    step = even[1] - even[0] if even.size > 1 else 0.0
    if not (step > 0 and frequency[0] > 0 and np.abs(even - frequency).max() <= 1e-2 * step):
        raise refused("frequencies that do not increase in equal steps", history.path, expected)
    return even


def refused(found: str, path: Path, expected: str) -> CampaignError:
    """Return the error for a file that violates its format.

    Examples
    --------
    >>> print(refused("no pulse contains an echo", Path("a.cphd"), "a CPHD file"))
    a.cphd: no pulse contains an echo; expected a CPHD file. Copy the file again, or remove it from the folder.
    """
    return CampaignError(
        found, where=path, expected=expected, remedy="Copy the file again, or remove it from the folder."
    )
