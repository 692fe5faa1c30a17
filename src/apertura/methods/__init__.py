"""Methods beyond image formation: autofocus, clock alignment, bench measurements, interferometry.

The estimators take arrays, apertures and imaged patches, and return corrections with their uncertainty. The package
imports `apertura.common` and `apertura.core`; it never opens a campaign.
"""
