"""Radio interference: noise and peak of an image with and without its exclusion.

``python benchmarks/interference.py WORKFOLDER [--pulses 150] [--levels=-20,0,20,40]`` simulates the demo with a
continuous tone, DME-like pulses, or bursts over the whole band, in the radar channel of both nodes, in the sidelink of
the receiving node, or in both channels. Levels are relative to the mean power of the echoes, or of the direct path for
the sidelink. The table gives peak and noise floor relative to the campaign without interference, and the flags
(docs/theory/interference.md).
"""

import argparse
import shutil
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.simulation import preset
from apertura.simulation.impairments import Adc, Interferer

KINDS = {
    "tone": Interferer(1.31012e9, 0.0),  # between two subcarriers, so that it leaks into all of them
    "DME-like": Interferer(1.35e9, 0.0, duration_s=7e-6, rate_hz=10e3, envelope="hann"),
    "burst": Interferer(1.4e9, 0.0, bandwidth_hz=1e9, duration_s=20e-6, rate_hz=2e3),
}
CHANNELS = {"radar": ("radar",), "sidelink": ("sidelink",), "both": ("radar", "sidelink")}
ADC = Adc(bits=16, backoff_db=50.0)
"""Converter with headroom for the strongest interference: saturation is another effect."""

Levels = dict[str, tuple[float, float]]
"""Pair → peak and noise floor, dB."""


def process(root: Path, pulses: int, sources: list[Interferer], setting: str) -> tuple[Levels, set[str]]:
    """Simulate and process a campaign; return levels and flags of its images."""
    shutil.rmtree(root, ignore_errors=True)
    specification = preset("demo", pulses=pulses)
    nodes = {}
    for name, node in specification.nodes.items():
        received = tuple(source for source in sources if source.channel == "radar" or name != "uav1")
        impairments = replace(node.impairments, adc=ADC, interference=received)
        nodes[name] = replace(node, impairments=impairments)
    ap.simulate(root, replace(specification, nodes=nodes), seed=1)
    config = root / "config" / "config.yaml"
    config.write_text(f"{config.read_text()}\nprocessing: {{interference: {setting}, autofocus: 'off'}}\n")
    campaign = Campaign.load(root)
    with redirect_stdout(StringIO()):
        ap.process(campaign, last="assess")
    return dict(_levels(campaign)), set(_flags(campaign))


def _levels(campaign: Campaign) -> Iterator[tuple[str, tuple[float, float]]]:
    for pair in ("uav1-uav1", "uav1-uav2"):
        power = np.abs(open_stage(campaign.stage("image", "f01", pair), "image").image.values) ** 2
        yield pair, (10 * np.log10(np.nanmax(power)), 10 * np.log10(np.nanquantile(power, 0.3)))


def _flags(campaign: Campaign) -> Iterator[str]:
    for pair in ("uav1-uav1", "uav1-uav2"):
        flags = open_stage(campaign.stage("image", "f01", pair), "image").attrs["flags"]
        yield from (name for name in flags if name.startswith(("interference", "pulses", "sidelink", "saturated")))


def main() -> None:
    """Print a row for each kind, channel and level of interference."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pulses", type=int, default=150)
    parser.add_argument("--levels", default="-20,0,20,40")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--channels", default=",".join(CHANNELS))
    options = parser.parse_args()
    table = Table(title="interference: peak / noise floor relative to the campaign without, dB")
    headings = (
        "kind",
        "channel",
        "level",
        "uav1-uav1 unchanged",
        "excluded",
        "uav1-uav2 unchanged",
        "excluded",
        "flags",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    clean, flags = process(options.folder / "clean", options.pulses, [], "auto")
    print("without interference:", clean, sorted(flags), flush=True)
    for kind in options.kinds.split(","):
        for channels in options.channels.split(","):
            for level in map(float, options.levels.split(",")):
                sources = [replace(KINDS[kind], level_db=level, channel=name) for name in CHANNELS[channels]]
                results = [
                    process(options.folder / "campaign", options.pulses, sources, setting)
                    for setting in ("none", "auto")
                ]
                cells = [
                    "{:+.2f} / {:+.2f}".format(*(np.subtract(levels[pair], clean[pair])))
                    for pair in ("uav1-uav1", "uav1-uav2")
                    for levels, _ in results
                ]
                row = (kind, channels, f"{level:g} dB", *cells, ", ".join(sorted(results[1][1])))
                print(*row, sep=" | ", flush=True)
                table.add_row(*row)
    Console(width=180).print(table)


if __name__ == "__main__":
    main()
