"""Known symbols that change from pulse to pulse, compared with a fixed code: image noise, peak, and computing time.

`python benchmarks/data_symbols.py` prints the tables of docs/theory/changing_codes.md. Images of the demo scene are
formed from recordings with and without noise. The difference of range profiles from those of a fixed QPSK code without
noise is the sum of noise and data sidelobes; its power relative to that of the fixed code with noise is the SNR loss.
"""

import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.echo.captures import blocks_of
from apertura.run.process import process
from apertura.simulation import ImageGrid, Impairments, preset, simulate
from apertura.stages import ingest
from apertura.stages.transfer import PairEcho

PULSES, SIDELINK_DB = 200, 25.0
PAIRS = "uav1-uav1", "uav1-uav2"
FIXED = ("qpsk", 1)
CODES = (FIXED, ("qpsk", PULSES), ("16qam", PULSES), ("64qam", PULSES), ("16qam", 1))
FILTERS = "auto", "reciprocal", "matched"


def simulated(root: Path, code: str, frames: int, snr_db: float | None) -> Path:
    """Simulate the demo flight with a code, on a grid of 40 m × 40 m."""
    plan = replace(preset("demo", pulses=PULSES), scene=ImageGrid("EPSG:32632", half_width_m=20.0, spacing_m=0.32))
    own = Impairments(radar_snr_db=snr_db)
    quiet = {"uav1": own, "uav2": replace(own, sidelink_snr_db=None if snr_db is None else SIDELINK_DB)}
    waveform = replace(plan.waveform, code=code, frames=frames)
    simulate(root, plan, waveform=waveform, impairments=quiet)
    for node in ("uav1", "uav2"):
        ingest.ingest(Campaign.load(root), "f01", node)
    return root


Formed = dict[str, tuple[np.ndarray, np.ndarray, dict]]


def imaged(root: Path, symbol_filter: str) -> Formed:
    """Return pair → image, range profiles, and report on the symbols."""
    path = root / "config/config.yaml"
    document = yaml.safe_load(path.read_text())
    document["processing"] = {"autofocus": "off", "background": "none", "interference": "none", "sidelink": "divide"}
    document["processing"] |= {
        "symbol_filter": symbol_filter,
        "accuracy_db": -60.0 if symbol_filter != "auto" else -45.0,
    }
    path.write_text(yaml.safe_dump(document))
    campaign = Campaign.load(root)
    process(campaign, first="echo", last="image")
    formed: Formed = {}
    nodes = json.loads((root / "truth.json").read_text())["flights"]["f01"]["nodes"]
    for pair in PAIRS:
        stage = {name: open_stage(campaign.stage(name, "f01", pair), name) for name in ("image", "profile", "echo")}
        scale = nodes[pair.split("-")[1]]["channels"]["radar"]["full_scale"]  # of the converter, which includes noise
        pixels, profiles = (stage[name][name].values * scale for name in ("image", "profile"))
        formed[pair] = pixels, profiles, stage["echo"].attrs.get("symbols", {})
    return formed


def decibels(ratio: float) -> float:
    """Return a power ratio in dB."""
    return 10 * np.log10(ratio)


def losses(snr_db: float) -> None:
    """Print the SNR loss of each code and filter, measured in images and predicted."""
    print(f"\nSNR {snr_db:g} dB per subcarrier")
    print("| code | frames | filter | pair | loss, dB | predicted | difference, dB | peak, dB |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        clean = imaged(simulated(Path(folder) / "clean", *FIXED, None), "auto")
        base: dict[str, tuple[float, float]] = {}
        fixed: Formed = {}
        for code, frames in CODES:
            root = simulated(Path(folder) / f"{code}{frames}", code, frames, snr_db)
            for symbol_filter in FILTERS if code != "qpsk" else ("auto",):
                formed = imaged(root, symbol_filter)
                fixed = fixed or formed
                for pair, (pixels, profiles, symbols) in formed.items():
                    # noise of pixels and of profiles
                    noise = tuple(
                        float(np.mean(np.abs(here - clear) ** 2))
                        for here, clear in zip((pixels, profiles), clean[pair], strict=False)
                    )
                    base.setdefault(pair, noise)
                    # of two images with independent noise, relative to the sum of their noise
                    difference = np.mean(np.abs(pixels - fixed[pair][0]) ** 2) / (base[pair][0] + noise[0])
                    bright = np.unravel_index(np.abs(clean[pair][0]).argmax(), pixels.shape)
                    peak = np.abs(pixels[bright] / clean[pair][0][bright]) ** 2
                    name = symbols.get("filter", "reciprocal")
                    print(
                        f"| {code} | {frames} | {name if symbol_filter != 'auto' else f'auto: {name}'} | {pair} | "
                        f"{decibels(noise[1] / base[pair][1]):.2f} | {symbols.get('loss_db', 0.0):.2f} | "
                        f"{decibels(max(difference, 1e-9)):.2f} | {decibels(peak):+.2f} |",
                        flush=True,
                    )


def times() -> None:
    """Print the CPU time per pulse from samples to transfer functions, by code and filter, interleaved."""
    rows: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        formed = {}
        for code, frames in (FIXED, ("qpsk", PULSES), ("64qam", PULSES)):
            root = simulated(Path(folder) / f"{code}{frames}", code, frames, 10.0)
            for symbol_filter in ("auto",) if code == "qpsk" else ("reciprocal", "wiener"):
                imaged(root, symbol_filter)
                for pair in PAIRS:
                    name = f"{code}, {frames} frames, {symbol_filter}, {pair}"
                    formed[name] = PairEcho.opened(Campaign.load(root), "f01", pair).form
        for _ in range(9):
            for name, form in formed.items():
                start_s = time.process_time()
                for block in blocks_of(np.arange(PULSES)):
                    form(block)
                rows.setdefault(name, []).append(1e6 * (time.process_time() - start_s) / PULSES)
    print("\n| code | CPU µs per pulse |\n|---|---|")
    for name, measured in rows.items():
        print(f"| {name} | {np.median(measured):.0f} |")


if __name__ == "__main__":
    losses(-5.0)
    losses(15.0)
    times()
