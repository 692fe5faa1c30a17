"""Images out of the house: one file per format."""
