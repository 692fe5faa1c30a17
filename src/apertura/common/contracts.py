"""Contracts of the stages: dimensions, dtype and unit of every variable, and required attributes."""

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
"""Standard name of σ⁰ in CF (Standard Name Table, https://cfconventions.org); γ⁰ and β⁰ have none."""

STANDARD_NAMES = {"incidence": "angle_of_incidence", "centre_frequency": "sensor_band_central_radiation_frequency"}
"""Variable of the cube → its standard name in CF; the others have none that means what they hold."""

Row = tuple[tuple[str, ...], str, str, str]

RASTERS: dict[str, Row] = {
    "image": (_RASTERS, "complex64", "1", "echo amplitude of every image; NaN: not flown, not formed"),
    "coherent": (_SUMS, "complex64", "1", "mean of the peak-normalised images"),
    "noncoherent": (_SUMS, "float32", "1", "mean power of the peak-normalised images"),
    "magnitude": (_SUMS, "float32", "1", "mean magnitude of the peak-normalised images"),
    "pair_coherence": (_RASTERS, "float32", "1", "coherence with the flight's reference pair"),
    "pair_phase": (_RASTERS, "float32", "rad", "phase less that of the flight's reference pair"),
    "flight_coherence": (_RASTERS, "float32", "1", "coherence with the pair's reference flight"),
    "flight_phase": (_RASTERS, "float32", "rad", "phase less that of the pair's reference flight"),
}
"""Written tile by tile."""

_OF_COHERENCE = {
    "looks": "independent samples in a window of",
    "chance": "what images with nothing in common have for",
    "common_band": "most that unchanged ground can show, by geometry, of",
}

MEASURED: dict[str, Row] = {
    **{
        f"{kind}_{name}": (_IMAGES, "float64", "1", f"{meaning} {kind}_coherence")
        for kind in ("pair", "flight")
        for name, meaning in _OF_COHERENCE.items()
    },
    "coherent_noise_floor": (_FLIGHTS, "float64", "dB", "median power of the coherent sum against its peak"),
    "clutter_reduction": (_FLIGHTS, "float64", "dB", "clutter of the images over that of their coherent sum"),
}
"""Known when the rasters are written."""

SUMMED = frozenset(name for name, row in (*RASTERS.items(), *MEASURED.items()) if row[0] in {_SUMS, _FLIGHTS})
"""Of these, what exists where a flight has two pairs to add up; NaN of flights of one pair."""

QUOTED: dict[str, Row] = {
    "heading": (_IMAGES, "float64", "degree", "direction of flight, clockwise from grid north"),
    "look_direction": (_IMAGES, "float64", "degree", "direction to the scene's middle, clockwise from grid north"),
    "incidence": (_IMAGES, "float64", "degree", "incidence of the transmitter at the scene's middle"),
    "bistatic_angle": (_IMAGES, "float64", "degree", "angle between the ways to both antennas"),
    "range": (_IMAGES, "float64", "m", "half the total path to the scene's middle, at closest approach"),
    "height": (_IMAGES, "float64", "m", "height of the antennas' midpoint above the scene's middle"),
    "centre_frequency": (_IMAGES, "float64", "Hz", "frequency at the middle of the band"),
    "bandwidth": (_IMAGES, "float64", "Hz", "bandwidth of the echo"),
    "resolution_cell": (_IMAGES, "float64", "m", "finest resolution cell along rows or columns"),
    "loss": (_IMAGES, "float64", "dB", "loss of the peak to phase errors, measured on the image"),
    "numerical_error": (_IMAGES, "float64", "dB", "error of the arithmetic, at most, against the image's rms"),
    "entropy": (_IMAGES, "float64", "1", "entropy of the image's power, nats"),
    "noise_floor": (_IMAGES, "float64", "dB", "median power of the image against its peak"),
    "pulses_used": (_IMAGES, "float64", "1", "pulses that make the image"),
    "pulses_dropped": (_IMAGES, "float64", "1", "pulses that were left out"),
    "peak": (_IMAGES, "float64", "1", "largest magnitude, which the image is divided by in sums"),
    "phase_removed": (_IMAGES, "float64", "rad", "phase taken off before the coherent sum; NaN: not in it"),
    "verdict": (_IMAGES, "T", "", "focus: focused, defocused or cannot tell; empty: not flown"),
    "flags": (_IMAGES, "T", "", "names of the image's flags, with commas between"),
}
"""Quality of each image; NaN where not measured."""

COORDINATES: dict[str, Row] = {
    "flight": (("flight",), "T", "", "name of the flight"),
    "pair": (("pair",), "T", "", "transmitter-receiver"),
    "time": (("flight",), "datetime64[ns]", "", "UTC of the middle of the flight"),
    "reference_pair": (("flight",), "T", "", "pair that the flight's others are compared with"),
    "reference_flight": (("pair",), "T", "", "flight that the pair is compared with in others"),
}


