"""Charts of speed, accuracy and stability, and the claims of the source paper."""
