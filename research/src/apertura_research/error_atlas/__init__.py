"""Errors of an image, from negligible to destructive: their cost, the expected cost, and the flags raised."""
