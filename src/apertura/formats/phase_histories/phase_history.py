"""Phase histories of other radars: what files of any format must hold, and how they are joined into stage `echo`."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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

if TYPE_CHECKING:
    import xarray as xr

LARGEST = 1e30
"""Largest sample: its square still adds up in float32."""

LOWEST_HZ = 1e6
"""No radar images at less: frequencies below are in MHz or GHz."""

_BLOCK_BYTES = 8 << 20
_EARTH_M = (6.3e6, 1e8)
"""How far from the Earth's centre an antenna may be: below any ground, beyond any orbit that images."""


class Samples(Protocol):
    """Transfer functions, (pulse, subcarrier), read lazily: an array, or an array-like."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its extent."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its values."""

    def __getitem__(self, index: Any) -> NDArray[Any]: ...


@dataclass(frozen=True, eq=False)
class History:
    """Content of one file.

    Attributes
    ----------
    path
        The file, for messages.
    time
        (pulse,) datetime64[ns], UTC.
    tx_position, rx_position
        (pulse, 3) float64, metres in `frame`; None where flight logs hold them.
    transfer
        (pulse, subcarrier), Σ a·exp(-j2πf(τ-τ_ref)).
    frequency
        (subcarrier,) float64, Hz.
    reference_delay
        (pulse,) float64, seconds: τ_ref.
    path_limit
        (pulse,) float64, metres of total path beyond which there are no echoes; infinite where not stated.
    used
        (pulse,) bool, those that hold echoes.
    frame
        'ecef' or 'local'; empty without positions.
    dropped
        Reason → how many pulses `used` leaves out.
    flags
        Edge crossed → what was measured, in one line.
    reference
        What samples are referred to: a delay as it was, or a point, so that τ_ref is its distance over the speed of
        light in vacuum, and no delay of its own.
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
    name: str, values: Samples, largest: float, refuse: Callable[[str], CampaignError]
) -> NDArray[np.float64]:
    """Return the largest magnitude of an array along its first axis, read in blocks.

    Parameters
    ----------
    name
        Its name in the file.
    values
        (row, …) numbers.
    largest
        What they may reach.
    refuse
        What was found → the error to raise.

    Raises
    ------
    CampaignError
        If a value is not a number, or larger.

    Examples
    --------
    >>> largest_by_row("fp", np.array([[1j, -2.0], [0.0, 0.5]]), 10.0, ValueError)
    array([2. , 0.5])
    """
    rows, found = values.shape[0], np.zeros(values.shape[0])
    step = max(1, _BLOCK_BYTES // max(1, values.dtype.itemsize * int(np.prod(values.shape[1:], dtype=int))))
    for first in range(0, rows, step):
        block = np.asarray(values[first : first + step])
        bad = np.argwhere(~np.isfinite(block))
        if bad.size:
            index = [int(bad[0][0]) + first, *bad[0][1:].tolist()]
            raise refuse(f"{name} is not a number at index {index}")
        found[first : first + step] = np.abs(block).reshape(len(block), -1).max(axis=1)
    if rows and found.max() > largest:
        raise refuse(f"{name} reaches {found.max():.3g}")
    return found


def joined(histories: Sequence[History], *, pair: str, expected: str) -> "xr.Dataset":
    """Return the `echo` stage of files that follow each other, of waves in vacuum; samples are read lazily.

    Parameters
    ----------
    histories
        Of the files, in the order of their pulses.
    pair
        Transmitter-receiver.
    expected
        What such a file is, for messages.

    Raises
    ------
    CampaignError
        If a file holds no pulse, an antenna that is nowhere near the Earth, frequencies that do not rise in equal
        steps, or times that do not rise; or if it differs from the first in its frequencies or its frame.
    """
    import dask.array as da
    import xarray as xr

    from apertura.core.echo.association import missing_flags

    first = histories[0]
    frequency = _even(first, expected)
    for history in histories:
        _check(history, first, expected)
    _check_times(histories, expected)
    parts = [
        da.from_array(one.transfer, chunks=(_rows(one.transfer), -1), name=False, asarray=True)[one.used]
        for one in histories
    ]
    placed = ("tx_position", "rx_position") if first.frame else ()
    dims = {
        **dict.fromkeys(placed, ("pulse", "axis")),
        **dict.fromkeys(("time", "reference_delay", "path_limit"), "pulse"),
    }
    pulsed = {name: (dims[name], np.concatenate([getattr(one, name)[one.used] for one in histories])) for name in dims}
    attrs: dict[str, Any] = {"frame": first.frame} if first.frame else {}
    missing = missing_flags(nanoseconds(pulsed["time"][1]))
    flags = Flags.merged(missing, *(one.flags for one in histories))
    attrs |= {"pair": pair, "flags": flags, "reference": first.reference, "wave_speed_m_s": SPEED_OF_LIGHT_M_S}
    reasons = Counter[str]()
    for one in histories:
        reasons.update(one.dropped)
    if reasons:
        attrs["pulses"] = {"used": len(pulsed["time"][1]), "dropped": reasons.total(), "reasons": dict(reasons)}
    samples = ("pulse", "subcarrier"), da.concatenate(parts)
    return xr.Dataset({**pulsed, "transfer": samples, "frequency": ("subcarrier", frequency)}, attrs=attrs)


def _rows(samples: Samples) -> int:
    return max(1, _BLOCK_BYTES // max(1, samples.dtype.itemsize * samples.shape[1]))


def _check(history: History, first: History, expected: str) -> None:
    frequency = history.frequency
    if not history.used.any():
        raise refused("no pulse holds an echo", history.path, expected)
    if frequency.shape != first.frequency.shape or np.abs(frequency - first.frequency).max() > 1e-6 * frequency[0]:
        raise refused("other frequencies than the first file", history.path, expected)
    if history.frame != first.frame:
        frames = [one.frame or "no positions" for one in (history, first)]
        raise refused(f"{frames[0]}, and {frames[1]} in the first file", history.path, expected)
    for name in ("tx_position", "rx_position") if history.frame == "ecef" else ():
        radius = np.linalg.norm(getattr(history, name), axis=1)
        bad = np.flatnonzero(history.used & ((radius < _EARTH_M[0]) | (radius > _EARTH_M[1])))
        if bad.size:
            found = f"{name} of pulse {bad[0]} is {radius[bad[0]]:.0f} m from the Earth's centre ({bad.size} in all)"
            raise refused(found, history.path, expected)


def _check_times(histories: Sequence[History], expected: str) -> None:
    last = None
    for history in histories:
        time = history.time[history.used]
        back = np.flatnonzero(np.diff(time) <= np.timedelta64(0, "ns"))
        if back.size:
            raise refused(f"pulse {back[0] + 1} is not later than the one before it", history.path, expected)
        if last is not None and time[0] <= last:
            raise refused("pulses that are not later than those of the file before it", history.path, expected)
        last = time[-1]


def _even(history: History, expected: str) -> Floats:
    """Return equal steps through the frequencies, which files may round to float32."""
    frequency = history.frequency
    if frequency.size and 0 < frequency[-1] < LOWEST_HZ:
        found = f"frequencies of {frequency[0]:g} to {frequency[-1]:g}: in another unit than Hz?"
        raise CampaignError(found, history.path, f"Hz, above {LOWEST_HZ:g}", "Write frequencies in Hz.")
    even = np.linspace(frequency[0], frequency[-1], frequency.size)
    step = even[1] - even[0] if even.size > 1 else 0.0
    if not (step > 0 and frequency[0] > 0 and np.abs(even - frequency).max() <= 1e-2 * step):
        raise refused("frequencies that do not rise in equal steps", history.path, expected)
    return even


def refused(found: str, path: Path, expected: str) -> CampaignError:
    """Return the error of a file that is not what its format promises.

    Examples
    --------
    >>> print(refused("no pulse holds an echo", Path("a.cphd"), "a CPHD file"))
    a.cphd: no pulse holds an echo; expected a CPHD file. Copy the file again or take it out of the folder.
    """
    return CampaignError(
        found, where=path, expected=expected, remedy="Copy the file again or take it out of the folder."
    )
