"""Recorders and flight logs: bytes in, `raw`, `track` or `echo` out; one file and one row per format.

Rows name their readers and do not import them: a step pays for the formats that it meets.
"""

import pkgutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from apertura.errors import CampaignError

if TYPE_CHECKING:
    import xarray as xr

    from apertura.ingest.recording import Recording

RECORDERS: Mapping[tuple[str, ...], str] = {(".sigmf-meta", ".sigmf-data"): "apertura.ingest.sigmf:open_sigmf"}
"""Suffixes of the files of a recording, <node><suffix>, metadata first, samples last → opener(*files) → `Recording`."""

TRACKS: Mapping[str, str] = {
    ".csv": "apertura.ingest.csv_track:read_csv_track",
    ".pos": "apertura.ingest.rtklib:read_rtklib_pos",
}
"""Suffix of <node>.track.* → reader(path, node=) → `track`."""

PHASE_HISTORIES: Mapping[str, tuple[str, str]] = {"afrl_mat": (".mat", "apertura.ingest.afrl:read_afrl_mat")}
"""waveform.format → suffix of <node>.*, reader(paths, pair=) → `echo`."""


def open_recording(files: Sequence[Path]) -> "Recording":
    """Open a recording; metadata and sizes are checked, samples are not read.

    Parameters
    ----------
    files
        In the order of a row of `RECORDERS`.
    """
    names = [file.name for file in files]
    row = next(row for row in RECORDERS if len(row) == len(names) and all(map(str.endswith, names, row)))
    opened: Recording = pkgutil.resolve_name(RECORDERS[row])(*files)
    return opened


def read_track(path: Path, *, node: str) -> "xr.Dataset":
    """Return the `track` stage of a flight log.

    Raises
    ------
    CampaignError
        If there is no reader for the file's suffix, or the log is not what its format promises.
    """
    if path.suffix not in TRACKS:
        raise CampaignError(
            f"a flight log of kind {path.suffix!r}",
            where=path,
            expected=f"one of {sorted(TRACKS)}",
            remedy="Convert the log, or write a reader for it.",
        )
    track: xr.Dataset = pkgutil.resolve_name(TRACKS[path.suffix])(path, node=node)
    return track


def read_phase_history(kind: str, paths: Sequence[Path], *, pair: str) -> "xr.Dataset":
    """Return the `echo` stage of phase-history files; `kind` is a key of `PHASE_HISTORIES`."""
    echo: xr.Dataset = pkgutil.resolve_name(PHASE_HISTORIES[kind][1])(paths, pair=pair)
    return echo
