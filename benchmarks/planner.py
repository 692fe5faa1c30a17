"""Comparison of the planner with an exhaustive search over all settings on 30 random campaigns.

A setting is valid if its measured error meets the requested accuracy. Each campaign's plan, including presumming, and
the five fastest valid settings are then timed alternately; the ratio is that of the median CPU seconds. If the plan's
setting misses the accuracy, the times of the next more accurate settings are added until a setting meets the accuracy.
"""

import argparse
import statistics
import time
from dataclasses import dataclass, field

import numpy as np
from campaigns import Drawn, draw

from apertura.core.backprojection.engines import load_engine, numba, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import SettingSearch, make_plan
from apertura.core.quality.measures import numerical_error_db


@dataclass
class Runner:
    """One setting on one campaign."""

    drawn: Drawn
    setting: Setting
    plan: Plan | None = None
    seconds: list[float] = field(default_factory=list)

    def go(self) -> np.ndarray:
        pixels = self.pixels
        begin = time.process_time()
        engine, profiles = load_engine(self.setting.engine), self.drawn.profiles
        inputs = self.drawn.history if engine.READS == "phase_history" else profiles
        if self.plan is not None and engine.READS == "profiles":
            inputs = self.plan.inputs(profiles)
        image = engine.form(engine.prepare(inputs, **self.setting.options), pixels, **self.setting.form_options)
        self.seconds.append(time.process_time() - begin)
        return image

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def pixels(self) -> np.ndarray:
        return self.drawn.grid.positions(0.0)


def compare(drawn: Drawn) -> tuple[str, list[float], float, str]:
    """Return the plan's setting, its errors before and after recomputation, its time ratio, and the best setting."""
    plan = make_plan(drawn.job, accuracy_db=drawn.accuracy_db)
    picked = np.random.default_rng(1).integers(0, drawn.grid.shape, (200, 2)).T
    exact = reference.form(drawn.history, drawn.grid.positions(0.0)[*picked])

    def error_db(runner: Runner) -> float:
        return numerical_error_db(runner.go()[*picked].astype(np.complex64), exact)

    mine = [Runner(drawn, plan.setting, plan)]
    reached = [error_db(mine[0])]
    for better in plan.fallbacks:
        if reached[-1] > drawn.accuracy_db:
            mine.append(Runner(drawn, better))
            reached.append(error_db(mine[-1]))
    every = SettingSearch(drawn.job).settings(len(drawn.job.aperture))
    every = [s for s in every if s.engine == "native"] or [s for s in every if s.engine == "numba"]
    others = [Runner(drawn, setting) for setting in every]
    met = [runner for runner in others if error_db(runner) <= drawn.accuracy_db]
    best = sorted(met, key=lambda runner: runner.seconds[0])[:5]
    for runner in (*mine, *best):
        runner.seconds.clear()
    for _ in range(7):
        for runner in (*mine, *best):
            runner.go()
    fastest = min(best, key=lambda runner: runner.median)
    thin = f", {plan.presum.factor}:1" if plan.presum else ""
    return plan.setting.line + thin, reached, sum(one.median for one in mine) / fastest.median, fastest.setting.line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="seed of the first campaign")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pulses", type=int, default=400)
    options = parser.parse_args()
    warm = draw(np.random.default_rng(999), pixels=16, pulses=8)
    numba.form(numba.prepare(warm.profiles), warm.grid.positions(0.0))
    ratios, recomputed, missed = [], 0, 0
    for seed in range(options.first, options.first + options.campaigns):
        drawn = draw(np.random.default_rng(seed), pixels=options.size, pulses=options.pulses)
        chosen, errors_db, ratio, best = compare(drawn)
        ratios.append(ratio)
        recomputed += len(errors_db) > 1
        missed += errors_db[-1] > drawn.accuracy_db
        line = ", ".join(f"{error:.1f}" for error in errors_db)
        print(f"{seed:>3} {drawn.name:<58}{line:>13} dB{ratio:>6.2f} x  {chosen}  (best: {best})", flush=True)
    above = sum(ratio > 1.5 for ratio in ratios)
    print(
        f"{missed} of {len(ratios)} miss the accuracy, {recomputed} require a better setting than the first; time "
        f"relative to the best setting: median {statistics.median(ratios):.2f}, worst {max(ratios):.2f}, "
        f"{above} above 1.5"
    )


if __name__ == "__main__":
    main()
