"""Compiled engine at the limits of its envelope; benchmarks/envelope.csv covers the whole envelope."""

import numpy as np
import pytest
from scenes import ecef, error_db, fly, pixel_grid, scatter

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import native

pytestmark = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")


@pytest.mark.parametrize("range_m", [30, 10_000])
@pytest.mark.parametrize(
    ("carrier_hz", "spacing_m"), [(0.4e9, C / 0.4e9 / 8), (0.4e9, 1.0), (10e9, C / 10e9 / 8), (10e9, 0.1), (10e9, 1.0)]
)
def test_error_stays_below_60_db_with_aperture_as_long_as_range(range_m, carrier_hz, spacing_m):
    pixels = pixel_grid(20, 20, spacing_m=spacing_m, range_m=range_m)
    scene = fly(scatter(pixels), pulses=24, carrier_hz=carrier_hz, range_m=range_m)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -60
    assert counts[3] == 0  # no pulse was skipped
