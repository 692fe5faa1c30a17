"""Physical constants; the only place they are written."""

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Speed of light in vacuum, m/s (exact by definition of the metre)."""
