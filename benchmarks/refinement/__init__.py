"""Refinement of tracks judged case by case; run as `python -m benchmarks.refinement`."""
