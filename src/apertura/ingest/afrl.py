"""AFRL Gotcha phase history (.mat): frequency-domain samples and antenna positions in the scene's frame.

It enters at `echo`: there are no raw samples, no clock and no code to remove.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.io import loadmat

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.errors import CampaignError

_EPOCH = np.datetime64("1970-01-01", "ns")


def read_afrl_mat(paths: Sequence[Path], *, pair: str) -> xr.Dataset:
    """Return the `echo` stage of a pass whose .mat files are joined in the order of their names.

    Each holds fp (subcarrier, pulse), freq (Hz), x, y, z and r0 (m). Monostatic: both phase centres are the antenna.
    Samples are referred to a delay of 2 r0/c. The data carry no clock: `time` counts pulses from the epoch at 1 s.
    Frame 'local': metres from the scene centre.

    Raises
    ------
    CampaignError
        If a file lacks a field, holds NaN, or frequencies differ between files or are not equally spaced.

    Notes
    -----
    Source: C. H. Casteel et al., "A challenge problem for 2D/3D imaging of targets from a volumetric data set in an
    urban environment", Proc. SPIE 6568, 2007, and the data set's read-me.
    """
    passes = [_read(path) for path in sorted(paths)]
    first = passes[0]["freq"]
    for path, fields in zip(sorted(paths), passes, strict=True):
        if fields["freq"].shape != first.shape or np.ptp(fields["freq"] - first) > 1e-6 * first[0]:
            raise _error("other frequencies than the first file", path)
    antenna = np.concatenate([np.stack([f["x"], f["y"], f["z"]], -1) for f in passes])
    reference = 2 * np.concatenate([f["r0"] for f in passes]) / SPEED_OF_LIGHT_M_S
    transfer = np.concatenate([f["fp"].T for f in passes]).astype(np.complex64)
    pulses = np.arange(len(transfer))
    return xr.Dataset(
        {
            "time": ("pulse", _EPOCH + pulses * np.timedelta64(1, "s")),
            "tx_position": (("pulse", "axis"), antenna),
            "rx_position": (("pulse", "axis"), antenna.copy()),
            "transfer": (("pulse", "subcarrier"), transfer),
            "frequency": ("subcarrier", _even(first, sorted(paths)[0])),
            "reference_delay": ("pulse", reference),
            "path_limit": ("pulse", np.full(len(pulses), np.inf)),
        },
        attrs={"frame": "local", "pair": pair, "flags": {}},
    )


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        data = loadmat(path, squeeze_me=True, struct_as_record=False)["data"]
        fields = {name: np.asarray(getattr(data, name)) for name in ("fp", "freq", "x", "y", "z", "r0")}
    except Exception as error:  # loadmat raises many kinds for a file that is not one
        raise _error(f"not readable ({str(error).splitlines()[0]})", path) from error
    fields |= {name: np.atleast_1d(fields[name]).astype(np.float64) for name in ("freq", "x", "y", "z", "r0")}
    if fields["fp"].shape != (fields["freq"].size, fields["x"].size):
        raise _error(
            f"fp is {fields['fp'].shape} for {fields['freq'].size} frequencies, {fields['x'].size} pulses", path
        )
    for name, values in fields.items():
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            raise _error(f"{name} is not a number at index {bad[0].tolist()} ({len(bad)} in all)", path)
    silent = np.flatnonzero(~fields["fp"].any(axis=0))
    if silent.size:
        raise _error(f"pulse {int(silent[0])} holds only zeros ({silent.size} in all)", path)
    return fields


def _even(frequency: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Return equal steps through `frequency`, which the files round to float32."""
    even = np.linspace(frequency[0], frequency[-1], frequency.size)
    step = even[1] - even[0]
    if step <= 0 or np.abs(even - frequency).max() > 1e-2 * step:
        raise _error("frequencies that do not rise in equal steps", path)
    return even


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected="a Gotcha .mat file with data.fp (frequency, pulse), freq, x, y, z, r0, all finite",
        remedy="Copy the file again or take it out of the folder.",
    )
