"""What a coherent sum does to what is not a target."""

from collections.abc import Sequence

import numpy as np


def clutter_reduction_db(single_db: Sequence[float], coherent_db: float) -> float:
    """Return by how much clutter lies lower, against the peak, in a coherent sum than in its images.

    Parameters
    ----------
    single_db
        (pair,) clutter of each image of the sum: its median power over its peak power, dB.
    coherent_db
        The same of the sum.

    Returns
    -------
    float
        dB; 10 lg of the number of images where the targets add in phase and the clutter does not, 0 where the images
        show one thing, less where targets do not add in phase.

    Raises
    ------
    ValueError
        If there is no image.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 3.

    Examples
    --------
    >>> round(clutter_reduction_db([-40.0, -40.0], -43.01), 2)
    3.01
    """
    if not single_db:
        raise ValueError("no image: a sum of nothing reduces nothing")
    return float(10 * np.log10(np.mean(10 ** (np.asarray(single_db) / 10))) - coherent_db)
