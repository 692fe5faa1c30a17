"""Map of a campaign in a browser: a page with the images, served on this machine only."""
