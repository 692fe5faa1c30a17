"""Every setting of every engine, with the error and the cost that geometry and waveform predict for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.engines import ENGINES
from apertura.focus.engines.native_prediction import path_variants
from apertura.focus.engines.native_tables import BAND, MARGIN, TAPS, band_error_db, design_table, ratio
from apertura.planning import cost
from apertura.planning.view import View

DEGREES = (1, 2)
OVERSAMPLINGS: Mapping[int, tuple[int, ...]] = {
    1: (4, 5, 6, 8, 10, 12, 16, 20, 24, 32),
    2: (2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20),
}
TOLERANCES_RAD = (1.5e-3, 1e-3, 7e-4, 5e-4, 3e-4, 1.5e-4, 5e-5, 1.5e-5)
NUMBA_OVERSAMPLINGS = (2, 4, 6, 8, 12, 16, 24, 32)

WIDE_SUM_DB = -105.0
"""Below this error the sum over pulses is float64; in float32 it errs by about -115 dB."""

_WORST_TO_RMS = 1 / 3
_FLOAT32_RAD = 2e-6
_SILENT = 1e-20
_REFINED_DB = -98.0  # the sinc filter of numba's table
_REFERENCE_DB = -140.0  # images are complex64


@dataclass(frozen=True)
class Signal:
    """What profiles hold.

    Attributes
    ----------
    centre_hz
        f_mid.
    oversampling
        Samples per cell c/B.
    step_m
        Total path between samples.
    samples
        Per pulse.
    window
        (subcarrier,) float64, weights over the band, of any scale; flat by default.
    """

    centre_hz: float
    oversampling: float
    step_m: float
    samples: int
    window: NDArray[np.float64] = field(default_factory=lambda: np.ones(1), repr=False)

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/c."""
        return 2 * np.pi * self.centre_hz / SPEED_OF_LIGHT_M_S


@dataclass(frozen=True)
class Setting:
    """An engine and how it is set, with what that is predicted to give.

    Attributes
    ----------
    engine
        A key of `ENGINES`.
    options, form_options
        Keywords of its `prepare` and of its `form`.
    error_db
        Predicted RMS error on random pixels.
    seconds, table_seconds
        Predicted on one thread: in all, and for what all tiles share.
    table_bytes
        What `prepare` returns for all pulses.
    reason
        One line.
    shares
        Of pixels × pulses that native computes by shared curvature, wide windows and exact paths.
    pulse_blocks
        Into how many blocks pulses are split, so that the tables of one fit into memory; their images add up.
    """

    engine: str
    options: Mapping[str, Any]
    form_options: Mapping[str, Any]
    error_db: float
    seconds: float
    table_bytes: int
    reason: str = ""
    table_seconds: float = 0.0
    shares: tuple[float, float, float] = (1.0, 0.0, 0.0)
    pulse_blocks: int = 1

    @property
    def line(self) -> str:
        """The engine and its options in a few words.

        Examples
        --------
        >>> Setting("numba", {"oversampling": 8}, {}, -80.0, 1.0, 0).line
        'numba oversampling=8'
        """
        return " ".join(
            [self.engine, *(f"{name}={value}" for name, value in {**self.options, **self.form_options}.items())]
        )


def candidates(
    view: View, signal: Signal, load: cost.Load, costs: cost.Costs, *, asked: Mapping[str, Any] | None = None
) -> list[Setting]:
    """Return every setting that can run here and that `asked` leaves, cheapest first; equal costs by predicted error.

    Parameters
    ----------
    view, signal
        Geometry and waveform.
    load
        How much there is to do; its `cells` are set for each setting.
    costs
        Constants of this machine.
    asked
        Values of engine, table_degree, table_oversampling, phase_tolerance_rad, accumulate that a person asks for.
        Those of native's tables leave native alone, where it was built.
    """
    asked = asked or {}
    engines = {"reference", "numba", *(("native",) if ENGINES["native"].available() else ())}
    if "engine" in asked:
        engines &= {asked["engine"]}
    elif "native" in engines and asked.keys() & {"table_degree", "phase_tolerance_rad", "accumulate"}:
        engines = {"native"}
    elif "table_oversampling" in asked:
        engines -= {"reference"}
    found = [_reference(view, load, costs)] if "reference" in engines else []
    if "numba" in engines:
        wanted = _only(asked, "table_oversampling", NUMBA_OVERSAMPLINGS)
        found += [_numba(view, signal, load, costs, n) for n in wanted if n >= signal.oversampling or len(wanted) == 1]
    if "native" in engines:
        found += [
            _native(
                view,
                signal,
                load,
                costs,
                degree=degree,
                oversampling=n,
                tolerance_rad=tolerance,
                accumulate=asked.get("accumulate"),
            )
            for degree in _only(asked, "table_degree", DEGREES)
            for n in _only(asked, "table_oversampling", OVERSAMPLINGS[degree])
            for tolerance in _only(asked, "phase_tolerance_rad", TOLERANCES_RAD)
        ]
    return sorted(found, key=lambda setting: (setting.seconds, setting.error_db))


