"""How much two images can have in common: the share of the ground's spectrum that both have seen."""

import numpy as np
from numpy.typing import NDArray


def common_band(
    carriers: tuple[NDArray[np.float64], NDArray[np.float64]], spectra: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> float:
    """Return the coherence of ground that did not change, seen by two images through bands of Gaussian shape.

    Parameters
    ----------
    carriers
        (2,) float64 each, cycles per metre east and north, the middle of the image's band.
    spectra
        (2, 2) float64 each, cycles² per m², the covariance of that band.

    Returns
    -------
    float
        0 to 1, within 0.09 of what equally wide bands with sharp edges share.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 1a.

    Examples
    --------
    >>> flat = np.eye(2) / 12  # as wide as a band of one cycle per metre
    >>> [round(common_band((np.zeros(2), np.array([apart, 0.0])), (flat, flat)), 2) for apart in (0, 0.2, 0.5, 1)]
    [1.0, 0.89, 0.47, 0.05]
    """
    apart, both = carriers[1] - carriers[0], (spectra[0] + spectra[1]) / 2
    shape = np.linalg.det(spectra[0]) * np.linalg.det(spectra[1]) / np.linalg.det(both) ** 2
    return float(shape**0.25 * np.exp(-apart @ np.linalg.solve(both, apart) / 4))


def window_px(spectrum: NDArray[np.float64], spacing_m: float, *, looks: float = 16, most: int = 65) -> int:
    """Return the side of the smallest window that holds some looks, pixels, odd.

    Parameters
    ----------
    spectrum
        (2, 2) float64, cycles² per m², the covariance of the image's band: of one with sharp edges a look is
        1/(12 √det) m².
    spacing_m
        Between pixels.
    looks
        Independent samples that coherence is measured on.
    most
        A window is not wider than so many pixels.

    Examples
    --------
    >>> window_px(np.eye(2) / 12, 0.25), window_px(np.eye(2) / 12, 2.0)
    (17, 5)
    """
    cells = 12 * np.sqrt(max(np.linalg.det(spectrum), 0.0)) * spacing_m**2  # of one pixel
    side = np.sqrt(looks / min(cells, 1)) if cells > 0 else np.inf
    return int(min(2 * np.ceil((side - 1) / 2) + 1, most))
