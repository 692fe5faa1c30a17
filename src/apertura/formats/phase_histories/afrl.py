"""AFRL Gotcha phase history (.mat): frequency-domain samples and antenna positions in the local frame of the scene.

The data are read as stage `echo`, because they contain no raw samples and no times, and no code is to be removed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, print_remark
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.phase_histories import mat_fields, phase_history
from apertura.formats.phase_histories.mat_fields import CORRECTIONS
from apertura.formats.phase_histories.phase_history import LARGEST, LEAST, History, largest_by_row, refused

_EXPECTED = "a Gotcha .mat file with data.fp (frequency, pulse), freq, x, y, z, r0, all finite"

_LARGEST = {"fp": LARGEST, "freq": 1e12, "x": 1e7, "y": 1e7, "z": 1e7, "r0": 1e7, "r_correct": 1e4, "ph_correct": 1e4}
"""Largest accepted value of each field: samples, Hz, m, rad."""

_LEAST = {"fp": LEAST}

_EPOCH = np.datetime64("1970-01-01", "ns")


def read_afrl_mat(
    paths: Sequence[Path], *, pair: str, described: Mapping[str, Any] = MappingProxyType({})
) -> xr.Dataset:
    """Read the .mat files of a pass, concatenated in the order of their names, as `echo` stage.

    Each file contains fp (subcarrier, pulse), freq (Hz), x, y, z and r0 (m). The radar is monostatic: the antenna is
    the phase centre of transmission and reception. Samples are referred to a delay of 2 r0/c. The data contain no
    times: `time` is the pulse number in seconds since 1970. The frame is 'local': metres from the scene centre.

    Files may contain corrections of their passes, data.af: r_correct (m) to be added to r0, and ph_correct (rad) to be
    added to the phase of samples. These corrections displace targets by decimetres and align the passes. They are
    applied if section `waveform` (`described`) contains ``corrections: stored``; otherwise they are only reported in
    `remarks`.

    Raises
    ------
    CampaignError
        If a file lacks a field or contains NaN, frequencies differ between files or are not equally spaced, or
        corrections to be applied are missing.

    Notes
    -----
    Source: C. H. Casteel et al., "A challenge problem for 2D/3D imaging of targets from a volumetric data set in an
    urban environment", Proc. SPIE 6568, 2007, and the data set's read-me.
    """
    paths = sorted(paths)
    try:
        passes = read_isolated(mat_fields.read_fields, paths)
    except UnreadableError as error:
        raise _error(f"not readable ({error})", error.path) from error
    return joined(paths, passes, pair=pair, corrected=described.get("corrections") == "stored")


def joined(
    paths: Sequence[Path], passes: Sequence[dict[str, NDArray[Any]]], *, pair: str, corrected: bool = False
) -> xr.Dataset:
    """Build the `echo` stage from the fields of each file.

    Parameters
    ----------
    paths
        Files in order, for messages.
    passes
        Fields of each file from `apertura.formats.phase_histories.mat_fields.read_fields`: fp (subcarrier, pulse)
        complex64; freq (subcarrier,) Hz; x, y, z, r0 (pulse,) m; optionally `CORRECTIONS`, (pulse,).
    pair
        Transmitter-receiver.
    corrected
        True to apply the corrections.

    Raises
    ------
    CampaignError
        If the shapes of fields are inconsistent, values are NaN or out of range, or frequencies differ between files.
    """
    histories, pulse = [], 0
    for path, fields in zip(paths, passes, strict=True):
        _check(fields, path)
        transfer, r0 = fields["fp"].T, fields["r0"]
        if corrected:
            missing = [name for name in CORRECTIONS if name not in fields]
            if missing:
                raise CampaignError(
                    f"no field data.af.{missing[0]}",
                    path,
                    "stored corrections, as configured in waveform.corrections",
                    "Set waveform.corrections to none.",
                )
            transfer = transfer * np.exp(1j * fields["ph_correct"])[:, None].astype(np.complex64)
            r0 = r0 + fields["r_correct"]
        antenna = np.stack([fields["x"], fields["y"], fields["z"]], -1)
        pulses = np.arange(pulse, pulse + len(antenna))
        pulse += len(antenna)
        histories.append(
            History(
                path,
                _EPOCH + pulses * np.timedelta64(1, "s"),
                antenna,
                antenna.copy(),
                transfer,
                fields["freq"],
                reference_delay=2 * r0 / SPEED_OF_LIGHT_M_S,
                path_limit=np.full(len(antenna), np.inf),
                used=np.ones(len(antenna), bool),
                frame="local",
                reference="point",
            )
        )
    echo = phase_history.joined(histories, pair=pair, expected=_EXPECTED)
    stored = [fields["r_correct"] for fields in passes if "r_correct" in fields]
    if corrected or not stored:
        return echo
    r_correct = np.concatenate(stored)
    remark = (
        f"data.af contains corrections of r0 ({r_correct.min():.2f} to {r_correct.max():.2f} m) and of phases; these "
        "corrections are not applied; to apply them, set waveform.corrections: stored"
    )
    print_remark(str(paths[0]), remark)
    return echo.assign_attrs(remarks=[remark])


def _check(fields: dict[str, NDArray[Any]], path: Path) -> None:
    size = fields["x"].size
    per_pulse = [name for name in ("y", "z", "r0", *CORRECTIONS) if name in fields]
    if fields["fp"].shape != (fields["freq"].size, size) or any(fields[name].size != size for name in per_pulse):
        raise _error(
            f"fp is {fields['fp'].shape} for {fields['freq'].size} frequencies, {size} pulses (y "
            f"{fields['y'].size}, z {fields['z'].size}, r0 {fields['r0'].size})",
            path,
        )
    for name, values in fields.items():
        largest_by_row(name, values, _LARGEST[name], lambda found: _error(found, path), least=_LEAST.get(name, 0.0))
    zero_pulses = np.flatnonzero(~fields["fp"].any(axis=0))
    if zero_pulses.size:
        raise _error(f"pulse {int(zero_pulses[0])} contains only zeros ({zero_pulses.size} such pulses)", path)


def _error(found: str, path: Path) -> CampaignError:
    return refused(found, path, _EXPECTED)
