"""Readers of recordings with raw samples; table in `apertura.formats.names.RECORDERS`."""
