"""Recorders' and flight logs: bytes in, `raw` and `track` out; one file per format."""
