"""Contracts of the stages: dimensions, dtype and unit of each variable, and required attributes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from apertura.common.errors import ContractError

if TYPE_CHECKING:
    import xarray as xr


# ---- Variables of stage `cube`: name → dimensions, dtype, unit, meaning ---------------------------------------------

_RASTERS, _SUMS, _IMAGES, _FLIGHTS = ("flight", "pair", "y", "x"), ("flight", "y", "x"), ("flight", "pair"), ("flight",)

CF_SIGMA0 = "surface_backwards_scattering_coefficient_of_radar_wave"
"""Standard name of σ⁰ in CF (Standard Name Table, https://cfconventions.org); γ⁰ and β⁰ have no standard name."""

STANDARD_NAMES = {"incidence": "angle_of_incidence", "centre_frequency": "sensor_band_central_radiation_frequency"}
"""Variable of the cube → CF standard name; CF defines none for the other variables."""

Row = tuple[tuple[str, ...], str, str, str]

RASTERS: dict[str, Row] = {
    "image": (
        _RASTERS,
        "complex64",
        "1",
        "echo amplitude of every image; NaN: no flight of the pair, or no image formed",
    ),
    "coherent": (_SUMS, "complex64", "1", "mean of the peak-normalised images"),
    "noncoherent": (_SUMS, "float32", "1", "mean power of the peak-normalised images"),
    "magnitude": (_SUMS, "float32", "1", "mean magnitude of the peak-normalised images"),
    "pair_coherence": (_RASTERS, "float32", "1", "coherence with the flight's reference pair"),
    "pair_phase": (_RASTERS, "float32", "rad", "phase relative to the flight's reference pair"),
    "flight_coherence": (_RASTERS, "float32", "1", "coherence with the pair's reference flight"),
    "flight_phase": (_RASTERS, "float32", "rad", "phase relative to the pair's reference flight"),
}
"""Rasters of the cube, written tile by tile."""

_OF_COHERENCE = {
    "window": "side of the estimation window, pixels, of",
    "looks": "independent samples in the window of",
    "chance": "expected value, for unrelated images, of",
    "common_band": "upper limit, set by the common band for unchanged terrain, of",
}

MEASURED: dict[str, Row] = {
    **{
        f"{kind}_{name}": (_IMAGES, "float64", "1", f"{meaning} {kind}_coherence")
        for kind in ("pair", "flight")
        for name, meaning in _OF_COHERENCE.items()
    },
    "coherent_noise_floor": (_FLIGHTS, "float64", "dB", "median power of the coherent sum relative to its peak"),
    "clutter_reduction": (
        _FLIGHTS,
        "float64",
        "dB",
        "clutter of the images relative to the clutter of their coherent sum",
    ),
}
"""Quantities measured while the rasters are written."""

SUMMED = frozenset(name for name, row in (*RASTERS.items(), *MEASURED.items()) if row[0] in {_SUMS, _FLIGHTS})
"""Variables that require a flight with at least two pairs; they are NaN for flights with a single pair."""

QUOTED: dict[str, Row] = {
    "heading": (_IMAGES, "float64", "degree", "direction of flight, clockwise from grid north"),
    "look_direction": (_IMAGES, "float64", "degree", "direction to the scene centre, clockwise from grid north"),
    "incidence": (_IMAGES, "float64", "degree", "incidence angle of the transmitter at the scene centre"),
    "bistatic_angle": (
        _IMAGES,
        "float64",
        "degree",
        "angle at the scene centre between the directions to both antennas",
    ),
    "range": (_IMAGES, "float64", "m", "half the total path via the scene centre, at closest approach"),
    "height": (_IMAGES, "float64", "m", "height of the antennas' midpoint above the scene centre"),
    "centre_frequency": (_IMAGES, "float64", "Hz", "centre frequency of the band"),
    "bandwidth": (_IMAGES, "float64", "Hz", "bandwidth of the echo"),
    "resolution_cell": (_IMAGES, "float64", "m", "finest resolution cell along rows or columns"),
    "loss": (_IMAGES, "float64", "dB", "peak loss due to phase errors, measured on the image"),
    "numerical_error": (_IMAGES, "float64", "dB", "upper limit of the numerical error relative to the image's rms"),
    "entropy": (_IMAGES, "float64", "1", "entropy of the image's power, nats"),
    "noise_floor": (_IMAGES, "float64", "dB", "median power of the image relative to its peak"),
    "pulses_used": (_IMAGES, "float64", "1", "number of pulses that form the image"),
    "pulses_dropped": (_IMAGES, "float64", "1", "number of pulses excluded from the image"),
    "peak": (_IMAGES, "float64", "1", "largest magnitude; the image is normalised by it before summation"),
    "phase_removed": (_IMAGES, "float64", "rad", "phase removed before the coherent sum; NaN: pair not in the sum"),
    "verdict": (_IMAGES, "T", "", "focus: focused, defocused or inconclusive; empty: no flight"),
    "flags": (_IMAGES, "T", "", "comma-separated names of the image's flags"),
}
"""Quality measures of each image; NaN where not measured."""

COORDINATES: dict[str, Row] = {
    "flight": (("flight",), "T", "", "name of the flight"),
    "pair": (("pair",), "T", "", "transmitter-receiver"),
    "time": (("flight",), "datetime64[ns]", "", "mid-time of the flight, UTC"),
    "reference_pair": (("flight",), "T", "", "pair to which the other pairs of the flight are compared"),
    "reference_flight": (("pair",), "T", "", "flight to which the other flights of the pair are compared"),
}
"""Coordinates of the cube."""


# ---- Contracts of all stages ----------------------------------------------------------------------------------------
#
# Data flows in one direction: raw → echo → profile → image → cube → files; `track` is an input of echo. `check` raises
# an error for a dataset that violates its contract.

Window = tuple[slice, slice]
"""Rows and columns of an image window."""


@dataclass(frozen=True)
class Variable:
    """Array of a stage."""

    dims: tuple[str, ...]
    dtype: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class Stage:
    """Contract of a stage: required arrays, required attributes and optional arrays."""

    variables: Mapping[str, Variable]
    attributes: Mapping[str, str]
    optional: Mapping[str, Variable] = field(default_factory=dict)


_PULSE_GEOMETRY = {
    "time": Variable(("pulse",), "datetime64[ns]", "", "UTC time tag of the pulse, transmitter's clock"),
    "tx_position": Variable(("pulse", "axis"), "float64", "m", "phase centre of the transmit antenna, in `frame`"),
    "rx_position": Variable(("pulse", "axis"), "float64", "m", "phase centre of the receive antenna, in `frame`"),
}
_CUBE = {name: Variable(*row) for part in (RASTERS, MEASURED, QUOTED, COORDINATES) for name, row in part.items()}
_FREQUENCY = {
    "frequency": Variable(("subcarrier",), "float64", "Hz", "RF frequency of each subcarrier, ascending"),
}
_TRANSFER = {
    "transfer": Variable(("pulse", "subcarrier"), "complex64", "1", "Σ a·exp(-j2πf(τ-τ_ref)) over the paths"),
}
_KNOTS = "node", "knot", "axis"
_FRAME = {
    "frame": "'ecef' (EPSG:4978) or 'local' (Cartesian axes of the campaign, not georeferenced)",
    "pair": "transmitter-receiver",
    "flags": "flags raised so far: flag name → one-line text with the measured values",
}
_WAVE = {"wave_speed_m_s": "propagation speed along the paths, m/s: path = wave_speed_m_s · delay"}

STAGES: Mapping[str, Stage] = {
    "raw": Stage(
        {
            "start": Variable(("pulse",), "int64", "1", "first sample of the capture in the recorder's file"),
            "time": Variable(("pulse",), "datetime64[ns]", "", "UTC time tag of the capture, clock of the node"),
            "frame": Variable(("pulse",), "int64", "1", "frame number transmitted in the payload; -1 if there is none"),
            "repeats": Variable(("pulse",), "bool", "1", "True if the capture is bit-identical to an earlier capture"),
        },
        {
            "node": "node name",
            "samples": "the recorder's file, relative to the campaign folder: channels interleaved per sample",
            "channels": "names of the channels",
            "capture_samples": "samples in each capture",
            "sample_rate_hz": "complex samples per second",
            "datatype": "SigMF datatype of the samples in the file",
            "trailing_bytes": "bytes at the end of the file that are not samples",
            "mixing": "down-conversion of real samples (if_hz, sample_rate_hz, restarts); null for complex samples",
        },
        {
            "segment_start": Variable(("segment",), "int64", "1", "first sample after bytes that are not samples"),
            "segment_skipped": Variable(("segment",), "int64", "1", "number of these bytes before the segment"),
        },
    ),
    "track": Stage(
        {
            "time": Variable(("epoch",), "datetime64[ns]", "", "UTC"),
            "position": Variable(("epoch", "axis"), "float64", "m", "logged point, in `frame`"),
            "attitude": Variable(
                ("epoch", "axis"), "float64", "rad", "roll, pitch, yaw of forward-right-down axes; NaN where not logged"
            ),
        },
        {
            "node": "node name",
            "frame": _FRAME["frame"],
            "dropped": "excluded epochs of the log: reason → number",
        },
        {
            "position_std": Variable(
                ("epoch", "axis"), "float64", "m", "logged standard deviation: north, east, up; NaN where not logged"
            ),
            "fix": Variable(
                ("epoch",), "int8", "1", "solution type as Q of RTKLIB (1 fix, 2 float, …); 0 if not logged"
            ),
        },
    ),
    "echo": Stage(
        {
            **_PULSE_GEOMETRY,
            **_FREQUENCY,
            "reference_delay": Variable(("pulse",), "float64", "s", "τ_ref, already removed from `transfer`"),
            "path_limit": Variable(("pulse",), "float64", "m", "longest total path within the cyclic prefix"),
        },
        _FRAME | _WAVE,
        {
            **_TRANSFER,
            "capture": Variable(("pulse",), "int64", "1", "index of the pulse's capture in the receiver's recording"),
            "frame": Variable(("pulse",), "int64", "1", "frame number of the pulse, which selects its code symbols"),
            "path_removed": Variable(
                ("pulse",), "float64", "m", "electrical path outside the scene, already removed from `transfer`"
            ),
            "clock_offset": Variable(
                ("pulse",), "float64", "Hz", "carrier offset of the receiver, already removed from its samples"
            ),
            "sidelink_delay": Variable(
                ("pulse",), "float64", "m", "measured sidelink delay × c, plus an arbitrary constant; NaN: no lock"
            ),
            "sidelink_snr": Variable(("pulse",), "float64", "dB", "sidelink SNR per subcarrier; NaN: no lock"),
            "sidelink_phase": Variable(("pulse",), "float64", "rad", "sidelink phase at mid-band; NaN: no lock"),
            "sidelink_amplitude": Variable(
                ("pulse",), "float64", "1", "sidelink amplitude per subcarrier, ADC counts; NaN: no lock"
            ),
            "sidelink_vector": Variable(
                ("pulse", "axis"), "float64", "m", "vector from the receiver's to the transmitter's sidelink antenna"
            ),
            "noise_excess": Variable(
                ("subcarrier",), "float32", "1", "noise relative to that of the neighbours, without interference"
            ),
            "noise_peak": Variable(
                ("subcarrier",), "float32", "1", "largest noise relative to that of a constant gain of the pulses"
            ),
            "symbol_channel": Variable(
                ("symbol_group", "subcarrier"), "complex64", "1", "mean channel of the sidelink for unknown symbols"
            ),
            "symbol_group": Variable(("symbol_group",), "float64", "1", "middle capture index of each mean channel"),
            "symbol_clock": Variable(
                ("symbol_capture",), "float64", "Hz", "carrier offset removed from the captures for unknown symbols"
            ),
        }
        | {
            f"{end}_axes": Variable(
                ("pulse", "axis", "body"), "float64", "1", f"body axes of the {node}: forward, right, down; in `frame`"
            )
            for end, node in (("tx", "transmitter"), ("rx", "receiver"))
        },
    ),
    "transfer": Stage({"time": _PULSE_GEOMETRY["time"], **_FREQUENCY, **_TRANSFER}, _FRAME),
    "profile": Stage(
        {
            **_PULSE_GEOMETRY,
            "profile": Variable(
                ("pulse", "range"),
                "complex64",
                "1",
                "range profile; the factor exp(+j2πf_mid·path/c) aligns pulses in phase",
            ),
            "start": Variable(("pulse",), "float64", "m", "total path (tx → scene → rx) of range sample 0"),
        },
        {
            **_FRAME,
            **_WAVE,
            "background": "echoes at constant delay: requested method, applied method, and reason",
            "interference": "subcarriers and pulses with interference: number, frequencies, whether excluded",
            "step_m": "total path between range samples, m",
            "centre_frequency_hz": "f_mid, reference frequency of the profile, Hz",
            "oversampling": "samples per resolution cell c/B of total path",
            "window": "weighting over the subcarriers",
            "compression_error_db": "rms error at test samples relative to the exact sum over subcarriers, dB",
        },
        {
            "background": Variable(
                ("background_knot", "subcarrier"),
                "complex64",
                "1",
                "removed background, with delays referred to the recorder's time base",
            ),
            "subcarrier_gain": Variable(
                ("subcarrier",),
                "float32",
                "1",
                "factor applied to `transfer`; 0 for subcarriers excluded for interference",
            ),
            "background_time": Variable(
                ("background_knot",), "float64", "s", "times of the knots of `background`, since the first pulse"
            ),
            "interference_level": Variable(
                ("subcarrier",),
                "float32",
                "1",
                "median power of `transfer`, reference for interference of single pulses",
            ),
        },
    ),
    "refined_track": Stage(
        {
            "time": Variable(("knot",), "datetime64[ns]", "", "UTC, transmitter's clock; linear between knots"),
            "further": Variable(
                ("pair", "knot"), "float64", "m", "extra total path, to be added to the path of all echoes of the pair"
            ),
            "correction": Variable(_KNOTS, "float64", "m", "vector to be added to positions of the node, in `frame`"),
            "std": Variable(_KNOTS, "float64", "m", "standard deviation of the residual error, per axis of `frame`"),
            "position": Variable(_KNOTS, "float64", "m", "radar phase centre according to the log, in `frame`"),
        },
        {
            "frame": _FRAME["frame"],
            "flags": "flags raised by the refinement: flag name → one-line text with the measured values",
            "nodes": "names along `node`",
            "pairs": "names along `pair`: pairs with a separate path offset; may be empty",
            "decisions": "autofocus, and autofocus_method if enabled: value and reason",
            "accepted": "True if images are formed with the correction, see also attributes `reason` and `report`",
            "left": "effect of the residual position errors on an image: loss_db, shift_m, phase_rad",
        },
    ),
    "terrain": Stage(
        {"height": Variable(("y", "x"), "float64", "m", "terrain height above the ellipsoid, or z in a local frame")},
        {"frame": _FRAME["frame"], "terrain": "DEM file, datum, geoid grid, lowest and highest terrain"},
    ),
    "image": Stage(
        {
            "image": Variable(
                ("y", "x"), "complex64", "1", "focused image with carrier phase, as echo amplitude; NaN: not formed"
            )
        },
        {**_FRAME, "quality": "engine, models, errors and measures, as in image.json"},
    ),
    "cube": Stage(
        {name: row for name, row in _CUBE.items() if name not in SUMMED},
        {
            "fusion": "flight → pairs of the coherent sum, phase removed from each; excluded pairs with reasons",
            "origins": "flight → hash of the code, grid, images and assessment from which its chunks were computed",
        },
        {name: row for name, row in _CUBE.items() if name in SUMMED},
    ),
}


def check(dataset: "xr.Dataset", stage: str) -> "xr.Dataset":
    """Check a dataset against the contract of `stage` and return it unchanged.

    Parameters
    ----------
    dataset
        Dataset to be checked; dask arrays are not computed.
    stage
        A key of `STAGES`.

    Raises
    ------
    ContractError
        If variables or attributes are missing, or dimensions or dtypes differ; the message lists all of them.

    Examples
    --------
    >>> import xarray as xr
    >>> check(xr.Dataset(), "image")
    Traceback (most recent call last):
    ...
    apertura.common.errors.ContractError: image: no variable 'image'; no attribute 'frame'; ...
    """
    contract = STAGES[stage]
    wrong = [f"no variable '{name}'" for name in contract.variables if name not in dataset.variables]
    for name, variable in {**contract.variables, **contract.optional}.items():
        if name not in dataset.variables:
            continue
        array = dataset[name]
        if array.dims != variable.dims:
            wrong.append(f"{name} has dims {array.dims}, not {variable.dims}")
        if array.dtype != np.dtype(variable.dtype):
            wrong.append(f"{name} is {array.dtype}, not {variable.dtype}")
    wrong += [f"no attribute '{name}'" for name in contract.attributes if name not in dataset.attrs]
    if wrong:
        raise ContractError(f"{stage}: {'; '.join(wrong)}")
    return dataset
