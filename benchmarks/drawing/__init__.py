"""Random error-free campaigns."""
