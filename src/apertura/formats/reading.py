"""Recorders and flight logs: bytes in, `raw`, `track` or `echo` out; one file and one row of `names` per format.

Readers are imported when a file of theirs is read. The code hash of a result whose code imports this module holds the
readers that the campaign's files name.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from apertura.formats.names import PHASE_HISTORIES, RECORDERS, TRACKS, log_format
from apertura.formats.tracks.log_options import AS_IT_SAYS, LogOptions

if TYPE_CHECKING:
    import xarray as xr

    from apertura.formats.recordings.recording import Recording


def open_recording(files: Sequence[Path]) -> "Recording":
    """Open a recording; metadata and sizes are checked, samples are not read.

    Parameters
    ----------
    files
        In the order of a row of `RECORDERS`.
    """
    names = [file.name for file in files]
    row = next(row for row in RECORDERS if len(row) == len(names) and names[0].endswith(row[0]))
    opened: Recording = RECORDERS[row](*files)
    return opened


def read_track(path: Path, *, node: str, options: LogOptions = AS_IT_SAYS) -> "xr.Dataset":
    """Return the `track` stage of a flight log.

    Raises
    ------
    CampaignError
        If no reader knows the file, or the log is not what its format promises.
    """
    track: xr.Dataset = TRACKS[log_format(path, options)].reader(path, node=node, options=options)
    return track


def read_phase_history(
    kind: str, paths: Sequence[Path], *, pair: str, described: Mapping[str, Any] = MappingProxyType({})
) -> "xr.Dataset":
    """Return the `echo` stage of phase-history files.

    Parameters
    ----------
    kind
        A key of `PHASE_HISTORIES`.
    paths
        The files, joined in this order.
    pair
        Transmitter-receiver.
    described
        The waveform of the config, for formats that do not state it.
    """
    row = PHASE_HISTORIES[kind]
    further = {"described": described} if row.described else {}
    echo: xr.Dataset = row.reader(paths, pair=pair, **further)
    return echo
