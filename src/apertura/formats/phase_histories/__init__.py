"""Phase histories and beat signals of other radars; rows in `apertura.formats.names.PHASE_HISTORIES`."""
