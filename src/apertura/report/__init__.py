"""Pictures and words of a report on a campaign, from arrays and numbers."""
