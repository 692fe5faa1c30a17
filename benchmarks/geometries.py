"""Error of engine tree in random geometries: `python benchmarks/geometries.py` writes benchmarks/geometries.csv.

Range 30 m to 10 km, aperture up to the range, spacing from an eighth of a wavelength to 1 m, carrier 0.4 to 10 GHz;
straight, wobbling and circular tracks with and without jitter, one or two nodes, flat, tilted and rolling terrain. Each
geometry is planned for -60 dB with a free choice of the engine, then formed by the tree with the planner's settings for
that accuracy and nodes of -74 dB, in smaller tiles if the tiles of the planner are summed directly. Echoes are noise
and scatterers of a flat band; the reference is their sum in float64 over pulses and frequencies at random pixels.
"""

import argparse
import csv
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from drawn import Geometry, draw
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import tree
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Job, Signal
from apertura.core.planning.planner import make_plan
from apertura.core.quality.error_check import error_bound

AIM_DB = -60.0
LINES, GUARD, SCATTERERS, CHECKED = 128, 32, 200, 400


@dataclass(frozen=True)
class Outcome:
    """Results of one geometry."""

    planned: str
    nodes_db: int
    side_px: int
    chunk: int
    by_tree: float  # fractions of pixels × pulses
    directly: float
    predicted_db: float
    measured_db: float
    bound_db: float

    @property
    def failure(self) -> str:
        """Short description of a failure; empty without one."""
        uncertified = ["certified error exceeds the requested error"] if self.bound_db > AIM_DB else []
        unpredicted = ["error exceeds the prediction"] if self.measured_db > self.predicted_db + 3 else []
        return ", ".join(uncertified + unpredicted)


def frequencies(geometry: Geometry) -> NDArray[np.float64]:
    """Return the frequencies of the lines; the centre frequency is midway between the middle two."""
    return geometry.carrier_hz + geometry.bandwidth_hz / LINES * (np.arange(LINES) - (LINES - 1) / 2)


def echo(geometry: Geometry, generator: np.random.Generator) -> NDArray[np.complex128]:
    """Simulate echoes, (pulse, line): noise, and scatterers among the pixels with a tenth of its power."""
    shape = geometry.pulses, LINES
    lines = np.sqrt(0.5) * (generator.standard_normal(shape) + 1j * generator.standard_normal(shape))
    flat = geometry.pixels.reshape(-1, 3)
    paths = geometry.aperture.path(flat[generator.integers(0, len(flat), SCATTERERS)])
    first, *_, last = -2j * np.pi * frequencies(geometry) / C
    for path in paths.T:
        phasor, step = np.exp(first * path), np.exp((last - first) / (LINES - 1) * path)
        lines += np.sqrt(0.1 / SCATTERERS) * phasor[:, None] * step[:, None] ** np.arange(LINES)
    return np.asarray(lines)


