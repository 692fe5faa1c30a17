"""Bench test of a stationary radar: measurement of channels, clocks and links (`measurement`), and its `report`."""
