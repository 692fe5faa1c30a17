"""A campaign in a browser: one page with its images, served on this machine alone."""
