"""Stages as what the engines are given: plain arrays, without files."""

from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.core.echo.compression import window_weights
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.geometry.aperture import Aperture

_APART = 64  # pulses: further apart they are read one by one


class Rows:
    """Samples of a stage that are read as pulses are asked for.

    Parameters
    ----------
    array
        (pulse, sample), opened lazily.

    Examples
    --------
    >>> rows = Rows(xr.DataArray(np.arange(12).reshape(4, 3)))
    >>> len(rows), rows[1:4:2].tolist(), np.asarray(rows).sum()
    (4, [[3, 4, 5], [9, 10, 11]], np.int64(66))
    """

    def __init__(self, array: xr.DataArray):
        self._array = array
        self.shape, self.ndim, self.dtype = array.shape, array.ndim, array.dtype

    def __len__(self) -> int:
        """Return the number of pulses."""
        return int(self.shape[0])

    def __getitem__(self, pulses: slice) -> NDArray[Any]:
        """Return the samples of some pulses; of pulses far apart no others are decoded."""
        first, last, step = pulses.indices(len(self))
        if step > _APART:
            return np.stack([self._array[number].values for number in range(first, last, step)])
        return np.asarray(self._array[first:last].values[::step])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return all of them."""
        return np.asarray(self._array.values, dtype)


def phase_history_of(echo: xr.Dataset, window: str, *, lazy: bool = False) -> PhaseHistory:
    """Return an echo stage as arrays, weighted by a window over the subcarriers; `lazy`: samples as they are asked."""
    return PhaseHistory(
        cast("NDArray[np.complex64]", Rows(echo.transfer)) if lazy else echo.transfer.values,
        echo.frequency.values,
        window_weights(window, len(echo.subcarrier)),
        echo.reference_delay.values,
        aperture_of(echo),
    )


def profiles_of(profile: xr.Dataset, *, lazy: bool = False) -> Profiles:
    """Return a profile stage as arrays; `lazy` as of `phase_history_of`."""
    return Profiles(
        cast("NDArray[np.complex64]", Rows(profile.profile)) if lazy else profile.profile.values,
        profile.start.values,
        profile.attrs["step_m"],
        profile.attrs["centre_frequency_hz"],
        profile.attrs["oversampling"],
        aperture_of(profile),
    )


def aperture_of(stage: xr.Dataset) -> Aperture:
    """Return the phase centres of an echo or profile stage."""
    return Aperture(stage.tx_position.values, stage.rx_position.values)


def inputs_of(given: PhaseHistory | Profiles | xr.Dataset, window: str = "hann") -> PhaseHistory | Profiles:
    """Return what an engine reads: arrays as they are, or those of a stage `echo` or `profile`.

    Raises
    ------
    TypeError
        If a dataset is another stage.
    """
    if isinstance(given, PhaseHistory | Profiles):
        return given
    if "transfer" in given:
        return phase_history_of(given, window)
    if "profile" in given:
        return profiles_of(given)
    raise TypeError(f"a dataset with {sorted(map(str, given.variables))}: must be a stage echo or profile")
