"""AFRL Gotcha phase history (.mat): frequency-domain samples and antenna positions in the scene's frame.

It enters at `echo`: there are no raw samples, no clock and no code to remove.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.errors import CampaignError
from apertura.ingest.isolated import UnreadableError, read_isolated

_LARGEST = {"fp": 1e30, "freq": 1e12, "x": 1e7, "y": 1e7, "z": 1e7, "r0": 1e7}
"""What a field may hold: samples whose squares float32 still adds, Hz, m."""

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
    paths = sorted(paths)
    try:
        passes = read_isolated("apertura.ingest.mat_fields:read_fields", paths)
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error
    return joined(paths, passes, pair=pair)


def joined(paths: Sequence[Path], passes: Sequence[dict[str, NDArray[Any]]], *, pair: str) -> xr.Dataset:
    """Return the `echo` stage of what `apertura.ingest.mat_fields` read of each file.

    Parameters
    ----------
    paths
        Files in order, for messages.
    passes
        Per file fp (subcarrier, pulse) complex64; freq (subcarrier,) Hz; x, y, z, r0 (pulse,) m.
    pair
        Transmitter-receiver.

    Raises
    ------
    CampaignError
        If fields do not fit each other, hold NaN or values that no radar has, or frequencies differ between files.
    """
    for path, fields in zip(paths, passes, strict=True):
        _check(fields, path)
    first = passes[0]["freq"]
    for path, fields in zip(paths, passes, strict=True):
        if fields["freq"].shape != first.shape or np.abs(fields["freq"] - first).max() > 1e-6 * abs(first[0]):
            raise _error("other frequencies than the first file", path)
    antenna = np.concatenate([np.stack([f["x"], f["y"], f["z"]], -1) for f in passes])
    reference = 2 * np.concatenate([f["r0"] for f in passes]) / SPEED_OF_LIGHT_M_S
    transfer = np.concatenate([f["fp"].T for f in passes])
    pulses = np.arange(len(transfer))
    return xr.Dataset(
        {
            "time": ("pulse", _EPOCH + pulses * np.timedelta64(1, "s")),
            "tx_position": (("pulse", "axis"), antenna),
            "rx_position": (("pulse", "axis"), antenna.copy()),
            "transfer": (("pulse", "subcarrier"), transfer),
            "frequency": ("subcarrier", _even(first, paths[0])),
            "reference_delay": ("pulse", reference),
            "path_limit": ("pulse", np.full(len(pulses), np.inf)),
        },
        attrs={"frame": "local", "pair": pair, "flags": {}},
    )


def _check(fields: dict[str, NDArray[Any]], path: Path) -> None:
    size = fields["x"].size
    if fields["fp"].shape != (fields["freq"].size, size) or any(fields[name].size != size for name in ("y", "z", "r0")):
        raise _error(
            f"fp is {fields['fp'].shape} for {fields['freq'].size} frequencies, {size} pulses (y "
            f"{fields['y'].size}, z {fields['z'].size}, r0 {fields['r0'].size})",
            path,
        )
    for name, values in fields.items():
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            raise _error(f"{name} is not a number at index {bad[0].tolist()} ({len(bad)} in all)", path)
        largest = float(np.abs(values).max())
        if largest > _LARGEST[name]:
            raise _error(f"{name} reaches {largest:.3g}", path)
    silent = np.flatnonzero(~fields["fp"].any(axis=0))
    if silent.size:
        raise _error(f"pulse {int(silent[0])} holds only zeros ({silent.size} in all)", path)


def _even(frequency: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Return equal steps through `frequency`, which the files round to float32."""
    even = np.linspace(frequency[0], frequency[-1], frequency.size)
    step = even[1] - even[0] if even.size > 1 else 0.0
    if step <= 0 or frequency[0] <= 0 or np.abs(even - frequency).max() > 1e-2 * step:
        raise _error("frequencies that do not rise in equal steps", path)
    return even


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected="a Gotcha .mat file with data.fp (frequency, pulse), freq, x, y, z, r0, all finite",
        remedy="Copy the file again or take it out of the folder.",
    )
