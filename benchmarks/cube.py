"""Run time and memory of one more flight, for a campaign of many small flights of one area.

    python -m benchmarks.cube                    200 flights, images of 256 x 256 pixels
    python -m benchmarks.cube --catalogs         STAC catalog, mosaics, map and RO-Crate of 50, 100 and 200 flights

A small simulated flight is processed once, and its results are copied to further flights. For the cube, the images are
replaced by independent speckle. Each step runs in a separate process. The cube is measured three times: written at once
for all flights but one, appended to by the last flight, and written at once for all flights.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.campaign.store import save_document
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages import coverage, cube
from benchmarks.products import enlarge, measured, run_step


def prepare(root: Path, flights: int, side: int | None) -> list[str]:
    """Write a campaign of `flights` flights with images of `side` pixels, or with all products; return its rows."""
    from dataclasses import replace

    plan = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    campaign = process(simulate(root, plan, seed=7), last="assess")
    (flight,) = campaign.image_flights
    if side is None:
        process(campaign, first="layers", last="export_fused")
    else:
        settled = json.loads(campaign.result("scene.json").read_text())
        settled["grid"]["shape"] = [side, side]
        save_document(campaign.result("scene.json"), settled)
    head, row = (root / "config" / "flights.tsv").read_text().splitlines()[:2]
    rows = [row.replace(flight.name, f"f{number:03}", 1) for number in range(1, flights + 1)]
    first = root / "results" / flight.name
    for number, line in enumerate(rows):
        name = line.split()[0]
        shutil.copytree(first, root / "results" / name)
        if side is not None:
            write_table(root, [head, line])
            for at, pair in enumerate(flight.pairs):
                enlarge(Campaign.load(root), name, pair, 2 * number + at, 1.0)
    return [head, *rows]


def write_table(root: Path, rows: list[str]) -> None:
    """Write the table of flights."""
    (root / "config" / "flights.tsv").write_text("".join(f"{row}\n" for row in rows))


def main() -> None:
    """Prepare a campaign and measure its steps."""
    if sys.argv[1:2] == ["--measure"]:
        run_step(*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--catalogs", action="store_true")
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/apertura-flights"))
    options = parser.parse_args()
    root = options.folder
    shutil.rmtree(root, ignore_errors=True)
    rows = prepare(root, options.flights, None if options.catalogs else options.side)
    if options.catalogs:
        for count in (options.flights // 4, options.flights // 2, options.flights):
            write_table(root, rows[: count + 1])
            print(f"{count} flights:", flush=True)
            campaign = Campaign.load(root)
            cube.cube(campaign)
            coverage.coverage(campaign)
            for step in ("mosaic", "map", "stac"):
                measured(root, step)
        return
    for title, last in (("all but one", -1), ("one more flight", None)):
        write_table(root, rows[:last])
        print(f"{title}:", flush=True)
        measured(root, "cube")
    print("all at once:", flush=True)
    (root / "results" / ".cube.zarr.lock").unlink()
    measured(root, "cube")
    files = [path for path in (root / "results" / "cube.zarr").rglob("*") if path.is_file()]
    print(f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
