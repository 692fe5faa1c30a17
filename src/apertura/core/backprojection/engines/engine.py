"""Interface of an engine, and a setting of one with its predicted error and cost."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from apertura.common.units import decibels
from apertura.core.backprojection.job import Job

BEAM_S = 1.2e-7
"""Seconds that `Beams.weight` takes for a pixel, a pulse and an antenna or the sector."""


class EngineOptions(BaseModel):
    """Options of an engine in ``processing.engine_options.<engine>``; None leaves one to the planner."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Setting:
    """An engine with its options, predicted error and cost.

    Attributes
    ----------
    engine
        A key of `ENGINES`.
    options, form_options
        Keywords of its `prepare` and of its `form`.
    error_db
        Predicted RMS error on random pixels.
    form_seconds, table_seconds
        Predicted for all pixels, and for the tables that all tiles share: of one core of a server of 2023 with AVX-512.
        Other machines take longer, in about the same ratios: a choice depends on the job alone.
    table_bytes
        What `prepare` returns for all pulses.
    reasons
        Option → reason of its value, in one line.
    pulse_blocks
        Into how many blocks pulses are split, so that the tables of one fit into memory; their images add up.
    """

    engine: str
    options: Mapping[str, Any]
    form_options: Mapping[str, Any]
    error_db: float
    form_seconds: float
    table_seconds: float = 0.0
    table_bytes: int = 0
    reasons: Mapping[str, str] = field(default_factory=dict)
    pulse_blocks: int = 1

    @property
    def seconds(self) -> float:
        """Tables and pixels."""
        return self.table_seconds + self.form_seconds

    @property
    def all_options(self) -> dict[str, Any]:
        """Options of `prepare` and of `form`."""
        return {**self.options, **self.form_options}

    @property
    def line(self) -> str:
        """The engine and its options in a few words.

        Examples
        --------
        >>> Setting("numba", {"oversampling": 8}, {}, -80.0, 1.0).line
        'numba oversampling=8'
        """
        return " ".join([self.engine, *(f"{name}={value}" for name, value in self.all_options.items())])


class Engine(Protocol):
    """A module that forms images.

    Attributes
    ----------
    Options
        Options of the config; its fields are options of `prepare` or `form`.
    READS
        Its input: a `PhaseHistory` or `Profiles`.
    available
        Whether it can run here.
    NEEDS
        Requirements, in a few words; an engine that runs everywhere leaves it out.
    TIMED
        False where its seconds were not measured: it is taken on request only, never by the planner alone.
    candidates
        (job, pulses=, requested=) → settings with predicted error and cost; `pulses` may be fewer than the job's,
        `requested` are options fixed by the config.
    prepare
        (inputs, **options) → tables that all tiles share; ``[pulses]`` of it, a slice from a multiple of 64 on, is that
        of some pulses.
    instruction_set
        Which instructions its sums run with here; an engine may leave it out.
    pieces
        (shape of a block of pixels, form_options) → windows of it that get the same bits when formed alone; an engine
        whose pixels are formed in patches of `PATCH_PX` leaves it out.
    VARIANTS
        Names of the variants of its sum; `form` adds the pixels × pulses that took each to an int64 array `counts`. An
        engine with one variant leaves it out.
    form
        (prepared, pixels (y, x, 3) float64, beams=None, **form_options) → (y, x) complex, the sum over the pulses;
        releases the GIL, starts no threads.
    """

    Options: type[EngineOptions]
    READS: Literal["phase_history", "profiles"]
    available: Callable[[], bool]
    prepare: Callable[..., Any]
    form: Callable[..., Any]

    @staticmethod
    def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterable[Setting]: ...  # noqa: D102


def checked_pixels(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the places of pixels as contiguous float64, checked for an engine's `form`.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres.

    Raises
    ------
    ValueError
        If they have another shape.

    Examples
    --------
    >>> checked_pixels(np.zeros((2, 4, 3))[:, ::2]).shape
    (2, 2, 3)
    """
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"{pixels.shape=}: must be (y, x, 3)")
    return np.ascontiguousarray(pixels, np.float64)


def compiled_for() -> str:
    """Return the processor that numba compiles for here, as LLVM calls it."""
    from llvmlite.binding import get_host_cpu_name
    from numba.core import config

    return f"numba: {getattr(config, 'CPU_NAME', None) or get_host_cpu_name()}"


def power_sum_db(*parts_db: float) -> float:
    """Return the sum of independent errors, dB.

    Examples
    --------
    >>> round(power_sum_db(-60.0, -60.0), 1)
    -57.0
    """
    return decibels(sum(10 ** (part / 10) for part in parts_db))


def option_values(requested: Mapping[str, Any], name: str, offered: Iterable[Any]) -> tuple[Any, ...]:
    """Return the values of an option to consider: the one requested, or all that the engine offers."""
    return (requested[name],) if requested.get(name) is not None else tuple(offered)
