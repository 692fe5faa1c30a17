"""Growth of run times with the image size: all engines and fastsar on scenes of 512² to 8192², run alternately.

    python benchmarks/growth.py --quick          # 12 minutes, most cases, one round of slow contestants
    python benchmarks/growth.py                  # all cases
    python benchmarks/growth.py --cases low      # cases whose name contains a word: "4096² × 8192, low, flat"
    python benchmarks/growth.py --draw           # redraw chart and table from the saved rows

Times are CPU seconds of one thread: medians over rounds that run all contestants alternately, with minimum and maximum.
If the cost of an engine grows with its pixels, a part of the tiles represents the image (`share`). Prints a table,
updates its rows in benchmarks/latest.json and draws docs/assets/growth.png. fastsar is compared if it is installed
(`pip install fastsar`); skipped contestants are listed with the reason.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import importlib.util
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

from growing.chart import draw
from growing.contestants import Contestant, EngineInput, SkippedError
from growing.rivals import Fastsar
from growing.scene import Geometry, Scene, Surface, build
from growing.table import exponents, markdown
from latest import Row, read_rows, replace_rows

from apertura.core.backprojection.engines import instruction_set

CHART = Path(__file__).parents[1] / "docs" / "assets" / "growth.png"
AIMS_DB = (-40.0, -60.0, -80.0)
SLOW = 0.05
"""Fraction of the image below which a contestant runs one round in quick mode."""

_KEY = ("group", "name", "aim_db", "geometry", "surface", "size", "pulses")


class Case(NamedTuple):
    """Parameters of a scene; `quick` is True if a quick run includes it."""

    size: int
    pulses: int
    geometry: Geometry
    surface: Surface = "flat"
    quick: bool = False

    @property
    def name(self) -> str:
        return f"{self.size}² × {self.pulses}, {self.geometry}, {self.surface}"


class Effort(NamedTuple):
    """Maximum number of rounds, approximate time limit of one run, and quick mode (native at one accuracy only)."""

    rounds: int
    limit_s: float
    quick: bool


CASES = (
    *(Case(size, 2 * size, "monostatic", quick=size < 8192) for size in (512, 1024, 2048, 4096, 8192)),
    *(Case(size, 2 * size, "bistatic", quick=True) for size in (512, 1024, 2048, 4096, 8192)),
    *(Case(2048, pulses, "bistatic", quick=pulses == 1024) for pulses in (1024, 16384, 65536)),
    Case(4096, 16384, "bistatic", quick=True),
    Case(8192, 65536, "bistatic"),
    *(
        Case(size, 2 * size, "bistatic", surface, size == 1024)
        for size in (1024, 2048)
        for surface in ("smooth", "rough")
    ),
    *(
        Case(size, pulses, "spotlight", quick=size == 4096)
        for size, pulses in ((1024, 1208), (2048, 2414), (4096, 4828))
    ),
    Case(4096, 8192, "low", quick=True),
)


def main() -> None:
    """Measure the cases, print, save and draw the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer cases, rounds and tiles; native at -60 dB only")
    parser.add_argument("--cases", nargs="*", default=[], help="select cases whose name contains one of these words")
    parser.add_argument("--only", nargs="*", default=[], help="names of contestants")
    parser.add_argument("--rounds", type=int, help="maximum number of rounds (default: 5; 3 with --quick)")
    parser.add_argument(
        "--limit", type=float, help="approximate seconds of one run of a contestant (default: 40; 6 with --quick)"
    )
    parser.add_argument("--draw", action="store_true", help="redraw the saved rows without measuring")
    parser.add_argument("--unsaved", action="store_true", help="print the results without saving them")
    options = parser.parse_args()
    rounds = options.rounds or (3 if options.quick else 5)
    limit_s = options.limit or (6.0 if options.quick else 40.0)
    cases = [case for case in CASES if case.quick or not options.quick]
    cases = [case for case in cases if not options.cases or any(word in case.name for word in options.cases)]
    rows: list[Row] = []
    for geometry in () if options.draw else sorted({case.geometry for case in cases}):
        # A small scene compiles the kernels before the measurement.
        measured(Case(256, 64, geometry), Effort(1, limit_s, quick=False), options.only)
    for case in () if options.draw else cases:
        rows += measured(case, Effort(rounds, limit_s, options.quick), options.only)
    if not options.unsaved:
        new = {tuple(row[key] for key in _KEY) for row in rows}
        kept = replace_rows(rows, lambda row: tuple(row.get(key) for key in _KEY) in new) if rows else read_rows()
        rows = [row for row in kept if row.get("group") == "growth"]
        CHART.parent.mkdir(exist_ok=True)
        draw(rows, CHART)
    print("\n" + markdown(rows) + "\n\n" + exponents(rows))


