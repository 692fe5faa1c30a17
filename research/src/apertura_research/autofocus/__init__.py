"""Scenes, flights and measures by which a refinement of tracks is judged; loss against sigma, pictures."""
