"""Charts of speed against accuracy for the user's own campaign."""
