"""Flight logs: one reader per format, each ends with `track.make_track`; rows in `apertura.formats.names.TRACKS`."""
