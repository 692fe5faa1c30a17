"""The scene: its grid, its ground, and what can be seen of it."""