def profiles_of(geometry: Geometry, lines: NDArray[np.complex128]) -> Profiles:
    """Return exact samples of the band-limited echo over all pixels and a guard, periodic in the range of the lines."""
    step_m = geometry.step_m
    coarse = geometry.pixels[:: max(1, geometry.rows // 32), :: max(1, geometry.columns // 32)]
    edges = (geometry.pixels[edge].reshape(-1, 3) for edge in (0, -1, np.s_[:, 0], np.s_[:, -1]))
    paths = geometry.aperture.path(np.concatenate([coarse.reshape(-1, 3), *edges]))
    start = paths.min(1) - GUARD * step_m
    length = int(np.ceil((paths.max(1) - start).max() / step_m)) + GUARD
    delayed = lines * np.exp(2j * np.pi * start[:, None] / C * (frequencies(geometry) - geometry.carrier_hz))
    period, at = np.fft.ifft(delayed, 2 * LINES, axis=1) * 2 * LINES, np.arange(length)
    samples = period[:, at % (2 * LINES)] * np.exp(-1j * np.pi * (LINES - 1) / (2 * LINES) * at)
    return Profiles(samples.astype(np.complex64), start, step_m, geometry.carrier_hz, 2.0, geometry.aperture)


def exact(geometry: Geometry, lines: NDArray[np.complex128], places: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Compute the double sum at points (point, 3) in float64."""
    frequency, image = frequencies(geometry), np.zeros(len(places), np.complex128)
    for first in range(0, geometry.pulses, 50):
        pulses = slice(first, first + 50)
        delay = 2 * np.pi / C * geometry.aperture[pulses].path(places)
        step, value = np.exp(1j * delay * (frequency[1] - frequency[0])), np.zeros(delay.shape, complex)
        for line in lines[pulses].T[::-1]:
            value *= step
            value += line[:, None]
        image += (value * np.exp(1j * delay * frequency[0])).sum(0)
    return image


def job_of(geometry: Geometry, profiles: Profiles) -> Job:
    """Return the planner's input."""
    shape = geometry.rows, geometry.columns
    at = np.ix_(*(np.linspace(0, size - 1, 5).astype(int) for size in shape))
    windows = [
        tuple(slice(at, at + min(256, size)) for at, size in zip(corner, shape, strict=True))
        for corner in ((0, 0), (shape[0] - min(256, shape[0]), shape[1] - min(256, shape[1])))
    ]
    signal = Signal(geometry.carrier_hz, 2.0, profiles.step_m, profiles.samples.shape[1])
    return Job(
        geometry.aperture, geometry.pixels[at], shape, geometry.spacing_m, geometry.carrier_hz, geometry.bandwidth_hz,
        LINES, signal, frame="local", tile_px=512, recorded=False,
        patches_on=lambda _: tuple(geometry.pixels[window] for window in windows),
    )  # fmt: skip


def _setting(job: Job, options: Mapping[str, int]) -> Setting:
    """Return the planner's setting of the tree with some options fixed."""
    overrides = {"engine": "tree", "presum": 1, "engine_options": {"tree": options}}
    return make_plan(job, accuracy_db=AIM_DB, overrides=overrides).setting


def _formed(
    geometry: Geometry, profiles: Profiles, setting: Setting
) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Return the flattened image, and the fractions of pixels × pulses by tree, direct sum, or no echo."""
    counts, trees = np.zeros(3, np.int64), tree.prepare(profiles, **setting.options)
    image = tree.form(trees, geometry.pixels, counts=counts, **setting.form_options)
    return image.ravel(), counts / counts.sum()


def measure(geometry: Geometry, **options: int) -> Outcome:
    """Plan and form one geometry, with any given options of the tree, and compare the image with the exact sum."""
    generator = np.random.default_rng([16, geometry.seed])
    lines = echo(geometry, generator)
    profiles = profiles_of(geometry, lines)
    job = job_of(geometry, profiles)
    planned = make_plan(job, accuracy_db=AIM_DB).engine
    setting = _setting(job, options)
    image, shares = _formed(geometry, profiles, setting)
    if not shares[0]:  # smaller tiles allow the sum by tree
        setting = _setting(job, {"side_px": 64, "chunk": 256} | options)
        image, shares = _formed(geometry, profiles, setting)
    checked = generator.choice(image.size, CHECKED, replace=False)
    truth = exact(geometry, lines, geometry.pixels.reshape(-1, 3)[checked])
    power = float((np.abs(image.astype(np.complex128)) ** 2).sum())
    bound = error_bound(image[checked], truth, np.full(CHECKED, CHECKED / image.size), power=power)
    squared_error = np.abs(image[checked] - truth) ** 2
    return Outcome(
        planned, *(setting.form_options[name] for name in ("nodes_db", "side_px", "chunk")), *shares[:2].tolist(),
        setting.error_db, float(10 * np.log10(squared_error.sum() / (np.abs(truth) ** 2).sum())), bound.bound_db,
    )  # fmt: skip


def row_of(geometry: Geometry, outcome: Outcome) -> dict[str, str]:
    """Return the table row of one geometry."""
    names = [f.name for f in fields(geometry) if f.repr] + [f.name for f in fields(outcome)]
    values = [getattr(geometry, f.name) for f in fields(geometry) if f.repr] + list(astuple(outcome))
    row = {n: f"{v:.4g}" if isinstance(v, float) else str(v) for n, v in zip(names, values, strict=True)}
    return row | {"failure": outcome.failure}


def main() -> None:
    """Measure all geometries, save the table and list the failures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 60), metavar=("FIRST", "END"))
    parser.add_argument(
        "--nodes_db", type=int, default=-74, help="option of the tree; the planner uses at most -74 for -60 dB"
    )
    for name in ("side_px", "chunk"):
        parser.add_argument(f"--{name}", type=int, help="option of the tree (default: chosen by the planner)")
    parser.add_argument("--table", type=Path, default=Path(__file__).with_suffix(".csv"))
    arguments = parser.parse_args()
    options = {name: value for name in ("nodes_db", "side_px", "chunk") if (value := getattr(arguments, name))}
    rows = []
    for seed in range(*arguments.seeds):
        geometry = draw(seed)
        rows.append(row_of(geometry, measure(geometry, **options)))
        print(*rows[-1].values(), sep="\t", flush=True)
    with arguments.table.open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    failed = [row for row in rows if row["failure"]]
    print(f"{len(rows)} geometries, {len(failed)} failed", *(f"{r['seed']}: {r['failure']}" for r in failed), sep="\n")


if __name__ == "__main__":
    main()
