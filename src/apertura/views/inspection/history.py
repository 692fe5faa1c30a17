"""Phase history: pulses, band, and where the antennas were."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.formats.names import PHASE_HISTORIES, log_suffixes
from apertura.formats.reading import read_phase_history
from apertura.views.inspection.log import bounds
from apertura.views.inspection.recording import LOST
from apertura.views.inspection.report import Report
from apertura.views.inspection.surroundings import NODE, Surroundings
from apertura.views.inspection.timing import counted, own_clock, timing

if TYPE_CHECKING:
    import xarray as xr


PHASE_HISTORY = "phase_history"
"""waveform.kind of samples that say themselves what was transmitted."""


def history_report(here: Path, files: Sequence[Path], kind: str, beside: Surroundings) -> Report:
    """Return what is told of phase history.

    Parameters
    ----------
    here
        The file or folder.
    files
        It and the one beside that belongs to it, or all of the folder.
    kind
        A key of `apertura.formats.names.PHASE_HISTORIES`.
    beside
        Where they lie.

    Raises
    ------
    CampaignError
        If there are none, they are not of that kind, or only the config of a campaign says what was transmitted, and
        there is none.
    """
    if not files:
        raise CampaignError(f"no {kind} group, the folder is empty", here, "phase history", "Copy the folder again.")
    described = beside.waveform if beside.waveform.get("format") == kind else {}
    if PHASE_HISTORIES[kind].waveform != PHASE_HISTORY and not described:
        raise CampaignError(
            "samples that do not say what was transmitted",
            here,
            f"raw/<flight>/{here.name} of a campaign whose config says waveform.format: {kind}",
            "`apertura init` makes a campaign folder; copy it there.",
        )
    echo = _read(files, kind, beside.node, described)
    from apertura.views.inspection.pictures import draw_history

    return Report(
        here,
        "phase history",
        kind,
        history_facts(echo),
        tuple(_missing(echo, kind, beside)),
        picture=lambda: draw_history(echo, here.name),
    )


def _read(files: Sequence[Path], kind: str, node: str, described: Mapping[str, Any]) -> "xr.Dataset":
    """Return the `echo` stage as of one antenna, else as of two, where the format says how it was taken."""
    try:
        return read_phase_history(kind, files, pair=f"{node}-{node}", described=described)
    except CampaignError as problem:
        try:
            return read_phase_history(kind, files, pair=f"tx-{node}", described=described)
        except CampaignError:
            raise problem from None


def history_facts(echo: "xr.Dataset") -> dict[str, Any]:
    """Return the facts of an `echo` stage."""
    frequency, times = echo.frequency.values, echo.time.values
    found: dict[str, Any] = {
        "pulses": len(times),
        "frequencies": frequency.size,
        "band_hz": [float(frequency[0]), float(frequency[-1])],
    }
    if frequency.size > 1:
        step_hz = float(frequency[-1] - frequency[0]) / (frequency.size - 1)
        found["resolution_of_path_m"] = SPEED_OF_LIGHT_M_S / (step_hz * frequency.size)
        found["unambiguous_path_m"] = SPEED_OF_LIGHT_M_S / step_hz
    found |= {"clock": "none, pulses are counted"} if counted(times) else timing(times, longer=LOST)
    if "tx_position" in echo:
        tx, rx = echo.tx_position.values, echo.rx_position.values
        found["frame"] = echo.attrs["frame"]
        found["bistatic"] = bool(np.abs(tx - rx).max() > 0)
        found |= {f"{leg}_bounds": bounds(at, echo.attrs["frame"]) for leg, at in (("tx", tx), ("rx", rx))}
    found["left_out"] = {why: int(count) for why, count in echo.attrs.get("dropped", {}).items()}
    found["flags"] = dict(echo.attrs.get("flags", {}))
    return found


def _missing(echo: "xr.Dataset", kind: str, beside: Surroundings) -> list[str]:
    found = []
    if "tx_position" not in echo and not beside.logged:
        found.append(f"where it was: a flight log {NODE}.track.<{'|'.join(log_suffixes())}> beside, for each antenna")
    if "tx_position" not in echo and not beside.aligned and own_clock(echo.time.values):
        found.append("the time: the recorder has a clock of its own; `apertura align` sets it against the log's")
    if not beside.waveform:
        found.append(f"its place: a campaign folder whose config says waveform.format: {kind}")
    return found
