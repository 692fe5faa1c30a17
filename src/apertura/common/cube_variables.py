"""What stage `cube` holds, a row each: name → dimensions, dtype, unit, meaning; see `contracts`."""

_RASTERS, _SUMS, _IMAGES = ("flight", "pair", "y", "x"), ("flight", "y", "x"), ("flight", "pair")

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
    "coherent_noise_floor": (("flight",), "float64", "dB", "median power of the coherent sum against its peak"),
    "clutter_reduction": (("flight",), "float64", "dB", "clutter of the images over that of their coherent sum"),
}
"""Known when the rasters are written."""

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
"""What each image says of itself; NaN where it does not."""

COORDINATES: dict[str, Row] = {
    "flight": (("flight",), "T", "", "name of the flight"),
    "pair": (("pair",), "T", "", "transmitter-receiver"),
    "time": (("flight",), "datetime64[ns]", "", "UTC of the middle of the flight"),
    "reference_pair": (("flight",), "T", "", "pair that the flight's others are compared with"),
    "reference_flight": (("pair",), "T", "", "flight that the pair is compared with in others"),
}
