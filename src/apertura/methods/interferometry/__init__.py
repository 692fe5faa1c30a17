"""Phase and coherence of two images of one scene, and heights from them."""
