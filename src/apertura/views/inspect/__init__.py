"""`apertura inspect`: what a file or folder is, what it holds, and what is missing to make an image of it."""
