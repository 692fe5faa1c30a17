"""Speed of light in the atmosphere: refractivity, its mean along paths, and images at that wave speed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.geometry.atmosphere import (
    SCALE_HEIGHT_M,
    Atmosphere,
    refractivity,
    standard_weather,
    wave_speed,
)
from apertura.core.imaging.range_profiles import RangeWindow, range_compress
from apertura.core.scene.terrain import FlatGround
from apertura.formats.phase_histories.phase_history import History, joined

ROOT = Path(__file__).parent.parent
AIR = 1.000282


def test_refractivity_matches_itu_r_p453():
    """Reference: dry term 77.6·1013.25/288.15; vapour term 3.73e5·e/T², with e_s = 17.04 hPa at 15 °C from tables."""
    assert refractivity(15.0, 1013.25, 0.0) == pytest.approx(77.6 * 1013.25 / 288.15, rel=1e-12)
    wet = refractivity(15.0, 1013.25, 100.0) - refractivity(15.0, 1013.25, 0.0)
    assert wet == pytest.approx(3.73e5 * 17.04 / 288.15**2, rel=0.006)  # 0.4 % is the enhancement factor of moist air
    assert refractivity(30.0, 1000.0, 100.0) == pytest.approx(430, abs=3)  # the tropics
    assert standard_weather(5000.0)[:2] == pytest.approx((-17.5, 540.2), abs=0.1)  # ISO 2533


@pytest.mark.parametrize("heights", [(600.0, 610.0), (3000.0, 0.0), (-50.0, 9000.0), (500.0, 500.0)])
def test_mean_refractivity_equals_the_path_integral(heights):
    air = Atmosphere(300.0, 100.0, "a test")
    along = np.linspace(0, 1, 20001)
    profile = 300.0 * np.exp(-(heights[0] + along * (heights[1] - heights[0]) - 100.0) / SCALE_HEIGHT_M)
    exact = ((profile[1:] + profile[:-1]) / 2).mean()
    assert air.mean_n(*heights) == pytest.approx(exact, rel=1e-7)
    assert air.mean_n(*heights[::-1]) == air.mean_n(*heights)


def test_ray_bending_is_below_0_1_mm_up_to_10_km():
    """Fastest path between two points of a layered atmosphere against the straight line, for a sine-shaped sag."""
    air, length = Atmosphere(320.0, 0.0, "a test"), 10_000.0
    x = np.linspace(0, length, 4001)

    def path_m(sag_m):
        height = 100.0 + sag_m * np.sin(np.pi * x / length)
        steps = np.hypot(np.diff(x), np.diff(height))
        return float((steps * (1 + 1e-6 * (air.at_n(height[1:]) + air.at_n(height[:-1])) / 2)).sum())

    times = [path_m(sag) for sag in np.linspace(0, 2, 81)]
    bend = 320e-6 / SCALE_HEIGHT_M
    assert times[0] - min(times) == pytest.approx(bend**2 * length**3 / 24, rel=0.05)
    assert times[0] - min(times) < 1e-4


def test_refractivity_of_a_flight_is_weighted_by_path_length():
    air = Atmosphere.stated(300.0, ground_m=0.0)
    high, low, far, near = (np.full(5, value) for value in (3000.0, 10.0, 5000.0, 100.0))
    flown = air.over(high, low, (far, near))
    exact = (5000 * air.mean_n(3000.0, 0.0) + 100 * air.mean_n(10.0, 0.0)) / 5100
    assert flown.refractivity_n == pytest.approx(float(exact), rel=1e-12)
    assert flown.left_m == pytest.approx(0, abs=1e-12)
    climbing = air.over(np.linspace(900, 1200, 5), np.linspace(900, 1200, 5), (np.full(5, 1500.0),) * 2)
    assert 3e-3 < climbing.left_m < 1.5e-2  # for a path of 3 km
    assert flown.report["vacuum_shift_m"] == pytest.approx(flown.refractivity_n * 1e-6 * 5100 / 2, rel=1e-3)


def test_refractivity_std_covers_10_k_20_hpa_and_any_humidity():
    air = Atmosphere.standard(300.0)
    celsius, hpa, humidity = standard_weather(300.0)
    for change in ((10, 0, 0), (-10, 0, 0), (0, 20, 0), (0, -20, 0)):
        error_n = refractivity(celsius + change[0], hpa + change[1], humidity) - air.refractivity_n
        assert abs(error_n) < air.std_n
    for extreme in (0.0, 100.0):
        assert abs(refractivity(celsius, hpa, extreme) - air.refractivity_n) < 2 * air.std_n
    measured = Atmosphere.of_weather(celsius, hpa, humidity, ground_m=300.0)
    assert measured.refractivity_n == air.refractivity_n
    assert 1 < measured.std_n < air.std_n / 3
    assert Atmosphere.stated(0.0, ground_m=0.0).std_n == 0  # simulated in vacuum
    assert Atmosphere.vacuum().std_n == 300  # vacuum assumed for a real atmosphere
    assert wave_speed(0.0) == SPEED_OF_LIGHT_M_S  # bitwise equal


# ---- Images at the wave speed in air --------------------------------------------------------------------------------

FREQUENCY = 1.2e9 + 2e6 * np.arange(128)
GRID = ap.SceneGrid("local", -6.0, 6.0, 0.25, (48, 48))
TARGET = np.array([[1.25, -0.75, 0.0]])  # corner of a pixel; the pixel centre is half a spacing away


def flight(range_m=600.0, pulses=96):
    along = np.linspace(-range_m / 12, range_m / 12, pulses)
    track = np.stack([along, np.full(pulses, -0.8 * range_m), np.full(pulses, 0.6 * range_m)], -1)
    return ap.Aperture(track, track + [20.0, 3.0, 1.0])


def history(aperture, index, **changes):
    """Return the echo of TARGET through air, from the delays of both one-way paths minus the delay of the origin."""
    origin_s, target_s = (index * aperture.path(place) / SPEED_OF_LIGHT_M_S for place in (0 * TARGET, TARGET))
    delay_s = target_s - origin_s
    echo = np.exp(-2j * np.pi * FREQUENCY * delay_s).astype(np.complex64)
    weight = np.hanning(130)[1:-1] / np.hanning(130).sum()
    return ap.PhaseHistory(echo, FREQUENCY, weight, origin_s[:, 0], aperture, **changes)


def peak_m(image):
    row, column = np.unravel_index(int(np.abs(np.asarray(image)).argmax()), image.shape)
    return float(image.x[column]), float(image.y[row])


@pytest.mark.slow
def test_target_is_at_its_position_only_at_the_speed_in_air():
    aperture, fine = flight(), ap.SceneGrid("local", 0.25, 0.25, 0.02, (100, 100))
    for speed, off_m in ((SPEED_OF_LIGHT_M_S / AIR, 0.0), (SPEED_OF_LIGHT_M_S, 282e-6 * 600 / 0.8)):
        recorded = history(aperture, AIR, wave_speed_m_s=speed)
        x, y = peak_m(ap.backproject(recorded, fine, terrain=0.0, certified_pixels=8).compute())
        assert (x, y) == pytest.approx((1.25, -0.75 + off_m), abs=0.05 * off_m + 0.021)


@pytest.mark.slow
def test_atmosphere_keyword_sets_the_wave_speed():
    """Accepted values: N at the terrain, an Atmosphere, the standard atmosphere, vacuum."""
    aperture, recorded_history = flight(), history(flight(), AIR)
    profiles = range_compress(recorded_history, GRID, FlatGround(0.0))
    height_m = float(aperture.tx_m[:, 2].mean())
    stated = Atmosphere.stated(300.0, ground_m=0.0)
    expected = {wave_speed(float(stated.mean_n(height_m, 0.0))): (300.0, stated), SPEED_OF_LIGHT_M_S: ("vacuum",)}
    expected[wave_speed(float(Atmosphere.standard(0.0).mean_n(height_m, 0.0)))] = ("auto",)
    quick = {"terrain": 0.0, "certified_pixels": 0}
    for speed, same in expected.items():
        for air in same:
            assert ap.backproject(recorded_history, GRID, atmosphere=air, **quick).wave_speed_m_s == pytest.approx(
                speed, abs=10
            )
    by_speed = ap.backproject(recorded_history.at_speed(wave_speed(float(stated.mean_n(height_m, 0.0)))), GRID, **quick)
    for recorded in (recorded_history, profiles):
        image = ap.backproject(recorded, GRID, atmosphere=stated, **quick)
        assert np.abs(image.values - by_speed.values).max() < 2e-3 * np.abs(by_speed.values).max()
    assert np.abs(ap.backproject(recorded_history, GRID, **quick).values - by_speed.values).max() > 0.1
    with pytest.raises(
        CampaignError, match="expected auto, vacuum, an Atmosphere, or the refractivity at the terrain in N units"
    ):
        ap.backproject(recorded_history, GRID, atmosphere="dry")


@pytest.mark.quick("numba", "reference")
@pytest.mark.parametrize("engine", [name for name in ENGINES if name not in {"cuda"}])
def test_image_in_air_equals_image_of_scaled_geometry_in_vacuum(engine):
    """Equation 4 of docs/theory/atmosphere.md holds at every pixel, for every engine and for the double sum.

    No certificate is computed, because it would replace an engine whose error is too large.
    """
    if not load_engine(engine).available():
        pytest.skip("cannot run here")
    aperture = flight()
    larger = ap.Aperture(*(AIR * leg for leg in aperture.legs))
    grid = replace(GRID, west_m=AIR * GRID.west_m, north_m=AIR * GRID.north_m, spacing_m=AIR * GRID.spacing_m)
    in_air = history(aperture, AIR, wave_speed_m_s=SPEED_OF_LIGHT_M_S / AIR)
    vacuum = replace(in_air, aperture=larger, wave_speed_m_s=SPEED_OF_LIGHT_M_S)
    images = [
        np.asarray(ap.backproject(recorded, on, terrain=0.0, engine=engine, integration="all", certified_pixels=0))
        for recorded, on in ((in_air, GRID), (vacuum, grid))
    ]
    exact = np.asarray(ap.backproject(in_air, GRID, terrain=0.0, engine="reference", integration="all"))
    assert np.abs(images[0] - images[1]).max() < 1e-3 * np.abs(exact).max()
    assert np.abs(images[0] - exact).max() < 2e-3 * np.abs(exact).max()


def test_profiles_keep_the_wave_speed_and_it_is_at_most_c():
    aperture = flight()
    recorded = history(aperture, AIR, wave_speed_m_s=SPEED_OF_LIGHT_M_S / AIR)
    profiles = range_compress(recorded, GRID, FlatGround(0.0))
    assert profiles.wave_speed_m_s == recorded.wave_speed_m_s
    assert profiles.bandwidth_hz == pytest.approx(256e6)
    assert profiles.wavelength_m * profiles.wavenumber_rad_m == pytest.approx(2 * np.pi)
    window = RangeWindow.of(aperture, GRID, FlatGround(0.0), FREQUENCY, wave_speed_m_s=SPEED_OF_LIGHT_M_S)
    with pytest.raises(ValueError, match="the wave speed of the history"):
        range_compress(recorded, GRID, FlatGround(0.0), window=window)
    for speed in (SPEED_OF_LIGHT_M_S * 1.0001, 1.0):
        with pytest.raises(ValueError, match="wave_speed_m_s"):
            replace(recorded, wave_speed_m_s=speed)


def test_extra_path_delays_echoes_at_the_speed_in_air():
    aperture, extra_path_m = flight(), np.full(96, 1.7)
    recorded = history(aperture, AIR, wave_speed_m_s=SPEED_OF_LIGHT_M_S / AIR)
    longer_s = recorded.moved(aperture, extra_path_m).reference_delay_s - recorded.reference_delay_s
    np.testing.assert_allclose(longer_s, 1.7 * AIR / SPEED_OF_LIGHT_M_S, rtol=1e-12)


def test_joined_histories_have_the_speed_in_vacuum_by_default(tmp_path):
    place = np.ones((3, 3))
    one = History(
        tmp_path / "a", np.arange(3).astype("datetime64[ns]"), place, place, np.ones((3, 4), np.complex64),
        1e9 + 1e6 * np.arange(4), np.zeros(3), np.full(3, np.inf), np.ones(3, bool), "local", reference="point",
    )  # fmt: skip
    echo = joined([one], pair="a-a", expected="a test")
    assert (echo.attrs["wave_speed_m_s"], echo.attrs["reference"]) == (SPEED_OF_LIGHT_M_S, "point")


# ---- Uses of the speed in vacuum ------------------------------------------------------------------------------------

_SIZE = "sizes of cells, searches, windows or grids, and limits of checks: 0.03 % is negligible"
_POWER = "wavelength of the radar equation: 0.003 dB"
_DRAWN = "plots and listings"
_ELECTRICAL = "electrical paths: cables, delays given as c times seconds"
_DEFAULT = "default for arrays without a stated speed"
_FORMAT = "delays that a file states as a distance, or unconverted delays for in_air"

VACUUM = {
    "common/constants.py": "the constant",
    "core/geometry/atmosphere.py": "v = c/n",
    "core/geometry/aperture.py": _SIZE,
    "core/scene/auto_grid.py": _SIZE,
    "core/planning/plan.py": _SIZE,
    "core/planning/planner.py": _SIZE,
    "core/backprojection/presum.py": _SIZE,
    "core/backprojection/inputs.py": _DEFAULT,
    "core/backprojection/job.py": _DEFAULT,
    "core/imaging/radiometry.py": _POWER,
    "core/imaging/resolution.py": _SIZE,
    "core/imaging/reflectors.py": "wavelength of a cross-section: 0.003 dB",
    "core/imaging/job.py": f"{_DEFAULT}; {_SIZE}",
    "core/imaging/judgement.py": "comparison with the speed in vacuum, so that the budget contains the effect of air",
    "core/echo/compression.py": _DEFAULT,
    "core/echo/calibration.py": _ELECTRICAL,
    "core/echo/dechirp.py": _ELECTRICAL,
    "core/echo/transfer.py": _ELECTRICAL,
    "methods/autofocus/evidence.py": _SIZE,
    "methods/autofocus/patches.py": _SIZE,
    "methods/autofocus/path_offsets.py": _SIZE,
    "methods/autofocus/refine.py": _SIZE,
    "methods/autofocus/ground_coherence.py": _SIZE,
    "methods/bench/links.py": _ELECTRICAL,
    "methods/alignment/on_point.py": _ELECTRICAL,
    "methods/interferometry/sensitivity.py": "radians per metre of height, to 0.03 %",
    "formats/phase_histories/afrl.py": _FORMAT,
    "formats/phase_histories/cphd.py": _FORMAT,
    "formats/phase_histories/phase_history.py": _FORMAT,
    "formats/phase_histories/fmcw.py": _FORMAT,
    "formats/phase_histories/pulson.py": _FORMAT,
    "formats/export/cphd.py": "reference of TDTropoSRP",
    "simulation/scatterers.py": "delay of an optical path",
    "simulation/fmcw.py": "simulates vacuum, and configures vacuum in the campaign",
    "simulation/gridding.py": "same as the plain sum of simulation/scatterers.py, for arrays in vacuum",
    "simulation/observation.py": _POWER,
    "simulation/synthesis.py": "excess path of reflections of the sidelink",
    "check/reach.py": _SIZE,
    "workflow/resources.py": _SIZE,
    "check/facts.py": _DRAWN,
    "stages/hypotheses.py": _SIZE,
    "stages/refine.py": _SIZE,
    "stages/echo.py": _ELECTRICAL,
    "stages/image_tags.py": "wavelength written next to the frequency",
    "stages/transfer.py": _ELECTRICAL,
    "tools/align.py": _ELECTRICAL,
    "tools/init/contents.py": _SIZE,
    "stages/node_log.py": _SIZE,
    "stages/radiometry.py": _POWER,
    "tools/design/planned_tracks.py": _ELECTRICAL,
    "tools/reflectors.py": "residual phase of a position error, to 0.03 %",
    "stages/calibration.py": _ELECTRICAL,
    "tools/design/view.py": _DRAWN,
    "views/inspect/pictures.py": _DRAWN,
    "views/report/step.py": _SIZE,
}
"""Modules that use the speed of light in vacuum, with reasons: delays are converted at the speed of their arrays."""


def test_uses_of_the_speed_of_light_in_vacuum_are_listed():
    source = ROOT / "src/apertura"
    users = {
        path.relative_to(source).as_posix()
        for path in source.rglob("*.py")
        if "SPEED_OF_LIGHT_M_S" in path.read_text(encoding="utf-8")
    }
    assert users == set(VACUUM), "read docs/theory/atmosphere.md, Wave speed of a pair"
    for path in (source / "core/backprojection/engines").rglob("*.py"):
        assert "SPEED_OF_LIGHT_M_S" not in path.read_text(encoding="utf-8"), path
