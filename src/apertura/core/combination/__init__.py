"""All flights and pairs on one grid, and what they add up to."""
