"""Recorder clock relative to the flight log, estimated from echoes of a known point or from the image sharpness."""
