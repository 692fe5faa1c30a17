"""Reading of recordings, flight logs and phase histories as stages `raw`, `track` and `echo`.

Each format has one module and one row in `names`. Readers are imported when they are first used; the code hash of a
result covers only the readers of the campaign's files.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from apertura.formats.names import PHASE_HISTORIES, RECORDERS, TRACKS, log_format
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions

if TYPE_CHECKING:
    import xarray as xr

    from apertura.formats.recordings.recording import Recording


def open_recording(files: Sequence[Path]) -> "Recording":
    """Open a recording; metadata and sizes are checked, samples are not read.

    Parameters
    ----------
    files
        Files in the order of a row of `RECORDERS`.
    """
    names = [file.name for file in files]
    row = next(row for row in RECORDERS if len(row) == len(names) and names[0].endswith(row[0]))
    opened: Recording = RECORDERS[row](*files)
    return opened


def read_track(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> "xr.Dataset":
    """Read a flight log as `track` stage.

    Raises
    ------
    CampaignError
        If no format matches the file, or the log violates its format.
    """
    track: xr.Dataset = TRACKS[log_format(path, options)].reader(path, node=node, options=options)
    return track


def read_phase_history(
    kind: str, paths: Sequence[Path], *, pair: str, described: Mapping[str, Any] = MappingProxyType({})
) -> "xr.Dataset":
    """Read phase-history files as `echo` stage.

    Parameters
    ----------
    kind
        A key of `PHASE_HISTORIES`.
    paths
        The files, concatenated in this order.
    pair
        Transmitter-receiver.
    described
        Waveform section of the config, for formats that do not contain the waveform.
    """
    row = PHASE_HISTORIES[kind]
    options = {"described": described} if row.described else {}
    echo: xr.Dataset = row.reader(paths, pair=pair, **options)
    return echo
