"""Page docs/howto/sizing.md: estimates of memory, run time and disk space for given numbers of pulses and pixels."""

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
_CAPTURE_SAMPLES = 2208  # samples per capture of `--preset flight`; the waveform is defined below
_WAVEFORM = {"carrier_hz": 1.2e9, "sample_rate_hz": 153.6e6, "prf_hz": 500.0, "subcarriers": 1024}
_WAVEFORM |= {"subcarrier_spacing_hz": 1e5, "symbol_s": 1.03125e-5, "cyclic_prefix_s": 4.375e-6}

_HEADER = f"""# Memory, time and disk of a campaign

Estimates for given numbers of pulses and pixels, for a campaign with a single flight in which `uav1` transmits, `uav1`
and `uav2` receive, and two pairs are imaged. Captures have the format of `apertura simulate --preset flight`
({_CAPTURE_SAMPLES} complex samples of 16 bit per channel, 1024 subcarriers), and pixels are {_SPACING_M:g} m wide. All
values in this table are **estimates**, which the workflow also uses. `apertura plan CAMPAIGN` estimates run time and
memory for the images of your campaign.

| pulses | pixels | recordings | time | memory: `image` | `refine` | results |
|---|---|---|---|---|---|---|
"""

_TAIL = f"""
- **Recordings**: samples of both nodes.
- **Time**: sum of the run times that `apertura run` estimates for all steps if they run one after another on two cores
  of 2025 with AVX-512 (`cost` of each rule in `src/apertura/workflow/rules.py`), including track refinement. The run
  time of an image varies with its plan by a factor of up to 18 ([growth](../theory/growth.md)).
- **Memory**: memory requested for a job on a cluster (`demand` of each rule), which is an upper limit. A job that
  exceeds the limit is submitted again with twice the request. Other steps request less than 2 GB. For small campaigns,
  a test checks that the request is at least the memory used, and at most four times the memory used.
- **Results**: {PIXEL_BYTES} bytes per pixel and pair for images, cube and rasters, and 8 bytes per sample of range
  profiles. These values are upper limits, because arrays are compressed. `processing: {{keep: [echo]}}` adds 8 KB per
  pulse and pair.

## Measured

CPU seconds of a single thread for a bistatic image, from transfer functions to pixels, for a requested accuracy of
−60 dB and flat terrain, on an AMD EPYC (Zen 5) with AVX-512 (`python benchmarks/growth.py`, results in
`benchmarks/latest.json`):

| pixels | pulses | engine `tree` | engine `native` |
|---|---|---|---|
"""

_END = """
Processing of a whole flight with 300 000 pulses, three pairs of 4096 × 4096 pixels and 13.5 GB of recordings takes
148 s on two cores (208 CPU seconds), and the largest process uses 925 MB ([a long flight](long_flights.md)).

This page is generated from `website/sizing.py` by `make pages`.
"""


def sizing_page() -> str:
    """Return the text of docs/howto/sizing.md."""
    estimated = [_estimated(pulses, side) for pulses, side in product(_PULSES, _SIDES)]
    return "".join([_HEADER, *estimated, _TAIL, *_measured(), _END])


def _estimated(pulses: int, side: int) -> str:
    campaign, edge_m = Campaign.load(_ROOT), side * _SPACING_M
    waveform = campaign.settings.waveform.model_copy(update=_WAVEFORM)
    grid = {"bounds_m": (0.0, 0.0, edge_m, edge_m), "spacing_m": _SPACING_M}
    scene = campaign.settings.scene.model_copy(update=grid)
    settings = campaign.settings.model_copy(update={"waveform": waveform, "scene": scene})
    recorded = {("f01", node): (4 * _CAPTURE_SAMPLES * pulses * count, pulses) for node, count in _CHANNELS.items()}
    resources = Resources(replace(campaign, settings=settings), recorded)
    rules = [(name, rule) for name, rule in RULES.items() if not rule.on_demand and not rule.shares]
    seconds = sum(
        resources.expected_seconds(name, *wildcards) for name, rule in rules for wildcards in places(campaign, rule)
    )
    job = SimpleNamespace(flight="f01", pair="uav1-uav2")
    memory = [1e6 * resources[name].mem_mb(job, 1) for name in ("image", "refine")]
    work, pairs = resources.work(job.flight, job.pair, None), len(campaign.flight(job.flight).pairs)
    disk = pairs * (work.profile_bytes + PIXEL_BYTES * work.pixels)
    samples = sum(size for size, _ in recorded.values())
    values = [f"{pulses:,}", f"{side}²", _gb(samples), f"{seconds / 60:.1f} min", *map(_gb, [*memory, disk])]
    return f"| {' | '.join(values)} |\n"


def _measured() -> list[str]:
    measured: dict[tuple[int, int], dict[str, str]] = {}
    for row in json.loads((_ROOT / "benchmarks/latest.json").read_text(encoding="utf-8")):
        if (row["geometry"], row.get("surface"), row.get("aim_db")) == ("bistatic", "flat", -60):
            measured.setdefault((row["size"], row["pulses"]), {})[row["name"]] = f"{row['seconds_from_echoes']:.3g} s"
    return [
        f"| {size}² | {pulses:,} | {by_engine['tree']} | {by_engine.get('native', 'not measured')} |\n"
        for (size, pulses), by_engine in sorted(measured.items())
        if "tree" in by_engine
    ]


def _gb(size: float) -> str:
    return f"{size / 1e9:.{1 if size < 9.95e9 else 0}f} GB"
