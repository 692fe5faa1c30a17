"""Coordinates, tracks, phase centres and the synthetic aperture of a pair."""