def _only(asked: Mapping[str, Any], name: str, otherwise: tuple[Any, ...]) -> tuple[Any, ...]:
    return (asked[name],) if name in asked else otherwise


def _native(
    view: View,
    signal: Signal,
    load: cost.Load,
    costs: cost.Costs,
    *,
    degree: int,
    oversampling: int,
    tolerance_rad: float,
    accumulate: str | None,
) -> Setting:
    k = signal.wavenumber_rad_m
    up, down = ratio(signal.oversampling, oversampling)
    cell_m = signal.step_m * down / up
    table_db = design_table(signal.oversampling, k * signal.step_m, oversampling=oversampling, degree=degree).error_db(
        signal.window
    )
    shares, path_rad = path_variants(
        view.range_m,
        view.slope,
        spacing_m=view.spacing_m,
        cell_m=cell_m,
        wavenumber_rad_m=k,
        tolerance_rad=tolerance_rad,
    )
    cells = -(-((signal.samples - 1) * up // down + 1 + 2 * MARGIN) // TAPS) * TAPS
    paths_db = 20 * np.log10(_WORST_TO_RMS * path_rad + _FLOAT32_RAD)
    beams_db = 20 * np.log10(view.weights.error + _SILENT)
    error_db = power_sum_db(table_db, paths_db, beams_db)
    tables, tiles = cost.seconds(
        costs, "native", replace(load, cells=cells), degree=degree, shares=shares, weights=view.weights
    )
    sum_type = accumulate or ("complex64" if error_db > WIDE_SUM_DB else "complex128")
    return Setting(
        "native",
        {"degree": degree, "oversampling": oversampling},
        {"accumulate": sum_type, "tolerance_rad": tolerance_rad},
        error_db,
        tables + tiles,
        load.pulses * cells * 8 * (degree + 1),
        f"table errs by {table_db:.1f} dB, paths by {paths_db:.1f} dB"
        + (f", weights of antennas by {beams_db:.1f} dB" if view.weights.antennas else ""),
        tables,
        shares,
    )


def _numba(view: View, signal: Signal, load: cost.Load, costs: cost.Costs, oversampling: int) -> Setting:
    factor = max(1, round(oversampling / signal.oversampling))
    cells = signal.samples * factor
    cubic_db = cubic_error_db(signal.oversampling * factor, signal.window)
    tables, tiles = cost.seconds(costs, "numba", replace(load, cells=cells), weights=view.weights)
    error_db = power_sum_db(cubic_db, _REFINED_DB)
    reason = f"cubic interpolation of a {signal.oversampling * factor:.3g}× table errs by {cubic_db:.1f} dB"
    table_bytes = 8 * load.pulses * cells
    return Setting("numba", {"oversampling": oversampling}, {}, error_db, tables + tiles, table_bytes, reason, tables)


def _reference(view: View, load: cost.Load, costs: cost.Costs) -> Setting:
    spent = cost.seconds(costs, "reference", load, weights=view.weights)[1]
    return Setting("reference", {}, {}, _REFERENCE_DB, spent, 0, "the double sum itself, float64")


def cubic_error_db(oversampling: float, window: NDArray[np.float64]) -> float:
    """Return the RMS error of four-point Lagrange interpolation of echoes that a window (subcarrier,) weighs, dB.

    Examples
    --------
    >>> [round(cubic_error_db(n, window)) for window in (np.ones(64), np.hanning(64)) for n in (4, 8)]
    [-54, -78, -72, -95]
    """
    omega = np.pi / oversampling * BAND
    u = np.linspace(0, 1, 41)[:, None]
    weights = (
        -u * (u - 1) * (u - 2) / 6,
        (u + 1) * (u - 1) * (u - 2) / 2,
        -(u + 1) * u * (u - 2) / 2,
        (u + 1) * u * (u - 1) / 6,
    )
    value = sum(weight * np.exp(1j * omega * (n - 1)) for n, weight in enumerate(weights))
    return band_error_db((np.abs(value - np.exp(1j * omega * u)) ** 2).mean(axis=0), window)


def power_sum_db(*parts_db: float) -> float:
    """Return the sum of independent errors, dB.

    Examples
    --------
    >>> round(power_sum_db(-60.0, -60.0), 1)
    -57.0
    """
    return float(10 * np.log10(sum(10 ** (part / 10) for part in parts_db)))
