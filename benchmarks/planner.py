"""The planner against exhaustive search: 30 random campaigns, every setting timed and measured.

A setting counts where its measured error meets the accuracy asked. Each campaign's plan, thinning included, and the
five fastest settings that count are timed again in turn; the ratio is of medians.
"""

import argparse
import statistics
import time
from dataclasses import dataclass, field

import numpy as np
from campaigns import Drawn, draw

from apertura.image.candidates import Setting, candidates
from apertura.image.cost import read_costs
from apertura.image.engines import ENGINES, numba, reference
from apertura.image.planner import make_plan
from apertura.image.quality import numerical_error
from apertura.image.view import look


@dataclass
class Runner:
    """One setting on one campaign."""

    drawn: Drawn
    setting: Setting
    plan: object = None
    seconds: list[float] = field(default_factory=list)

    def go(self) -> np.ndarray:
        pixels = self.pixels
        begin = time.perf_counter()
        engine, profiles = ENGINES[self.setting.engine], self.drawn.profiles
        history = self.drawn.spectra if engine.reads == "echo" else profiles
        if self.plan is not None and engine.reads == "profile":
            history = self.plan.history(profiles)
        image = engine.form(engine.prepare(history, **self.setting.options), pixels, **self.setting.form_options)
        self.seconds.append(time.perf_counter() - begin)
        return image

    @property
    def pixels(self) -> np.ndarray:
        return self.drawn.grid.positions()


def compare(drawn: Drawn) -> tuple[str, float, float, str]:
    """Return (plan's setting, its error, ratio to the best, the best setting)."""
    plan = make_plan(drawn.job, accuracy_db=drawn.accuracy_db, costs=read_costs())
    picked = np.random.default_rng(1).integers(0, drawn.grid.shape, (200, 2)).T
    exact = reference.form(drawn.spectra, drawn.grid.positions()[*picked])

    def error_db(runner: Runner) -> float:
        return numerical_error(runner.go()[*picked].astype(np.complex64), exact).rms_db

    mine = Runner(drawn, plan.setting, plan)
    reached = error_db(mine)
    view = look(drawn.job.tx_position_m[::8], drawn.job.rx_position_m[::8], drawn.job.net_m, drawn.job.spacing_m)
    every = candidates(view, drawn.job.signal, drawn.job.load, read_costs())
    every = [s for s in every if s.engine == "native"] or [s for s in every if s.engine == "numba"]
    others = [Runner(drawn, setting) for setting in every]
    met = [runner for runner in others if error_db(runner) <= drawn.accuracy_db]
    best = sorted(met, key=lambda runner: runner.seconds[0])[:5]
    for runner in (mine, *best):
        runner.seconds.clear()
    for _ in range(7):
        for runner in (mine, *best):
            runner.go()
    times = {id(runner): statistics.median(runner.seconds) for runner in (mine, *best)}
    fastest = min(best, key=lambda runner: times[id(runner)])
    thin = f", {plan.presum.factor}:1" if plan.presum else ""
    return plan.setting.line + thin, reached, times[id(mine)] / times[id(fastest)], fastest.setting.line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=30)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pulses", type=int, default=400)
    asked = parser.parse_args()
    warm = draw(np.random.default_rng(999), pixels=16, pulses=8)
    numba.form(numba.prepare(warm.profiles), warm.grid.positions())
    ratios, missed = [], 0
    for seed in range(asked.campaigns):
        drawn = draw(np.random.default_rng(seed), pixels=asked.size, pulses=asked.pulses)
        chosen, error_db, ratio, best = compare(drawn)
        ratios.append(ratio)
        missed += error_db > drawn.accuracy_db
        print(f"{seed:>3} {drawn.name:<58}{error_db:>7.1f} dB{ratio:>6.2f} x  {chosen}  (best: {best})", flush=True)
    print(f"{missed} of {len(ratios)} need a better setting than the first; against exhaustive search: median "
          f"{statistics.median(ratios):.2f}, worst {max(ratios):.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
