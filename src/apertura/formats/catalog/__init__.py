"""Results of a campaign described for other programs: STAC to search them, RO-Crate to check their provenance."""

CATALOG = "catalog.json"
"""Where the STAC catalog begins, in its folder."""

CRATE = "ro-crate-metadata.json"
"""The RO-Crate, in the folder of the results."""
