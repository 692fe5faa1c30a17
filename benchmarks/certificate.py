"""Comparison of certified error bounds with the true errors of 200 images, recomputed by the double sum at all pixels.

Counts how often the error over all pixels stays below the bound, and the margin of the bound: for the certificate of
finished images, and for the bound from Python, which uses only the sampled pixels. The difference between the predicted
and the true error characterises the planner.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from campaigns import Drawn, draw
from numpy.typing import NDArray

from apertura.core.backprojection.engines import load_engine, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.imaging.certify import certified
from apertura.core.imaging.formation import Formation
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import SettingSearch, make_plan
from apertura.core.quality.error_check import error_bound

TILE_PX = 32


@dataclass(frozen=True)
class ImageErrors:
    """Errors of one image, dB: true error over all pixels, prediction, bounds and estimate of its certificates."""

    name: str
    error_db: float
    predicted_db: float
    bound_db: float
    estimate_db: float
    drawn_alone_db: float


def evaluated(seeds: range, *, pixels: int, pulses: int, engine: str | None = None) -> Iterator[ImageErrors]:
    """Evaluate two images of every campaign: the planned image, and an image with a random setting of given engines."""
    for seed in seeds:
        generator = np.random.default_rng(seed)
        drawn = draw(generator, pixels=pixels, pulses=pulses)
        plan = make_plan(drawn.job, accuracy_db=drawn.accuracy_db)
        exact = np.asarray(reference.form(drawn.history, drawn.grid.positions(0.0)) / pulses)
        others = [one for one in SettingSearch(drawn.job, engine).settings(pulses) if one.engine != "reference"]
        other = others[generator.integers(len(others))]
        for one in (plan, replace(plan, setting=other, presum=None)):
            yield _image_errors(drawn, one, exact, seed)


def _image_errors(drawn: Drawn, plan: Plan, exact: NDArray[np.complex128], seed: int) -> ImageErrors:
    formation = Formation(drawn.history, drawn.profiles, drawn.grid, plan, TILE_PX)
    image = _image(drawn, plan.setting, plan)
    certificate = certified(formation, image, accuracy_db=np.inf, threads=1)
    sampled = np.random.default_rng(seed).integers(0, image.shape, (64, 2))
    values, power = formation.values(sampled)
    bound = error_bound(values, exact[tuple(sampled.T)], np.ones(64), power=power)
    return ImageErrors(
        f"{drawn.name}, {plan.setting.line}",
        true_error_db(image, exact),
        plan.setting.error_db,
        certificate["numerical_error_db"],
        certificate["numerical_error_estimate_db"],
        max(bound.bound_db, plan.setting.error_db),
    )


def _image(drawn: Drawn, setting: Setting, plan: Plan) -> NDArray[np.complex64]:
    engine = load_engine(setting.engine)
    inputs = drawn.history if engine.READS == "phase_history" else plan.inputs(drawn.profiles)
    places = drawn.grid.positions(0.0)
    image = engine.form(engine.prepare(inputs, **setting.options), places, **setting.form_options)
    return (image / len(drawn.history)).astype(np.complex64)


def true_error_db(image: NDArray[np.complex64], exact: NDArray[np.complex128]) -> float:
    """Return the RMS difference over all pixels after one gain, relative to the RMS of the exact image."""
    values = image.astype(np.complex128)
    gain = np.vdot(values, exact) / np.vdot(values, values)
    return float(20 * np.log10(np.linalg.norm(gain * values - exact) / np.linalg.norm(exact)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=100, help="two images each")
    parser.add_argument("--first", type=int, default=0, help="seed of the first campaign")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--pulses", type=int, default=80)
    parser.add_argument("--engine", help="engine of the second image (default: any)")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.campaigns)
    images = []
    for one in evaluated(seeds, pixels=options.size, pulses=options.pulses, engine=options.engine):
        images.append(one)
        missed = "" if one.bound_db >= one.error_db else " bound below the error"
        print(f"{one.name:<100}{one.error_db:>8.1f} dB, bound {one.bound_db:>7.1f} dB{missed}", flush=True)
    error = np.array([one.error_db for one in images])
    for name in ("predicted_db", "estimate_db"):
        less = np.array([getattr(one, name) for one in images]) - error
        low, high = np.percentile(less, [2.5, 97.5])
        print(f"{name} - error: {low:+.1f} to {high:+.1f} dB in 95 % of {len(images)}, minimum {less.min():+.1f} dB")
    for name in ("bound_db", "drawn_alone_db"):
        above = np.array([getattr(one, name) for one in images]) - error
        print(
            f"{name}: holds in {(above >= -0.005).mean():.1%} of {len(images)}, "
            f"median {np.median(above):.1f} dB above the error, 9 of 10 within {np.percentile(above, 90):.1f} dB"
        )


if __name__ == "__main__":
    main()
