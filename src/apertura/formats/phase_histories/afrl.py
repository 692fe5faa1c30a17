"""AFRL Gotcha phase history (.mat): frequency-domain samples and antenna positions in the scene's frame.

It enters at `echo`: there are no raw samples, no clock and no code to remove.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.phase_histories import phase_history
from apertura.formats.phase_histories.phase_history import LARGEST, History, largest_by_row, refused

_EXPECTED = "a Gotcha .mat file with data.fp (frequency, pulse), freq, x, y, z, r0, all finite"

_LARGEST = {"fp": LARGEST, "freq": 1e12, "x": 1e7, "y": 1e7, "z": 1e7, "r0": 1e7}
"""Largest values of fields: samples, Hz, m."""

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
        passes = read_isolated("apertura.formats.phase_histories.mat_fields:read_fields", paths)
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error
    return joined(paths, passes, pair=pair)


def joined(paths: Sequence[Path], passes: Sequence[dict[str, NDArray[Any]]], *, pair: str) -> xr.Dataset:
    """Return the `echo` stage of what `apertura.formats.phase_histories.mat_fields` read of each file.

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
    histories, pulse = [], 0
    for path, fields in zip(paths, passes, strict=True):
        _check(fields, path)
        antenna = np.stack([fields["x"], fields["y"], fields["z"]], -1)
        pulses = np.arange(pulse, pulse + len(antenna))
        pulse += len(antenna)
        histories.append(
            History(
                path,
                _EPOCH + pulses * np.timedelta64(1, "s"),
                antenna,
                antenna.copy(),
                fields["fp"].T,
                fields["freq"],
                reference_delay=2 * fields["r0"] / SPEED_OF_LIGHT_M_S,
                path_limit=np.full(len(antenna), np.inf),
                used=np.ones(len(antenna), bool),
                frame="local",
                reference="point",
            )
        )
    return phase_history.joined(histories, pair=pair, expected=_EXPECTED)


def _check(fields: dict[str, NDArray[Any]], path: Path) -> None:
    size = fields["x"].size
    if fields["fp"].shape != (fields["freq"].size, size) or any(fields[name].size != size for name in ("y", "z", "r0")):
        raise _error(
            f"fp is {fields['fp'].shape} for {fields['freq'].size} frequencies, {size} pulses (y "
            f"{fields['y'].size}, z {fields['z'].size}, r0 {fields['r0'].size})",
            path,
        )
    for name, values in fields.items():
        largest_by_row(name, values, _LARGEST[name], lambda found: _error(found, path))
    silent = np.flatnonzero(~fields["fp"].any(axis=0))
    if silent.size:
        raise _error(f"pulse {int(silent[0])} holds only zeros ({silent.size} in all)", path)


def _error(found: str, path: Path) -> CampaignError:
    return refused(found, path, _EXPECTED)
