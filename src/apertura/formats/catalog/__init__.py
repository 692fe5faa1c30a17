"""What a campaign has made, described for other programs: STAC for those who search, RO-Crate for those who check."""

CATALOG = "catalog.json"
"""Where the STAC catalog begins, in its folder."""

CRATE = "ro-crate-metadata.json"
"""The RO-Crate, in the folder of the results."""
