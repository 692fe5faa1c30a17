"""Provenance attributes of stages, and GeoTIFF tags: settings, inputs and code of upstream stages, time, quality."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from apertura import __version__
from apertura.campaign.config import polarisation_of
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import STAGES, STANDARD_NAMES, check
from apertura.common.provenance import (
    Provenance,
    canonical_json,
    joined,
    lock_sha256,
    packages,
    software,
)


def stamped(
    dataset: xr.Dataset,
    stage: str,
    *,
    modules: Sequence[str],
    parents: Sequence[xr.Dataset] | Mapping[str, xr.Dataset] = (),
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Return a checked dataset with its own and its parents' provenance as attributes.

    Parameters
    ----------
    dataset
        Dataset computed by the step.
    stage
        A key of `apertura.common.contracts.STAGES`.
    modules
        ``__name__`` of the step's module and of modules named in tables; the code hash covers their imports.
    parents, settings, inputs
        As in `apertura.common.provenance.Provenance.of`.
    """
    origin = Provenance.of(modules, parents, settings=settings, inputs=inputs, software=packages())
    return stamp(dataset, stage, **vars(origin))


def tags_of(origin: Provenance, lineage: Lineage) -> dict[str, str]:
    """Return the provenance tags of an exported file: settings, inputs and code, and the hashes of its source files.

    Parameters
    ----------
    origin
        Settings, inputs and code of the file and of all upstream stages.
    lineage
        Lineage of the result, with the SHA-256 of each of its sources.
    """
    return replace(origin, software=joined(origin.software, software())).tags() | {
        "APERTURA_SOURCES": canonical_json(lineage.sources.digests),
        "APERTURA_LOCK_SHA256": lock_sha256(),
    }


def stamp(
    dataset: xr.Dataset,
    stage: str,
    *,
    runspec: Mapping[str, Any],
    inputs: Mapping[str, str],
    code_sha256: str,
    software: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Check a dataset and write units and provenance into its attributes.

    Parameters
    ----------
    dataset
        Dataset computed by the stage.
    stage
        A key of `STAGES`.
    runspec
        Settings used by this stage and all upstream stages.
    inputs
        Role → SHA-256 of each input.
    code_sha256
        Chained code hashes of this stage and all upstream stages.
    software
        Package → version, of this stage and all upstream stages.

    Returns
    -------
    xarray.Dataset
        A shallow copy; the arrays are shared.

    Raises
    ------
    ContractError
        In the cases of `check`.
    """
    stamped = check(dataset, stage).copy()
    contract = STAGES[stage]
    for name, variable in {**contract.variables, **contract.optional}.items():
        if name not in dataset.variables:
            continue
        if variable.unit:
            stamped[name].attrs["units"] = variable.unit
        stamped[name].attrs["long_name"] = variable.meaning
        if name in STANDARD_NAMES:
            stamped[name].attrs["standard_name"] = STANDARD_NAMES[name]
    stamped.attrs |= {
        "apertura_stage": stage,
        "apertura_version": __version__,
        "runspec": canonical_json(runspec),
        "inputs": dict(sorted(inputs.items())),
        "code_sha256": code_sha256,
        "software": dict(software or {}),
    }
    return stamped


_FIRST_CLOCK = np.datetime64("1980-01-06")  # times of a recording without a clock start in 1970


def acquisition_tags(campaign: Campaign, views: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return time, frequency, look side and author of an image as tags; for a sum, those of all its pairs together."""
    each = list(views.values())
    first, last = min(view["first_utc"] for view in each), max(view["last_utc"] for view in each)
    centres = {view["centre_hz"] for view in each}
    low = min(view["centre_hz"] - view["band_hz"] / 2 for view in each)
    high = max(view["centre_hz"] + view["band_hz"] / 2 for view in each)
    centre_hz = centres.pop() if len(centres) == 1 else (low + high) / 2
    sides = {view["side"] for view in each}
    side = sides.pop() if len(sides) == 1 else "both"
    is_observable = any(view["side_observable"] for view in each)
    labels = {label for pair in views if (label := polarisation_of(campaign.settings.nodes, pair))}
    incidence = [view["incidence_deg"] for view in each]
    metadata, has_clock = campaign.settings.metadata, np.datetime64(first) >= _FIRST_CLOCK
    tags = {
        "APERTURA_ACQUISITION_START": f"{first[:26]}Z" if has_clock else None,
        "APERTURA_ACQUISITION_END": f"{last[:26]}Z" if has_clock else None,
        "APERTURA_CENTRE_FREQUENCY_HZ": f"{centre_hz:.12g}",
        "APERTURA_BANDWIDTH_HZ": f"{high - low:.12g}",
        "APERTURA_WAVELENGTH_M": f"{SPEED_OF_LIGHT_M_S / centre_hz:.6g}",
        "APERTURA_LOOK_SIDE": side if side == "both" or is_observable else f"{side}, assumed",
        "APERTURA_INCIDENCE_DEG": f"{np.mean(incidence):.2f}",
        "APERTURA_POLARISATION": ", ".join(sorted(labels)) or None,
        "APERTURA_PLATFORM": metadata.platform,
        "APERTURA_DOI": metadata.doi,
        "TIFFTAG_DATETIME": f"{first[:19].replace('-', ':').replace('T', ' ')}" if has_clock else None,
        "TIFFTAG_ARTIST": metadata.author,
        "TIFFTAG_COPYRIGHT": metadata.licence,
    }
    return {name: value for name, value in tags.items() if value is not None}


def quality_tags(report: Mapping[str, Any]) -> dict[str, str]:
    """Return instruction set, error bound, flags, models and error budget of an image as tags."""
    reports = {
        name: report[name] for name in ("budget", "budgets", "focus", "fusion", "recomputed") if report.get(name)
    }
    return {
        "APERTURA_INSTRUCTION_SET": report["instruction_set"],
        "APERTURA_ERROR_DB": f"{report['numerical_error_db']:.2f}",
        "APERTURA_ERROR_CONFIDENCE": f"{report['numerical_error_confidence']:.2f}",
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_MODELS": canonical_json(report["models"]),
        **{f"APERTURA_{name.upper()}": canonical_json(value) for name, value in reports.items()},
    }
