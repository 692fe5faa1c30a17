"""Beams: where antennas look, and how they weigh pulses."""
