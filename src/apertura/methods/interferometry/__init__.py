"""Phase and coherence of two images of one scene, and the heights they tell."""
