"""Provenance of a step's result: its own settings, inputs and code, and those of the stages before it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import xarray as xr

from apertura import __version__
from apertura.campaign.digests import Lineage
from apertura.common.contracts import STAGES, STANDARD_NAMES, check
from apertura.common.provenance import Provenance, canonical_json, joined, lock_sha256, packages, software


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
