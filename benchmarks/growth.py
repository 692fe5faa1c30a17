"""How seconds grow with the image: every engine and fastsar on scenes of 512² to 8192², interleaved.

    python benchmarks/growth.py --quick          # 12 minutes, most cases, one round of what is slow
    python benchmarks/growth.py                  # all cases
    python benchmarks/growth.py --cases low      # whose name holds a word: "4096² × 8192, low, flat"
    python benchmarks/growth.py --draw           # the chart and the table again, of the rows that are there

Seconds are CPU seconds of one thread, medians over rounds that visit all contestants in turn, least and most beside
them. Where an engine's cost grows with its pixels some tiles stand for all (`share`). Prints a table, puts its rows
into benchmarks/latest.json and draws docs/assets/growth.png. fastsar takes part where it is installed
(`pip install fastsar`); an engine that is missing is named with its reason.
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
from growing.contestants import Contestant, House, SkippedError
from growing.rivals import Fastsar
from growing.scene import Geometry, Scene, Surface, build
from growing.table import exponents, markdown
from latest import Row, read_rows, replace_rows

from apertura.core.backprojection.engines import instruction_set

CHART = Path(__file__).parents[1] / "docs" / "assets" / "growth.png"
AIMS_DB = (-40.0, -60.0, -80.0)
SLOW = 0.05
"""Who forms less of an image than this has one round where it is quick."""

_KEY = ("group", "name", "aim_db", "geometry", "surface", "size", "pulses")


class Case(NamedTuple):
    """A scene, and whether a quick run has it."""

    size: int
    pulses: int
    geometry: Geometry
    surface: Surface = "flat"
    quick: bool = False

    @property
    def name(self) -> str:
        return f"{self.size}² × {self.pulses}, {self.geometry}, {self.surface}"


class Effort(NamedTuple):
    """Rounds at most; seconds of one run, roughly; whether native stands at one accuracy alone."""

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
    """Measure, print, save and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer cases, rounds and tiles; native at -60 dB alone")
    parser.add_argument("--cases", nargs="*", default=[], help="words, one of which a case's name holds")
    parser.add_argument("--only", nargs="*", default=[], help="names of contestants")
    parser.add_argument("--rounds", type=int, help="at most; 5, or 3 where quick")
    parser.add_argument("--limit", type=float, help="seconds of one run of a contestant, roughly; 40, or 6 where quick")
    parser.add_argument("--draw", action="store_true", help="measure nothing")
    parser.add_argument("--unsaved", action="store_true", help="print alone")
    asked = parser.parse_args()
    rounds, limit_s = asked.rounds or (3 if asked.quick else 5), asked.limit or (6.0 if asked.quick else 40.0)
    cases = [case for case in CASES if case.quick or not asked.quick]
    cases = [case for case in cases if not asked.cases or any(word in case.name for word in asked.cases)]
    rows: list[Row] = []
    for geometry in () if asked.draw else sorted({case.geometry for case in cases}):
        measured(Case(256, 64, geometry), Effort(1, limit_s, quick=False), asked.only)  # what is compiled once
    for case in () if asked.draw else cases:
        rows += measured(case, Effort(rounds, limit_s, asked.quick), asked.only)
    if not asked.unsaved:
        made = {tuple(row[key] for key in _KEY) for row in rows}
        kept = replace_rows(rows, lambda row: tuple(row.get(key) for key in _KEY) in made) if rows else read_rows()
        rows = [row for row in kept if row.get("group") == "growth"]
        CHART.parent.mkdir(exist_ok=True)
        draw(rows, CHART)
    print("\n" + markdown(rows) + "\n\n" + exponents(rows))


def measured(case: Case, effort: Effort, only: list[str]) -> list[Row]:
    """Return the rows of one scene; contestants take turns until each has had its rounds or its time."""
    begin = time.perf_counter()
    scene = build(case.size, case.pulses, case.geometry, case.surface)
    house = House(scene)
    print(f"{scene.name}: {len(scene.history.frequency_hz)} subcarriers", flush=True)
    contestants = [one for one in _contestants(house, effort) if not only or one.name in only]
    loads = [os.getloadavg()[0]]
    for turn in range(effort.rounds):
        house.compress()
        for one in contestants:
            once = effort.quick and one.share < SLOW  # of what goes pixel by pixel
            if turn == 0 or (not once and one.spent * (turn + 1) / turn < 3 * effort.limit_s):
                one.go()
        loads.append(os.getloadavg()[0])
    print(f"  {time.perf_counter() - begin:.0f} s, load {min(loads):.1f} to {max(loads):.1f}", flush=True)
    compression_s = median(house.compressions)
    measures = {"machine": machine(), "load": round(max(loads), 1), "compression_s": float(f"{compression_s:.3g}")}
    return [one.row(compression_s) | measures for one in contestants]


def machine() -> str:
    """Return the processor, as Linux calls it, and what our sums run with."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    return f"{model}, {instruction_set('native')}"


def _contestants(house: House, effort: Effort) -> Iterator[Contestant]:
    """Yield those who can take part; say why the others do not."""
    limit_s = effort.limit_s
    entries: list[tuple[str, Callable[[], Contestant]]] = [
        (f"{engine} {aim_db:.0f} dB", partial(house.planned, engine, aim_db, limit_s))
        for engine in ("native", "tree")
        for aim_db in (AIMS_DB if engine == "tree" or not effort.quick else (-60.0,))
    ]
    entries.append(("numba", partial(house.planned, "numba", -60.0, limit_s / 2, fields=True)))
    if importlib.util.find_spec("fastsar"):
        rival = Fastsar(house.scene)
        entries += [(name, partial(rival.factorized, name, **options)) for name, options in _factorized(house.scene)]
        entries += [
            ("fastsar exact", partial(rival.exact, limit_s)),
            ("fastsar points", partial(rival.points, limit_s / 2)),
        ]
    else:
        print("  fastsar is not installed")
    without: dict[str, list[str]] = {}
    for name, enter in entries:
        try:
            yield enter()
        except SkippedError as reason:
            without.setdefault(str(reason), []).append(name)
    for why_not, names in without.items():
        print(f"  without {', '.join(names)}: {why_not}")


def _factorized(scene: Scene) -> Iterator[tuple[str, dict[str, int]]]:
    """Yield fastsar's factorized former as it comes, and as exact as it gets.

    Its image is the more exact the smaller its last patches are: of 16 pixels at least, so pixels are made finer; with
    one level more where three leave too much to the last.
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
