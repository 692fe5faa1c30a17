"""Scenes, flights and metrics that evaluate the track refinement; charts of loss against sigma, and images."""
