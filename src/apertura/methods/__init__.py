"""Methods that improve or compare images beyond forming them: autofocus, alignment of clocks, bench, interferometry.

Offers estimators that take arrays, apertures and formed patches and give corrections with their uncertainty. Imports
`apertura.common` and `apertura.core`; never opens a campaign.
"""
