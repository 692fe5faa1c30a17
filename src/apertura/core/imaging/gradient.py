"""Gradient of a user-defined image objective with respect to phase centres and paths."""

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import Gradient, path_gradient
from apertura.core.backprojection.inputs import Profiles
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain, ground_of

if TYPE_CHECKING:
    import xarray as xr


def gradient(
    profiles: "Profiles | xr.Dataset",
    grid: SceneGrid,
    dj_dimage: NDArray[np.complexfloating[Any, Any]],
    *,
    terrain: Terrain | float | None = None,
    beams: Beams | None = None,
) -> Gradient:
    """Compute the gradient of a real image objective J with respect to the phase centres and the path of each pulse.

    Parameters
    ----------
    profiles
        Range profiles, oversampled by at least 2, or the dataset of a campaign's stage `profile`.
    grid
        Pixels of the image, often only a patch of a grid, such as ``grid[40:60, 10:30]``.
    dj_dimage
        (y, x) complex, derivative G, defined by J(I + dI) = J(I) + Re Σ conj(G)·dI, that is, ∂J/∂Re I + j·∂J/∂Im I. For
        J = Σ|I|⁴, G is 4|I|²·I. PyTorch's gradient of a complex tensor is G; JAX's gradient is the conjugate of G. The
        image I is the result of `backproject` with integration='all': it has the carrier phase and is divided by the
        number of pulses.
    terrain
        As for `backproject`.
    beams
        As for `backproject`. The dependence of a pulse's weight on its phase centres is neglected.

    Returns
    -------
    Gradient
        `tx_m` and `rx_m`, (pulse, 3), and `path_m`, (pulse,), in the unit of J per metre. `path_m` is the derivative
        with respect to an extra path common to all echoes of a pulse (`Profiles.moved`).

    Raises
    ------
    CampaignError
        If `profiles` are not range profiles (`range_compress` computes them from a phase history), if the shape of
        `dj_dimage` differs from that of the grid, or if no terrain is given for a georeferenced grid.
    ValueError
        If `dj_dimage` or a position on the terrain is not finite.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 6 to 8: the exact derivative of the interpolated, rotated and summed samples.
    Finite differences of images formed by `backproject` agree with the gradient within the error of the engine.

    Examples
    --------
    Sharpness J = Σ|I|⁴, with a logged receiver position that is 2 cm too high at one pulse:

    >>> import apertura as ap
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> true = ap.Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * true.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> logged = ap.Aperture(track, track + 0.02 * np.eye(128)[64][:, None] * [0, 0, 1])
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), logged)
    >>> grid = ap.SceneGrid("local", -2.0, 2.0, 0.1, (40, 40))
    >>> image = ap.backproject(history, grid).values
    >>> profiles = ap.range_compress(history, grid, ap.FlatGround(0.0))
    >>> derivatives = ap.gradient(profiles, grid, 4 * np.abs(image) ** 2 * image)
    >>> int(np.abs(derivatives.rx_m[:, 2]).argmax()), bool(derivatives.rx_m[64, 2] < 0), derivatives.path_m.shape
    (64, True, (128,))
    """
    ground = ground_of(terrain, grid)
    if "profile" in getattr(profiles, "data_vars", ()):
        profiles = profiles_of(cast("xr.Dataset", profiles), lazy=True)
    if not isinstance(profiles, Profiles):
        found = f"an object of type {type(profiles).__name__}"
        expected = "Profiles, or the dataset of stage profile"
        raise CampaignError(found, "profiles", expected, "Compute profiles from a phase history by range_compress.")
    try:
        slope = np.asarray(dj_dimage, np.complex128)
    except (TypeError, ValueError):
        slope = np.empty(0, np.complex128)
    if slope.shape != grid.shape:
        found = f"shape {slope.shape}" if slope.size else f"an object of type {type(dj_dimage).__name__}"
        expected = f"a complex array of the grid's shape, {grid.shape}"
        remedy = "Differentiate the objective with respect to every pixel of this grid."
        raise CampaignError(found, "dj_dimage", expected, remedy)
    places_m = ground.positions(grid).reshape(-1, 3)
    return path_gradient(profiles, places_m, slope.ravel() / len(profiles), beams=beams)
