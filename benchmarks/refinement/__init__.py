"""Evaluation of the track refinement case by case; run as `python -m benchmarks.refinement`."""
