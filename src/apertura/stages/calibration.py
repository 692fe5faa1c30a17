"""Rule `calibrate`: path offsets of a flight's pairs, from a reflector at a known position."""

from pathlib import Path
from typing import Any

import numpy as np

from apertura.campaign.config import CalibrationSettings
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_document, remake, save_document
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import canonical_json, chained_sha256
from apertura.core.echo.calibration import estimate_path_offset, reflector_history
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.imaging.range_profiles import Rows, wave_speed_of
from apertura.core.quality.measures import coherence_factor
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of


def calibrate(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/calibration.json: path offset, standard deviation and coherence of every pair.

    Raises
    ------
    CampaignError
        If config/config.yaml has no calibration section, or no reflector is detected.
    """
    requested = campaign.settings.calibration
    if requested is None:
        raise CampaignError(
            "no section calibration",
            where="config/config.yaml",
            expected="calibration.flight and calibration.reflector_m for a flight of kind calibration",
            remedy="Configure the position of the reflector.",
        )
    lineage = result_of(campaign, "calibration", flight).begin(campaign.root)
    report: dict[str, Any] = {"flight": flight, "reflector_m": list(requested.reflector_m), "pairs": {}}
    codes = []
    for pair in campaign.flight(flight).pairs:
        opened = PairEcho.opened(campaign, flight, pair)
        codes.append(opened.dataset.attrs["code_sha256"])
        report["pairs"][pair] = _pair(campaign, opened, requested, where=f"flight {flight}, pair {pair}") | {
            "inputs": opened.dataset.attrs["inputs"]
        }
    report["code_sha256"] = chained_sha256(lineage.result.code_sha256, codes)
    path = campaign.result(flight, "calibration.json")
    save_document(path, report, lineage)
    return path


def calibrated(campaign: Campaign, flight: str, pair: str) -> dict[str, Any] | None:
    """Return the calibrated path offset of a pair for an imaging flight; None if the configured offsets apply."""
    requested = campaign.settings.calibration
    if requested is None or campaign.flight(flight).kind == "calibration":
        return None
    path = campaign.result(requested.flight, "calibration.json")
    document = open_document(path)
    with undamaged(path, expected="the fields that step calibrate writes", remedy=remake(path)):
        offsets = {name: _validated(offset) for name, offset in document["pairs"].items()}
    if pair not in offsets:
        raise CampaignError(
            f"no offset of pair {pair}",
            where=path,
            expected=f"all pairs of flight {flight}; calibrated in {requested.flight}: {', '.join(sorted(offsets))}",
            remedy="Fly the calibration with the same transmitter and nodes, or remove section calibration.",
        )
    return {"flight": requested.flight, **offsets[pair]}


def _validated(offset: dict[str, Any]) -> dict[str, Any]:
    """Return the validated values of a pair's report."""
    std_m = offset["std_m"]
    return {
        "offset_m": float(offset["offset_m"]),
        "std_m": None if std_m is None else float(std_m),
        "inputs": {str(role): str(digest) for role, digest in offset["inputs"].items()},
        "flags": {str(name): str(text) for name, text in offset["flags"].items()},
    }


def _pair(campaign: Campaign, opened: PairEcho, requested: CalibrationSettings, *, where: str) -> dict[str, Any]:
    echo = opened.stage
    reflector = frame_from_map(campaign.settings.scene.crs, *requested.reflector_m)
    path_m = Aperture(echo.tx_position.values, echo.rx_position.values).path(reflector)
    path_m = path_m * (SPEED_OF_LIGHT_M_S / wave_speed_of(echo))  # electrical length, as for path offsets
    transfer, frequency = Rows(echo.transfer), echo.frequency.values
    offset = estimate_path_offset(transfer, frequency, path_m=path_m, search_m=requested.search_m, where=where)
    history = reflector_history(transfer, frequency, path_m=path_m + offset.offset_m)
    phase = np.unwrap(np.angle(history))
    return {
        "offset_m": round(echo.attrs["stated_offset_m"] + offset.offset_m, 6),
        "std_m": offset.std_m if np.isfinite(offset.std_m) else None,
        "stated_offset_m": echo.attrs["stated_offset_m"],
        "contrast_db": round(offset.contrast_db, 2),
        "pulses": offset.pulses,
        "coherence_factor": coherence_factor(history),
        "phase_rad": [round(float(value), 4) for value in phase],
        "phase_std_rad": round(float(np.std(phase)), 4),
        "flags": Flags.merged(opened.flags, offset.flags),
    }


def calibration_spec(offset: dict[str, Any] | None) -> str:
    """Return the applied calibration as one line for provenance."""
    return canonical_json({name: offset[name] for name in ("flight", "offset_m", "std_m")} if offset else None)
