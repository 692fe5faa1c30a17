"""Metadata of the results for other programs: a STAC catalog for searching, and an RO-Crate for provenance."""

CATALOG = "catalog.json"
"""Root file of the STAC catalog, in its folder."""

CRATE = "ro-crate-metadata.json"
"""RO-Crate metadata file, in the folder of the results."""
