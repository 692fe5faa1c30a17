"""Bench measurements of a stationary radar from its recordings: channels, clocks and links."""
