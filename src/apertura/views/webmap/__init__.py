"""Map of a campaign in a browser: a page with its images, served on this machine only."""
