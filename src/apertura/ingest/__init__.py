"""Recorders and flight logs: bytes in, `raw`, `track` or `echo` out; one file and one row per format."""

from apertura.ingest.afrl import read_afrl_mat
from apertura.ingest.csv_track import read_csv_track
from apertura.ingest.rtklib import read_rtklib_pos
from apertura.ingest.sigmf import cut, open_sigmf, read_sigmf

TRACKS = {".csv": read_csv_track, ".pos": read_rtklib_pos}
"""Suffix of <node>.track.* → reader(path, node=) → `track`."""

PHASE_HISTORIES = {"afrl_mat": read_afrl_mat}
"""waveform.format → reader(paths, pair=) → `echo`."""

__all__ = ["PHASE_HISTORIES", "TRACKS", "cut", "open_sigmf", "read_sigmf"]
