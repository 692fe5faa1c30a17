"""What was transmitted: the code symbols, and what was sent before each symbol."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.echo.framing import Framing
from apertura.errors import CampaignError
from apertura.settings import OfdmWaveform


def read_codes(path: Path, subcarriers: int) -> NDArray[np.complex64]:
    """Return the transmitted code symbols, (subcarrier,) complex64.

    Raises
    ------
    CampaignError
        If the file is missing, of another length, or a symbol is zero or not finite.
    """
    try:
        codes = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"not readable ({error})", where=path, expected="a .npy file of code symbols", remedy="Copy it there."
        ) from error
    usable = codes.shape == (subcarriers,) and np.isfinite(codes).all() and np.abs(codes).min() > 0
    if not usable:
        raise CampaignError(
            f"{codes.dtype} of shape {codes.shape}, {int((codes == 0).sum())} of them zero",
            where=path,
            expected=f"({subcarriers},) complex64 without zeros, as config/config.yaml: waveform.subcarriers",
            remedy="Use the codes that were transmitted, or correct the waveform.",
        )
    return np.asarray(codes, np.complex64)


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
        If the preamble is missing.
    """
    if not path.is_file():
        raise CampaignError(
            "no such file",
            where=path,
            expected=f"the preamble that {where.name}: apertura:framing names",
            remedy="Copy it there.",
        )
    keys = ("chip_samples", "centre_hz", "counter_bits", "bit_chips", "guard_samples")
    chips = np.load(path, allow_pickle=False).astype(np.int64)
    return Framing(chips, sample_rate_hz=sample_rate_hz, **{key: described[key] for key in keys})