# ---- Contracts of all stages ----------------------------------------------------------------------------------------
#
# Stages are nouns and data flows one way: raw → echo → profile → image → cube → files; `track` joins at echo. `check`
# refuses a dataset that breaks its contract.

Window = tuple[slice, slice]
"""Rows and columns of a part of an image."""


@dataclass(frozen=True)
class Variable:
    """One array of a stage."""

    dims: tuple[str, ...]
    dtype: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class Stage:
    """Contract of a stage: its arrays, required attributes, and optional arrays."""

    variables: Mapping[str, Variable]
    attributes: Mapping[str, str]
    optional: Mapping[str, Variable] = field(default_factory=dict)


_PULSE_GEOMETRY = {
    "time": Variable(("pulse",), "datetime64[ns]", "", "UTC time tag of the pulse, transmitter's clock"),
    "tx_position": Variable(("pulse", "axis"), "float64", "m", "transmitting phase centre, in `frame`"),
    "rx_position": Variable(("pulse", "axis"), "float64", "m", "receiving phase centre, in `frame`"),
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
    "frame": "'ecef' (EPSG:4978) or 'local' (the campaign's own Cartesian axes, no place on Earth)",
    "pair": "transmitter-receiver",
    "flags": "edges crossed so far: flag name → what was measured, in one line",
}
_WAVE = {"wave_speed_m_s": "speed of the wave along the paths, m/s: path = wave_speed_m_s · delay"}

