"""Readers of flight logs, one per format, all built on `track.make_track`; table in `apertura.formats.names.TRACKS`."""
