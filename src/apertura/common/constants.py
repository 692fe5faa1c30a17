"""Physical constants, and codes of registers; the only place they are written."""

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Speed of light in vacuum, m/s (exact by definition of the metre)."""

LARGEST_REFRACTIVITY = 500.0
"""N units, (n - 1)·10⁶, of air anywhere on Earth, hot, wet and low: the largest mean of ITU-R P.453's maps is 400."""

VERTICAL_DATUMS = {"EPSG:5773": "egm96", "EPSG:3855": "egm2008"}
"""Vertical CRS → the datum that its heights count from, as the config calls it."""
BOLTZMANN_J_K = 1.380649e-23
REFERENCE_K = 290.0
"""Boltzmann's constant, exact in SI; temperature that noise figures refer to (IEEE Std 686)."""