def measured(case: Case, effort: Effort, only: list[str]) -> list[Row]:
    """Measure one scene; contestants run alternately until each reaches its number of rounds or its time limit."""
    begin = time.perf_counter()
    scene = build(case.size, case.pulses, case.geometry, case.surface)
    engine_input = EngineInput(scene)
    print(f"{scene.name}: {len(scene.history.frequency_hz)} subcarriers", flush=True)
    contestants = [one for one in _contestants(engine_input, effort) if not only or one.name in only]
    loads = [os.getloadavg()[0]]
    for number in range(effort.rounds):
        engine_input.compress()
        for one in contestants:
            once = effort.quick and one.share < SLOW  # contestants that work pixel by pixel
            if number == 0 or (not once and one.spent * (number + 1) / number < 3 * effort.limit_s):
                one.go()
        loads.append(os.getloadavg()[0])
    print(f"  {time.perf_counter() - begin:.0f} s, load {min(loads):.1f} to {max(loads):.1f}", flush=True)
    compression_s = median(engine_input.compressions)
    measures = {"machine": machine(), "load": round(max(loads), 1), "compression_s": float(f"{compression_s:.3g}")}
    return [one.row(compression_s) | measures for one in contestants]


def machine() -> str:
    """Return the processor's model name and the instruction set of engine native."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    return f"{model}, {instruction_set('native')}"


def _contestants(engine_input: EngineInput, effort: Effort) -> Iterator[Contestant]:
    """Yield the available contestants; print the reasons for skipped contestants."""
    limit_s = effort.limit_s
    entries: list[tuple[str, Callable[[], Contestant]]] = [
        (f"{engine} {aim_db:.0f} dB", partial(engine_input.planned, engine, aim_db, limit_s))
        for engine in ("native", "tree")
        for aim_db in (AIMS_DB if engine == "tree" or not effort.quick else (-60.0,))
    ]
    entries.append(("numba", partial(engine_input.planned, "numba", -60.0, limit_s / 2, fields=True)))
    if importlib.util.find_spec("fastsar"):
        rival = Fastsar(engine_input.scene)
        entries += [
            (name, partial(rival.factorized, name, **options)) for name, options in _factorized(engine_input.scene)
        ]
        entries += [
            ("fastsar exact", partial(rival.exact, limit_s)),
            ("fastsar points", partial(rival.points, limit_s / 2)),
        ]
    else:
        print("  fastsar is not installed")
    skipped: dict[str, list[str]] = {}
    for name, enter in entries:
        try:
            yield enter()
        except SkippedError as error:
            skipped.setdefault(str(error), []).append(name)
    for reason, names in skipped.items():
        print(f"  {', '.join(names)} skipped: {reason}")


def _factorized(scene: Scene) -> Iterator[tuple[str, dict[str, int]]]:
    """Yield the factorized `ImageFormer` of fastsar with default settings, and with the most accurate settings.

    The error decreases with the size of the last patches, which have at least 16 pixels. Finer pixels reduce the
    patches, and large images use one more level than the default of three.
    """
    deep = {"levels": 4} if scene.size >= 2048 else {}
    yield "fastsar FFBP", {}
    if scene.size > 4096:
        yield "fastsar FFBP deeper", deep
    if scene.geometry == "spotlight":
        yield "fastsar FFBP of 16", {"T": 16}
    else:
        yield "fastsar FFBP finer", {"finer": 2, "T": 16, **deep}


if __name__ == "__main__":
    main()
