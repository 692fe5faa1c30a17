"""Typical mistakes in campaign folders, each a small function that modifies a copy."""
