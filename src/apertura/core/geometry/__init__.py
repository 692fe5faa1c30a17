"""Coordinates, tracks, lever arms, atmosphere, and the synthetic aperture of a pair."""
