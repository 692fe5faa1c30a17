"""Whether what was transmitted is what the waveform says: code symbols, or the samples of a pulse."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import OfdmWaveform


def check_codes(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a problem unless codes are complex, one per subcarrier, finite, not zero; or a pulse as long as stated."""
    waveform = inspected.waveform
    if waveform is None:
        return
    path = inspected.campaign.sent_file
    if not path.is_file() or path.stat().st_size == 0:
        return
    if not isinstance(waveform, OfdmWaveform):
        yield from inspected.unsent
        return
    found = _found(path, waveform.subcarriers)
    if found:
        yield CampaignError(
            found,
            where=path,
            expected=f"a .npy file of ({waveform.subcarriers},) complex64, waveform.subcarriers, finite, without zeros",
            remedy="Use the codes that were transmitted, or correct the waveform.",
        )


def _found(path: Path, subcarriers: int) -> str:
    """Return what is wrong with a file of codes, shape and type before any of its content is read; '' if nothing is."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(stream)
            at = stream.tell()
    except (OSError, ValueError) as error:
        return f"not a .npy file ({str(error).splitlines()[0]})"
    if shape != (subcarriers,) or dtype.kind != "c":
        return f"{dtype} of shape {shape}"
    if path.stat().st_size - at != subcarriers * dtype.itemsize:
        return f"{path.stat().st_size - at} bytes for {subcarriers} symbols of {dtype.itemsize}"
    codes = np.fromfile(path, dtype, offset=at)
    lost, silent = int((~np.isfinite(codes)).sum()), int((codes == 0).sum())
    if lost or silent:
        return f"{lost} symbols that are no number, {silent} that are zero"
    return ""
