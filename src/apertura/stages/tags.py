"""Provenance of stages as attributes, and of exported files as tags: settings, inputs and code of upstream stages."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import xarray as xr

from apertura import __version__
from apertura.campaign.digests import Lineage
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


def copied_inputs(first: xr.Dataset, second: xr.Dataset) -> dict[str, str]:
    """Return a flag if recordings or logs of two flights have the same content, as a copy has under another name."""
    of_second = {digest: name for name, digest in second.attrs["inputs"].items()}
    equal = [
        f"{name} = {of_second[digest]}"
        for name, digest in first.attrs["inputs"].items()
        if digest in of_second and name.split("/")[:2] != of_second[digest].split("/")[:2]
    ]
    return {"inputs_copied": f"files with the same content: {', '.join(equal)}"} if equal else {}


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
        "TIFFTAG_SOFTWARE": f"apertura {__version__}",
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
