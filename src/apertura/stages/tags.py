"""Attributes of stages and tags of GeoTIFFs: settings, inputs, code, those of the stages before, time and quality."""

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
    """Return `dataset` checked and stamped with its own and its parents' provenance.

    Parameters
    ----------
    dataset
        What the step computed.
    stage
        A key of `apertura.common.contracts.STAGES`.
    modules
        ``__name__`` of the step's module and of modules named by rows of tables; the code hash covers their imports.
    parents, settings, inputs
        As `apertura.common.provenance.Provenance.of`.
    """
    origin = Provenance.of(modules, parents, settings=settings, inputs=inputs, software=packages())
    return stamp(dataset, stage, **vars(origin))


def tags_of(origin: Provenance, lineage: Lineage) -> dict[str, str]:
    """Return the provenance tags of an exported file: settings, inputs and code, and the hashes of its source files.

    Parameters
    ----------
    origin
        Settings, inputs and code, its own and those of the stages before it.
    lineage
        Of the result, with the sha256 of each of its sources.
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
    """Check `dataset` and write units and provenance into its attributes.

    Parameters
    ----------
    dataset
        What the stage computed.
    stage
        A key of `STAGES`.
    runspec
        Settings that this stage and those before it used.
    inputs
        Role → sha256 of each thing read.
    code_sha256
        Chain of the code hashes of this stage and those before it.
    software
        Package → version, of this stage and those before it.

    Returns
    -------
    xarray.Dataset
        A shallow copy; the arrays are shared.

    Raises
    ------
    ContractError
        As `check`.
    """
    stamped = check(dataset, stage).copy()
    contract = STAGES[stage]
    for name, promise in {**contract.variables, **contract.optional}.items():
        if name not in dataset.variables:
            continue
        if promise.unit:
            stamped[name].attrs["units"] = promise.unit
        stamped[name].attrs["long_name"] = promise.meaning
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


_FIRST_CLOCK = np.datetime64("1980-01-06")  # a recording without a clock counts from 1970


def acquisition_tags(campaign: Campaign, views: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return time, frequency, side and author of an image as tags; of a sum, those of its pairs together."""
    each = list(views.values())
    first, last = min(one["first_utc"] for one in each), max(one["last_utc"] for one in each)
    centres = {one["centre_hz"] for one in each}
    low, high = (f(one["centre_hz"] + sign * one["band_hz"] / 2 for one in each) for f, sign in ((min, -1), (max, 1)))
    centre_hz = centres.pop() if len(centres) == 1 else (low + high) / 2
    sides = {one["side"] for one in each}
    side = sides.pop() if len(sides) == 1 else "both"
    seen = any(one["side_observable"] for one in each)
    labels = {label for pair in views if (label := polarisation_of(campaign.settings.nodes, pair))}
    incidence = [one["incidence_deg"] for one in each]
    stated, clock = campaign.settings.metadata, np.datetime64(first) >= _FIRST_CLOCK
    found = {
        "APERTURA_ACQUISITION_START": f"{first[:26]}Z" if clock else None,
        "APERTURA_ACQUISITION_END": f"{last[:26]}Z" if clock else None,
        "APERTURA_CENTRE_FREQUENCY_HZ": f"{centre_hz:.12g}",
        "APERTURA_BANDWIDTH_HZ": f"{high - low:.12g}",
        "APERTURA_WAVELENGTH_M": f"{SPEED_OF_LIGHT_M_S / centre_hz:.6g}",
        "APERTURA_LOOK_SIDE": side if side == "both" or seen else f"{side}, assumed",
        "APERTURA_INCIDENCE_DEG": f"{np.mean(incidence):.2f}",
        "APERTURA_POLARISATION": ", ".join(sorted(labels)) or None,
        "APERTURA_PLATFORM": stated.platform,
        "APERTURA_DOI": stated.doi,
        "TIFFTAG_DATETIME": f"{first[:19].replace('-', ':').replace('T', ' ')}" if clock else None,
        "TIFFTAG_ARTIST": stated.author,
        "TIFFTAG_COPYRIGHT": stated.licence,
    }
    return {name: value for name, value in found.items() if value is not None}


def quality_tags(report: Mapping[str, Any]) -> dict[str, str]:
    """Return engine, error bound, flags, models and budget of an image as tags."""
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
