"""Beat signals in MATLAB and WAV files; run by `read_isolated`, and importing no more than that takes."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.phase_histories.mat_fields import read_variables


def read_beat_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return beat (sweep, sample), and time where there is one.

    Parameters
    ----------
    path
        MATLAB file, version 4 to 7.3.

    Raises
    ------
    ValueError
        If there is no such variable.
    """
    variables = read_variables(path, ["beat", "time"])
    if "beat" not in variables:
        raise ValueError("no variable called beat")
    fields = {name: np.asarray(values) for name, values in variables.items()}
    return {name: np.atleast_1d(values) if name == "time" else np.atleast_2d(values) for name, values in fields.items()}


def read_wav(path: Path) -> dict[str, NDArray[Any]]:
    """Return rate (1,) float64 Hz and samples (sample, channel) as they were written.

    Parameters
    ----------
    path
        WAV file.

    Raises
    ------
    ValueError
        If it ends before the length in its header, or is otherwise no such file.
    """
    from scipy.io import wavfile

    with warnings.catch_warnings():
        warnings.simplefilter("error", wavfile.WavFileWarning)  # a file that was cut off is no more than a warning
        warnings.filterwarnings("ignore", message="Chunk .* not understood", category=wavfile.WavFileWarning)
        rate, samples = wavfile.read(path)
    return {"rate": np.array([rate], np.float64), "samples": samples.reshape(len(samples), -1)}
