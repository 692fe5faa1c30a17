"""How an image will be formed, why, and at what cost."""
