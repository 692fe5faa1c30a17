"""Stages as what the engines are given: plain arrays, without files."""

import xarray as xr

from apertura.echo.compression import window_weights
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.geometry.aperture import Aperture


def phase_history_of(echo: xr.Dataset, window: str) -> PhaseHistory:
    """Return the transfer functions of an echo stage as arrays, weighted by a window over the subcarriers."""
    return PhaseHistory(
        echo.transfer.values,
        echo.frequency.values,
        window_weights(window, len(echo.subcarrier)),
        echo.reference_delay.values,
        aperture_of(echo),
    )


def profiles_of(profile: xr.Dataset) -> Profiles:
    """Return a profile stage as arrays."""
    return Profiles(
        profile.profile.values,
        profile.start.values,
        profile.attrs["step_m"],
        profile.attrs["centre_frequency_hz"],
        profile.attrs["oversampling"],
        aperture_of(profile),
    )


def aperture_of(stage: xr.Dataset) -> Aperture:
    """Return the phase centres of an echo or profile stage."""
    return Aperture(stage.tx_position.values, stage.rx_position.values)


def inputs_of(given: PhaseHistory | Profiles | xr.Dataset, window: str = "hann") -> PhaseHistory | Profiles:
    """Return what an engine reads: arrays as they are, or those of a stage `echo` or `profile`.

    Raises
    ------
    TypeError
        If a dataset is another stage.
    """
    if isinstance(given, PhaseHistory | Profiles):
        return given
    if "transfer" in given:
        return phase_history_of(given, window)
    if "profile" in given:
        return profiles_of(given)
    raise TypeError(f"a dataset with {sorted(map(str, given.variables))}: must be a stage echo or profile")
