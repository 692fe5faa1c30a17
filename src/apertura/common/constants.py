"""Physical constants and EPSG codes, defined only in this module."""

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Speed of light in vacuum, m/s (exact by definition of the metre)."""

LARGEST_REFRACTIVITY = 500.0
"""Upper limit of refractivity on Earth, (n - 1)·10⁶ in N units; the largest mean in the maps of ITU-R P.453 is 400."""

VERTICAL_DATUMS = {"EPSG:5773": "egm96", "EPSG:3855": "egm2008"}
"""Vertical CRS → name of the vertical datum in the config."""
BOLTZMANN_J_K = 1.380649e-23
REFERENCE_K = 290.0
"""Boltzmann constant, J/K (exact in SI); reference temperature of noise figures, K (IEEE Std 686)."""
