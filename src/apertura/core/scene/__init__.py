"""The scene: its grid, its ground, and visibility."""
