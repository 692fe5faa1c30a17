"""What was transmitted: the code symbols, and what was sent before each symbol."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.echo.framing import Framing
from apertura.errors import CampaignError
from apertura.ingest.npy import read_npy
from apertura.settings import OfdmWaveform

MOST_SYMBOLS = 1 << 24
"""Code symbols of a waveform."""

MOST_CHIPS = 1 << 20
"""Chips of a preamble."""

MOST_LEAD_SAMPLES = 1 << 26
"""Samples before a symbol."""


def read_codes(path: Path, subcarriers: int) -> NDArray[np.complex64]:
    """Return the transmitted code symbols, (subcarrier,) complex64.

    Raises
    ------
    CampaignError
        If the file is missing, of another length, or a symbol is zero or not finite.
    """
    expected = f"({subcarriers},) complex64 without zeros, as config/config.yaml: waveform.subcarriers"
    remedy = "Use the codes that were transmitted, or correct the waveform."
    if not path.is_file():
        raise CampaignError("no such file", where=path, expected=expected, remedy="Copy it there.")
    stored = read_npy(path, kinds="c", most=MOST_SYMBOLS, expected=expected, remedy=remedy)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        codes = stored.astype(np.complex64)
    usable = codes.shape == (subcarriers,) and np.isfinite(codes).all() and np.abs(codes).min() > 0
    if not usable:
        raise CampaignError(
            f"{stored.dtype} of shape {codes.shape}, {int((codes == 0).sum())} of them zero, "
            f"{int((~np.isfinite(codes)).sum())} not finite",
            where=path,
            expected=expected,
            remedy=remedy,
        )
    return codes


def symbol_samples(waveform: OfdmWaveform) -> int:
    """Return how many samples cyclic prefix and symbol last: (T_cp + T)·f_s."""
    return round((waveform.cyclic_prefix_s + waveform.symbol_s) * waveform.sample_rate_hz)


def read_framing(path: Path, described: Mapping[str, Any], *, sample_rate_hz: float, where: Path) -> Framing:
    """Return what was sent before each symbol.

    Parameters
    ----------
    path
        .npy file of the preamble's chips, ±1.
    described
        The recorder's apertura:framing.
    sample_rate_hz
        Complex samples per second.
    where
        The file that describes it, for messages.

    Raises
    ------
    CampaignError
        If the preamble is missing, is not chips of ±1, or takes longer than any pulse.
    """
    if not path.is_file():
        raise CampaignError(
            "no such file",
            where=path,
            expected=f"the preamble that {where.name}: apertura:framing names",
            remedy="Copy it there.",
        )
    expected = f"one dimension of chips +1 and -1, no more than {MOST_CHIPS}"
    chips = read_npy(path, kinds="if", most=MOST_CHIPS, expected=expected, remedy="Save the preamble that was sent.")
    if chips.ndim != 1 or not chips.size or not np.isin(chips, (-1, 1)).all():
        found = f"{chips.dtype} of shape {chips.shape}, {int((~np.isin(chips, (-1, 1))).sum())} neither 1 nor -1"
        raise CampaignError(found, where=path, expected=expected, remedy="Save the preamble that was sent.")
    keys = ("chip_samples", "centre_hz", "counter_bits", "bit_chips", "guard_samples")
    framing = Framing(chips.astype(np.int64), sample_rate_hz=sample_rate_hz, **{key: described[key] for key in keys})
    if framing.lead_samples > MOST_LEAD_SAMPLES:
        raise CampaignError(
            f"{framing.lead_samples} samples of preamble, counter and guard before each symbol",
            where=where,
            expected=f"no more than {MOST_LEAD_SAMPLES}",
            remedy="Correct apertura:framing.",
        )
    return framing
