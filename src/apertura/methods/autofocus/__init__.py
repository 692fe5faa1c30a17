"""Autofocus: refinement of tracks from the images, validated on held-out patches."""
