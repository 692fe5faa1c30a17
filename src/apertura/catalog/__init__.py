"""What a campaign has made, described for other programs: STAC for those who search, RO-Crate for those who check."""
