"""Antenna beams: patterns and axes, weights of pulses, and illumination of the scene."""
