"""Channels, clocks and links of a radar that stands still, measured on its recordings."""
