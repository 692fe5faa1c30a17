"""Estimation of the recorder's clock offset from the flight log, by echoes of a known point or by image sharpness."""
