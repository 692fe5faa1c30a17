"""From captured symbols to range profiles: phases match the predictions from delays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried
from scipy.signal.windows import hann

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.echo.compression import centre_frequency, compress, range_step, window_weights
from apertura.core.echo.demodulate import Numerology, demodulate, remove_path, subcarrier_numbers
from apertura.core.geometry.geodesy import (
    ecef_from_geodetic,
    ecef_from_projected,
    geodetic_from_ecef,
    ned_axes,
    projected_from_ecef,
)
from apertura.core.geometry.lever_arms import phase_centres

RATE, SPACING, COUNT, PREFIX = 64e6, 1e6, 32, 16


def symbol(delay_s, codes, numbers, carrier=1e9):
    """Return the samples of a delayed symbol at the receiver from the definition (eq. 1 of the theory)."""
    time = np.arange(PREFIX + 80) / RATE - delay_s
    inside = (time >= 0) & (time < PREFIX / RATE + 1.25 / SPACING)
    waves = np.exp(2j * np.pi * numbers * SPACING * (time[:, None] - PREFIX / RATE))
    signal = inside * (waves @ codes) * np.exp(-2j * np.pi * carrier * delay_s)
    return signal[None] * 200


@pytest.mark.parametrize("carrier_is", ["band_start", "band_centre"])
@pytest.mark.parametrize("delay_samples", [0.0, 3.3, 15.9])
def test_echo_rotates_every_subcarrier_by_its_delay(carrier_is, delay_samples):
    numbers = subcarrier_numbers(COUNT, carrier_is=carrier_is)
    codes = np.exp(2j * np.pi * np.random.default_rng(1).random(COUNT))
    delay = delay_samples / RATE
    captured = np.round(symbol(delay, codes, numbers) * 3).astype(np.complex64)
    transfer = demodulate(captured, Numerology(1e9, RATE, numbers, PREFIX, 64))[0] / codes / 600
    expected = np.exp(-2j * np.pi * (1e9 + numbers * SPACING) * delay)
    np.testing.assert_allclose(transfer, expected, atol=2e-3)


def test_echo_beyond_the_prefix_is_no_pure_delay():
    numbers, codes = subcarrier_numbers(COUNT, carrier_is="band_start"), np.ones(COUNT, complex)
    late = symbol(30 / RATE, codes, numbers).astype(np.complex64)
    transfer = demodulate(late, Numerology(1e9, RATE, numbers, PREFIX, 64))[0] / 200
    assert np.abs(np.abs(transfer) - 1).max() > 0.1


def test_dft_needs_prefix_and_one_period():
    with pytest.raises(ValueError, match="must have at least 80"):
        demodulate(np.ones((1, 79), np.complex64), Numerology(1e9, RATE, np.arange(4), 16, 64))


def band():
    return 1.2e9 + 400e3 * np.arange(512)


def echo_of(paths, frequency):
    return sum(np.exp(-2j * np.pi * frequency * path / SPEED_OF_LIGHT_M_S) for path in paths)[None].astype(np.complex64)


def test_profile_peaks_at_the_path_with_the_centre_phase():
    frequency = band()
    step, _ = range_step(frequency, oversampling=2)
    start = 30.0
    profile = compress(
        echo_of([start + 50 * step], frequency),
        frequency,
        weight=window_weights("hann", 512),
        reference_delay_s=np.zeros(1),
        start_m=np.array([start]),
        count=100,
    )[0]
    assert np.abs(profile).argmax() == 50
    compensated = profile[50] * np.exp(
        2j * np.pi * centre_frequency(frequency) * (start + 50 * step) / SPEED_OF_LIGHT_M_S
    )
    np.testing.assert_allclose(compensated, 1.0, atol=1e-4)


def test_reference_delay_is_restored():
    """Samples relative to a delay τ_ref give the same absolute profile as samples without a reference."""
    frequency, tau = band(), np.array([137.4 / SPEED_OF_LIGHT_M_S])
    options = {"weight": window_weights("none", 512), "start_m": np.array([140.0]), "count": 64}
    absolute = compress(echo_of([150.0], frequency), frequency, reference_delay_s=np.zeros(1), **options)
    referred = remove_path(echo_of([150.0], frequency), frequency, delay_s=tau)
    np.testing.assert_allclose(
        compress(referred, frequency, reference_delay_s=tau, **options), absolute, atol=2e-4 * np.abs(absolute).max()
    )


@pytest.mark.parametrize("count", [16, 49, 64, 400])
def test_swath_profile_matches_the_complete_sum(count):
    """Decimation to the swath has an error below -110 dB relative to the strongest echo at any position."""
    frequency, generator = band(), np.random.default_rng(3)
    paths = generator.uniform(0, 749, 40)  # everywhere in the unambiguous range
    transfer = np.repeat(echo_of(paths, frequency) + 10 * echo_of([400.0], frequency), 3, axis=0)
    start, weight = np.array([100.0, 333.3, 700.0]), window_weights("none", 512)
    options = {"weight": weight, "reference_delay_s": np.zeros(3), "start_m": start, "count": count}
    step, _ = range_step(frequency, oversampling=2)
    delay = (start[:, None] + step * np.arange(count)) / SPEED_OF_LIGHT_M_S
    waves = np.exp(2j * np.pi * (frequency - centre_frequency(frequency)) * delay[..., None])
    whole = np.einsum("pn,n,prn->pr", transfer, weight, waves)
    assert np.abs(compress(transfer, frequency, **options) - whole).max() < 10 * 10 ** (-110 / 20)


def test_hann_window_lowers_the_sidelobes():
    frequency = band()
    levels = {}
    for window in ("none", "hann"):
        profile = np.abs(
            compress(
                echo_of([100.0], frequency),
                frequency,
                weight=window_weights(window, 512),
                reference_delay_s=np.zeros(1),
                start_m=np.array([100.0]),
                count=512,
                oversampling=8,
            )[0]
        )
        first_null = np.flatnonzero(np.diff(profile) > 0)[0]
        levels[window] = 20 * np.log10(profile[first_null:300].max() / profile[0])
    assert levels["none"] == pytest.approx(-13.3, abs=0.2)
    assert levels["hann"] == pytest.approx(-31.5, abs=0.3)


@pytest.mark.parametrize("count", [3, 64, 1023, 1024])
def test_hann_window_is_symmetric(count):
    """Only this definition agrees with profiles of other programs and closed formulas."""
    expected = hann(count, sym=True)
    np.testing.assert_allclose(window_weights("hann", count), expected / expected.sum(), atol=1e-15)
    periodic = hann(count, sym=False)
    assert np.abs(window_weights("hann", count) - periodic / periodic.sum()).max() > 1e-9


EPOCHS = np.datetime64("2025-05-14T09:30", "ns") + np.arange(20) * np.timedelta64(100, "ms")


def northward(speed=2.0):
    latitude = 48.0 + speed * 0.1 * np.arange(20) / 111_200
    return ecef_from_geodetic(latitude, np.full(20, 9.0), np.full(20, 600.0))


def lever_arm_offset(attitude_deg, lever, attitude_from="log"):
    attitude = np.tile(np.radians(attitude_deg), (20, 1))
    position = northward()
    placed = phase_centres(
        EPOCHS, position, attitude, at=EPOCHS[5:6], lever_arm_m=lever, attitude_from=attitude_from, where="log"
    )
    latitude, longitude, height = (geodetic_from_ecef(placed) - geodetic_from_ecef(position[5:6]))[0]
    return [latitude * 111_200, longitude * 111_320 * np.cos(np.radians(48)), height]


@pytest.mark.parametrize(
    ("attitude", "lever", "north_east_up"),
    [
        ((0, 0, 0), (1, 0, 0), (1, 0, 0)),
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (0, 1, 0), (0, 1, 0)),
        ((0, 0, 0), (0, 0, 1), (0, 0, -1)),
        ((0, 90, 0), (1, 0, 0), (0, 0, 1)),
        ((90, 0, 0), (0, 1, 0), (0, 0, -1)),
        ((90, 0, 90), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_lever_arms_rotate_with_the_body(attitude, lever, north_east_up):
    np.testing.assert_allclose(lever_arm_offset(attitude, lever), north_east_up, atol=5e-3)


def test_course_replaces_yaw_if_configured():
    np.testing.assert_allclose(lever_arm_offset((0, 0, 77), (1, 0, 0), "course"), (1, 0, 0), atol=5e-3)


def test_yaw_is_interpolated_across_north():
    attitude = np.zeros((20, 3))
    attitude[:, 2] = np.radians(np.where(np.arange(20) < 10, 359.0, 1.0))
    placed = phase_centres(
        EPOCHS,
        np.tile(northward()[:1], (20, 1)),
        attitude,
        at=EPOCHS[9:10] + np.timedelta64(50, "ms"),
        lever_arm_m=(10.0, 0.0, 0.0),
        attitude_from="log",
        where="log",
    )
    east = (geodetic_from_ecef(placed) - geodetic_from_ecef(northward()[:1]))[0, 1]
    assert abs(east * 74_500) < 0.01


def test_positions_between_epochs_follow_the_curve():
    """A circle sampled at 10 Hz: linear interpolation has an error of 1 mm, the spline of less than 0.02 mm."""
    angle = 0.2 * np.arange(20) * 0.1
    circle = np.stack([10 * np.cos(angle), 10 * np.sin(angle), np.zeros(20)], -1)
    at = EPOCHS[8:12] + np.timedelta64(50, "ms")
    placed = phase_centres(
        EPOCHS,
        circle,
        np.full((20, 3), np.nan),
        at=at,
        lever_arm_m=(0.0, 0.0, 0.0),
        attitude_from="none",
        where="log",
    )
    assert np.abs(np.linalg.norm(placed, axis=1) - 10).max() < 2e-5


def test_track_must_cover_the_pulses():
    with pytest.raises(CampaignError, match=r"ends 0\.100 s before the last"):
        phase_centres(
            EPOCHS,
            northward(),
            np.zeros((20, 3)),
            at=EPOCHS[-1:] + np.timedelta64(100, "ms"),
            lever_arm_m=(0.0, 0.0, 0.0),
            attitude_from="log",
            where="log",
        )


@tried(50)
@given(latitude=st.floats(-80, 80), longitude=st.floats(6, 12), height_m=st.floats(-400, 9000))
def test_ecef_conversion_is_invertible_to_a_micrometre(latitude, longitude, height_m):
    """Geodetic coordinates and UTM zone 32, in both directions; up is the direction of increasing height."""
    place = np.array([latitude, longitude, height_m])
    position = ecef_from_geodetic(*place)
    returned = geodetic_from_ecef(position)
    np.testing.assert_allclose(returned * [111_200, 111_200, 1], place * [111_200, 111_200, 1], atol=1e-6)
    projected = projected_from_ecef("EPSG:32632", position)
    np.testing.assert_allclose(ecef_from_projected("EPSG:32632", *projected), position, atol=1e-6)
    higher = ecef_from_geodetic(latitude, longitude, height_m + 1)
    np.testing.assert_allclose(ned_axes(position) @ [0, 0, -1], higher - position, atol=1e-6)


@pytest.mark.parametrize("overrun", [0.02, 0.1, 0.3])
def test_echo_beyond_the_prefix_loses_power_to_noise(overrun):
    """Eq. 5a of docs/theory/focus.md for 512 subcarriers, 20 random codes, one echo of amplitude 1 and no window."""
    count, length, prefix = 512, 1024, 64
    numerology = Numerology(1e9, 1024e6, np.arange(count), prefix_samples=prefix, dft_samples=length)
    codes = np.exp(2j * np.pi * np.random.default_rng(1).random((20, count)))
    period = np.fft.ifft(codes, length, norm="forward")
    late = 2 * round(overrun * count)  # integer resolution cells
    captures = np.zeros((20, prefix + length), np.complex64)
    captures[:, prefix + late :] = np.concatenate([period[:, -prefix:], period], axis=1)[:, : length - late]
    transfer = demodulate(captures, numerology) / codes
    power = np.abs(np.fft.ifft(transfer, axis=1)) ** 2
    cell = round((prefix + late) * count / length)
    assert 10 * np.log10(power[:, cell].mean()) == pytest.approx(20 * np.log10(1 - overrun), abs=0.3)
    rest = np.delete(power, range(cell - 8, cell + 9), axis=1)
    assert 10 * np.log10(rest.mean()) == pytest.approx(10 * np.log10(overrun * (1 - overrun) / count), abs=0.5)
