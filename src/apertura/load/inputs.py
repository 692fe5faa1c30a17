"""Stages as what the engines are given: plain arrays, without files."""

import xarray as xr

from apertura.echo.compression import window_weights
from apertura.focus.inputs import Profiles, Spectra


def spectra_of(echo: xr.Dataset, window: str) -> Spectra:
    """Return the transfer functions of an echo stage as arrays, weighted by a window over the subcarriers."""
    return Spectra(
        echo.transfer.values,
        echo.frequency.values,
        window_weights(window, len(echo.subcarrier)),
        echo.reference_delay.values,
        echo.tx_position.values,
        echo.rx_position.values,
    )


def profiles_of(profile: xr.Dataset) -> Profiles:
    """Return a profile stage as arrays."""
    return Profiles(
        profile.profile.values,
        profile.start.values,
        profile.attrs["step_m"],
        profile.attrs["centre_frequency_hz"],
        profile.attrs["oversampling"],
        profile.tx_position.values,
        profile.rx_position.values,
    )
