"""Clocks of recorders and logs: offset and drift, estimated by a known point or by the sharpness of the scene."""
