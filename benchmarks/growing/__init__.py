"""Scenes, contestants, tables and charts of `benchmarks/growth.py`."""
