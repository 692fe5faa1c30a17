"""Extraction of beat signals from MATLAB and WAV files; run by `read_isolated`, with minimal imports."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.phase_histories.mat_fields import read_variables


def read_beat_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read variable beat (sweep, sample), and time if present.

    Parameters
    ----------
    path
        MATLAB file, version 4 to 7.3.

    Raises
    ------
    ValueError
        If the file does not contain variable beat.
    """
    variables = read_variables(path, ["beat", "time"])
    if "beat" not in variables:
        raise ValueError("no variable beat")
    fields = {name: np.asarray(values) for name, values in variables.items()}
    return {name: np.atleast_1d(values) if name == "time" else np.atleast_2d(values) for name, values in fields.items()}


def read_wav(path: Path) -> dict[str, NDArray[Any]]:
    """Read rate (1,) float64 Hz and samples (sample, channel) in their original type.

    Parameters
    ----------
    path
        WAV file.

    Raises
    ------
    ValueError
        If the file is shorter than stated in its header, or is not a WAV file.
    """
    from scipy.io import wavfile

    with warnings.catch_warnings():
        warnings.simplefilter("error", wavfile.WavFileWarning)  # scipy only warns about a truncated file
        warnings.filterwarnings("ignore", message="Chunk .* not understood", category=wavfile.WavFileWarning)
        rate, samples = wavfile.read(path)
    return {"rate": np.array([rate], np.float64), "samples": samples.reshape(len(samples), -1)}
