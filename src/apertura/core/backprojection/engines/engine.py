"""Interface of engines, and engine settings with predicted error and cost."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from apertura.common.units import decibels
from apertura.core.backprojection.job import Job

BEAM_S = 1.2e-7
"""Computing time of `Beams.weight` per pixel, pulse, and antenna or sector, seconds."""


class EngineOptions(BaseModel):
    """Options of an engine in ``processing.engine_options.<engine>``; the planner selects options that are None."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Setting:
    """Engine with options, predicted error and predicted cost.

    Attributes
    ----------
    engine
        Key of `ENGINES`.
    options, form_options
        Keyword arguments of `prepare` and of `form`.
    error_db
        Predicted RMS error at random pixels, dB.
    form_seconds, table_seconds
        Predicted time for all pixels, and for the tables common to all tiles, on one core of a server of 2023 with
        AVX-512. On other machines, the ratios between the times of settings are approximately the same; the choice
        therefore depends only on the job. The time of a GPU is multiplied by the number of threads, which share it.
    table_bytes
        Size of the tables of all pulses.
    reasons
        Option → reason for its value, one line.
    pulse_blocks
        Number of pulse blocks with which the tables of one block fit into memory; the image is the sum over the blocks.
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
        """Predicted time for tables and pixels, seconds."""
        return self.table_seconds + self.form_seconds

    @property
    def all_options(self) -> dict[str, Any]:
        """Options of `prepare` and of `form`."""
        return {**self.options, **self.form_options}

    @property
    def line(self) -> str:
        """Engine and options in one phrase.

        Examples
        --------
        >>> Setting("numba", {"oversampling": 8}, {}, -80.0, 1.0).line
        'numba oversampling=8'
        """
        return " ".join([self.engine, *(f"{name}={value}" for name, value in self.all_options.items())])


class Engine(Protocol):
    """Interface of an engine module, which forms images.

    Attributes
    ----------
    Options
        Model of the options in the config; its fields are options of `prepare` or `form`.
    READS
        Input type: phase history or profiles.
    available
        Returns True if the engine can run on this machine.
    NEEDS
        Requirements, one phrase; not defined by an engine without requirements.
    candidates
        (job, pulses=, requested=) → settings with predicted error and cost. `pulses` may be smaller than the number of
        pulses of the job; `requested` contains options fixed by the config.
    prepare
        (inputs, **options) → tables common to all tiles. Indexing the tables with a slice of pulses that starts at a
        multiple of 64 returns the tables of these pulses.
    instruction_set
        Returns the instruction set of the sums on this machine; optional.
    pieces
        (shape of a block of pixels, form_options) → windows that can be formed independently with bit-identical
        results; not defined by an engine that forms pixels in patches of `PATCH_PX`.
    VARIANTS
        Names of the variants of the sum; `form` adds the number of pixel-pulse contributions of each variant to an
        int64 array `counts`. Not defined by an engine with a single variant.
    form
        (prepared, pixels (y, x, 3) float64, beams=None, **form_options) → (y, x) complex, the sum over the pulses. The
        function releases the GIL and starts no threads.
    """

    Options: type[EngineOptions]
    READS: Literal["phase_history", "profiles"]
    available: Callable[[], bool]
    prepare: Callable[..., Any]
    form: Callable[..., Any]

    @staticmethod
    def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterable[Setting]: ...  # noqa: D102


def checked_pixels(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixel positions as contiguous float64, validated for `form` of an engine.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres.

    Raises
    ------
    ValueError
        If the shape is not (y, x, 3).

    Examples
    --------
    >>> checked_pixels(np.zeros((2, 4, 3))[:, ::2]).shape
    (2, 2, 3)
    """
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"{pixels.shape=}: must be (y, x, 3)")
    return np.ascontiguousarray(pixels, np.float64)


def compiled_for() -> str:
    """Return the LLVM name of the processor for which numba compiles on this machine."""
    from llvmlite.binding import get_host_cpu_name
    from numba.core import config

    return f"numba: {getattr(config, 'CPU_NAME', None) or get_host_cpu_name()}"


def power_sum_db(*parts_db: float) -> float:
    """Return the power sum of independent errors, dB.

    Examples
    --------
    >>> round(power_sum_db(-60.0, -60.0), 1)
    -57.0
    """
    return decibels(sum(10 ** (part / 10) for part in parts_db))


def option_values(requested: Mapping[str, Any], name: str, offered: Iterable[Any]) -> tuple[Any, ...]:
    """Return the candidate values of an option: the requested value, or all values offered by the engine."""
    return (requested[name],) if requested.get(name) is not None else tuple(offered)
