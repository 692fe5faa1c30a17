"""Speed against accuracy, on the user's own campaign."""
