"""The scene: grid, terrain, coordinate reference systems, and visibility."""
