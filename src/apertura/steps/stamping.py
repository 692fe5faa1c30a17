"""How a step's result inherits where it came from: settings, inputs and code of the stages before it."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from apertura.contracts import stamp
from apertura.provenance import chained_sha256, code_sha256, merged


def stamped(
    dataset: xr.Dataset,
    stage: str,
    *,
    module: str,
    parents: Sequence[xr.Dataset] = (),
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Return `dataset` checked and stamped with its own and its parents' provenance.

    Parameters
    ----------
    dataset
        What the step computed.
    stage
        A key of `apertura.contracts.STAGES`.
    module
        ``__name__`` of the step's module; its import closure is the code that ran.
    parents
        Stages that were opened.
    settings
        What of the config mattered to this step.
    inputs
        Role → sha256 of files read from outside the results.
    """
    runspec: dict[str, Any] = {}
    for parent in parents:
        runspec |= json.loads(parent.attrs["runspec"])
    return stamp(
        dataset,
        stage,
        runspec=runspec | dict(settings or {}),
        inputs=merged(*(parent.attrs["inputs"] for parent in parents), inputs or {}),
        code_sha256=chained_sha256(code_sha256(module), (parent.attrs["code_sha256"] for parent in parents)),
    )
