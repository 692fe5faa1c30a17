"""How a step's result inherits where it came from: settings, inputs and code of the stages before it."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from apertura.contracts import stamp
from apertura.provenance import Provenance


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
        A key of `apertura.contracts.STAGES`.
    modules
        ``__name__`` of the step's module, and modules that rows named to it; their import closure is the code that ran.
    parents, settings, inputs
        As `apertura.provenance.Provenance.of`.
    """
    origin = Provenance.of(modules, parents, settings=settings, inputs=inputs)
    return stamp(dataset, stage, runspec=origin.runspec, inputs=origin.inputs, code_sha256=origin.code_sha256)
