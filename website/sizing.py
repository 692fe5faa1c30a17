"""docs/howto/sizing.md: memory, time and disk of campaigns by pulses and pixels, as the workflow estimates them."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

from apertura.campaign.folder import Campaign
from apertura.check.files import PIXEL_BYTES
from apertura.workflow.lineage import places
from apertura.workflow.resources import Resources
from apertura.workflow.rules import RULES

_ROOT = Path(__file__).parents[1]
_PULSES, _SIDES, _SPACING_M = (10_000, 100_000, 300_000), (1024, 4096, 8192), 0.1
_CHANNELS = {"uav1": 1, "uav2": 2}
_CAPTURE = 2208  # samples of `--preset flight`, whose waveform this is
_WAVEFORM = {"carrier_hz": 1.2e9, "sample_rate_hz": 153.6e6, "prf_hz": 500.0, "subcarriers": 1024}
_WAVEFORM |= {"subcarrier_spacing_hz": 1e5, "symbol_s": 1.03125e-5, "cyclic_prefix_s": 4.375e-6}

_HEAD = f"""# How much a campaign takes

Memory, time and disk by pulses and pixels, for a campaign of one flight: `uav1` transmits, `uav1` and `uav2` receive,
two pairs are imaged. Captures are those of `apertura simulate --preset flight` ({_CAPTURE} complex samples of 16 bit a
channel, 1024 subcarriers); pixels are {_SPACING_M:g} m wide. All numbers of this table are **estimates**, those
that the workflow itself uses. `apertura plan CAMPAIGN` estimates the images of your own campaign.

| pulses | pixels | recordings | time | memory: `image` | `refine` | results |
|---|---|---|---|---|---|---|
"""

_TAIL = f"""
- **Recordings**: samples of both nodes.
- **Time**: sum of the seconds that `apertura run` expects of all steps, one after the other, on two cores of 2025 with
  AVX-512 (`cost` of each rule in `src/apertura/workflow/rules.py`), with refinement of the tracks. The time of an image
  depends on its plan, by a factor of up to 18 ([growth](../theory/growth.md)).
- **Memory**: what a job requests from a cluster (`demand` of each rule), an upper limit; a job that exceeds it is
  submitted again with twice as much. Other steps request less than 2 GB. A test compares requests with the memory that
  small campaigns use: no less, and at most four times as much.
- **Results**: {PIXEL_BYTES} bytes per pixel and pair for images, cube and rasters, and 8 bytes per sample of range
  profiles; an upper limit, since arrays are compressed. `processing: {{keep: [echo]}}` adds 8 KB per pulse and pair.

## Measured

CPU seconds of one thread for one bistatic image, from transfer functions to pixels, −60 dB requested, flat ground, AMD
EPYC (Zen 5) with AVX-512 (`python benchmarks/growth.py`, kept in `benchmarks/latest.json`):

| pixels | pulses | engine `tree` | engine `native` |
|---|---|---|---|
"""

_END = """
A whole flight: 300 000 pulses, three pairs of 4096 × 4096 pixels, 13.5 GB of recordings take 148 s on two cores, 208
CPU seconds, 925 MB in the largest process ([a long flight](long_flights.md)).

Written by `make pages` from `website/sizing.py`.
"""


def sizing_page() -> str:
    """Return docs/howto/sizing.md."""
    estimated = [_estimated(pulses, side) for pulses, side in product(_PULSES, _SIDES)]
    return "".join([_HEAD, *estimated, _TAIL, *_measured(), _END])


def _estimated(pulses: int, side: int) -> str:
    campaign, edge_m = Campaign.load(_ROOT), side * _SPACING_M
    waveform = campaign.settings.waveform.model_copy(update=_WAVEFORM)
    grid = {"bounds_m": (0.0, 0.0, edge_m, edge_m), "spacing_m": _SPACING_M}
    scene = campaign.settings.scene.model_copy(update=grid)
    settings = campaign.settings.model_copy(update={"waveform": waveform, "scene": scene})
    recorded = {("f01", node): (4 * _CAPTURE * pulses * count, pulses) for node, count in _CHANNELS.items()}
    resources = Resources(replace(campaign, settings=settings), recorded)
    rules = [(name, rule) for name, rule in RULES.items() if not rule.on_demand and not rule.shares]
    seconds = sum(resources.expected_seconds(name, *where) for name, rule in rules for where in places(campaign, rule))
    job = SimpleNamespace(flight="f01", pair="uav1-uav2")
    memory = [1e6 * resources[name].mem_mb(job, 1) for name in ("image", "refine")]
    work, pairs = resources.work(job.flight, job.pair, None), len(campaign.flight(job.flight).pairs)
    disk = pairs * (work.profile_bytes + PIXEL_BYTES * work.pixels)
    samples = sum(size for size, _ in recorded.values())
    cells = [f"{pulses:,}", f"{side}²", _gb(samples), f"{seconds / 60:.1f} min", *map(_gb, [*memory, disk])]
    return f"| {' | '.join(cells)} |\n"


def _measured() -> list[str]:
    taken: dict[tuple[int, int], dict[str, str]] = {}
    for row in json.loads((_ROOT / "benchmarks/latest.json").read_text(encoding="utf-8")):
        if (row["geometry"], row.get("surface"), row.get("aim_db")) == ("bistatic", "flat", -60):
            taken.setdefault((row["size"], row["pulses"]), {})[row["name"]] = f"{row['seconds_from_echoes']:.3g} s"
    return [
        f"| {size}² | {pulses:,} | {by['tree']} | {by.get('native', 'not measured')} |\n"
        for (size, pulses), by in sorted(taken.items())
        if "tree" in by
    ]


def _gb(size: float) -> str:
    return f"{size / 1e9:.{1 if size < 9.95e9 else 0}f} GB"
