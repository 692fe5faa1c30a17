"""Tracks refined by the image itself: what spoils focus, how it is estimated, and whether it may be believed."""