STAGES: Mapping[str, Stage] = {
    "raw": Stage(
        {
            "start": Variable(("pulse",), "int64", "1", "first sample of the capture in the recorder's file"),
            "time": Variable(("pulse",), "datetime64[ns]", "", "UTC time tag of the capture, node's own clock"),
            "frame": Variable(("pulse",), "int64", "1", "frame number sent in the payload, -1 without"),
            "repeats": Variable(("pulse",), "bool", "1", "whether the capture repeats an earlier one bit for bit"),
        },
        {
            "node": "node name",
            "samples": "the recorder's file, relative to the campaign folder: channels interleaved per sample",
            "channels": "names of the channels",
            "capture_samples": "samples of each capture",
            "sample_rate_hz": "complex samples per second",
            "datatype": "of the numbers in the file, as SigMF names it",
            "trailing_bytes": "at the end of the file that are no samples",
            "mixing": "of real samples: if_hz, sample_rate_hz, restarts; null: they are complex",
        },
        {
            "segment_start": Variable(("segment",), "int64", "1", "first samples behind bytes that are no samples"),
            "segment_skipped": Variable(("segment",), "int64", "1", "how many such bytes the file holds before each"),
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
            "dropped": "epochs of the log that were left out: reason → how many",
        },
        {
            "position_std": Variable(
                ("epoch", "axis"), "float64", "m", "what the log states of its error: north, east, up; NaN where none"
            ),
            "fix": Variable(("epoch",), "int8", "1", "solution, RTKLIB's Q: 1 fix, 2 float …; 0 where not logged"),
        },
    ),
    "echo": Stage(
        {
            **_PULSE_GEOMETRY,
            **_FREQUENCY,
            "reference_delay": Variable(("pulse",), "float64", "s", "τ_ref, already removed from `transfer`"),
            "path_limit": Variable(("pulse",), "float64", "m", "total path beyond which an echo leaves the prefix"),
        },
        _FRAME | _WAVE,
        {
            **_TRANSFER,
            "capture": Variable(("pulse",), "int64", "1", "capture of the receiver's recording that `transfer` is of"),
            "path_removed": Variable(
                ("pulse",), "float64", "m", "electrical path beyond that by the scene, already removed from `transfer`"
            ),
            "clock_offset": Variable(
                ("pulse",), "float64", "Hz", "carrier offset of the receiver, already removed from its samples"
            ),
            "sidelink_delay": Variable(
                ("pulse",), "float64", "m", "measured delay of the sidelink times c, any constant in it; NaN: no lock"
            ),
            "sidelink_snr": Variable(("pulse",), "float64", "dB", "of the sidelink per subcarrier; NaN: no lock"),
            "sidelink_phase": Variable(("pulse",), "float64", "rad", "of the sidelink at mid-band; NaN: no lock"),
            "sidelink_amplitude": Variable(
                ("pulse",), "float64", "1", "of the sidelink per subcarrier, ADC counts; NaN: no lock"
            ),
            "sidelink_vector": Variable(
                ("pulse", "axis"), "float64", "m", "receiver's sidelink point to transmitter's"
            ),
        }
        | {
            f"{leg}_axes": Variable(
                ("pulse", "axis", "body"), "float64", "1", f"forward, right, down of the {node}'s body, in `frame`"
            )
            for leg, node in (("tx", "transmitter"), ("rx", "receiver"))
        },
    ),
    "transfer": Stage({"time": _PULSE_GEOMETRY["time"], **_FREQUENCY, **_TRANSFER}, _FRAME),
    "profile": Stage(
        {
            **_PULSE_GEOMETRY,
            "profile": Variable(
                ("pulse", "range"), "complex64", "1", "range profile; times exp(+j2πf_mid·path/c) it is in phase"
            ),
            "start": Variable(("pulse",), "float64", "m", "total path (tx → scene → rx) of range sample 0"),
        },
        {
            **_FRAME,
            **_WAVE,
            "background": "echoes at constant delay: method requested, removed, and why",
            "interference": "subcarriers with interference: how many, where, excluded or not",
            "step_m": "total path between range samples, m",
            "centre_frequency_hz": "f_mid, to which the profile is referenced, Hz",
            "oversampling": "samples per resolution cell c/B of total path",
            "window": "weighting over the subcarriers",
            "compression_error_db": "RMS error against the sum over the subcarriers, measured at some samples, dB",
        },
        {
            "background": Variable(
                ("background_knot", "subcarrier"),
                "complex64",
                "1",
                "removed, in delays of the recorder",
            ),
            "subcarrier_gain": Variable(
                ("subcarrier",), "float32", "1", "factor of `transfer`: 0 where interference is excluded"
            ),
            "background_time": Variable(("background_knot",), "float64", "s", "of its knots, from the first pulse"),
        },
    ),
    "refined_track": Stage(
        {
            "time": Variable(("knot",), "datetime64[ns]", "", "UTC, transmitter's clock; between knots linear"),
            "further": Variable(
                ("pair", "knot"), "float64", "m", "total path by which all echoes of the pair lie further, to be added"
            ),
            "correction": Variable(_KNOTS, "float64", "m", "to be added to every point of the node, in `frame`"),
            "std": Variable(_KNOTS, "float64", "m", "standard deviation of what is left, along each axis of `frame`"),
            "position": Variable(_KNOTS, "float64", "m", "radar phase centre as the log has it, in `frame`"),
        },
        {
            "frame": _FRAME["frame"],
            "flags": "edges crossed by the refinement: flag name → what was measured, in one line",
            "nodes": "names along `node`",
            "pairs": "names along `pair`: those that have an offset of their own, or none",
            "decisions": "autofocus, and autofocus_method where it is on: value and reason",
            "accepted": "whether images are formed with the correction; why: a line; report: what was measured",
            "left": "what is left of errors of position does to an image: loss_db, shift_m, phase_rad",
        },
    ),
    "terrain": Stage(
        {"height": Variable(("y", "x"), "float64", "m", "ground at the pixel: above the ellipsoid, or z of the frame")},
        {"frame": _FRAME["frame"], "terrain": "the DEM: file, datum, geoid grid, lowest and highest ground"},
    ),
    "image": Stage(
        {
            "image": Variable(
                ("y", "x"), "complex64", "1", "focused scene, carrier kept; 1 is the echo's amplitude; NaN: not formed"
            )
        },
        {**_FRAME, "quality": "engine, models, errors and measures, as in image.json"},
    ),
    "cube": Stage(
        {name: row for name, row in _CUBE.items() if name not in SUMMED},
        {
            "fusion": "flight → pairs of the coherent sum with the phase taken off each, pairs left out and why",
            "coherence_window": "pixels along a side of the window that coherence is measured in",
        },
        {name: row for name, row in _CUBE.items() if name in SUMMED},
    ),
}


def check(dataset: "xr.Dataset", stage: str) -> "xr.Dataset":
    """Return `dataset` unchanged if it keeps the contract of `stage`.

    Parameters
    ----------
    dataset
        Arrays and attributes to be passed on; dask arrays are not computed.
    stage
        A key of `STAGES`.

    Raises
    ------
    ContractError
        Listing every variable or attribute that is missing or has other dimensions or dtype.

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
    for name, promise in {**contract.variables, **contract.optional}.items():
        if name not in dataset.variables:
            continue
        array = dataset[name]
        if array.dims != promise.dims:
            wrong.append(f"{name} has dims {array.dims}, not {promise.dims}")
        if array.dtype != np.dtype(promise.dtype):
            wrong.append(f"{name} is {array.dtype}, not {promise.dtype}")
    wrong += [f"no attribute '{name}'" for name in contract.attributes if name not in dataset.attrs]
    if wrong:
        raise ContractError(f"{stage}: {'; '.join(wrong)}")
    return dataset
