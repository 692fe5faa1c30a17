"""Mistakes that people make with a campaign folder, each a small function that makes one in a copy."""
