"""Metadata of the results: STAC catalog for searching, RO-Crate for provenance, CEOS-ARD sheet of each image."""

CATALOG = "catalog.json"
"""Root file of the STAC catalog, in its folder."""

CRATE = "ro-crate-metadata.json"
"""RO-Crate metadata file, in the folder of the results."""

DOCUMENTS = ("image.json", "ceos_ard.json", "ceos_ard.html")
"""Documents in the folder of an image: report, and CEOS-ARD sheet with its page."""
