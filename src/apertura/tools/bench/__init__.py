"""Bench test of a stationary radar: `measurement` of channels, clocks and links, and the `report` on them."""
