"""Opening a campaign: its grid, ground, pairs and antennas, once."""
