"""Clocks of recorders and logs: aligned by what a scene shows, and their drift."""
