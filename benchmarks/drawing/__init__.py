"""Right campaigns of every kind, drawn at random."""
