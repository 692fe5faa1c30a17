"""Scenes, flights and measures by which a refinement of tracks is judged; run as `python -m benchmarks.refinement`."""

from benchmarks.refinement.cases import PROBES_M, Case, case
from benchmarks.refinement.measures import Judgement, judge

__all__ = ["PROBES_M", "Case", "Judgement", "case", "judge"]
