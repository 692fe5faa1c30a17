"""Scenes larger than what was recorded: pixels are formed from the pulses whose recordings contain their echoes."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import image_of, quality_of, state
from scenes import compiled, monostatic, plan, straight_track

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.backprojection.engines import load_engine, reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.gate import EDGE_CELLS, RangeGate
from apertura.core.geometry.sector import Sector
from apertura.core.imaging.noise import noise_power
from apertura.core.imaging.radiometry import Calibration
from apertura.core.imaging.range_profiles import RangeWindow, range_compress
from apertura.core.imaging.resolution import Resolution
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import Looks
from apertura.core.scene.terrain import FlatGround
from apertura.run.process import process
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers
from apertura.stages.pair import open_pair
from apertura.stages.planning import gated, plan_pair
from apertura.stages.scene import expected_scene
from apertura.views.plan import first_flight

GROUND = FlatGround(0.0)
GRID = SceneGrid("local", -14.0, 42.0, 0.25, (80, 112))
WHOLE = (slice(0, 80), slice(0, 112))
SPACING_HZ, SUBCARRIERS, PULSES = 1.6e6, 256, 300
FREQUENCY = 1.2e9 + SPACING_HZ * np.arange(SUBCARRIERS)
CELL_M = C / (SPACING_HZ * SUBCARRIERS)
EDGE_M = EDGE_CELLS * CELL_M
ALONG = np.linspace(0.0, 9.0, PULSES)
MONO = monostatic(straight_track(PULSES, length_m=24.0))
APERTURES = {"mono": MONO, "bi": Aperture(MONO.tx_m, MONO.rx_m + [3.0, -1.0, 0.5])}


def gate_of(aperture, middle_m=82.0):
    """Return a gate whose limit differs from pulse to pulse, as in a bistatic pair."""
    return RangeGate(middle_m + 0.4 * np.sin(ALONG), EDGE_M)


def recorded(gate, aperture, points):
    """Return the weight of each pulse at points by its definition: 1 up to an edge before the limit, 0 beyond."""
    depth = (gate.limit_m[:, None] - aperture.path(points)) / gate.edge_m
    smooth = depth**4 * (35 - 84 * depth + 70 * depth**2 - 20 * depth**3)
    return np.where(depth <= 0, 0.0, np.where(depth >= 1, 1.0, smooth))


def history_of(aperture, points, amplitudes, window="hann"):
    weight = np.hanning(SUBCARRIERS) if window == "hann" else np.ones(SUBCARRIERS)
    echo = transfer(Scatterers(np.asarray(points), np.asarray(amplitudes)), aperture, FREQUENCY, spreading=False)
    return PhaseHistory(echo, FREQUENCY, weight / weight.sum(), np.zeros(PULSES), aperture)


def profiles_of(history, beams):
    window = RangeWindow.of(history.aperture, GRID, GROUND, FREQUENCY, beams=beams, wave_speed_m_s=C)
    return range_compress(history, GRID, GROUND, window=window)


def pixels():
    return GROUND.positions(GRID)


def rms_db(error, exact):
    return 10 * np.log10((np.abs(error) ** 2).mean() / (np.abs(exact) ** 2).mean())


SCATTERED = np.random.default_rng(3).uniform([-14, 22, 0], [14, 42, 0], (80, 3))


# ---- Every engine sums the recorded echoes

ENGINES = {
    "native": ({"oversampling": 8}, {"tolerance_rad": 2e-4}),
    "numba": ({"oversampling": 16}, {}),
    "tree": ({"oversampling": 16}, {"nodes_db": -80, "presum_db": -80, "side_px": 64}),
}


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("flown", APERTURES)
@pytest.mark.parametrize("with_sector", [False, True])
def test_engines_sum_the_recorded_echoes(flown, with_sector):
    aperture = APERTURES[flown]
    sector = Sector.of(aperture, chord_m=3.0, centre=0.0, half=0.25) if with_sector else None
    gate, history = gate_of(aperture), history_of(aperture, SCATTERED, np.ones(80))
    beams, points = Beams(sector=sector, gate=gate), pixels().reshape(-1, 3)
    weight = recorded(gate, aperture, points)
    if sector:
        weight = weight * sector.weight(aperture, points)
    exact = (reference.terms(history, points) * weight).sum(axis=0).reshape(GRID.shape)
    np.testing.assert_allclose(reference.form(history, pixels(), beams=beams), exact, atol=1e-9 * np.abs(exact).max())
    profiles = profiles_of(history, beams)
    for name, (options, form_options) in ENGINES.items():
        engine = load_engine(name)
        image = engine.form(engine.prepare(profiles, **options), pixels(), beams=beams, **form_options)
        assert rms_db(image - exact, exact) < -62, name


@pytest.mark.slow
@compiled
def test_tree_is_not_chosen_where_a_flat_window_widens_the_band():
    """The edge of a gate widens the band of a flat window, which the nodes of a tree do not resolve."""
    size = {"shape": (4000, 4000), "aperture": monostatic(straight_track(3000))}
    gate = Beams(gate=RangeGate(np.full(3000, 55.0), EDGE_M))
    assert plan(**size).engine == "tree"
    assert plan(**size, beams=gate).engine != "tree"
    assert plan(-45.0, **size, beams=gate).engine == "tree"


@pytest.mark.slow
def test_gate_moves_with_the_paths_of_a_refined_track():
    """Profiles that are corrected by a path contain the gate at the corrected path."""
    gate, history, engine = gate_of(MONO), history_of(MONO, SCATTERED, np.ones(80)), load_engine("numba")
    extra_m, moved = 0.5 + 0.2 * np.cos(ALONG), Aperture(MONO.tx_m + [0.0, 0.1, 0.05], MONO.rx_m + [0.0, 0.1, 0.05])
    profiles = profiles_of(history, Beams(gate=gate)).moved(moved, extra_m)
    exact = reference.form(history.moved(moved, extra_m), pixels(), beams=Beams(gate=gate.moved(extra_m)))
    image = engine.form(engine.prepare(profiles, oversampling=16), pixels())
    assert rms_db(image - exact, exact) < -62
    unmoved = reference.form(history.moved(moved, extra_m), pixels(), beams=Beams(gate=gate))
    assert rms_db(image - unmoved, exact) > -40


def test_partly_recorded_scene_is_not_presummed():
    gate = Beams(gate=RangeGate(np.full(300, 55.0), EDGE_M))
    reasons = plan(beams=gate).reasons["presum"]
    assert "the weights of the recorded paths differ" in reasons
    with pytest.raises(CampaignError, match="or a partly recorded scene"):
        plan(beams=gate, overrides={"presum": 4})


@compiled
@pytest.mark.parametrize("blocks", ["auto", 3])
def test_image_has_no_data_exactly_where_no_pulse_recorded_the_pixel(blocks):
    """Interpolation and the sidelobes of a strong echo must not leak beyond the end of the recording."""
    gate = gate_of(MONO)
    history = history_of(MONO, [[0.0, 36.5, 0.0], *SCATTERED], [300.0, *np.ones(80)])
    image = ap.backproject(
        history, GRID, terrain=GROUND, beams=Beams(gate=gate), integration="all", pulse_blocks=blocks
    )
    unrecorded = ~(recorded(gate, MONO, pixels().reshape(-1, 3)) > 0).any(axis=0).reshape(GRID.shape)
    assert 0.1 < unrecorded.mean() < 0.5
    np.testing.assert_array_equal(image.values == 0, unrecorded)
    assert image.attrs["numerical_error_db"] < -60


def test_gate_excludes_only_pulses_without_weight():
    gate = gate_of(MONO)
    rng = np.random.default_rng(5)
    middle, radius = rng.uniform([-14, 22, 0], [14, 42, 0], (60, 3)), rng.uniform(0.1, 3.0, 60)
    mask = illumination_mask(Beams(gate=gate), MONO, middle, radius, pulses=16)
    excluded = 0
    for sphere in range(60):
        directions = rng.standard_normal((200, 3))
        inside = middle[sphere] + radius[sphere] * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        weight = recorded(gate, MONO, inside).max(axis=1)
        for block in np.flatnonzero(~mask[:, sphere]):
            assert not weight[16 * block : 16 * (block + 1)].any()
            excluded += 1
    assert excluded > 100


# ---- A point of which a part of the pulses recorded the echo

POINT = np.array([[10.0, 36.0, 0.0]])


def point_image(spacing_m=0.05):
    """Return a fine image around the point, its grid, and the weights of the pulses at the point."""
    gate = gate_of(MONO)
    grid = SceneGrid("local", POINT[0, 0] - 3.0, POINT[0, 1] + 3.0, spacing_m, (121, 121))
    history = history_of(MONO, POINT, [1.0])
    image = ap.backproject(history, grid, terrain=GROUND, beams=Beams(gate=gate), integration="all")
    return image.values, grid, recorded(gate, MONO, POINT)[:, 0]


def width(power, spacing_m):
    """Return the -3 dB width of a peak, interpolated linearly."""
    peak = int(power.argmax())
    half = power[peak] / 2
    right = peak + int(np.argmax(power[peak:] < half))
    left = peak - int(np.argmax(power[peak::-1] < half))
    ends = [
        right - 1 + (power[right - 1] - half) / (power[right - 1] - power[right]),
        left + 1 - (power[left + 1] - half) / (power[left + 1] - power[left]),
    ]
    return (ends[0] - ends[1]) * spacing_m


@compiled
def test_partly_recorded_point_has_its_place_amplitude_and_width():
    image, grid, weight = point_image()
    assert 0.3 < weight.mean() < 0.75
    power = np.abs(image) ** 2
    row, column = np.unravel_index(power.argmax(), power.shape)
    east_m, north_m = grid.west_m + (column + 0.5) * 0.05, grid.north_m - (row + 0.5) * 0.05
    assert (east_m, north_m) == pytest.approx((POINT[0, 0], POINT[0, 1]), abs=0.1)
    # the mean over all pulses, of which a part recorded the point
    assert np.sqrt(power.max()) == pytest.approx(weight.mean(), rel=0.02)
    # The calibration contains this factor: a calibrated point has its true cross-section.
    window = (slice(row, row + 1), slice(column, column + 1))
    per_m2 = [
        Calibration.of(grid, GROUND, MONO, beams, constant=1.0, cell_m2=1.0).rcs_power(window)[0, 0]
        for beams in (Beams(gate=gate_of(MONO)), None)
    ]
    assert per_m2[0] / per_m2[1] == pytest.approx(power.max(), rel=0.04)
    resolution = Resolution.of(
        grid, GROUND, MONO, Beams(gate=gate_of(MONO)), frequency_hz=FREQUENCY, weight=np.hanning(SUBCARRIERS)
    )
    fine = resolution.axes((slice(row, row + 1), slice(column, column + 1)))[0][0, 0]
    whole = Resolution.of(grid, GROUND, MONO, None, frequency_hz=FREQUENCY, weight=np.hanning(SUBCARRIERS))
    fine_whole = whole.axes((slice(row, row + 1), slice(column, column + 1)))[0][0, 0]
    assert fine > 1.4 * fine_whole  # the partial aperture resolves less
    # Response along the track: sum of the echoes' phases with the weights of the recorded pulses.
    along = POINT + np.linspace(-2.0, 2.0, 801)[:, None] * [1.0, 0.0, 0.0]
    cycles = (MONO.path(along) - MONO.path(POINT)) * FREQUENCY[SUBCARRIERS // 2] / C
    expected = np.abs((weight[:, None] * np.exp(2j * np.pi * cycles)).sum(axis=0)) ** 2
    assert width(power[row], 0.05) == pytest.approx(width(expected, 0.005), rel=0.08)
    assert width(power[row], 0.05) == pytest.approx(fine, rel=0.15)


# ---- Looks, noise and calibration


def some_pixels(count=1500):
    rows, columns = np.random.default_rng(7).integers(0, GRID.shape, (count, 2)).T
    return rows, columns, GROUND.positions_at(GRID, rows, columns)


@pytest.mark.quick("bi")
@pytest.mark.parametrize("flown", APERTURES)
def test_looks_are_those_of_the_recorded_pulses(flown):
    aperture = APERTURES[flown]
    gate = gate_of(aperture)
    looks = Looks.of(GRID, GROUND, aperture, Beams(gate=gate))
    rows, columns, points = some_pixels()
    weight = recorded(gate, aperture, points)
    total, squares = weight.sum(axis=0), (weight**2).sum(axis=0)
    lit = total > 0
    exact = np.where(lit, np.maximum(1, total**2 / np.where(lit, squares, 1)), 0)
    partly = lit & (weight < 1).any(axis=0)
    assert partly.sum() > 100
    np.testing.assert_allclose(looks.effective(WHOLE)[rows, columns], exact, rtol=2e-3)
    np.testing.assert_allclose(looks.weight_squares(WHOLE)[rows, columns], squares, rtol=2e-3, atol=1e-3)
    np.testing.assert_array_equal(looks.illuminated(WHOLE)[rows, columns], lit)


def test_looks_of_a_recorded_scene_are_unchanged():
    far = Beams(gate=RangeGate(np.full(PULSES, 1e3), EDGE_M))
    with_gate, without = (Looks.of(GRID, GROUND, MONO, beams) for beams in (far, None))
    np.testing.assert_array_equal(with_gate.effective(WHOLE), without.effective(WHOLE))


def noisy(draws, rng):
    """Return phase histories of white noise of unit power per subcarrier."""
    silent = history_of(MONO, POINT, [0.0])
    for _ in range(draws):
        noise = (rng.standard_normal((PULSES, SUBCARRIERS, 2)) @ [1, 1j]) / np.sqrt(2)
        yield replace(silent, transfer=noise.astype(np.complex64))


@pytest.mark.slow
def test_noise_of_a_pixel_is_that_of_its_recorded_pulses():
    """The variance of pixels of pure noise is σ²Σw²/M², and σ² is measured in spite of the gate."""
    beams, rng = Beams(gate=gate_of(MONO)), np.random.default_rng(11)
    calibration = Calibration.of(GRID, GROUND, MONO, beams, constant=1.0, cell_m2=1.0)
    share = calibration.pixel_noise(WHOLE)
    rows, columns, points = some_pixels(400)
    weight = recorded(gate_of(MONO), MONO, points)
    lit, partly = weight.any(axis=0), (weight < 0.98).any(axis=0) & (weight.sum(axis=0) > 15)
    np.testing.assert_allclose(share[rows, columns][lit], (weight**2).sum(axis=0)[lit] / PULSES**2, rtol=2e-3)
    assert np.isnan(share[rows, columns][~lit]).all()
    measured, sigma2 = np.zeros(partly.sum()), list[float]()
    draws = 16
    for history in noisy(draws, rng):
        image = reference.form(history, points[partly][None], beams=beams)[0] / PULSES
        measured += np.abs(image) ** 2 / draws
        sigma2.append(noise_power(profiles_of(history, beams), points, beams=beams).power)
    true = (history.weight**2).sum()
    ratio = measured / (true * share[rows, columns][partly])
    assert ratio.mean() == pytest.approx(1.0, abs=0.08)
    assert np.mean(sigma2) == pytest.approx(true, rel=0.1)


def test_nesz_of_terrain_does_not_depend_on_the_recorded_part():
    """Power of terrain and noise both grow with the number of recorded pulses: their ratio is that of all pulses."""
    partly = Calibration.of(GRID, GROUND, MONO, Beams(gate=gate_of(MONO)), constant=1.0, cell_m2=1.0)
    whole = Calibration.of(GRID, GROUND, MONO, None, constant=1.0, cell_m2=1.0)
    ratios = [each.pixel_noise(WHOLE) / each.power(WHOLE, "sigma0") for each in (partly, whole)]
    known = np.isfinite(ratios[0])
    assert 0.5 < known.mean() < 0.95
    np.testing.assert_allclose(ratios[0][known], ratios[1][known], rtol=1e-9)


# ---- A campaign


def opened(root, pair="uav1-uav1"):
    campaign = Campaign.load(root)
    return campaign, open_pair(campaign, "f01", pair), expected_scene(campaign, lambda: first_flight(campaign))


def limited(root, limit_m, pair="uav1-uav1"):
    campaign, opened_pair, scene = opened(root, pair)
    offset_m = float(opened_pair.path_limits_m[0]) - limit_m
    return campaign, replace(opened_pair, path_limits_m=opened_pair.path_limits_m - offset_m), scene


def paths_of(pair, scene):
    rows, columns = np.meshgrid(*(np.arange(size) for size in scene.grid.shape), indexing="ij")
    points = scene.terrain.positions_at(scene.grid, rows.ravel()[::7], columns.ravel()[::7])
    return pair.aperture.path(points)


def shares_of(line):
    """Return the shares of the scene not recorded by all pulses and by none, in percent."""
    return [float(part.split(" %")[0].split()[-1]) for part in line.split(":")[0].split(",")]


@pytest.mark.quick("uav1-uav2")
@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_flag_states_the_recorded_shares(tiny, pair):
    campaign, _, scene = opened(tiny, pair)
    path_m = paths_of(opened(tiny, pair)[1], scene)
    campaign, cut, scene = limited(tiny, float(np.quantile(path_m.min(axis=0), 0.8)), pair)
    cut = gated(campaign, cut, scene)
    weight = cut.gate.at(path_m)
    line = plan_pair(campaign, cut, scene).flags["scene_beyond_recording"]
    shares = shares_of(line)
    assert shares[0] == pytest.approx(100 * (weight < 1).any(axis=0).mean(), abs=1.5)
    assert shares[1] == pytest.approx(100 * (weight == 0).all(axis=0).mean(), abs=1.5)
    pulses = int(line.split("the cyclic prefix at ")[1].split()[0])
    assert pulses == pytest.approx((weight < 1).any(axis=1).sum(), abs=2)
    assert "A likely cause" not in line


def test_flag_names_a_default_height_as_a_cause(tiny):
    campaign, pair, scene = limited(tiny, float(np.median(paths_of(*opened(tiny)[1:]))))
    guessed = campaign.settings.scene.model_copy(update={"height_m": None})
    if not guessed.height_is_default:
        guessed = type(guessed).model_validate(
            {
                key: value
                for key, value in campaign.settings.scene.model_dump(exclude_unset=True).items()
                if key != "height_m"
            }
        )
    assert guessed.height_is_default
    guessing = replace(campaign, settings=campaign.settings.model_copy(update={"scene": guessed}))
    flags = plan_pair(guessing, gated(guessing, pair, scene), scene).flags
    assert "A likely cause: " in flags["scene_beyond_recording"]


def test_sufficient_limit_has_no_gate_and_no_flag(tiny):
    campaign, pair, scene = opened(tiny)
    longest_m = float(paths_of(pair, scene).max())
    side_m = 4 * scene.grid.spacing_m * max(scene.grid.shape) / 33  # spheres bound the paths of blocks of pixels
    enough = gated(*limited(tiny, longest_m + side_m))
    assert enough.gate is None
    assert "scene_beyond_recording" not in plan_pair(campaign, enough, scene).flags
    assert gated(*limited(tiny, longest_m - 0.1)).gate is not None


def test_scene_without_recorded_echoes_is_refused(tiny):
    shortest_m = float(paths_of(*opened(tiny)[1:]).min())
    with pytest.raises(CampaignError, match="echoes of the scene arrive after the cyclic prefix at"):
        gated(*limited(tiny, shortest_m - 0.1))
    assert gated(*limited(tiny, shortest_m + 2.0)).gate is not None


def widened(root):
    """Extend the scene beyond the recorded ranges on one side."""
    west, south, east, north = Campaign.load(root).settings.scene.bounds_m
    return state(root, "scene", bounds_m=[west, south, east + 120, north + 120], spacing_m=0.5)


def test_check_accepts_a_partly_recorded_scene(tiny):
    widened(tiny)
    assert not problems(tiny)


@pytest.mark.slow
def test_products_of_a_partly_recorded_campaign(tiny):
    """All steps run; pixels without a pulse are without data in every product; plan and image state the same shares."""
    campaign = widened(tiny)
    planned = {pair: gated(*opened(tiny, pair)) for pair in ("uav1-uav1", "uav1-uav2")}
    scene = opened(tiny)[2]
    planned_flags = {pair: plan_pair(campaign, each, scene).flags for pair, each in planned.items()}
    campaign = process(tiny)
    for pair, flags in planned_flags.items():
        folder = tiny / "results" / "f01"
        image = image_of(campaign, pair)
        empty = np.isnan(image.real)
        assert 0.1 < empty.mean() < 0.9
        quality = quality_of(campaign, pair)
        assert quality["numerical_error_db"] < -40
        name = "scene_beyond_recording"
        assert shares_of(flags[name]) == pytest.approx(shares_of(quality["flags"][name]), abs=1)
        assert shares_of(flags[name])[1] == pytest.approx(100 * empty.mean(), abs=1.5)
        masks = {
            "mask": lambda values: values == 255,
            "looks": lambda values: values == 0,
            "nesz": np.isnan,
            "incidence": np.isnan,
            "slc": lambda values: np.isnan(values.real),
            "db": np.isnan,
        }
        for product, is_empty in masks.items():
            with rasterio.open(folder / pair / f"{product}.tif") as raster:
                np.testing.assert_array_equal(is_empty(raster.read(1)), empty, product)
    with rasterio.open(tiny / "results/f01/fused/noncoherent_db.tif") as raster:
        fused = np.isnan(raster.read(1))
    images = [np.isnan(image_of(campaign, pair).real) for pair in planned]
    assert (fused >= (images[0] & images[1])).all()
    assert fused.mean() < 0.9
