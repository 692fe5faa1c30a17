"""What a plan says of its setting, and what it takes: reasons, seconds, bytes."""

from collections.abc import Iterator, Mapping
from typing import Any

from apertura.image.candidates import WIDE_SUM_DB, Setting
from apertura.image.models import Decision
from apertura.image.plan import Job
from apertura.image.thinning import Presum

_BASE_BYTES = 300_000_000  # the interpreter and its libraries
_TILE_BYTES = 150  # per pixel in work: positions, their projection, the sum
_PRODUCT_BYTES = 60  # per pixel: image, its part of the cube, three rasters with overviews, before compression
_SETTING_KEYS = {"engine", "table_degree", "table_oversampling", "phase_tolerance_rad", "accumulate"}


def setting_decisions(chosen: Setting, asked: Mapping[str, Any], accuracy_db: float) -> Iterator[Decision]:
    """Yield the choices that make up a setting, with their reasons.

    Parameters
    ----------
    chosen
        The setting.
    asked
        Choice → value that a person asks for.
    accuracy_db
        Error asked.
    """

    def why(*keys: str) -> str:
        return "asked for in config/config.yaml; " if any(key in asked for key in keys) else ""

    met = "meets" if chosen.error_db <= accuracy_db else "does not meet"
    rank = "what was asked for" if asked.keys() & _SETTING_KEYS else "cheapest of every engine and setting"
    yield Decision("engine", chosen.engine, f"{why('engine')}{rank}, {met} {accuracy_db:.0f} dB", chosen.error_db)
    if "oversampling" in chosen.options:
        yield Decision("table_oversampling", chosen.options["oversampling"], why("table_oversampling") + chosen.reason)
    if chosen.engine == "native":
        options = {**chosen.options, **chosen.form_options}
        shared, wide, exact = (100 * share for share in chosen.shares)
        forms = f"of pixel·pulses {shared:.0f} % share curvature, {wide:.0f} % need their own or wide windows"
        reasons = {
            "table_degree": "cheapest with this oversampling",
            "phase_tolerance_rad": f"{forms}, {exact:.0f} % the exact way",
            "accumulate": f"sums in float32 err by -115 dB, wider below {WIDE_SUM_DB:.0f} dB; paths start in float64",
        }
        names = {"table_degree": "degree", "phase_tolerance_rad": "tolerance_rad", "accumulate": "accumulate"}
        for name, reason in reasons.items():
            yield Decision(name, options[names[name]], why(name) + reason)


def wall_seconds(chosen: Setting, job: Job) -> float:
    """Return the seconds on the job's threads; choices are made on one, so that they do not depend on it."""
    return chosen.table_seconds + (chosen.seconds - chosen.table_seconds) / min(job.threads, job.load.tiles)


def bytes_needed(job: Job, chosen: Setting, presum: Presum | None) -> tuple[int, int]:
    """Return peak memory of the imaging step, and what the pair leaves on disk, bytes."""
    pulses, pixels = len(job.tx_position_m), job.shape[0] * job.shape[1]
    history = 8 * pulses * (job.subcarriers + job.signal.samples)
    virtual = 0 if presum is None else 16 * pulses * job.signal.samples + 16 * len(presum.at) * job.signal.samples
    tiles = min(job.threads, job.load.tiles) * _TILE_BYTES * min(job.tile_px**2, pixels)
    memory = _BASE_BYTES + 2 * history + virtual + chosen.table_bytes + tiles
    return memory, history + _PRODUCT_BYTES * pixels
