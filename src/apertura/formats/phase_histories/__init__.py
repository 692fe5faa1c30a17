"""Readers of phase histories and beat signals of other radars; table in `apertura.formats.names.PHASE_HISTORIES`."""
