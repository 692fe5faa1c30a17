"""Samples as recorders write them; rows in `apertura.formats.names.RECORDERS`."""
