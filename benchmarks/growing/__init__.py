"""What `benchmarks/growth.py` compares: scenes of every size, contestants, and a chart of what was measured."""
